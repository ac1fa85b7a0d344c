"""Calibration step 2: the Young's modulus factor from tip loads and displacements.

This is the room's front door; what it names is written in the modules beside it.
"""

import math

import numpy as np

from calibration.errors import OutsideValidityError
from reporting.provenance import collect_provenance

from .errors_in_variables import Measure, exact_posterior, pair_log_likelihoods, residual_variance
from .experiments import HALF_WIDTH_95, LoadDisplacementData, published_measurements
from .particle_filter import DEFAULT_PARTICLE_COUNT, particle_filter
from .posterior import GaussianPrior, ScalarPosterior
from .quality import assess_fit
from .record import Alternative, CalibrationReward, StaticCalibration
from .stiffness_curve import PUBLISHED_LINE, StiffnessCurve, stiffness_curve_of

__all__ = [
    "PUBLISHED_LINE",
    "GaussianPrior",
    "LoadDisplacementData",
    "ScalarPosterior",
    "StaticCalibration",
    "StiffnessCurve",
    "calibrate_static",
    "exact_posterior",
    "particle_filter",
    "published_measurements",
    "stiffness_curve_of",
]


def calibrate_static(
    curve: StiffnessCurve = PUBLISHED_LINE,
    data: LoadDisplacementData | None = None,
    seed: int = 0,
    *,
    prior: GaussianPrior | None = None,
    particle_count: int = DEFAULT_PARTICLE_COUNT,
) -> StaticCalibration:
    """Find the posterior of e in both ways, and what follows from it.

    Parameters
    ----------
    curve : StiffnessCurve
        k(e); the published line by default, `stiffness_curve_of(model)` for a structural model.
    data : LoadDisplacementData, optional
        The measured pairs; the published eight by default.
    seed : int
        Seed of the particle filter.
    prior : GaussianPrior, optional
        Prior of e; the paper's by default.
    particle_count : int
        Particles of the filter.

    Raises
    ------
    OutsideValidityError, DegenerateFilterError, PosteriorError
        See `exact_posterior` and `particle_filter`.
    """
    data = published_measurements() if data is None else data
    prior = prior or GaussianPrior()
    exact = exact_posterior(data, curve=curve, prior=prior)
    particle = particle_filter(data, seed=seed, curve=curve, prior=prior, particle_count=particle_count)
    grid = particle.likelihood_grid
    likelihood = np.exp(pair_log_likelihoods(curve, data, grid))
    prior_grid = np.linspace(-8.0, 8.0, 2001) * prior.standard_deviation + prior.mean
    stiffness = _push_forward(particle.posterior, curve)
    return StaticCalibration(
        data=data,
        curve=curve,
        prior=prior,
        particle=particle,
        exact=exact,
        tip_stiffness_prior=_push_forward(ScalarPosterior(prior_grid, prior.density(prior_grid)), curve),
        tip_stiffness_particle=ScalarPosterior(
            stiffness.grid,
            stiffness.density,
            unit="N/m",
            mean=particle.stiffness_mean,
            standard_deviation=particle.stiffness_standard_deviation,
        ),
        tip_stiffness_exact=_push_forward(exact, curve),
        pair_likelihood=likelihood / np.trapezoid(likelihood, grid, axis=1)[:, None],
        alternatives=_alternatives(curve, data, prior),
        quality=assess_fit(data, float(curve.stiffness(exact.mean))),
        reward=_reward(curve, data, prior, exact),
        seed=seed,
        provenance=collect_provenance(
            seed,
            input_hashes={"measurements": data.sha256},
            packages=("calibration",),
            distributions=("uav-twin", "numpy", "scipy"),
        ).as_dict(),
    )


def _push_forward(posterior: ScalarPosterior, curve: StiffnessCurve) -> ScalarPosterior:
    """Return the density of k(e), p(e) / (dk/de), over the part of the grid on which k is positive."""
    stiffness = curve.stiffness(posterior.grid)
    positive = stiffness > 0.0
    density = posterior.density[positive] / curve.slope(posterior.grid[positive])
    return ScalarPosterior(stiffness[positive], density, unit="N/m")


def _alternatives(
    curve: StiffnessCurve, data: LoadDisplacementData, prior: GaussianPrior
) -> tuple[Alternative, ...]:
    """Return the posterior under other assumptions, but for those that lead out of the curve's range."""
    half_width = HALF_WIDTH_95 * data.displacement_standard_deviation * 1e3
    assumptions: tuple[tuple[str, Measure, float], ...] = (
        ("prior flat in the true load", "load", 0.0),
        ("density of the ratio (the particle filter with unlimited samples)", "ratio", 0.0),
        (
            f"a zero offset of ±{half_width:.2g} mm shared by each run",
            "displacement",
            data.displacement_standard_deviation,
        ),
    )
    found = []
    for name, measure, offset in assumptions:
        try:
            posterior = exact_posterior(
                data, curve=curve, prior=prior, measure=measure, zero_offset_standard_deviation=offset
            )
        except OutsideValidityError:
            continue
        found.append(Alternative(name, posterior.mean, posterior.standard_deviation))
    return tuple(found)


def _reward(
    curve: StiffnessCurve, data: LoadDisplacementData, prior: GaussianPrior, exact: ScalarPosterior
) -> CalibrationReward:
    def error(factor: float) -> float:
        k = float(curve.stiffness(factor))
        tolerance = HALF_WIDTH_95 * math.sqrt(float(residual_variance(data, k))) / k
        return -float(np.mean(np.abs(data.displacement - data.load / k))) / tolerance

    positive = exact.density > 0.0
    log_ratio = np.zeros_like(exact.density)
    log_ratio[positive] = np.log(exact.density[positive]) - prior.log_density(exact.grid[positive])
    return CalibrationReward(
        prior_error=error(prior.mean),
        posterior_error=error(exact.mean),
        uncertainty_reduction=1.0 - exact.standard_deviation / prior.standard_deviation,
        information_gain=float(np.trapezoid(exact.density * log_ratio, exact.grid)),
    )
