"""The behaviour of a structure's FMU: static equilibrium, or its modes integrated in time.

Missing effects may be switched on and changed between steps: a patch of the structure, and sensors
that read its outputs. This file is copied into the FMU, where `fe.runtime` is the folder `fe`
beside it; `structure_behaviour.c` does the same for a structure without effects.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import FiniteElementError
from fe.runtime.modal_system import rayleigh_damping_ratio
from fe.runtime.reduced import ReducedModel
from fe.runtime.reduced_results import ReducedResponse
from fe.runtime.transient import ModalIntegrator, TransientState

from .contents import UnacceptableValuesError
from .table import MODE_COUNT, StructureRoles
from .variables import TRANSIENT, FmuVariable

if TYPE_CHECKING:
    from .effects import ActiveEffects, SwitchableEffects


BOUND, POINT_OR_BOUND, MODES = range(3)
"""Groups of outputs that are computed when they are read.

They are the bound of the strains, the load point or else the bound of the displacements, and the
modes.
"""
_NONE_LENGTH = -1.0
"""Length that marks a part of a saved state as None."""


class StructureBehaviour:
    """The behaviour of a structure: each call completes, or raises and changes nothing.

    The outputs are gauges, displacements and accelerations. Two models can give them: the reduced
    model, and for wings with missing effects the patched wing (`SwitchableEffects.wing`). The
    reduced model is used for static responses as long as no effect changes structure or loads; also
    for transient ones if there is no patched wing.

    Parameters
    ----------
    table : sequence of FmuVariable
        The variables of the FMU, the inputs first.
    effects : SwitchableEffects, optional
        Missing effects of a wing.
    """

    def __init__(
        self,
        model: ReducedModel,
        table: Sequence[FmuVariable],
        roles: StructureRoles,
        effects: SwitchableEffects | None = None,
    ) -> None:
        self._model = model
        self._roles = roles
        self._effects = effects
        self._inputs = [row.name for row in table if row.causality == "input"]
        self._accelerations_at_rest = [0.0] * len(model.accelerations)
        # the values of the controls come last in the model, and do not change its modes
        self._structural_count = len(model.input_names) - len(model.controls)
        # set before the initialisation and between steps
        self._parameters: Mapping[str, float] = {}
        self._is_transient = False
        self._tuned: Mapping[str, float] = {}
        self._tuned_start_time = 0.0
        # the present state; if there is no integrator, the reduced model is at rest
        self._begin_time = 0.0
        self._active: ActiveEffects | None = None
        self._vector: FloatArray | None = None
        self._integrator: ModalIntegrator | None = None
        self._state: TransientState | None = None
        self._static: ReducedResponse | None = None
        self._filters: list[float] | None = None
        self._readings: list[float] = []

    def tune(self, values: Mapping[str, float], start_time: float) -> None:
        """Set the variables of the effects by name, for the next start or step.

        `start_time` is the start of the simulation [s].
        """
        self._tuned = values
        self._tuned_start_time = start_time

    def start(
        self, parameters: Mapping[str, float], time: float, inputs: Sequence[float]
    ) -> Sequence[float]:
        """Return the outputs at equilibrium under the inputs, or just after a release.

        Parameters
        ----------
        time : float
            Start time [s].
        inputs : sequence of float
            Inputs in the order of the table.

        Raises
        ------
        UnacceptableValuesError
            If the structure cannot have the effects that are on.
        """
        return self._completely(time, 0.0, inputs, parameters)

    def advance(self, time: float, duration: float, inputs: Sequence[float]) -> Sequence[float]:
        """Return the outputs after a step with constant inputs and effects.

        Parameters
        ----------
        time, duration : float
            Beginning and length of the step [s].
        inputs : sequence of float
            Inputs in the order of the table.

        Raises
        ------
        UnacceptableValuesError
            If the structure cannot have the effects that are on.
        """
        if self._vector is None:
            raise RuntimeError("the structure was not initialised")
        return self._completely(time, duration, inputs)

    def later(self, group: int) -> list[float]:
        """Return a group of outputs that is computed only when it is read.

        Parameters
        ----------
        group : int
            `BOUND`, `POINT_OR_BOUND` or `MODES`.
        """
        if self._vector is None:
            raise RuntimeError("the structure was not initialised")
        if group == MODES:
            return self._modes(self._vector)
        if group == POINT_OR_BOUND and self._roles.load_point is not None:
            # if effects of sensors are on, the load point is the last channel that they read
            return [self._readings[-1] if self._readings else self._point_displacement()]
        static = self._static_response(self._vector)
        if group == BOUND:
            return [static.strain_error_bound]
        return [static.displacement_error_bound]

    def _modes(self, vector: FloatArray) -> list[float]:
        """Return the frequencies [Hz], then the damping ratios, of the modes with outputs."""
        integrator = self._integrator
        modes = self._model.modes(vector) if integrator is None else integrator.modes
        frequency = modes.frequency[:MODE_COUNT]
        alpha, beta = self._damping
        damping_ratio = rayleigh_damping_ratio(alpha, beta, frequency)
        return [*frequency.tolist(), *damping_ratio.tolist()]

    def _static_response(self, vector: FloatArray) -> ReducedResponse:
        """Return the static response of the model, computed once for each step."""
        if self._static is None:
            self._static = self._model.static_response(vector)
        return self._static

    def _point_displacement(self) -> float:
        """Return the displacement [m] of the point at which a load holds the structure."""
        if self._integrator is not None and self._state is not None:
            load = self._holding_load(self._integrator)
            return self._integrator.point_displacement(self._state, load)
        assert self._vector is not None
        static = self._static_response(self._vector)
        return float(self._model.static_load[self._roles.point_load] @ static.coordinates)

    # ------------------------------------------------------------ saved states

    def state(self) -> list[float]:
        """Return the state as numbers: all that is needed to continue, except the parameters.

        The first number counts the parts; each part follows as its length and its numbers.
        """
        motion: list[Sequence[float] | FloatArray] = []
        if self._state is not None:
            state = self._state
            motion = [state.displacement, state.velocity, state.load, *state.memory]
        parts: list[Sequence[float] | FloatArray | None] = [
            self._vector,
            None if self._active is None else self._active.values,
            (self._begin_time,),
            self._filters,
            self._readings,
            *motion,
        ]
        numbers = [float(len(parts))]
        for part in parts:
            if part is None:
                numbers.append(_NONE_LENGTH)
            else:
                numbers.append(float(len(part)))
                numbers += map(float, part)
        return numbers

    def restore(self, parameters: Mapping[str, float], state: Sequence[float]) -> None:
        """Restore a state that `state` has returned.

        Parameters
        ----------
        parameters : mapping of str to float
            The parameters at the time of that state, by name.
        state : sequence of float
            The numbers of the state, as they were saved.

        Raises
        ------
        ValueError
            If a number is not finite.
        """
        if not np.isfinite(list(state)).all():
            raise ValueError("it holds a number that is not finite")
        vector, values, begin_time, filters, readings, *motion = _parts_of_state(state)
        self._take_parameters(parameters)
        self._static = None
        self._begin_time = begin_time[0] if begin_time else 0.0
        self._filters = filters
        self._readings = readings or []
        self._vector = None if vector is None else np.array(vector)
        if self._effects is not None and values is not None:
            self._active = self._effects.active(values)
        self._integrator = None
        self._state = None
        if motion and self._vector is not None:
            self._integrator = self._make_integrator(self._vector)
            displacement, velocity, load, *memory = map(np.array, motion)
            self._state = TransientState(displacement, velocity, load)
            if memory:
                self._state = TransientState(displacement, velocity, load, np.array(memory))

    # ------------------------------------------------------------ steps

    def _take_parameters(self, parameters: Mapping[str, float]) -> None:
        """Set the parameters, among them the damping and whether the response is transient."""
        self._parameters = dict(parameters)
        self._damping = (parameters["damping.alpha"], parameters["damping.beta"])
        self._is_transient = int(parameters["response"]) == TRANSIENT

    def _completely(
        self,
        time: float,
        duration: float,
        inputs: Sequence[float],
        start_parameters: Mapping[str, float] | None = None,
    ) -> list[float]:
        """Return the outputs after a start or a step; restore the previous state after an error.

        `start_parameters` are those of a start, and None for a step.
        """
        previous_attributes = dict(self.__dict__)
        try:
            if start_parameters is not None:
                self._take_parameters(start_parameters)
                self._begin_time = self._tuned_start_time
                self._vector = None
                self._state = None
                self._integrator = None
                self._filters = None
            return self._outputs_after(time, duration, inputs)
        except Exception as error:
            self.__dict__.update(previous_attributes)
            if not isinstance(error, FiniteElementError):
                raise
            sentence = str(error).removesuffix(".")
            raise UnacceptableValuesError(f"{sentence}.") from error

    def _outputs_after(self, time: float, duration: float, inputs: Sequence[float]) -> list[float]:
        """Return the outputs after a step of some duration [s] from a time [s], with given inputs.

        If there is no state yet, they are the outputs at the start.
        """
        has_changed = self._effects is not None and self._take_effects(self._effects)
        values = {**self._parameters, **dict(zip(self._inputs, inputs, strict=True))}
        vector = np.array([values[name] for name in self._roles.chosen])
        has_patched_structure = self._active is not None and self._active.changes_structure
        integrator: ModalIntegrator | None = None
        state: TransientState | None = None
        static: ReducedResponse | None = None
        if self._is_transient or has_patched_structure:
            integrator, state = self._next_motion(vector, time, duration, has_changed=has_changed)
            outputs: list[float] = integrator.outputs(state).tolist()
        else:
            static = self._model.static_response(vector)
            outputs = [
                *static.strain.tolist(),
                *static.displacement.tolist(),
                *self._accelerations_at_rest,
            ]
        self._vector = vector
        self._integrator = integrator
        self._state = state
        self._static = static
        if self._active is None:
            return outputs
        return self._read_by_sensors(self._active, outputs, duration, time + duration)

    def _next_motion(
        self, vector: FloatArray, time: float, duration: float, *, has_changed: bool
    ) -> tuple[ModalIntegrator, TransientState]:
        """Return the integrator and the state after a start or a step.

        `vector` (V,) are the values of the model; `has_changed` says whether the effects have
        changed.
        """
        integrator = self._integrator
        state = self._state
        # If the structure has changed, make a new integrator and express the state in its modes.
        if integrator is None or has_changed or self._structure_differs(vector):
            integrator = self._make_integrator(vector)
            if self._integrator is not None and state is not None:
                state = integrator.take_over(state, self._integrator)
        load = integrator.structure.load_coefficients(vector)
        if not self._is_transient:
            return integrator, integrator.equilibrium(load, state)
        if state is not None:
            time_since_start = time - self._begin_time
            return integrator, integrator.advance(state, duration, load, time_since_start)
        if self._roles.release is None:
            return integrator, integrator.state_at_rest(load)
        release = self._parameters[self._roles.release]
        holding_load = self._holding_load(integrator)
        return integrator, integrator.state_after_release(release, load, holding_load)

    def _structure_differs(self, vector: FloatArray) -> bool:
        """Return whether a value that determines the modes has changed since the last step."""
        if self._vector is None:
            return True
        count = self._structural_count
        return vector[:count].tobytes() != self._vector[:count].tobytes()

    def _holding_load(self, integrator: ModalIntegrator) -> int:
        """Return the index of the load that holds the displaced structure before a release."""
        holding = integrator.structure.holding_load
        return self._roles.point_load if holding is None else holding

    def _make_integrator(self, vector: FloatArray) -> ModalIntegrator:
        """Return the time integrator of the structure, or of the patched wing if there is one."""
        if self._effects is None or self._effects.wing is None:
            alpha, beta = self._damping
            return ModalIntegrator(self._model.structure_at(vector), alpha, beta)
        assert self._active is not None
        return self._effects.integrator(vector, self._damping, self._active)

    # ------------------------------------------------------------ effects

    def _take_effects(self, effects: SwitchableEffects) -> bool:
        """Apply the variables of the effects; return whether the effects have changed."""
        values = effects.values(self._tuned)
        previous_effects = self._active
        if previous_effects is not None and previous_effects.values == values:
            return False
        self._active = effects.active(values)
        # Other filters cannot continue with the memory of these.
        if previous_effects is None or previous_effects.filters != self._active.filters:
            self._filters = None
        return True

    def _read_by_sensors(
        self, active: ActiveEffects, outputs: list[float], duration: float, end: float
    ) -> list[float]:
        """Return the outputs as sensors with the active effects read them.

        The memory of the sensors' filters is kept for the next step.
        """
        assert self._effects is not None
        if not len(active.patch):
            self._filters = None
            self._readings = []
            return outputs
        release = self._parameters.get(self._roles.release or "", 0.0)
        kind = "flight"
        if self._is_transient:
            kind = "ringdown" if release else "forced"
        readings = self._effects.readings(
            active,
            np.array([*outputs, self._point_displacement()]),
            self._strains_across(active, len(outputs) + 1),
            self._filters,
            duration,
            kind=kind,
            time=end - self._begin_time if self._is_transient else end,
            start=self._begin_time,
            release=release,
        )
        self._filters = readings.filter_memory
        self._readings = readings.values
        # The displacement of the load point is the last channel; it is not among these outputs.
        return self._readings[:-1]

    def _strains_across(self, active: ActiveEffects, channels: int) -> FloatArray | None:
        """Return the strains (2, C) transverse to the gauges and in shear, for C channels.

        They are zero for channels other than gauges. None unless an effect changes structure or
        loads, or turns a gauge.
        """
        if self._integrator is None or self._state is None or not active.changes_structure:
            return None
        displacement = self._integrator.displacement(self._state)
        strains = self._integrator.structure.strain_component_rows @ displacement
        other_channels = channels - strains.shape[1]
        return np.pad(strains, ((0, 0), (0, other_channels)))


def _parts_of_state(state: Sequence[float]) -> list[list[float] | None]:
    """Return the parts of a saved state; see `StructureBehaviour.state`."""
    numbers = iter(state)
    parts: list[list[float] | None] = []
    for _ in range(int(next(numbers))):
        length = next(numbers)
        if length < 0.0:
            parts.append(None)
        else:
            parts.append([next(numbers) for _ in range(int(length))])
    return parts
