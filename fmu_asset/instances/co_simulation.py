"""Co-simulation of FMI 1.0, 2.0 and 3.0 through fmpy's slaves, and model exchange as if it were that.

Models of model exchange are solved by SUNDIALS CVODE. The solver is fmpy's, with the failures and the memory
that its wrapper lets slip.
"""

import ctypes
import math
from collections.abc import Callable
from typing import Any

from fmpy.fmi1 import FMICallException, FMU1Model, FMU1Slave
from fmpy.fmi2 import FMU2Model, FMU2Slave
from fmpy.fmi3 import FMU3Model, FMU3Slave
from fmpy.sundials import CVodeSolver
from fmpy.sundials.libraries import sundials_core
from fmpy.sundials.nvector_serial import N_VDestroy_Serial

from fmu_asset.errors import FmuCallError, FmuError, said

from .base import ACCEPTED, DISCARD, OK, Calls, FmuInstance
from .plan import LinearInputs, Plan, Settings

_LAST_SUCCESSFUL_TIME, _TERMINATED = 2, 3
"""Of the enumeration `fmi2StatusKind`."""


class FMU1CoSimulation(FMU1Slave):  # type: ignore[misc]
    """FMI 1.0 co-simulation with the methods of FMI 2.0."""

    # ruff: noqa: N802 - fmpy's names

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        # fmpy 0.3.32 takes what these two return for a text, and crashes when it is not 0.
        for name in ("InitializeSlave", "DoStep"):
            getattr(self.dll, f"{self.modelIdentifier}_fmi{name}").restype = ctypes.c_int

    def setupExperiment(self, *, startTime: float, stopTime: float | None, tolerance: float | None) -> None:
        """Keep start and end of the experiment until the initialisation."""
        self._start_time = startTime
        self._stop_time = stopTime

    def enterInitializationMode(self) -> None:
        """Do nothing: FMI 1.0 has no modes."""

    def exitInitializationMode(self) -> None:
        """Initialise."""
        self.initialize(tStart=self._start_time, stopTime=self._stop_time)


class CoSimulation(FmuInstance):
    """A co-simulation instance: a step is one call, in FMI 3.0 without event mode and early return."""

    classes = {1: FMU1CoSimulation, 2: FMU2Slave, 3: FMU3Slave}  # noqa: RUF012

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan)
        self._event, self._terminate, self._early = (ctypes.c_bool() for _ in range(3))
        self._reached = ctypes.c_double()
        told = (self._event, self._terminate, self._early, self._reached)
        further = {
            1: (ctypes.c_char.from_param(b"\x01"),),
            2: (ctypes.c_int.from_param(1),),
            3: (ctypes.c_bool.from_param(True), *(ctypes.byref(value) for value in told)),
        }
        # The C functions themselves: fmpy's methods log and look up names at every call.
        self._do_step = self._prepared("DoStep", self._begin, self._size, *further[self._version])

    def _calls_of(self, lines: LinearInputs) -> Calls:
        name = "SetRealInputDerivatives"
        references = [number for group in self._plan.inputs if group.linear for number in group.references]
        count = len(references)
        call = self._prepared(
            name,
            ctypes.byref((ctypes.c_uint * count)(*references)),
            ctypes.c_size_t.from_param(count),
            ctypes.byref((ctypes.c_int * count)(*[1] * count)),
            ctypes.byref(lines.slopes),
        )
        return [(name, call, None)]

    def _advance(self) -> None:
        # Outputs of a call that an FMU need not set, and that one of FMI 1 or 2 does not have.
        self._terminate.value = self._early.value = False
        self._reached.value = self._begin.value + self._size.value
        status = self._do_step()
        if status not in ACCEPTED:
            if status == DISCARD and self._version == 2 and (reached := self._ended_at()) is not None:
                raise self._end(reached)
            raise self._call_error(f"{self._prefix}DoStep", status, self._where())
        if self._terminate.value:
            raise self._end(self._within(self._reached.value))
        if self._early.value:
            self.lost = True
            why = said("running.early", time=self._reached.value, where=self._where())
            raise FmuCallError(why, self._texts())

    def _within(self, time: float) -> float:
        """Return a time that the FMU says to have reached, within the step."""
        begin, size = self._begin.value, self._size.value
        return min(max(time, begin), begin + size)

    def _ended_at(self) -> float | None:
        """Return where an FMU of FMI 2 has ended its simulation by a step that it discarded, if it has."""
        ended, reached = ctypes.c_int(), ctypes.c_double()
        dll, component = self._fmu.dll, self._fmu.component
        status = dll.fmi2GetBooleanStatus(component, _TERMINATED, ctypes.byref(ended))
        if status != OK or not ended.value:
            return None
        status = dll.fmi2GetRealStatus(component, _LAST_SUCCESSFUL_TIME, ctypes.byref(reached))
        # Exports of pythonfmu say of every step that they discard that they have ended where it began.
        went = status == OK and reached.value > self._begin.value
        return self._within(reached.value) if went else None


# ruff: noqa: N802, N815 - fmpy's names

_MOST_EVENT_ITERATIONS = 100
_MOST_EVENTS_IN_A_STEP = 10_000
_MOST_INTERNAL_STEPS = 100_000

for _name in ("SUNLinSolFree", "SUNMatDestroy", "SUNContext_Free"):
    getattr(sundials_core, _name).argtypes = [ctypes.c_void_p]


class FMU1ModelExchange(FMU1Model):  # type: ignore[misc]
    """FMI 1.0 model exchange, which has no modes, with the methods of FMI 2.0."""

    getNominalsOfContinuousStates = FMU1Model.getNominalContinuousStates

    def setupExperiment(self, *, startTime: float, stopTime: float | None, tolerance: float | None) -> None:
        """Set the time, and keep the tolerance; this interface is told no end."""
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

    def _calls_of(self, lines: LinearInputs) -> Calls:
        return self._blocks("Set", tuple(g for g in self._plan.inputs if g.linear), self._values, 2)

    def _follow(self, lines: LinearInputs) -> None:
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


def open_instance(plan: Plan) -> FmuInstance:
    """Return a new instance of the plan's FMI version and interface.

    Raises
    ------
    FmuCallError
        If the binary cannot be loaded or the instance cannot be made.
    """
    return (ModelExchange if plan.fmu.interface == "model-exchange" else CoSimulation)(plan)
