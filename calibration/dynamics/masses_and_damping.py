"""Calibration step 3, second half: point masses and Rayleigh damping for each sample of e.

Kapteyn et al. 2021, eqs. (19) and (20): the masses that bring the first two flapwise frequencies nearest to
the measured ones, under the weighed total; eq. (25): the Rayleigh coefficients that give the two modes their
measured damping ratios through eq. (18).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from calibration.errors import ExperimentDataError, MassConstraintError, OutsideValidityError
from fe.runtime.modal_system import rayleigh_coefficients
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import DigitalState, Geometry

from .trials import PUBLISHED_DAMPING_RATIOS, PUBLISHED_FREQUENCIES

TOTAL_MASS = 0.472
"""Weighed mass of two servos and the pitot tube [kg] (Kapteyn et al. 2021, eqs. (19) and (20))."""

FLAPWISE = ("first", "second")
"""The two flapwise bending modes."""

QUANTITIES = ("servo_mass", "pitot_mass", "damping_alpha", "damping_beta")
"""What step 3 calibrates, in the order of `DynamicCalibration.samples`."""

FrequencyModel = Callable[[float, float, float], tuple[float, float]]
"""(e, servo mass [kg], pitot mass [kg]) to the natural frequencies of the two flapwise modes [Hz]."""


class DynamicTargets(NamedTuple):
    """Measured natural frequencies [Hz] and damping ratios [1] of the first two flapwise bending modes."""

    frequency: tuple[float, float] = PUBLISHED_FREQUENCIES
    damping_ratio: tuple[float, float] = PUBLISHED_DAMPING_RATIOS


class MassRange(NamedTuple):
    """Least and greatest mass of a servo and of the pitot tube for which frequencies may be asked [kg]."""

    servo: tuple[float, float]
    pitot: tuple[float, float]


@dataclass(frozen=True, eq=False)
class DynamicCalibration:
    """Posterior of masses and damping as samples, one for each sample of e.

    Attributes
    ----------
    young_modulus_factor : (N,) array
        Samples of e [1].
    servo_mass, pitot_mass : (N,) array
        Mass of each servo and of the pitot tube [kg].
    frequency : (N, 2) array
        Natural frequencies of the model there [Hz].
    damping_alpha, damping_beta : (N,) array
        Rayleigh coefficients [1/s], [s].
    targets : DynamicTargets
        What was measured.
    source : str
        Whose model it is.
    """

    young_modulus_factor: NDArray[np.float64]
    servo_mass: NDArray[np.float64]
    pitot_mass: NDArray[np.float64]
    frequency: NDArray[np.float64]
    damping_alpha: NDArray[np.float64]
    damping_beta: NDArray[np.float64]
    targets: DynamicTargets
    source: str

    @property
    def samples(self) -> NDArray[np.float64]:
        """(N, 4) samples of `QUANTITIES`."""
        return np.column_stack([getattr(self, name) for name in QUANTITIES])

    def mean(self, name: str) -> float:
        """Return the mean over the samples of an attribute, in its unit."""
        return float(np.mean(getattr(self, name)))

    def standard_deviation(self, name: str) -> float:
        """Return the standard deviation over the samples of an attribute, in its unit."""
        values = getattr(self, name)
        return float(np.std(values, ddof=1)) if values.size > 1 else 0.0

    @property
    def relative_error(self) -> NDArray[np.float64]:
        """(N,) mean of the two relative errors of the frequencies: what eqs. (19) and (20) make least [1]."""
        target = np.array(self.targets.frequency)
        return np.asarray(np.mean(np.abs(self.frequency / target - 1.0), axis=1))

    def states(self, geometry: Geometry | None = None) -> tuple[DigitalState, ...]:
        """Return one digital state for each sample, healthy and of this planform."""
        return tuple(
            DigitalState(geometry or Geometry(), factor, servo, pitot, alpha, beta)
            for factor, (servo, pitot, alpha, beta) in zip(
                self.young_modulus_factor.tolist(), self.samples.tolist(), strict=True
            )
        )


def calibrate_dynamics(
    model: ReducedModel,
    young_modulus_factor: Sequence[float] | NDArray[np.float64],
    targets: DynamicTargets | None = None,
    *,
    total_mass: float = TOTAL_MASS,
    source: str = "reduced model",
) -> DynamicCalibration:
    """Calibrate masses and damping on a reduced model; its flapwise modes are followed by their shape.

    Raises
    ------
    MassConstraintError, ExperimentDataError
        See `fit_masses`.
    OutsideValidityError
        If a sample of e lies outside the range of the model.
    """
    lower, upper = model.validity["young_modulus_factor"]
    factors = np.asarray(young_modulus_factor, dtype=np.float64)
    outside = factors[~((factors >= lower) & (factors <= upper))]
    if outside.size:
        raise OutsideValidityError(
            f"a sample of e is {outside[0]:g}, but the model holds for {lower:g} to {upper:g}; build one "
            "with a wider range."
        )

    def frequencies(factor: float, servo: float, pitot: float) -> tuple[float, float]:
        modes = model.modes(young_modulus_factor=factor, servo_mass=servo, pitot_mass=pitot)
        first, second = modes.followed
        return float(modes.frequency[first]), float(modes.frequency[second])

    masses = MassRange(servo=model.validity["servo_mass"], pitot=model.validity["pitot_mass"])
    return fit_masses(frequencies, factors, masses, targets, total_mass=total_mass, source=source)


def fit_masses(
    frequencies: FrequencyModel,
    young_modulus_factor: NDArray[np.float64],
    masses: MassRange,
    targets: DynamicTargets | None = None,
    *,
    total_mass: float = TOTAL_MASS,
    source: str = "model",
) -> DynamicCalibration:
    """Find masses under the weighed total, then damping, for each sample of e.

    One mass is free: the pitot tube has what two servos leave of the total. The search, of Brent, ends at
    1 microgram; the authors', of Nelder and Mead, ends at 1 g.

    Parameters
    ----------
    frequencies : callable
        Of a model.
    young_modulus_factor : (N,) array
        Samples of e [1].
    masses : MassRange
        Where the model may be asked.
    targets : DynamicTargets, optional
        The published ones by default.
    total_mass : float
        2 m_servo + m_pitot [kg].
    source : str
        Whose model it is.

    Raises
    ------
    MassConstraintError
        If no masses within the range keep the total, or the best lie at the limit of the range.
    ExperimentDataError
        If there is no sample of e, or a target is not positive and finite, or the damping ratios need a
        negative Rayleigh coefficient.
    """
    targets = targets or DynamicTargets()
    _check_targets(targets)
    factors = np.asarray(young_modulus_factor, dtype=np.float64)
    if factors.ndim != 1 or factors.size == 0 or not np.all(np.isfinite(factors)):
        raise ExperimentDataError(f"{source}: at least one sample of e is needed, and each must be finite.")
    lower, upper = _servo_range(masses, total_mass)
    servo = np.empty(factors.size)
    frequency = np.empty((factors.size, 2))
    damping = np.empty((factors.size, 2))
    for place, factor in enumerate(factors.tolist()):

        def error(mass: float, factor: float = factor) -> float:
            first, second = frequencies(factor, mass, total_mass - 2.0 * mass)
            return 0.5 * (abs(first / targets.frequency[0] - 1.0) + abs(second / targets.frequency[1] - 1.0))

        found = minimize_scalar(error, bounds=(lower, upper), method="bounded", options={"xatol": 1e-9})
        servo[place] = found.x
        if min(servo[place] - lower, upper - servo[place]) < 1e-6:
            raise MassConstraintError(
                f"at e = {factor:g} the masses nearest to {targets.frequency[0]:.4g} and "
                f"{targets.frequency[1]:.4g} Hz lie at the limit of the model, {servo[place]:.4g} kg for a "
                f"servo under a total of {total_mass:g} kg; check the measured frequencies and the total."
            )
        pair = frequencies(factor, float(servo[place]), total_mass - 2.0 * float(servo[place]))
        frequency[place] = pair
        damping[place] = damping_coefficients(pair, targets.damping_ratio)
    return DynamicCalibration(
        young_modulus_factor=factors,
        servo_mass=servo,
        pitot_mass=total_mass - 2.0 * servo,
        frequency=frequency,
        damping_alpha=damping[:, 0],
        damping_beta=damping[:, 1],
        targets=targets,
        source=source,
    )


def damping_coefficients(
    frequency: tuple[float, float], damping_ratio: tuple[float, float]
) -> tuple[float, float]:
    """Return alpha [1/s] and beta [s] by eq. (25).

    Raises
    ------
    ExperimentDataError
        If a coefficient would be negative, so that some mode would gain energy.
    """
    alpha, beta = rayleigh_coefficients(frequency, damping_ratio)
    if alpha < 0.0 or beta < 0.0:
        raise ExperimentDataError(
            f"damping ratios {damping_ratio[0]:g} at {frequency[0]:.4g} Hz and {damping_ratio[1]:g} at "
            f"{frequency[1]:.4g} Hz need Rayleigh coefficients of {alpha:.3g} 1/s and {beta:.3g} s, but "
            "neither may be negative; check the ring-down records."
        )
    return alpha, beta


def _check_targets(targets: DynamicTargets) -> None:
    for name, unit, values in (
        ("frequency", " Hz", targets.frequency),
        ("damping ratio", "", targets.damping_ratio),
    ):
        for which, value in zip(FLAPWISE, values, strict=True):
            if not (math.isfinite(value) and value > 0.0):
                raise ExperimentDataError(
                    f"the measured {name} of the {which} flapwise mode is {value:g}{unit}, but a positive "
                    "finite number is needed."
                )
    if not max(targets.damping_ratio) < 1.0:
        raise ExperimentDataError(
            f"a measured damping ratio of {max(targets.damping_ratio):.4g} lets nothing swing; give "
            "fractions of critical damping, 0.05 for 5 %."
        )


def _servo_range(masses: MassRange, total_mass: float) -> tuple[float, float]:
    lower = max(masses.servo[0], 0.5 * (total_mass - masses.pitot[1]))
    upper = min(masses.servo[1], 0.5 * (total_mass - masses.pitot[0]))
    if not (math.isfinite(total_mass) and lower < upper):
        least = 2.0 * masses.servo[0] + masses.pitot[0]
        greatest = 2.0 * masses.servo[1] + masses.pitot[1]
        raise MassConstraintError(
            f"two servos and the pitot tube cannot weigh {total_mass:g} kg: the model takes totals between "
            f"{least:g} and {greatest:g} kg."
        )
    return lower, upper
