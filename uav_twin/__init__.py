"""A predictive structural digital twin of a UAV wing: the one name to import.

Each name comes from the package that holds it, and is imported when it is first used. `__init__.pyi`
beside this file lists them; `docs/python.md` shows all of them at work; the command line is `uav-twin`.
"""

import re
from importlib import import_module
from pathlib import Path
from typing import Any

_LINE = re.compile(r"^from (\S+) import (\w+) as \2$", re.MULTILINE)
_LIST = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
_HOMES = {name: module for module, name in _LINE.findall(_LIST)}
"""Module of each name."""

__all__ = sorted(_HOMES)  # noqa: PLE0605 - the names stand in `__init__.pyi` alone


def __getattr__(name: str) -> Any:
    """Import a name of `__all__` when it is first used."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    from uav_twin.shadowing import refuse_shadowing

    refuse_shadowing()
    found = globals()[name] = getattr(import_module(_HOMES[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
