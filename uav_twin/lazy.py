"""Names that are imported from their packages when they are first used; a `.pyi` file lists them."""

import re
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

_LINE = re.compile(r"^from (\S+) import (\w+) as \2$", re.MULTILINE)


def handed_on(file: str) -> tuple[dict[str, str], Callable[[str], Any]]:
    """Return the module of each name in the `.pyi` beside a file, and a `__getattr__` that imports it."""
    path = Path(file).with_suffix(".pyi")
    homes = {name: module for module, name in _LINE.findall(path.read_text(encoding="utf-8"))}
    own = path.parent.name if path.stem == "__init__" else f"{path.parent.name}.{path.stem}"

    def found(name: str) -> Any:
        if name not in homes:
            raise AttributeError(
                f"module {own!r} has no attribute {name!r}; it has {', '.join(sorted(homes))}"
            )
        _ours()
        return getattr(import_module(homes[name]), name)

    return homes, found


@cache
def _ours() -> None:
    from uav_twin.shadowing import refuse_shadowing

    refuse_shadowing()
