"""What a structure does in one communication step: static equilibrium, or its modes integrated in time.

Copied into the FMU, where `fe.runtime` is the folder `fe` beside it; `structure_behaviour.c` does the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from fe.runtime.damping import rayleigh_damping_ratio
from fe.runtime.reduced import ReducedModel, StaticResponse
from fe.runtime.transient import ModalIntegrator, TransientState

from .table import MODE_COUNT, Roles
from .variables import TRANSIENT, FmuVariable

FloatArray = npt.NDArray[np.float64]

BOUND, POINT_OR_BOUND, MODES = range(3)
"""Groups of outputs that are computed when they are read."""


def later_outputs(table: Sequence[FmuVariable], roles: Roles) -> tuple[slice, ...]:
    """Return the rows of the groups `BOUND`, `POINT_OR_BOUND` and `MODES`."""
    reference = {row.name: row.reference for row in table}
    other = reference[roles.load_point or roles.displacement_bound or ""]
    bound, first = reference["strain_error_bound"], reference["frequency[1]"]
    count = 2 * sum(name.startswith("frequency[") for name in reference)
    return slice(bound, bound + 1), slice(other, other + 1), slice(first, first + count)


class StructureBehaviour:
    """A structure in time; a call either completes or raises and leaves everything as it was.

    Outputs are gauges, displacements and accelerations.

    Parameters
    ----------
    model : ReducedModel
        The reduced structure.
    table : sequence of FmuVariable
        Its variables, the inputs first.
    roles : Roles
        Which of them is what.
    """

    def __init__(self, model: ReducedModel, table: Sequence[FmuVariable], roles: Roles) -> None:
        self._model, self._roles = model, roles
        inputs = [row.name for row in table if row.causality == "input"]
        self._sources = [(name, inputs.index(name) if name in inputs else None) for name in roles.chosen]
        self._resting = [0.0] * len(model.accelerations)
        self._own = len(model.chosen) - len(model.controls)  # what modes depend on
        self._parameters: Mapping[str, float] = {}
        self._vector: FloatArray | None = None
        self._motion: tuple[ModalIntegrator, TransientState] | None = None
        self._static: StaticResponse | None = None

    def start(self, parameters: Mapping[str, float], time: float, inputs: Sequence[float]) -> Sequence[float]:
        """Begin in equilibrium under the inputs, or just let go of where a force held the structure aside."""
        kept, motion = dict(parameters), None
        vector = self._chosen(kept, inputs)
        if int(kept["response"]) == TRANSIENT:
            integrator, load = self._integrator(kept, vector), self._model.load_coefficients(vector)
            state = integrator.at_rest(load)
            if self._roles.release is not None:
                state = integrator.released(kept[self._roles.release], load, self._roles.point_load)
            motion = integrator, state
        outputs = self._outputs(vector, motion)
        self._parameters = kept
        return outputs

    def advance(self, time: float, duration: float, inputs: Sequence[float]) -> Sequence[float]:
        """Advance by one step of `duration` [s] with the inputs held."""
        before, motion = self._vector, self._motion
        if before is None:
            raise RuntimeError("the structure was not initialised")
        vector = self._chosen(self._parameters, inputs)
        if motion is not None:
            integrator, state = motion
            if vector[: self._own].tobytes() != before[: self._own].tobytes():
                integrator = self._integrator(self._parameters, vector)
                state = integrator.take_over(state, motion[0])
            motion = integrator, integrator.advance(state, duration, self._model.load_coefficients(vector))
        return self._outputs(vector, motion)

    def later(self, group: int) -> list[float]:
        """Return the outputs of a group: the bound, the other bound or the load point, the modes."""
        if self._vector is None:
            raise RuntimeError("the structure was not initialised")
        if group == MODES:
            return self.modal_data()
        if group == POINT_OR_BOUND and self._roles.load_point is not None:
            return [self.load_point_displacement()]
        self._static = self._static or self._model.static_response(self._vector)
        bounds = self._static.strain_error_bound, self._static.displacement_error_bound
        return [bounds[group]]

    def load_point_displacement(self) -> float:
        """Return the displacement of the point where the load acts that holds the structure aside [m]."""
        point = self._roles.point_load
        if self._motion is not None:
            integrator, state = self._motion
            return integrator.point_displacement(state, point)
        self._static = self._static or self._model.static_response(self._vector)
        return float(self._model.static_load[point] @ self._static.coordinates)

    def modal_data(self) -> list[float]:
        """Return natural frequencies [Hz], then damping ratios [1], under the last inputs."""
        modes = self._model.modes(self._vector) if self._motion is None else self._motion[0].modes
        frequency = modes.frequency[:MODE_COUNT]
        ratio = rayleigh_damping_ratio(*self._damping(self._parameters), frequency)
        return [*frequency.tolist(), *ratio.tolist()]

    def state(self) -> list[float]:
        """Return all that is remembered, without the parameters."""
        vector = [] if self._vector is None else self._vector.tolist()
        return [*vector, *([] if self._motion is None else self._motion[1].to_list())]

    def restore(self, parameters: Mapping[str, float], state: Sequence[float]) -> None:
        """Take back what `state` returned; `parameters` are those of that moment."""
        count, kept, vector, motion = len(self._model.chosen), dict(parameters), None, None
        if state:
            vector = np.array(state[:count])
        if vector is not None and len(state) > count:
            found = TransientState.from_list(state[count:], self._model.mode_count)
            motion = self._integrator(kept, vector), found
        self._parameters, self._vector, self._motion, self._static = kept, vector, motion, None

    def _chosen(self, parameters: Mapping[str, float], inputs: Sequence[float]) -> FloatArray:
        return np.array(
            [parameters[name] if number is None else inputs[number] for name, number in self._sources]
        )

    @staticmethod
    def _damping(parameters: Mapping[str, float]) -> tuple[float, float]:
        return parameters["damping.alpha"], parameters["damping.beta"]

    def _integrator(self, parameters: Mapping[str, float], vector: FloatArray) -> ModalIntegrator:
        return ModalIntegrator(self._model, vector, *self._damping(parameters))

    def _outputs(
        self, vector: FloatArray, motion: tuple[ModalIntegrator, TransientState] | None
    ) -> list[float]:
        """Take what is chosen and the motion, and return the outputs."""
        static = None
        if motion is not None:
            values: list[float] = motion[0].outputs(motion[1]).tolist()
        else:
            static = self._model.static_response(vector)
            values = static.strain.tolist() + static.displacement.tolist() + self._resting
        self._vector, self._motion, self._static = vector, motion, static
        return values
