"""Meshes that tests write line by line, and places in systems of coordinates that are turned."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fe.elements.cells import jacobians
from fe.runtime.errors import MeshError
from fe.structure.mesh import StructureMesh
from fe.structure.mesh_file import read_mesh
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)
CUBES = INPUTS.text("cubes.inp")
NASTRAN_TETRAHEDRON = INPUTS.text("tetrahedron.bdf").splitlines()
ABAQUS_TETRAHEDRON = INPUTS.text("tetrahedron.inp").splitlines()

ORIGIN = np.array([0.3, -1.2, 0.7])
TURN = Rotation.from_rotvec([0.4, -0.9, 1.3])
AXES = TURN.as_matrix().T
"""The axes of the turned system, a row for each."""


def coordinates_in_turned_system(points: Any, kind: str) -> Any:
    """Return the coordinates (n, 3) of points in the system at `ORIGIN` that `TURN` turned.

    This is what a reader undoes; `kind` is R (rectangular), C (cylindrical) or S (spherical).
    """
    x, y, z = TURN.inv().apply(points - ORIGIN).T
    if kind == "R":
        return np.column_stack((x, y, z))
    radius_in_plane = np.hypot(x, y)
    azimuth = np.rad2deg(np.arctan2(y, x))
    if kind == "C":
        return np.column_stack((radius_in_plane, azimuth, z))
    polar_angle = np.rad2deg(np.arctan2(radius_in_plane, z))
    return np.column_stack((np.hypot(radius_in_plane, z), polar_angle, azimuth))


def read_lines(path: Path, *lines: str) -> StructureMesh:
    """Write lines and read them as a mesh in m."""
    path.write_text("\n".join(lines) + "\n", encoding="latin-1")
    return read_mesh(path, 1.0, "m")


def volume_of(mesh: StructureMesh) -> float:
    local_points, weights = mesh.kind.mass_rule
    determinant = np.linalg.det(jacobians(mesh.kind, mesh.nodes, local_points))
    return float((determinant * weights).sum())


def card_of(*fields: object) -> str:
    """Return the fields of a card with commas between them."""
    return ",".join(f"{field:.12g}" if isinstance(field, float) else str(field) for field in fields)


def assert_mesh_refused(path: Path, sentence: str) -> None:
    with refused(MeshError, sentence):
        read_mesh(path, 1.0, "m")
