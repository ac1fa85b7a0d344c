"""Names that a module re-exports and imports only when they are first used.

A `.pyi` file beside the module lists them, for this module and for type checkers. So a command
imports only what it needs, and `--help` imports none of it.
"""

import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

_REEXPORT = re.compile(r"^from (\S+) import (\w+) as \2$", re.MULTILINE)


def reexported_names(file: str) -> dict[str, str]:
    """Return the defining module of each name that the `.pyi` file beside a module re-exports.

    Parameters
    ----------
    file : str
        The path of the module; lines ``from MODULE import NAME as NAME`` of the `.pyi` file count.
    """
    stub = Path(file).with_suffix(".pyi").read_text(encoding="utf-8")
    return {name: module for module, name in _REEXPORT.findall(stub)}


def lazy_getattr(module: str, file: str) -> Callable[[str], Any]:
    """Return the `__getattr__` of a module that imports its re-exported names on first use.

    Parameters
    ----------
    module : str
        The name of the module, for error messages.
    file : str
        The path of the module.
    """
    modules = reexported_names(file)

    def getattr_of_module(name: str) -> Any:
        if name not in modules:
            available = ", ".join(sorted(modules))
            raise AttributeError(f"module {module!r} has no attribute {name!r}; it has {available}")
        return getattr(import_module(modules[name]), name)

    return getattr_of_module
