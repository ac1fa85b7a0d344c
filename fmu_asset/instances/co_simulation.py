"""Co-simulation of FMI 1.0, 2.0 and 3.0 through fmpy's slaves."""

# ruff: noqa: N802 - methods and arguments have fmpy's names

import ctypes

from fmpy.fmi1 import FMU1Slave
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave

from fmu_asset.errors import FmuCallError

from .base import FmiCall, FmuInstance
from .plan import LinearInputs, Plan
from .statuses import ACCEPTED, DISCARD, OK

_LAST_SUCCESSFUL_TIME = 2
"""Value of the C enumeration `fmi2StatusKind`: the time at which a discarded step ended."""
_TERMINATED = 3
"""Value of the C enumeration `fmi2StatusKind`: whether the FMU has ended its simulation."""


class FMU1CoSimulation(FMU1Slave):  # type: ignore[misc]
    """FMI 1.0 co-simulation with the methods of FMI 2.0."""

    def __init__(self, **arguments: object) -> None:
        super().__init__(**arguments)
        # fmpy 0.3.32 takes what these two return for a text, and crashes when it is not 0
        for name in ("InitializeSlave", "DoStep"):
            function = getattr(self.dll, f"{self.modelIdentifier}_fmi{name}")
            function.restype = ctypes.c_int

    def setupExperiment(
        self, *, startTime: float, stopTime: float | None, tolerance: float | None
    ) -> None:
        """Store start and end of the experiment until the initialisation."""
        self._start_time = startTime
        self._stop_time = stopTime

    def enterInitializationMode(self) -> None:
        """Do nothing: FMI 1.0 has no modes."""

    def exitInitializationMode(self) -> None:
        """Initialise the FMU."""
        self.initialize(tStart=self._start_time, stopTime=self._stop_time)


class CoSimulation(FmuInstance):
    """A co-simulation instance: each step is one call of the FMU.

    In FMI 3.0 neither event mode nor early return is used.
    """

    classes = {1: FMU1CoSimulation, 2: FMU2Slave, 3: FMU3Slave}  # noqa: RUF012

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan)
        # outputs of doStep in FMI 3
        self._event_needed = ctypes.c_bool()
        self._terminated = ctypes.c_bool()
        self._returned_early = ctypes.c_bool()
        self._reached_time = ctypes.c_double()
        # call the C function directly, since fmpy's method logs and looks up names at every call
        self._do_step_call = self._prepared_call(
            "DoStep", self._step_begin, self._step_size, *self._further_arguments()
        )

    def _further_arguments(self) -> tuple[object, ...]:
        """Return the arguments of the C function doStep after time and step size, by version."""
        if self._version == 1:
            return (ctypes.c_char.from_param(b"\x01"),)  # newStep
        if self._version == 2:
            return (ctypes.c_int.from_param(1),)  # noSetFMUStatePriorToCurrentPoint
        return (
            ctypes.c_bool.from_param(True),  # noSetFMUStatePriorToCurrentPoint
            ctypes.byref(self._event_needed),
            ctypes.byref(self._terminated),
            ctypes.byref(self._returned_early),
            ctypes.byref(self._reached_time),
        )

    def _interpolation_calls(self, linear_inputs: LinearInputs) -> list[FmiCall]:
        """Return the call that sets the first derivatives of the linear inputs."""
        references: list[int] = []
        for group in self._plan.inputs:
            if group.linear:
                references += group.references
        count = len(references)
        first_order = [1] * count
        function = "SetRealInputDerivatives"
        call = self._prepared_call(
            function,
            ctypes.byref((ctypes.c_uint * count)(*references)),
            ctypes.c_size_t.from_param(count),
            ctypes.byref((ctypes.c_int * count)(*first_order)),
            ctypes.byref(linear_inputs.slopes),
        )
        return [FmiCall(function, call)]

    def _do_step(self) -> None:
        """Make one communication step."""
        # an FMU need not set these outputs, and FMI 1 and 2 have none
        self._terminated.value = False
        self._returned_early.value = False
        self._reached_time.value = self._step_begin.value + self._step_size.value
        status = self._do_step_call()
        if status not in ACCEPTED:
            self._raise_ended_if_terminated(status)
            raise self._call_error(f"{self._prefix}DoStep", status, self._step_label())
        if self._terminated.value:
            raise self._ended_error(self._limited_to_step(self._reached_time.value))
        if self._returned_early.value:
            self.lost = True
            raise FmuCallError(
                f"The FMU returned early, at t = {self._reached_time.value:g} s, in "
                f"{self._step_label()}, although early returns are not allowed; try a smaller "
                "step_size in the binding.",
                self._last_messages(),
            )

    def _limited_to_step(self, time: float) -> float:
        """Return a time [s] that the FMU reports, limited to the present step."""
        begin = self._step_begin.value
        return min(max(time, begin), begin + self._step_size.value)

    def _raise_ended_if_terminated(self, status: int) -> None:
        """Raise an error if a step was discarded because the FMU ended its simulation.

        FMI 2 reports the end of a simulation in this way; the details must be queried.
        """
        if status != DISCARD or self._version != 2:
            return
        terminated = ctypes.c_int()
        reached_time = ctypes.c_double()
        dll = self._fmu.dll
        component = self._fmu.component
        query_status = dll.fmi2GetBooleanStatus(component, _TERMINATED, ctypes.byref(terminated))
        if query_status != OK or not terminated.value:
            return
        query_status = dll.fmi2GetRealStatus(
            component, _LAST_SUCCESSFUL_TIME, ctypes.byref(reached_time)
        )
        # FMUs of pythonfmu claim at every discarded step that they ended at its beginning
        if query_status == OK and reached_time.value > self._step_begin.value:
            raise self._ended_error(self._limited_to_step(reached_time.value))
