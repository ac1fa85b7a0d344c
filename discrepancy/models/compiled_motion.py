"""The loops of motion with laws at ports, compiled: the files that the FMU runs as plain Python."""

from collections.abc import Callable
from functools import cache
from inspect import getmembers, isfunction
from itertools import chain
from types import ModuleType
from typing import Any

from fe.compilation import callable_when_compiled, choose_when_compiled, compiled
from fe.runtime import laws, motion_arrays, motion_kernel, static_path
from fe.runtime.motion import Kernel


def _functions(module: ModuleType) -> list[Callable[..., Any]]:
    return [item for _, item in getmembers(module, isfunction) if item.__module__ == module.__name__]


@cache
def law_functions() -> tuple[Callable[..., Any], ...]:
    """Return the functions of `fe.runtime.laws`, which compiled functions can call from then on."""
    functions = [item for module in laws.MODULES for item in _functions(module)]
    tables = {choice: laws.answers(choice.__name__) for choice in (laws.advance, laws.pull)}
    found = tuple(dict.fromkeys((*functions, *chain(*tables.values()))))
    for function in found:
        callable_when_compiled(function, makes_arrays=False)
    for choice, table in tables.items():
        choose_when_compiled(choice, table)
    return found


@cache
def compiled_kernel() -> Kernel:
    """Return the compiled loops, for `kernel` of `fe.runtime.stepwise.advance` and `static_solution`.

    The functions of `fe` stay plain; they can be called from compiled ones from then on.
    """
    inner = {*_functions(motion_arrays), *_functions(motion_kernel)} - {motion_kernel.integrate}
    for function in inner:
        callable_when_compiled(function, makes_arrays=False, inline=True)
    callable_when_compiled(static_path.settle_port, makes_arrays=False)
    callable_when_compiled(static_path.static_forces)
    functions = (*law_functions(), *inner, static_path.settle_port)
    return Kernel(compiled(motion_kernel.integrate, functions), compiled(static_path.static_path, functions))
