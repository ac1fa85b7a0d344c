"""C functions of an FMU with their arguments converted once, not at every call."""

import ctypes
from collections.abc import Callable
from functools import partial
from typing import Any

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
