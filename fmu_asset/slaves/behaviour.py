"""What the wing does in one communication step: the steady turn, or the modes integrated in time.

This file is copied into the FMU, where `fe.runtime` is the folder `fe` beside it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fe.runtime.damping import rayleigh_damping_ratio
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import TIP_FORCE
from fe.runtime.transient import ModalIntegrator, TransientState

from .variables import TRANSIENT


class UnacceptableEffectError(ValueError):
    """The values of missing effects are none that the wing can have; one sentence with its full stop."""


@dataclass(frozen=True, slots=True)
class WingParameters:
    """Parameters of the wing FMU, SI units; `response` as in `variables`."""

    young_modulus_factor: float
    damping_alpha: float
    damping_beta: float
    servo_mass: float
    pitot_mass: float
    initial_tip_displacement: float
    response: int


class Response(NamedTuple):
    """Outputs at the end of a step: strain (G,) dimensionless, tip displacement [m]."""

    strain: npt.NDArray[np.float64]
    tip_displacement: float


class Moment(NamedTuple):
    """What a step of an FMU with missing effects depends on beside inputs and duration.

    Attributes
    ----------
    time, start : float
        Time at the end of the step, and at the start of the simulation [s].
    values : mapping of str to float
        Variables of the effects by name.
    """

    time: float
    start: float
    values: Mapping[str, float]


class WingBehaviour:
    """The wing in time: what it remembers, and how a step changes it.

    A step either completes or raises and leaves everything as it was. Inputs are load factor, the
    losses of the damage regions and tip force [N], in this order, and are held over the step.

    Parameters
    ----------
    model : ReducedModel
        The wing.
    mode_count : int
        Number of modes whose data `modal_data` returns.
    """

    def __init__(self, model: ReducedModel, mode_count: int) -> None:
        self._model = model
        self._mode_count = mode_count
        self._parameters: WingParameters | None = None
        self._inputs: tuple[float, ...] = ()
        self._integrator: ModalIntegrator | None = None
        self._transient: TransientState | None = None
        self._bound: float | None = None

    @property
    def input_count(self) -> int:
        """Number of inputs."""
        return len(self._model.regions) + 2

    def start(
        self, parameters: WingParameters, inputs: Sequence[float], moment: Moment | None = None
    ) -> Response:
        """Find the initial state: equilibrium, and for the transient the tip displaced and just let go.

        Parameters and inputs lie within the validity box; nothing here depends on `moment`.
        """
        if parameters.response != TRANSIENT:
            response = self._equilibrium(parameters, inputs)
            self._integrator, self._transient = None, None
        else:
            integrator = self._make_integrator(parameters, inputs)
            load = (inputs[0], inputs[-1])
            transient = integrator.released(parameters.initial_tip_displacement, load, TIP_FORCE)
            response = self._read(integrator, transient)
            self._integrator, self._transient, self._bound = integrator, transient, None
        self._parameters, self._inputs = parameters, tuple(inputs)
        return response

    def advance(self, inputs: Sequence[float], duration: float, moment: Moment | None = None) -> Response:
        """Advance by one step of `duration` [s] with the inputs held, within the validity box, as `start`."""
        parameters, before = self._parameters, self._integrator
        if parameters is None:
            raise RuntimeError("the wing was not initialised")
        if before is None or self._transient is None:
            response = self._equilibrium(parameters, inputs)
        else:
            integrator, transient = before, self._transient
            if tuple(inputs[1:-1]) != self._inputs[1:-1]:
                integrator = self._make_integrator(parameters, inputs)
                transient = integrator.take_over(transient, before)
            load = (inputs[0], inputs[-1])
            transient = integrator.advance(transient, duration, load)
            response = self._read(integrator, transient)
            self._integrator, self._transient, self._bound = integrator, transient, None
        self._inputs = tuple(inputs)
        return response

    def strain_error_bound(self) -> float:
        """Return the certified bound of the static strains under the last inputs (dimensionless)."""
        if self._bound is None:
            if self._parameters is None:
                raise RuntimeError("the wing was not initialised")
            self._equilibrium(self._parameters, self._inputs)
        return self._bound or 0.0

    def load_point_displacement(self) -> float:
        """Return the displacement of the point where the tip force acts [m]."""
        if self._parameters is None:
            raise RuntimeError("the wing was not initialised")
        if self._integrator is not None and self._transient is not None:
            return self._integrator.point_displacement(self._transient, TIP_FORCE)
        static = self._model.static_response(self._vector(self._parameters, self._inputs))
        return float(self._model.static_load[TIP_FORCE] @ static.coordinates)

    def modal_data(self) -> tuple[list[float], list[float]]:
        """Return natural frequencies [Hz] and damping ratios [1] under the last inputs."""
        parameters = self._parameters
        if parameters is None:
            raise RuntimeError("the wing was not initialised")
        if self._integrator is not None:
            frequency, ratio = self._integrator.modes.frequency, self._integrator.damping_ratio
        else:
            frequency = self._model.modes(self._vector(parameters, self._inputs)).frequency
            ratio = rayleigh_damping_ratio(parameters.damping_alpha, parameters.damping_beta, frequency)
        return frequency[: self._mode_count].tolist(), ratio[: self._mode_count].tolist()

    def state(self) -> list[float]:
        """Return all that is remembered as plain floats; parameters are kept by the slave."""
        head = [float(self._parameters is not None), float(self._transient is not None)]
        inputs = list(self._inputs) or [0.0] * self.input_count
        return [*head, *inputs, *([] if self._transient is None else self._transient.to_list())]

    def restore(self, parameters: WingParameters, values: Sequence[float]) -> None:
        """Take back what `state` returned; `parameters` are those of that moment."""
        started, moving = values[0] != 0.0, values[1] != 0.0
        inputs = tuple(values[2 : 2 + self.input_count])
        integrator, transient = None, None
        if moving:
            integrator = self._make_integrator(parameters, inputs)
            transient = TransientState.from_list(values[2 + self.input_count :], self._model.mode_count)
        self._parameters = parameters if started else None
        self._inputs = inputs if started else ()
        self._integrator, self._transient, self._bound = integrator, transient, None

    def _equilibrium(self, parameters: WingParameters, inputs: Sequence[float]) -> Response:
        static = self._model.static_response(self._vector(parameters, inputs))
        self._bound = static.strain_error_bound
        return Response(static.strain, float(static.displacement[0]))

    def _make_integrator(self, parameters: WingParameters, inputs: Sequence[float]) -> ModalIntegrator:
        vector = self._vector(parameters, inputs)
        return ModalIntegrator(self._model, vector, parameters.damping_alpha, parameters.damping_beta)

    @staticmethod
    def _vector(parameters: WingParameters, inputs: Sequence[float]) -> npt.NDArray[np.float64]:
        masses = (parameters.servo_mass, parameters.pitot_mass)
        return np.array((parameters.young_modulus_factor, *inputs[1:-1], *masses, inputs[0], inputs[-1]))

    @staticmethod
    def _read(integrator: ModalIntegrator, transient: TransientState) -> Response:
        outputs = integrator.outputs(transient)
        return Response(outputs[:-1], float(outputs[-1]))
