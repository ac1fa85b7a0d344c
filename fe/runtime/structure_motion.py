"""Transient response of a structure by modes: exact for loads that are held, with static correction.

Kapteyn et al. 2021, eq. (12), in modal coordinates, as `transient` does for the wing. Modes that are not kept
follow the loads without delay.

NumPy and relative imports only: this file is copied into the FMU.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .damping import rayleigh_damping_ratio
from .structure_model import StructureModel
from .transient import free_propagator

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class StructureMotionState:
    """All that a structure remembers between two steps.

    Attributes
    ----------
    displacement, velocity : (M,) ndarray
        Modal coordinates [m kg^1/2] and their rates [m kg^1/2 / s].
    load : (L,) ndarray
        Coefficients of the loads at this moment.
    """

    displacement: FloatArray
    velocity: FloatArray
    load: FloatArray

    def to_list(self) -> list[float]:
        """Return the state as 2 M + L plain floats."""
        return [*self.displacement.tolist(), *self.velocity.tolist(), *self.load.tolist()]

    @classmethod
    def from_list(cls, values: Sequence[float], mode_count: int) -> "StructureMotionState":
        """Return the state that `to_list` wrote, equal to the last bit."""
        array = np.array(values, dtype=np.float64)
        return cls(array[:mode_count], array[mode_count : 2 * mode_count], array[2 * mode_count :])


class StructureMotion:
    """Motion of a structure at one state of health, parameters and masses.

    Parameters
    ----------
    model : StructureModel
        The structure.
    vector : (V,) ndarray
        Values of all that can be chosen; those of the controls do not matter.
    damping_alpha, damping_beta : float
        Rayleigh damping [1/s], [s].

    Raises
    ------
    OutsideModelError
        If a value lies outside the model's validity box.
    """

    def __init__(
        self, model: StructureModel, vector: FloatArray, damping_alpha: float, damping_beta: float
    ) -> None:
        self.model = model
        self.modes = model.modes(vector)
        self.damping_ratio = rayleigh_damping_ratio(damping_alpha, damping_beta, self.modes.frequency)
        self._omega = 2.0 * np.pi * self.modes.frequency
        loads = len(model.load_factors)
        static = [model.static_response(vector, load) for load in np.eye(loads)]
        self._static_coordinates = np.stack([found.coordinates for found in static], axis=1)
        count = model.static_count
        static_output = np.stack([np.append(found.strain, found.displacement) for found in static], axis=1)
        self._participation = self.modes.participation.T
        self._modal_static = self._participation / self._omega[:, np.newaxis] ** 2
        self._modal_output = self.modes.output[:count]
        self._acceleration_output = self.modes.output[count:]
        # what the modes that are not kept contribute, at once, per unit load
        self._correction = static_output - self._modal_output @ self._modal_static
        coefficients = model.mass_coefficients(vector)
        self._from_modal = self.modes.shape.T @ self.modes.mass
        self._from_static = self.modes.shape.T @ np.tensordot(coefficients, model.cross_mass, 1)

    def at_rest(self, load: FloatArray) -> StructureMotionState:
        """Return the state of equilibrium under loads (L,)."""
        return StructureMotionState(self._modal_static @ load, np.zeros_like(self._omega), load)

    def advance(self, state: StructureMotionState, duration: float, load: FloatArray) -> StructureMotionState:
        """Return the state after `duration` [s] under loads (L,) that are held; exact for the kept modes."""
        step = free_propagator(self._omega, self.damping_ratio, duration)
        static = self._modal_static @ load
        aside, velocity = state.displacement - static, state.velocity
        return StructureMotionState(
            step.displacement_displacement * aside + step.displacement_velocity * velocity + static,
            # plus zero: a structure at rest has the velocity 0, not -0
            step.velocity_displacement * aside + step.velocity_velocity * velocity + 0.0,
            load,
        )

    def outputs(self, state: StructureMotionState) -> FloatArray:
        """Return gauges, displacements and accelerations (O,) at a state.

        An acceleration is that of the kept modes: the others follow loads that are held, without inertia.
        """
        settled = self._modal_output @ state.displacement + self._correction @ state.load
        omega = self._omega
        acceleration = (
            self._participation @ state.load
            - 2.0 * self.damping_ratio * omega * state.velocity
            - omega**2 * state.displacement
        )
        return np.concatenate((settled, self._acceleration_output @ acceleration))

    def take_over(self, state: StructureMotionState, before: "StructureMotion") -> StructureMotionState:
        """Return a state of another motion in the modes of this one, after a change of health.

        Displacement and velocity of the structure stay; they are projected on the new modes with the mass.
        """
        deviation = state.displacement - before._modal_static @ state.load
        static = before._static_coordinates @ state.load
        return StructureMotionState(
            self._from_modal @ (before.modes.shape @ deviation) + self._from_static @ static,
            self._from_modal @ (before.modes.shape @ state.velocity),
            state.load,
        )
