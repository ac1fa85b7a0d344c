"""The loops of motion with laws at ports, compiled: the files that the FMU runs as plain Python."""

from collections.abc import Callable
from functools import cache
from inspect import getmembers, isfunction
from types import ModuleType
from typing import Any

from fe.compilation import callable_when_compiled, choose_when_compiled, compiled
from fe.runtime import laws, motion_arrays, motion_kernel, static_path
from fe.runtime.laws import interface
from fe.runtime.motion import Kernel

SELDOM = (
    motion_kernel.find_routes,
    motion_kernel.begin_on_modes,
    motion_kernel.find_answer,
    motion_kernel.begin_flexible,
    static_path.settle_port,
)
"""Functions that are not called at every step; the others become part of their callers."""


def _functions(module: ModuleType) -> list[Callable[..., Any]]:
    return [item for _, item in getmembers(module, isfunction) if item.__module__ == module.__name__]


@cache
def law_functions() -> tuple[Callable[..., Any], ...]:
    """Return the functions of `fe.runtime.laws`, which compiled functions can call from then on."""
    functions = [item for module in (*laws.MODULES, interface) for item in _functions(module)]
    for function in functions:
        callable_when_compiled(function, makes_arrays=False)
    for name in interface.FUNCTIONS:
        choose_when_compiled(getattr(laws, name), laws.answers(name))
    return tuple(functions)


@cache
def compiled_kernel() -> Kernel:
    """Return the compiled loops, for `kernel` of `fe.runtime.stepwise.advance` and `static_solution`.

    The functions of `fe` stay plain; they can be called from compiled ones from then on.
    """
    functions = list(law_functions())
    of_static: tuple[Callable[..., Any], ...] = (static_path.pull_of, static_path.settle_port)
    for function in (*of_static, *_functions(motion_arrays), *_functions(motion_kernel)):
        functions.append(function)
        if function is not motion_kernel.integrate:
            callable_when_compiled(function, makes_arrays=False, inline=function not in SELDOM)
    for function in (static_path.static_forces, static_path.arrive_at_rest):
        callable_when_compiled(function)
    return Kernel(compiled(motion_kernel.integrate, functions), compiled(static_path.static_path, functions))
