"""Binned kernel densities against direct evaluation."""

import numpy as np
import pytest

from calibration.errors import PosteriorError
from calibration.static.kernel_density import BinnedKernelDensity, normal_reference_bandwidth


def direct(samples, weights, bandwidth, value):
    kernel = np.exp(-0.5 * ((value[:, None] - samples) / bandwidth) ** 2) / (bandwidth * np.sqrt(2.0 * np.pi))
    return kernel @ weights


@pytest.mark.parametrize("count", [50, 3000])
@pytest.mark.parametrize("kind", ["equal", "weighted"])
def test_binned_equals_direct_evaluation(count, kind):
    generator = np.random.default_rng(1)
    samples = np.concatenate([generator.normal(1.0, 0.03, count), generator.gamma(2.0, 0.05, count)])
    weights = generator.random(samples.size) if kind == "weighted" else np.ones(samples.size)
    weights /= weights.sum()
    binned = BinnedKernelDensity.fit(samples, weights=weights if kind == "weighted" else None)
    value = np.linspace(samples.min() - 0.05, samples.max() + 0.05, 1500)
    exact = direct(samples, weights, binned.bandwidth, value)
    assert np.abs(binned(value) - exact).max() < 1e-3 * exact.max()


def test_finer_than_the_sampling_noise_at_a_million_samples():
    samples = np.random.default_rng(2).normal(0.0, 1.0, 1_000_000)
    binned = BinnedKernelDensity.fit(samples)
    value = np.linspace(-5.0, 5.0, 41)
    some = np.array([-5.0, -3.0, -1.0, 1.0, 3.0, 5.0])
    exact = direct(samples[:, None].T, np.full(samples.size, 1e-6), binned.bandwidth, some)
    assert binned(some[1:-1]) == pytest.approx(exact[1:-1], rel=1e-3)
    assert binned(some) == pytest.approx(exact, rel=1e-2)  # the ends rest on a few samples each
    variance = 1.0 + binned.bandwidth**2
    truth = np.exp(-0.5 * value**2 / variance) / np.sqrt(2.0 * np.pi * variance)
    assert np.abs(binned(value) - truth).max() < 0.01 * truth.max()


def test_the_tail_of_one_sample_is_the_kernel():
    samples = np.array([0.0, 1.0, 2.0, 10.0])
    binned = BinnedKernelDensity.fit(samples, bandwidth=0.5)
    value = 10.0 + np.linspace(0.0, 3.5, 8)
    kernel = 0.25 * np.exp(-0.5 * ((value - 10.0) / 0.5) ** 2) / (0.5 * np.sqrt(2.0 * np.pi))
    assert binned(value[:5]) == pytest.approx(kernel[:5], rel=0.01)
    assert binned(value[5:]) == pytest.approx(kernel[5:], rel=0.15)


def test_integrates_to_one_is_never_negative_and_vanishes_outside():
    binned = BinnedKernelDensity.fit(np.random.default_rng(3).standard_cauchy(200).clip(-20, 20))
    assert binned.density.min() >= 0.0
    assert np.trapezoid(binned.density, binned.grid) == pytest.approx(1.0, abs=1e-9)
    assert binned([binned.grid[0] - 1.0, binned.grid[-1] + 1.0, np.inf]) == pytest.approx(0.0)


def test_bandwidth_is_the_robust_normal_reference_rule():
    samples = np.array([1.0, 2.0, 3.0, 4.0, 100.0])  # median 3, median deviation 1
    assert normal_reference_bandwidth(samples) == pytest.approx(1.0 / 0.6745 * (4.0 / 15.0) ** 0.2)


@pytest.mark.parametrize("samples", [np.ones(5), np.array([1.0, np.nan, 2.0])])
def test_samples_without_spread_are_refused(samples):
    with pytest.raises(PosteriorError, match="spread"):
        BinnedKernelDensity.fit(samples)


def test_samples_too_far_apart_need_a_window():
    samples = np.array([0.0, 1e-3, 2e-3, 3e-3, 1e9])
    with pytest.raises(PosteriorError, match="narrower window"):
        BinnedKernelDensity.fit(samples)
    within = BinnedKernelDensity.fit(samples, window=(-0.01, 0.01))
    value = np.linspace(-0.005, 0.008, 100)
    exact = direct(samples, np.full(5, 0.2), within.bandwidth, value)
    assert np.abs(within(value) - exact).max() < 1e-3 * exact.max()


def test_a_window_changes_nothing_within_it():
    samples = np.random.default_rng(5).standard_t(2, 2000)
    whole, part = BinnedKernelDensity.fit(samples), BinnedKernelDensity.fit(samples, window=(-1.0, 2.0))
    value = np.linspace(-1.0, 2.0, 301)
    assert np.abs(whole(value) - part(value)).max() < 1e-3 * whole.density.max()
    assert part.density.size < whole.density.size
    assert BinnedKernelDensity.fit(samples, window=(1e6, 2e6))([0.0, 1.5e6]).tolist() == [0.0, 0.0]
