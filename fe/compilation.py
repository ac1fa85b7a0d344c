"""Loops over numbers compiled by numba, with the machine code kept on disk between processes."""

import hashlib
import inspect
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba
from numba.extending import overload, register_jitable

from fe.reduction.built_once import cache_folder

__all__ = ["callable_when_compiled", "choose_when_compiled", "compiled"]

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
"""A division by zero gives infinity, as in NumPy: a loop that might raise is not computed side by side."""


def compiled(
    function: Callable[Parameters, Result], calls: Iterable[Callable[..., Any]] = ()
) -> Callable[Parameters, Result]:
    """Compile `function` with numba when it is first called; it runs without the interpreter lock.

    The machine code is kept where `NUMBA_CACHE_DIR` says, else beside the function's file, else in the folder
    of what is kept between runs, under a hash of the sources. If none can be written, it is compiled anew in
    every process.

    Parameters
    ----------
    function : callable
        In the subset of Python that numba knows.
    calls : iterable of callable
        Plain functions of other files that it calls: numba by itself sees changes of its own file only.
        The files of compiled functions that its module names count without being told.
    """
    named = [item.py_func for item in function.__globals__.values() if hasattr(item, "py_func")]
    with _kept_by_sources([inspect.getfile(item) for item in (function, *calls, *named)]):
        try:
            made = numba.njit(cache=True, **OPTIONS)(function)
        except RuntimeError:  # numba's way to say that it found no writable folder
            made = numba.njit(**OPTIONS)(function)
    return cast("Callable[Parameters, Result]", made)


@contextmanager
def _kept_by_sources(files: list[str]) -> Iterator[None]:
    """Have numba keep what is declared meanwhile by the content of files, the function's own first."""
    digest = hashlib.sha256()
    for file in sorted(set(files)):
        digest.update(Path(file).read_bytes())
    given = numba.config.CACHE_DIR
    beside = Path(files[0]).parent
    folder = beside / "__pycache__" if os.access(beside, os.W_OK) else cache_folder() / "compiled"
    numba.config.CACHE_DIR = str(Path(given or folder) / f"numba-{digest.hexdigest()[:16]}")
    try:
        yield
    finally:
        numba.config.CACHE_DIR = given


def callable_when_compiled(
    function: Callable[..., Any],
    *,
    makes_arrays: bool = True,
    inline: bool = False,
) -> Callable[..., Any]:
    """Let compiled functions call a plain one, which itself stays plain; returns it.

    Parameters
    ----------
    function : callable
        In the subset of Python that numba knows.
    makes_arrays : bool
        If neither it nor what it calls makes an array, numba need not count the references to those that are
        handed on, which takes longer than a short function itself.
    inline : bool
        Make it part of its callers.
    """
    register_jitable(**OPTIONS, _nrt=makes_arrays, forceinline=inline)(function)
    return function


def choose_when_compiled(chosen: Callable[..., Any], table: tuple[Callable[..., Any], ...]) -> None:
    """Let compiled functions call `chosen(number, ...)`, which is `table[number](...)`.

    The table is one of functions of `callable_when_compiled` that make no arrays.
    """
    chain = _last(table[-1])
    for number, function in reversed(list(enumerate(table[:-1]))):
        if function is not table[-1]:
            rest = callable_when_compiled(chain, makes_arrays=False, inline=True)
            chain = _link(number, function, rest)

    def compiled_choice(number: Any, *given: Any) -> Any:
        return chain

    overload(chosen, jit_options={"nogil": True, "_nrt": False, "forceinline": True})(compiled_choice)


def _last(function: Callable[..., Any]) -> Callable[..., Any]:
    def choice(number: Any, *given: Any) -> Any:
        return function(*given)

    return choice


def _link(number_of_it: int, function: Callable[..., Any], rest: Callable[..., Any]) -> Callable[..., Any]:
    def choice(number: Any, *given: Any) -> Any:
        if number == number_of_it:
            return function(*given)
        return rest(number, *given)

    return choice
