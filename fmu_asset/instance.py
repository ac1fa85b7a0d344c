"""One instance of an FMU in this process: fmpy's `FMU2Slave`, one batched set and get per step.

The worker process runs this; `FmiAsset` runs it directly when it is told not to isolate. Values travel in two
blocks of doubles that are allocated once: `request` is time, step size, then all inputs; `reply` is all
outputs. Integers and Booleans are doubles in the blocks.
"""

from __future__ import annotations

import ctypes
import itertools
import os
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fmpy import calloc, free
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import (
    FMU2Slave,
    fmi2CallbackAllocateMemoryTYPE,
    fmi2CallbackFreeMemoryTYPE,
    fmi2CallbackFunctions,
    fmi2CallbackLoggerTYPE,
)
from fmpy.logging import addLoggerProxy

from .errors import FmuCallError, FmuStateError, FmuWorkerError

STATUS_NAMES = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")
_WARNING, _DISCARD, _ERROR, _FATAL = 1, 2, 3, 4
_LONGEST_LOG = 1000
_MESSAGES_IN_ERROR = 10

Settings = list[tuple[str, int, float]]
"""Base type (Real, Integer or Boolean), value reference, value."""


@dataclass(frozen=True)
class Plan:
    """What an instance exchanges: plain values, sent to a worker as JSON.

    Attributes
    ----------
    folder : str
        Where the FMU is extracted.
    guid, model_identifier, instance_name : str
        As FMI wants them.
    real_inputs, integer_inputs, boolean_inputs : list of int
        Value references of what is set at every step, in the order of the request block.
    real_outputs, integer_outputs, boolean_outputs : list of int
        Value references of what is read at every step, in the order of the reply block.
    """

    folder: str
    guid: str
    model_identifier: str
    instance_name: str
    real_inputs: list[int]
    integer_inputs: list[int]
    boolean_inputs: list[int]
    real_outputs: list[int]
    integer_outputs: list[int]
    boolean_outputs: list[int]

    @property
    def input_count(self) -> int:
        """Number of inputs."""
        return len(self.real_inputs) + len(self.integer_inputs) + len(self.boolean_inputs)

    @property
    def output_count(self) -> int:
        """Number of outputs."""
        return len(self.real_outputs) + len(self.integer_outputs) + len(self.boolean_outputs)


# fmpy's native proxy, which formats the messages of C FMUs, knows one logger in a process. This one gives
# every message to the instance whose name it carries.
_listeners: dict[bytes, deque[tuple[int, str]]] = {}
_instance_numbers = itertools.count(1)


def _log(_: object, instance_name: bytes, status: int, category: bytes, message: bytes) -> None:
    listener = _listeners.get(instance_name or b"")
    if listener is not None:
        listener.append((int(status), (message or b"").decode("utf-8", "replace").rstrip()))


_LOGGER = fmi2CallbackLoggerTYPE(_log)


def _callbacks() -> Any:
    callbacks = fmi2CallbackFunctions()
    callbacks.logger = _LOGGER
    callbacks.allocateMemory = fmi2CallbackAllocateMemoryTYPE(calloc)
    callbacks.freeMemory = fmi2CallbackFreeMemoryTYPE(free)
    addLoggerProxy(ctypes.byref(callbacks))
    return callbacks


class Block:
    """A part of a block of doubles that is exchanged with the FMU in one call of one base type."""

    def __init__(self, references: Sequence[int], doubles: Any, begin: int, kind: Any) -> None:
        count = len(references)
        self.count = count
        self.references = (ctypes.c_uint * count)(*references)
        self._doubles, self._begin = doubles, begin
        self.real = kind is ctypes.c_double
        if self.real and count:
            self.values = (kind * count).from_buffer(doubles, 8 * begin)
        else:
            self.values = (kind * count)()

    def to_fmu(self) -> None:
        """Convert the doubles for the FMU; reals need none of it, since they are the block itself."""
        for index in range(self.count):
            self.values[index] = int(self._doubles[self._begin + index])

    def from_fmu(self) -> None:
        """Convert what the FMU gave to doubles; reals need none of it."""
        for index in range(self.count):
            self._doubles[self._begin + index] = float(self.values[index])


class FmuInstance:
    """One FMI 2.0 co-simulation instance.

    Parameters
    ----------
    plan : Plan
        What is exchanged.

    Attributes
    ----------
    request, reply : ctypes array of double
        The blocks; see the module.

    Raises
    ------
    FmuCallError
        If the binary cannot be loaded or the instance cannot be made.
    """

    def __init__(self, plan: Plan) -> None:
        self.request = (ctypes.c_double * (2 + plan.input_count))()
        self.reply = (ctypes.c_double * max(plan.output_count, 1))()
        # Unique in the process, so that log messages find their instance.
        name = f"{plan.instance_name}-{os.getpid()}-{next(_instance_numbers)}"
        self._listener: deque[tuple[int, str]] = deque(maxlen=_LONGEST_LOG)
        _listeners[name.encode()] = self._listener
        self._name = name.encode()
        self._lost = False
        self._set: list[tuple[str, Callable[..., int], Block]] = []
        self._get: list[tuple[str, Callable[..., int], Block]] = []
        self._phase = "instantiated"
        with _guarded_directory():
            try:
                self._fmu = FMU2Slave(
                    guid=plan.guid,
                    modelIdentifier=plan.model_identifier,
                    unzipDirectory=plan.folder,
                    instanceName=name,
                )
                self._fmu.instantiate(callbacks=_callbacks(), loggingOn=True)
            except Exception as error:
                messages = self._texts()
                _listeners.pop(self._name, None)
                raise FmuCallError(f"The FMU could not be instantiated ({error}).", messages) from error
        fmu = self._fmu
        begin = 2
        for name, references, kind in (
            ("fmi2SetReal", plan.real_inputs, ctypes.c_double),
            ("fmi2SetInteger", plan.integer_inputs, ctypes.c_int),
            ("fmi2SetBoolean", plan.boolean_inputs, ctypes.c_int),
        ):
            if references:
                self._set.append((name, getattr(fmu.dll, name), Block(references, self.request, begin, kind)))
            begin += len(references)
        begin = 0
        for name, references, kind in (
            ("fmi2GetReal", plan.real_outputs, ctypes.c_double),
            ("fmi2GetInteger", plan.integer_outputs, ctypes.c_int),
            ("fmi2GetBoolean", plan.boolean_outputs, ctypes.c_int),
        ):
            if references:
                self._get.append((name, getattr(fmu.dll, name), Block(references, self.reply, begin, kind)))
            begin += len(references)
        # The C functions themselves, with the types that FMU2Slave has given them: its methods log and look
        # up names at every call.
        self._do_step = fmu.dll.fmi2DoStep
        self._component = fmu.component

    def initialise(self, start_time: float, parameters: Settings, *, with_inputs: bool) -> None:
        """Set parameters, and inputs if wanted, and bring the instance to its first communication point.

        Parameters
        ----------
        start_time : float
            Start time [s].
        parameters : Settings
            What is set before initialisation.
        with_inputs : bool
            Whether the inputs of the request block are set, instead of the FMU's own start values.

        Raises
        ------
        FmuCallError
            If a call fails, or the FMU logs an error on the way.
        """
        fmu = self._fmu
        with self._calls("initialisation"):
            fmu.setupExperiment(startTime=start_time)
            for kind, reference, value in parameters:
                if kind == "Real":
                    fmu.setReal([reference], [value])
                elif kind == "Integer":
                    fmu.setInteger([reference], [int(value)])
                else:
                    fmu.setBoolean([reference], [bool(value)])
            fmu.enterInitializationMode()
            if with_inputs:
                self._exchange(self._set, sending=True)
            fmu.exitInitializationMode()
            self._phase = "stepping"
        self._refuse_logged_errors("refused its initialisation")

    def step(self) -> None:
        """Make the step that the request block describes; the reply block then holds the outputs.

        Raises
        ------
        FmuCallError
            If a call returns Discard, Error or Fatal.
        FmuWorkerError
            If the instance was lost to an earlier fatal error.
        """
        if self._lost:
            raise FmuWorkerError("The instance was lost to a fatal error; reset the asset to go on.")
        request = self.request
        self._exchange(self._set, sending=True)
        status = self._do_step(self._component, request[0], request[1], 1)
        if status > _WARNING:
            raise self._call_error("fmi2DoStep", status, f"the step from t = {request[0]:g} s")
        self._exchange(self._get, sending=False)

    def read(self) -> None:
        """Read the outputs of this moment into the reply block."""
        with self._calls("reading the outputs"):
            self._exchange(self._get, sending=False)

    def save(self) -> bytes:
        """Return the serialised FMU state."""
        fmu = self._fmu
        with self._calls("saving the state"):
            state = fmu.getFMUstate()
            try:
                return bytes(fmu.serializeFMUstate(state))
            finally:
                fmu.freeFMUstate(state)

    def restore(self, content: bytes) -> None:
        """Restore a serialised FMU state.

        Raises
        ------
        FmuCallError
            If a call fails.
        FmuStateError
            If the FMU refuses the state in its log.
        """
        fmu = self._fmu
        with self._calls("restoring the state"):
            state = fmu.deSerializeFMUstate(content)
            try:
                fmu.setFMUstate(state)
            finally:
                fmu.freeFMUstate(state)
        self._refuse_logged_errors("refused the state", FmuStateError)

    def reset(self) -> None:
        """Bring the instance back to the moment after its instantiation."""
        with self._calls("reset"):
            if self._phase == "stepping":
                self._fmu.terminate()
            self._fmu.reset()
            self._phase = "instantiated"

    def take_log(self) -> list[tuple[int, str]]:
        """Return and forget the messages that the FMU has logged: status and text."""
        messages = list(self._listener)
        self._listener.clear()
        return messages

    @property
    def has_log(self) -> bool:
        """Whether there are messages."""
        return bool(self._listener)

    @property
    def lost(self) -> bool:
        """Whether a fatal error has made the instance unusable."""
        return self._lost

    def close(self) -> None:
        """Free the instance; one that was lost to a fatal error is left alone, since freeing it can crash."""
        _listeners.pop(self._name, None)
        if self._lost:
            return
        self._lost = True
        with _guarded_directory():
            try:
                if self._phase == "stepping":
                    self._fmu.terminate()
            except FMICallException as error:
                if error.status == _FATAL:
                    return
            self._fmu.freeInstance()

    def _exchange(self, blocks: list[tuple[str, Callable[..., int], Block]], *, sending: bool) -> None:
        for name, function, block in blocks:
            if sending and not block.real:
                block.to_fmu()
            status = function(self._component, block.references, block.count, block.values)
            if status > _WARNING:
                raise self._call_error(name, status, "setting inputs" if sending else "reading outputs")
            if not (sending or block.real):
                block.from_fmu()

    @contextmanager
    def _calls(self, what: str) -> Iterator[None]:
        if self._lost:
            raise FmuWorkerError("The instance was lost to a fatal error; reset the asset to go on.")
        with _guarded_directory():
            try:
                yield
            except FMICallException as error:
                raise self._call_error(str(error.function), int(error.status), what) from error

    def _call_error(self, function: str, status: int, what: str) -> FmuCallError:
        name = STATUS_NAMES[status] if 0 <= status < len(STATUS_NAMES) else str(status)
        if status == _FATAL or not 0 <= status <= _FATAL:
            self._lost = True
            after = "the instance is lost"
        elif status == _DISCARD:
            after = "the FMU did not accept it"
        else:
            after = "its values are no longer to be trusted"
        return FmuCallError(f"{function} returned {name} in {what}: {after}.", self._texts())

    def _refuse_logged_errors(
        self, verb: str, kind: type[FmuCallError | FmuStateError] = FmuCallError
    ) -> None:
        if any(status in (_ERROR, _FATAL) for status, _ in self._listener):
            raise kind(f"The FMU {verb}.", self._texts())

    def _texts(self) -> list[str]:
        return [text for _, text in self.take_log()][-_MESSAGES_IN_ERROR:]


def forget_modules(folder: str) -> None:
    """Take what an FMU in Python has imported from its folder out of this process.

    Otherwise the next FMU with a module of the same name, or the caller, would be given that module, and the
    folder is about to be removed. Instances that still run keep what they have.
    """
    inside = folder.rstrip(os.sep) + os.sep
    sys.path[:] = [entry for entry in sys.path if not (entry + os.sep).startswith(inside)]
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", None) or "").startswith(inside):
            del sys.modules[name]


@contextmanager
def _guarded_directory() -> Iterator[None]:
    """Come back to the working directory, wherever the FMU or fmpy goes."""
    here = Path.cwd()
    try:
        yield
    finally:
        os.chdir(here)
