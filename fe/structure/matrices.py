"""From matrices and a structure file to affine operators, and what is said of matrices that are no structure.

Matrices are turned into SI units as they are read: stiffness in N/m, mass in kg, unknowns in metres (turns
times the unit of length). A row that reads a displacement is then, transposed, a force of 1 N there.
"""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy import sparse

from fe.elements.cells import unit_vector
from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import MeshError, SolutionError
from fe.sentences import said

from .affine import AffineStructure, StiffnessTerm, designed
from .design import Extension, MatrixDesign, MatrixLoad, MatrixMass
from .mesh_file import Place, read_matrix, read_unknowns, read_vector
from .tables import MOTIONS, Vector

Shares = Mapping[int, tuple[float, ...]]

READ: Shares = {
    1: (1.0,), 2: (0.5,) * 2, 3: (1 / 6, 2 / 3, 1 / 6), 4: (0.25,) * 4, 8: (0.25,) * 4 + (0.0,) * 4,
}  # fmt: skip
"""Shares of the rows that carry one name in its displacement: CalculiX expands a node of a shell into two or
three through the thickness and one of a beam into four or eight (found by what version 2.20 prints)."""
PUSHED: Shares = {**READ, 3: (-0.5, 2.0, -0.5)}
"""Shares of these rows in a force on the node, as CalculiX shares it."""

_ROUNDING = 1e-12
"""Entries of a difference of matrices below this share of the diagonal are rounding."""
_UNSYMMETRIC = 1e-9
_INDEFINITE = 1e-3
"""How far below zero, as a share of the whole, a part may come: matrices in files are rounded."""
_FREE = 1e-10
"""A motion with less stiffness than this share of its diagonal is free."""
_MOST_FREE = 7  # motions that are looked at


def _named(place: Place) -> str:
    return f"node {place[0]}, component {place[1]}"


@dataclass(frozen=True)
class Matrices:
    """Matrices and vectors by name, and node and component of each of their n rows.

    Attributes
    ----------
    folder : Path
        Where the files are.
    places : list of (int, int)
        Node and component of each row.
    unit : float
        Metres in the unit of length of the matrices.
    """

    folder: Path
    places: list[Place]
    unit: float

    @cached_property
    def rows(self) -> dict[Place, list[int]]:
        """Rows of each node's component."""
        found: dict[Place, list[int]] = {}
        for row, place in enumerate(self.places):
            found.setdefault(place, []).append(row)
        return found

    def rows_of(self, place: Place, where: str) -> list[int]:
        """Rows of a node's component; raises `MeshError` where the matrices have none."""
        if place not in self.rows:
            node, component = place
            own = ", ".join(str(other) for number, other in sorted(self.rows) if number == node)
            known = f"its components {own}" if own else "no such node"
            raise MeshError(
                said("matrices.component", where=where, node=node, component=component, known=known)
            )
        return self.rows[place]

    def at(self, place: Place, where: str, shares: Shares = READ) -> FloatArray:
        """Vector (n,) of 1 at a node's component, shared among the rows of that name.

        Raises
        ------
        MeshError
            If the matrices have no such row, or so many that it is not known how they share.
        """
        own, found = self.rows_of(place, where), np.zeros(len(self.places))
        if len(own) not in shares:
            raise MeshError(said("matrices.rows", where=where, place=place, count=len(own)))
        found[own] = shares[len(own)]
        return found

    def along(self, node: int, direction: Vector, where: str, shares: Shares = READ) -> FloatArray:
        """Vector (n,) of a direction (3,) at a node."""
        parts = [x * self.at((node, axis), where, shares) for axis, x in enumerate(direction, start=1) if x]
        return np.asarray(np.sum(parts, axis=0))

    def everywhere(self, field: Vector, where: str) -> FloatArray:
        """Vector (n,) of a shift of all nodes; raises `MeshError` where turns may look like shifts."""
        if len(self.rows) < len(self.places):
            raise MeshError(said("matrices.turns", where=where))
        return np.array([[*field, 0.0, 0.0, 0.0][component - 1] for _, component in self.places])

    def vector(self, name: str, where: str, shares: Shares = READ) -> FloatArray:
        """Vector (n,) of a file."""
        return read_vector(self.folder, name, lambda place: self.at(place, where, shares), len(self.places))

    def matrix(self, name: str, where: str, *, partial: bool = False) -> sparse.csr_array:
        """Return the symmetric matrix (n, n) of a file [N/m or kg], its rows in the order of the places.

        A `partial` one may end before them, as a table does whose last rows are zero.

        Raises
        ------
        MeshError
            If it cannot be read, has other rows, is not finite or not symmetric.
        """
        matrix, own = read_matrix(self.folder, name)
        size, place = len(self.places), f"{where}: {self.folder / name}"
        if own is not None:
            chosen = [self.rows_of(each, place)[0] for each in own]
            placed = sparse.eye_array(size, format="csc")[:, chosen].tocsr()
            matrix = (placed @ matrix @ placed.T).tocsr()
        if partial and matrix.shape[0] < size:
            matrix.resize((size, size))
        if matrix.shape[0] != size:
            raise MeshError(said("matrices.size", where=place, rows=matrix.shape[0], size=size))
        largest = abs(matrix).max() if matrix.nnz else 0.0
        if not np.isfinite(largest):
            raise MeshError(f"{place} holds a number that is not finite.")
        skew = abs(matrix - matrix.T).tocoo()
        if skew.nnz and skew.max() > _UNSYMMETRIC * largest:
            worst = int(skew.data.argmax())
            both = [_named(self.places[int(axis[worst])]) for axis in skew.coords]
            raise MeshError(said("matrices.skew", where=place, both=both, apart=skew.data[worst]))
        return sparse.csr_array(0.5 * (matrix + matrix.T) / self.unit)


def assemble_matrices(design: MatrixDesign, folder: Path, design_hash: str) -> AffineStructure:
    """Make the affine operators of a structure from matrices.

    Raises
    ------
    MeshError
        If a file cannot be read, does not fit the others, lacks what the design names, or is no structure's:
        unsymmetric, indefinite, not held, or with mass that nothing holds.
    """
    files = Matrices(folder, _places(design, folder), design.unit)
    stiffness, mass = (
        sum(files.matrix(name, key) for name in getattr(design, key))
        for key in ("stiffness_matrix", "mass_matrix")
    )
    moves = (stiffness.diagonal() != 0.0) | (mass.diagonal() != 0.0)
    for where, part in design.numbered("support"):
        for node, motion in itertools.product(part.nodes, part.hold):
            moves[files.rows_of((node, MOTIONS.index(motion) + 1), where)] = False
    free = np.flatnonzero(moves)
    if not len(free):
        raise MeshError(f"{folder}: the matrices have no row that is free and has stiffness or mass.")
    _check_whole(stiffness[free][:, free], mass[free][:, free], [files.places[row] for row in free])

    fields = designed(
        design,
        sparse.eye_array(len(moves), format="csc")[:, free].tocsr(),
        mass,
        (_point_mass(part, files, where) for where, part in design.numbered("mass")),
        (_load(part, files, where) for where, part in design.numbered("load")),
        {
            key: sparse.csr_array(np.array([*_rows(design, files, key)]).reshape(-1, len(moves)))
            for key in ("gauge", "displacement", "acceleration", "port")
        },
    )
    return AffineStructure(
        **fields | {"expansion": _expansion(files)[:, free]},
        stiffness_terms=tuple(_stiffness_terms(design, files, stiffness, free)),
        design_hash=design_hash,
    )


def _places(design: MatrixDesign, folder: Path) -> list[Place]:
    if design.unknowns is not None:
        return read_unknowns(folder / design.unknowns)
    found: set[Place] = set()
    for name in design.stiffness_matrix:
        _, own = read_matrix(folder, name)
        if own is None:
            raise MeshError(said("matrices.unnamed", path=folder / name))
        found.update(own)
    return sorted(found)


def _point_mass(part: MatrixMass, files: Matrices, where: str) -> sparse.csr_array:
    """Return the mass matrix (n, n) of 1 kg."""
    if part.matrix is not None:
        return files.matrix(part.matrix, where, partial=True)
    assert part.node is not None
    known = [axis for axis in (1, 2, 3) if (part.node, axis) in files.rows] or [1]
    column = sparse.csr_array(np.array([files.at((part.node, axis), where) for axis in known]).T)
    return sparse.csr_array(column @ column.T)


def _load(load: MatrixLoad, files: Matrices, where: str) -> FloatArray:
    """Return the vector (n,) of a load [N], or of the field of an acceleration [m/s^2]."""
    if load.acceleration is not None:
        return files.everywhere(load.acceleration, where)
    if load.node is not None and load.force is not None:
        return files.along(load.node, load.force, where, PUSHED)
    return files.vector(str(load.vector), where, PUSHED)


def _rows(design: MatrixDesign, files: Matrices, key: str) -> Iterator[FloatArray]:
    """Yield the rows (n,) of strains [1/m], or of displacements, accelerations or ports [1]."""
    scale = 1.0 / design.unit if key == "gauge" else 1.0
    for place, part in design.numbered(key):
        where = f"{place} ({part.name})"
        if part.vector is not None:
            yield scale * files.vector(part.vector, where)
            continue
        assert part.direction is not None
        direction = tuple(unit_vector(part.direction))
        if isinstance(part, Extension):
            first, last = (files.along(node, direction, where) for node in part.nodes or ())
            yield scale * (last - first) / (part.length or 1.0)
        elif part.node is not None:
            yield files.along(part.node, direction, where)


def _expansion(files: Matrices) -> sparse.csr_array:
    """Return the displacements of all nodes (3 nodes, n), zero where the matrices do not tell them."""
    nodes = sorted({node for node, _ in files.places})
    found = sparse.lil_array((3 * len(nodes), len(files.places)))
    for row, place in enumerate(itertools.product(nodes, (1, 2, 3))):
        own = files.rows.get(place, [])
        if len(own) in READ:
            found[row, own] = READ[len(own)]
    return found.tocsr()


def _stiffness_terms(
    design: MatrixDesign, files: Matrices, whole: sparse.csr_array, free: IntArray
) -> Iterator[StiffnessTerm]:
    """Yield the parts, then what they leave of the whole; each at least semidefinite."""
    rest, nominal = whole, {part.name: part.nominal for part in design.parameter}
    for where, part in design.numbered("part"):
        if part.changed is not None and part.times is not None:
            own = (whole - files.matrix(part.changed, where)) / (1.0 - part.times)
        else:
            own = files.matrix(str(part.matrix), where, partial=True)
        rest = rest - own
        inside = _part_of(whole, own, free, said("matrices.softened", where=where))
        if not inside.nnz:
            raise MeshError(f"{where} has no stiffness: its matrix changes nothing that is free.")
        yield StiffnessTerm(inside / nominal.get(part.scaled_by or "", 1.0), part.scaled_by, part.damage)
    left = _part_of(whole, rest, free, said("matrices.overlap"))
    if left.nnz:
        yield StiffnessTerm(left)


def _part_of(
    whole: sparse.csr_array, part: sparse.csr_array, free: IntArray, sentence: str
) -> sparse.csr_array:
    """Return the free rows of a part without what is rounding of the whole; refuse an indefinite one."""
    found, size = part.tocoo(), np.sqrt(np.abs(whole.diagonal()))
    found.data[np.abs(found.data) <= _ROUNDING * size[found.row] * size[found.col]] = 0.0
    inside = found.tocsr()[free][:, free]
    inside.eliminate_zeros()
    _check_definite(inside + _INDEFINITE * whole[free][:, free], sentence)
    return inside


def _check_definite(matrix: sparse.csr_array, sentence: str) -> None:
    try:
        Factorisation(sparse.csr_array(matrix))
    except SolutionError:
        raise MeshError(sentence) from None


def _check_whole(stiffness: sparse.csr_array, mass: sparse.csr_array, places: list[Place]) -> None:
    """Refuse a stiffness that leaves motions free or is indefinite, and mass that is unheld or indefinite."""
    diagonal, heavy = stiffness.diagonal(), mass.diagonal()
    for bad, what in (
        (diagonal < 0.0, "a negative stiffness on its own: the matrix is no structure's at rest"),
        ((diagonal == 0.0) & (heavy != 0.0), "mass but no stiffness: hold it, or give it stiffness"),
        (heavy < 0.0, "a negative mass"),
    ):
        if bad.any():
            more = f" ({int(bad.sum())} rows are like it)" if bad.sum() > 1 else ""
            raise MeshError(f"{_named(places[int(bad.argmax())])} has {what}{more}.")
    try:
        Factorisation(stiffness).solve(np.random.default_rng(16).standard_normal(len(places)))
    except SolutionError:
        _refuse_singular(stiffness, places)
    floor = np.where(heavy > 0.0, heavy, heavy.mean() or 1.0)
    _check_definite(mass + sparse.diags_array(1e-6 * floor), said("matrices.indefinite_mass"))


def _refuse_singular(stiffness: sparse.csr_array, places: list[Place]) -> None:
    """Say which motions a stiffness that cannot be solved with leaves free, or that it is indefinite."""
    scale, identity = sparse.diags_array(1.0 / np.sqrt(stiffness.diagonal())), sparse.eye_array(len(places))
    lifted = sparse.csr_array(scale @ stiffness @ scale + _INDEFINITE * identity)
    _check_definite(lifted, said("matrices.indefinite_stiffness"))
    values, shapes = lowest_eigenpairs(lifted, identity, min(_MOST_FREE, len(places) - 1))
    free = int((values < _INDEFINITE + _FREE).sum())
    moved = int(np.abs(scale @ shapes[:, 0]).argmax())
    raise MeshError(said("matrices.free", count=free or 1, place=_named(places[moved])))
