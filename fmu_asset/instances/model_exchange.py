"""Model exchange of FMI 1.0, 2.0 and 3.0 as if it were co-simulation: fmpy's models and CVODE."""

import math
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from fmpy.fmi1 import FMICallException, FMU1Model
from fmpy.fmi2 import FMU2Model
from fmpy.fmi3 import FMU3Model

from fmu_asset.errors import FmuCallError

from .base import Calls, FmuInstance
from .block import Lines
from .plan import Settings
from .solver import Solver

_MOST_EVENT_ITERATIONS = 100
_MOST_EVENTS_IN_A_STEP = 10_000


class ModelExchange(FmuInstance):
    """A model-exchange instance with its solver.

    Inputs are held over a communication step, or move in straight lines. Where they differ from the last
    ones there is an event at the communication point, and the solver starts again there, as it does where a
    line bends; without a change it keeps its step size and order.
    """

    _solver: Solver | None = None
    _next_event: float | None = None
    _sent: bytes | None = None
    # What fmpy calls these depends on the FMI version.
    _derivatives = "getDerivatives"
    _nominals = "getNominalsOfContinuousStates"
    _update = "newDiscreteStates"

    # ------------------------------------------------------------------ what an FMI version says

    def _update_once(self) -> tuple[bool, bool, float | None]:
        """Iterate once over an event: whether more is needed, whether to end, next time event."""
        more, finished, _, _, due, time = getattr(self._fmu, self._update)()
        return more, finished, time if due else None

    def _enter_event_mode(self) -> None:
        self._fmu.enterEventMode()

    def _enter_continuous_time_mode(self) -> None:
        self._fmu.enterContinuousTimeMode()

    def _completed_step(self) -> tuple[bool, bool]:
        """Return whether the FMU wants an event, and whether it wants to end."""
        event, end = self._fmu.completedIntegratorStep()
        return bool(event), bool(end)

    def _functions(self) -> dict[str, Callable[..., Any]]:
        fmu = self._fmu
        return {
            "get_x": fmu.getContinuousStates,
            "set_x": fmu.setContinuousStates,
            "get_dx": getattr(fmu, self._derivatives),
            "get_z": fmu.getEventIndicators,
            "get_nominals": getattr(fmu, self._nominals),
            "set_time": fmu.setTime,
        }

    # ------------------------------------------------------------------ the same for all

    def _initialise(self, start_time: float, parameters: Settings, *, with_inputs: bool) -> None:
        self._close_solver()
        self._start(start_time, parameters, with_inputs=with_inputs)
        self._iterate_event(start_time)
        self._sent = bytes(self._values)[16:] if with_inputs else None

    def _send(self) -> None:
        """Send inputs that have changed, as an event."""
        bends = False
        if self._lines is not None:
            before = bytes(self._lines.slopes)
            self._lines.aim()
            bends = bytes(self._lines.slopes) != before
        now = bytes(self._values)[16:]
        if now == self._sent and not bends:
            return
        with self._calls("setting inputs"):
            if now != self._sent:
                self._enter_event_mode()
                self._set_values(self._set)
                self._sent = now
                self._iterate_event(self.request[0])
            if self._solver is not None:
                self._solver.reset(self.request[0])

    def _calls_of(self, lines: Lines) -> Calls:
        return self._blocks("Set", tuple(g for g in self._plan.inputs if g.linear), self._values, 2)

    def _follow(self, lines: Lines) -> None:
        """Leave the inputs: they move with the solver's time."""

    def apply(self, time: float) -> None:
        """Set the inputs of a moment [s], where they move."""
        if self._lines is not None:
            self._lines.move(time)
            self._set_values(self._moving)

    def _advance(self) -> None:
        begin, size = self._begin.value, self._size.value
        end = begin + size
        with self._calls(f"the step from t = {begin:g} s"):
            if self._solver is None:
                self._solver = Solver(
                    start_time=begin,
                    largest_step=size,
                    tolerance=self._plan.solver_tolerance,
                    states=self._plan.states,
                    event_indicators=self._plan.event_indicators,
                    functions=self._functions(),
                    inputs=self,
                )
            time = begin
            for _ in range(_MOST_EVENTS_IN_A_STEP):
                time = self._advance_to_event(self._solver, time, end, 1e-12 * size)
                if time >= end:
                    self._sent = bytes(self._values)[16:]
                    return
        self._lost = True
        raise FmuCallError(
            f"The FMU had {_MOST_EVENTS_IN_A_STEP} events in the step from t = {begin:g} s and is at "
            f"t = {time:g} s; its events probably pile up. Reset the asset, and try a smaller step_size.",
            self._texts(),
        )

    def _advance_to_event(self, solver: Solver, time: float, end: float, close: float) -> float:
        """Integrate to the end or to the next event, and handle that; return the time reached."""
        due = self._next_event
        target = end if due is None or due >= end - close else max(due, time)
        event = False
        if target > time + close:
            try:
                event, time = solver.advance(time, target)
            except RuntimeError as error:
                self._lost = True
                raise FmuCallError(
                    f"The solver could not integrate the FMU in the step from t = {time:g} s ({error}); "
                    "reset the asset, and try a smaller step_size or another tolerance in the binding.",
                    self._texts(),
                ) from error
        if not event and abs(time - end) <= close:
            time = end
        self._fmu.setTime(time)
        self.apply(time)
        if self._plan.completed_step:
            wanted, finished = self._completed_step()
            self._heed_end(finished, time)
            event = event or wanted
        if event or (due is not None and time >= due - close):
            self._enter_event_mode()
            self._iterate_event(time)
            solver.reset(time)
        return time

    def _iterate_event(self, time: float) -> None:
        """Update the discrete states until they are settled, and go on in continuous time."""
        for _ in range(_MOST_EVENT_ITERATIONS):
            more, finished, following = self._update_once()
            self._heed_end(finished, time)
            if not more:
                break
        else:
            self._lost = True
            raise FmuCallError(
                f"The FMU's discrete states do not settle at t = {time:g} s: {_MOST_EVENT_ITERATIONS} event "
                "iterations were made; the instance is lost.",
                self._texts(),
            )
        self._next_event = following if following is None or math.isfinite(following) else None
        self._enter_continuous_time_mode()

    def _heed_end(self, finished: bool, time: float) -> None:
        if finished:
            raise self._end(time)

    def _close_solver(self) -> None:
        if self._solver is not None:
            self._solver.close()
        self._solver = self._next_event = self._sent = None

    def reset(self) -> None:
        """Bring the instance back to the moment after its instantiation."""
        self._close_solver()
        super().reset()

    def _free(self) -> None:
        self._close_solver()
        super()._free()


class ModelExchange1(ModelExchange):
    """FMI 1.0 model exchange; it has no modes."""

    _fmpy_class = FMU1Model
    _nominals = "getNominalContinuousStates"

    def _start(self, start_time: float, parameters: Settings, *, with_inputs: bool) -> None:
        self._fmu.setTime(start_time)
        self._apply(parameters)
        if with_inputs:
            self._set_values(self._set)
        tolerance = self._plan.tolerance
        converged, _, _, finished, due, time = self._fmu.initialize(
            toleranceControlled=b"\x00" if tolerance is None else b"\x01", relativeTolerance=tolerance or 0.0
        )
        self._heed_end(finished, start_time)
        self._first: tuple[bool, float | None] | None = (not converged, time if due else None)

    def _update_once(self) -> tuple[bool, bool, float | None]:
        if self._first is not None:
            # The initialisation was the first iteration.
            (more, due), self._first = self._first, None
            return more, False, due
        converged, _, _, finished, due_defined, time = self._fmu.eventUpdate()
        return not converged, finished, time if due_defined else None

    def _enter_event_mode(self) -> None:
        pass

    def _enter_continuous_time_mode(self) -> None:
        pass

    def _completed_step(self) -> tuple[bool, bool]:
        return bool(self._fmu.completedIntegratorStep()), False

    def reset(self) -> None:
        """Refuse: FMI 1.0 model exchange cannot be reset, so that the asset makes a new instance."""
        raise FmuCallError("FMI 1.0 model exchange has no reset.")

    def _free(self) -> None:
        self._close_solver()
        if self._phase == "stepping":
            with suppress(FMICallException):
                self._fmu.terminate()
        self._fmu.freeInstance()


class ModelExchange2(ModelExchange):
    """FMI 2.0 model exchange."""

    _fmpy_class = FMU2Model


class ModelExchange3(ModelExchange):
    """FMI 3.0 model exchange."""

    _fmpy_class = FMU3Model
    _derivatives = "getContinuousStateDerivatives"
    _update = "updateDiscreteStates"


MODEL_EXCHANGE: dict[int, type[ModelExchange]] = {1: ModelExchange1, 2: ModelExchange2, 3: ModelExchange3}
