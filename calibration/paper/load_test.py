"""Calibration step 2 alone, as in Fig. 5 of the paper: e and the tip stiffness, exactly and by particles."""

import math
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from calibration.errors import OutsideValidityError, PosteriorError, said
from calibration.static.errors_in_variables import FitQuality, Measure, assess_fit, exact_posterior
from calibration.static.experiments import LoadDisplacementData, published_measurements
from calibration.static.posterior import (
    PUBLISHED_LINE,
    GaussianPrior,
    ScalarPosterior,
    Seed,
    StiffnessCurve,
    child_seed,
)
from reporting.arrays import Float

DEFAULT_PARTICLE_COUNT = 1_000_000
"""Particles, and samples of each measured pair, in the authors' script."""

CELLS_PER_BANDWIDTH, KEPT = 128, 32
"""Cells of a kernel density within one bandwidth, so many that few samples are less than 0.1 % off; one of
so many is kept of a posterior."""

_KERNEL_REACH = 8.0  # bandwidths; the kernel beyond holds 1e-15
_MEDIAN_DEVIATION_OF_GAUSSIAN = 0.6745  # of a standard Gaussian, as rounded in the rule
_PURPOSE_PAIRS, _PURPOSE_PARTICLES = 0, 1
_FEWEST_EFFECTIVE_PARTICLES = 10.0


@dataclass(frozen=True, eq=False, kw_only=True)
class ParticlePosterior(ScalarPosterior):
    """p(e | measured pairs) as weighted particles, summarised.

    The density is a kernel density of the weighted particles, for plots and samples; `mean` and
    `standard_deviation` are those of the particles, without the kernel's width.

    Attributes
    ----------
    likelihood_grid : (N,) array
        Values of e at which the likelihoods are kept.
    likelihood : (n_pairs, N) array
        Kernel density of e from each pair alone: the paper's likelihood curves in Fig. 5.
    stiffness : ScalarPosterior
        The particles' tip stiffness k(e) [N/m], in the same way.
    """

    likelihood_grid: Float
    likelihood: Float
    stiffness: ScalarPosterior


def reference_bandwidth_factor(count: float) -> float:
    """Return (4 / (3 n))^(1/5), the bandwidth that is optimal for n standard Gaussian samples."""
    return math.exp(0.2 * math.log(4.0 / (3.0 * count)))


def normal_reference_bandwidth(samples: Float) -> float:
    """Return the bandwidth that is optimal for Gaussian data: sigma_robust * (4 / (3 n))^(1/5).

    sigma_robust is the median absolute deviation from the median over 0.6745. This is the default of
    MATLAB's `fitdist(samples, 'kernel')`, which the authors used (Bowman and Azzalini 1997).
    """
    sigma = float(np.median(np.abs(samples - np.median(samples)))) / _MEDIAN_DEVIATION_OF_GAUSSIAN
    return sigma * reference_bandwidth_factor(samples.size)


def kernel_density(
    samples: Float,
    bandwidth: float,
    window: tuple[float, float],
    weights: Float | None = None,
) -> tuple[Float, Float]:
    """Return grid (N,) and Gaussian kernel density (N,) of samples (n,) over a window."""
    reach = _KERNEL_REACH * bandwidth
    ends = window[0] - reach, window[1] + reach
    spacing = bandwidth / CELLS_PER_BANDWIDTH
    mass, edges = np.histogram(samples, math.ceil((ends[1] - ends[0]) / spacing), ends, weights=weights)
    whole = samples.size if weights is None else weights.sum()
    density = mass / (whole * (edges[1] - edges[0]))
    smooth = gaussian_filter1d(density, CELLS_PER_BANDWIDTH, mode="constant", truncate=_KERNEL_REACH)
    return 0.5 * (edges[1:] + edges[:-1]), smooth


def particle_filter(
    data: LoadDisplacementData,
    *,
    seed: Seed,
    curve: StiffnessCurve = PUBLISHED_LINE,
    prior: GaussianPrior | None = None,
    particle_count: int = DEFAULT_PARTICLE_COUNT,
) -> ParticlePosterior:
    """Weigh particles drawn from the prior by the kernel likelihood of one pair after the other.

    The likelihood of a pair is the paper's: loads and displacements are drawn from the Gaussians of their
    readings; each drawn pair is turned into a stiffness and, through the inverse of eq. (14), into a sample
    of e, whose kernel density it is. As the number of samples grows, it tends to the measure "ratio" of
    `errors_in_variables`, which is known in closed form. Weights are multiplied in the log domain and
    normalised; the result repeats bit for bit with the seed.

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
    PosteriorError
        If fewer than ten effective particles remain: prior and measurements contradict each other, or there
        are too few particles.
    """
    prior = prior or GaussianPrior()
    generator = np.random.default_rng(child_seed(seed, _PURPOSE_PARTICLES))
    of_pairs = np.random.default_rng(child_seed(seed, _PURPOSE_PAIRS))
    particles = prior.mean + prior.standard_deviation * generator.standard_normal(particle_count)
    kept_at = prior.mean + prior.standard_deviation * np.linspace(-8.0, 8.0, 801)
    window = float(kept_at[0]), float(kept_at[-1])
    log_weight, weight = np.zeros(particle_count), np.empty(0)
    likelihood = np.zeros((data.count, kept_at.size))
    for pair, (load, displacement) in enumerate(zip(data.load, data.displacement, strict=True)):
        loads = load + data.load_standard_deviation * of_pairs.standard_normal(particle_count)
        scatter = data.displacement_standard_deviation * of_pairs.standard_normal(particle_count)
        factors = curve.young_modulus_factor(loads / (displacement + scatter))
        known = kernel_density(factors, normal_reference_bandwidth(factors), window)
        likelihood[pair] = np.interp(kept_at, *known)
        with np.errstate(divide="ignore"):  # a particle that no sample reaches has weight zero
            log_weight += np.log(np.interp(particles, *known))
        largest = float(log_weight.max())
        if largest == -math.inf:
            given = pair + 1, load, displacement * 1e3
            raise PosteriorError(said("particles.unexplained", given=given, data=data, prior=prior))
        weight = np.exp(log_weight - largest)
        weight /= weight.sum()
    effective = 1.0 / float(np.sum(weight**2))
    if effective < _FEWEST_EFFECTIVE_PARTICLES:
        left = effective, particle_count
        raise PosteriorError(said("particles.effective", left=left, data=data))
    mean, standard_deviation = _moments(weight, particles)
    # The spread of the weighted particles, in the rule's place of the median deviation.
    bandwidth = standard_deviation * reference_bandwidth_factor(effective)
    grid, density = kernel_density(particles, bandwidth, window, weight)
    smooth = ScalarPosterior(grid[::KEPT], density[::KEPT])
    pushed = push_forward(smooth, curve)
    return ParticlePosterior(
        grid=smooth.grid,
        density=smooth.density,
        mean=mean,
        standard_deviation=standard_deviation,
        likelihood_grid=kept_at,
        likelihood=likelihood,
        stiffness=ScalarPosterior(pushed.grid, pushed.density, *_moments(weight, curve.stiffness(particles))),
    )


def _moments(weight: Float, value: Float) -> tuple[float, float]:
    # Pairwise sums rather than dot products, whose last bits depend on the number of BLAS threads.
    mean = float(np.sum(weight * value))
    return mean, math.sqrt(float(np.sum(weight * (value - mean) ** 2)))


@dataclass(frozen=True, eq=False)
class StaticCalibration:
    """Everything that calibration step 2 found.

    Attributes
    ----------
    data : LoadDisplacementData
        The measured pairs.
    curve : StiffnessCurve
        k(e).
    prior : GaussianPrior
        p(e).
    particle : ParticlePosterior
        p(e | pairs) by the paper's particle filter.
    exact : ScalarPosterior
        p(e | pairs) with errors in both variables, by quadrature.
    alternatives : dict of str to ScalarPosterior
        The exact posterior under other assumptions; those that leave the range of the curve are missing.
    """

    data: LoadDisplacementData
    curve: StiffnessCurve
    prior: GaussianPrior
    particle: ParticlePosterior
    exact: ScalarPosterior
    alternatives: dict[str, ScalarPosterior]

    @property
    def before(self) -> ScalarPosterior:
        """The prior on a grid."""
        grid = np.linspace(-8.0, 8.0, 2001) * self.prior.standard_deviation + self.prior.mean
        return ScalarPosterior(grid, np.exp(self.prior.log_density(grid)))

    @property
    def tip_stiffness_prior(self) -> ScalarPosterior:
        """p(k), the quantity of interest of Fig. 5 [N/m]."""
        return push_forward(self.before, self.curve)

    @property
    def tip_stiffness_exact(self) -> ScalarPosterior:
        """p(k | pairs) by quadrature [N/m]."""
        return push_forward(self.exact, self.curve)

    @property
    def quality(self) -> FitQuality:
        """Residuals at the exact posterior mean."""
        return assess_fit(self.data, float(self.curve.stiffness(self.exact.mean)))


def calibrate_static(
    curve: StiffnessCurve = PUBLISHED_LINE,
    data: LoadDisplacementData | None = None,
    seed: int = 0,
    *,
    particle_count: int = DEFAULT_PARTICLE_COUNT,
) -> StaticCalibration:
    """Find the posterior of e in both ways, and under other assumptions.

    Parameters
    ----------
    curve : StiffnessCurve
        k(e); the published line by default, `stiffness_curve_of(model)` for a structural model.
    data : LoadDisplacementData, optional
        The measured pairs; the published eight by default.
    seed : int
        Seed of the particle filter.
    particle_count : int
        Particles of the filter.

    Raises
    ------
    OutsideValidityError, PosteriorError
        See `exact_posterior` and `particle_filter`.
    """
    data = published_measurements() if data is None else data
    prior = GaussianPrior()
    exact = exact_posterior(data, curve=curve, prior=prior)
    particle = particle_filter(data, seed=seed, curve=curve, prior=prior, particle_count=particle_count)
    alternatives = {}
    assumptions: tuple[tuple[str, Measure, float], ...] = (
        ("flat in load", "load", 0.0),
        ("ratio", "ratio", 0.0),  # what the particle filter tends to
        ("zero offsets", "displacement", data.displacement_standard_deviation),  # that each run shares
    )
    for name, measure, offset in assumptions:
        with suppress(OutsideValidityError):
            alternatives[name] = exact_posterior(
                data, curve=curve, prior=prior, measure=measure, zero_offset_standard_deviation=offset
            )
    return StaticCalibration(data, curve, prior, particle, exact, alternatives)


def push_forward(posterior: ScalarPosterior, curve: StiffnessCurve) -> ScalarPosterior:
    """Return the density of k(e), p(e) / (dk/de), over the part of the grid on which k is positive."""
    stiffness = curve.stiffness(posterior.grid)
    positive = stiffness > 0.0
    density = posterior.density[positive] / curve.slope(posterior.grid[positive])
    return ScalarPosterior(stiffness[positive], density)
