"""Proof: scores of calibrated predictions, gaps, standard errors over trials."""

from dataclasses import replace
from math import isnan, log, pi

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter

from discrepancy.campaign.records import NoiseRecord
from discrepancy.errors import FitError
from discrepancy.judgement.proof import correlation_time, gap_closed, log_density, prove, score_gain, scores
from tests.discrepancy.bench import Bench, with_noise


def lacking(bench, size):
    """Return what a model lacks in every release."""
    shape = np.array([1.0, 0.8, 0.5, 0.2])
    return {
        n: np.outer(size * np.cos(2 * np.pi * 9.0 * t.time) * np.exp(-0.8 * t.time), shape)
        for n, t in enumerate(bench.trials)
        if t.release is not None
    }


MANY = (200.0, 180.0, 150.0, 120.0, 100.0, 80.0)
HELD = (False, True, False, True, True, True)


def test_scores_of_a_right_model():
    bench = Bench(count=400, amplitudes=MANY, held_out=HELD, noise_freedom=2000.0)
    fitted = bench.fit(np.random.default_rng(13))
    for part in (fitted.fitted, fitted.held_out):
        found = scores(part)
        assert found.chi_square_per_dof == pytest.approx(1.0, abs=4.0 * found.chi_square_deviation)
        assert found.coverage_50 == pytest.approx(0.5, abs=0.03)
        assert found.coverage_90 == pytest.approx(0.9, abs=0.02)
        assert found.log_score == pytest.approx(-0.5 * (1.0 + log(2.0 * pi)), abs=0.06)
        assert found.whiteness > 0.01
        assert found.pit_p_value > 0.01
        assert sum(found.pit) == pytest.approx(1.0)
        assert found.rms["g1"] == pytest.approx(2.0, rel=0.1)


def test_uniformity_of_transforms_is_calibrated_and_sees_wrong_spread():
    bench = Bench(count=100, noise_freedom=np.inf)
    generator = np.random.default_rng(4)
    p = []
    for _ in range(150):
        fitted = bench.fit(generator)
        trials = tuple(
            replace(i, predictive_deviation=i.noise_deviation * np.sqrt(i.expected_variance))
            for i in fitted.trials
        )
        p.append(scores(replace(fitted, trials=trials)).pit_p_value)
    assert np.mean(np.array(p) < 0.05) < 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / 150)
    wide = tuple(replace(i, predictive_deviation=1.5 * i.predictive_deviation) for i in fitted.trials)
    assert scores(replace(fitted, trials=wide)).pit_p_value < 1e-6


def test_a_closed_gap_is_one_and_an_open_gap_zero():
    """Half the error leaves a quarter of the gap."""
    bench = Bench(amplitudes=MANY, held_out=HELD)
    before = bench.fit(np.random.default_rng(5), extra=lacking(bench, 25.0))
    proof = prove(before, bench.fit(np.random.default_rng(5)))
    assert proof.held_out_before.chi_square_per_dof > 3.0
    assert proof.gap_closed == pytest.approx(1.0, abs=0.1)
    assert proof.gap_reason == ""
    assert proof.log_score_gain > 5.0 * proof.log_score_gain_error > 0.0
    assert proof.remaining.startswith("Nothing that these data can show remains")
    none = prove(before, before)
    assert none.gap_closed == 0.0
    assert none.log_score_gain == none.log_score_gain_error == 0.0
    assert none.remaining.startswith("Still unexplained: χ²/dof")
    exact = Bench(amplitudes=MANY, held_out=HELD, noise_freedom=np.inf)
    sets = [exact.fit(np.random.default_rng(6), extra=lacking(exact, size)) for size in (40.0, 20.0)]
    assert prove(*sets).gap_closed == pytest.approx(0.75, abs=0.03)


def test_no_gap_is_said_and_not_divided_by():
    """Nor is there one without a held-out trial or a noise record."""
    fitted = Bench(amplitudes=(200.0, 150.0), held_out=(False, True)).fit(np.random.default_rng(7))
    proof = prove(fitted, fitted)
    assert isnan(proof.gap_closed)
    assert "show no gap before" in proof.gap_reason
    bare = with_noise(fitted, None)
    proof = prove(bare, bare)
    assert isnan(proof.held_out_after.chi_square_per_dof)
    assert "No noise record" in proof.gap_reason
    assert "not known" in proof.remaining
    without = Bench().fit(np.random.default_rng(7))
    proof = prove(without, without)
    assert isnan(proof.gap_closed)
    assert isnan(proof.log_score_gain)
    assert proof.gap_reason == "No trial was held out."
    assert proof.held_out_after is None
    assert gap_closed(None, None)[1] == "No trial was held out."


def test_scores_of_one_set():
    """Density beside scipy; a short record widens the deviation; without a used sample there is none."""
    fitted = Bench(count=40, noise_freedom=np.inf).fit(np.random.default_rng(2))
    item = fitted.trials[0]
    expected = stats.norm.logpdf(item.residual, scale=item.predictive_deviation)
    np.testing.assert_allclose(log_density(item), expected + np.log(item.noise_deviation), rtol=1e-12)
    exact, loose = (
        scores(residuals).chi_square_deviation
        for residuals in (fitted, with_noise(fitted, NoiseRecord(2.0, 10.0)))
    )
    assert loose**2 == pytest.approx(exact**2 + 0.2)
    unused = replace(item, trial=replace(item.trial, used=np.zeros_like(item.used)))
    with pytest.raises(FitError, match="at least one used sample"):
        scores(replace(fitted, trials=(unused,)))


def test_standard_error_is_that_of_trials_not_of_samples():
    # Gains differ from trial to trial by a random size: only the number of trials can shrink the error.
    bench = Bench(count=200, amplitudes=MANY, held_out=HELD, noise_freedom=np.inf)
    generator = np.random.default_rng(9)
    found = []
    for _ in range(120):
        held = [n for n, t in enumerate(bench.trials) if t.held_out]
        extra = {n: generator.standard_normal() * 1.5 * np.ones((1, 4)) for n in held}
        seed = generator.integers(1 << 30)
        sets = [bench.fit(np.random.default_rng(seed), extra=more).held_out for more in (extra, None)]
        found.append(score_gain(*sets))
    gains, errors = np.array(found).T
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.std(gains), rel=0.35)


def test_correlation_time_of_an_autoregression():
    white = np.random.default_rng(10).standard_normal((40, 4000))
    found = [correlation_time(series) for series in lfilter([1.0], [1.0, -0.8], white)]
    assert np.mean(found) == pytest.approx(1.8 / 0.2, rel=0.15)
    assert correlation_time(np.ones(10)) == 1.0
    assert correlation_time(np.array([1.0, -1.0] * 50)) == 1.0
