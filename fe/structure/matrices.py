"""From matrices and a structure file to affine operators, and what is said of matrices that are no structure.

Unknowns stay in the unit of length of the matrices, so that these are taken as they are; rows that read a
displacement, and masses and accelerations, are turned into SI units.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, eigsh

from fe.full.cholesky import Cholesky
from fe.full.statics import Factorisation
from fe.runtime.errors import MeshError, SolutionError

from .affine import DesignedStructure, LoadTerm, StiffnessTerm, names_of
from .design import unit_vector
from .matrix_design import MatrixDesign, MatrixMass
from .matrix_files import Place, read_matrix, read_unknowns, read_vector
from .rosettes import Vector
from .tables import MOTIONS

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Shares = Mapping[int, tuple[float, ...]]

READ: Shares = {
    1: (1.0,),
    2: (0.5,) * 2,
    3: (1 / 6, 2 / 3, 1 / 6),
    4: (0.25,) * 4,
    8: (0.25,) * 4 + (0.0,) * 4,
}
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
_SMALL, _MOTIONS = 32, 12  # matrices that are solved densely; motions that are looked at in larger ones


@dataclass(frozen=True)
class Unknowns:
    """Node and component of each of the n rows of the matrices."""

    places: list[Place]

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
            raise MeshError(
                f"{where}: node {node} has no component {component} in the matrices, which know "
                f"{f'its components {own}' if own else 'no such node'}; what is held or tied when they are "
                "written is not among them: name another node."
            )
        return self.rows[place]

    def vector(self, place: Place, where: str, shares: Shares = READ) -> FloatArray:
        """Vector (n,) of 1 at a node's component, shared among the rows of that name.

        Raises
        ------
        MeshError
            If the matrices have no such row, or so many that it is not known how they share.
        """
        own = self.rows_of(place, where)
        if len(own) not in shares:
            raise MeshError(
                f"{where}: node {place[0]} has {len(own)} rows of component {place[1]}, and how these share "
                "what acts on the node is not known; name another node, or give a vector."
            )
        found = np.zeros(len(self.places))
        found[own] = shares[len(own)]
        return found

    def along(self, node: int, direction: Vector, where: str, shares: Shares = READ) -> FloatArray:
        """Vector (n,) of a direction (3,) at a node."""
        parts = [
            value * self.vector((node, component), where, shares)
            for component, value in enumerate(direction, start=1)
            if value
        ]
        return np.asarray(np.sum(parts, axis=0))

    def everywhere(self, field: Vector, where: str) -> FloatArray:
        """Vector (n,) of a shift of all nodes; raises `MeshError` where turns may look like shifts."""
        if len(self.rows) < len(self.places):
            raise MeshError(
                f"{where}: several rows of the matrices carry one name, as those of expanded shells and "
                "beams do, and rows that turn cannot be told from rows that shift; give the load as a vector."
            )
        return np.array([field[component - 1] if component <= 3 else 0.0 for _, component in self.places])


@dataclass(frozen=True)
class MatrixStructure(DesignedStructure):
    """Finite element model of a structure from matrices.

    Attributes
    ----------
    design : MatrixDesign
        What was asked for.
    held : int
        Rows of the matrices that are held.
    loose : int
        Rows without stiffness and mass, which are left out.
    """

    design: MatrixDesign
    held: int
    loose: int


@dataclass(frozen=True)
class _Matrices:
    """The files of a design: matrices on all rows, and vectors."""

    folder: Path
    unknowns: Unknowns
    unit: float

    def matrix(self, name: str, where: str, *, partial: bool = False) -> sparse.csr_array:
        """Return a symmetric matrix (n, n), its rows in the order of the unknowns.

        A `partial` one may end before them, as a table does whose last rows are zero.
        """
        stored = read_matrix(self.folder, name)
        matrix, size = stored.matrix, len(self.unknowns.places)
        place = f"{where}: {self.folder / name}"
        if stored.places is not None:
            rows = [self.unknowns.rows_of(own, place)[0] for own in stored.places]
            chosen = sparse.coo_array(
                (np.ones(len(rows)), (rows, np.arange(len(rows)))), (size, len(rows))
            ).tocsr()
            matrix = sparse.csr_array(chosen @ matrix @ chosen.T)
        if partial and matrix.shape[0] < size:
            matrix.resize((size, size))
        if matrix.shape[0] != size:
            raise MeshError(
                f"{place} has {matrix.shape[0]} rows, but there are {size} unknowns; matrices and unknowns "
                "must be of the same run."
            )
        largest = abs(matrix).max() if matrix.nnz else 0.0
        if not np.isfinite(largest):
            raise MeshError(f"{place} holds a number that is not finite.")
        skew = abs(matrix - matrix.T).tocoo()
        if skew.nnz and skew.max() > _UNSYMMETRIC * largest:
            worst = int(skew.data.argmax())
            row, column = (_named(self.unknowns.places[int(axis[worst])]) for axis in skew.coords)
            raise MeshError(
                f"{place} is not symmetric: its entries between {row} and {column} differ by "
                f"{skew.data[worst]:.3g}; friction, follower loads and gyroscopic terms cannot be taken."
            )
        return sparse.csr_array(0.5 * (matrix + matrix.T))

    def sum(self, names: tuple[str, ...], where: str) -> sparse.csr_array:
        """Return the sum of matrices."""
        return sparse.csr_array(sum(self.matrix(name, where) for name in names))

    def vector(self, name: str, where: str, shares: Shares = READ) -> FloatArray:
        """Return a vector (n,)."""

        def named(place: Place) -> FloatArray:
            return self.unknowns.vector(place, where, shares)

        return read_vector(self.folder, name, named, len(self.unknowns.places))


def _named(place: Place) -> str:
    return f"node {place[0]}, component {place[1]}"


def assemble_matrices(design: MatrixDesign, folder: Path, design_hash: str) -> MatrixStructure:
    """Make the affine operators of a structure from matrices.

    Raises
    ------
    MeshError
        If a file cannot be read, does not fit the others, lacks what the design names, or is no structure's:
        unsymmetric, indefinite, not held, or with mass that nothing holds.
    """
    files = _Matrices(folder, _unknowns(design, folder), design.unit)
    stiffness = files.sum(design.stiffness_matrix, "stiffness_matrix")
    mass = files.sum(design.mass_matrix, "mass_matrix")
    held = _held(design, files.unknowns)
    loose = ~held & (stiffness.diagonal() == 0.0) & (mass.diagonal() == 0.0)
    free = np.flatnonzero(~held & ~loose)
    _check_whole(stiffness[free][:, free], mass[free][:, free], [files.unknowns.places[row] for row in free])

    chosen = tuple(part for part in design.mass if part.free)
    own = {part.name: _point_mass(part, files, number) for number, part in enumerate(design.mass, start=1)}
    for part in design.mass:
        if not part.free:
            mass = mass + part.mass * own[part.name]
    masses: dict[str | None, sparse.csr_array] = {None: mass} | {part.name: own[part.name] for part in chosen}
    outputs = {key: _rows(design, files, key)[:, free] for key in ("gauge", "displacement", "acceleration")}
    return MatrixStructure(
        **names_of(design),
        stiffness_terms=tuple(_stiffness_terms(design, files, stiffness, free)),
        mass_terms=tuple(term[free][:, free] for term in masses.values()),
        load_terms=tuple(
            replace(term, vector=term.vector[free]) for term in _load_terms(design, files, masses)
        ),
        gauge_output=outputs["gauge"],
        displacement_output=outputs["displacement"],
        acceleration_output=outputs["acceleration"],
        expansion=_expansion(design, files.unknowns)[:, free],
        design_hash=design_hash,
        design=design,
        held=int(held.sum()),
        loose=int(loose.sum()),
    )


def _unknowns(design: MatrixDesign, folder: Path) -> Unknowns:
    if design.unknowns is not None:
        return Unknowns(read_unknowns(folder / design.unknowns))
    places = [read_matrix(folder, name).places for name in design.stiffness_matrix]
    if any(own is None for own in places):
        raise MeshError(
            f"{folder / design.stiffness_matrix[0]} does not say which node and component each row is; name "
            "a file with a line for each row, such as `97.3`, by the key unknowns."
        )
    return Unknowns(sorted({place for own in places for place in own or ()}))


def _held(design: MatrixDesign, unknowns: Unknowns) -> BoolArray:
    """Return which rows (n,) the supports hold."""
    held = np.zeros(len(unknowns.places), dtype=bool)
    for number, part in enumerate(design.support, start=1):
        for node in part.nodes:
            for motion in part.hold:
                held[unknowns.rows_of((node, MOTIONS.index(motion) + 1), f"support[{number}]")] = True
    return held


def _point_mass(part: MatrixMass, files: _Matrices, number: int) -> sparse.csr_array:
    """Return the mass matrix (n, n) of 1 kg, in the unit of the matrices."""
    where = f"mass[{number}]"
    if part.matrix is not None:
        return files.matrix(part.matrix, where, partial=True)
    assert part.node is not None
    known = [component for component in (1, 2, 3) if (part.node, component) in files.unknowns.rows]
    columns = [files.unknowns.vector((part.node, component), where) for component in known or (1,)]
    column = sparse.csr_array(np.array(columns).T)
    return sparse.csr_array(files.unit * (column @ column.T))


def _load_terms(
    design: MatrixDesign, files: _Matrices, masses: dict[str | None, sparse.csr_array]
) -> Iterator[LoadTerm]:
    """Yield the parts of every load on all rows; an acceleration acts on 1 kg of each free mass as well."""
    for number, load in enumerate(design.load, start=1):
        where = f"load[{number}]"
        if load.vector is not None:
            yield LoadTerm(load.name, files.vector(load.vector, where, PUSHED))
        elif load.node is not None and load.force is not None:
            yield LoadTerm(load.name, files.unknowns.along(load.node, load.force, where, PUSHED))
        elif load.acceleration is not None:
            field = files.unknowns.everywhere(load.acceleration, where) / design.unit
            for name, term in masses.items():
                yield LoadTerm(load.name, np.asarray(term @ field), name)


def _rows(design: MatrixDesign, files: _Matrices, key: str) -> sparse.csr_array:
    """Return the rows (m, n) of outputs, displacements in metres."""
    rows = [np.zeros((0, len(files.unknowns.places)))]
    for number, part in enumerate(getattr(design, key), start=1):
        where = f"{key}[{number}] ({part.name})"
        if part.vector is not None:
            row = files.vector(part.vector, where)
        else:
            direction = tuple(unit_vector(part.direction))
            ends = [files.unknowns.along(node, direction, where) for node in part.ends]
            row = (ends[-1] - ends[0]) / part.length if key == "gauge" else ends[0]
        rows.append((row if key == "gauge" else design.unit * row)[None])
    return sparse.csr_array(np.vstack(rows))


def _expansion(design: MatrixDesign, unknowns: Unknowns) -> sparse.csr_array:
    """Return the displacements [m] of all nodes (3 nodes, n), zero where the matrices do not tell them."""
    nodes = {node: number for number, node in enumerate(sorted({node for node, _ in unknowns.places}))}
    entries = [
        (3 * nodes[node] + component - 1, row, design.unit * share)
        for (node, component), own in unknowns.rows.items()
        if component <= 3
        for row, share in zip(own, READ.get(len(own), ()), strict=False)
    ]
    row, column, value = np.array(entries).T
    shape = (3 * len(nodes), len(unknowns.places))
    return sparse.coo_array((value, (row.astype(int), column.astype(int))), shape).tocsr()


def _stiffness_terms(
    design: MatrixDesign, files: _Matrices, whole: sparse.csr_array, free: IntArray
) -> Iterator[StiffnessTerm]:
    """Yield the parts, then what they leave of the whole; each at least semidefinite."""
    rest, stiffness = whole, whole[free][:, free]
    nominal = {part.name: part.nominal for part in design.parameter}
    for number, part in enumerate(design.part, start=1):
        where = f"part[{number}]"
        if part.matrix is not None:
            own = files.matrix(part.matrix, where, partial=True)
        else:
            assert part.changed is not None
            assert part.times is not None
            own = (whole - files.matrix(part.changed, where)) / (1.0 - part.times)
        own, rest = _without_rounding(own, whole), rest - own
        inside = own[free][:, free]
        if not inside.nnz:
            raise MeshError(f"{where} has no stiffness: its matrix changes nothing that is free.")
        _check_part(
            inside, stiffness, f"{where} takes stiffness away somewhere; its file is of another run or part"
        )
        yield StiffnessTerm(inside / nominal.get(part.scaled_by or "", 1.0), part.scaled_by, part.damage)
    rest = _without_rounding(rest, whole)[free][:, free]
    if rest.nnz:
        _check_part(
            rest, stiffness, "the parts are together stiffer than the whole; two parts must not overlap"
        )
        yield StiffnessTerm(rest)


def _without_rounding(part: sparse.csr_array, whole: sparse.csr_array) -> sparse.csr_array:
    """Return a part of a matrix without entries that are rounding of the whole."""
    found, size = part.tocoo(), np.sqrt(np.abs(whole.diagonal()))
    row, column = found.coords
    kept = np.abs(found.data) > _ROUNDING * size[row] * size[column]
    return sparse.coo_array((found.data[kept], (row[kept], column[kept])), found.shape).tocsr()


def _check_part(part: sparse.csr_array, whole: sparse.csr_array, sentence: str) -> None:
    try:
        Cholesky((part + _INDEFINITE * whole).tocsr())
    except SolutionError:
        raise MeshError(f"{sentence}: with it the stiffness is not positive definite.") from None


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
        raise MeshError(_why_singular(stiffness, places)) from None
    floor = np.where(heavy > 0.0, heavy, heavy.mean() or 1.0)
    try:
        Cholesky((mass + sparse.diags_array(1e-6 * floor)).tocsr())
    except SolutionError:
        raise MeshError(
            "the mass matrix is indefinite: some motion of the structure has negative mass."
        ) from None


def _why_singular(stiffness: sparse.csr_array, places: list[Place]) -> str:
    """Return which motions a stiffness that cannot be solved with leaves free, or that it is indefinite."""
    scale = sparse.diags_array(1.0 / np.sqrt(stiffness.diagonal()))
    scaled = sparse.csr_array(scale @ stiffness @ scale)
    count = len(places)
    try:
        inverse = Cholesky((scaled + _INDEFINITE * sparse.eye_array(count)).tocsr())
    except SolutionError:
        return "the stiffness is indefinite: some motion of the structure has negative stiffness."
    if count <= _SMALL:
        values, shapes = np.linalg.eigh(scaled.toarray())
    else:
        operator = LinearOperator((count, count), matvec=inverse.solve, dtype=float)
        start = np.random.default_rng(16).standard_normal(count)
        values, shapes = eigsh(scaled, k=_MOTIONS, sigma=-_INDEFINITE, OPinv=operator, v0=start)
    free = values < max(_FREE, 1.01 * float(values.min()))
    moved = int(np.abs(scale @ shapes[:, values.argmin()]).argmax())
    return (
        f"the stiffness leaves {free.sum()} motions free, or nearly; in one {_named(places[moved])} "
        "moves most. Hold the structure by [[support]], or before its matrices are written."
    )
