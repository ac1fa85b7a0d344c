"""Loops over numbers compiled by numba, with the machine code kept on disk between processes.

Without numba (extra `uav-twin[fast]`) they run as what they are, plain Python.
"""

import functools
import hashlib
import inspect
import itertools
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np

from fe.reduction.built_once import cache_folder
from fe.runtime import dry_friction, laws, motion_arrays, motion_kernel, static_path
from fe.runtime.motion import Kernel
from reporting.progress import note

try:
    import numba
    from numba.core import event
    from numba.extending import overload, register_jitable
except ModuleNotFoundError:
    numba = None

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
"""A division by zero gives infinity, as in NumPy: a loop that might raise is not computed side by side."""
WITHOUT = (
    "numba is not installed, and loops run as plain Python: a mission takes 25 seconds more, `discrepancy` "
    "several times as long. pip install 'uav-twin[fast]'"
)


def compiled(
    function: Callable[Parameters, Result], calls: Iterable[Callable[..., Any]] = ()
) -> Callable[Parameters, Result]:
    """Compile `function` with numba when it is first called; it runs without the interpreter lock.

    That it is compiled, or runs plain, is told once in a process.

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
    if numba is None:
        return _plain(function)
    named = [item.py_func for item in function.__globals__.values() if hasattr(item, "py_func")]
    with _kept_by_sources([inspect.getfile(item) for item in (function, *calls, *named)]):
        try:
            made = numba.njit(cache=True, **OPTIONS)(function)
        except RuntimeError:  # numba's way to say that it found no writable folder
            made = numba.njit(**OPTIONS)(function)
    return cast("Callable[Parameters, Result]", made)


def _plain(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    with_silent_divisions = np.errstate(all="ignore")(function)

    @functools.wraps(function)
    def plain(*given: Parameters.args, **named: Parameters.kwargs) -> Result:
        _tell_once(WITHOUT)
        return with_silent_divisions(*given, **named)

    return plain


_tell_once = functools.cache(note)

if numba is not None:

    class _Announcement(event.Listener):  # type: ignore[misc]
        """Told is the first loop that is not found on disk."""

        def on_start(self, event: Any) -> None:
            _tell_once("Compiling loops by numba, kept for later runs: 10 to 25 s ...")

        def on_end(self, event: Any) -> None:
            """Nothing: the stage of the command that compiles tells its time."""

    event.register("numba:compile", _Announcement())


@contextmanager
def _kept_by_sources(files: list[str]) -> Iterator[None]:
    """Have numba keep what is declared meanwhile by the content of files, the function's own first."""
    digest = hashlib.sha256()
    for file in sorted({*files, __file__}):  # what makes a choice among laws, too
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
    if numba is not None:
        register_jitable(**OPTIONS, _nrt=makes_arrays, forceinline=inline)(function)
    return function


def _functions(module: ModuleType) -> list[Callable[..., Any]]:
    found = inspect.getmembers(module, inspect.isfunction)
    return [item for _, item in found if item.__module__ == module.__name__]


@functools.cache
def law_functions() -> tuple[Callable[..., Any], ...]:
    """Return the functions of `fe.runtime.laws`, which compiled functions can call from then on."""
    tables = {
        choice: laws.functions_by_law(choice.__name__) for choice in (laws.advance, laws.force_and_slope)
    }
    functions = [item for module in laws.MODULES for item in _functions(module)]
    found = tuple(dict.fromkeys((*functions, *itertools.chain(*tables.values()))))
    for function in found:
        callable_when_compiled(function, makes_arrays=False)
    for choice, table in tables.items() if numba is not None else ():
        _choose_when_compiled(choice, table)
    return found


def _choose_when_compiled(choice: Callable[..., Any], table: tuple[Callable[..., Any], ...]) -> None:
    """Let compiled functions call `choice(number, ...)`, which is `table[number](...)`."""
    # Written out as one function: a chain of functions would be compiled link by link. Its signature is that
    # of `compiled_choice`, as numba asks.
    scope: dict[str, Any] = {"Any": Any} | {f"answer_{number}": each for number, each in enumerate(table)}
    lines = [f"    if number == {number}: return answer_{number}(*given)" for number in range(len(table) - 1)]
    head, end = "def choice(number: Any, *given: Any) -> Any:", f"    return answer_{len(table) - 1}(*given)"
    exec("\n".join([head, *lines, end]), scope)

    def compiled_choice(number: Any, *given: Any) -> Any:
        return scope["choice"]

    overload(choice, jit_options={"nogil": True, "_nrt": False, "forceinline": True})(compiled_choice)


@functools.cache
def compiled_kernel() -> Kernel:
    """Return the compiled loops of `fe.runtime.motion.advance` and `static_solution`, for their `kernel`.

    The functions of `fe.runtime` stay plain; they can be called from compiled ones from then on.
    """
    inner = {
        *_functions(motion_arrays),
        *_functions(dry_friction),
        *_functions(motion_kernel),
    } - {motion_kernel.integrate}
    for function in inner:
        callable_when_compiled(function, makes_arrays=False, inline=True)
    static_inner = {*_functions(static_path)} - {static_path.static_path}
    with_arrays = {static_path.static_forces, static_path.solve_static_position}
    for function in static_inner:
        callable_when_compiled(function, makes_arrays=function in with_arrays)
    sources = (*law_functions(), *inner, *static_inner)
    return Kernel(compiled(motion_kernel.integrate, sources), compiled(static_path.static_path, sources))
