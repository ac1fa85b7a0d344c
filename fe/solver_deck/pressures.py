"""Pressure on faces of solids and on shells, as nodal forces."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from fe.elements.cells import CellMesh
from fe.elements.kinds import ElementKind
from fe.runtime.arrays import FloatArray
from fe.structure.deck_text import fail, real
from fe.structure.mesh import Surface
from fe.structure.nodal_loads import face_areas

from .mesh_of_deck import TypedElement
from .shell_sides import KIND_BY_TYPE, ShellGeometry, ShellSide, solid_of_shell

NodalForces = dict[tuple[int, int], float]
"""Force at a node along an axis, by node and direction."""


class NotReadError(Exception):
    """Raised for a line of a load that is left out; the message says why."""


class FaceForces(NamedTuple):
    """Nodal forces on loaded faces.

    Attributes
    ----------
    solid : dict
        Forces on nodes of solids.
    sides : dict of ShellSide to dict
        Forces on one side of the thickness of shells, at the shell's nodes.
    """

    solid: NodalForces
    sides: dict[ShellSide, NodalForces]


class _LoadedFace(NamedTuple):
    """A loaded face of an element.

    Attributes
    ----------
    kind : ElementKind
        The solid whose shape functions the face has.
    face : int
        Index of the face, from 0.
    side : ShellSide or None
        The loaded side of a shell; None for a solid.
    """

    kind: ElementKind
    face: int
    side: ShellSide | None


_SHELL_FACES = {
    "P": ShellSide.BOTTOM,
    "P1": ShellSide.BOTTOM,
    "P2": ShellSide.TOP,
    "PNEG": ShellSide.BOTTOM,
    "PPOS": ShellSide.TOP,
}
"""The side on which a pressure acts, by its label. It pushes inwards, so that a pressure on the
bottom pushes along the normal."""


def element_pressure(shells: ShellGeometry, where: str, values: Sequence[str]) -> FaceForces:
    """Return the nodal forces of a line of *DLOAD: elements, the label of a face, the pressure.

    Raises
    ------
    MeshError
        If a number or a set cannot be read.
    NotReadError
        If loads of this label or on elements of this type are left out.
    """
    name, label, value, *_ = [*values, "", "", ""]
    numbers = shells.mesh.elements_named(name, where)
    return _pressure_forces(shells, [(number, label) for number in numbers], real(where, value))


def surface_pressure(shells: ShellGeometry, where: str, values: Sequence[str]) -> FaceForces:
    """Return the nodal forces of a line of *DSLOAD, which is `SURFACE, P, PRESSURE`.

    Raises
    ------
    MeshError
        If the deck has no such surface of faces, or a number cannot be read.
    NotReadError
        If loads of this label or on elements of this type are left out.
    """
    name, label, value, *_ = [*values, "", "", ""]
    if label.upper() != "P":
        raise NotReadError(f"*DSLOAD {label} is left out; a pressure P is read")
    faces = _surface_faces(shells, name, where)
    return _pressure_forces(shells, faces, real(where, value))


def surface_nodes(shells: ShellGeometry, name: str, where: str) -> list[int]:
    """Return the distinct nodes of the faces of a surface.

    Raises
    ------
    MeshError
        If the deck has no such surface of faces.
    NotReadError
        If its faces cannot be read.
    """
    nodes: dict[int, None] = {}
    for number, label in _surface_faces(shells, name, where):
        element = shells.mesh.elements[number]
        loaded_face = _loaded_face(element, label.upper())
        face_nodes = loaded_face.kind.face_nodes[loaded_face.face]
        nodes |= dict.fromkeys(element.nodes[index] for index in face_nodes)
    return list(nodes)


def _surface_faces(shells: ShellGeometry, name: str, where: str) -> list[tuple[int, str]]:
    """Return the faces of a surface, each as an element number with the label of a pressure on it.

    The label is P1 for the first face of an element.
    """
    surfaces = [
        block
        for block in shells.blocks
        if block.keyword == "SURFACE" and block.parameters.get("NAME", "").upper() == name.upper()
    ]
    if not surfaces or surfaces[0].parameters.get("TYPE", "ELEMENT").upper() != "ELEMENT":
        fail(where, f"the name of a *SURFACE of faces is expected, but {name!r} was given.")
    faces = []
    for face_where, values in surfaces[0].data:
        member, face_name, *_ = [*values, ""]
        # A surface names its faces S1, S2, ...; a pressure on them is P1, P2, ...
        label = "P" + face_name.upper().removeprefix("S")
        numbers = shells.mesh.elements_named(member, face_where)
        faces += [(number, label) for number in numbers]
    return faces


def _pressure_forces(
    shells: ShellGeometry, faces: Sequence[tuple[int, str]], pressure: float
) -> FaceForces:
    """Return the nodal forces of a pressure on faces, each an element number with a label."""
    result = FaceForces({}, {ShellSide.BOTTOM: {}, ShellSide.TOP: {}})
    for number, label in faces:
        element = shells.mesh.elements.get(number)
        if element is None:
            continue
        loaded_face = _loaded_face(element, label.upper())
        side = loaded_face.side
        forces = result.solid if side is None else result.sides[side]
        for node, force in _nodal_forces(shells, number, loaded_face, pressure):
            for axis, component in enumerate(force.tolist(), start=1):
                forces[node, axis] = forces.get((node, axis), 0.0) + component
    return result


def _loaded_face(element: TypedElement, label: str) -> _LoadedFace:
    """Return the face of an element that the label of a pressure means."""
    solid = solid_of_shell(element.type_name)
    if solid is not None and label in _SHELL_FACES:
        return _LoadedFace(solid, face=0, side=_SHELL_FACES[label])
    plain_type = element.type_name.rstrip("RIHTM")
    is_face = label[:1] == "P" and label[1:].isdigit()
    if plain_type not in KIND_BY_TYPE or not is_face:
        raise NotReadError(
            f"a load {label} on elements {element.type_name} is left out; write it as *CLOAD"
        )
    return _LoadedFace(KIND_BY_TYPE[plain_type], face=int(label[1:]) - 1, side=None)


def _nodal_forces(
    shells: ShellGeometry, number: int, loaded: _LoadedFace, pressure: float
) -> Iterator[tuple[int, FloatArray]]:
    """Yield each node of a face with the force (3,) that a pressure exerts on it.

    A shell is treated as the first face of a solid, whose other nodes do not matter. Pressure on
    the bottom of a shell acts along its normal, which is the direction of a pressure on that face:
    against the outward normal of the solid.
    """
    kind = loaded.kind
    face = loaded.face
    element = shells.mesh.elements[number]
    if not 0 <= face < len(kind.face_nodes):
        raise NotReadError(
            f"a load P{face + 1} on elements {element.type_name} is left out: they have the faces "
            f"1 to {len(kind.face_nodes)}"
        )
    face_nodes = kind.face_nodes[face]
    expected_count = kind.node_count if loaded.side is None else len(face_nodes)
    if len(element.nodes) != expected_count:
        raise NotReadError(
            f"pressure is left out: an element {element.type_name} has {expected_count} nodes, but "
            f"one here has {len(element.nodes)}"
        )
    # the positions of the face's nodes: of a shell, those on its expanded top or bottom
    positions = np.zeros((kind.node_count, 3))
    if loaded.side is None:
        numbers = [element.nodes[node] for node in face_nodes]
        positions[list(face_nodes)] = [shells.mesh.points[node] for node in numbers]
    else:
        numbers = list(element.nodes)
        positions[list(face_nodes)] = shells.side_positions(number, loaded.side)
    # the face as the surface of a mesh of one cell: pressure times its nodal area vectors
    cell = np.arange(kind.node_count)[None]
    solid = CellMesh(points=positions, cells=cell, kind=kind)
    surface = Surface(np.array([0]), np.array([face]))
    inward = 1.0 if loaded.side is ShellSide.TOP else -1.0
    vectors = inward * pressure * face_areas(solid, surface).vectors
    for node_in_element, node in zip(face_nodes, numbers, strict=True):
        yield node, vectors[node_in_element]
