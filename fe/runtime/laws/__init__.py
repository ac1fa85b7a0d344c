"""Laws of internal forces at ports; `fe.runtime.laws.interface` says what a law is.

Every law of a file of this folder has a number, its index in `LAWS`. `advance` and
`force_and_slope` of this module take that number first, and then call the function of the law.
`fe.compilation` compiles them.

NumPy and relative imports only: this folder is copied into the FMU.
"""

from collections.abc import Callable
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

from .interface import PortForce

MODULES = tuple(import_module(f"{__name__}.{module.name}") for module in iter_modules(__path__))
"""The modules of this folder."""
LAWS = tuple(sorted(PortForce.__subclasses__(), key=lambda law: law.kind))
"""The classes of the laws, by number."""


def functions_by_law(name: str) -> tuple[Callable[..., Any], ...]:
    """Return one function of the interface for each law, by the number of the law."""
    return tuple(getattr(law, name) for law in LAWS)


def _function_of_numbered_law(name: str) -> Callable[..., Any]:
    """Return a function that takes the number of a law, and calls that law's function."""
    functions = functions_by_law(name)

    def call(number: int, *arguments: Any) -> Any:
        return functions[number](*arguments)

    call.__name__ = name
    return call


advance = _function_of_numbered_law("advance")
force_and_slope = _function_of_numbered_law("force_and_slope")
