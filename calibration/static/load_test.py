"""Calibration step 2: the factor e on Young's modulus and the tip stiffness by a load test."""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from calibration.errors import OutsideValidityError
from calibration.static.errors_in_variables import (
    FitQuality,
    Measure,
    assess_fit,
    exact_posterior,
    pair_log_likelihoods,
)
from calibration.static.experiments import LoadDisplacementData, published_measurements
from calibration.static.posterior import (
    PUBLISHED_LINE,
    GaussianPrior,
    ScalarPosterior,
    StiffnessCurve,
    push_forward,
)


@dataclass(frozen=True, eq=False)
class StaticCalibration:
    """All results of calibration step 2.

    Attributes
    ----------
    prior : GaussianPrior
        The prior p(e).
    exact : ScalarPosterior
        The posterior p(e | pairs) with errors in both variables, by quadrature.
    alternatives : dict of str to ScalarPosterior
        The exact posterior under other assumptions, unless it leaves the range of the curve.
    """

    data: LoadDisplacementData
    curve: StiffnessCurve
    prior: GaussianPrior
    exact: ScalarPosterior
    alternatives: dict[str, ScalarPosterior]

    @property
    def before(self) -> ScalarPosterior:
        """The prior of e as a density on a grid."""
        grid = np.linspace(-8.0, 8.0, 2001) * self.prior.standard_deviation + self.prior.mean
        return ScalarPosterior(grid, np.exp(self.prior.log_density(grid)))

    @property
    def by_pair(self) -> tuple[ScalarPosterior, ...]:
        """p(e | one pair) for each pair, with a flat prior of e over the range of `before`."""
        grid = self.before.grid
        likelihoods = np.exp(pair_log_likelihoods(self.curve, self.data, grid))
        return tuple(ScalarPosterior(grid, likelihood) for likelihood in likelihoods)

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
) -> StaticCalibration:
    """Return the posterior of e given a load test, and that under other assumptions.

    Parameters
    ----------
    curve : StiffnessCurve
        The stiffness k(e): the published line by default, `stiffness_curve_of` of a structural
        model.
    data : LoadDisplacementData, optional
        The measured pairs; the eight published ones by default.

    Raises
    ------
    OutsideValidityError
        If the posterior reaches beyond the range of the curve, see `exact_posterior`.
    """
    if data is None:
        data = published_measurements()
    prior = GaussianPrior()
    exact = exact_posterior(data, curve=curve, prior=prior)
    alternatives = {}
    # Name, measure, and standard deviation of the zero offset that each loading run shares
    assumptions: tuple[tuple[str, Measure, float], ...] = (
        ("flat in load", "load", 0.0),
        ("ratio", "ratio", 0.0),
        ("zero offsets", "displacement", data.displacement_standard_deviation),
    )
    for name, measure, offset in assumptions:
        with suppress(OutsideValidityError):
            alternatives[name] = exact_posterior(
                data,
                curve=curve,
                prior=prior,
                measure=measure,
                zero_offset_standard_deviation=offset,
            )
    return StaticCalibration(
        data=data,
        curve=curve,
        prior=prior,
        exact=exact,
        alternatives=alternatives,
    )
