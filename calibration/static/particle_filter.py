"""The paper's particle filter for the Young's modulus factor: Kapteyn et al. 2021, calibration step 2."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.errors import DegenerateFilterError, PosteriorError

from .experiments import LoadDisplacementData
from .kernel_density import BinnedKernelDensity, reference_bandwidth_factor
from .posterior import GaussianPrior, ScalarPosterior, Seed, check_count, child_seed
from .stiffness_curve import PUBLISHED_LINE, StiffnessCurve

DEFAULT_PARTICLE_COUNT = 1_000_000
"""Particles, and samples of each measured pair, in the authors' script."""

_PURPOSE_PAIRS = 0
_PURPOSE_PARTICLES = 1
_FEWEST_PARTICLES = 100
_FEWEST_EFFECTIVE_PARTICLES = 10.0


@dataclass(frozen=True, eq=False)
class ParticlePosterior:
    """p(e | measured pairs) as weighted particles, summarised.

    Attributes
    ----------
    posterior : ScalarPosterior
        Kernel density of the weighted particles, for plots and samples; its `mean` and
        `standard_deviation` are those of the particles, without the kernel's width.
    effective_sample_size : (n_pairs,) array
        1 / sum of squared weights after each pair; the last is that of the posterior.
    particle_count : int
        Number of particles.
    bandwidth : (n_pairs,) array
        Kernel bandwidth of each pair's likelihood [1].
    likelihood_grid : (N,) array
        Values of e at which the likelihoods are kept.
    likelihood : (n_pairs, N) array
        Kernel density of e from each pair alone: the paper's likelihood curves in Fig. 5.
    stiffness_mean, stiffness_standard_deviation : float
        Weighted mean and standard deviation of the particles' tip stiffness k(e) [N/m].
    """

    posterior: ScalarPosterior
    effective_sample_size: NDArray[np.float64]
    particle_count: int
    bandwidth: NDArray[np.float64]
    likelihood_grid: NDArray[np.float64]
    likelihood: NDArray[np.float64]
    stiffness_mean: float
    stiffness_standard_deviation: float

    @property
    def mean(self) -> float:
        """Weighted mean of the particles."""
        return self.posterior.mean

    @property
    def standard_deviation(self) -> float:
        """Weighted standard deviation of the particles."""
        return self.posterior.standard_deviation


def pair_likelihoods(
    curve: StiffnessCurve,
    data: LoadDisplacementData,
    seed: Seed,
    sample_count: int,
    window: tuple[float, float] = (-math.inf, math.inf),
) -> list[BinnedKernelDensity]:
    """Return the paper's likelihood of each pair: a kernel density of e = k^-1(f / x).

    Loads and displacements are drawn from the Gaussians of their readings; each drawn pair is turned
    into a stiffness and, through the inverse of eq. (14), into a sample of e. The densities are kept for e
    in `window`.
    """
    generator = np.random.default_rng(child_seed(seed, _PURPOSE_PAIRS))
    densities = []
    for load, displacement in zip(data.load, data.displacement, strict=True):
        loads = load + data.load_standard_deviation * generator.standard_normal(sample_count)
        displacements = generator.standard_normal(sample_count)
        displacements *= data.displacement_standard_deviation
        displacements += displacement
        factors = curve.young_modulus_factor(loads / displacements)
        densities.append(BinnedKernelDensity.fit(factors, window=window))
    return densities


def particle_filter(
    data: LoadDisplacementData,
    *,
    seed: Seed,
    curve: StiffnessCurve = PUBLISHED_LINE,
    prior: GaussianPrior | None = None,
    particle_count: int = DEFAULT_PARTICLE_COUNT,
) -> ParticlePosterior:
    """Weigh particles drawn from the prior by the kernel likelihood of one pair after the other.

    Weights are multiplied in the log domain and normalised; the result repeats bit for bit with the
    seed. As the number of samples grows, the likelihoods tend to
    `errors_in_variables.log_ratio_density`, which is known in closed form.

    Parameters
    ----------
    data : LoadDisplacementData
        The measured pairs.
    seed : int or SeedSequence
        Seed of all draws.
    curve : StiffnessCurve
        k(e).
    prior : GaussianPrior, optional
        Prior of e; the paper's by default.
    particle_count : int
        Number of particles, and of samples for each pair.

    Raises
    ------
    DegenerateFilterError
        If fewer than ten effective particles remain: prior and measurements contradict each other, or
        there are too few particles.
    PosteriorError
        If fewer than a hundred particles are asked for, or more than `MOST_SAMPLES`.
    """
    prior = prior or GaussianPrior()
    if particle_count < _FEWEST_PARTICLES:
        raise PosteriorError(
            f"at least {_FEWEST_PARTICLES} particles are needed, but {particle_count} were given."
        )
    check_count(particle_count, PosteriorError)
    generator = np.random.default_rng(child_seed(seed, _PURPOSE_PARTICLES))
    particles = prior.mean + prior.standard_deviation * generator.standard_normal(particle_count)
    grid = prior.mean + prior.standard_deviation * np.linspace(-8.0, 8.0, 801)
    likelihoods = pair_likelihoods(curve, data, seed, particle_count, (float(grid[0]), float(grid[-1])))
    log_weight = np.zeros(particle_count)
    effective = np.zeros(data.count)
    weight = np.full(particle_count, 1.0 / particle_count)
    for pair, likelihood in enumerate(likelihoods):
        with np.errstate(divide="ignore"):  # a particle that no sample reaches has weight zero
            log_weight += np.log(likelihood(particles))
        largest = float(log_weight.max())
        if largest == -math.inf:
            raise DegenerateFilterError(
                f"no particle explains pair {pair + 1} ({data.load[pair]:g} N, "
                f"{data.displacement[pair] * 1e3:g} mm) of {data.source} and those before it; check "
                f"the prior N({prior.mean:g}, {prior.standard_deviation:.3g}^2), the units and the curve."
            )
        weight = np.exp(log_weight - largest)
        weight /= weight.sum()
        effective[pair] = 1.0 / float(np.sum(weight**2))
    if effective[-1] < _FEWEST_EFFECTIVE_PARTICLES:
        raise DegenerateFilterError(
            f"only {effective[-1]:.1f} of {particle_count} particles effectively remain after "
            f"{data.count} pairs; take more particles, or the exact posterior."
        )
    mean, standard_deviation = _moments(weight, particles)
    stiffness_mean, stiffness_standard_deviation = _moments(weight, curve.stiffness(particles))
    # The spread of the weighted particles, in the rule's place of the median deviation.
    bandwidth = standard_deviation * reference_bandwidth_factor(float(effective[-1]))
    alive = weight > 0.0
    density = BinnedKernelDensity.fit(particles[alive], weights=weight[alive], bandwidth=bandwidth)
    return ParticlePosterior(
        posterior=ScalarPosterior(
            density.grid[::4], density.density[::4], mean=mean, standard_deviation=standard_deviation
        ),
        effective_sample_size=effective,
        particle_count=particle_count,
        bandwidth=np.array([likelihood.bandwidth for likelihood in likelihoods]),
        likelihood_grid=grid,
        likelihood=np.array([likelihood(grid) for likelihood in likelihoods]),
        stiffness_mean=stiffness_mean,
        stiffness_standard_deviation=stiffness_standard_deviation,
    )


def _moments(weight: NDArray[np.float64], value: NDArray[np.float64]) -> tuple[float, float]:
    # Pairwise sums rather than dot products, whose last bits depend on the number of BLAS threads.
    mean = float(np.sum(weight * value))
    return mean, math.sqrt(float(np.sum(weight * (value - mean) ** 2)))
