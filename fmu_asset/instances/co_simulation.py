"""Co-simulation of FMI 1.0, 2.0 and 3.0 through fmpy's slaves."""

import ctypes
from collections.abc import Callable
from typing import Any

from fmpy.fmi1 import FMU1Slave
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave

from fmu_asset.errors import FmuCallError

from .base import ACCEPTED, FmuInstance
from .messages import Mailbox, callbacks
from .plan import Plan, Settings
from .prepared import prepared


def slave_arguments(plan: Plan, mailbox: Mailbox) -> dict[str, str]:
    """Return what fmpy's classes are constructed with."""
    return {
        "guid": plan.guid,
        "modelIdentifier": plan.model_identifier,
        "unzipDirectory": plan.folder,
        "instanceName": mailbox.name,
    }


class CoSimulation1(FmuInstance):
    """FMI 1.0 co-simulation."""

    def _instantiate(self, plan: Plan, mailbox: Mailbox) -> Any:
        fmu = FMU1Slave(**slave_arguments(plan, mailbox))
        # fmpy 0.3.32 takes what these two return for a text, and crashes when it is not 0.
        for name in ("fmiInitializeSlave", "fmiDoStep"):
            getattr(fmu.dll, f"{plan.model_identifier}_{name}").restype = ctypes.c_int
        fmu.instantiate(functions=callbacks(1), loggingOn=True)
        if not fmu.component:
            raise FmuCallError("fmiInstantiateSlave returned no instance")
        self._do_step = prepared(
            getattr(fmu.dll, f"{plan.model_identifier}_fmiDoStep"),
            ctypes.c_void_p.from_param(fmu.component),
            self._begin,
            self._size,
            ctypes.c_char.from_param(b"\x01"),
        )
        return fmu

    def _function(self, name: str) -> Callable[..., int]:
        function: Callable[..., int] = getattr(self._fmu.dll, f"{self._plan.model_identifier}_fmi{name}")
        return function

    def _initialise(self, start_time: float, parameters: Settings, *, with_inputs: bool) -> None:
        self._apply(parameters)
        if with_inputs:
            self._send()
        self._fmu.initialize(tStart=start_time)

    def _advance(self) -> None:
        status = self._do_step()
        if status not in ACCEPTED:
            raise self._call_error("fmiDoStep", status, self._where())


class CoSimulation2(FmuInstance):
    """FMI 2.0 co-simulation."""

    def _instantiate(self, plan: Plan, mailbox: Mailbox) -> Any:
        fmu = FMU2Slave(**slave_arguments(plan, mailbox))
        fmu.instantiate(callbacks=callbacks(2), loggingOn=True)
        # The C functions themselves: fmpy's methods log and look up names at every call.
        self._do_step = prepared(
            fmu.dll.fmi2DoStep,
            ctypes.c_void_p.from_param(fmu.component),
            self._begin,
            self._size,
            ctypes.c_int.from_param(1),
        )
        return fmu

    def _function(self, name: str) -> Callable[..., int]:
        function: Callable[..., int] = getattr(self._fmu.dll, f"fmi2{name}")
        return function

    def _initialise(self, start_time: float, parameters: Settings, *, with_inputs: bool) -> None:
        fmu = self._fmu
        fmu.setupExperiment(startTime=start_time, tolerance=self._plan.tolerance)
        self._apply(parameters)
        fmu.enterInitializationMode()
        if with_inputs:
            self._send()
        fmu.exitInitializationMode()

    def _advance(self) -> None:
        status = self._do_step()
        if status not in ACCEPTED:
            raise self._call_error("fmi2DoStep", status, self._where())


class CoSimulation3(FmuInstance):
    """FMI 3.0 co-simulation, without event mode and early return."""

    def _instantiate(self, plan: Plan, mailbox: Mailbox) -> Any:
        fmu = FMU3Slave(**slave_arguments(plan, mailbox))
        fmu.instantiate(loggingOn=True, logMessage=mailbox.log)
        self._event, self._terminate, self._early = (ctypes.c_bool() for _ in range(3))
        self._reached = ctypes.c_double()
        self._do_step = prepared(
            fmu.dll.fmi3DoStep,
            ctypes.c_void_p.from_param(fmu.component),
            self._begin,
            self._size,
            ctypes.c_bool.from_param(True),
            *(ctypes.byref(flag) for flag in (self._event, self._terminate, self._early, self._reached)),
        )
        return fmu

    def _function(self, name: str) -> Callable[..., int]:
        function: Callable[..., int] = getattr(self._fmu.dll, f"fmi3{name}")
        return function

    def _initialise(self, start_time: float, parameters: Settings, *, with_inputs: bool) -> None:
        self._apply(parameters)
        self._fmu.enterInitializationMode(tolerance=self._plan.tolerance, startTime=start_time)
        if with_inputs:
            self._send()
        self._fmu.exitInitializationMode()

    def _advance(self) -> None:
        # Outputs of a call that an FMU need not set.
        self._terminate.value = self._early.value = False
        status = self._do_step()
        if status not in ACCEPTED:
            raise self._call_error("fmi3DoStep", status, self._where())
        if self._terminate.value:
            raise FmuCallError(f"The FMU asked to end the simulation in {self._where()}.", self._texts())
        if self._early.value:
            self._lost = True
            raise FmuCallError(
                f"The FMU returned early, at t = {self._reached.value:g} s, in {self._where()}, though it "
                "was told that this is not supported; try a smaller step_size in the binding.",
                self._texts(),
            )
