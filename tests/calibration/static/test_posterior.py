"""Densities on a grid: moments, quantiles, samples."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from calibration.errors import PosteriorError
from calibration.static.posterior import GaussianPrior, ScalarPosterior, child_seed


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


@given(scale=st.floats(1e-290, 1e290))
def test_the_scale_of_the_density_does_not_matter(scale):
    _, posterior = gaussian(size=201)
    scaled = ScalarPosterior(posterior.grid, posterior.density / posterior.density.max() * scale)
    assert scaled.mean == pytest.approx(posterior.mean)
    assert np.trapezoid(scaled.density, scaled.grid) == pytest.approx(1.0)


def test_samples_repeat_bit_for_bit_and_follow_the_density():
    _, posterior = gaussian()
    samples = posterior.samples(5, 20_000)
    assert np.array_equal(samples, posterior.samples(5, 20_000))
    assert np.array_equal(samples, posterior.samples(np.random.SeedSequence(5), 20_000))
    assert not np.array_equal(samples, posterior.samples(6, 20_000))
    assert samples.mean() == pytest.approx(1.0, abs=6e-4)
    assert samples.std() == pytest.approx(0.02, rel=0.03)


def test_stratified_samples_have_one_in_each_stratum_in_random_order():
    _, posterior = gaussian()
    samples = posterior.samples(5, 100)
    strata = np.floor(posterior.cumulative(samples) * 100.0 + 1e-9).astype(int)
    assert sorted(strata) == list(range(100))
    assert list(strata) != list(range(100))
    assert abs(samples.mean() - 1.0) < 2e-4


def test_seeds_of_purposes_do_not_depend_on_how_often_they_are_asked_for():
    root = np.random.SeedSequence(9, spawn_key=(3,))
    states = [child_seed(root, purpose).generate_state(4).tolist() for purpose in (0, 1, 0)]
    assert states[0] == states[2] != states[1]


@pytest.mark.parametrize(
    ("grid", "density"),
    [
        ([0.0, 1.0], [1.0, 1.0]),
        ([0.0, 1.0, 1.0], [1.0, 1.0, 1.0]),
        ([0.0, 1.0, 2.0], [1.0, -1.0, 1.0]),
        ([0.0, 1.0, 2.0], [0.0, 0.0, 0.0]),
        ([0.0, 1.0, 2.0], [1.0, np.nan, 1.0]),
        ([0.0, 1.0, np.inf], [1.0, 1.0, 1.0]),
    ],
)
def test_what_is_no_density_is_refused(grid, density):
    with pytest.raises(PosteriorError):
        ScalarPosterior(np.array(grid), np.array(density))


def test_senseless_requests_are_refused():
    _, posterior = gaussian()
    with pytest.raises(PosteriorError, match="from 0 to 1"):
        posterior.quantile(1.1)
    with pytest.raises(PosteriorError, match="number of samples"):
        posterior.samples(0, 0)
    with pytest.raises(PosteriorError, match="at most 10,000,000 samples"):
        posterior.samples(0, 10**40)
    for mean, deviation in ((np.nan, 1.0), (1.0, 0.0), (1.0, np.inf)):
        with pytest.raises(PosteriorError, match="prior"):
            GaussianPrior(mean, deviation)
