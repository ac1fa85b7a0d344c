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
from .reduced import ReducedModel
from .responses import Modes, StaticResponse
from .state import Losses

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TransientState:
    """All that the wing remembers between two steps.

    Attributes
    ----------
    displacement : (M,) ndarray
        Modal coordinates q [m kg^1/2].
    velocity : (M,) ndarray
        Their rates [m kg^1/2 / s].
    load : (2,) ndarray
        Load factor [1] and tip force [N] at this moment.
    """

    displacement: FloatArray
    velocity: FloatArray
    load: FloatArray

    def to_list(self) -> list[float]:
        """Return the state as 2 M + 2 plain floats; `from_list` gives it back to the last bit."""
        return [*self.displacement.tolist(), *self.velocity.tolist(), *self.load.tolist()]

    @classmethod
    def from_list(cls, values: Sequence[float]) -> "TransientState":
        """Return the state that `to_list` wrote, 2 M + 2 numbers.

        Raises
        ------
        InvalidStateError
            If the count is odd or below four, or a value is not finite.
        """
        if len(values) < 4 or len(values) % 2 or not all(isfinite(value) for value in values):
            raise InvalidStateError(
                f"A transient state needs 2 M + 2 finite numbers (M modes), but {len(values)} numbers came, "
                f"{sum(isfinite(value) for value in values)} of them finite."
            )
        array = np.array(values, dtype=np.float64)
        count = (len(values) - 2) // 2
        return cls(array[:count], array[count:-2], array[-2:])


class TransientResponse(NamedTuple):
    """Outputs at one moment: `strain` (G,) dimensionless, `tip_displacement` [m], `tip_velocity` [m/s]."""

    strain: FloatArray
    tip_displacement: float
    tip_velocity: float


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
    """Transient response of the wing at one state of health and mass.

    The integrator itself never changes; what changes is the `TransientState` that its methods take and give.
    When health changes, make another integrator and let it take over the state (`take_over`).

    Parameters
    ----------
    model : ReducedModel
        The wing.
    young_modulus_factor, stiffness_loss, servo_mass, pitot_mass, damping_alpha, damping_beta
        As of `fe.runtime.state.DigitalState`.

    Attributes
    ----------
    modes : Modes
        The modes at this state.
    damping_ratio : (M,) ndarray
        Their damping ratios, eq. (18).

    Raises
    ------
    OutsideModelError
        If a parameter lies outside the model's validity box.
    InvalidStateError
        If a Rayleigh coefficient is negative or not finite.
    """

    def __init__(
        self,
        model: ReducedModel,
        *,
        young_modulus_factor: float,
        stiffness_loss: Losses,
        servo_mass: float,
        pitot_mass: float,
        damping_alpha: float,
        damping_beta: float,
    ) -> None:
        for name, value in (("damping_alpha", damping_alpha), ("damping_beta", damping_beta)):
            if not (isfinite(value) and value >= 0.0):
                raise InvalidStateError(f"{name} must be zero or a positive finite number, but is {value!r}.")
        self.model = model
        self.masses = (servo_mass, pitot_mass)
        self.modes: Modes = model.modes(young_modulus_factor, stiffness_loss, servo_mass, pitot_mass)
        self.damping_ratio = rayleigh_damping_ratio(damping_alpha, damping_beta, self.modes.frequency)
        self._omega = 2.0 * np.pi * self.modes.frequency
        lift = model.static_response(young_modulus_factor, stiffness_loss, 1.0, 0.0)
        tip = model.static_response(young_modulus_factor, stiffness_loss, 0.0, 1.0)
        self._static: tuple[StaticResponse, StaticResponse] = (lift, tip)
        self._static_coordinates = np.stack((lift.coordinates, tip.coordinates), axis=1)
        # outputs per unit load: (G + 1, 2)
        self._static_output = np.stack(
            (np.append(lift.strain, lift.tip_displacement), np.append(tip.strain, tip.tip_displacement)),
            axis=1,
        )
        self._participation = np.stack((self.modes.lift_participation, self.modes.tip_participation), axis=1)
        self._modal_static = self._participation / self._omega[:, np.newaxis] ** 2
        self._modal_output = np.vstack((self.modes.strain, self.modes.tip_displacement))
        # what the modes that are not kept contribute, at once, per unit load
        self._correction = self._static_output - self._modal_output @ self._modal_static
        participation = self.modes.tip_participation  # also how far each mode moves the load point
        self._load_point_correction = (
            model.static_load[1] @ self._static_coordinates - participation @ self._modal_static
        )
        self._cached: tuple[float, Propagator] | None = None

    def static_response(self, load_factor: float, tip_force: float = 0.0) -> TransientResponse:
        """Return the response, without velocity, after resting under a load factor [1] and tip force [N]."""
        output = self._static_output @ np.array((load_factor, tip_force))
        return TransientResponse(output[:-1], float(output[-1]), 0.0)

    def at_rest(self, load_factor: float, tip_force: float = 0.0) -> TransientState:
        """Return the state of equilibrium under a load factor [1] and tip force [N]."""
        load = np.array((load_factor, tip_force), dtype=np.float64)
        return TransientState(self._modal_static @ load, np.zeros_like(self._omega), load)

    def released(
        self, initial_tip_displacement: float, load_factor: float = 0.0, tip_force: float = 0.0
    ) -> TransientState:
        """Return the state just after a tip that was held aside by a tip force is let go.

        Parameters
        ----------
        initial_tip_displacement : float
            How far the holding force had moved the tip from its equilibrium under the other loads [m].
        load_factor, tip_force : float
            The loads that stay [1], [N].
        """
        rest = self.at_rest(load_factor, tip_force)
        holding_force = initial_tip_displacement / self._static[1].tip_displacement
        return TransientState(
            rest.displacement + self._modal_static[:, 1] * holding_force, rest.velocity, rest.load
        )

    def advance(self, state: TransientState, duration: float, load: npt.ArrayLike) -> TransientState:
        """Return the state after a load that is held; exact.

        If the load differs from that of `state`, it jumps at once, and the wing overshoots.

        Parameters
        ----------
        state : TransientState
            The state before.
        duration : float
            Time [s], positive.
        load : (2,) array_like
            Load factor [1] and tip force [N].

        Raises
        ------
        InvalidStateError
            If the duration is not positive or the load is not finite.
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
            # plus zero: a wing at rest has the velocity 0, not -0
            propagator.velocity_displacement * aside + propagator.velocity_velocity * velocity + 0.0,
            acting,
        )

    def response(self, state: TransientState) -> TransientResponse:
        """Return the outputs at a state; the modes that are not kept follow its load at once."""
        output = self._modal_output @ state.displacement + self._correction @ state.load
        return TransientResponse(
            output[:-1], float(output[-1]), float(self.modes.tip_displacement @ state.velocity)
        )

    def load_point_displacement(self, state: TransientState) -> float:
        """Return the upward displacement of the point where the tip force acts, 5 cm from the tip [m]."""
        kept = self.modes.tip_participation @ state.displacement
        return float(kept + self._load_point_correction @ state.load)

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
        from_modal, from_static = self.model.modal_projection(self.modes, *self.masses)
        deviation = state.displacement - before._modal_static @ state.load
        static = before._static_coordinates @ state.load
        return TransientState(
            from_modal @ (before.modes.shape @ deviation) + from_static @ static,
            from_modal @ (before.modes.shape @ state.velocity),
            state.load,
        )
