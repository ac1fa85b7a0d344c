"""The operators of a wing design before assembly, and their projection on a given basis.

For two designs with the same cells, the difference of the operators is projected from the changed
cells alone. A number of the design usually changes few cells, so no global matrix is assembled.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from fe.elements.cells import mass_blocks, stiffness_blocks
from fe.structure.body import Body
from fe.wing.design import WingDesign
from fe.wing.gauges import gauge_output
from fe.wing.mesh import WingMesh, build_mesh
from fe.wing.operators import section_displacement, turn_load, upward, wing_body

from .errors import IdentificationError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

STILL = 1e-4
"""Cells that move by less than this fraction of the largest move do not count as moved."""
_CELLS_AT_ONCE = 128
_AXES = 3
_MASS_TERMS = 3
_STRUCTURE = 0  # index of the structure's own mass among the mass terms


class ReducedTerms(NamedTuple):
    """Operators of a wing, or differences of them, on a static basis (N) and a modal basis (m).

    Attributes
    ----------
    stiffness : (K + 2, N, N) array
        Terms of the affine stiffness.
    lift, tip : (N,) arrays
        Load at load factor 1, and a unit force at the location of the static test.
    gauges : (G, N) array
        Gauge strains.
    modal_stiffness : (K + 2, m, m) array
        Terms of the affine stiffness on the modal basis.
    modal_mass : (3, m, m) array
        Mass of the structure, of 1 kg in each servo, and of 1 kg in the pitot.
    """

    stiffness: FloatArray
    lift: FloatArray
    tip: FloatArray
    gauges: FloatArray
    modal_stiffness: FloatArray
    modal_mass: FloatArray

    def combined(self, added: "ReducedTerms", factor: float) -> "ReducedTerms":
        """Return these terms plus `factor` times other terms."""
        return ReducedTerms._make(
            term + factor * added_term for term, added_term in zip(self, added, strict=True)
        )

    def scaled(self, factor: float) -> "ReducedTerms":
        """Return `factor` times these terms."""
        return ReducedTerms._make(factor * term for term in self)

    def after_step(self, step: FloatArray, derivatives: "ReducedTerms") -> "ReducedTerms":
        """Return these terms after a step (P,) of the parameters.

        Parameters
        ----------
        step : (P,) array
            Changes of the parameters.
        derivatives : ReducedTerms
            Derivatives of the terms, each (P, ...).
        """
        return ReducedTerms._make(
            term + np.tensordot(step, derivative, axes=1)
            for term, derivative in zip(self, derivatives, strict=True)
        )

    def stack_of(self, derivatives: Iterable["ReducedTerms"]) -> "ReducedTerms":
        """Return the derivatives of these terms, one for each parameter, along a new first axis.

        Without parameters, that axis is empty.
        """
        slopes = list(derivatives)
        if not slopes:
            return ReducedTerms._make(np.empty((0, *term.shape)) for term in self)
        return ReducedTerms._make(np.stack(arrays) for arrays in zip(*slopes, strict=True))


@dataclass(frozen=True, eq=False)
class WingPieces:
    """Everything of a wing from which its operators are assembled.

    Attributes
    ----------
    body : Body
        Mesh, root, cells and point masses.
    lift, tip : (full,) arrays
        Load at load factor 1, and a unit force at the location of the static test.
    gauges : csr (G, full)
        Gauge strains.
    """

    body: Body[WingMesh]
    lift: FloatArray
    tip: FloatArray
    gauges: sparse.csr_array

    @property
    def mesh(self) -> WingMesh:
        """The mesh."""
        return self.body.mesh

    @property
    def design(self) -> WingDesign:
        """The design."""
        return self.mesh.design

    @property
    def expansion(self) -> sparse.csr_array:
        """Free to all unknowns, csr (full, n)."""
        return self.body.supports.expansion


def wing_pieces(design: WingDesign, base: WingPieces | None = None) -> WingPieces:
    """Return the pieces of a design.

    Parameters
    ----------
    design : WingDesign
        The design.
    base : WingPieces, optional
        Pieces of another design. Those that both designs share are taken from it.

    Raises
    ------
    IdentificationError
        If the mesh has other cells than that of the base.
    """
    if base is None:
        body = wing_body(build_mesh(design))
        return WingPieces(
            body=body,
            lift=turn_load(body),
            tip=_tip_force(body.mesh),
            gauges=gauge_output(body.mesh),
        )
    same_mesh = _mesh_numbers(design) == _mesh_numbers(base.design)
    body = _body_on_mesh_of(base, design) if same_mesh else _body_on_moved_mesh(base, design)
    same_lift = same_mesh and _has_same_lift(base, body)
    same_gauges = same_mesh and design.gauges == base.design.gauges
    return WingPieces(
        body=body,
        lift=base.lift if same_lift else turn_load(body),
        tip=_tip_force(body.mesh),
        gauges=base.gauges if same_gauges else gauge_output(body.mesh),
    )


def _body_on_mesh_of(base: WingPieces, design: WingDesign) -> Body[WingMesh]:
    """Return the body of a design whose mesh is that of the base."""
    body = wing_body(replace(base.mesh, design=design))
    if design.root == base.design.root:
        return replace(body, supports=base.body.supports)
    return body


def _body_on_moved_mesh(base: WingPieces, design: WingDesign) -> Body[WingMesh]:
    """Return the body of a design with a mesh of its own.

    Raises
    ------
    IdentificationError
        If the mesh has other cells than that of the base.
    """
    body = wing_body(build_mesh(design))
    cells = body.mesh.cells
    base_cells = base.mesh.cells
    if cells.shape != base_cells.shape or np.any(cells != base_cells):
        raise IdentificationError(
            "a small change of the design changes the number of cells; change mesh.span_size or "
            "mesh.chord_size a little."
        )
    return body


def _has_same_lift(base: WingPieces, body: Body[WingMesh]) -> bool:
    """Return whether a body on the same mesh has the lift of the base.

    With inertia relief, the lift also depends on the masses.
    """
    design = body.mesh.design
    if design.lift != base.design.lift:
        return False
    if not design.lift.inertia_relief:
        return True
    same_density = not np.any(body.density != base.body.density)
    return same_density and design.point_masses == base.design.point_masses


def _tip_force(mesh: WingMesh) -> FloatArray:
    """Return a unit force (full,) at the location of the static test."""
    load = mesh.design.tip_load
    distance = mesh.design.planform.semi_span - load.distance_from_tip
    return upward(section_displacement(mesh, distance, load.chord))


def _mesh_numbers(design: WingDesign) -> tuple[object, ...]:
    """Return everything of a design that decides its mesh."""
    return (
        design.planform,
        design.airfoil,
        (design.skin.thickness, design.skin.closed_leading_edge),
        [band.end for band in design.skin.bands],
        [(web.chord, web.thickness) for web in design.webs],
        [(rib.station, rib.thickness) for rib in design.ribs],
        [rod.reach for rod in design.rods],
        [(added.start, added.end) for added in design.added_density],
        design.defects,
        design.mesh,
    )


def reduced(pieces: WingPieces, static: FloatArray, modal: FloatArray) -> ReducedTerms:
    """Return all operators on two bases.

    Parameters
    ----------
    pieces : WingPieces
        The wing.
    static, modal : (n, N) and (n, m) arrays
        Static and modal basis on the free unknowns.
    """
    every_cell = np.arange(len(pieces.mesh.cells))
    full_static = pieces.expansion @ static
    full_modal = pieces.expansion @ modal
    cell_terms = _cell_terms(pieces, every_cell, full_static, full_modal)
    return cell_terms.combined(_other_terms(pieces, static, modal), 1.0)


def reduced_difference(
    minuend: WingPieces, subtrahend: WingPieces, static: FloatArray, modal: FloatArray
) -> ReducedTerms:
    """Return the operators of one wing minus those of another with the same cells, on two bases.

    Parameters
    ----------
    minuend, subtrahend : WingPieces
        Both wings.
    static, modal : (n, N) and (n, m) arrays
        Static and modal basis on the free unknowns.
    """
    same_supports = minuend.expansion is subtrahend.expansion
    static_of_minuend = minuend.expansion @ static
    modal_of_minuend = minuend.expansion @ modal
    static_of_subtrahend = static_of_minuend
    modal_of_subtrahend = modal_of_minuend
    differs = _changed_cells(minuend, subtrahend)
    if not same_supports:
        static_of_subtrahend = subtrahend.expansion @ static
        modal_of_subtrahend = subtrahend.expansion @ modal
        changed_rows = np.any(static_of_minuend != static_of_subtrahend, axis=1)
        changed_rows |= np.any(modal_of_minuend != modal_of_subtrahend, axis=1)
        every_cell = np.arange(len(minuend.mesh.cells))
        differs |= np.any(changed_rows[minuend.mesh.unknowns_of(every_cell)], axis=1)
    cells = np.flatnonzero(differs)
    cell_difference = _cell_terms(minuend, cells, static_of_minuend, modal_of_minuend).combined(
        _cell_terms(subtrahend, cells, static_of_subtrahend, modal_of_subtrahend), -1.0
    )
    other_difference = _other_terms(minuend, static, modal).combined(
        _other_terms(subtrahend, static, modal), -1.0
    )
    return cell_difference.combined(other_difference, 1.0)


def _changed_cells(first: WingPieces, second: WingPieces) -> BoolArray:
    """Return whether each cell differs in position, elasticity or density between two wings."""
    # The section's least-squares edges move a little everywhere when one mesh line moves.
    move = np.abs(first.mesh.corners - second.mesh.corners).max(axis=(1, 2))
    position_differs = move > STILL * move.max()
    elasticity_differs = np.any(first.body.elasticity != second.body.elasticity, axis=(1, 2))
    variation_differs = np.any(first.body.variation != second.body.variation, axis=1)
    density_differs = first.body.density != second.body.density
    return np.asarray(position_differs | elasticity_differs | variation_differs | density_differs)


def _cell_terms(
    pieces: WingPieces, cells: IntArray, static: FloatArray, modal: FloatArray
) -> ReducedTerms:
    """Return stiffness and mass of chosen cells on two bases; all other terms are zero.

    Parameters
    ----------
    pieces : WingPieces
        The wing.
    cells : (c,) array
        Numbers of the cells.
    static, modal : (full, N) and (full, m) arrays
        Static and modal basis on all unknowns.
    """
    body = pieces.body
    mesh = pieces.mesh
    term_count = len(body.parts)
    N = static.shape[1]
    m = modal.shape[1]
    bases = np.hstack([static, modal])
    stiffness = np.zeros((term_count, N, N))
    modal_stiffness = np.zeros((term_count, m, m))
    mass = np.zeros((_MASS_TERMS, m, m))
    for term in range(term_count):
        cells_of_term = cells[body.part[cells] == term]
        for start in range(0, len(cells_of_term), _CELLS_AT_ONCE):
            batch = cells_of_term[start : start + _CELLS_AT_ONCE]
            nodes = mesh.nodes[batch]
            motions = bases[mesh.unknowns_of(batch)]

            # Stiffness, without the rigid part of the motions
            strained = motions - _rigid_part(nodes, motions)
            blocks = stiffness_blocks(
                mesh.kind, nodes, body.elasticity[batch], body.variation[batch]
            )
            forces = (blocks @ strained).reshape(-1, N + m)
            strained = strained.reshape(-1, N + m)
            stiffness[term] += strained[:, :N].T @ forces[:, :N]
            modal_stiffness[term] += strained[:, N:].T @ forces[:, N:]

            # Mass, the same for each component of the displacement
            blocks = mass_blocks(mesh.kind, nodes, body.density[batch], mesh.kind.mass_rule)
            node_count = blocks.shape[1]
            shapes = motions[:, :, N:].reshape(len(batch), node_count, -1)
            inertia = (blocks @ shapes).reshape(-1, m)
            mass[_STRUCTURE] += shapes.reshape(-1, m).T @ inertia
    gauge_count = pieces.gauges.shape[0]
    return ReducedTerms(
        stiffness=stiffness,
        lift=np.zeros(N),
        tip=np.zeros(N),
        gauges=np.zeros((gauge_count, N)),
        modal_stiffness=modal_stiffness,
        modal_mass=mass,
    )


def _rigid_part(points: FloatArray, motions: FloatArray) -> FloatArray:
    """Return the rigid motions (c, 60, k) of cells that are nearest to given motions.

    Rigid motions carry no energy. But their rounding errors times the stiffness of a thin cell
    would swamp the small differences between two designs.

    Parameters
    ----------
    points : (c, 20, 3) array
        Positions of the nodes of each cell [m].
    motions : (c, 60, k) array
        Displacements of the nodes of each cell.
    """
    arm = points - points.mean(axis=1, keepdims=True)
    arm = arm / np.abs(arm).max(axis=(1, 2), keepdims=True)
    modes = np.zeros((*points.shape, 2 * _AXES))
    for axis in range(_AXES):
        rotation = _AXES + axis
        next_axis = (axis + 1) % _AXES
        last_axis = (axis + 2) % _AXES
        modes[:, :, axis, axis] = 1.0
        modes[:, :, next_axis, rotation] = -arm[:, :, last_axis]
        modes[:, :, last_axis, rotation] = arm[:, :, next_axis]
    basis, _ = np.linalg.qr(modes.reshape(len(points), -1, 2 * _AXES))
    return np.asarray(basis @ (basis.swapaxes(1, 2) @ motions))


def _other_terms(pieces: WingPieces, static: FloatArray, modal: FloatArray) -> ReducedTerms:
    """Return springs, point masses, loads and gauges on two bases.

    Parameters
    ----------
    pieces : WingPieces
        The wing.
    static, modal : (n, N) and (n, m) arrays
        Static and modal basis on the free unknowns.
    """
    term_count = len(pieces.body.parts)
    N = static.shape[1]
    m = modal.shape[1]
    springs = pieces.body.supports.stiffness
    stiffness = np.zeros((term_count, N, N))
    stiffness[-1] = static.T @ (springs @ static)
    modal_stiffness = np.zeros((term_count, m, m))
    modal_stiffness[-1] = modal.T @ (springs @ modal)

    full_static = pieces.expansion @ static
    full_modal = pieces.expansion @ modal
    mass = np.zeros((_MASS_TERMS, m, m))
    for kind, masses in enumerate(pieces.body.masses, start=1):
        for weights in masses.weights:
            for component in range(_AXES):
                row = weights @ full_modal[component::_AXES]
                mass[kind] += np.outer(row, row)
    return ReducedTerms(
        stiffness=stiffness,
        lift=pieces.lift @ full_static,
        tip=pieces.tip @ full_static,
        gauges=np.asarray(pieces.gauges @ full_static),
        modal_stiffness=modal_stiffness,
        modal_mass=mass,
    )
