"""Co-simulation of FMI 1.0, 2.0 and 3.0 through fmpy's slaves."""

import ctypes
from abc import abstractmethod
from typing import Any

from fmpy.fmi1 import FMU1Slave
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave

from fmu_asset.errors import FmuCallError

from .base import ACCEPTED, DISCARD, OK, Calls, FmuInstance
from .block import Lines, prepared
from .messages import Mailbox
from .plan import Plan, Settings

_LAST_SUCCESSFUL_TIME, _TERMINATED = 2, 3
"""Of the enumeration `fmi2StatusKind`."""


class CoSimulation(FmuInstance):
    """A co-simulation instance: a step is one call."""

    @abstractmethod
    def _further_arguments(self) -> tuple[Any, ...]:
        """Return the C values that follow communication point and step size in a call of DoStep."""

    def _ended_at(self) -> float | None:
        """Return where the FMU has ended its simulation by a step that it discarded; None if it has not."""
        return None

    def _within(self, time: float) -> float:
        """Return a time that the FMU says to have reached, within the step."""
        begin, size = self._begin.value, self._size.value
        return min(max(time, begin), begin + size)

    def _instantiate(self, plan: Plan, mailbox: Mailbox) -> Any:
        fmu = super()._instantiate(plan, mailbox)
        if not fmu.component:
            raise FmuCallError(f"{self._c_name('InstantiateSlave')} returned no instance")
        # The C functions themselves: fmpy's methods log and look up names at every call.
        self._do_step = prepared(
            self._function("DoStep", fmu),
            ctypes.c_void_p.from_param(fmu.component),
            self._begin,
            self._size,
            *self._further_arguments(),
        )
        return fmu

    def _calls_of(self, lines: Lines) -> Calls:
        name = "SetRealInputDerivatives"
        references = [number for group in self._plan.inputs if group.linear for number in group.references]
        count = len(references)
        call = prepared(
            self._function(name),
            ctypes.c_void_p.from_param(self._component),
            ctypes.byref((ctypes.c_uint * count)(*references)),
            ctypes.c_size_t.from_param(count),
            ctypes.byref((ctypes.c_int * count)(*[1] * count)),
            ctypes.byref(lines.slopes),
        )
        return [(name, call, None)]

    def _advance(self) -> None:
        status = self._do_step()
        if status not in ACCEPTED:
            if status == DISCARD and (reached := self._ended_at()) is not None:
                raise self._end(reached)
            raise self._call_error(self._c_name("DoStep"), status, self._where())


class CoSimulation1(CoSimulation):
    """FMI 1.0 co-simulation."""

    _fmpy_class = FMU1Slave

    def _made(self, plan: Plan, name: str) -> Any:
        fmu = super()._made(plan, name)
        # fmpy 0.3.32 takes what these two return for a text, and crashes when it is not 0.
        for function in ("InitializeSlave", "DoStep"):
            self._function(function, fmu).restype = ctypes.c_int  # type: ignore[attr-defined]
        return fmu

    def _further_arguments(self) -> tuple[Any, ...]:
        return (ctypes.c_char.from_param(b"\x01"),)

    def _start(self, start_time: float, parameters: Settings, *, with_inputs: bool) -> None:
        self._apply(parameters)
        if with_inputs:
            self._set_values(self._set)
        self._fmu.initialize(tStart=start_time)


class CoSimulation2(CoSimulation):
    """FMI 2.0 co-simulation."""

    _fmpy_class = FMU2Slave

    def _further_arguments(self) -> tuple[Any, ...]:
        return (ctypes.c_int.from_param(1),)

    def _ended_at(self) -> float | None:
        ended, reached = ctypes.c_int(), ctypes.c_double()
        component = self._component
        status = self._function("GetBooleanStatus")(component, _TERMINATED, ctypes.byref(ended))
        if status != OK or not ended.value:
            return None
        status = self._function("GetRealStatus")(component, _LAST_SUCCESSFUL_TIME, ctypes.byref(reached))
        # Exports of pythonfmu say of every step that they discard that they have ended where it began.
        went = status == OK and reached.value > self._begin.value
        return self._within(reached.value) if went else None


class CoSimulation3(CoSimulation):
    """FMI 3.0 co-simulation, without event mode and early return."""

    _fmpy_class = FMU3Slave

    def _further_arguments(self) -> tuple[Any, ...]:
        self._event, self._terminate, self._early = (ctypes.c_bool() for _ in range(3))
        self._reached = ctypes.c_double()
        told = (self._event, self._terminate, self._early, self._reached)
        return (ctypes.c_bool.from_param(True), *(ctypes.byref(value) for value in told))

    def _advance(self) -> None:
        # Outputs of a call that an FMU need not set.
        self._terminate.value = self._early.value = False
        self._reached.value = self._begin.value + self._size.value
        super()._advance()
        if self._terminate.value:
            raise self._end(self._within(self._reached.value))
        if self._early.value:
            self._lost = True
            raise FmuCallError(
                f"The FMU returned early, at t = {self._reached.value:g} s, in {self._where()}, though it "
                "was told that this is not supported; try a smaller step_size in the binding.",
                self._texts(),
            )
