"""Laws of internal forces at ports; `fe.runtime.laws.interface` says what a law is.

Every law of a file of this folder is known by its number, its place in `LAWS`. `advance` and `pull` are here
once, with that number before what they are given: they call those of the law.
`fe.compilation` has the same compiled.

NumPy and relative imports only: this folder is copied into the FMU.
"""

from collections.abc import Callable
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

from .interface import PortForce

MODULES = tuple(import_module(f"{__name__}.{item.name}") for item in iter_modules(__path__))
LAWS = tuple(sorted(PortForce.__subclasses__(), key=lambda law: law.kind))
"""The laws' primitives, by number."""


def answers(name: str) -> tuple[Callable[..., Any], ...]:
    """Return a function of the interface as each law answers it."""
    return tuple(getattr(law, name) for law in LAWS)


def _chosen(name: str) -> Callable[..., Any]:
    table = answers(name)

    def chosen(number: int, *given: Any) -> Any:
        return table[number](*given)

    chosen.__name__ = name
    return chosen


advance, pull = map(_chosen, ("advance", "pull"))
