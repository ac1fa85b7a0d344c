"""Model exchange of FMI 1.0, 2.0 and 3.0, solved by SUNDIALS CVODE as if it were co-simulation.

The solver is fmpy's; failures and memory that its wrapper loses are handled here.
"""

# ruff: noqa: N802, N815 - methods and arguments have fmpy's names

import ctypes
import math
from collections.abc import Callable, MutableSequence
from typing import Protocol

from fmpy.fmi1 import FMICallException, FMU1Model
from fmpy.fmi2 import FMU2Model
from fmpy.fmi3 import FMU3Model
from fmpy.sundials import CVodeSolver
from fmpy.sundials.libraries import sundials_core
from fmpy.sundials.nvector_serial import N_VDestroy_Serial

from fmu_asset.errors import FmuCallError, FmuError

from .base import FmiCall, FmpyInstance, FmuInstance
from .plan import InitialValues, LinearInputs, Plan
from .statuses import DISCARD

_MOST_EVENT_ITERATIONS = 100
_MOST_EVENTS_IN_A_STEP = 10_000
_MOST_INTERNAL_STEPS = 100_000
_ROUNDING = 1e-12
"""Fraction of a step below which two times count as the same."""

for _name in ("SUNLinSolFree", "SUNMatDestroy", "SUNContext_Free"):
    getattr(sundials_core, _name).argtypes = [ctypes.c_void_p]


class FMU1ModelExchange(FMU1Model):  # type: ignore[misc]
    """FMI 1.0 model exchange, which has no modes, with the methods of FMI 2.0."""

    getNominalsOfContinuousStates = FMU1Model.getNominalContinuousStates

    def setupExperiment(
        self, *, startTime: float, stopTime: float | None, tolerance: float | None
    ) -> None:
        """Set the time, and store the tolerance; this interface has no end time."""
        self._tolerance = tolerance
        self.setTime(startTime)

    def enterInitializationMode(self) -> None:
        """Do nothing, as in the other modes."""

    enterEventMode = enterContinuousTimeMode = enterInitializationMode

    def exitInitializationMode(self) -> None:
        """Initialise the FMU, which also is the first iteration of an event."""
        is_controlled = b"\x00" if self._tolerance is None else b"\x01"
        self._first_event = self.initialize(is_controlled, self._tolerance or 0.0)

    def newDiscreteStates(self) -> tuple[bool, bool, bool, bool, bool, float]:
        """Make one iteration of an event."""
        event = self._first_event or self.eventUpdate()
        self._first_event = None
        converged, _, _, terminated, has_next_event, next_event_time = event
        return not converged, terminated, False, False, has_next_event, next_event_time

    def completedIntegratorStep(self) -> tuple[bool, bool]:
        """Return whether the FMU asks for an event, and False: it cannot ask to end."""
        return bool(super().completedIntegratorStep()), False

    def reset(self) -> None:
        """Raise an error: FMI 1.0 has no reset here, so the asset makes a new instance."""
        raise FmuCallError("FMI 1.0 model exchange has no reset.")


class FMU3ModelExchange(FMU3Model):  # type: ignore[misc]
    """FMI 3.0 model exchange with the method names of FMI 2.0."""

    getDerivatives = FMU3Model.getContinuousStateDerivatives
    newDiscreteStates = FMU3Model.updateDiscreteStates


class InterpolatedInputs(Protocol):
    """The inputs of a model that change between two communication points."""

    def apply(self, time: float) -> None:
        """Set the inputs at a time [s]."""


class CvodeSolver(CVodeSolver):  # type: ignore[misc]
    """The CVODE solver of a model-exchange instance: BDF with root finding at events.

    Parameters
    ----------
    fmu : fmpy model
        The FMU, with the methods of FMI 2.0.
    plan : Plan
        Gives the numbers of states and event indicators, and the relative tolerance. The absolute
        tolerance of a state is the relative one times its nominal value.
    inputs : InterpolatedInputs
        Sets the inputs before each evaluation of the model.
    start_time : float
        The start of the integration [s].
    largest_step : float
        Limit of the internal steps [s]. It bounds how long an event can stay undetected whose
        indicator changes sign twice within a step.
    """

    def __init__(
        self,
        fmu: FmpyInstance,
        plan: Plan,
        inputs: InterpolatedInputs,
        start_time: float,
        largest_step: float,
    ) -> None:
        self._failure: Exception | None = None
        self._is_open = True

        def get_nominals(values: MutableSequence[float], count: int) -> None:
            fmu.getNominalsOfContinuousStates(values, count)
            for index in range(count):
                # FMI allows no nominal value of zero, and CVODE no zero tolerance of a zero state
                values[index] = abs(values[index]) or 1.0

        super().__init__(
            nx=plan.fmu.states,
            nz=plan.fmu.event_indicators,
            get_x=fmu.getContinuousStates,
            set_x=fmu.setContinuousStates,
            get_dx=fmu.getDerivatives,
            get_z=fmu.getEventIndicators,
            get_nominals=get_nominals,
            set_time=fmu.setTime,
            input=inputs,
            startTime=start_time,
            maxStep=largest_step,
            relativeTolerance=plan.solver_tolerance,
            maxNumSteps=_MOST_INTERNAL_STEPS,
        )

    # CVODE calls these methods through ctypes, which only prints an exception that leaves a
    # callback; CVODE would go on with wrong values. So the exception is stored, CVODE gets an error
    # status and stops, and `advance` raises the exception.

    def f(self, t: float, y: object, ydot: object, user_data: object) -> int:
        """Compute the right-hand side for CVODE.

        The status 1 asks CVODE to try a smaller step, and -1 ends the integration.
        """
        return self._guarded(self._right_hand_side, t, y, ydot, user_data)

    def _right_hand_side(self, t: float, y: object, ydot: object, user_data: object) -> int:
        self.input.apply(t)
        return int(super().f(t, y, ydot, user_data))

    def g(self, t: float, y: object, gout: object, user_data: object) -> int:
        """Compute the event indicators for CVODE."""
        return self._guarded(super().g, t, y, gout, user_data)

    def _guarded(
        self, function: Callable[..., int], t: float, y: object, result: object, user_data: object
    ) -> int:
        """Call a callback of CVODE and return its status; store an exception instead of raising it.

        If the FMU discards the evaluation, CVODE may try a smaller step.
        """
        try:
            return function(t, y, result, user_data)
        except (FMICallException, FmuError) as error:
            self._failure = error
            return 1 if getattr(error, "status", None) == DISCARD else -1

    def advance(self, begin: float, end: float) -> tuple[bool, float]:
        """Integrate to the end of an interval, or to the first event in it.

        Parameters
        ----------
        begin, end : float
            The interval of integration [s].

        Returns
        -------
        event : bool
            Whether an event indicator changed its sign.
        time : float
            The time that was reached [s].

        Raises
        ------
        FMICallException, FmuCallError
            If the FMU failed.
        RuntimeError
            If CVODE failed.
        """
        self._failure = None
        try:
            event, _, time = self.step(begin, end)
        except Exception as error:
            if self._failure is not None:
                raise self._failure from error
            raise RuntimeError(self.error_info[3] if self.error_info else str(error)) from error
        return event, time

    def close(self) -> None:
        """Free the solver, and the parts of it that fmpy's wrapper never frees."""
        if not self._is_open:
            return
        super().__del__()
        sundials_core.SUNLinSolFree(self.LS)
        sundials_core.SUNMatDestroy(self.A)
        N_VDestroy_Serial(self.x)
        N_VDestroy_Serial(self.abstol)
        sundials_core.SUNContext_Free(ctypes.byref(self.sunctx))
        self._is_open = False

    def __del__(self) -> None:
        """Do nothing: `close` frees the solver."""


class ModelExchange(FmuInstance):
    """A model-exchange instance with its solver.

    Over a communication step an input is constant, or changes linearly if the binding says so. If
    inputs jump at a communication point, this is an event, and the solver restarts. It also
    restarts if the slope of a linear input changes. Otherwise it keeps its step size and order.
    """

    classes = {1: FMU1ModelExchange, 2: FMU2Model, 3: FMU3ModelExchange}  # noqa: RUF012
    _solver: CvodeSolver | None = None
    _next_event_time: float | None = None
    _sent_inputs: bytes | None = None

    def _go_to_start(
        self, start_time: float, parameters: InitialValues, *, with_inputs: bool
    ) -> None:
        """Initialise the FMU and iterate its discrete states to convergence, as at an event."""
        self._close_solver()
        super()._go_to_start(start_time, parameters, with_inputs=with_inputs)
        self._settle_discrete_states(start_time)
        self._sent_inputs = self._inputs_now() if with_inputs else None

    def _inputs_now(self) -> bytes:
        """Return all present inputs as bytes, for an exact comparison."""
        # The block begins with time and step size, 8 bytes each.
        return bytes(self._values)[16:]

    def _send_inputs(self) -> None:
        """Set the inputs of a new step, and restart the solver if they or their slopes jump.

        A jump of the values is an event, which the FMU must handle; a jump of the slopes is not.
        """
        slope_changes = False
        if self._linear_inputs is not None:
            previous_slopes = bytes(self._linear_inputs.slopes)
            self._linear_inputs.begin_step()
            slope_changes = bytes(self._linear_inputs.slopes) != previous_slopes
        inputs = self._inputs_now()
        has_changed = inputs != self._sent_inputs
        if not has_changed and not slope_changes:
            return
        with self._fmpy_calls("setting inputs"):
            if has_changed:
                self._fmu.enterEventMode()
                self._make_calls(self._set_calls)
                self._sent_inputs = inputs
                self._settle_discrete_states(self.request[0])
            if self._solver is not None:
                self._solver.reset(self.request[0])

    def _interpolation_calls(self, linear_inputs: LinearInputs) -> list[FmiCall]:
        """Return the calls that set linear inputs, which the solver makes at each evaluation."""
        linear_groups = tuple(group for group in self._plan.inputs if group.linear)
        # Values begin behind time and step size in the block.
        return self._group_calls("Set", linear_groups, self._values, 2)

    def _send_interpolated_inputs(self, linear_inputs: LinearInputs) -> None:
        """Do nothing: `apply` sets the linear inputs at every evaluation."""

    def apply(self, time: float) -> None:
        """Set the linear inputs to their values at a time [s]; called before each evaluation."""
        if self._linear_inputs is not None:
            self._linear_inputs.move_to(time)
            self._make_calls(self._per_step_calls)

    def _do_step(self) -> None:
        """Integrate over one communication step, which may contain several events."""
        begin = self._step_begin.value
        size = self._step_size.value
        end = begin + size
        with self._fmpy_calls(self._step_label()):
            if self._solver is None:
                self._solver = CvodeSolver(self._fmu, self._plan, self, begin, size)
            time = begin
            for _ in range(_MOST_EVENTS_IN_A_STEP):
                time = self._integrate_to_event(self._solver, time, end, _ROUNDING * size)
                if time >= end:
                    self._sent_inputs = self._inputs_now()
                    return
        raise self._lost_error(
            f"The FMU had {_MOST_EVENTS_IN_A_STEP} events in {self._step_label()} and is at "
            f"t = {time:g} s; its events probably pile up. Reset the asset, and try a smaller "
            "step_size."
        )

    def _integrate_to_event(
        self, solver: CvodeSolver, time: float, end: float, resolution: float
    ) -> float:
        """Integrate to the next event or the end of the step, and return the time reached [s].

        An event is handled at once. There are three kinds: state events, which the solver finds as
        a change of sign of an event indicator; step events, which the FMU asks for after a step of
        the solver; and time events, which the FMU announced at the last event. Times [s] that
        differ by less than `resolution` count as equal.
        """
        # Integrate to the announced time event if it lies inside the step, else to the end. A time
        # event that is overdue is handled at once.
        time_event = self._next_event_time
        stop_time = (
            end if time_event is None or time_event >= end - resolution else max(time_event, time)
        )
        has_event = False
        if stop_time > time + resolution:
            try:
                has_event, time = solver.advance(time, stop_time)
            except RuntimeError as error:
                raise self._lost_error(
                    f"The solver could not integrate the FMU in the step from t = {time:g} s "
                    f"({error}); reset the asset, and try a smaller step_size or another tolerance "
                    "in the binding."
                ) from error
        if not has_event and abs(time - end) <= resolution:
            time = end
        # bring the FMU to the time reached; it may ask for a step event there
        self._fmu.setTime(time)
        self.apply(time)
        if self._plan.fmu.completed_step:
            wants_event, terminated = self._fmu.completedIntegratorStep()
            if terminated:
                raise self._ended_error(time)
            has_event = has_event or bool(wants_event)
        # handle the event: update the discrete states and restart the solver
        is_time_event = time_event is not None and time >= time_event - resolution
        if has_event or is_time_event:
            self._fmu.enterEventMode()
            self._settle_discrete_states(time)
            solver.reset(time)
        return time

    def _settle_discrete_states(self, time: float) -> None:
        """Iterate the event at a time [s] until the discrete states have converged.

        The FMU must be in event mode; it then returns to continuous time. Its next time event is
        recorded.
        """
        for _ in range(_MOST_EVENT_ITERATIONS):
            update = self._fmu.newDiscreteStates()
            needs_another, terminated, _, _, has_next_event, next_event_time = update
            if terminated:
                raise self._ended_error(time)
            if not needs_another:
                break
        else:
            raise self._lost_error(
                f"The FMU's discrete states do not settle at t = {time:g} s: "
                f"{_MOST_EVENT_ITERATIONS} event iterations were made; the instance is lost."
            )
        has_time_event = has_next_event and math.isfinite(next_event_time)
        self._next_event_time = next_event_time if has_time_event else None
        self._fmu.enterContinuousTimeMode()

    def _lost_error(self, sentence: str) -> FmuCallError:
        """Mark the instance as lost, and return the error that says why."""
        self.lost = True
        return FmuCallError(sentence, self._last_messages())

    def _close_solver(self) -> None:
        """Free the solver and forget the pending time event and the inputs that were set."""
        if self._solver is not None:
            self._solver.close()
        self._solver = None
        self._next_event_time = None
        self._sent_inputs = None

    def reset(self) -> None:
        """Return the instance to its state after instantiation."""
        self._close_solver()
        super().reset()

    def _terminate_and_free(self) -> None:
        self._close_solver()
        super()._terminate_and_free()
