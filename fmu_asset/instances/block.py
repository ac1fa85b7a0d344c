"""What is exchanged in one call of one base type, and inputs that move in straight lines in a step."""

import ctypes
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from .plan import Floats, Group, Plan

_C_TYPES: dict[str, Any] = {
    "Real": ctypes.c_double, "Float64": ctypes.c_double, "Float32": ctypes.c_float, "Integer": ctypes.c_int,
    **{name: getattr(ctypes, f"c_{name.lower()}") for bits in (8, 16, 32, 64)
       for name in (f"Int{bits}", f"UInt{bits}")},
}  # fmt: skip
_BOOLEANS: dict[int, Any] = {1: ctypes.c_ubyte, 2: ctypes.c_int, 3: ctypes.c_bool}


def values_of(block: Any) -> Floats:
    """Return a ctypes array of doubles as an array that shares its memory."""
    return np.frombuffer(memoryview(block).cast("B"))


def exchanged(
    fmi_version: int, group: Group, doubles: Any, begin: int, *, sent: bool
) -> tuple[tuple[Any, ...], Callable[[], object] | None]:
    """Return what a C function that sets or reads variables takes after the instance, and a conversion.

    Parameters
    ----------
    fmi_version : int
        1, 2 or 3.
    group : Group
        The variables, of one base type; enumerations are integers, see `FmuDescription.exchange_kind`.
    doubles : ctypes array of double
        The block of their values.
    begin : int
        Where the group begins in it.
    sent : bool
        Whether the values are set.

    Returns
    -------
    tuple of (tuple, callable or None)
        C values; what converts the numbers of the block before they are set, or into the block after they
        are read: None where the FMU reads and writes the block itself.
    """
    kind = _BOOLEANS[fmi_version] if group.kind == "Boolean" else _C_TYPES[group.kind]
    convert = None
    if kind is ctypes.c_double and group.count:
        values = (kind * group.count).from_buffer(doubles, 8 * begin)
    else:
        values = (kind * group.count)()
        pair = [np.ctypeslib.as_array(values), values_of(doubles)[begin : begin + group.count]]
        target, source = pair if sent else reversed(pair)
        convert = partial(np.copyto, target, source, casting="unsafe")
    length = len(group.references)
    counts = [length, group.count] if fmi_version == 3 else [length]
    first, *further = [ctypes.c_size_t.from_param(count) for count in counts]
    references = ctypes.byref((ctypes.c_uint * length)(*group.references))
    return (references, first, ctypes.byref(values), *further), convert


# Without declared types ctypes passes C values as they are: a third of the time of a call that converts.
_Function = ctypes.CFUNCTYPE(ctypes.c_int)


def prepared(function: Any, *arguments: Any) -> Callable[[], int]:
    """Return a call without arguments.

    Parameters
    ----------
    function : C function
        One that returns an FMI status.
    *arguments
        C values: results of `from_param` and `byref`, or objects such as `c_double`, whose value at the
        moment of the call is passed. A Python number would not be of the right type.

    Returns
    -------
    callable
        Makes the call and returns its status.
    """
    address = ctypes.cast(function, ctypes.c_void_p).value
    assert address is not None  # ctypes finds no function at 0
    return partial(_Function(address), *arguments)


_ROUNDING = 1e-12
"""Of the step: what the moment of its end may lack."""


class Lines:
    """What the FMU is given within a step, of a request that says where each line begins and ends.

    Parameters
    ----------
    request : ctypes array of double
        The request block: time, step size, the inputs at the end of the step (those that move first), and
        where they begin.
    plan : Plan
        What is exchanged.

    Attributes
    ----------
    values : ctypes array of double
        Time, step size, and the inputs of the moment.
    slopes : ctypes array of double
        Derivatives in time of the inputs that move.
    """

    def __init__(self, request: Any, plan: Plan) -> None:
        count = plan.linear_count
        self.values = (ctypes.c_double * (len(request) - count))()
        self.slopes = (ctypes.c_double * count)()
        self._request, self._all = values_of(request), values_of(self.values)
        self._moving, self._slopes = self._all[2 : 2 + count], values_of(self.slopes)
        self._end, self._begin = self._request[2 : 2 + count], self._request[-count:]
        self._substeps, self._start, self._span = plan.substeps, 0.0, 1.0

    def stand(self) -> None:
        """Give the inputs of the request as they are, as in an initialisation."""
        self._all[:] = self._request[: len(self._all)]

    def aim(self) -> None:
        """Take the lines of a new request, and give the inputs of its begin."""
        self._start, self._span = self._request[0], self._request[1] * self._substeps
        self._slopes[:] = (self._end - self._begin) / self._span
        self.stand()
        self._moving[:] = self._begin

    def move(self, time: float) -> None:
        """Give the inputs of a moment [s]; one that stays keeps its value to the bit, and so does the end."""
        share = (time - self._start) / self._span
        there = share >= 1.0 - _ROUNDING
        self._moving[:] = self._end if there else self._begin + share * (self._end - self._begin)
