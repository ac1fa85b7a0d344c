"""Compile numerical loops by numba, and keep the machine code on disk.

Without numba (extra `uav-twin[fast]`) the same functions run as plain Python.
"""

import functools
import hashlib
import inspect
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, ParamSpec, TypeVar, cast

import numpy as np

from fe.reduction.built_once import cache_folder
from reporting.progress import note

if TYPE_CHECKING:
    from fe.runtime.motion import Kernel

try:
    import numba
    from numba.core import event
    from numba.core.caching import FunctionCache, UserProvidedCacheLocator
    from numba.core.runtime import rtsys
    from numba.extending import overload, register_jitable
except ModuleNotFoundError:
    numba = None

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
NumericalFunction = Callable[..., object]
"""A function in the subset of Python that numba knows."""
_Function = TypeVar("_Function", bound=NumericalFunction)

# A division by zero gives infinity, as in NumPy: numba does not vectorise a loop that may raise an
# error.
OPTIONS: dict[str, object] = {"nogil": True, "error_model": "numpy"}
"""Options of numba."""
# A caller's machine code holds a copy of each function that it calls, and reordered sums of the
# copy may round otherwise than those of the function by itself. Which of the two runs depends on
# what the process has compiled or loaded before, unless the callers inline the function.
OPTIONS_OF_REORDERED_SUMS: dict[str, object] = {
    **OPTIONS,
    "forceinline": True,
    "fastmath": {"reassoc", "contract", "nsz"},
}
"""Options of numba that allow to add in another order, and to round a product and a sum once."""

WITHOUT_NUMBA = (
    "numba is not installed, and loops run as plain Python: a mission takes 25 seconds more, "
    "`discrepancy` several times as long. pip install 'uav-twin[fast]'"
)


def compiled(
    function: Callable[Parameters, Result],
    calls: Iterable[NumericalFunction] = (),
    *,
    reorders_sums: bool = False,
) -> Callable[Parameters, Result]:
    """Let numba compile a function at its first call; the compiled function releases the GIL.

    The first time in a process that something is compiled, or runs as plain Python because numba is
    missing, a note is printed.

    The machine code is kept, under a hash of the sources, in the folder `NUMBA_CACHE_DIR`, or else
    beside the function's file, or else in the cache folder. If none of these is writable, the
    function is compiled anew in every process.

    Parameters
    ----------
    function : callable
        In the subset of Python that numba knows.
    calls : iterable of callable
        Plain functions of other files that it calls, since numba itself detects changes of its own
        file only. The files of compiled functions that its module names, and of those that their
        modules name, are found without them.
    reorders_sums : bool
        Whether the compiler may reorder sums, which vector instructions need. Results then repeat
        to the last bit on one processor; between processors, and from plain Python, they differ by
        rounding errors.
    """
    if numba is None:
        return _plain_with_note(function)
    options = OPTIONS_OF_REORDERED_SUMS if reorders_sums else OPTIONS
    sources = (function, *calls, *_compiled_callees(function))
    with _cache_named_by_sources(sources):
        try:
            compiled_function = numba.njit(cache=True, **options)(function)
            compiled_function._cache = _KeptMachineCode(function)
        except RuntimeError:  # raised by numba if it finds no folder that it can write to
            compiled_function = numba.njit(**options)(function)
    return cast("Callable[Parameters, Result]", compiled_function)


def _compiled_callees(function: NumericalFunction) -> list[NumericalFunction]:
    """Return the compiled functions that a function's module names, and those that theirs name."""
    callees: dict[NumericalFunction, None] = {}
    callers = [function]
    while callers:
        for value in callers.pop().__globals__.values():
            callee = getattr(value, "py_func", None)
            if callee is not None and callee not in callees:
                callees[callee] = None
                callers.append(callee)
    return list(callees)


def compiled_with_reordered_sums(
    function: Callable[Parameters, Result],
) -> Callable[Parameters, Result]:
    """Compile a function as `compiled` does, with reordered sums; a decorator."""
    return compiled(function, reorders_sums=True)


def _plain_with_note(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Return a plain Python function that once prints that numba is missing."""
    with_silent_divisions = np.errstate(all="ignore")(function)

    @functools.wraps(function)
    def plain(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        _note_once(WITHOUT_NUMBA)
        return with_silent_divisions(*args, **kwargs)

    return plain


_note_once = functools.cache(note)

if numba is not None:

    class _CompilationNote(event.Listener):  # type: ignore[misc]
        """Notes the first compilation of a function that is not on disk."""

        def on_start(self, event: object) -> None:
            _note_once("Compiling loops by numba, kept for later runs: 10 to 25 s ...")

        def on_end(self, event: object) -> None:
            """Do nothing, because the stage of the command that compiles shows the time."""

    event.register("numba:compile", _CompilationNote())

    class _KeptMachineCode(FunctionCache):  # type: ignore[misc]
        """The files of a function's machine code, which are read without numba's compiler.

        Before it reads machine code, numba's own cache imports all that the compiler can translate,
        with parts of SciPy: 0.3 s in each process. Machine code needs none of it but the memory
        management of arrays. A function that is compiled imports the rest as before.
        """

        def load_overload(self, signature: object, target_context: object) -> object:
            """Return the machine code for a signature; None if it is not in the files."""
            rtsys.initialize(target_context)
            with self._guard_against_spurious_io_errors():
                return self._load_overload(signature, target_context)

    class CacheFolderItself(UserProvidedCacheLocator):  # type: ignore[misc]
        """Keeps machine code in the folder that is set, whatever the path of the source file.

        By itself numba adds a folder that is named by this path, so that each copy of the package
        would compile the same loops anew.
        """

        @classmethod
        def get_suitable_cache_subpath(cls, py_file: str) -> str:
            """Return the path below the folder that is set: none."""
            return ""

    CACHE_LOCATORS = (
        f"{__name__}.{CacheFolderItself.__name__},InTreeCacheLocator,UserWideCacheLocator"
    )
    """Where numba looks for a folder that it can write to, in this order."""


@contextmanager
def _cache_named_by_sources(functions: Sequence[NumericalFunction]) -> Iterator[None]:
    """Set numba's cache folder, within the context, to one named by a hash of source files.

    The sources are those of the functions, of which the compiled one comes first.
    """
    digest = hashlib.sha256()
    files = [inspect.getfile(function) for function in functions]
    for file in sorted({*files, __file__}):  # this file generates code, too
        digest.update(Path(file).read_bytes())
    # The kept machine code names the modules of its records: it is of no use once they have moved.
    for module in sorted({function.__module__ for function in functions}):
        digest.update(module.encode())
    if any(Path(file).parent.name == "laws" for file in files):
        # The numbers of installed laws depend on which of them are installed.
        from fe.runtime import laws

        digest.update("".join(law.kind for law in laws.INSTALLED_LAWS).encode())
    previous_folder = numba.config.CACHE_DIR
    folder_of_function = Path(files[0]).parent
    if previous_folder:
        parent = Path(previous_folder)
    elif os.access(folder_of_function, os.W_OK):
        parent = folder_of_function / "__pycache__"
    else:
        parent = cache_folder() / "compiled"
    previous_locators = getattr(numba.config, "CACHE_LOCATOR_CLASSES", "")  # old versions have none
    numba.config.CACHE_DIR = str(parent / f"numba-{digest.hexdigest()[:16]}")
    numba.config.CACHE_LOCATOR_CLASSES = CACHE_LOCATORS
    try:
        yield
    finally:
        numba.config.CACHE_DIR = previous_folder
        numba.config.CACHE_LOCATOR_CLASSES = previous_locators


def callable_when_compiled(
    function: _Function,
    *,
    makes_arrays: bool = True,
    inline: bool = False,
) -> _Function:
    """Let compiled functions call a plain one; return the function, which stays plain.

    Parameters
    ----------
    function : callable
        In the subset of Python that numba knows.
    makes_arrays : bool
        If neither the function nor what it calls makes an array, numba need not count references to
        arrays, which takes longer than a short function itself.
    inline : bool
        Whether the function is inlined into its callers.
    """
    if numba is not None:
        register_jitable(**OPTIONS, _nrt=makes_arrays, forceinline=inline)(function)
    return function


def _functions_of(module: ModuleType) -> list[NumericalFunction]:
    """Return the functions that a module itself defines."""
    functions = [function for _, function in inspect.getmembers(module, inspect.isfunction)]
    return [function for function in functions if function.__module__ == module.__name__]


@functools.cache
def law_functions() -> tuple[NumericalFunction, ...]:
    """Register the functions of `fe.runtime.laws` with numba, so that compiled functions call them.

    Returns these functions.
    """
    from fe.runtime import laws  # most compiled functions know no laws

    implementations = {
        choice: laws.functions_by_law(choice.__name__)
        for choice in (laws.advance, laws.force_and_slope)
    }
    functions: list[NumericalFunction] = []
    for module in laws.MODULES:
        functions += _functions_of(module)
    for functions_of_laws in implementations.values():
        functions += functions_of_laws
    functions = list(dict.fromkeys(functions))
    for function in functions:
        callable_when_compiled(function, makes_arrays=False)
    if numba is not None:
        for choice, functions_of_laws in implementations.items():
            _choose_when_compiled(choice, functions_of_laws)
    return tuple(functions)


def _choose_when_compiled(
    choice: NumericalFunction, functions: tuple[NumericalFunction, ...]
) -> None:
    """Let compiled functions call `choice(number, ...)`, which calls `functions[number]`.

    The choice is generated as source text with one line for each number: a chain of functions would
    be compiled link by link.
    """
    namespace: dict[str, object] = {}
    for number, function in enumerate(functions):
        namespace[f"answer_{number}"] = function
    last_number = len(functions) - 1
    # numba asks for the signature of `compiled_choice` below.
    lines = ["def choice(number: object, *given: object) -> object:"]
    for number in range(last_number):
        lines.append(f"    if number == {number}: return answer_{number}(*given)")
    lines.append(f"    return answer_{last_number}(*given)")
    exec("\n".join(lines), namespace)

    def compiled_choice(number: object, *given: object) -> object:
        return namespace["choice"]

    jit_options = {"nogil": True, "_nrt": False, "forceinline": True}
    overload(choice, jit_options=jit_options)(compiled_choice)


@functools.cache
def compiled_kernel() -> "Kernel":
    """Return the compiled loops, for `integrate_motion` and `static_solution`.

    The functions of `fe.runtime` stay plain, but compiled functions can call them from then on.
    """
    from fe.runtime import dry_friction, motion_arrays, motion_kernel, static_path
    from fe.runtime.motion import Kernel

    inner_functions = {
        *_functions_of(motion_arrays),
        *_functions_of(dry_friction),
        *_functions_of(motion_kernel),
    }
    inner_functions.remove(motion_kernel.integrate)
    for function in inner_functions:
        callable_when_compiled(function, makes_arrays=False, inline=True)
    static_functions = {*_functions_of(static_path)}
    static_functions.remove(static_path.static_path)
    functions_with_arrays = {static_path.static_forces, static_path.solve_static_position}
    for function in static_functions:
        callable_when_compiled(function, makes_arrays=function in functions_with_arrays)
    called_functions = (*law_functions(), *inner_functions, *static_functions)
    integrate = compiled(motion_kernel.integrate, called_functions)
    follow_static_path = compiled(static_path.static_path, called_functions)
    return Kernel(integrate, follow_static_path)
