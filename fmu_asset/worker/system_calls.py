"""Calls of the C library for the sandbox, with errors as exceptions."""

import ctypes
import os
from functools import cache


@cache
def libc() -> ctypes.CDLL:
    """Return the C library of this process."""
    return ctypes.CDLL(None, use_errno=True)


def checked(result: int) -> int:
    """Return the result of a call of the C library.

    Raises
    ------
    OSError
        If it is negative.
    """
    if result < 0:
        error = ctypes.get_errno()
        raise OSError(error, f"the sandbox: {os.strerror(error)}")
    return result
