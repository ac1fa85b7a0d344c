"""Co-simulation of FMI 1.0, 2.0 and 3.0 through fmpy's slaves."""

import ctypes
from typing import Any

from fmpy.fmi1 import FMU1Slave
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave

from fmu_asset.errors import FmuCallError
from fmu_asset.sentences import said

from .base import ACCEPTED, DISCARD, OK, Calls, FmuInstance
from .plan import Lines, Plan

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

    def setupExperiment(self, *, startTime: float, tolerance: float | None) -> None:
        """Keep the start time."""
        self._start_time = startTime

    def enterInitializationMode(self) -> None:
        """Do nothing: FMI 1.0 has no modes."""

    def exitInitializationMode(self) -> None:
        """Initialise."""
        self.initialize(tStart=self._start_time)


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

    def _calls_of(self, lines: Lines) -> Calls:
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
