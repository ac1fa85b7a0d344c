"""Bindings of small FMUs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fmu_asset.door.binding import Binding, parse_binding

Ends = Mapping[str, tuple[Any, Any]]


def bound(step_size: float, observation: Ends, *, record: object = None, **roles: Any) -> Binding:
    """Return a binding: of each name in each role its variable and unit; `header` has further keys."""
    header = {"name": "bound", "step_size": step_size, **roles.pop("header", {})}
    tables: dict[str, Any] = {
        role: {name: {"variable": variable, "unit": unit} for name, (variable, unit) in ends.items()}
        for role, ends in roles.items()
    }
    if record is not None:
        tables["record"] = {"variables": record}
    observed = {name: {"variables": names, "unit": unit} for name, (names, unit) in observation.items()}
    return parse_binding({"binding": header, "observation": observed, **tables})
