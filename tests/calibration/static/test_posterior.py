"""Densities on a grid: moments, quantiles, samples."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal, norm

from calibration.errors import OutsideValidityError, PosteriorError
from calibration.static.errors_in_variables import exact_posterior, log_likelihood, pair_log_likelihoods
from calibration.static.experiments import published_measurements
from calibration.static.posterior import (
    PUBLISHED_LINE,
    TABLE_TOLERANCE,
    GaussianPrior,
    ScalarPosterior,
    stiffness_curve_of,
    stiffness_line,
)


def gaussian(mean=1.0, deviation=0.02, size=2001):
    prior = GaussianPrior(mean, deviation)
    grid = mean + deviation * np.linspace(-10.0, 10.0, size)
    return prior, ScalarPosterior(grid, prior.density(grid) * 7.0)


def test_moments_quantiles_and_intervals_of_a_gaussian():
    prior, posterior = gaussian()
    assert posterior.mean == pytest.approx(1.0, abs=1e-12)
    assert posterior.standard_deviation == pytest.approx(0.02, rel=1e-9)
    probability = np.array([1e-6, 0.025, 0.3, 0.5, 0.99])
    assert posterior.quantile(probability) == pytest.approx(prior.quantile(probability), abs=2e-6)
    assert posterior.interval(0.95) == pytest.approx((1 - 1.959964 * 0.02, 1 + 1.959964 * 0.02), abs=1e-6)
    value = np.array([0.95, 1.0, 1.01])
    below = norm.cdf(value, prior.mean, prior.standard_deviation)
    assert posterior.cumulative(value) == pytest.approx(below, abs=1e-5)


@given(
    density=st.lists(st.floats(0.0, 1e6), min_size=3, max_size=12).filter(lambda d: max(d) > 1e-3),
    probability=st.floats(0.0, 1.0),
)
def test_quantile_inverts_the_distribution_function(density, probability):
    posterior = ScalarPosterior(np.linspace(0.0, 1.0, len(density)), np.array(density))
    value = posterior.quantile(probability)
    assert 0.0 <= value <= 1.0
    assert posterior.cumulative(value) == pytest.approx(probability, abs=1e-9)


def test_samples_repeat_bit_for_bit_and_follow_the_density():
    """One in each stratum, in random order."""
    _, posterior = gaussian()
    samples = posterior.samples(5, 20_000)
    assert np.array_equal(samples, posterior.samples(np.random.SeedSequence(5), 20_000))
    assert not np.array_equal(samples, posterior.samples(6, 20_000))
    assert samples.mean() == pytest.approx(1.0, abs=6e-4)
    assert samples.std() == pytest.approx(0.02, rel=0.03)
    samples = posterior.samples(5, 100)
    strata = np.floor(posterior.cumulative(samples) * 100.0 + 1e-9).astype(int).tolist()
    assert sorted(strata) == list(range(100)) != strata
    assert abs(samples.mean() - 1.0) < 2e-4


# ---------------------------------------------------------------- stiffness curves


RANGE = (0.9, 1.1)


class Springs:
    """A skin spring in parallel with another, both on a root spring: a smooth curve that is no line."""

    def __init__(self):
        self.calls = 0

    def tip_stiffness(self, young_modulus_factor):
        self.calls += 1
        return 1.0 / (1.0 / (640.0 * young_modulus_factor + 100.0) + 1.0 / 8000.0)


def test_a_table_meets_its_model_within_the_stated_error():
    """And continues smoothly beyond its ends."""
    model = Springs()
    curve = stiffness_curve_of(model.tip_stiffness, RANGE)
    assert (curve.lower, curve.upper) == (0.9, 1.1)
    assert model.calls < 600
    factor = np.linspace(0.9, 1.1, 997)
    exact = np.array([model.tip_stiffness(value) for value in factor])
    assert np.abs(curve.stiffness(factor) / exact - 1.0).max() < 3.0 * TABLE_TOLERANCE
    slope = (curve.stiffness(factor + 1e-6) - curve.stiffness(factor - 1e-6)) / 2e-6
    assert curve.slope(factor[1:-1]) == pytest.approx(slope[1:-1], rel=1e-4)
    for end in RANGE:
        below, at, above = curve.stiffness([end - 1e-6, end, end + 1e-6])
        assert at - below == pytest.approx(above - at, rel=1e-3)
    anywhere = np.linspace(0.3, 1.9, 33)
    assert curve.young_modulus_factor(curve.stiffness(anywhere)) == pytest.approx(anywhere, abs=1e-7)


def test_a_rough_curve_is_refused():
    with pytest.raises(PosteriorError, match="too rough"):
        stiffness_curve_of(lambda e: 600.0 + 100.0 * e + 5.0 * (70.0 * e // 1.0), RANGE)


# ---------------------------------------------------------------- the exact posterior


DATA = published_measurements()
FACTORS = np.linspace(0.85, 1.2, 36)


@pytest.mark.parametrize("measure", ["displacement", "load", "ratio"])
def test_pair_likelihoods_equal_quadrature_over_the_true_displacement(measure):
    true = np.linspace(1e-5, 25e-3, 40_001)  # m
    k = PUBLISHED_LINE.stiffness(FACTORS)
    weight = true if measure == "ratio" else 1.0
    brute = np.empty((DATA.count, FACTORS.size))
    for pair, (load, displacement) in enumerate(zip(DATA.load, DATA.displacement, strict=True)):
        of_displacement = norm.pdf(displacement, true, DATA.displacement_standard_deviation) * weight
        for index, stiffness in enumerate(k):
            of_load = norm.pdf(load, stiffness * true, DATA.load_standard_deviation)
            brute[pair, index] = np.trapezoid(of_load * of_displacement, true)
    brute = brute * {"load": k, "ratio": 575.2}.get(measure, 1.0)
    if measure == "ratio":
        ours = pair_log_likelihoods(PUBLISHED_LINE, DATA, FACTORS, "ratio")
        assert ours == pytest.approx(np.log(brute), abs=1e-8)
    total = log_likelihood(PUBLISHED_LINE, DATA, FACTORS, measure=measure)
    assert total == pytest.approx(np.log(brute).sum(axis=0), abs=1e-7)


@pytest.mark.parametrize("zero_offset", [0.0, 1e-4, 5e-3])
def test_a_shared_zero_offset_equals_the_full_covariance(zero_offset):
    expected = np.zeros(FACTORS.size)
    for index, k in enumerate(PUBLISHED_LINE.stiffness(FACTORS)):
        for run in DATA.run_indices:
            of_run = DATA.run == run
            count = int(of_run.sum())
            variance = DATA.load_standard_deviation**2 + (k * DATA.displacement_standard_deviation) ** 2
            covariance = variance * np.eye(count) + (k * zero_offset) ** 2
            residual = DATA.load[of_run] - k * DATA.displacement[of_run]
            expected[index] += multivariate_normal.logpdf(residual, np.zeros(count), covariance)
    ours = log_likelihood(PUBLISHED_LINE, DATA, FACTORS, zero_offset_standard_deviation=zero_offset)
    assert ours == pytest.approx(expected, abs=1e-8)


def test_published_pairs():
    posterior = exact_posterior(DATA)
    assert posterior.mean == pytest.approx(1.00797, abs=1e-5)
    assert posterior.standard_deviation == pytest.approx(0.01031, abs=1e-5)
    # The closed form of the paper's filter meets the paper's Table 1 to its last digit.
    ratio = exact_posterior(DATA, measure="ratio")
    assert f"{ratio.mean:.4f} {ratio.standard_deviation:.4f}" == "1.0073 0.0103"
    # measurements far from the prior are followed
    stiff = dataclasses.replace(
        DATA, displacement=DATA.load / PUBLISHED_LINE.stiffness(1.6), displacement_standard_deviation=1e-6,
        load_standard_deviation=1e-4,
    )  # fmt: skip
    posterior = exact_posterior(stiff)
    assert posterior.mean == pytest.approx(1.6, abs=1e-3)
    assert 0.0 < posterior.standard_deviation < 1e-3
    curve = stiffness_line(575.2, 101.8, "narrow model", 0.9, 0.99)
    with pytest.raises(OutsideValidityError, match=r"outside \[0.9, 0.99\], where narrow model"):
        exact_posterior(DATA, curve=curve)
