"""One instance of an FMU in this process: one batched set and get per step, whatever the FMI version.

The worker process runs this; `FmiAsset` runs it directly when it is told not to isolate.
"""

import ctypes
import itertools
import os
import sys
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import chdir, contextmanager
from typing import Any, ClassVar

from fmpy import calloc, fmi1, fmi2, free
from fmpy.fmi1 import FMICallException
from fmpy.logging import addLoggerProxy

from fmu_asset.errors import (
    FmuCallError,
    FmuEndedError,
    FmuError,
    FmuStateError,
    FmuWorkerError,
    said,
    visible,
)

from .plan import Instance, LinearInputs, Plan, Settings, VariableGroup, exchanged, prepared

STATUS_NAMES = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")
OK, WARNING, DISCARD, ERROR, FATAL, PENDING = range(6)
ACCEPTED = frozenset({OK, WARNING})
_MESSAGES_IN_ERROR = 10
_NO_STOP_TIME = (
    ". It was told no end of the experiment: if it asks for one, give `stop_time` in the table [binding] of "
    "its binding"
)

Calls = list[tuple[str, Callable[[], int], Callable[[], object] | None]]
"""Name of the function, the prepared call, and what converts the values before or after it, if needed."""


# ---------------------------------------------------------------------- what FMUs log

_LONGEST_LOG = 1000

# fmpy's native proxy, which formats the messages of C FMUs, knows one logger in a process.
_logging: "dict[bytes, FmuInstance]" = {}
_instance_numbers = itertools.count(1)


def _log(_: object, instance_name: bytes, status: int, category: bytes, message: bytes) -> None:
    instance = _logging.get(instance_name or b"")
    if instance is not None:
        instance.log(None, status, category, message)


_MODULES = {1: fmi1, 2: fmi2}
_LOGGERS = {1: fmi1.fmi1CallbackLoggerTYPE(_log), 2: fmi2.fmi2CallbackLoggerTYPE(_log)}


def callbacks(fmi_version: int) -> Any:
    """Return new callbacks for FMI 1 or 2, whose logger knows all instances."""
    module, name = _MODULES[fmi_version], f"fmi{fmi_version}Callback"
    given = getattr(module, f"{name}Functions")()  # what is not said, such as `stepFinished`, is none
    given.logger = _LOGGERS[fmi_version]
    given.allocateMemory = getattr(module, f"{name}AllocateMemoryTYPE")(calloc)
    given.freeMemory = getattr(module, f"{name}FreeMemoryTYPE")(free)
    addLoggerProxy(ctypes.byref(given))
    return given


# ---------------------------------------------------------------------- an instance


class FmuInstance(Instance):
    """One instance in this process; subclasses speak the interfaces, and the table of classes the versions.

    Parameters
    ----------
    plan : Plan
        What is exchanged.

    Attributes
    ----------
    messages : deque of (int, str)
        The last ones that the FMU has logged and nobody has taken yet: status and text.

    Raises
    ------
    FmuCallError
        If the binary cannot be loaded or the instance cannot be made.
    """

    # Wherever the FMU or fmpy goes, `chdir(".")` comes back to the working directory.

    classes: ClassVar[dict[int, type[Any]]]
    """fmpy's class for each FMI version: that of FMI 2, or one with its methods."""

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan)
        # Communication point and step size of a step, where they stand in the request.
        self._begin = ctypes.c_double.from_buffer(self.request, 0)
        self._size = ctypes.c_double.from_buffer(self.request, 8)
        self._plan, self._version = plan, plan.fmu.major_version
        self._prefix = "fmi" if self._version == 1 else f"fmi{self._version}"
        self._lines = LinearInputs(self.request, plan) if plan.linear_count else None
        self._name = f"{plan.instance_name}-{os.getpid()}-{next(_instance_numbers)}"
        self.messages: deque[tuple[int, str]] = deque(maxlen=_LONGEST_LOG)
        self._errors = 0
        _logging[self._name.encode()] = self
        self._ended: float | None = None
        self._phase = "instantiated"
        with chdir("."):
            try:
                self._fmu = self._instantiated()
            except Exception as error:
                _logging.pop(self._name.encode())
                raise FmuCallError(_why_not_instantiated(error), self._texts()) from error
        for function in vars(self._fmu.dll).values():
            # fmpy lets negative statuses pass.
            if getattr(function, "restype", None) is ctypes.c_int:
                function.errcheck = _refuse_negative
        self._values = self.request if self._lines is None else self._lines.values
        self._set = self._blocks("Set", plan.inputs, self._values, 2)
        self._get = self._blocks("Get", plan.outputs, self.reply, 0)
        self._moving = [] if self._lines is None else self._calls_of(self._lines)

    def _instantiated(self) -> Any:
        """Return fmpy's object, instantiated."""
        plan = self._plan
        fmu = self.classes[self._version](
            guid=plan.fmu.guid,
            modelIdentifier=plan.fmu.model_identifier,
            unzipDirectory=plan.folder,
            instanceName=self._name,
        )
        if self._version == 3:
            fmu.instantiate(loggingOn=True, logMessage=self.log)
        else:
            given = {"functions" if self._version == 1 else "callbacks": callbacks(self._version)}
            fmu.instantiate(loggingOn=True, **given)
        if not fmu.component:
            raise RuntimeError("no instance was returned")
        return fmu

    # ------------------------------------------------------------------ what an interface says

    def _start(self, start_time: float, parameters: Settings, *, with_inputs: bool) -> None:
        """Bring the instance to its first communication point."""
        fmu = self._fmu
        experiment = {
            "startTime": start_time,
            "stopTime": self._plan.stop_time,
            "tolerance": self._plan.tolerance,
        }
        if self._version < 3:
            fmu.setupExperiment(**experiment)
        if self._plan.configuration:
            fmu.enterConfigurationMode()
            self._apply(self._plan.configuration)
            fmu.exitConfigurationMode()
        self._apply(parameters)
        fmu.enterInitializationMode(**(experiment if self._version == 3 else {}))
        if with_inputs:
            self._make(self._set)
        fmu.exitInitializationMode()

    @abstractmethod
    def _advance(self) -> None:
        """Make one communication step from `_begin` over `_size`; the inputs are set."""

    @abstractmethod
    def _calls_of(self, lines: LinearInputs) -> Calls:
        """Return what makes inputs move: calls that tell how fast, or that set them again."""

    def _send(self) -> None:
        """Set the inputs of the request block."""
        if self._lines is not None:
            self._lines.aim()
        self._make(self._set + self._moving)

    def _follow(self, lines: LinearInputs) -> None:
        """Set the inputs where their lines are at a later communication point of the step."""
        lines.move(self._begin.value)
        self._make(self._set + self._moving)

    def _free(self) -> None:
        """Terminate and free the instance."""
        if self._phase == "stepping":
            try:
                self._fmu.terminate()
            except FMICallException as error:
                if error.status == FATAL:
                    return
        self._fmu.freeInstance()

    # ------------------------------------------------------------------ what the twin asks; see `Instance`

    def initialise(self, start_time: float, parameters: Settings, with_inputs: bool) -> None:
        """Set parameters, and inputs if wanted, and go to the first communication point."""
        errors = self._errors
        if self._lines is not None:
            self._lines.stand()
        with self._calls("initialisation"):
            self._start(start_time, parameters, with_inputs=with_inputs)
            self._phase = "stepping"
        if self._errors > errors:
            hint = "" if self._plan.stop_time is not None else _NO_STOP_TIME
            raise FmuCallError(f"The FMU refused its initialisation{hint}.", self._texts())

    def step(self) -> None:
        """Make the step that the request block describes."""
        if self.lost:
            raise FmuWorkerError("The instance was lost to a fatal error; reset the asset to go on.")
        if self._ended is not None:
            raise FmuEndedError(said("running.ended", time=self._ended), time=self._ended)
        self._send()
        if self._plan.substeps == 1:
            self._advance()
        else:
            self._advance_many()
        self._make(self._get, "reading outputs")

    def _advance_many(self) -> None:
        first, size = self._begin.value, self._size.value
        number = 0
        try:
            for number in range(self._plan.substeps):
                self._begin.value = first + number * size
                if number and self._lines is not None:
                    self._follow(self._lines)
                self._advance()
        except FmuError as error:
            if number == 0 or isinstance(error, FmuEndedError):
                raise
            # Between two observations it cannot go back to the last one.
            self.lost = True
            why = said("running.substep", error=error, number=number + 1, of=self._plan)
            raise type(error)(why, error.messages) from error
        finally:
            self._begin.value = first  # the request is the caller's, and what a later start is compared by

    def read(self) -> None:
        """Read the outputs of this moment into the reply block."""
        with self._calls("reading the outputs"):
            self._make(self._get, "reading outputs")

    def save(self) -> bytes:
        """Return the serialised FMU state."""
        fmu = self._fmu
        with self._calls("saving the state"):
            state = fmu.getFMUState()
            try:
                return bytes(fmu.serializeFMUState(state))
            finally:
                fmu.freeFMUState(state)

    def restore(self, content: bytes) -> None:
        """Restore a serialised FMU state."""
        fmu, errors = self._fmu, self._errors
        with self._calls("restoring the state"):
            state = fmu.deserializeFMUState(content)
            try:
                fmu.setFMUState(state)
            finally:
                fmu.freeFMUState(state)
        self._ended = None
        if self._errors > errors:
            raise FmuStateError("The FMU refused the state.", self._texts())

    def reset(self) -> None:
        """Bring the instance back to the moment after its instantiation."""
        with self._calls("reset"):
            if self._phase == "stepping":
                self._fmu.terminate()
            self._fmu.reset()
            self._phase, self._ended = "instantiated", None

    def log(self, _: object, status: int, category: bytes, message: bytes) -> None:
        """Take a message of the FMU."""
        self._errors += status in (ERROR, FATAL)
        text = (message or b"").decode("utf-8", "replace").rstrip()
        self.messages.append((int(status), visible(text)))

    def take_log(self) -> list[tuple[int, str]]:
        """Return and forget the messages that the FMU has logged: status and text."""
        messages = list(self.messages)
        self.messages.clear()
        return messages

    def close(self) -> None:
        """Free the instance; one that was lost to a fatal error is left alone, since freeing it can crash."""
        _logging.pop(self._name.encode(), None)
        if self.lost:
            return
        self.lost = True
        with chdir("."):
            self._free()

    # ------------------------------------------------------------------ inside

    def _prepared(self, name: str, *arguments: Any) -> Callable[[], int]:
        """Return a call of a C function of the instance such as SetReal, with C values."""
        before = f"{self._plan.fmu.model_identifier}_" if self._version == 1 else ""
        function = getattr(self._fmu.dll, before + self._prefix + name)
        return prepared(function, ctypes.c_void_p.from_param(self._fmu.component), *arguments)

    def _blocks(self, verb: str, groups: tuple[VariableGroup, ...], doubles: Any, begin: int) -> Calls:
        calls: Calls = []
        for group in groups:
            arguments, convert = exchanged(self._version, group, doubles, begin, sent=verb == "Set")
            calls.append((verb + group.kind, self._prepared(verb + group.kind, *arguments), convert))
            begin += group.count
        return calls

    def _apply(self, parameters: Settings) -> None:
        for kind, reference, values in parameters:
            if kind == "String":
                self._fmu.setString([reference], values)
                continue
            doubles = (ctypes.c_double * len(values))(*map(float, values))
            self._make(self._blocks("Set", (VariableGroup(kind, (reference,), len(values)),), doubles, 0))

    def _make(self, calls: Calls, what: str = "setting inputs") -> None:
        """Make calls that set values, with the conversion before, or that read them."""
        for name, call, convert in calls:
            if convert is not None and name[0] == "S":
                convert()
            status = call()
            if status not in ACCEPTED:
                raise self._call_error(self._prefix + name, status, what)
            if convert is not None and name[0] == "G":
                convert()

    def _end(self, time: float) -> FmuEndedError:
        """Take note that the FMU has ended its simulation, and return the error that says so."""
        self._ended = time
        return FmuEndedError(
            f"The FMU asked to end the simulation in {self._where()}, and ended at t = {time:g} s.",
            self._texts(),
            time,
        )

    def _where(self) -> str:
        """Return which step is made, for an error."""
        return f"the step from t = {self._begin.value:g} s"

    @contextmanager
    def _calls(self, what: str) -> Iterator[None]:
        if self.lost:
            raise FmuWorkerError("The instance was lost to a fatal error; reset the asset to go on.")
        with chdir("."):
            try:
                yield
            except FMICallException as error:
                raise self._call_error(str(error.function), int(error.status), what) from error

    def _call_error(self, function: str, status: int, what: str) -> FmuCallError:
        # What the standard still allows after an error is not worth the trouble: another instance is made.
        self.lost = self.lost or status != DISCARD
        after = {
            DISCARD: "the FMU did not accept it and stays where it was; try other inputs or a smaller step",
            ERROR: "its values are no longer to be trusted; reset the asset or restore a state",
            PENDING: "asynchronous steps are not supported; export it to step synchronously",
        }.get(status, "the instance is lost; reset the asset or restore a state")
        if what == "initialisation" and self._plan.stop_time is None:
            after += _NO_STOP_TIME
        return FmuCallError(f"{function} returned {status_name(status)} in {what}: {after}.", self._texts())

    def _texts(self) -> list[str]:
        return [text for _, text in self.take_log()][-_MESSAGES_IN_ERROR:]


def status_name(status: int) -> str:
    """Return what FMI calls a status."""
    return STATUS_NAMES[status] if 0 <= status < len(STATUS_NAMES) else str(status)


def _refuse_negative(status: int, function: Any, arguments: tuple[Any, ...]) -> int:
    """Check what a C function that fmpy calls has returned."""
    if status < 0:
        raise FMICallException(function=function.__name__, status=status)
    return status


def _why_not_instantiated(error: Exception) -> str:
    text = " ".join(str(error).split())
    text = text.rpartition(".so: ")[2].removesuffix(".")  # without our folder
    if "shared library" in str(error):
        return (
            f"The FMU's binary cannot be loaded on this machine ({text}); it was built for another processor "
            "or system, or it needs a library that is not installed."
        )
    if "undefined symbol" in text:
        return f"The FMU's binary lacks a function that its FMI version requires ({text}); export it again."
    return f"The FMU could not be instantiated ({text})."


def forget_modules(folder: str) -> None:
    """Take what an FMU in Python has imported from its folder out of this process.

    Otherwise the next FMU with a module of the same name, or the caller, would be given that module, and the
    folder is about to be removed. Instances that still run keep what they have.
    """
    inside = folder.rstrip(os.sep) + os.sep
    sys.path[:] = [entry for entry in sys.path if not (entry + os.sep).startswith(inside)]
    # A copy is one step, unlike a list of items: other threads import too.
    for name, module in sys.modules.copy().items():
        if str(getattr(module, "__file__", None) or "").startswith(inside):
            sys.modules.pop(name, None)
