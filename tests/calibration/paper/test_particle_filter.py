"""The paper's particle filter against its closed-form limit and the paper's figures."""

import dataclasses

import numpy as np
import pytest

from calibration.errors import PosteriorError
from calibration.paper.load_test import kernel_density, normal_reference_bandwidth, particle_filter
from calibration.static.errors_in_variables import exact_posterior, pair_log_likelihoods
from calibration.static.experiments import published_measurements
from calibration.static.posterior import GaussianPrior
from calibration.static.stiffness_curve import PUBLISHED_LINE, stiffness_curve_of

DATA = published_measurements()


@pytest.mark.parametrize("seed", [0, 1])
def test_table_1_of_the_paper(seed):
    posterior = particle_filter(DATA, seed=seed)
    assert posterior.mean == pytest.approx(1.0073, abs=0.002)
    assert posterior.standard_deviation == pytest.approx(0.0103, abs=0.001)
    # Far closer than the paper's digits require: the filter without its sampling noise is known.
    limit = exact_posterior(DATA, measure="ratio")
    assert posterior.mean == pytest.approx(limit.mean, abs=2e-4)
    assert posterior.standard_deviation == pytest.approx(limit.standard_deviation, abs=1e-4)
    assert posterior.particle_count == 1_000_000
    assert 3e5 < posterior.effective_sample_size[-1] < 8e5
    assert posterior.stiffness.mean == pytest.approx(575.2 * posterior.mean + 101.8)
    assert posterior.stiffness.standard_deviation == pytest.approx(575.2 * posterior.standard_deviation)


def test_kernel_likelihoods_tend_to_the_density_of_the_ratio():
    grid = np.linspace(0.93, 1.09, 33)
    exact = np.exp(pair_log_likelihoods(PUBLISHED_LINE, DATA, grid, "ratio"))
    found = particle_filter(DATA, seed=3, particle_count=300_000)
    for density, expected in zip(found.likelihood, exact, strict=True):
        assert (
            np.abs(np.interp(grid, found.likelihood_grid, density) - expected).max() < 0.03 * expected.max()
        )


def test_repeats_bit_for_bit_and_differs_between_seeds():
    first, again, other = (particle_filter(DATA, seed=seed, particle_count=20_000) for seed in (7, 7, 8))
    assert first.mean == again.mean
    assert np.array_equal(first.density, again.density)
    assert np.array_equal(first.likelihood, again.likelihood)
    assert first.mean != other.mean


def test_a_tabulated_curve_gives_what_its_line_gives():
    curve = stiffness_curve_of(lambda factor: float(PUBLISHED_LINE.stiffness(factor)), (0.85, 1.15))
    table = particle_filter(DATA, seed=1, curve=curve, particle_count=100_000)
    line = particle_filter(DATA, seed=1, particle_count=100_000)
    assert table.mean == pytest.approx(line.mean, abs=1e-9)
    assert table.standard_deviation == pytest.approx(line.standard_deviation, abs=1e-9)


def test_the_density_agrees_with_the_particles():
    filtered = particle_filter(DATA, seed=2, particle_count=200_000)
    density = filtered.density
    grid = filtered.grid
    mean = np.trapezoid(density * grid, grid)
    assert mean == pytest.approx(filtered.mean, abs=1e-5)
    deviation = np.sqrt(np.trapezoid(density * (grid - mean) ** 2, grid))
    assert deviation == pytest.approx(filtered.standard_deviation, rel=0.01)


def test_effective_particles_fall_with_the_pairs_on_the_whole():
    effective = particle_filter(DATA, seed=0, particle_count=50_000).effective_sample_size
    assert effective.shape == (8,)
    assert effective[-1] < effective[0] < 50_000


def test_measurements_that_no_particle_explains_are_refused():
    far = dataclasses.replace(DATA, displacement=DATA.displacement * 0.5)
    with pytest.raises(PosteriorError, match="no particle explains pair"):
        particle_filter(far, seed=0, particle_count=2000)


def test_too_few_effective_particles_are_refused():
    with pytest.raises(PosteriorError, match="effectively remain"):
        particle_filter(DATA, seed=0, prior=GaussianPrior(0.93, 0.015), particle_count=100)
    with pytest.raises(PosteriorError, match="at least 100"):
        particle_filter(DATA, seed=0, particle_count=0)


def test_uncertain_readings_whose_ratio_has_heavy_tails():
    vague = dataclasses.replace(DATA, displacement_standard_deviation=2e-3)
    posterior = particle_filter(vague, seed=0, particle_count=200_000)
    limit = exact_posterior(vague, measure="ratio")
    assert posterior.mean == pytest.approx(limit.mean, abs=1e-3)
    assert posterior.standard_deviation == pytest.approx(limit.standard_deviation, rel=0.02)


def direct(samples, weights, bandwidth, value):
    kernel = np.exp(-0.5 * ((value[:, None] - samples) / bandwidth) ** 2) / (bandwidth * np.sqrt(2.0 * np.pi))
    return kernel @ weights


@pytest.mark.parametrize("count", [50, 3000])
@pytest.mark.parametrize("kind", ["equal", "weighted"])
def test_a_kernel_density_of_counts_is_that_of_samples(count, kind):
    """Within its window, whatever lies beyond."""
    generator = np.random.default_rng(1)
    samples = np.concatenate([generator.normal(1.0, 0.03, count), generator.gamma(2.0, 0.05, count), [40.0]])
    weights = generator.random(samples.size) if kind == "weighted" else np.ones(samples.size)
    weights /= weights.sum()
    bandwidth = normal_reference_bandwidth(samples)
    grid, density = kernel_density(samples, bandwidth, (0.0, 1.2), weights if kind == "weighted" else None)
    value = np.linspace(0.0, 1.2, 1500)
    exact = direct(samples, weights, bandwidth, value)
    assert np.abs(np.interp(value, grid, density) - exact).max() < 1e-3 * exact.max()
    assert density.min() >= 0.0


def test_a_kernel_density_integrates_to_one_and_vanishes_at_the_ends_of_its_grid():
    samples = np.random.default_rng(3).standard_cauchy(200).clip(-20, 20)
    grid, density = kernel_density(samples, normal_reference_bandwidth(samples), (-20.0, 20.0))
    assert np.trapezoid(density, grid) == pytest.approx(1.0, abs=1e-9)
    assert density[[0, -1]] == pytest.approx(0.0, abs=1e-9)
    # what lies beyond the window has its share of the whole, and no density within
    _, far = kernel_density(samples, 0.5, (1e6, 1e6 + 1.0))
    assert not far.any()


def test_bandwidth_is_the_robust_normal_reference_rule():
    samples = np.array([1.0, 2.0, 3.0, 4.0, 100.0])  # median 3, median deviation 1
    assert normal_reference_bandwidth(samples) == pytest.approx(1.0 / 0.6745 * (4.0 / 15.0) ** 0.2)
    for without_spread in (np.ones(5), np.array([1.0, np.nan, 2.0])):
        with pytest.raises(PosteriorError, match="spread"):
            normal_reference_bandwidth(without_spread)
