"""Forces that act at times: evidence against dense Gaussians, moments against hidden truths."""

import numpy as np
import pytest

from benchmarks.event_moments import found_in as found_in_series
from benchmarks.event_moments import noise, record
from benchmarks.force_events import counted, drawn, found_in, problem_of
from discrepancy.judgement.when import begins_inside, when_sentence
from discrepancy.missing_force.events import Acting, EventSearch
from discrepancy.missing_force.filtered import Process
from discrepancy.missing_force.view import View
from discrepancy.missing_force.windows import residual_windows
from discrepancy.report.residual_figures import time_line_figure
from discrepancy.verdict import GapWindow, Moment
from discrepancy.workflow import investigate
from tests.discrepancy.bench import Bench

from .test_filtered import dense, trial_of

EVENT, REST = Process(2.0, 0.15, rough=True), Process(0.5, 0.4, rough=True)


@pytest.mark.parametrize("uneven", [False, True], ids=["even", "uneven"])
def test_the_evidence_of_an_event_is_that_of_dense_conditioning(uneven):
    random = np.random.default_rng(3)
    time = 0.02 * np.arange(40)
    if uneven:
        time = np.round(time + np.r_[0.0, random.uniform(-0.006, 0.006, 39)], 3)
    residual = random.standard_normal((40, 2)) * [3.0, 1.0]
    local = random.standard_normal((1, 40, 2))
    trial = trial_of(time, residual, local=local)
    search = EventSearch(View([trial], np.zeros(0)), 0, EVENT, [np.zeros(40, dtype=bool)])
    steps = search.steps(0, Acting(EVENT, REST))
    starts, ends = np.array([0, 7, 20]), np.array([9, 26, 40])
    values = search.evidence(*search.ways(0, steps, np.zeros(40, dtype=bool), starts, ends))
    always = dense(trial, REST)[0] + np.eye(80) + np.outer(local.ravel(), local.ravel())
    for a, start in enumerate(starts):
        for b, end in enumerate(ends):
            if end <= start:
                assert values[a, b] == -np.inf
                continue
            edge = (-np.inf if start == 0 else time[start], np.inf if end == 40 else time[end])
            covariance = always + dense(trial, EVENT, window=edge)[0]
            wanted = -0.5 * residual.ravel() @ np.linalg.solve(covariance, residual.ravel())
            wanted -= 0.5 * np.linalg.slogdet(covariance)[1]
            assert values[a, b] == pytest.approx(wanted, abs=0.05)
            on = np.zeros(40, dtype=bool)
            on[start:end] = True
            assert search.evidence(*search.whole(0, steps, on)) == pytest.approx(values[a, b], abs=1e-7)


def test_a_force_that_turns_is_one_that_does_not_turned():
    """Its readings before and after a turn have the opposite correlation; what they are alone is the same."""
    trial = trial_of(0.02 * np.arange(40), np.random.default_rng(5).standard_normal((40, 2)))
    never, turns = np.zeros(40, dtype=bool), np.arange(40) == 20
    both = [EventSearch(View([trial], np.zeros(0)), 0, EVENT, [flips]) for flips in (never, turns)]
    acting = Acting(EVENT, Process(1e-6, 1.0, rough=True))
    for on, same in ((np.arange(40) < 20, True), (~never, False)):
        one, other = (search.total(acting, [on]) for search in both)
        assert (abs(one - other) < 1e-9) is same


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        ("power", 9),
        ("leak", 5),
        ("tank", 3),
        ("push", 9),
        ("push", 8),
        ("friction", 2),
        ("always", 0),
        ("nothing", 2),
    ],
)
def test_begin_and_end_of_what_acts_for_a_while_are_found(tmp_path, kind, seed):
    kinds = ("power", "leak", "tank", "push", "friction", "always", "nothing")
    case = drawn(tmp_path / kind, kind, (1, seed, kinds.index(kind)))
    found = found_in(case)
    counts = counted(case, found)
    assert counts["close"] == counts["moments"] == 2 * len(case.windows) == len(found)
    for true, (_, low, high) in zip(np.ravel(case.windows), found, strict=True):
        wide = high - low  # an interval of 90 % three times as wide fails in one of a million cases
        assert low - wide < true < high + wide


@pytest.mark.parametrize("kind", ["offset", "random motion", "line", "scatter"])
def test_moments_of_residuals_are_where_they_were_made(kind):
    generator = np.random.default_rng(5)
    for _ in range(2):
        time, values, truth = record(generator, kind)
        found = found_in_series(time, values).moments(0)
        assert len(found) == len(truth)
        np.testing.assert_allclose(found[:, 0], truth, atol=0.01 * time[-1])


def test_quiet_records_of_coloured_noise_have_no_event():
    generator = np.random.default_rng(7)
    for _ in range(5):
        best = found_in_series(np.arange(400.0), noise(generator, 400, 0.5))
        assert not best.moments(0).size


def test_a_window_of_a_campaign_is_told_and_drawn():
    bench = Bench(count=300)
    event = np.zeros((300, 4))
    event[120:200, 1] = 16.0  # eight noises, from 1.2 s to 2 s
    fitted = bench.fit(np.random.default_rng(4), extra={1: event})
    (window,) = residual_windows(fitted)
    assert (window.trial, window.channels) == ("release 2", ("g2",))
    assert window.begin.low - 0.01 <= 1.2 <= window.begin.high + 0.01
    assert window.end.low - 0.01 <= 2.0 <= window.end.high + 0.01
    assert window.size == pytest.approx(8.0, rel=0.1)
    assert residual_windows(fitted) == (window,)
    assert begins_inside((window,))
    sentence = when_sentence((window,))
    assert sentence.startswith("The gap is there in 'release 2' since 1.")
    figure = time_line_figure((window,))
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == ["release 2"]
    assert residual_windows(bench.fit(np.random.default_rng(4))) == ()


def test_a_verdict_tells_when_a_store_leaked(tmp_path):
    case = drawn(tmp_path / "leak", "leak", (1, 5, 1))
    found = investigate(problem_of(case).campaign, problem_of(case).model)
    told = [window for window in found.verdict.windows if not window.with_effect]
    assert len(told) == len(case.windows)
    for window, (begin, end) in zip(told, case.windows, strict=True):
        assert abs(window.begin.value - begin) < 0.01 * case.length
        assert abs(window.end.value - end) < 0.01 * case.length
        assert window.channels == ("block",)
        assert window.size > 3.0
    assert when_sentence(told) in found.verdict.sentence


def test_words_of_windows():
    whole = GapWindow("a", ("x",), None, None, 0.0, 9.0, 4.0)
    assert when_sentence((whole,)) == "The gap is there throughout the records."
    assert not begins_inside((whole,))
    part = GapWindow("b", ("x",), Moment(1.0, 0.98, 1.04), None, 0.0, 9.0, 3.0)
    assert when_sentence((whole, part)) == (
        "The gap is there in 'b' since 1.000 s (0.980 to 1.040), to the end of the record, 3 times the "
        "noise; in 'a' throughout the record, 4 times the noise."
    )
    assert when_sentence((whole, part, part, part)) == (
        "The gap comes and goes, 4 times; the largest is in 'a' throughout the record, 4 times the noise."
    )
    left = GapWindow("b", ("x",), None, Moment(2.0, 1.5, 2.5), 0.0, 9.0, 2.0, with_effect=True)
    assert when_sentence((left,)) == ""
    assert time_line_figure(()) is None
