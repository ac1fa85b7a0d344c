"""Names that a module hands on: imported from their own modules when they are first used.

A `.pyi` file beside the module lists them, for this and for type checkers. So a command needs nothing of what
others use, and `--help` needs none.
"""

import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any


def homes_of(file: str) -> dict[str, str]:
    """Return the module of each name in the `.pyi` beside a file: `from MODULE import NAME as NAME`."""
    text = Path(file).with_suffix(".pyi").read_text(encoding="utf-8")
    return {name: home for home, name in re.findall(r"^from (\S+) import (\w+) as \2$", text, re.MULTILINE)}


def handed_on(module: str, file: str) -> Callable[[str], Any]:
    """Return the `__getattr__` of a module with its file."""
    homes = homes_of(file)

    def found(name: str) -> Any:
        if name not in homes:
            known = ", ".join(sorted(homes))
            raise AttributeError(f"module {module!r} has no attribute {name!r}; it has {known}")
        return getattr(import_module(homes[name]), name)

    return found
