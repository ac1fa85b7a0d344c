"""Laws of internal forces at ports, one file each; `fe.runtime.laws.interface` says what a law is.

Every file of this folder but that one is a law. A law is known by its number, its place in `LAWS`, and each
function of the interface is here once, with that number before what it is given: it calls that of the law.
`discrepancy.models.compiled_motion` has the same compiled.

NumPy and relative imports only: this folder is copied into the FMU.
"""

from collections.abc import Callable
from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType
from typing import Any

from . import interface
from .interface import FUNCTIONS, PortForce


def _law(module: ModuleType) -> type[PortForce]:
    """Return the primitive of a law's file."""
    (law,) = (
        item
        for item in vars(module).values()
        if isinstance(item, type) and issubclass(item, PortForce) and item.__module__ == module.__name__
    )
    return law


NAMES = tuple(sorted(item.name for item in iter_modules(__path__) if item.name != "interface"))
MODULES = tuple(import_module(f"{__name__}.{name}") for name in NAMES)
"""The laws' files."""
LAWS = tuple(map(_law, MODULES))
"""The laws' primitives, by number."""


def answers(name: str) -> tuple[Callable[..., Any], ...]:
    """Return a function of the interface as each law answers it."""
    return tuple(getattr(module, name, getattr(interface, name)) for module in MODULES)


def _chosen(name: str) -> Callable[..., Any]:
    table = answers(name)

    def chosen(number: int, *given: Any) -> Any:
        return table[number](*given)

    return chosen


(
    advance, parts, pull,
    dry, holds, strength, share, steady, kick, holding_limit, crossing,
) = map(_chosen, FUNCTIONS)  # fmt: skip
