"""A structure file with the changes of a patch written into its tables."""

import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import InvalidDesignError, InvalidPatchError
from fe.runtime.patch import (
    GaugeOffset,
    InterfaceCompliance,
    LoadOffset,
    LoadTilt,
    ModelPatch,
    PlaceMass,
    Primitive,
    RegionStiffnessLoss,
    SupportCompliance,
)
from reporting.formats.toml_file import read_toml

from .candidates import AXES, patches_of_mesh, places_of_mesh
from .design import Gauge, Interface, MeshDesign, load_structure, parse_structure
from .gauges import gauge_axes
from .location import nearest_point
from .mesh import StructureMesh
from .nodal_loads import point_weights, set_weights
from .operators import part_of_cells, structure_mesh
from .tables import INTERFACE_MOTIONS, MOTIONS

WRITTEN = (
    SupportCompliance,
    InterfaceCompliance,
    PlaceMass,
    RegionStiffnessLoss,
    LoadOffset,
    LoadTilt,
    GaugeOffset,
)
"""Kinds of primitives that the structure file of a mesh can express."""

SPRING_KEYS = {
    "normal": ("n",),
    "tangential": ("s", "t"),
    "twist": ("rn",),
    "bending": ("rs", "rt"),
}
"""Motions of an interface whose springs each key of its table gives."""

Tables = dict[str, Any]


def changed_tables(file: Path, patch: ModelPatch, folder: Path) -> Tables:
    """Return the tables of a structure file with the changes of a patch.

    Parameters
    ----------
    file : Path
        The structure file.
    patch : ModelPatch
        Only primitives of the kinds `WRITTEN`.
    folder : Path
        The folder of the new file; the path of the mesh is relative to it.

    Raises
    ------
    InvalidPatchError
        If the file cannot express a change.
    """
    design = load_structure(file)
    tables: Tables = dict(read_toml(file, InvalidDesignError, what="structure file"))
    if not isinstance(design, MeshDesign):
        raise InvalidPatchError(
            f"{file} is a structure from matrices, whose file cannot state such changes; give an "
            "--out that ends in .json, which is accepted wherever a model is expected."
        )
    mesh = structure_mesh(design, file)
    mesh_file = (file.parent / design.mesh).resolve()
    tables["mesh"] = Path(os.path.relpath(mesh_file, folder.resolve())).as_posix()
    for primitive in patch:
        if isinstance(primitive, SupportCompliance):
            _soften_support(tables, mesh, primitive)
        elif isinstance(primitive, InterfaceCompliance):
            _soften_interface(tables, design, primitive)
        elif isinstance(primitive, PlaceMass):
            _add_mass(tables, mesh, primitive)
        elif isinstance(primitive, RegionStiffnessLoss):
            _lose_stiffness(tables, design, mesh, primitive)
        elif isinstance(primitive, LoadOffset):
            row = _load_of(tables, primitive.control, "point")
            point = list(row["point"])
            point[AXES.index(primitive.axis)] += primitive.distance / mesh.unit
            row["point"] = point
        elif isinstance(primitive, LoadTilt):
            row = _load_of(tables, primitive.control, "force")
            row["force"] = _tilted(np.array(row["force"], dtype=float), primitive)
        elif isinstance(primitive, GaugeOffset):
            _shift_gauge(tables, mesh, primitive)
        else:
            raise _not_stated(primitive, "it has no table for this")
    # parsed only as a check, which raises if the result is not a structure
    parse_structure(tables, source=f"{file} with its patch")
    return tables


def _not_stated(primitive: Primitive, reason: str) -> InvalidPatchError:
    """Return the error for a primitive that a structure file cannot express."""
    return InvalidPatchError(
        f"A structure file cannot state the primitive {primitive.kind!r}: {reason}; give an --out "
        "that ends in .json, which is accepted wherever a model is expected."
    )


def _soften_support(tables: Tables, mesh: StructureMesh, primitive: SupportCompliance) -> None:
    """Release one motion of a support and give it a spring, in the tables of a structure file.

    If the support is not yet a rigid set, it becomes one about its centre. If the motion has a
    spring already, the compliances are added.
    """
    rows = [row for row in tables["support"] if row["set"] == primitive.support]
    if len(rows) != 1:
        reason = f"{len(rows)} tables hold the set {primitive.support!r}"
        raise _not_stated(primitive, reason)
    (row,) = rows
    if "rigid_about" not in row:
        if set(row.get("hold", ())) != set(AXES):
            reason = f"the support {primitive.support!r} does not hold x, y and z"
            raise _not_stated(primitive, reason)
        centre = set_weights(mesh, primitive.support, "the support") @ mesh.points
        row["rigid_about"] = (centre / mesh.unit).tolist()
        row["hold"] = list(MOTIONS)
    # one spring for each motion; zero stands for none
    springs = [*row.get("springs", ()), *[0.0] * len(MOTIONS)][: len(MOTIONS)]
    number = MOTIONS.index(primitive.motion)
    compliance = primitive.compliance
    if springs[number] > 0.0:
        compliance += 1.0 / springs[number]
    springs[number] = 1.0 / compliance
    row["springs"] = springs
    row["hold"] = [motion for motion in row.get("hold", ()) if motion != primitive.motion]


def _soften_interface(tables: Tables, design: MeshDesign, primitive: InterfaceCompliance) -> None:
    """Give one motion of an interface a spring, in series with the one that it may have."""
    names = [interface.name for interface in design.interface]
    if primitive.interface not in names:
        raise _not_stated(primitive, f"it has no [[interface]] {primitive.interface!r}")
    row = tables["interface"][names.index(primitive.interface)]
    # the springs as the file has them now, perhaps changed by an earlier primitive
    springs = dict(zip(INTERFACE_MOTIONS, Interface(**row).springs, strict=True))
    compliance = primitive.compliance
    if springs[primitive.motion] > 0.0:
        compliance += 1.0 / springs[primitive.motion]
    springs[primitive.motion] = 1.0 / compliance
    for key, motions in SPRING_KEYS.items():
        values = [springs[motion] for motion in motions]
        if any(values):
            row[key] = values if len(values) > 1 else values[0]


def _add_mass(tables: Tables, mesh: StructureMesh, primitive: PlaceMass) -> None:
    """Add a point mass at the centre of a set, or at a point, to the tables of a structure file."""
    if primitive.mass <= 0.0:
        raise _not_stated(primitive, f"a mass must be positive, and this one is {primitive.mass:g}")
    place = next(place for place in places_of_mesh(mesh) if place.name == primitive.place)
    position = place.weights @ mesh.points
    if place.reach > 0.0:
        position = nearest_point(mesh, place.point_beside(primitive.along, primitive.across))
    point = tuple((position / mesh.unit).tolist())
    try:
        point_weights(mesh, point, primitive.place)
    except InvalidDesignError as cause:
        reason = f"the centre of {primitive.place!r} lies outside the structure"
        raise _not_stated(primitive, reason) from cause
    masses = list(tables.get("mass", ()))
    name = _new_name("added", [row["name"] for row in masses])
    masses.append({"name": name, "point": list(point), "mass": primitive.mass})
    tables["mass"] = masses


def _lose_stiffness(
    tables: Tables, design: MeshDesign, mesh: StructureMesh, primitive: RegionStiffnessLoss
) -> None:
    """Take stiffness from some cells of a mesh, in the tables of a structure file.

    They are those of a damage region, of a named set, or of a patch of `patches_of_mesh`, for which
    a set is defined in the file.
    """
    set_of_region = {region.name: region.set for region in design.damage}
    set_name = set_of_region.get(primitive.region, primitive.region)
    if set_name not in mesh.cell_sets:
        region_of = part_of_cells(mesh, list(design.numbered("damage")), "damage region")
        patches = patches_of_mesh(mesh, design.gauge, region_of)
        if primitive.region not in patches:
            raise _not_stated(primitive, f"the mesh has no cells {primitive.region!r}")
        numbers = mesh.cell_numbers[patches[primitive.region]].tolist()
        sets = list(tables.get("set", ()))
        set_name = _new_name("softened", (*mesh.cell_sets, *mesh.node_sets))
        sets.append({"name": set_name, "of": "cells", "numbers": numbers})
        tables["set"] = sets
        mesh.cell_sets[set_name] = patches[primitive.region]
    losses = list(tables.get("stiffness_loss", ()))
    row = {"set": set_name, "fraction": primitive.loss}
    if primitive.extent != 1.0:
        row["extent"] = primitive.extent
    losses.append(row)
    tables["stiffness_loss"] = losses


def _new_name(stem: str, names: Collection[str]) -> str:
    """Return the first of STEM_1, STEM_2, ... that is no name yet."""
    number = 1
    while f"{stem}_{number}" in names:
        number += 1
    return f"{stem}_{number}"


def _shift_gauge(tables: Tables, mesh: StructureMesh, primitive: GaugeOffset) -> None:
    """Move a gauge along or across its direction, tangentially to the surface."""
    rows = [row for row in tables.get("gauge", ()) if row["name"] == primitive.gauge]
    if not rows:
        raise _not_stated(primitive, f"it has no [[gauge]] {primitive.gauge!r} of its own")
    (row,) = rows
    along, across = gauge_axes(mesh, Gauge(**row), f"the gauge {primitive.gauge!r}")
    axis = along if primitive.axis == "along" else across
    row["point"] = (np.array(row["point"]) + primitive.distance / mesh.unit * axis).tolist()


def _load_of(tables: Tables, control: str, key: str) -> Tables:
    """Return the only load table with this control and this key."""
    rows = [row for row in tables["load"] if row.get("control") == control and key in row]
    if len(rows) != 1:
        raise InvalidPatchError(
            f"The control {control!r} has {len(rows)} loads with {key!r}, and one is expected."
        )
    row: Tables = rows[0]
    return row


def _tilted(force: FloatArray, primitive: LoadTilt) -> list[float]:
    """Return a force (3,) turned towards an axis by an angle."""
    magnitude = float(np.linalg.norm(force))
    along = force / magnitude
    across = np.eye(3)[AXES.index(primitive.axis)]
    across = across - along * (along @ across)
    across = across / np.linalg.norm(across)
    direction = np.cos(primitive.angle) * along + np.sin(primitive.angle) * across
    return [float(value) for value in magnitude * direction]
