"""What the supports hold, what springs they set, what is rigid, and whether the structure is free to move."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from fe.runtime.arrays import BoolArray, FloatArray, IntArray
from fe.runtime.errors import MeshError

from .design import MeshDesign, Support
from .mesh import StructureMesh
from .tables import MOTIONS

_FREE = 1e-8
"""A rigid motion that the supports resist by less than this share of the stiffest one is free."""


@dataclass(frozen=True)
class RigidSet:
    """Nodes (m,) that move as a rigid body.

    Attributes
    ----------
    nodes : (m,)
        Numbers of the nodes.
    point : (3,) m
        About which it turns.
    motions : (3 m, 6)
        Displacements of the nodes by 1 m along x, y, z and 1 rad about them.
    held : (6,) bool
        Motions that are held.
    springs : (6,) N/m, N m/rad
        Springs to the ground.
    """

    nodes: IntArray
    point: FloatArray
    motions: FloatArray
    held: BoolArray
    springs: FloatArray


@dataclass(frozen=True)
class SupportedUnknowns:
    """Held displacements and springs of all unknowns (3 node + component), and rigid sets.

    Attributes
    ----------
    held : (full,) bool
        Whether a displacement is held at zero.
    springs : (full,) N/m
        Springs to the ground.
    rigid : tuple of RigidSet
        Their nodes are not among the held ones.
    """

    held: BoolArray
    springs: FloatArray
    rigid: tuple[RigidSet, ...] = ()

    @cached_property
    def alone(self) -> IntArray:
        """Unknowns (f,) that are free by themselves."""
        found = ~self.held
        for part in self.rigid:
            found[_unknowns(part.nodes)] = False
        return np.flatnonzero(found)

    @cached_property
    def expansion(self) -> sparse.csr_array:
        """Free unknowns to all unknowns, csr (full, n); the motions of rigid sets come last."""
        size, count = len(self.held), len(self.alone)
        parts = [sparse.coo_array((np.ones(count), (self.alone, np.arange(count))), (size, count))]
        for part in self.rigid:
            moving = sparse.coo_array(part.motions[:, ~part.held])
            rows = _unknowns(part.nodes)[moving.row]
            parts.append(sparse.coo_array((moving.data, (rows, moving.col)), (size, moving.shape[1])))
        return sparse.hstack(parts).tocsr()

    @property
    def stiffness(self) -> sparse.csr_array:
        """Stiffness (n, n) of the springs on the free unknowns."""
        ground = self.expansion.T @ sparse.diags_array(self.springs) @ self.expansion
        turns = [part.springs[~part.held] for part in self.rigid]
        own = np.concatenate([np.zeros(len(self.alone)), *turns])
        return sparse.csr_array(ground + sparse.diags_array(own))


def _unknowns(nodes: IntArray) -> IntArray:
    return np.asarray(3 * nodes[:, None] + np.arange(3)).ravel()


def supported(design: MeshDesign, mesh: StructureMesh) -> SupportedUnknowns:
    """Collect the supports of a design.

    Raises
    ------
    MeshError
        If a set is missing or empty, a rigid one lies on a line or shares nodes with another support, or the
        supports leave a rigid motion of the structure free.
    """
    rigid: dict[str, RigidSet] = {}
    held = np.zeros((len(mesh.points), 3), dtype=bool)
    springs = np.zeros((len(mesh.points), 3))
    for where, part in ((f"support[{number}]", part) for number, part in enumerate(design.support, start=1)):
        nodes = mesh.nodes_of(part.set, where)
        if part.rigid_about is not None:
            rigid[where] = _rigid_set(part, mesh, nodes, where)
            continue
        held[nodes] |= np.isin(MOTIONS[:3], part.hold)
        if part.springs is not None:
            springs[nodes] += np.asarray(part.springs) / len(nodes)
    springs[held] = 0.0
    taken = np.any(held | (springs > 0.0), axis=1)
    for where, body in rigid.items():
        shared = body.nodes[taken[body.nodes]]
        if len(shared):
            raise MeshError(
                f"{where}: {len(shared)} nodes of the rigid set belong to another support, too, such as that "
                f"at {mesh.place(mesh.points[shared[0]])}; say what holds it in its own table."
            )
        taken[body.nodes] = True
    bodies = tuple(rigid.values())
    _check_rigid_motions(mesh, held, springs, bodies)
    return SupportedUnknowns(held.ravel(), springs.ravel(), bodies)


def _rigid_set(part: Support, mesh: StructureMesh, nodes: IntArray, where: str) -> RigidSet:
    point = mesh.unit * np.asarray(part.rigid_about)
    motions = rigid_motions(mesh.points[nodes], point, 2.0)
    if np.linalg.matrix_rank(motions, _FREE * np.linalg.norm(motions)) < len(MOTIONS):
        raise MeshError(
            f"{where}: the nodes of the rigid set {part.set!r} lie on a line, about which it could turn."
        )
    springs = np.zeros(len(MOTIONS))
    springs[: len(part.springs or ())] = part.springs or ()
    return RigidSet(nodes, point, motions, np.isin(MOTIONS, part.hold), springs)


def rigid_motions(points: FloatArray, centre: FloatArray, size: float) -> FloatArray:
    """Six rigid motions (3 nodes, 6): along and about x, y, z through `centre`, turns over `size` / 2."""
    arm = (points - centre) / (0.5 * size)
    motions = np.zeros((len(points), 3, 6))
    for axis in range(3):
        motions[:, axis, axis] = 1.0
        motions[:, :, 3 + axis] = np.cross(np.eye(3)[axis], arm)
    return motions.reshape(-1, 6)


def _check_rigid_motions(
    mesh: StructureMesh, held: BoolArray, springs: FloatArray, bodies: tuple[RigidSet, ...]
) -> None:
    """Refuse supports that resist fewer than six rigid motions, and say which one is free."""
    centre = mesh.points.mean(axis=0)
    motions = rigid_motions(mesh.points, centre, mesh.size)
    # Every resisting unknown counts alike: what matters is whether it resists, not how stiff it is.
    resisted = motions[(held | (springs > 0.0)).ravel()]
    for body in bodies:
        own = np.vstack((rigid_motions(body.point[None], centre, mesh.size), np.eye(6)[3:]))
        resisted = np.vstack((resisted, own[body.held | (body.springs > 0.0)]))
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
    foot = mesh.size * np.round((centre + np.cross(turn, shift) / (turn @ turn)) / mesh.size, 9)
    return f"a turn about the axis along ({_text(axis)}) through {mesh.place(foot)}"


def _text(vector: FloatArray) -> str:
    return ", ".join(f"{value + 0.0:.3g}" for value in np.round(vector, 9))
