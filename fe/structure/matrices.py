"""Assemble the affine operators of a structure from matrices.

Matrices are converted to SI units as they are read: stiffness in N/m, mass in kg, unknowns in
metres (rotations times the unit of length). A row that reads a displacement is then, transposed, a
force of 1 N there.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import sparse

from fe.elements.elasticity import unit_vector
from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import MeshError, SolutionError

from .affine import AffineStructure, StiffnessTerm, SupportMotion
from .affine_fields import AffineFields, OutputRows, affine_fields
from .matrix_design import (
    Extension,
    MatrixDesign,
    MatrixLoad,
    MatrixMass,
    NodeOutput,
    StiffnessPart,
)
from .matrix_files import FORCE_WEIGHTS, READ_WEIGHTS, MatrixFiles, describe_dof
from .matrix_tables import Dof, read_matrix, read_unknowns
from .tables import MOTIONS

_ROUNDING = 1e-12
"""Entries of a difference of matrices below this fraction of the diagonal are rounding."""
_INDEFINITE = 1e-3
"""Fraction of the whole by which a part may be negative, as matrices in files are rounded."""
_FREE = 1e-10
"""A mode is free if its stiffness, scaled to a unit diagonal, is below this."""
_MOST_FREE_MOTIONS = 7
"""Free motions that are counted at most."""


@dataclass(frozen=True)
class MatrixStructure(AffineStructure):
    """A structure from matrices.

    Attributes
    ----------
    nodes : tuple of int
        Numbers of the nodes whose displacements `expansion` gives, in their order.
    """

    design: MatrixDesign
    nodes: tuple[int, ...]


def assemble_matrices(
    design: MatrixDesign, folder: Path, design_hash: str, *, yielding: bool = False
) -> MatrixStructure:
    """Assemble the affine operators of a structure from matrices.

    Parameters
    ----------
    folder : Path
        The names of the files are relative to it.
    yielding : bool
        Whether the motions that the supports hold are added as the last unknowns. The nodes of a
        support then shift together, and each turns by the same angle: matrix files have no
        positions of nodes, which a common rotation would need.

    Raises
    ------
    MeshError
        If a file cannot be read, does not fit the others, lacks what the design names, or is not of
        a structure: unsymmetric, indefinite, not held, or with mass that nothing holds.
    """
    files = MatrixFiles(folder, _row_dofs(design, folder), design.unit)
    stiffness = sum(files.matrix(name, "stiffness_matrix") for name in design.stiffness_matrix)
    mass = sum(files.matrix(name, "mass_matrix") for name in design.mass_matrix)
    free_rows = _free_rows(design, files, (stiffness.diagonal() != 0.0) | (mass.diagonal() != 0.0))
    if not len(free_rows):
        raise MeshError(
            f"{folder}: the matrices have no row that is free and has stiffness or mass."
        )
    free_dofs = [files.dofs[row] for row in free_rows]
    _check_structure(stiffness[free_rows][:, free_rows], mass[free_rows][:, free_rows], free_dofs)
    unknowns = _Unknowns(sparse.eye_array(len(files.dofs), format="csc")[:, free_rows].tocsr())
    if yielding:
        unknowns = _with_held_motions(design, files, unknowns)
    fields = _affine_fields_of_matrices(design, files, mass, unknowns)
    # The expansion of the model gives displacements of nodes, not the rows of the matrices.
    fields["expansion"] = (_nodal_displacements(files) @ unknowns.expansion).tocsr()
    return MatrixStructure(
        design=design,
        nodes=tuple(sorted({node for node, _ in files.dofs})),
        **fields,
        stiffness_terms=tuple(_stiffness_terms(design, files, stiffness, unknowns)),
        design_hash=design_hash,
    )


class _Unknowns(NamedTuple):
    """The unknowns of a structure from matrices.

    Attributes
    ----------
    expansion : csr (R, n)
        Unknowns to the R rows of the matrices: first the free rows, then motions of supports.
    motions : tuple of SupportMotion
        The motions of supports.
    """

    expansion: sparse.csr_array
    motions: tuple[SupportMotion, ...] = ()

    @property
    def free_count(self) -> int:
        """The number of unknowns that are free rows."""
        return int(self.expansion.shape[1]) - len(self.motions)


def _with_held_motions(design: MatrixDesign, files: MatrixFiles, unknowns: _Unknowns) -> _Unknowns:
    """Append the motions that the supports hold to the unknowns, as if the supports were free.

    Each motion is a column (R,): the rows of the matrices that move with it have the value 1.
    """
    columns: dict[tuple[str, str], FloatArray] = {}
    for label, support in design.numbered("support"):
        nodes = sorted(support.nodes)
        name = f"node {nodes[0]}" if len(nodes) == 1 else f"nodes {nodes[0]} to {nodes[-1]}"
        for motion in support.hold:
            component = MOTIONS.index(motion) + 1
            column = columns.setdefault((name, motion), np.zeros(len(files.dofs)))
            for node in support.nodes:
                column[files.rows_of((node, component), label)] = 1.0
    motions = tuple(
        SupportMotion(name, motion, unknowns.free_count + index, 0.0)
        for index, (name, motion) in enumerate(columns)
    )
    # a rotation is multiplied by the unit of length, because all unknowns are lengths
    blocks = [
        sparse.csr_array(column[:, np.newaxis] * (files.unit if "r" in motion else 1.0))
        for (_, motion), column in columns.items()
    ]
    return _Unknowns(sparse.hstack((unknowns.expansion, *blocks)).tocsr(), motions)


def _row_dofs(design: MatrixDesign, folder: Path) -> list[Dof]:
    """Return the node and component of each row of the stiffness matrices.

    The file of unknowns names them, or else the files of the stiffness matrices themselves. Raises
    `MeshError` if neither does.
    """
    if design.unknowns is not None:
        return read_unknowns(folder / design.unknowns)
    dofs: set[Dof] = set()
    for name in design.stiffness_matrix:
        _, dofs_in_file = read_matrix(folder, name)
        if dofs_in_file is None:
            raise MeshError(
                f"{folder / name} does not say which node and component each row is; name a file "
                "with a line for each row, such as `97.3`, by the key unknowns."
            )
        dofs.update(dofs_in_file)
    return sorted(dofs)


def _free_rows(design: MatrixDesign, files: MatrixFiles, can_move: FloatArray) -> IntArray:
    """Return the indices of the rows that have stiffness or mass and that no support holds."""
    is_free = can_move.copy()
    for label, support in design.numbered("support"):
        for node, motion in itertools.product(support.nodes, support.hold):
            component = MOTIONS.index(motion) + 1
            is_free[files.rows_of((node, component), label)] = False
    return np.flatnonzero(is_free)


def _affine_fields_of_matrices(
    design: MatrixDesign, files: MatrixFiles, mass: sparse.csr_array, unknowns: _Unknowns
) -> AffineFields:
    """Return the fields of the affine model of matrices, but the stiffness terms.

    Their expansion (R, n) maps the n unknowns to the R rows of the matrices.
    """
    row_count = len(files.dofs)
    # `label` names a row of the design in messages, such as `load[1]`
    point_masses = (_point_mass(part, files, label) for label, part in design.numbered("mass"))
    loads = (_load(load, files, label) for label, load in design.numbered("load"))

    def output_rows(key: str) -> sparse.csr_array:
        rows = [
            _output_row(output, files, f"{label} ({output.name})")
            for label, output in design.numbered(key)
        ]
        return sparse.csr_array(np.array(rows).reshape(-1, row_count))

    return affine_fields(
        design,
        expansion=unknowns.expansion,
        mass=mass,
        point_masses=point_masses,
        loads=loads,
        outputs=OutputRows(
            gauge=output_rows("gauge"),
            displacement=output_rows("displacement"),
            acceleration=output_rows("acceleration"),
            port=output_rows("port"),
        ),
        support_motions=unknowns.motions,
    )


def _point_mass(part: MatrixMass, files: MatrixFiles, where: str) -> sparse.csr_array:
    """Return the mass matrix (n, n) of 1 kg of a point mass."""
    if part.matrix is not None:
        return files.matrix(part.matrix, where, partial=True)
    assert part.node is not None
    dofs = [(part.node, axis) for axis in (1, 2, 3)]
    dofs_with_rows = [dof for dof in dofs if dof in files.rows]
    if not dofs_with_rows:
        dofs_with_rows = dofs[:1]  # refused by name below
    unit_vectors = [files.unit_vector_at(dof, where) for dof in dofs_with_rows]
    selection = sparse.csr_array(np.transpose(unit_vectors))
    return sparse.csr_array(selection @ selection.T)


def _load(load: MatrixLoad, files: MatrixFiles, where: str) -> FloatArray:
    """Return the vector (n,) of a load [N], or of an acceleration [m/s^2] at all rows."""
    if load.acceleration is not None:
        return files.uniform_field(load.acceleration, where)
    if load.node is not None and load.force is not None:
        return files.direction_at(load.node, load.force, where, FORCE_WEIGHTS)
    return files.vector(str(load.vector), where, FORCE_WEIGHTS)


def _output_row(output: Extension | NodeOutput, files: MatrixFiles, where: str) -> FloatArray:
    """Return the row (n,) of a strain [1/m], or of a displacement, acceleration or port [1]."""
    is_strain = isinstance(output, Extension)
    scale = 1.0 / files.unit if is_strain else 1.0
    if output.vector is not None:
        return scale * files.vector(output.vector, where)
    assert output.direction is not None
    x, y, z = unit_vector(output.direction).tolist()
    if isinstance(output, Extension):
        assert output.nodes is not None
        assert output.length is not None
        first_direction, last_direction = (
            files.direction_at(node, (x, y, z), where) for node in output.nodes
        )
        return scale * (last_direction - first_direction) / output.length
    assert output.node is not None
    return files.direction_at(output.node, (x, y, z), where)


def _nodal_displacements(files: MatrixFiles) -> sparse.csr_array:
    """Return the matrix (3 nodes, n) from rows to displacements of all nodes.

    Components without a row are zero.
    """
    nodes = sorted({node for node, _ in files.dofs})
    displacements = sparse.lil_array((3 * len(nodes), len(files.dofs)))
    for component_index, dof in enumerate(itertools.product(nodes, (1, 2, 3))):
        rows = files.rows.get(dof, [])
        if len(rows) in READ_WEIGHTS:
            displacements[component_index, rows] = READ_WEIGHTS[len(rows)]
    return displacements.tocsr()


def _stiffness_terms(
    design: MatrixDesign,
    files: MatrixFiles,
    whole_stiffness: sparse.csr_array,
    unknowns: _Unknowns,
) -> Iterator[StiffnessTerm]:
    """Yield a stiffness term for each part of the design, then one for the remaining stiffness.

    The terms add up to the whole stiffness (R, R). Raises `MeshError` if a part is zero or
    indefinite, or all parts together are stiffer than the whole.
    """
    nominal_values = {parameter.name: parameter.nominal for parameter in design.parameter}
    remainder = whole_stiffness
    for label, part in design.numbered("part"):
        matrix = _part_matrix(part, files, whole_stiffness, label)
        remainder = remainder - matrix
        free_part = _free_part(
            whole_stiffness,
            matrix,
            unknowns,
            refusal=f"{label} takes stiffness away somewhere; its file is of another run or part.",
        )
        if not free_part.nnz:
            raise MeshError(f"{label} has no stiffness: its matrix changes nothing that is free.")
        scale = nominal_values.get(part.scaled_by or "", 1.0)
        yield StiffnessTerm(free_part / scale, part.scaled_by, part.damage)
    free_remainder = _free_part(
        whole_stiffness,
        remainder,
        unknowns,
        refusal="the parts are together stiffer than the whole; two parts must not overlap.",
    )
    if free_remainder.nnz:
        yield StiffnessTerm(free_remainder)


def _part_matrix(
    part: StiffnessPart, files: MatrixFiles, whole_stiffness: sparse.csr_array, where: str
) -> sparse.csr_array:
    """Return the stiffness (R, R) of a part.

    It is read from the part's own file, or follows from the matrix of the whole structure in which
    the modulus of the part is multiplied by a factor.
    """
    if part.changed is not None and part.times is not None:
        # whole - changed = (1 - factor) * part
        changed_stiffness = files.matrix(part.changed, where)
        return (whole_stiffness - changed_stiffness) / (1.0 - part.times)
    return files.matrix(str(part.matrix), where, partial=True)


def _free_part(
    whole_stiffness: sparse.csr_array, part: sparse.csr_array, unknowns: _Unknowns, *, refusal: str
) -> sparse.csr_array:
    """Project the stiffness (R, R) of a part on the unknowns.

    Entries that are rounding errors of the whole stiffness are set to zero. Raises `MeshError` with
    the sentence `refusal` if the part is indefinite.
    """
    entries = part.tocoo()
    scale = np.sqrt(np.abs(whole_stiffness.diagonal()))
    is_rounding = np.abs(entries.data) <= _ROUNDING * scale[entries.row] * scale[entries.col]
    entries.data[is_rounding] = 0.0
    expansion = unknowns.expansion
    part_of_unknowns = (expansion.T @ (entries.tocsr() @ expansion)).tocsr()
    part_of_unknowns.eliminate_zeros()
    free = slice(0, unknowns.free_count)
    free_expansion = expansion[:, free]
    free_whole = free_expansion.T @ (whole_stiffness @ free_expansion)
    _check_definite(part_of_unknowns[free, free] + _INDEFINITE * free_whole, refusal)
    return part_of_unknowns


def _check_definite(matrix: sparse.csr_array, refusal: str) -> None:
    """Raise `MeshError` with the sentence `refusal` if a matrix is not positive definite."""
    try:
        Factorisation(sparse.csr_array(matrix))
    except SolutionError:
        raise MeshError(refusal) from None


def _check_structure(stiffness: sparse.csr_array, mass: sparse.csr_array, dofs: list[Dof]) -> None:
    """Raise `MeshError` if matrices (m, m) of the free rows cannot be those of a held structure.

    The stiffness must be positive definite and not nearly singular. The mass must be positive
    semidefinite, but for a tolerance of 1e-6 of its diagonal.
    """
    stiffness_diagonal = stiffness.diagonal()
    mass_diagonal = mass.diagonal()
    _check_rows(
        dofs,
        stiffness_diagonal < 0.0,
        "a negative stiffness on its own: the matrix cannot belong to a structure at rest",
    )
    _check_rows(
        dofs,
        (stiffness_diagonal == 0.0) & (mass_diagonal != 0.0),
        "mass but no stiffness: hold it, or give it stiffness",
    )
    _check_rows(dofs, mass_diagonal < 0.0, "a negative mass")
    # The factorisation fails if the stiffness is not positive definite. If it is nearly singular,
    # rounding errors may let it succeed. But a random load moves all weakly held motions, and
    # `solve` raises the error, since the solution is inaccurate.
    try:
        Factorisation(stiffness).solve(np.random.default_rng(16).standard_normal(len(dofs)))
    except SolutionError:
        _refuse_singular(stiffness, dofs)
    # a small mass is added to each row, so that massless rows pass the test of definiteness
    row_mass = np.where(mass_diagonal > 0.0, mass_diagonal, mass_diagonal.mean() or 1.0)
    _check_definite(
        mass + sparse.diags_array(1e-6 * row_mass),
        "the mass matrix is indefinite: some motion of the structure has negative mass.",
    )


def _check_rows(dofs: list[Dof], is_faulty: FloatArray, fault: str) -> None:
    """Raise `MeshError` if any of the m rows is faulty; the message names the first one.

    `fault` completes the sentence "node 1, component 2 has": "a negative mass".
    """
    count = int(is_faulty.sum())
    if not count:
        return
    first_row = describe_dof(dofs[int(is_faulty.argmax())])
    count_text = f" ({count} rows are like it)" if count > 1 else ""
    raise MeshError(f"{first_row} has {fault}{count_text}.")


def _refuse_singular(stiffness: sparse.csr_array, dofs: list[Dof]) -> None:
    """Raise the `MeshError` for a stiffness that is indefinite or leaves motions free.

    The message counts the free motions and names the degree of freedom that moves most in one.
    """
    # unit diagonal, lifted so that free motions have the least positive eigenvalues
    scale = sparse.diags_array(1.0 / np.sqrt(stiffness.diagonal()))
    identity = sparse.eye_array(len(dofs))
    lifted = sparse.csr_array(scale @ stiffness @ scale + _INDEFINITE * identity)
    _check_definite(
        lifted,
        "the stiffness is indefinite: some motion of the structure has negative stiffness.",
    )
    count = min(_MOST_FREE_MOTIONS, len(dofs) - 1)
    eigenvalues, shapes = lowest_eigenpairs(lifted, identity, count)
    free_count = int((eigenvalues < _INDEFINITE + _FREE).sum())
    lowest_shape = shapes.T[0]
    largest_row = int(np.abs(scale @ lowest_shape).argmax())
    raise MeshError(
        f"motions that the stiffness leaves free, or nearly: {free_count or 1}; in one "
        f"{describe_dof(dofs[largest_row])} moves most. Hold the structure by [[support]] "
        "in its structure file, or before its matrices are written (in a deck: *BOUNDARY)."
    )
