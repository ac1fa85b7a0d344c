"""Packing the companions of the wing as FMUs, by the machinery that packs it; equal input, equal bytes."""

import json
import os
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from fmu_asset.description import PLACEHOLDER, Declaration
from fmu_asset.errors import FmuBuildError
from fmu_asset.packing.contents import (
    FmuInfo,
    check_start,
    checked_target,
    python_members,
    sealed,
    write_fmu,
)
from fmu_asset.slaves.variables import ENUMERATIONS, FmuVariable, Unit

from . import damage_growth, strain_gauges

_STATUS = tuple(enumeration for enumeration in ENUMERATIONS if enumeration.name == "Status")
_UNITS = (
    Unit("1", (), (("microstrain", 1e6), ("%", 100.0))),
    Unit("s", (("s", 1),)),
    Unit("1/s", (("s", -1),), (("microstrain/s", 1e6),)),
)

_IMPORTS = """import json

from .companions import {name} as companion
from .slaves.base import Contents


def load_contents(resources):
    \"\"\"Return what the setting that was packed describes.\"\"\"
    setting = json.loads((resources / "setting.json").read_text(encoding="utf-8"))
    return Contents(companion.variable_table(setting), lambda: companion.behaviour(setting))

"""


COMPANIONS: Mapping[str, Any] = {module.NAME: module for module in (damage_growth, strain_gauges)}
"""What can be built, by name: a file of this folder with a table, dependencies and a behaviour."""


def build_companion(
    name: str,
    path: str | os.PathLike[str],
    *,
    start: Mapping[str, float] | None = None,
    gauge_count: int | None = None,
    replace: bool = False,
) -> FmuInfo:
    """Pack a companion as an FMU; equal input gives equal bytes.

    Parameters
    ----------
    name : str
        One of `COMPANIONS`.
    path : path-like
        Where to write, with the suffix .fmu.
    start : mapping of str to float, optional
        Start values of inputs and parameters that take the place of the defaults.
    gauge_count : int, optional
        Number of gauges of `strain_gauges`; 24 by default.
    replace : bool
        Whether an existing file may be replaced.

    Raises
    ------
    FmuBuildError
        If there is no such companion, a start value does not fit, the file exists, the suffix is wrong, or
        the wrong pythonfmu is installed.
    """
    target = checked_target(path, replace=replace)
    content, content_hash = companion_bytes(name, start=start, gauge_count=gauge_count)
    return write_fmu(target, content, content_hash, name)


def companion_bytes(
    name: str, *, start: Mapping[str, float] | None = None, gauge_count: int | None = None
) -> tuple[bytes, str]:
    """Return the archive and its content hash; see `build_companion`."""
    companion = COMPANIONS.get(name)
    if companion is None:
        raise FmuBuildError(f"There is no companion FMU {name!r}; there are {', '.join(COMPANIONS)}.")
    setting: dict[str, Any] = {"start": {key: float(value) for key, value in (start or {}).items()}}
    if gauge_count is not None:
        if gauge_count < 1 or name != strain_gauges.NAME:
            raise FmuBuildError(f"{name} cannot have {gauge_count} gauges.")
        setting["gauge_count"] = gauge_count
    try:
        table = companion.variable_table(setting)
    except ValueError as error:
        raise FmuBuildError(f"The companion FMU {name} cannot be built: {error}.") from error
    check_start(table)
    return sealed(_members(companion, table, setting))


def _members(companion: Any, table: tuple[FmuVariable, ...], setting: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the files of the archive, with the placeholder wherever the content hash will stand."""
    own = files("fmu_asset.companions")
    folder = f"resources/{companion.NAME}_{PLACEHOLDER}_runtime/companions"
    declared = Declaration(
        companion.NAME, companion.DESCRIPTION, table, _UNITS, _STATUS, companion.dependencies(setting)
    )
    members = python_members(
        declared,
        "Companion",
        imports=_IMPORTS.format(name=companion.NAME),
        resources={"setting.json": (json.dumps(setting, sort_keys=True, indent=1) + "\n").encode()},
        host="It runs in any Python host; the standard library is enough.",
    )
    members[f"{folder}/__init__.py"] = b'"""What the FMU does."""\n'
    members[f"{folder}/{companion.NAME}.py"] = (own / f"{companion.NAME}.py").read_bytes()
    return members
