"""Calibration step 2 alone, as in Fig. 5 of the paper: e and the tip stiffness, exactly and by particles."""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from calibration.errors import OutsideValidityError
from calibration.paper.particle_filter import DEFAULT_PARTICLE_COUNT, ParticlePosterior, particle_filter
from calibration.static.errors_in_variables import Measure, exact_posterior
from calibration.static.experiments import LoadDisplacementData, published_measurements
from calibration.static.posterior import GaussianPrior, ScalarPosterior
from calibration.static.quality import FitQuality, assess_fit
from calibration.static.stiffness_curve import PUBLISHED_LINE, StiffnessCurve


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
        return ScalarPosterior(grid, self.prior.density(grid))

    @property
    def tip_stiffness_prior(self) -> ScalarPosterior:
        """p(k), the quantity of interest of Fig. 5 [N/m]."""
        return push_forward(self.before, self.curve)

    @property
    def tip_stiffness_exact(self) -> ScalarPosterior:
        """p(k | pairs) by quadrature [N/m]."""
        return push_forward(self.exact, self.curve)

    @property
    def tip_stiffness_particle(self) -> ScalarPosterior:
        """p(k | pairs) by particles, whose mean and deviation it has [N/m]."""
        found = push_forward(self.particle.posterior, self.curve)
        moments = self.particle.stiffness_mean, self.particle.stiffness_standard_deviation
        return ScalarPosterior(found.grid, found.density, *moments)

    @property
    def quality(self) -> FitQuality:
        """Residuals at the exact posterior mean."""
        return assess_fit(self.data, float(self.curve.stiffness(self.exact.mean)))


def calibrate_static(
    curve: StiffnessCurve = PUBLISHED_LINE,
    data: LoadDisplacementData | None = None,
    seed: int = 0,
    *,
    prior: GaussianPrior | None = None,
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
