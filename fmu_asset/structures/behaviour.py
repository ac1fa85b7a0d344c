"""What a structure does in one communication step: static equilibrium, or its modes integrated in time.

Copied into the FMU, where `fe.runtime` is the folder `fe` beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from fe.runtime.damping import rayleigh_damping_ratio
from fe.runtime.reduced import ReducedModel
from fe.runtime.transient import ModalIntegrator, TransientState

from ..slaves.variables import TRANSIENT

FloatArray = npt.NDArray[np.float64]


class StructureBehaviour:
    """A structure in time; a call either completes or raises and leaves everything as it was.

    Inputs are the controls, then the losses of the damage regions. Outputs are gauges, displacements,
    accelerations and both error bounds.

    Parameters
    ----------
    model : ReducedModel
        The reduced structure.
    """

    def __init__(self, model: ReducedModel) -> None:
        self._model = model
        self._parameters: dict[str, float] = {}
        self._inputs: tuple[float, ...] = ()
        self._vector = model.nominal
        self._motion: ModalIntegrator | None = None
        self._state: TransientState | None = None

    def start(self, parameters: Mapping[str, float], time: float, inputs: Sequence[float]) -> list[float]:
        """Begin in equilibrium under the inputs."""
        kept = dict(parameters)
        vector = self._chosen(kept, inputs)
        motion = state = None
        if int(kept["response"]) == TRANSIENT:
            motion = self._motion_at(kept, vector)
            state = motion.at_rest(self._model.load_coefficients(vector))
        outputs = self._outputs(vector, motion, state)
        self._parameters, self._inputs, self._vector = kept, tuple(inputs), vector
        self._motion, self._state = motion, state
        return outputs

    def advance(self, time: float, duration: float, inputs: Sequence[float]) -> list[float]:
        """Advance by one step of `duration` [s] with the inputs held."""
        vector = self._chosen(self._parameters, inputs)
        motion, state = self._motion, self._state
        if motion is not None and state is not None:
            controls = len(self._model.controls)
            if tuple(inputs[controls:]) != self._inputs[controls:]:
                motion = self._motion_at(self._parameters, vector)
                state = motion.take_over(state, self._motion or motion)
            state = motion.advance(state, duration, self._model.load_coefficients(vector))
        outputs = self._outputs(vector, motion, state)
        self._inputs, self._vector, self._motion, self._state = tuple(inputs), vector, motion, state
        return outputs

    def modal_data(self) -> list[float]:
        """Return natural frequencies [Hz], then damping ratios [1], under the last inputs."""
        frequency = (self._motion.modes if self._motion else self._model.modes(self._vector)).frequency
        alpha, beta = self._damping(self._parameters)
        return [*frequency.tolist(), *rayleigh_damping_ratio(alpha, beta, frequency).tolist()]

    def state(self) -> list[float]:
        """Return all that is remembered, without the parameters."""
        return [*self._inputs, *(() if self._state is None else self._state.to_list())]

    def restore(self, parameters: Mapping[str, float], state: Sequence[float]) -> None:
        """Take back what `state` returned."""
        count = len(self._model.controls) + len(self._model.regions)
        kept, inputs, moving = dict(parameters), tuple(state[:count]), state[count:]
        if not inputs:  # saved before the initialisation
            return
        vector = self._chosen(kept, inputs)
        motion = found = None
        if moving:
            motion = self._motion_at(kept, vector)
            found = TransientState.from_list(moving, self._model.mode_count)
        self._parameters, self._inputs, self._vector = kept, inputs, vector
        self._motion, self._state = motion, found

    def _chosen(self, parameters: Mapping[str, float], inputs: Sequence[float]) -> FloatArray:
        model, controls = self._model, len(self._model.controls)
        return np.array(
            (
                *(parameters[name] for name in model.parameters),
                *inputs[controls:],
                *(parameters[f"mass.{name}"] for name in model.masses),
                *inputs[:controls],
            )
        )

    @staticmethod
    def _damping(parameters: Mapping[str, float]) -> tuple[float, float]:
        return parameters["damping.alpha"], parameters["damping.beta"]

    def _motion_at(self, parameters: Mapping[str, float], vector: FloatArray) -> ModalIntegrator:
        return ModalIntegrator(self._model, vector, *self._damping(parameters))

    def _outputs(
        self, vector: FloatArray, motion: ModalIntegrator | None, state: TransientState | None
    ) -> list[float]:
        static = self._model.static_response(vector)
        if motion is not None and state is not None:
            values = motion.outputs(state).tolist()
        else:
            resting = (0.0,) * len(self._model.accelerations)
            values = [*static.strain.tolist(), *static.displacement.tolist(), *resting]
        return [*values, static.strain_error_bound, static.displacement_error_bound]
