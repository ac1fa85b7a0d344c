"""What the supports hold, what springs they set, and whether they leave the structure free to move."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from fe.runtime.errors import MeshError

from .design import StructureDesign
from .mesh import StructureMesh

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_FREE = 1e-8
"""A rigid motion that the supports resist by less than this share of the stiffest one is free."""
_AXES = "xyz"


@dataclass(frozen=True)
class SupportedUnknowns:
    """Held displacements and springs of all unknowns (3 node + component).

    Attributes
    ----------
    held : (full,) bool
        Whether a displacement is held at zero.
    springs : (full,) N/m
        Springs to the ground.
    """

    held: BoolArray
    springs: FloatArray

    @property
    def expansion(self) -> sparse.csr_array:
        """Free unknowns to all unknowns, csr (full, n)."""
        free = np.flatnonzero(~self.held)
        places = (free, np.arange(len(free)))
        return sparse.coo_array((np.ones(len(free)), places), shape=(len(self.held), len(free))).tocsr()


def supported(design: StructureDesign, mesh: StructureMesh) -> SupportedUnknowns:
    """Collect the supports of a design.

    Raises
    ------
    MeshError
        If a set is missing or empty, or the supports leave a rigid motion of the structure free.
    """
    held = np.zeros((len(mesh.points), 3), dtype=bool)
    springs = np.zeros((len(mesh.points), 3))
    for number, part in enumerate(design.support, start=1):
        nodes = mesh.nodes_of(part.set, f"support[{number}]")
        for axis in part.hold:
            held[nodes, _AXES.index(axis)] = True
        if part.springs is not None:
            springs[nodes] += np.asarray(part.springs) / len(nodes)
    springs[held] = 0.0
    _check_rigid_motions(mesh, held, springs)
    return SupportedUnknowns(held.ravel(), springs.ravel())


def rigid_motions(points: FloatArray, centre: FloatArray, size: float) -> FloatArray:
    """Six rigid motions (3 nodes, 6): along and about x, y, z through `centre`, turns over `size` / 2."""
    arm = (points - centre) / (0.5 * size)
    motions = np.zeros((len(points), 3, 6))
    for axis in range(3):
        motions[:, axis, axis] = 1.0
        motions[:, :, 3 + axis] = np.cross(np.eye(3)[axis], arm)
    return motions.reshape(-1, 6)


def _check_rigid_motions(mesh: StructureMesh, held: BoolArray, springs: FloatArray) -> None:
    """Refuse supports that resist fewer than six rigid motions, and say which one is free."""
    centre = mesh.points.mean(axis=0)
    motions = rigid_motions(mesh.points, centre, mesh.size)
    # Every resisting unknown counts alike: what matters is whether it resists, not how stiff it is.
    resisted = motions[(held | (springs > 0.0)).ravel()]
    _, values, directions = np.linalg.svd(np.vstack((resisted, np.zeros((6, 6)))), full_matrices=False)
    free = directions[values <= _FREE * max(float(values[0]), 1e-300)]
    if len(free):
        raise MeshError(
            f"{mesh.source}: the supports leave {len(free)} of the six rigid motions free, among them "
            f"{_described(free[0], mesh, centre)}; hold further directions."
        )


def _described(motion: FloatArray, mesh: StructureMesh, centre: FloatArray) -> str:
    shift, turn = motion[:3], motion[3:] / (0.5 * mesh.size)
    if np.linalg.norm(motion[3:]) < 1e-6:
        return f"a shift along ({_text(shift / np.linalg.norm(shift))})"
    axis = turn / np.linalg.norm(turn)
    foot = centre + np.cross(turn, shift) / (turn @ turn)
    return f"a turn about the axis along ({_text(axis)}) through {mesh.place(_rounded(foot, mesh.size))}"


def _rounded(point: FloatArray, size: float) -> FloatArray:
    return np.asarray(np.where(np.abs(point) < 1e-9 * size, 0.0, point))


def _text(vector: FloatArray) -> str:
    return ", ".join(f"{value + 0.0:.3g}" for value in np.where(np.abs(vector) < 1e-9, 0.0, vector))
