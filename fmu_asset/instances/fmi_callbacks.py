"""Callbacks that FMI 1 and 2 pass to an FMU: its logger, and its memory allocation.

fmpy formats the messages of C FMUs in a native proxy, which knows one logger per process. Instances
therefore register by name, and the logger finds them.
"""

import ctypes
from typing import Protocol

from fmpy import calloc, fmi1, fmi2, free
from fmpy.logging import addLoggerProxy


class MessageReceiver(Protocol):
    """An instance that receives the messages of its FMU."""

    def log(self, environment: object, status: int, category: bytes, message: bytes) -> None:
        """Receive a message of the FMU; the signature is that of fmpy's callback in FMI 3."""


_receivers: dict[bytes, MessageReceiver] = {}
_FMPY_MODULES = {1: fmi1, 2: fmi2}


def register(instance_name: str, receiver: MessageReceiver) -> None:
    """Send the messages of an instance to a receiver from now on."""
    _receivers[instance_name.encode()] = receiver


def unregister(instance_name: str) -> None:
    """Drop the messages of an instance from now on."""
    _receivers.pop(instance_name.encode(), None)


def _log(_: object, instance_name: bytes, status: int, category: bytes, message: bytes) -> None:
    receiver = _receivers.get(instance_name or b"")
    if receiver is not None:
        receiver.log(None, status, category, message)


_LOGGERS = {1: fmi1.fmi1CallbackLoggerTYPE(_log), 2: fmi2.fmi2CallbackLoggerTYPE(_log)}


def callbacks(fmi_version: int) -> ctypes.Structure:
    """Return new callback functions for FMI 1 or 2, as fmpy's structure for that version."""
    module = _FMPY_MODULES[fmi_version]
    prefix = f"fmi{fmi_version}Callback"
    # functions that are not set, such as `stepFinished`, are null
    functions: ctypes.Structure = getattr(module, f"{prefix}Functions")()
    functions.logger = _LOGGERS[fmi_version]
    functions.allocateMemory = getattr(module, f"{prefix}AllocateMemoryTYPE")(calloc)
    functions.freeMemory = getattr(module, f"{prefix}FreeMemoryTYPE")(free)
    addLoggerProxy(ctypes.byref(functions))
    return functions
