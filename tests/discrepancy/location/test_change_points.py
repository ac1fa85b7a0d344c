"""Change points: evidence against dense Gaussians, the optimum against enumeration, moments against truth."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.stats import multivariate_normal, multivariate_t

from benchmarks.event_moments import noise, record
from discrepancy.judgement.when import begins_inside, when_sentence
from discrepancy.location.change_points import (
    COLOURS,
    SHORTEST,
    GapWindow,
    Moment,
    SegmentEvidence,
    best_segmentation,
    change_price,
    gap_windows,
    segments_of,
)
from discrepancy.report.time_line import time_line_figure


@pytest.mark.parametrize("freedom", [7.0, np.inf])
def test_quiet_evidence_is_that_of_dense_gaussians(freedom: float) -> None:
    series = np.random.default_rng(1).normal(0.0, 1.3, (12, 1))
    evidence = SegmentEvidence(series, np.ones((12, 1), bool), np.array([freedom]))
    quiet, _ = evidence.quiet_and_gap(np.array([2]), np.array([9]))
    expected = []
    for colour in COLOURS:
        covariance = toeplitz(colour ** np.arange(7))
        values = series[2:9, 0]
        if np.isinf(freedom):
            expected.append(multivariate_normal.logpdf(values, cov=covariance))
        else:  # the variance is inverse gamma with the record's degrees of freedom
            expected.append(multivariate_t.logpdf(values, shape=covariance, df=freedom))
    assert quiet[0, 0] == pytest.approx(np.log(np.mean(np.exp(expected))), rel=1e-9)


def test_the_segmentation_is_the_best_of_all() -> None:
    generator = np.random.default_rng(3)
    count, changed = 18, 0
    for _ in range(5):
        series = generator.standard_normal((count, 2))
        series[generator.integers(4, 9) : generator.integers(11, 15), 0] += generator.uniform(4.0, 20.0)
        evidence = SegmentEvidence(series, np.ones((count, 2), bool), np.array([20.0, np.inf]))
        price = change_price(count)
        best, least = (), -np.inf
        for number in range(4):
            for changes in combinations(range(1, count), number):
                known = (0, *changes, count)
                if min(b - a for a, b in pairwise(known)) < SHORTEST:
                    continue
                total = sum(
                    float(evidence.scores(np.array([a]), np.array([b]))[0]) for a, b in pairwise(known)
                )
                if total - price * number > least:
                    best, least = changes, total - price * number
        assert best_segmentation(evidence, np.arange(count + 1), price) == list(best)
        changed += bool(best)
    assert changed >= 2


@pytest.mark.parametrize("kind", ["offset", "random motion", "line", "scatter"])
def test_moments_are_where_they_were_made(kind: str) -> None:
    generator = np.random.default_rng(5)
    held = total = 0
    for _ in range(5):
        time, values, truth = record(generator, kind)
        segments = segments_of(values[:, None], np.ones((len(values), 1), bool), time, np.array([99.0]))
        moments = [item.begin for item in segments if item.begin is not None]
        assert len(moments) == len(truth)
        for true, found in zip(truth, moments, strict=True):
            assert abs(found.value - true) < 0.01 * time[-1]
            held += found.low <= true <= found.high
            total += 1
    assert held >= 0.5 * total  # 90 % are expected: at most 10 moments, of which 5 fail in 0.2 % of cases


def test_quiet_records_of_coloured_noise_have_no_event() -> None:
    generator = np.random.default_rng(7)
    for _ in range(15):
        values = noise(generator, 400, 0.5)[:, None]
        (only,) = segments_of(values, np.ones(values.shape, bool), np.arange(400.0), np.array([99.0]))
        assert not only.holds.any()


def test_blanks_are_no_event_and_widen_an_interval_only_where_they_are() -> None:
    generator = np.random.default_rng(9)
    values = generator.standard_normal((500, 1))
    values[300:] += 8.0
    used = np.ones((500, 1), bool)
    used[:60] = used[280:310] = False
    values[~used] = np.nan
    quiet, gap = segments_of(values, used, np.arange(500.0), np.array([np.inf]))
    assert not quiet.holds.any()
    assert gap.holds.all()
    assert gap.begin is not None
    assert 279.0 <= gap.begin.low < 284.0  # anywhere in the blanks, none of which tells more than another
    assert 306.0 < gap.begin.high <= 310.0


def test_a_window_of_a_campaign_is_told_and_drawn(make_bench) -> None:  # type: ignore[no-untyped-def]
    bench = make_bench(count=300)
    event = np.zeros((300, 4))
    event[120:200, 1] = 16.0  # eight noises, from 1.2 s to 2 s
    fitted = bench.fit(np.random.default_rng(4), extra={1: event})
    (window,) = gap_windows(fitted)
    assert (window.trial, window.channels) == ("release 2", ("g2",))
    assert window.begin is not None
    assert window.end is not None
    assert window.begin.low <= 1.2 <= window.begin.high + 0.01
    assert window.end.low - 0.01 <= 2.0 <= window.end.high + 0.01
    assert gap_windows(fitted) == (window,)
    assert begins_inside((window,))
    sentence = when_sentence((window,))
    assert sentence.startswith("The gap is there in 'release 2' since 1.19")
    assert " until 1.99" in sentence
    figure = time_line_figure((window,))
    assert figure is not None
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == ["release 2"]
    assert gap_windows(bench.fit(np.random.default_rng(4))) == ()


def test_words_of_windows() -> None:
    whole = GapWindow("a", ("x",), None, None, 0.0, 9.0, 4.0)
    assert when_sentence((whole,)) == "The gap is there throughout the records."
    assert not begins_inside((whole,))
    part = GapWindow("b", ("x",), Moment(1.0, 0.98, 1.04), None, 0.0, 9.0, 3.0)
    assert when_sentence((whole, part)) == (
        "The gap is there in 'b' since 1.000 s (0.980 to 1.040), to the end of the record, 3 times the "
        "noise; in 'a' throughout the record, 4 times the noise."
    )
    left = GapWindow("b", ("x",), None, Moment(2.0, 1.5, 2.5), 0.0, 9.0, 2.0, with_effect=True)
    assert when_sentence((left,)) == ""
    assert time_line_figure(()) is None
