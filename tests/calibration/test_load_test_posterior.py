"""The posterior of a load test: densities on a grid, stiffness curves, likelihoods."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from calibration.errors import OutsideValidityError, PosteriorError
from calibration.static.errors_in_variables import exact_posterior, log_likelihood
from calibration.static.experiments import published_measurements
from calibration.static.posterior import (
    PUBLISHED_LINE,
    TABLE_TOLERANCE,
    GaussianPrior,
    ScalarPosterior,
    stiffness_curve_of,
    stiffness_line,
)

LOAD_TEST = published_measurements()

# ---------------------------------------------------------------- densities on a grid

GAUSSIAN = GaussianPrior(1.0, 0.02)


@pytest.fixture(scope="module")
def gaussian_on_grid():
    """The density of `GAUSSIAN`, times seven, on a grid of ten deviations to both sides."""
    grid = 1.0 + 0.02 * np.linspace(-10.0, 10.0, 2001)
    return ScalarPosterior(grid, np.exp(GAUSSIAN.log_density(grid)) * 7.0)


def test_a_gaussian_on_a_grid_has_its_moments(gaussian_on_grid):
    assert gaussian_on_grid.mean == pytest.approx(1.0, abs=1e-12)
    assert gaussian_on_grid.standard_deviation == pytest.approx(0.02, rel=1e-9)


def test_a_gaussian_on_a_grid_has_its_quantiles(gaussian_on_grid):
    probability = np.array([1e-6, 0.025, 0.3, 0.5, 0.99])

    quantiles = gaussian_on_grid.quantile(probability)

    assert quantiles == pytest.approx(GAUSSIAN.quantile(probability), abs=2e-6)


def test_a_gaussian_on_a_grid_has_its_interval(gaussian_on_grid):
    half_width = 1.959964 * 0.02

    interval = gaussian_on_grid.interval(0.95)

    assert interval == pytest.approx((1 - half_width, 1 + half_width), abs=1e-6)


def test_a_gaussian_on_a_grid_has_its_cumulative_probability(gaussian_on_grid):
    value = np.array([0.95, 1.0, 1.01])

    cumulative = gaussian_on_grid.cumulative(value)

    expected = norm.cdf(value, GAUSSIAN.mean, GAUSSIAN.standard_deviation)
    assert cumulative == pytest.approx(expected, abs=1e-5)


def test_samples_repeat_bit_for_bit(gaussian_on_grid):
    samples = gaussian_on_grid.samples(5, 20_000)

    same_seed = np.random.SeedSequence(5)
    assert np.array_equal(samples, gaussian_on_grid.samples(same_seed, 20_000))
    assert not np.array_equal(samples, gaussian_on_grid.samples(6, 20_000))


def test_samples_follow_the_density(gaussian_on_grid):
    samples = gaussian_on_grid.samples(5, 20_000)

    assert samples.mean() == pytest.approx(1.0, abs=6e-4)
    assert samples.std() == pytest.approx(0.02, rel=0.03)


def test_there_is_one_sample_in_each_stratum_in_random_order(gaussian_on_grid):
    samples = gaussian_on_grid.samples(5, 100)

    probability = gaussian_on_grid.cumulative(samples)
    strata = np.floor(probability * 100.0 + 1e-9).astype(int).tolist()
    assert sorted(strata) == list(range(100))
    assert strata != list(range(100))
    assert abs(samples.mean() - 1.0) < 2e-4


# ---------------------------------------------------------------- stiffness curves

LOW = 0.9
HIGH = 1.1


@dataclass
class CountedModel:
    """A model of the tip stiffness that counts how often it is asked."""

    calls: list[float] = field(default_factory=list)

    def __call__(self, young_modulus_factor):
        """Return the stiffness of two springs beside each other, both on a root spring: no line."""
        self.calls.append(young_modulus_factor)
        return 1.0 / (1.0 / (640.0 * young_modulus_factor + 100.0) + 1.0 / 8000.0)


@dataclass(frozen=True)
class TabulatedModel:
    """A stiffness curve, the calls that it needed, and its model."""

    curve: object
    call_count: int
    model: CountedModel


@pytest.fixture(scope="module")
def tabulated():
    model = CountedModel()
    curve = stiffness_curve_of(model, (LOW, HIGH))
    return TabulatedModel(curve, len(model.calls), model)


def test_a_table_has_the_range_of_its_model(tabulated):
    assert (tabulated.curve.lower, tabulated.curve.upper) == (LOW, HIGH)


def test_a_table_asks_its_model_not_too_often(tabulated):
    assert tabulated.call_count < 600


def test_a_table_meets_its_model_within_the_stated_error(tabulated):
    factor = np.linspace(LOW, HIGH, 997)

    stiffness = tabulated.curve.stiffness(factor)

    exact = np.array([tabulated.model(value) for value in factor])
    assert np.abs(stiffness / exact - 1.0).max() < 3.0 * TABLE_TOLERANCE


def test_the_slope_of_a_table_is_that_by_differences(tabulated):
    factor = np.linspace(LOW, HIGH, 997)[1:-1]
    ahead = tabulated.curve.stiffness(factor + 1e-6)
    behind = tabulated.curve.stiffness(factor - 1e-6)

    assert tabulated.curve.slope(factor) == pytest.approx((ahead - behind) / 2e-6, rel=1e-4)


@pytest.mark.parametrize("end", [LOW, HIGH])
def test_a_table_continues_smoothly_beyond_its_ends(tabulated, end):
    below, at_end, above = tabulated.curve.stiffness([end - 1e-6, end, end + 1e-6])

    assert at_end - below == pytest.approx(above - at_end, rel=1e-3)


def test_the_factor_of_a_stiffness_is_the_inverse(tabulated):
    factor = np.linspace(0.3, 1.9, 33)

    inverse = tabulated.curve.young_modulus_factor(tabulated.curve.stiffness(factor))

    assert inverse == pytest.approx(factor, abs=1e-7)


def test_a_rough_curve_is_refused():
    def stiffness_with_steps(young_modulus_factor):
        steps = 70.0 * young_modulus_factor // 1.0
        return 600.0 + 100.0 * young_modulus_factor + 5.0 * steps

    with pytest.raises(PosteriorError, match="too rough"):
        stiffness_curve_of(stiffness_with_steps, (LOW, HIGH))


# ---------------------------------------------------------------- likelihoods

FACTORS = np.linspace(0.85, 1.2, 36)
STIFFNESS = PUBLISHED_LINE.stiffness(FACTORS)
NORMALISATION = {"displacement": 1.0, "load": STIFFNESS, "ratio": 575.2}
"""What a flat density of each measure means in terms of the true displacement."""


@pytest.mark.parametrize("measure", NORMALISATION)
def test_pair_likelihoods_equal_quadrature_over_the_true_displacement(measure):
    true_displacement = np.linspace(1e-5, 25e-3, 40_001)  # m
    weight = true_displacement if measure == "ratio" else 1.0
    by_quadrature = np.empty((LOAD_TEST.count, FACTORS.size))
    pairs = zip(LOAD_TEST.load, LOAD_TEST.displacement, strict=True)
    for pair, (load, displacement) in enumerate(pairs):
        deviation = LOAD_TEST.displacement_standard_deviation
        of_displacement = norm.pdf(displacement, true_displacement, deviation) * weight
        for index, stiffness in enumerate(STIFFNESS):
            true_load = stiffness * true_displacement
            of_load = norm.pdf(load, true_load, LOAD_TEST.load_standard_deviation)
            integral = np.trapezoid(of_load * of_displacement, true_displacement)
            by_quadrature[pair, index] = integral

    log_density = log_likelihood(PUBLISHED_LINE, LOAD_TEST, FACTORS, measure=measure)

    expected = np.log(by_quadrature * NORMALISATION[measure]).sum(axis=0)
    assert log_density == pytest.approx(expected, abs=1e-7)


def log_density_by_covariance(stiffness, run, zero_offset):
    """Return the log density of a run whose readings share an offset, by its full covariance."""
    is_of_run = LOAD_TEST.run == run
    count = int(is_of_run.sum())
    load_variance = LOAD_TEST.load_standard_deviation**2
    displacement_variance = (stiffness * LOAD_TEST.displacement_standard_deviation) ** 2
    independent = (load_variance + displacement_variance) * np.eye(count)
    covariance = independent + (stiffness * zero_offset) ** 2
    residual = LOAD_TEST.load[is_of_run] - stiffness * LOAD_TEST.displacement[is_of_run]
    return multivariate_normal.logpdf(residual, np.zeros(count), covariance)


@pytest.mark.parametrize("zero_offset", [0.0, 1e-4, 5e-3])
def test_a_shared_zero_offset_equals_the_full_covariance(zero_offset):
    log_density = log_likelihood(
        PUBLISHED_LINE, LOAD_TEST, FACTORS, zero_offset_standard_deviation=zero_offset
    )

    expected = np.zeros(FACTORS.size)
    for index, stiffness in enumerate(STIFFNESS):
        for run in LOAD_TEST.run_indices:
            expected[index] += log_density_by_covariance(stiffness, run, zero_offset)
    assert log_density == pytest.approx(expected, abs=1e-8)


# ---------------------------------------------------------------- the exact posterior


def test_the_posterior_of_the_published_pairs():
    posterior = exact_posterior(LOAD_TEST)

    assert posterior.mean == pytest.approx(1.00797, abs=1e-5)
    assert posterior.standard_deviation == pytest.approx(0.01031, abs=1e-5)


def test_measurements_far_from_the_prior_are_followed():
    stiff = replace(
        LOAD_TEST,
        displacement=LOAD_TEST.load / PUBLISHED_LINE.stiffness(1.6),
        displacement_standard_deviation=1e-6,
        load_standard_deviation=1e-4,
    )

    posterior = exact_posterior(stiff)

    assert posterior.mean == pytest.approx(1.6, abs=1e-3)
    assert 0.0 < posterior.standard_deviation < 1e-3


def test_a_posterior_beyond_the_end_of_its_curve_is_refused():
    narrow = stiffness_line(575.2, 101.8, "narrow model", 0.9, 0.99)

    with pytest.raises(
        OutsideValidityError, match=r"outside \[0.9, 0.99\], the range in which narrow model"
    ):
        exact_posterior(LOAD_TEST, curve=narrow)
