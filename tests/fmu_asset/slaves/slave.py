"""An FMU of FMI 2 in this process, call by call, through fmpy."""

from __future__ import annotations

import ctypes
import itertools
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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

from fmu_asset.archive.fmu_file import extract_fmu, read_fmu

OK, DISCARD, ERROR = 0, 2, 3

# fmpy's native proxy, which formats messages, knows one logger in a process: it finds the log by the name.
_logs: dict[bytes, list[tuple[int, str]]] = {}
_numbers = itertools.count()


def _take(_: object, name: bytes, status: int, category: bytes, message: bytes) -> None:
    _logs[name].append((status, message.decode()))


_LOGGER = fmi2CallbackLoggerTYPE(_take)


class Slave:
    """An FMU in this process, call by call: statuses and log messages are kept, none is an exception.

    With `like`, another instance of the FMU that one has extracted.
    """

    def __init__(self, path: Path, *, like: Slave | None = None) -> None:
        self.description = read_fmu(path) if like is None else like.description
        self.folder = extract_fmu(self.description) if like is None else like.folder
        self._owns_folder = like is None
        name = f"wing-{next(_numbers)}"
        self.reference = {v.name: v.reference for v in self.description.variables}
        self.names = [v.name for v in self.description.variables if v.kind == "Real"]
        self.real = [self.reference[name] for name in self.names]
        self.log = _logs.setdefault(name.encode(), [])
        callbacks = fmi2CallbackFunctions()
        callbacks.logger = _LOGGER
        callbacks.allocateMemory = fmi2CallbackAllocateMemoryTYPE(calloc)
        callbacks.freeMemory = fmi2CallbackFreeMemoryTYPE(free)
        addLoggerProxy(ctypes.byref(callbacks))
        self.fmu = FMU2Slave(
            guid=self.description.guid,
            modelIdentifier=self.description.model_identifier,
            unzipDirectory=str(self.folder),
            instanceName=name,
        )
        self.fmu.instantiate(callbacks=callbacks, loggingOn=True)

    def status_of(self, call: Callable[..., object], *arguments: object) -> int:
        """Return the FMI status of a call."""
        try:
            call(*arguments)
        except FMICallException as error:
            return int(error.status)
        return OK

    def start(self, *, response: int = 1, start_time: float = 0.0, anew: bool = True, **values: float) -> int:
        """Reset if `anew`, set values, dots in their names written as two underscores, and initialise."""
        if anew:
            self.fmu.reset()
        self.fmu.setupExperiment(startTime=start_time)
        self.fmu.enterInitializationMode()
        self.fmu.setInteger([self.reference["response"]], [response])
        for name, value in values.items():
            self.fmu.setReal([self.reference[name.replace("__", ".")]], [value])
        return self.status_of(self.fmu.exitInitializationMode)

    def step(self, inputs: Sequence[float], time: float, size: float) -> int:
        """Set the inputs in order (of a wing load factor, z1, z2, tip force) and make a step."""
        given = [v.reference for v in self.description.variables if v.causality == "input"]
        self.fmu.setReal(given, list(inputs))
        return self.status_of(self.fmu.doStep, time, size)

    def of(self, name: str) -> float:
        """Return a real variable."""
        return float(self.fmu.getReal([self.reference[name]])[0])

    def everything(self) -> list[float]:
        """Return all real variables."""
        return [float(value) for value in self.fmu.getReal(self.real)]

    @property
    def status(self) -> int:
        """The output `status`."""
        return int(self.fmu.getInteger([self.reference["status"]])[0])

    def saved(self) -> bytes:
        """Return the serialised state."""
        state = self.fmu.getFMUstate()
        try:
            return bytes(self.fmu.serializeFMUstate(state))
        finally:
            self.fmu.freeFMUstate(state)

    def restore(self, content: bytes) -> int:
        """Restore a serialised state and return the worst status."""
        try:
            state = self.fmu.deSerializeFMUstate(content)
        except FMICallException as error:
            return int(error.status)
        try:
            return self.status_of(self.fmu.setFMUstate, state)
        finally:
            self.fmu.freeFMUstate(state)

    def close(self) -> None:
        """Free the instance."""
        self.fmu.freeInstance()
        if self._owns_folder:
            shutil.rmtree(self.folder)


@contextmanager
def instantiated(kind: type, path: Path, **options: Any) -> Iterator[Any]:
    """Yield an instance of a class of fmpy and the value references of its variables by name."""
    described = read_fmu(path)
    folder = extract_fmu(described)
    made = kind(
        guid=described.guid,
        modelIdentifier=described.model_identifier,
        unzipDirectory=str(folder),
        instanceName="wing",
    )
    made.instantiate(**options)
    yield made, {variable.name: variable.reference for variable in described.variables}
    made.freeInstance()
    shutil.rmtree(folder)
