"""The posterior of a wing's stiffness, masses and damping under all its readings together.

Unknown are e, the servo mass s, the pitot mass p and the Rayleigh coefficients (alpha, beta). Known are the
load test, the weighed total T of 2 s + p, and frequencies y and damping ratios z of two modes. With the
model's frequencies f_i(e, s, p) and relative model errors delta_i ~ N(0, tau_i^2), which leave in closed
form,

    T ~ N(2 s + p, s_T^2),   y_i ~ N(f_i, s_i^2 + tau_i^2 f_i^2),   z_i ~ N(zeta_i, r_i^2),

zeta_i by Kapteyn et al. 2021, eq. (18), at the model's own frequencies, as in eq. (25): the coefficients
belong to the model and give *its* modes the measured damping. Pairs of the load test have errors in both
readings (`calibration.static.errors_in_variables`).
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from calibration.errors import ExperimentDataError, OutsideValidityError
from calibration.result.record import ParameterPrior, Reading
from calibration.sentences import said
from calibration.static.errors_in_variables import exact_posterior, residual_variance
from calibration.static.experiments import LoadDisplacementData
from calibration.static.posterior import GaussianPrior

from .inference import FloatArray, infer
from .wing_table import MODEL_ERROR, QUANTITIES, WingTable, wing_priors

_LIMIT_MARGIN = 0.01  # of the range of e
_LARGEST_SHARE_AT_LIMIT = 0.05
_HARDLY = 2.33  # standard deviations that one in a hundred exceeds


def joint_posterior(
    wing: WingTable,
    static: LoadDisplacementData,
    readings: Sequence[Reading],
    *,
    priors: tuple[ParameterPrior, ...] | None = None,
    model_error: tuple[float, float] = MODEL_ERROR,
    seed: int = 0,
    count: int = 1000,
) -> FloatArray:
    """Return samples (count, 5) of e, masses and Rayleigh coefficients, given all measurements at once.

    Parameters
    ----------
    wing : WingTable
        The wing, by `tabulate_wing`.
    static : LoadDisplacementData
        The load test.
    readings : sequence of Reading
        The weighed mass and both modes are needed; what does not follow from the parameters is left aside.
    priors : tuple of ParameterPrior, optional
        `wing_priors` of the model by default.
    model_error : (float, float)
        Relative standard deviation of the model's two frequencies about the wing's. Zero trusts them.
    seed : int
        The same seed gives the same samples.
    count : int
        Number of samples.

    Raises
    ------
    ExperimentDataError
        If no masses within the model's range keep the weighed total, or the damping ratios need negative
        coefficients.
    OutsideValidityError
        If the load test alone puts e outside the model, or all measurements together press it against the
        end of the model's range.
    PosteriorError
        See `infer`.
    """
    priors = wing_priors(wing.validity) if priors is None else priors
    errors = {"frequency_1": model_error[0], "frequency_2": model_error[1]}
    columns = {figure.name: at for at, figure in enumerate(QUANTITIES[1:], start=1)}
    kept = {item.name: item for item in readings if item.name in columns}
    _refuse_negative(kept)
    servo_range(wing.validity, kept["weighed_mass"].value)
    exact_posterior(static, curve=wing.stiffness, prior=GaussianPrior(priors[0].mean, priors[0].deviation))
    read, spread = np.array([(item.value, item.deviation) for item in kept.values()]).T
    relative = np.array([errors.get(name, 0.0) for name in kept])
    places = [columns[name] for name in kept]

    def compare(states: FloatArray) -> tuple[FloatArray, FloatArray]:
        outputs = wing.outputs(states)
        stiffness, shown = outputs[:, :1], outputs[:, places]
        pairs = static.load - stiffness * static.displacement
        scatter = np.broadcast_to(np.sqrt(residual_variance(static, stiffness)), pairs.shape)
        return np.hstack([pairs, read - shown]), np.hstack([scatter, np.hypot(spread, relative * shown)])

    samples = infer(priors, compare, seed=seed, count=count)
    limits = priors[0].low, priors[0].high
    for limit in limits:
        share = float(np.mean(np.abs(samples[:, 0] - limit) < _LIMIT_MARGIN * (limits[1] - limits[0])))
        if share > _LARGEST_SHARE_AT_LIMIT:
            raise OutsideValidityError(said("joint.limit", share=share, limit=limit))
    return samples


def _refuse_negative(readings: Mapping[str, Reading]) -> None:
    """Refuse damping ratios that hardly allow two coefficients of which neither is negative."""
    omega = 2.0 * math.pi * np.array([readings[f"frequency_{mode}"].value for mode in (1, 2)])
    inverse = np.linalg.inv(0.5 * np.column_stack([1.0 / omega, omega]))
    ratios = [readings[f"damping_ratio_{mode}"] for mode in (1, 2)]
    coefficients = inverse @ [item.value for item in ratios]
    spread = np.sqrt(inverse**2 @ [item.deviation**2 for item in ratios])
    if np.any(coefficients + _HARDLY * spread < 0.0):
        raise ExperimentDataError(said("joint.negative", ratios=ratios))


def servo_range(validity: Mapping[str, tuple[float, float]], total_mass: float) -> tuple[float, float]:
    """Return least and greatest mass of a servo with which a model can keep the weighed total [kg].

    Raises
    ------
    ExperimentDataError
        If there is none.
    """
    servo, pitot = validity["servo_mass"], validity["pitot_mass"]
    lower = max(servo[0], 0.5 * (total_mass - pitot[1]))
    upper = min(servo[1], 0.5 * (total_mass - pitot[0]))
    if not (math.isfinite(total_mass) and lower < upper):
        least, greatest = 2.0 * servo[0] + pitot[0], 2.0 * servo[1] + pitot[1]
        raise ExperimentDataError(said("joint.total", total=total_mass, ends=(least, greatest)))
    return lower, upper
