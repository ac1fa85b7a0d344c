"""Motions without rows of their own in CalculiX's matrices: tied nodes, and rotations.

A tied node has no row in the matrices, because CalculiX eliminates it: its motion is a weighted sum
of rows. A weak spring of stiffness k between the node and an added node r shows the weights: in the
column of r, the stored stiffness holds -k times the weight of each row.

Shells and beams have no rotations as unknowns either. If a node bears a moment, CalculiX replaces
another unknown by the mean rotation of its section. The weights of the rotation follow from the
stiffness before and after this substitution.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fe.full.factorisation import Factorisation
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import CalculixError
from fe.structure.abaqus import DataLine, KeywordBlock
from fe.structure.matrix_tables import Dof

from .calculix_jobs import CalculixJobs, StoredMatrices
from .linear_model import ROTATIONS, TRANSLATIONS, real_text
from .loads import DeckLoad
from .row_vectors import MotionReader, WeightedRows

_PROBE_STIFFNESS = 1.0
_SMALLEST_WEIGHT = 1e-9
"""Weights below this, relative to the largest, are rounding."""
_SMALLEST_MOTION = 1e-6
"""Motions of nodes below this, relative to the largest of any row, are rounding."""
MOST_MOMENTS = 40
"""Largest number of nodes and directions with moments, each of which takes a run of CalculiX."""


class _Probe(NamedTuple):
    """A spring that shows the weights of a motion.

    Attributes
    ----------
    motion : Dof
        Node and direction of the motion.
    added_node : int
        The added node at the other end, which has a row in this direction.
    direction : int
        The direction of the spring at the added node.
    """

    motion: Dof
    added_node: int
    direction: int


def read_tied_motions(
    jobs: CalculixJobs,
    blocks: Sequence[KeywordBlock],
    matrices: StoredMatrices,
    dofs: Sequence[Dof],
) -> dict[Dof, WeightedRows]:
    """Return the motions of tied nodes as weighted rows of the matrices.

    Parameters
    ----------
    matrices : StoredMatrices
        The matrices of these blocks.
    dofs : sequence of Dof
        Degrees of freedom without rows.

    Returns
    -------
    dict of Dof to WeightedRows
        The weights of each motion; motions whose weights CalculiX does not show are left out.

    Raises
    ------
    CalculixError
        If CalculiX fails.
    """
    if not dofs:
        return {}
    first_added = _free_number(jobs)
    nodes = list(dict.fromkeys(node for node, _ in dofs))
    added_node = {node: first_added + number for number, node in enumerate(nodes)}
    probes = [_Probe((node, axis), added_node[node], axis) for node, axis in dofs]
    added_blocks = _added_nodes(jobs, {added_node[node]: node for node in nodes})
    added_blocks += _supports_of(probes)
    for probe in probes:
        node, axis = probe.motion
        added_blocks += _spring(jobs, probe.added_node, (node, axis), (probe.added_node, axis))
    return _weights_of(jobs, [*blocks, *added_blocks], matrices, probes)


def read_rotations(
    jobs: CalculixJobs,
    blocks: Sequence[KeywordBlock],
    matrices: StoredMatrices,
    dofs: Sequence[Dof],
) -> dict[Dof, WeightedRows]:
    """Return rotations of nodes of shells and beams as weighted rows of the matrices.

    The parameters are those of `read_tied_motions`, with the directions 4, 5 and 6.

    Raises
    ------
    CalculixError
        If CalculiX fails.
    SolutionError
        If the stiffness cannot be factorised.
    """
    mean_rotations = {}
    rigid_sections = []
    for dof in dofs:
        weights = _mean_rotation(jobs, blocks, matrices, dof)
        if weights is None:
            rigid_sections.append(dof)
        else:
            mean_rotations[dof] = weights
    signed = _with_signs(jobs, blocks, matrices, mean_rotations)
    return signed | _rotations_of_rigid_sections(jobs, blocks, matrices, rigid_sections)


def _mean_rotation(
    jobs: CalculixJobs,
    blocks: Sequence[KeywordBlock],
    matrices: StoredMatrices,
    dof: Dof,
) -> WeightedRows | None:
    """Return the weights of the mean rotation of a node's section, up to their common sign.

    A deck with a moment at the node has this rotation as an unknown, in place of another unknown
    u_e. From rotation = sum_i c_i u_i it follows that u_e = (rotation - sum of the other c_i u_i) /
    c_e. In the new stiffness the row of the rotation therefore has K_ee / c_e^2 on the diagonal,
    and (K_ei - K_ee c_i / c_e) / c_e elsewhere, where K is the stiffness without the moment. These
    are solved for the weights c. The result is None if the moment makes no new unknown.
    """
    # the matrices with a moment at the node, and the unknowns that it adds and removes
    node, direction = dof
    loaded = jobs.matrices("moment", blocks, step_lines=("*CLOAD", f"{node},{direction},1."))
    new_dofs = Counter(loaded.dofs) - Counter(matrices.dofs)
    lost_dofs = Counter(matrices.dofs) - Counter(loaded.dofs)
    if new_dofs.total() != 1 or lost_dofs.total() != 1:
        return None
    rotation = loaded.dofs.index(next(iter(new_dofs)))
    eliminated = _eliminated_row(matrices, loaded, rotation, next(iter(lost_dofs)))
    if eliminated is None:
        return None
    # rows K_e of the eliminated unknown, and of the rotation in the new stiffness
    other_rows = np.delete(np.arange(len(matrices.dofs)), eliminated)
    other_rows_loaded = np.delete(np.arange(len(loaded.dofs)), rotation)
    old_row = matrices.stiffness[[eliminated]].toarray().ravel()
    new_row = loaded.stiffness[[rotation]].toarray().ravel()
    # c_e from the diagonals, then the other c_i
    weights = np.empty(len(matrices.dofs))
    weights[eliminated] = np.sqrt(old_row[eliminated] / new_row[rotation])
    difference = old_row[other_rows] - weights[eliminated] * new_row[other_rows_loaded]
    weights[other_rows] = difference * weights[eliminated] / old_row[eliminated]
    return _significant(weights)


def _eliminated_row(
    matrices: StoredMatrices, loaded: StoredMatrices, rotation: int, lost_dof: Dof
) -> int | None:
    """Return the row that a rotation replaces; None if the order of the other rows differs.

    If several rows belong to the lost degree of freedom, the replaced one is that without which the
    diagonals of both matrices have the most entries in common.
    """
    remaining = np.delete(loaded.stiffness.diagonal(), rotation)
    remaining_dofs = [*loaded.dofs[:rotation], *loaded.dofs[rotation + 1 :]]
    diagonal = matrices.stiffness.diagonal()
    best_row = None
    fewest_changes = len(diagonal)
    for row, dof in enumerate(matrices.dofs):
        if dof != lost_dof:
            continue
        if [*matrices.dofs[:row], *matrices.dofs[row + 1 :]] != remaining_dofs:
            continue
        changes = int(np.sum(~np.isclose(np.delete(diagonal, row), remaining, rtol=1e-10)))
        if changes < fewest_changes:
            best_row = row
            fewest_changes = changes
    return best_row


def _with_signs(
    jobs: CalculixJobs,
    blocks: Sequence[KeywordBlock],
    matrices: StoredMatrices,
    rotations: Mapping[Dof, WeightedRows],
) -> dict[Dof, WeightedRows]:
    """Give the weights of each rotation the sign with which CalculiX moves the nodes.

    A moment in positive direction shows the sign by the displacements of the nodes. Torsion of a
    straight beam moves no node of the deck. The sign then follows from the positions of the
    expanded nodes in the section, which the rotations about the two other axes show. A rotation
    whose sign remains unknown is left out.
    """
    if not rotations:
        return {}
    signs_of_rotations = _signs_by_displacements(jobs, blocks, matrices, rotations)
    for dof, sign in list(signs_of_rotations.items()):
        if sign != 0.0:
            continue
        node, direction = dof
        other_rotations = {}
        for other_direction in ROTATIONS:
            weights = _mean_rotation(jobs, blocks, matrices, (node, other_direction))
            if other_direction != direction and weights is not None:
                other_rotations[node, other_direction] = weights
        signs = _signs_by_displacements(jobs, blocks, matrices, other_rotations)
        signed = {key: weights.times(signs[key]) for key, weights in other_rotations.items()}
        signs_of_rotations[dof] = _sign_by_section(matrices.dofs, dof, rotations[dof], signed)
    return {
        dof: weights.times(signs_of_rotations[dof])
        for dof, weights in rotations.items()
        if signs_of_rotations[dof]
    }


def _signs_by_displacements(
    jobs: CalculixJobs,
    blocks: Sequence[KeywordBlock],
    matrices: StoredMatrices,
    rotations: Mapping[Dof, WeightedRows],
) -> dict[Dof, float]:
    """Return 1, -1, or 0 if the moment moves no node, for each rotation of unknown sign."""
    if not rotations:
        return {}
    count = len(matrices.dofs)
    moments = np.column_stack([weights.vector(count) for weights in rotations.values()])
    solutions = Factorisation(matrices.stiffness).solve(moments)
    loads = [
        DeckLoad("moment", lines=["*CLOAD", f"{node},{direction},1."])
        for node, direction in rotations
    ]
    printed = jobs.displacements(loads, blocks, preloaded=False)
    reader = MotionReader(matrices.dofs)
    signs = {}
    for dof, solution, displacements in zip(rotations, solutions.T, printed, strict=True):
        values_solved = []
        values_printed = []
        for node, displacement in displacements.items():
            for axis in TRANSLATIONS:
                value = reader.displacement(solution, (node, axis))
                if value is not None:
                    values_solved.append(value)
                    values_printed.append(displacement[axis - 1])
        largest = max(map(abs, values_solved), default=0.0)
        moves = largest > _SMALLEST_MOTION * np.abs(solution).max()
        signs[dof] = float(np.sign(np.dot(values_solved, values_printed))) if moves else 0.0
    return signs


def _sign_by_section(
    dofs: Sequence[Dof],
    dof: Dof,
    weights: WeightedRows,
    others: Mapping[Dof, WeightedRows],
) -> float:
    """Return the sign of a rotation about an axis from those about the two other axes.

    The mean rotation about an axis a has the weights w = (a x p) / (m |p|^2) at each of m expanded
    nodes, where p is the position of the node in the section without its component along a. Hence p
    is -(a x w) / |w|^2 up to a positive factor. The sign is 0 if the other rotations do not show
    the positions.
    """
    node, direction = dof
    axis = np.eye(3)[direction - 4]
    section = np.zeros((0, 3))
    for (_, other), other_weights in others.items():
        other_axis = np.eye(3)[other - 4]
        vectors = _vectors_of_section(dofs, node, other_weights)
        squares = np.sum(vectors**2, axis=1, keepdims=True)
        offsets = np.divide(
            -np.cross(other_axis, vectors), squares, out=np.zeros_like(vectors), where=squares > 0.0
        )
        # The component along the axis of the torsion does not matter.
        offsets -= np.outer(offsets @ axis, axis)
        section = section + offsets if len(section) else offsets
    if not len(section):
        return 0.0
    vectors = _vectors_of_section(dofs, node, weights)
    return float(np.sign(np.sum(vectors * np.cross(axis, section))))


def _vectors_of_section(dofs: Sequence[Dof], node: int, weights: WeightedRows) -> FloatArray:
    """Return the weights (m, 3) of the expanded nodes of a node, in the order of the rows."""
    dense = weights.vector(len(dofs))
    vectors: list[FloatArray] = []
    previous_axis = 4
    for row, (row_node, axis) in enumerate(dofs):
        if row_node != node:
            continue
        if axis <= previous_axis:
            vectors.append(np.zeros(3))
        vectors[-1][axis - 1] = dense[row]
        previous_axis = axis
    return np.array(vectors)


def _rotations_of_rigid_sections(
    jobs: CalculixJobs,
    blocks: Sequence[KeywordBlock],
    matrices: StoredMatrices,
    dofs: Sequence[Dof],
) -> dict[Dof, WeightedRows]:
    """Return the weights of rotations that are unknowns already, such as where beams meet shells.

    CalculiX makes such a section rigid. An equation lets an added node follow the rotation; a weak
    spring between it and a second added node then shows the weights, as for a tied node.
    """
    if not dofs:
        return {}
    first_added = _free_number(jobs)
    probes: list[_Probe] = []
    positions: dict[int, int] = {}
    added_blocks: list[KeywordBlock] = []
    for number, (node, direction) in enumerate(dofs):
        follower = first_added + 2 * number
        probe = _Probe((node, direction), follower + 1, 1)
        positions |= {follower: node, probe.added_node: node}
        terms = [str(text) for text in (follower, 1, 1.0, node, direction, -1.0)]
        lines = [DataLine("", ["2"]), DataLine("", terms)]
        added_blocks.append(KeywordBlock("", "EQUATION", {}, lines))
        added_blocks += _spring(jobs, follower, (follower, 1), (probe.added_node, 1))
        added_blocks += _supports_of([_Probe(probe.motion, follower, 1), probe])
        probes.append(probe)
    added_blocks = [*_added_nodes(jobs, positions), *added_blocks]
    return _weights_of(jobs, [*blocks, *added_blocks], matrices, probes)


def _free_number(jobs: CalculixJobs) -> int:
    """Return the first number that is neither a node's nor an element's."""
    mesh = jobs.model.mesh
    largest_node = max(mesh.points)
    largest_element = max(mesh.elements)
    return max(largest_node, largest_element) + 1


def _added_nodes(jobs: CalculixJobs, positions: Mapping[int, int]) -> list[KeywordBlock]:
    """Return the *NODE block of added nodes, each at the position of a node of the deck."""
    lines = []
    for added, node in positions.items():
        coordinates = [real_text(value) for value in jobs.model.mesh.points[node].tolist()]
        lines.append(DataLine("", [str(added), *coordinates]))
    return [KeywordBlock("", "NODE", {}, lines)]


def _supports_of(probes: Sequence[_Probe]) -> list[KeywordBlock]:
    """Return the *BOUNDARY block that holds added nodes in the directions without a spring."""
    free: dict[int, set[int]] = {}
    for probe in probes:
        free.setdefault(probe.added_node, set()).add(probe.direction)
    lines = [
        DataLine("", [str(node), str(axis)])
        for node, axes in free.items()
        for axis in TRANSLATIONS
        if axis not in axes
    ]
    return [KeywordBlock("", "BOUNDARY", {}, lines)] if lines else []


def _spring(jobs: CalculixJobs, number: int, first: Dof, second: Dof) -> list[KeywordBlock]:
    """Return the blocks *ELEMENT and *SPRING of a weak spring between two degrees of freedom."""
    element = 3 * number + first[1]
    name = f"UAVPROBE{element}"
    ends = [str(element), str(first[0]), str(second[0])]
    return [
        KeywordBlock("", "ELEMENT", {"TYPE": "SPRING2", "ELSET": name}, [DataLine("", ends)]),
        KeywordBlock(
            "",
            "SPRING",
            {"ELSET": name},
            [
                DataLine("", [str(first[1]), str(second[1])]),
                DataLine("", [real_text(_PROBE_STIFFNESS)]),
            ],
        ),
    ]


def _weights_of(
    jobs: CalculixJobs,
    blocks: Sequence[KeywordBlock],
    matrices: StoredMatrices,
    probes: Sequence[_Probe],
) -> dict[Dof, WeightedRows]:
    """Return the weights of each motion to which a spring was added, from the stored stiffness.

    The result is empty if CalculiX fails, or if the springs change the rows of the matrices.
    """
    try:
        probed = jobs.matrices("probes", blocks)
    except CalculixError:
        return {}
    added_nodes = {probe.added_node for probe in probes}
    rows = [row for row, (node, _) in enumerate(probed.dofs) if node not in added_nodes]
    if not _are_same_rows(jobs, [probed.dofs[row] for row in rows], matrices.dofs):
        return {}
    weights_of_motions = {}
    for probe in probes:
        dof = (probe.added_node, probe.direction)
        column = probed.stiffness[[probed.dofs.index(dof)]].toarray().ravel()
        weights = -column[rows] / _PROBE_STIFFNESS
        if weights.any():
            weights_of_motions[probe.motion] = _significant(weights)
    return weights_of_motions


def _are_same_rows(jobs: CalculixJobs, dofs: Sequence[Dof], expected: Sequence[Dof]) -> bool:
    """Return whether rows have the same names, ignoring numbers of nodes that CalculiX adds."""
    known = jobs.model.mesh.points
    names = [(node if node in known else None, axis) for node, axis in dofs]
    expected_names = [(node if node in known else None, axis) for node, axis in expected]
    return names == expected_names


def _significant(weights: FloatArray) -> WeightedRows:
    """Return the weights (n,) without rounding errors."""
    magnitude = np.abs(weights)
    rows: IntArray = np.flatnonzero(magnitude > _SMALLEST_WEIGHT * magnitude.max())
    return WeightedRows(rows, weights[rows])
