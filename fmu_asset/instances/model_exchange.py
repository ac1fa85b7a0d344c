"""Model exchange of FMI 1.0, 2.0 and 3.0 as if it were co-simulation: fmpy's models and SUNDIALS CVODE.

The solver is fmpy's, with the failures and the memory that its wrapper lets slip.
"""

import ctypes
import math
from collections.abc import Callable
from typing import Any

from fmpy.fmi1 import FMICallException, FMU1Model
from fmpy.fmi2 import FMU2Model
from fmpy.fmi3 import FMU3Model
from fmpy.sundials import CVodeSolver
from fmpy.sundials.libraries import sundials_core
from fmpy.sundials.nvector_serial import N_VDestroy_Serial

from fmu_asset.errors import FmuCallError, FmuError
from fmu_asset.sentences import said

from .base import DISCARD, Calls, FmuInstance
from .plan import Lines, Plan, Settings

# ruff: noqa: N802, N815 - fmpy's names

_MOST_EVENT_ITERATIONS = 100
_MOST_EVENTS_IN_A_STEP = 10_000
_MOST_INTERNAL_STEPS = 100_000

for _name in ("SUNLinSolFree", "SUNMatDestroy", "SUNContext_Free"):
    getattr(sundials_core, _name).argtypes = [ctypes.c_void_p]


class FMU1ModelExchange(FMU1Model):  # type: ignore[misc]
    """FMI 1.0 model exchange, which has no modes, with the methods of FMI 2.0."""

    getNominalsOfContinuousStates = FMU1Model.getNominalContinuousStates

    def setupExperiment(self, *, startTime: float, tolerance: float | None) -> None:
        """Set the time, and keep the tolerance."""
        self._tolerance = tolerance
        self.setTime(startTime)

    def enterInitializationMode(self) -> None:
        """Do nothing, as in the other modes."""

    enterEventMode = enterContinuousTimeMode = enterInitializationMode

    def exitInitializationMode(self) -> None:
        """Initialise, which is the first iteration of an event."""
        controlled = b"\x00" if self._tolerance is None else b"\x01"
        self._first = self.initialize(controlled, self._tolerance or 0.0)

    def newDiscreteStates(self) -> tuple[bool, bool, bool, bool, bool, float]:
        """Iterate once over an event."""
        converged, _, _, finished, due, time = self._first or self.eventUpdate()
        self._first = None
        return not converged, finished, False, False, due, time

    def completedIntegratorStep(self) -> tuple[bool, bool]:
        """Return whether the FMU wants an event; it cannot want to end."""
        return bool(super().completedIntegratorStep()), False

    def reset(self) -> None:
        """Refuse: FMI 1.0 model exchange cannot be reset, so that the asset makes a new instance."""
        raise FmuCallError("FMI 1.0 model exchange has no reset.")


class FMU3ModelExchange(FMU3Model):  # type: ignore[misc]
    """FMI 3.0 model exchange with the methods of FMI 2.0."""

    getDerivatives = FMU3Model.getContinuousStateDerivatives
    newDiscreteStates = FMU3Model.updateDiscreteStates


class Solver(CVodeSolver):  # type: ignore[misc]
    """Backward differentiation with root finding for one model-exchange instance.

    Parameters
    ----------
    fmu : fmpy model
        The FMU, with the methods of FMI 2.0.
    plan : Plan
        Its numbers of states and event indicators, and the relative tolerance; absolute ones are this times
        the nominal values.
    inputs : ModelExchange
        Whose `apply` sets the inputs of a moment; asked before each evaluation.
    start_time : float
        Where to begin [s].
    largest_step : float
        Limit of internal steps [s], so that an event indicator that changes sign twice is not missed for
        long.
    """

    def __init__(self, fmu: Any, plan: Plan, inputs: Any, start_time: float, largest_step: float) -> None:
        self._failure: Exception | None = None
        self._open = True

        def get_nominals(values: Any, count: int) -> None:
            fmu.getNominalsOfContinuousStates(values, count)
            for index in range(count):
                # Zero says nothing of a size, and CVODE takes no tolerance of zero for a state that is zero.
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

    # An exception that leaves a ctypes callback is printed and forgotten, and CVODE goes on with rubbish.

    def f(self, t: float, y: Any, ydot: Any, user_data: Any) -> int:
        """Return the right-hand side; 1 asks CVODE for a smaller step, -1 ends the integration."""
        return self._guarded(self._right_hand_side, t, y, ydot, user_data)

    def _right_hand_side(self, t: float, *rest: Any) -> int:
        self.input.apply(t)
        return int(super().f(t, *rest))

    def g(self, t: float, y: Any, gout: Any, user_data: Any) -> int:
        """Return the event indicators."""
        return self._guarded(super().g, t, y, gout, user_data)

    def _guarded(self, function: Callable[..., int], *arguments: Any) -> int:
        try:
            return function(*arguments)
        except (FMICallException, FmuError) as error:
            self._failure = error
            return 1 if getattr(error, "status", None) == DISCARD else -1

    def advance(self, begin: float, end: float) -> tuple[bool, float]:
        """Integrate until `end` or an event; return whether there was one, and the time reached.

        Raises
        ------
        FMICallException, FmuCallError
            If the FMU failed.
        RuntimeError
            If CVODE failed.
        """
        self._failure = None
        try:
            event, _, reached = self.step(begin, end)
        except Exception as error:
            if self._failure is not None:
                raise self._failure from error
            raise RuntimeError(self.error_info[3] if self.error_info else str(error)) from error
        return event, reached

    def close(self) -> None:
        """Free what fmpy's wrapper does not: the vectors, the matrix, the linear solver and the context."""
        if not self._open:
            return
        super().__del__()
        sundials_core.SUNLinSolFree(self.LS)
        sundials_core.SUNMatDestroy(self.A)
        N_VDestroy_Serial(self.x)
        N_VDestroy_Serial(self.abstol)
        sundials_core.SUNContext_Free(ctypes.byref(self.sunctx))
        self._open = False

    def __del__(self) -> None:
        """Leave it to `close`."""


class ModelExchange(FmuInstance):
    """A model-exchange instance with its solver.

    Inputs are held over a communication step, or move in straight lines. Where they differ from the last
    ones there is an event at the communication point, and the solver starts again there, as it does where a
    line bends; without a change it keeps its step size and order.
    """

    classes = {1: FMU1ModelExchange, 2: FMU2Model, 3: FMU3ModelExchange}  # noqa: RUF012
    _solver: Solver | None = None
    _next_event: float | None = None
    _sent: bytes | None = None

    def _start(self, start_time: float, parameters: Settings, *, with_inputs: bool) -> None:
        self._close_solver()
        super()._start(start_time, parameters, with_inputs=with_inputs)
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
                self._fmu.enterEventMode()
                self._make(self._set)
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
            self._make(self._moving)

    def _advance(self) -> None:
        begin, size = self._begin.value, self._size.value
        end = begin + size
        with self._calls(self._where()):
            solver = self._solver = self._solver or Solver(self._fmu, self._plan, self, begin, size)
            time = begin
            for _ in range(_MOST_EVENTS_IN_A_STEP):
                time = self._advance_to_event(solver, time, end, 1e-12 * size)
                if time >= end:
                    self._sent = bytes(self._values)[16:]
                    return
        where = self._where()
        raise self._lost_to(said("running.events", most=_MOST_EVENTS_IN_A_STEP, where=where, time=time))

    def _advance_to_event(self, solver: Solver, time: float, end: float, close: float) -> float:
        """Integrate to the end or to the next event, and handle that; return the time reached."""
        due = self._next_event
        target = end if due is None or due >= end - close else max(due, time)
        event = False
        if target > time + close:
            try:
                event, time = solver.advance(time, target)
            except RuntimeError as error:
                raise self._lost_to(said("running.solver", time=time, error=error)) from error
        if not event and abs(time - end) <= close:
            time = end
        self._fmu.setTime(time)
        self.apply(time)
        if self._plan.fmu.completed_step:
            wanted, finished = self._fmu.completedIntegratorStep()
            if finished:
                raise self._end(time)
            event = event or bool(wanted)
        if event or (due is not None and time >= due - close):
            self._fmu.enterEventMode()
            self._iterate_event(time)
            solver.reset(time)
        return time

    def _iterate_event(self, time: float) -> None:
        """Update the discrete states until they are settled, and go on in continuous time."""
        for _ in range(_MOST_EVENT_ITERATIONS):
            more, finished, _, _, due, following = self._fmu.newDiscreteStates()
            if finished:
                raise self._end(time)
            if not more:
                break
        else:
            raise self._lost_to(said("running.discrete", time=time, most=_MOST_EVENT_ITERATIONS))
        self._next_event = following if due and math.isfinite(following) else None
        self._fmu.enterContinuousTimeMode()

    def _lost_to(self, sentence: str) -> FmuCallError:
        """Give the instance up, and return the error that says why."""
        self.lost = True
        return FmuCallError(sentence, self._texts())

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
