"""Compilation of numerical loops by numba, with the types kept for the type checker."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

from numba import njit

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def compiled(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Return a numerical function compiled to machine code, which is kept on disk between runs.

    Parameters
    ----------
    function : callable
        A function in the subset of Python that numba compiles. Its records are named tuples.
    """
    return cast("Callable[Parameters, Result]", njit(cache=True)(function))
