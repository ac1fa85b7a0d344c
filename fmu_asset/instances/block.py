"""What is exchanged in one call of one base type, and inputs that move in straight lines in a step."""

import ctypes
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from .plan import Group, Plan

# Enumerations are integers in FMI 1 and 2 and Int64 in FMI 3; see `archive.exchange_kind`.
_C_TYPES: dict[tuple[int, str], Any] = {
    (1, "Real"): ctypes.c_double,
    (1, "Integer"): ctypes.c_int,
    (1, "Boolean"): ctypes.c_ubyte,
    (2, "Real"): ctypes.c_double,
    (2, "Integer"): ctypes.c_int,
    (2, "Boolean"): ctypes.c_int,
    (3, "Float64"): ctypes.c_double,
    (3, "Float32"): ctypes.c_float,
    (3, "Int8"): ctypes.c_int8,
    (3, "UInt8"): ctypes.c_uint8,
    (3, "Int16"): ctypes.c_int16,
    (3, "UInt16"): ctypes.c_uint16,
    (3, "Int32"): ctypes.c_int32,
    (3, "UInt32"): ctypes.c_uint32,
    (3, "Int64"): ctypes.c_int64,
    (3, "UInt64"): ctypes.c_uint64,
    (3, "Boolean"): ctypes.c_bool,
}


class Block:
    """Variables of one base type within a block of doubles.

    Parameters
    ----------
    fmi_version : int
        1, 2 or 3.
    component : pointer
        The instance.
    group : Group
        The variables.
    doubles : ctypes array of double
        The block.
    begin : int
        Where the group begins in it.

    Attributes
    ----------
    arguments : tuple
        What the C function takes, already as C values.
    direct : bool
        Whether the FMU reads and writes the block itself, so that nothing is to be converted.
    """

    def __init__(self, fmi_version: int, component: Any, group: Group, doubles: Any, begin: int) -> None:
        kind = _C_TYPES[fmi_version, group.kind]
        self._doubles, self._begin, self._count = doubles, begin, group.count
        self._convert = float if kind is ctypes.c_float else int
        self.direct = kind is ctypes.c_double
        if self.direct and group.count:
            self._values = (kind * group.count).from_buffer(doubles, 8 * begin)
        else:
            self._values = (kind * group.count)()
        references = (ctypes.c_uint * len(group.references))(*group.references)
        count = ctypes.c_size_t.from_param(len(group.references))
        counted = (ctypes.c_size_t.from_param(group.count),) if fmi_version == 3 else ()
        self.arguments: tuple[Any, ...] = (
            ctypes.c_void_p.from_param(component),
            ctypes.byref(references),
            count,
            ctypes.byref(self._values),
            *counted,
        )

    def to_fmu(self) -> None:
        """Convert the doubles for the FMU."""
        for index in range(self._count):
            self._values[index] = self._convert(self._doubles[self._begin + index])

    def from_fmu(self) -> None:
        """Convert what the FMU gave to doubles."""
        for index in range(self._count):
            self._doubles[self._begin + index] = float(self._values[index])


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
        self._request, self._all = _array(request), _array(self.values)
        self._moving, self._slopes = self._all[2 : 2 + count], _array(self.slopes)
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


def _array(block: Any) -> npt.NDArray[np.float64]:
    return np.frombuffer(memoryview(block).cast("B"))
