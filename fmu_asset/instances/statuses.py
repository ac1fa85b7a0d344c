"""Statuses that FMI functions return, and the message about a failed instantiation."""

from typing import TYPE_CHECKING

from fmpy.fmi1 import FMICallException

if TYPE_CHECKING:
    from ctypes import _NamedFuncPointer as CFunction  # a name for type checkers alone

STATUS_NAMES = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")
OK, WARNING, DISCARD, ERROR, FATAL, PENDING = range(6)
ACCEPTED = frozenset({OK, WARNING})


def status_name(status: int) -> str:
    """Return the name that FMI gives a status."""
    return STATUS_NAMES[status] if 0 <= status < len(STATUS_NAMES) else str(status)


def refuse_negative(status: int, function: "CFunction", arguments: tuple[object, ...]) -> int:
    """Raise an error for a negative status of a C function that fmpy calls (a hook of ctypes)."""
    if status < 0:
        raise FMICallException(function=function.__name__, status=status)
    return status


def instantiation_failure(error: Exception) -> str:
    """Return the message about an FMU that could not be instantiated."""
    text = " ".join(str(error).split())
    reason = text.rpartition(".so: ")[2].removesuffix(".")  # without our folder
    if "shared library" in str(error):
        return (
            f"The FMU's binary cannot be loaded on this machine ({reason}); it was built for "
            "another processor or system, or it needs a library that is not installed."
        )
    if "undefined symbol" in reason:
        return (
            f"The FMU's binary lacks a function that its FMI version requires ({reason}); export "
            "it again."
        )
    return f"The FMU could not be instantiated ({reason})."
