"""The hand-over record, and the split of a motion into its modes."""

from dataclasses import replace

import numpy as np
import pytest

from discrepancy.errors import FitError
from discrepancy.location.dependence import modal_motion
from discrepancy.location.residuals import ResidualSet, quadratic_moments
from tests.discrepancy.bench import Bench, sensitivity


def test_sensitivity_holds_the_leverages_of_least_squares():
    generator = np.random.default_rng(3)
    jacobian = generator.standard_normal((30, 2, 4))
    noise = np.array([0.5, 2.0])
    table = (jacobian / noise[:, np.newaxis]).reshape(60, 4)
    covariance = np.linalg.inv(table.T @ table)
    hat = table @ covariance @ table.T
    found = sensitivity(jacobian, covariance, noise).reshape(60, 4)
    np.testing.assert_allclose(found @ found.T, hat, atol=1e-12)
    assert np.sum(found**2) == pytest.approx(4.0)


def test_moments_of_a_sum_of_squares_are_those_of_the_projection():
    generator = np.random.default_rng(5)
    S = np.linalg.qr(generator.standard_normal((12, 3)))[0] * np.array([1.0, 0.9, 0.4])
    A = np.eye(12) - S @ S.T
    expected = 1.0 - np.sum(S**2, axis=1)
    mean, freedom = quadratic_moments([(expected[:5], S[:5]), (expected[5:], S[5:])])
    assert mean == pytest.approx(np.trace(A))
    assert freedom == pytest.approx(np.trace(A) ** 2 / np.trace(A @ A))
    assert quadratic_moments([(expected, None)]) == pytest.approx((np.trace(A), np.trace(A)))


@pytest.mark.parametrize("held_out", [False, True])
def test_restored_residuals_are_white_with_unit_variance(held_out):
    bench = Bench(count=40, noise_freedom=np.inf, held_out=(False, held_out))
    generator = np.random.default_rng(11)
    draws = np.array([
        np.concatenate([part.ravel() for part in bench.fit(generator).white(generator)]) for _ in range(1200)
    ])  # fmt: skip
    covariance = draws.T @ draws / len(draws)
    plain = np.abs(covariance - np.eye(len(covariance)))
    # Standard deviations of the entries are sqrt(2 / 1200) on and sqrt(1 / 1200) off the diagonal.
    assert np.max(np.diag(plain)) < 5.0 * np.sqrt(2.0 / 1200)
    assert np.max(plain - np.diag(np.diag(plain))) < 6.0 * np.sqrt(1.0 / 1200)


def test_without_restoring_the_early_samples_are_too_quiet():
    bench = Bench(count=40, noise_freedom=np.inf, static=False)
    generator = np.random.default_rng(12)
    squares = np.mean([bench.fit(generator).trials[0].standardised[:8] ** 2 for _ in range(300)], axis=0)
    expected = bench.fit(generator).trials[0].expected_variance[:8]
    assert expected.min() < 0.9
    np.testing.assert_allclose(squares, expected, atol=0.35)
    assert np.mean(squares - expected) == pytest.approx(0.0, abs=0.06)


def test_what_no_fit_leaves_is_refused():
    good = Bench(count=40).fit(np.random.default_rng(1))
    item = good.trials[0]
    for change in (
        {"residual": np.full_like(item.residual, np.nan)},
        {"noise_deviation": np.zeros(4)},
        {"predictive_deviation": -item.predictive_deviation},
        {"leverage": np.full_like(item.leverage, 1.5)},
    ):
        with pytest.raises(
            FitError, match="not finite, deviations that are not positive, or a leverage above"
        ):
            replace(item, **change)
    for channels, trials in ((good.channels, ()), ({}, good.trials)):
        with pytest.raises(FitError, match="at least one trial, and the channels"):
            ResidualSet(channels, trials)


def test_values_that_are_not_used_may_be_anything():
    good = Bench(count=40).fit(np.random.default_rng(1))
    item = good.trials[0]
    used = item.used.copy()
    used[7, 2] = False
    residual = item.residual.copy()
    residual[7, 2] = np.nan
    changed = replace(item, trial=replace(item.trial, used=used), residual=residual)
    assert np.isnan(changed.standardised[7, 2])
    white = ResidualSet(good.channels, (changed,)).white(np.random.default_rng(0))[0]
    assert np.all(np.isfinite(white))


# ---------------------------------------------------------------- splitting a motion into its modes


def test_two_damped_modes_are_split_up_to_the_ends():
    time = 0.005 * np.arange(800)
    waves = []
    for f, zeta, size in ((5.3, 0.02, 1.0), (28.0, 0.01, 0.4)):
        w = 2.0 * np.pi * f
        waves.append(size * np.exp((-zeta + 1j) * w * time))
    values = (waves[0] + waves[1]).real[:, np.newaxis] + 0.3
    found = modal_motion(values, 0.005, (5.2, 28.3))
    assert found is not None
    for mode, wave in enumerate(waves):
        size = np.abs(wave)
        for part, exact in zip(found, (wave.real, -wave.imag, size), strict=True):
            error = np.abs(part[mode, :, 0] - exact) / size[0]
            # Frequencies are 1 to 2 % off, and at the ends a window looks to one side only.
            assert error.max() < 0.08
            assert error[80:-80].max() < 0.03


@pytest.mark.parametrize("frequencies", [(), (5.0, 120.0), (5.0, 5.01), (0.01,)])
def test_what_cannot_be_split_is_none(frequencies):
    assert modal_motion(np.ones((100, 1)), 0.005, frequencies) is None
