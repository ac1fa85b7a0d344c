"""Transient response by modes: exact for a load that is held, with static correction.

Kapteyn et al. 2021, eq. (12), in modal coordinates: q'' + 2 zeta omega q' + omega^2 q = shape^T f, one
equation for each mode, because Rayleigh damping (17) leaves the modes uncoupled. Modes that are not kept
follow the load without delay (static correction).

NumPy and relative imports only: this file is copied into the FMU.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .damping import rayleigh_damping_ratio
from .errors import InvalidStateError
from .reduced import ReducedModel, dense_sum

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TransientState:
    """All that a structure remembers between two steps.

    Attributes
    ----------
    displacement : (M,) ndarray
        Modal coordinates q [m kg^1/2].
    velocity : (M,) ndarray
        Their rates [m kg^1/2 / s].
    load : (L,) ndarray
        Coefficients of the loads at this moment; of a wing the load factor [1] and the tip force [N].
    """

    displacement: FloatArray
    velocity: FloatArray
    load: FloatArray

    def to_list(self) -> list[float]:
        """Return the state as 2 M + L plain floats; `from_list` gives it back to the last bit."""
        return [*self.displacement.tolist(), *self.velocity.tolist(), *self.load.tolist()]

    @classmethod
    def from_list(cls, values: Sequence[float], mode_count: int) -> "TransientState":
        """Return the state of M modes that `to_list` wrote.

        Raises
        ------
        InvalidStateError
            If there are too few values, or one is not finite.
        """
        if len(values) < 2 * mode_count or not all(isfinite(value) for value in values):
            raise InvalidStateError(
                f"A transient state of {mode_count} modes needs at least {2 * mode_count} finite numbers, "
                f"but {len(values)} came, {sum(isfinite(value) for value in values)} of them finite."
            )
        array = np.array(values, dtype=np.float64)
        return cls(array[:mode_count], array[mode_count : 2 * mode_count], array[2 * mode_count :])


class Propagator(NamedTuple):
    """Exact solution of the free modal equations after one duration; every entry has the shape (M,).

    q(t) = `displacement_displacement` q(0) + `displacement_velocity` q'(0), and in the same way for q'(t).
    """

    displacement_displacement: FloatArray
    displacement_velocity: FloatArray
    velocity_displacement: FloatArray
    velocity_velocity: FloatArray


def free_propagator(angular_frequency: FloatArray, damping_ratio: FloatArray, duration: float) -> Propagator:
    """Return the exact free response of uncoupled modes, for any damping ratio.

    Written without differences of large numbers, so that zeta near 1 and zeta >> 1 are accurate.

    Parameters
    ----------
    angular_frequency : (M,) ndarray
        Undamped angular frequencies [rad/s].
    damping_ratio : (M,) ndarray
        Damping ratios, zero or positive [1].
    duration : float
        Time [s], zero or positive.
    """
    omega, zeta = angular_frequency, damping_ratio
    decay = zeta * omega
    root = omega * np.sqrt(
        np.abs((zeta - 1.0) * (zeta + 1.0))
    )  # damped frequency, or half the gap of the decays
    over = zeta > 1.0
    # oscillating and critical: exp(-decay t) (cos, sin / root)
    envelope = np.exp(-decay * duration)
    sine = envelope * duration * np.sinc(root * duration / np.pi)
    cosine = envelope * np.cos(root * duration)
    # not oscillating: two decays, slow * fast = omega^2
    fast = decay + root
    slow = omega**2 / fast
    slow_exponential = np.exp(-slow * duration)
    gap = np.where(over, 2.0 * root, 1.0)
    with np.errstate(under="ignore"):
        gap_part = np.where(gap * duration > 0.0, -np.expm1(-gap * duration) / gap, duration)
        hyperbolic_sine = slow_exponential * gap_part
        sinus = np.where(over, hyperbolic_sine, sine)
        displacement_displacement = np.where(over, slow_exponential + slow * sinus, cosine + decay * sine)
        velocity_velocity = np.where(over, np.exp(-fast * duration) - slow * sinus, cosine - decay * sine)
    return Propagator(displacement_displacement, sinus, -(omega**2) * sinus, velocity_velocity)


class ModalIntegrator:
    """Transient response of a structure at one state of health, parameters and masses.

    The integrator itself never changes; what changes is the `TransientState` that its methods take and give.
    When health changes, make another integrator and let it take over the state (`take_over`).

    Parameters
    ----------
    model : ReducedModel
        The structure.
    vector : (V,) ndarray
        Values of all that can be chosen; those of the controls do not matter.
    damping_alpha, damping_beta : float
        Rayleigh damping [1/s], [s].

    Attributes
    ----------
    modes : Modes
        The modes at this state.
    damping_ratio : (M,) ndarray
        Their damping ratios, eq. (18).

    Raises
    ------
    OutsideModelError
        If a value lies outside the model's validity box.
    InvalidStateError
        If a Rayleigh coefficient is negative or not finite.
    """

    def __init__(
        self, model: ReducedModel, vector: FloatArray, damping_alpha: float, damping_beta: float
    ) -> None:
        for name, value in (("damping_alpha", damping_alpha), ("damping_beta", damping_beta)):
            if not (isfinite(value) and value >= 0.0):
                raise InvalidStateError(f"{name} must be zero or a positive finite number, but is {value!r}.")
        self.model = model
        self.modes = model.modes(vector)
        self.damping_ratio = rayleigh_damping_ratio(damping_alpha, damping_beta, self.modes.frequency)
        self._omega = 2.0 * np.pi * self.modes.frequency
        static = [model.static_response(vector, load=load) for load in np.eye(len(model.load_factors))]
        self._static_coordinates = np.stack([found.coordinates for found in static], axis=1)
        # outputs per unit load: (O', L)
        self._static_output = np.stack(
            [np.append(found.strain, found.displacement) for found in static], axis=1
        )
        self._participation = self.modes.participation.T
        self._modal_static = self._participation / self._omega[:, np.newaxis] ** 2
        self._modal_output = self.modes.output[: model.static_count]
        self._acceleration_output = self.modes.output[model.static_count :]
        # what the modes that are not kept contribute, at once, per unit load
        self._correction = self._static_output - self._modal_output @ self._modal_static
        self._cached: tuple[float, Propagator] | None = None
        self._from_modal = self.modes.shape.T @ self.modes.mass
        masses = model.mass_coefficients(vector)
        self._from_static = self.modes.shape.T @ dense_sum(masses, model.cross_mass)

    def at_rest(self, load: npt.ArrayLike) -> TransientState:
        """Return the state of equilibrium under loads (L,)."""
        acting = np.array(load, dtype=np.float64)
        return TransientState(self._modal_static @ acting, np.zeros_like(self._omega), acting)

    def released(self, aside: float, load: npt.ArrayLike, point: int) -> TransientState:
        """Return the state just after a structure that was held aside is let go.

        Parameters
        ----------
        aside : float
            How far the holding force had moved the last static output, of a wing its tip, from its
            equilibrium under the other loads [m].
        load : (L,) array_like
            The loads that stay.
        point : int
            Number of the load that held it.
        """
        rest = self.at_rest(load)
        holding_force = aside / self._static_output[-1, point]
        return TransientState(
            rest.displacement + self._modal_static[:, point] * holding_force, rest.velocity, rest.load
        )

    def advance(self, state: TransientState, duration: float, load: npt.ArrayLike) -> TransientState:
        """Return the state after loads that are held; exact for the kept modes.

        If the loads differ from those of `state`, they jump at once, and the structure overshoots.

        Parameters
        ----------
        state : TransientState
            The state before.
        duration : float
            Time [s], positive.
        load : (L,) array_like
            Coefficients of the loads.

        Raises
        ------
        InvalidStateError
            If the duration is not positive or a load is not finite.
        """
        acting = np.array(load, dtype=np.float64)
        if not (isfinite(duration) and duration > 0.0 and np.isfinite(acting).all()):
            raise InvalidStateError(
                f"A transient step needs a positive duration and a finite load, but got {duration!r} s and "
                f"{load!r}."
            )
        if self._cached is None or self._cached[0] != duration:
            self._cached = (duration, free_propagator(self._omega, self.damping_ratio, duration))
        propagator = self._cached[1]
        static = self._modal_static @ acting
        aside, velocity = state.displacement - static, state.velocity
        return TransientState(
            propagator.displacement_displacement * aside
            + propagator.displacement_velocity * velocity
            + static,
            # plus zero: a structure at rest has the velocity 0, not -0
            propagator.velocity_displacement * aside + propagator.velocity_velocity * velocity + 0.0,
            acting,
        )

    def outputs(self, state: TransientState) -> FloatArray:
        """Return gauges, displacements and accelerations (O,) at a state.

        The modes that are not kept follow the loads at once; an acceleration is that of the kept modes, since
        the others follow loads that are held without inertia.
        """
        settled = self._modal_output @ state.displacement + self._correction @ state.load
        if not len(self._acceleration_output):
            return np.asarray(settled)
        omega = self._omega
        acceleration = (
            self._participation @ state.load
            - 2.0 * self.damping_ratio * omega * state.velocity
            - omega**2 * state.displacement
        )
        return np.concatenate((settled, self._acceleration_output @ acceleration))

    def point_displacement(self, state: TransientState, point: int) -> float:
        """Return the displacement along the load of a number at its point [m]."""
        participation = self._participation[:, point]  # also how far each mode moves the point
        correction = (
            self.model.static_load[point] @ self._static_coordinates - participation @ self._modal_static
        )
        return float(participation @ state.displacement + correction @ state.load)

    def energy(self, state: TransientState) -> float:
        """Return kinetic plus strain energy of the kept modes about the equilibrium under the load [J].

        It never grows while the load stays.
        """
        deviation = self._omega * (state.displacement - self._modal_static @ state.load)
        return float(0.5 * (state.velocity @ state.velocity + deviation @ deviation))

    def take_over(self, state: TransientState, before: "ModalIntegrator") -> TransientState:
        """Return a state of another integrator in the modes of this one, after a change of health or mass.

        Displacement and velocity of the structure stay what they were; they are projected on the new modes
        with the new mass matrix (exactly, in reduced coordinates). The part that the new modes cannot hold
        follows the load without delay, as always.

        `state` is in the modes of `before`, the integrator of the same model that it belongs to.
        """
        deviation = state.displacement - before._modal_static @ state.load
        static = before._static_coordinates @ state.load
        return TransientState(
            self._from_modal @ (before.modes.shape @ deviation) + self._from_static @ static,
            self._from_modal @ (before.modes.shape @ state.velocity),
            state.load,
        )
