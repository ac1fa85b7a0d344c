"""The paper's step 3: point masses and Rayleigh damping for each sample of e.

Kapteyn et al. 2021, eqs. (19) and (20): the masses that bring the first two flapwise frequencies
nearest to the measured ones, for the weighed total; eq. (25): the Rayleigh coefficients that give
the two modes their measured damping ratios by eq. (18).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from calibration.errors import ExperimentDataError
from calibration.joint.posterior import servo_range
from calibration.result.record import QuantityReading
from evidence.identification.published_results import PublishedResults
from fe.runtime.modal_system import rayleigh_coefficients
from reporting.arrays import Float

_AT_LIMIT = 1e-6  # kg between a mass and the end of its range

FrequencyModel = Callable[[Float], Float]
"""Returns the flapwise frequencies (N, 2) [Hz] for rows (N, 3) of e, servo and pitot mass [kg]."""


class PaperSamples(NamedTuple):
    """Samples of the state by the paper's procedure.

    Attributes
    ----------
    samples : (N, 5) array
        The samples of e [1], servo and pitot mass [kg], alpha [1/s] and beta [s].
    frequency : (N, 2) array
        The model's two flapwise frequencies [Hz].
    """

    samples: Float
    frequency: Float


def fit_masses(
    frequencies: FrequencyModel,
    young_modulus_factor: Float,
    validity: Mapping[str, tuple[float, float]],
    readings: Sequence[QuantityReading],
) -> PaperSamples:
    """Fit the masses and the damping coefficients to the readings, for each sample of e.

    The weighed total leaves one unknown mass: that of a servo; the pitot tube has the rest. It
    minimises the mean relative error of the two frequencies. The search (bounded Brent) ends at
    1 microgram; the authors' search, by Nelder and Mead, ends at 1 g.

    Parameters
    ----------
    frequencies : callable
        The flapwise frequencies of a model, such as `WingTable.frequency`.
    young_modulus_factor : (N,) array
        The samples of e [1].
    validity : mapping of str to (float, float)
        The ranges of the masses in the model [kg].
    readings : sequence of QuantityReading
        The weighed mass and both modes.

    Raises
    ------
    ExperimentDataError
        If no masses within the range have the total, the best lie at the limit of the range, or the
        damping ratios need a negative Rayleigh coefficient.
    OutsideValidityError
        If a sample of e lies outside the range of the model.
    """
    measured_values = {reading.name: reading.value for reading in readings}
    total_mass = measured_values["weighed_mass"]
    target = np.array([measured_values["frequency_1"], measured_values["frequency_2"]])
    ratios = measured_values["damping_ratio_1"], measured_values["damping_ratio_2"]
    limits = servo_range(validity, total_mass)
    samples = []
    fitted_frequencies = []
    for modulus_factor in young_modulus_factor.tolist():
        servo_mass = _nearest_servo_mass(frequencies, modulus_factor, total_mass, target, limits)
        pitot_mass = total_mass - 2.0 * servo_mass
        # the model's frequencies with these masses give alpha and beta
        fitted_pair = frequencies(np.array([[modulus_factor, servo_mass, pitot_mass]]))[0]
        frequency_1, frequency_2 = fitted_pair.tolist()
        alpha, beta = damping_coefficients((frequency_1, frequency_2), ratios)
        samples.append((modulus_factor, servo_mass, pitot_mass, alpha, beta))
        fitted_frequencies.append(fitted_pair)
    return PaperSamples(np.array(samples), np.array(fitted_frequencies))


def _nearest_servo_mass(
    frequencies: FrequencyModel,
    modulus_factor: float,
    total_mass: float,
    target: Float,
    limits: tuple[float, float],
) -> float:
    """Return the servo mass [kg] that brings the model's frequencies nearest to `target` (2,) [Hz].

    Raises `ExperimentDataError` if the mass lies at an end of its range `limits` [kg].
    """

    def mean_error(servo_mass: float) -> float:
        pitot_mass = total_mass - 2.0 * servo_mass
        ratio = frequencies(np.array([[modulus_factor, servo_mass, pitot_mass]]))[0] / target
        return 0.5 * float(np.abs(ratio - 1.0).sum())

    search = minimize_scalar(mean_error, bounds=limits, method="bounded", options={"xatol": 1e-9})
    servo_mass = float(search.x)
    lower, upper = limits
    if min(servo_mass - lower, upper - servo_mass) < _AT_LIMIT:
        raise ExperimentDataError(
            f"at e = {modulus_factor:g} the masses nearest to {target[0]:.4g} and "
            f"{target[1]:.4g} Hz lie at the limit of the model, {servo_mass:.4g} kg for a servo "
            f"under a total of {total_mass:g} kg; check the measured frequencies and the total."
        )
    return servo_mass


def damping_coefficients(
    frequency: tuple[float, float], damping_ratio: tuple[float, float]
) -> tuple[float, float]:
    """Return alpha [1/s] and beta [s] by eq. (25).

    Parameters
    ----------
    frequency, damping_ratio : (float, float)
        The frequencies [Hz] and damping ratios [1] of the two modes.

    Raises
    ------
    ExperimentDataError
        If a coefficient would be negative, so that some mode would gain energy.
    """
    alpha, beta = rayleigh_coefficients(frequency, damping_ratio)
    if alpha < 0.0 or beta < 0.0:
        raise ExperimentDataError(
            f"damping ratios {damping_ratio[0]:g} at {frequency[0]:.4g} Hz and "
            f"{damping_ratio[1]:g} at {frequency[1]:.4g} Hz need Rayleigh coefficients of "
            f"{alpha:.3g} 1/s and {beta:.3g} s, but neither may be negative; "
            "check the ring-down records."
        )
    return alpha, beta


def authors_samples(published: PublishedResults) -> PaperSamples:
    """Return the authors' samples, with alpha and beta by eq. (25)."""
    ratio_1, ratio_2 = published.damping_ratio.tolist()
    damping = []
    for frequency_1, frequency_2 in published.frequency.tolist():
        damping.append(damping_coefficients((frequency_1, frequency_2), (ratio_1, ratio_2)))
    samples = np.column_stack([published.states, damping])
    return PaperSamples(samples, published.frequency)
