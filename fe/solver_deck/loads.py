"""Loads of a deck: nodal forces, gravity, and pressure on faces of solids and shells."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from fe.elements.cells import CellMesh
from fe.elements.kinds import DECK_KINDS, ElementKind
from fe.runtime.arrays import FloatArray
from fe.structure.abaqus import KeywordBlock
from fe.structure.deck_text import fail, real, whole
from fe.structure.mesh import Surface
from fe.structure.nodal_loads import face_areas

from .linear_model import LinearModel, block_lines
from .mesh_of_deck import DeckElement, DeckMesh

NodalForces = dict[tuple[int, int], float]
"""Force at a node along an axis, by node and direction."""

_KIND_BY_TYPE = {kind.calculix: kind for kind in DECK_KINDS.values()}
_SHELL_SOLIDS = {
    "S3": "C3D6",
    "S4": "C3D8",
    "S4R": "C3D8",
    "S6": "C3D15",
    "S8": "C3D20",
    "S8R": "C3D20",
}
"""The solid whose first face has the shape functions of a shell."""


@dataclass
class DeckLoad:
    """A load of a deck.

    Attributes
    ----------
    name : str
        Name in the structure file.
    lines : list of str
        The lines of the deck that apply it.
    forces : dict
        Forces at nodes, in the deck's unit.
    acceleration : (3,) array or None
        Acceleration of gravity, in the deck's units.
    """

    name: str
    lines: list[str] = field(default_factory=list)
    forces: NodalForces = field(default_factory=dict)
    acceleration: FloatArray | None = None


@dataclass
class DeckLoads:
    """The loads of a deck that are read, and sentences on those that are left out."""

    loads: list[DeckLoad]
    remarks: list[str]


class _NotReadError(Exception):
    """A line of a load that is left out; the message says why."""


def read_loads(model: LinearModel) -> DeckLoads:
    """Read the loads of a deck: those of one keyword and kind in one step are one load.

    Loads of all kinds of steps are read, at the values of their lines, without time curves.
    """
    loads: list[DeckLoad] = []
    remarks: list[str] = []
    steps_with_loads = [step for step in model.steps if any(_is_load(block) for block in step)]
    for number, step in enumerate(steps_with_loads, start=1):
        suffix = f"_{number}" if len(steps_with_loads) > 1 else ""
        in_step: dict[str, DeckLoad] = {}
        for block in step:
            if _is_load(block):
                _add_block(model, block, in_step, suffix, remarks)
        loads += in_step.values()
    return DeckLoads([load for load in loads if _acts(load)], list(dict.fromkeys(remarks)))


def _is_load(block: KeywordBlock) -> bool:
    return block.keyword in ("CLOAD", "DLOAD")


def _acts(load: DeckLoad) -> bool:
    """Return whether a load is not zero."""
    has_force = any(load.forces.values())
    return has_force or (load.acceleration is not None and bool(load.acceleration.any()))


def _add_block(
    model: LinearModel,
    block: KeywordBlock,
    loads: dict[str, DeckLoad],
    suffix: str,
    remarks: list[str],
) -> None:
    """Add the lines of a *CLOAD or *DLOAD to the loads of a step, by kind."""
    for line in block.data:
        where, values = line
        try:
            if block.keyword == "CLOAD":
                kind, acceleration = "force", None
                forces = _force(model, where, values)
            elif _entry(values, 1).upper() == "GRAV":
                kind, forces = "gravity", {}
                acceleration = _gravity(model, where, values)
            else:
                kind, acceleration = "pressure", None
                forces = _pressure(model.mesh, where, values)
        except _NotReadError as error:
            remarks.append(f"{where}: {error}")
            continue
        load = loads.setdefault(kind, DeckLoad(kind + suffix))
        load.lines += block_lines(KeywordBlock(where, block.keyword, {}, [line]))
        for place, force in forces.items():
            load.forces[place] = load.forces.get(place, 0.0) + force
        if acceleration is not None:
            load.acceleration = acceleration + (
                0.0 if load.acceleration is None else load.acceleration
            )


def _entry(values: Sequence[str], number: int) -> str:
    """Return an entry of a line; empty if the line is shorter."""
    return values[number] if number < len(values) else ""


def _force(model: LinearModel, where: str, values: Sequence[str]) -> NodalForces:
    """Return the nodal forces of a line of *CLOAD."""
    direction = whole(where, _entry(values, 1))
    force = real(where, _entry(values, 2))
    if direction not in (1, 2, 3):
        raise _NotReadError(
            "a moment or flux is left out; write it as forces at several nodes, or name the load "
            "in the structure file"
        )
    nodes = model.mesh.nodes_named(values[0], where)
    systems = [block for block in model.blocks if block.keyword == "TRANSFORM"]
    transformed = {
        node
        for block in systems
        for node in model.mesh.node_sets.get(block.parameters.get("NSET", "").upper(), ())
    }
    if transformed.intersection(nodes):
        raise _NotReadError("a force in the axes of *TRANSFORM is left out; give it along x, y, z")
    return {(node, direction): force for node in nodes}


def _gravity(model: LinearModel, where: str, values: Sequence[str]) -> FloatArray:
    """Return the acceleration of a line of gravity, which must act on all elements."""
    size, *direction = (real(where, _entry(values, number)) for number in (2, 3, 4, 5))
    elements = set(model.mesh.elements_named(values[0], where))
    missing = set(model.mesh.elements) - elements
    if missing:
        raise _NotReadError(
            f"gravity on some elements is left out: {values[0]} lacks {len(missing)} of "
            f"{len(model.mesh.elements)}; let it act on all"
        )
    axis = np.array(direction)
    if not axis.any():
        fail(where, "gravity needs a direction, but its three components are zero.")
    return np.asarray(size * axis / np.linalg.norm(axis))


def _pressure(mesh: DeckMesh, where: str, values: Sequence[str]) -> NodalForces:
    """Return the nodal forces of a line of pressure on faces of solids or on shells."""
    label = _entry(values, 1).upper()
    pressure = real(where, _entry(values, 2))
    forces: NodalForces = {}
    for number in mesh.elements_named(values[0], where):
        element = mesh.elements.get(number)
        if element is None:
            continue
        faces = _loaded_face(element, label)
        for node, force in _face_forces(mesh, element, *faces, pressure):
            for axis, component in enumerate(force.tolist(), start=1):
                forces[node, axis] = forces.get((node, axis), 0.0) + component
    return forces


def _loaded_face(element: DeckElement, label: str) -> tuple[ElementKind, int]:
    """Return the kind of solid whose shape functions a loaded face has, and the face's number."""
    solid = _SHELL_SOLIDS.get(element.type_name)
    if solid is not None and label in ("P", "P1"):
        return _KIND_BY_TYPE[solid], 0
    plain_type = element.type_name.rstrip("RIHTM")
    is_face = label[:1] == "P" and label[1:].isdigit()
    if plain_type not in _KIND_BY_TYPE or not is_face:
        raise _NotReadError(
            f"a load {label} on elements {element.type_name} is left out; write it as *CLOAD"
        )
    return _KIND_BY_TYPE[plain_type], int(label[1:]) - 1


def _face_forces(
    mesh: DeckMesh, element: DeckElement, kind: ElementKind, face: int, pressure: float
) -> Iterator[tuple[int, FloatArray]]:
    """Yield the nodes of a face with the force (3,) that the pressure exerts on each.

    A shell is the first face of a solid, whose other nodes do not count. Pressure acts along the
    normal of a shell and against the outward normal of a solid, which for the first face is the
    same direction.
    """
    if not 0 <= face < len(kind.face_nodes):
        raise _NotReadError(
            f"a load P{face + 1} on elements {element.type_name} is left out: they have the faces "
            f"1 to {len(kind.face_nodes)}"
        )
    face_nodes = kind.face_nodes[face]
    is_shell = element.type_name in _SHELL_SOLIDS
    expected_count = len(face_nodes) if is_shell else kind.node_count
    if len(element.nodes) != expected_count:
        raise _NotReadError(
            f"pressure is left out: an element {element.type_name} has {expected_count} nodes, but "
            f"one here has {len(element.nodes)}"
        )
    numbers = list(element.nodes)
    if not is_shell:
        numbers = [element.nodes[node] for node in face_nodes]
    positions = np.zeros((kind.node_count, 3))
    positions[list(face_nodes)] = [mesh.points[number] for number in numbers]
    cell = np.arange(kind.node_count)[None]
    solid = CellMesh(points=positions, cells=cell, kind=kind)
    surface = Surface(np.array([0]), np.array([face]))
    vectors = -pressure * face_areas(solid, surface).vectors
    for local, number in zip(face_nodes, numbers, strict=True):
        yield number, vectors[local]
