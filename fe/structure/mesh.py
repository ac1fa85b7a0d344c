"""The mesh of a structure, and the body it becomes: cells, what they are made of, what holds them.

Nodes, cells of one kind and named sets are as the file has them, in metres. Also what its supports hold,
what springs they set, what is rigid, and whether it is free to move.
"""

from collections.abc import Iterable, Mapping, Sized
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from scipy import sparse

from fe.elements.cells import CellMesh
from fe.elements.kinds import Rule
from fe.runtime.arrays import BoolArray, FloatArray, IntArray
from fe.runtime.errors import MeshError
from fe.sentences import said

from .affine import StiffnessTerm, designed
from .design import MeshDesign, Support
from .tables import MOTIONS, StructureDesign

EVERYTHING = "all"
"""The set of all cells, which no file has to hold."""
_Content = TypeVar("_Content", bound=Sized)


@dataclass(frozen=True)
class Surface:
    """Faces of cells.

    Attributes
    ----------
    cell, face : (m,)
        Cell of each face and the face's number in it.
    """

    cell: IntArray
    face: IntArray

    def __len__(self) -> int:
        return len(self.cell)


@dataclass(frozen=True)
class StructureMesh(CellMesh):
    """Mesh of a file in metres; nodes that no cell uses are left out.

    Attributes
    ----------
    source : str
        The file, for sentences.
    unit : float
        Metres in a unit of length of the file.
    unit_name : str
        Its name.
    node_numbers : (nn,)
        Numbers of the nodes in the file, or from 1 where it has none.
    cell_numbers : (nc,)
        Numbers of the cells in the file.
    node_sets, cell_sets : dict of str to (m,)
        Nodes and cells of each set; -1 stands for a node that no cell uses.
    face_sets : dict of str to set of corner tuples
        Faces, each by its corner nodes in rising order.
    loose : (l,)
        Numbers of the nodes that no cell uses.
    remarks : tuple of str
        What a user should know of the file: words that were passed over though nobody knows what they do.
    """

    source: str
    unit: float
    unit_name: str
    node_numbers: IntArray
    cell_numbers: IntArray
    node_sets: dict[str, IntArray]
    cell_sets: dict[str, IntArray]
    face_sets: dict[str, frozenset[tuple[int, ...]]]
    loose: IntArray
    remarks: tuple[str, ...] = ()

    @cached_property
    def size(self) -> float:
        """Diagonal [m] of the box around the structure."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @property
    def boundary(self) -> Surface:
        """Faces of one cell alone: the surface of the structure."""
        return Surface(*self.outer_faces[:2])

    @cached_property
    def cell_radius(self) -> FloatArray:
        """Radii (nc,) [m] of the spheres around the centres of the cells that hold their nodes."""
        return np.asarray(np.linalg.norm(self.nodes - self.centres[:, None], axis=2).max(axis=1))

    @cached_property
    def face_spheres(self) -> tuple[FloatArray, FloatArray]:
        """Centres (m, 3) [m] of the faces of the surface and the radii (m,) [m] around them."""
        surface = self.boundary
        centre, radius = np.empty((len(surface), 3)), np.empty(len(surface))
        for number, nodes in enumerate(self.kind.face_nodes):
            on = np.flatnonzero(surface.face == number)
            points = self.nodes[surface.cell[on]][:, list(nodes)]
            centre[on] = points.mean(axis=1)
            radius[on] = np.linalg.norm(points - centre[on, None], axis=2).max(axis=1)
        return centre, radius

    def place(self, point: FloatArray) -> str:
        """Return a place [m] as it stands in a sentence, in the unit of the file."""
        text = ", ".join(f"{value / self.unit + 0.0:.6g}" for value in point)
        return f"({text}) {self.unit_name}"

    def cell(self, number: int) -> str:
        """Return a cell as it stands in a sentence: its number in the file, and where it is."""
        return f"{self.cell_numbers[number]} at {self.place(self.centres[number])}"

    def cells_of(self, name: str, where: str) -> IntArray:
        """Cells (m,) of a set; `where` is the place in the design, for the sentence.

        Raises
        ------
        MeshError
            If there is no such set of cells, or it is empty.
        """
        sets = self.cell_sets
        if name == EVERYTHING or _named(sets, EVERYTHING) is None:
            sets = sets | {EVERYTHING: sets.get(EVERYTHING, np.arange(len(self.cells)))}
        return self._content(sets, name, "cells", "cell", where)

    def nodes_of(self, name: str, where: str) -> IntArray:
        """Nodes (m,) of a set of nodes or faces, see `cells_of`.

        Raises
        ------
        MeshError
            If there is no such set, it is empty, or holds nodes that no cell uses.
        """
        found = self._content(self.node_sets, name, "nodes or faces", "node", where)
        left_out = int((found < 0).sum())
        if left_out:
            raise MeshError(said("mesh.loose", where=where, count=left_out, name=name, mesh=self))
        return found

    def _content(self, sets: dict[str, _Content], name: str, kind: str, member: str, where: str) -> _Content:
        found = _named(sets, name)
        if found is None:
            raise MeshError(said("mesh.unknown", where=where, mesh=self, kind=kind, name=name, known=sets))
        if not len(found):
            raise MeshError(f"{where}: the set {name!r} of {self.source} holds no {member}.")
        return found

    def faces_of(self, name: str, where: str) -> Surface:
        """Faces of the surface that lie in a set: of faces, or of nodes that hold all corners of a face.

        Raises
        ------
        MeshError
            If there is no such set, or no face of the surface lies in it.
        """
        surface = self.faces_between(name, self.nodes_of(name, where))
        if not len(surface):
            raise MeshError(said("mesh.faces", where=where, name=name, mesh=self))
        return surface

    def faces_between(self, name: str, nodes: IntArray) -> Surface:
        """Faces of a set of faces, or else those of the surface all of whose corners are among nodes (m,)."""
        cell, face, corners = self.outer_faces
        wanted = _named(self.face_sets, name)
        if wanted is None:
            inside = np.isin(corners, [-1, *nodes]).all(axis=1)
        else:
            rows = (tuple(row[row >= 0].tolist()) for row in corners)
            inside = np.array([row in wanted for row in rows])
        return Surface(cell[inside], face[inside])


def _named(sets: dict[str, _Content], name: str) -> _Content | None:
    """Return the content of a set by its name, whose case counts only where two differ by nothing else."""
    alike = [content for key, content in sets.items() if key.casefold() == name.casefold()]
    return sets.get(name, alike[0] if len(alike) == 1 else None)


_FREE = 1e-8
"""A rigid motion that the supports resist by less than this share of the stiffest one is free."""


class RigidSet(NamedTuple):
    """Nodes that move as a rigid body.

    Attributes
    ----------
    nodes : (m,)
        Numbers of the nodes.
    point : (3,) m
        About which it turns.
    held : (6,) bool
        Motions along x, y, z and about them that are held.
    springs : (6,) N/m, N m/rad
        Springs to the ground.
    """

    nodes: IntArray
    point: FloatArray
    held: BoolArray
    springs: FloatArray


class Supports(NamedTuple):
    """The n free unknowns: displacements, then the motions of rigid sets by 1 m and 1 rad.

    Attributes
    ----------
    expansion : csr (full, n)
        Free unknowns to the displacements of all nodes (3 node + component).
    alone : (f,)
        Displacements that are free unknowns by themselves, the first of these.
    springs : (n,) N/m, N m/rad
        Springs to the ground.
    """

    expansion: sparse.csr_array
    alone: IntArray
    springs: FloatArray

    @property
    def stiffness(self) -> sparse.csr_array:
        """Stiffness (n, n) of the springs."""
        return sparse.diags_array(self.springs).tocsr()


def supports(
    points: FloatArray, held: BoolArray, springs: FloatArray, bodies: Iterable[RigidSet]
) -> Supports:
    """Return what is free of nodes, of which some are held, sprung or rigid.

    Parameters
    ----------
    points : (nodes, 3) m
        Places of the nodes.
    held, springs : (nodes, 3) bool, (nodes, 3) N/m
        Displacements that are held, and springs to the ground, of nodes that belong to no rigid set.
    bodies : iterable of RigidSet
        The rigid sets.
    """
    free, moved, stiff = ~held, [], []
    for body in bodies:
        free[body.nodes] = False
        moving = sparse.coo_array(rigid_motions(points[body.nodes], body.point, 2.0)[:, ~body.held])
        places = (3 * body.nodes[moving.row // 3] + moving.row % 3, moving.col)
        moved.append(sparse.coo_array((moving.data, places), (free.size, moving.shape[1])))
        stiff.append(body.springs[~body.held])
    alone = np.flatnonzero(free)
    expansion = sparse.hstack((sparse.eye_array(free.size, format="csc")[:, alone], *moved))
    return Supports(expansion.tocsr(), alone, np.concatenate((springs.ravel()[alone], *stiff)))


def supported(design: MeshDesign, mesh: StructureMesh) -> Supports:
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
    for where, part in design.numbered("support"):
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
            place = mesh.place(mesh.points[shared[0]])
            raise MeshError(said("mesh.rigid_shared", where=where, count=len(shared), place=place))
        taken[body.nodes] = True
    bodies = tuple(rigid.values())
    _check_rigid_motions(mesh, held, springs, bodies)
    return supports(mesh.points, held, springs, bodies)


def _rigid_set(part: Support, mesh: StructureMesh, nodes: IntArray, where: str) -> RigidSet:
    point = mesh.unit * np.asarray(part.rigid_about)
    motions = rigid_motions(mesh.points[nodes], point, 2.0)
    if np.linalg.matrix_rank(motions, _FREE * np.linalg.norm(motions)) < len(MOTIONS):
        raise MeshError(said("mesh.rigid", where=where, name=part.set))
    springs = np.zeros(len(MOTIONS))
    springs[: len(part.springs or ())] = part.springs or ()
    return RigidSet(nodes, point, np.isin(MOTIONS, part.hold), springs)


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
        motion = _described(free[0], mesh, centre)
        raise MeshError(said("mesh.free", mesh=mesh, count=len(free), motion=motion))


def _described(motion: FloatArray, mesh: StructureMesh, centre: FloatArray) -> str:
    shift, turn = motion[:3], motion[3:] / (0.5 * mesh.size)
    if np.linalg.norm(motion[3:]) < 1e-6:
        return f"a shift along ({_text(shift / np.linalg.norm(shift))})"
    axis = turn / np.linalg.norm(turn)
    foot = mesh.size * np.round((centre + np.cross(turn, shift) / (turn @ turn)) / mesh.size, 9)
    return f"a turn about the axis along ({_text(axis)}) through {mesh.place(foot)}"


def _text(vector: FloatArray) -> str:
    return ", ".join(f"{value + 0.0:.3g}" for value in np.round(vector, 9))


Mesh = TypeVar("Mesh", bound=CellMesh, covariant=True)


class PointMass(NamedTuple):
    """Mass [kg] at each of k points, by its name, and the shares (k, nodes) of the nodes in these points."""

    name: str
    mass: float
    shares: FloatArray


@dataclass(frozen=True)
class Body(Generic[Mesh]):
    """What is assembled.

    Attributes
    ----------
    mesh : CellMesh
        Nodes and cells.
    supports : Supports
        What is held, sprung and rigid.
    elasticity, density : (nc, 6, 6) Pa, (nc,) kg/m^3
        Of the cells, in space, nominal and undamaged.
    part : (nc,)
        Part of the stiffness that each cell belongs to.
    parts : tuple of (str or None, str or None)
        Parameter and damage region of each part.
    masses : tuple of PointMass
        Point masses with their nominal values.
    variation : (nc, q) or (1, 1)
        Elasticity at the points of the stiffness rule over that of the cell.
    mass_rule : points (q, 3) and weights (q,), optional
        Integration of the mass, by default that of the kind of the cells.
    """

    mesh: Mesh
    supports: Supports
    elasticity: FloatArray
    density: FloatArray
    part: IntArray
    parts: tuple[tuple[str | None, str | None], ...]
    masses: tuple[PointMass, ...]
    variation: FloatArray = field(default_factory=lambda: np.ones((1, 1)))
    mass_rule: Rule | None = None

    def stiffness(self, cells: IntArray) -> sparse.csr_array:
        """Stiffness (n, n) [N/m] of some of the cells on the free unknowns."""
        factor = np.broadcast_to(self.variation, (len(self.part), len(self.mesh.kind.stiffness_rule[1])))
        own = self.mesh.stiffness(cells, self.elasticity[cells], factor[cells])
        return (self.supports.expansion.T @ (own @ self.supports.expansion)).tocsr()

    @property
    def stiffness_terms(self) -> tuple[StiffnessTerm, ...]:
        """The parts in their order; springs are with the part of nothing, which comes last."""
        terms = {pair: self.stiffness(np.flatnonzero(self.part == n)) for n, pair in enumerate(self.parts)}
        springs, nothing = self.supports.stiffness, (None, None)
        if self.supports.springs.any():
            terms[nothing] = terms[nothing] + springs if nothing in terms else springs
        return tuple(StiffnessTerm(term, *pair) for pair, term in terms.items())

    @cached_property
    def cell_mass(self) -> sparse.csr_array:
        """Mass (nodes, nodes) [kg] of the cells, of one component."""
        return self.mesh.mass(np.arange(len(self.part)), self.density, self.mass_rule)

    @property
    def nodal_mass(self) -> FloatArray:
        """Share (nodes,) [kg] of each node in the mass of cells and nominal point masses."""
        heavy = (own.mass * own.shares.sum(axis=0) for own in self.masses)
        return sum(heavy, np.asarray(self.cell_mass.sum(axis=1)))

    def assembled(
        self, design: StructureDesign, loads: Iterable[FloatArray], outputs: Mapping[str, sparse.csr_array]
    ) -> dict[str, Any]:
        """Return fields of the affine model of the body, all but the hash, see `designed`."""
        three = sparse.eye_array(3)
        points = (sparse.csr_array(own.shares) for own in self.masses)
        masses = (sparse.kron(own.T @ own, three, format="csr") for own in points)
        mass = sparse.kron(self.cell_mass, three, format="csr")
        fields = designed(design, self.supports.expansion, mass, masses, loads, outputs)
        return fields | {"stiffness_terms": self.stiffness_terms, "body": self}
