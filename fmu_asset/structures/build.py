"""Packing a reduced structure as an FMU, by the machinery that packs the wing; equal input, equal bytes."""

import json
import os
import re
from collections.abc import Mapping
from importlib.resources import files

from fe.runtime.reduced import ReducedModel
from fmu_asset.archive.design_record import DESIGN_RECORD, design_record
from fmu_asset.compiled.package import FmiVersion, compiled_members
from fmu_asset.compiled.variable_header import Roles
from fmu_asset.errors import FmuBuildError
from fmu_asset.packing.contents import (
    PLACEHOLDER,
    FmuInfo,
    check_start,
    checked_target,
    room_members,
    write_fmu,
)
from fmu_asset.packing.python_fmu import python_members
from fmu_asset.packing.wing_fmu import FmuKind, check_version, packed
from fmu_asset.slaves.variables import UNITS, FmuVariable, Unit

from .table import structure_table

_IMPORTS = """from .structures.slave import StructureSlave as _Slave
from .structures.slave import load_contents
"""
_COMPANION_FILES = ("slave.py", "table.py")
_OWN_FILES = ("__init__.py", "behaviour.py", "slave.py", "table.py")
_ACCELERATION = Unit("m/s2", (("m", 1), ("s", -2)))


def build_structure_fmu(
    model: ReducedModel,
    path: str | os.PathLike[str],
    *,
    kind: FmuKind = "python",
    start: Mapping[str, float] | None = None,
    fmi: FmiVersion = 2,
    replace: bool = False,
) -> FmuInfo:
    """Pack a reduced structure as an FMI co-simulation FMU.

    Parameters
    ----------
    model : ReducedModel
        The structure.
    path : path-like
        Where to write, with the suffix .fmu.
    kind : {"python", "compiled", "source"}
        What evaluates the model: Python in the host, C compiled now, or C to be compiled elsewhere.
    start : mapping of str to float, optional
        Start values by variable name that take the place of the nominal ones.
    fmi : {2, 3}
        Version of FMI; 3 for the kinds in C.
    replace : bool
        Whether an existing file may be replaced.

    Raises
    ------
    FmuBuildError
        If a start value does not fit, a name is taken by a variable of the FMU, the file exists, the suffix
        is wrong, the wrong pythonfmu is installed, or there is no C compiler for a compiled one.
    """
    target = checked_target(path, replace=replace)
    content, content_hash = structure_fmu_bytes(model, start, kind, fmi)
    return write_fmu(target, content, content_hash, stem_of(model), model.design_hash)


def stem_of(model: ReducedModel) -> str:
    """Return the name of a structure as an identifier of C."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", model.name).strip("_")[:40]
    return plain if plain[:1].isalpha() else f"structure_{plain}".rstrip("_")


def structure_fmu_bytes(
    model: ReducedModel,
    start: Mapping[str, float] | None = None,
    kind: FmuKind = "python",
    fmi: FmiVersion = 2,
) -> tuple[bytes, str]:
    """Return the archive and its content hash; see `build_structure_fmu`."""
    check_version(kind, fmi)
    given = {name: float(value) for name, value in (start or {}).items()}
    try:
        table = structure_table(model, given)
    except ValueError as error:
        raise FmuBuildError(f"The FMU of the structure {model.name} cannot be built: {error}.") from error
    check_start(table)
    name = stem_of(model)
    description = (
        f"Structure {model.name}: strains, displacements, accelerations and modes from a reduced finite "
        "element model under its loads, with regions that can lose stiffness."
    )
    if kind == "python":
        template = _python_template(model, table, given, name, description)
    else:
        template = compiled_members(
            model,
            table,
            _roles_of(model),
            units=_units(table),
            model_name=name,
            identifier=f"{name}_{PLACEHOLDER}",
            guid=PLACEHOLDER,
            content_tag=PLACEHOLDER,
            description=description,
            fmi=fmi,
        )
    return packed(template, name, kind, fmi)


def _python_template(
    model: ReducedModel,
    table: tuple[FmuVariable, ...],
    start: Mapping[str, float],
    name: str,
    description: str,
) -> dict[str, bytes]:
    """Return the files of the FMU that runs in Python, with the placeholder in them."""
    runtime = f"resources/{name}_{PLACEHOLDER}_runtime"
    members = python_members(
        name,
        "Structure_",
        imports=_IMPORTS,
        table=table,
        description=description,
        resources={
            "structure.npz": model.to_bytes(),
            DESIGN_RECORD: design_record(model.design_hash),
            "start.json": (json.dumps(start, sort_keys=True) + "\n").encode(),
        },
        units=_units(table),
    ) | room_members("fe.runtime", f"{runtime}/fe")
    for room, names in (("companions", _COMPANION_FILES), ("structures", _OWN_FILES)):
        own = files(f"fmu_asset.{room}")
        for file in names:
            source = (own / file).read_bytes().replace(b"from fe.runtime", b"from ..fe")
            members[f"{runtime}/{room}/{file}"] = source
    members[f"{runtime}/companions/__init__.py"] = b'"""What small slaves have in common."""\n'
    return members


def _roles_of(model: ReducedModel) -> Roles:
    """Return which variables of a structure are what."""
    return Roles(
        chosen=(
            *model.parameters,
            *(f"health.{name}" for name in model.regions),
            *(f"mass.{name}" for name in model.masses),
            *model.controls,
        ),
        outputs=model.static_count + len(model.accelerations),
        displacement_bound="displacement_error_bound",
    )


def _units(table: tuple[FmuVariable, ...]) -> tuple[Unit, ...]:
    """Return the units of the table; of a control's unit that is not known no more than its name is told."""
    known = (*UNITS, _ACCELERATION)
    names = {unit.name for unit in known}
    others = sorted({row.unit for row in table if row.unit is not None} - names)
    return (*known, *(Unit(name) for name in others))
