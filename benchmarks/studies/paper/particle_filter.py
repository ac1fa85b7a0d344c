"""The particle filter of the paper, for the factor e on Young's modulus and the tip stiffness."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calibration.errors import PosteriorError
from calibration.static.experiments import LoadDisplacementData
from calibration.static.posterior import (
    PUBLISHED_LINE,
    GaussianPrior,
    ScalarPosterior,
    Seed,
    StiffnessCurve,
    child_seed,
    push_forward,
)
from reporting.arrays import Float

DEFAULT_PARTICLE_COUNT = 1_000_000
"""Number of particles, and of samples of each measured pair, in the authors' script."""

CELLS_PER_BANDWIDTH = 128
"""Cells of a kernel density in one bandwidth; the error by binning is then below 0.1 %."""

CELLS_PER_STORED_VALUE = 32
"""Number of cells of a kernel density for one value of the stored posterior."""

_KERNEL_REACH = 8.0  # bandwidths; the probability of the kernel beyond is 1e-15
_MEDIAN_DEVIATION_OF_GAUSSIAN = 0.6745  # of a standard Gaussian, as rounded in the rule
_PURPOSE_PAIRS = 0  # of the seed
_PURPOSE_PARTICLES = 1  # of the seed
_FEWEST_EFFECTIVE_PARTICLES = 10.0
_LIKELIHOOD_REACH = 8.0  # of the likelihoods, in prior standard deviations


@dataclass(frozen=True, eq=False, kw_only=True)
class ParticlePosterior(ScalarPosterior):
    """The density p(e | measured pairs) of weighted particles.

    The density is a kernel density of the particles, for plots and samples; `mean` and
    `standard_deviation` are those of the particles, without the width of the kernel.

    Attributes
    ----------
    stiffness : ScalarPosterior
        The density of the particles' tip stiffness k(e) [N/m].
    """

    stiffness: ScalarPosterior


def reference_bandwidth_factor(count: float) -> float:
    """Return (4 / (3 n))^(1/5), the optimal bandwidth for n standard Gaussian samples."""
    return math.exp(0.2 * math.log(4.0 / (3.0 * count)))


def normal_reference_bandwidth(samples: Float) -> float:
    """Return the optimal bandwidth for Gaussian samples (n,): sigma_robust * (4 / (3 n))^(1/5).

    sigma_robust is the median absolute deviation from the median over 0.6745. This is the default
    of MATLAB's `fitdist(samples, 'kernel')`, which the authors used (Bowman and Azzalini 1997).
    """
    absolute_deviations = np.abs(samples - np.median(samples))
    sigma = float(np.median(absolute_deviations)) / _MEDIAN_DEVIATION_OF_GAUSSIAN
    return sigma * reference_bandwidth_factor(samples.size)


class KernelDensity(NamedTuple):
    """A density (N,) at evenly spaced points (N,)."""

    grid: Float
    density: Float

    def at(self, values: Float) -> Float:
        """Return the density at given values, interpolated linearly between the grid points."""
        return np.asarray(np.interp(values, self.grid, self.density))


def kernel_density(
    samples: Float,
    bandwidth: float,
    window: tuple[float, float],
    weights: Float | None = None,
) -> KernelDensity:
    """Return the Gaussian kernel density of samples (n,) on an even grid.

    The samples are counted in cells much narrower than the kernel, and the counts are smoothed,
    which is far faster than a sum over the samples.

    Parameters
    ----------
    bandwidth : float
        The standard deviation of the kernel.
    window : (float, float)
        The range in which the density is needed.
    weights : (n,) array, optional
        The weights of the samples; equal by default.
    """
    # slow to import, and an exact posterior needs no kernel density
    from scipy.ndimage import gaussian_filter1d

    lower = window[0] - _KERNEL_REACH * bandwidth
    upper = window[1] + _KERNEL_REACH * bandwidth
    spacing = bandwidth / CELLS_PER_BANDWIDTH
    cell_count = math.ceil((upper - lower) / spacing)
    cell_weight, edges = np.histogram(samples, cell_count, (lower, upper), weights=weights)
    total_weight = samples.size if weights is None else weights.sum()
    density = cell_weight / (total_weight * (edges[1] - edges[0]))
    smooth = gaussian_filter1d(
        density, CELLS_PER_BANDWIDTH, mode="constant", truncate=_KERNEL_REACH
    )
    return KernelDensity(grid=0.5 * (edges[1:] + edges[:-1]), density=smooth)


def particle_filter(
    data: LoadDisplacementData,
    *,
    seed: Seed,
    curve: StiffnessCurve = PUBLISHED_LINE,
    prior: GaussianPrior | None = None,
    particle_count: int = DEFAULT_PARTICLE_COUNT,
) -> ParticlePosterior:
    """Return the posterior of e by the paper's particle filter.

    Particles are drawn from the prior and weighted by the likelihood of one pair after the other.
    The likelihood of a pair is the paper's: loads and displacements are drawn from the Gaussians of
    their readings; each drawn pair gives a stiffness and, by the inverse of eq. (14), a sample of
    e; the likelihood is the kernel density of these samples. As their number grows, it tends to the
    measure "ratio" of `errors_in_variables`, which is known in closed form. Equal seeds give equal
    results, bit for bit.

    Parameters
    ----------
    prior : GaussianPrior, optional
        The prior of e; the paper's by default.
    particle_count : int
        The number of particles, and of samples for each pair.

    Raises
    ------
    PosteriorError
        If fewer than ten effective particles remain, because prior and measurements contradict each
        other or there are too few particles.
    """
    prior = prior or GaussianPrior()
    generator = np.random.default_rng(child_seed(seed, _PURPOSE_PARTICLES))
    pair_generator = np.random.default_rng(child_seed(seed, _PURPOSE_PAIRS))
    particles = prior.mean + prior.standard_deviation * generator.standard_normal(particle_count)
    reach = _LIKELIHOOD_REACH * prior.standard_deviation
    window = prior.mean - reach, prior.mean + reach

    pair_densities = []
    for pair in range(data.count):
        pair_densities.append(
            _pair_density(data, pair, curve, window, pair_generator, particle_count)
        )
    weight = _particle_weights(particles, pair_densities, data, prior)
    effective_size = 1.0 / float(np.sum(weight**2))
    if effective_size < _FEWEST_EFFECTIVE_PARTICLES:
        raise PosteriorError(
            f"only {effective_size:.1f} of {particle_count} particles effectively remain after "
            f"{data.count} pairs; take more particles, or the exact posterior."
        )

    # Densities of e and of the stiffness. The standard deviation of the weighted particles replaces
    # the robust one in the rule of the bandwidth.
    moments_of_e = _weighted_moments(weight, particles)
    stiffness = _weighted_moments(weight, curve.stiffness(particles))
    bandwidth = moments_of_e.standard_deviation * reference_bandwidth_factor(effective_size)
    grid, grid_density = kernel_density(particles, bandwidth, window, weight)
    coarse_density = ScalarPosterior(
        grid[::CELLS_PER_STORED_VALUE], grid_density[::CELLS_PER_STORED_VALUE]
    )
    stiffness_density = push_forward(coarse_density, curve)
    return ParticlePosterior(
        grid=coarse_density.grid,
        density=coarse_density.density,
        mean=moments_of_e.mean,
        standard_deviation=moments_of_e.standard_deviation,
        stiffness=ScalarPosterior(
            stiffness_density.grid,
            stiffness_density.density,
            mean=stiffness.mean,
            standard_deviation=stiffness.standard_deviation,
        ),
    )


def _particle_weights(
    particles: Float,
    pair_densities: Sequence[KernelDensity],
    data: LoadDisplacementData,
    prior: GaussianPrior,
) -> Float:
    """Return weights (N,) of the particles, whose sum is 1: the product of the pairs' likelihoods.

    Raises `PosteriorError` if no particle explains a pair and those before it.
    """
    # a product of likelihoods would underflow, so logarithms are added
    log_weight = np.zeros(particles.size)
    for pair, density in enumerate(pair_densities):
        with np.errstate(divide="ignore"):  # a particle that no sample reaches has weight zero
            log_weight += np.log(density.at(particles))
        if float(log_weight.max()) == -math.inf:
            raise PosteriorError(
                f"no particle explains pair {pair + 1} ({data.load[pair]:g} N, "
                f"{data.displacement[pair] * 1e3:g} mm) of {data.source} and those before it; "
                f"check the prior N({prior.mean:g}, {prior.standard_deviation:.3g}^2), the units "
                "and the curve."
            )
    weight = np.exp(log_weight - float(log_weight.max()))
    weight /= weight.sum()
    return np.asarray(weight)


def _pair_density(
    data: LoadDisplacementData,
    pair: int,
    curve: StiffnessCurve,
    window: tuple[float, float],
    generator: np.random.Generator,
    count: int,
) -> KernelDensity:
    """Return the paper's likelihood of e given one pair: a kernel density of samples.

    `window` is the range of e in which the density is needed.
    """
    load_error = data.load_standard_deviation * generator.standard_normal(count)
    displacement_error = data.displacement_standard_deviation * generator.standard_normal(count)
    load = data.load[pair] + load_error
    displacement = data.displacement[pair] + displacement_error
    factors = curve.young_modulus_factor(load / displacement)
    return kernel_density(factors, normal_reference_bandwidth(factors), window)


class Moments(NamedTuple):
    """Mean and standard deviation, in SI units."""

    mean: float
    standard_deviation: float


def _weighted_moments(weight: Float, value: Float) -> Moments:
    """Return the moments of values (N,) with weights (N,) that sum to 1."""
    # Pairwise sums rather than dot products, whose last bits depend on the number of BLAS threads.
    mean = float(np.sum(weight * value))
    variance = float(np.sum(weight * (value - mean) ** 2))
    return Moments(mean, math.sqrt(variance))
