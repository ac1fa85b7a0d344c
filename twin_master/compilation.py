"""Compilation of the inner loops, with a cache on disk where one can be kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba

__all__ = ["compiled"]

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def compiled(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile `function` with numba when it is first called; it runs without the interpreter lock.

    The machine code is kept beside the package, or in numba's cache folder of the user if the package
    folder cannot be written. If neither can be written, it is compiled anew in every process.
    """
    try:
        return cast("Callable[Parameters, Result]", numba.njit(cache=True, nogil=True)(function))
    except RuntimeError:  # numba's way to say that it found no writable folder
        return cast("Callable[Parameters, Result]", numba.njit(nogil=True)(function))
