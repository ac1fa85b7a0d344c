"""What a design changes in the operators, cell by cell, and its projection on a given basis.

The difference of the operators of two designs with the same cells is projected from the cells that differ
alone: a number of the design usually changes few of them, and no global matrix is assembled.
"""

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

STILL = 1e-4
"""Cells that move by less than this share of the largest move do not count as moved."""
_BATCH = 128


class ReducedTerms(NamedTuple):
    """Operators of a wing, or differences of them, on a static basis (N) and a modal basis (m).

    Attributes
    ----------
    stiffness : (K + 2, N, N)
        Terms of the affine stiffness.
    lift, tip : (N,)
        Load at load factor 1, and a unit force at the place of the static test.
    gauges : (G, N)
        Gauge strains.
    modal_stiffness : (K + 2, m, m)
    modal_mass : (3, m, m)
        Structure, 1 kg in each servo, 1 kg in the pitot.
    """

    stiffness: FloatArray
    lift: FloatArray
    tip: FloatArray
    gauges: FloatArray
    modal_stiffness: FloatArray
    modal_mass: FloatArray

    def combined(self, other: "ReducedTerms", factor: float) -> "ReducedTerms":
        """Return self + factor * other."""
        return ReducedTerms(*(mine + factor * its for mine, its in zip(self, other, strict=True)))

    def scaled(self, factor: float) -> "ReducedTerms":
        """Return factor * self."""
        return ReducedTerms(*(factor * mine for mine in self))


@dataclass(frozen=True, eq=False)
class WingPieces:
    """Everything of a wing that its operators are made of, before assembly.

    Attributes
    ----------
    body : Body
        Mesh, root, cells and point masses.
    lift, tip : (full,)
        Load at load factor 1, and a unit force at the place of the static test.
    gauges : csr (G, full)
    """

    body: Body[WingMesh]
    lift: FloatArray
    tip: FloatArray
    gauges: sparse.csr_array

    @property
    def mesh(self) -> WingMesh:
        """Its mesh."""
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
    """Make the pieces of a design; those that a `base` design shares are taken from it.

    Raises
    ------
    IdentificationError
        If the mesh has other cells than that of the base.
    """
    same_mesh = base is not None and _same_mesh(design, base.design)
    if base is not None and same_mesh:
        body = wing_body(replace(base.mesh, design=design))
        if design.root == base.design.root:
            body = replace(body, supports=base.body.supports)
    else:
        body = wing_body(build_mesh(design))
        if base is not None and (
            body.mesh.cells.shape != base.mesh.cells.shape or np.any(body.mesh.cells != base.mesh.cells)
        ):
            raise IdentificationError(
                "a small change of the design changes the number of cells; change mesh.span_size or "
                "mesh.chord_size a little."
            )
    same_gauges = base is not None and same_mesh and design.gauges == base.design.gauges
    places = design.point_masses
    relieved = design.lift.inertia_relief and base is not None
    same_lift = (
        base is not None
        and same_mesh
        and design.lift == base.design.lift
        and not (
            relieved and (np.any(body.density != base.body.density) or places != base.design.point_masses)
        )
    )
    plan, load = design.planform, design.tip_load
    return WingPieces(
        body=body,
        lift=base.lift if base is not None and same_lift else turn_load(body),
        tip=upward(section_displacement(body.mesh, plan.semi_span - load.distance_from_tip, load.chord)),
        gauges=base.gauges if base is not None and same_gauges else gauge_output(body.mesh),
    )


def _same_mesh(one: WingDesign, other: WingDesign) -> bool:
    """Whether everything that decides the mesh is the same."""
    first, second = (
        (
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
        for design in (one, other)
    )
    return first == second


def reduced(pieces: WingPieces, static: FloatArray, modal: FloatArray) -> ReducedTerms:
    """Project all operators on bases (n, N) and (n, m) of free unknowns."""
    every = np.arange(len(pieces.mesh.cells))
    cells = _cell_terms(pieces, every, pieces.expansion @ static, pieces.expansion @ modal)
    return cells.combined(_other_terms(pieces, static, modal), 1.0)


def reduced_difference(
    one: WingPieces, other: WingPieces, static: FloatArray, modal: FloatArray
) -> ReducedTerms:
    """Project the operators of one wing less those of another with the same cells."""
    bases = static, modal
    own = [one.expansion @ basis for basis in bases]
    its = own if one.expansion is other.expansion else [other.expansion @ basis for basis in bases]
    # The section's least-squares edges move a little everywhere when one mesh line moves.
    move = np.abs(one.mesh.corners - other.mesh.corners).max(axis=(1, 2))
    differ = (
        (move > STILL * move.max())
        | np.any(one.body.elasticity != other.body.elasticity, axis=(1, 2))
        | np.any(one.body.variation != other.body.variation, axis=1)
        | (one.body.density != other.body.density)
    )
    if own is not its:
        moved = np.any(own[0] != its[0], axis=1) | np.any(own[1] != its[1], axis=1)
        differ |= np.any(moved[one.mesh.unknowns_of(np.arange(len(one.mesh.cells)))], axis=1)
    cells = np.flatnonzero(differ)
    difference = _cell_terms(one, cells, own[0], own[1]).combined(
        _cell_terms(other, cells, its[0], its[1]), -1.0
    )
    rest = _other_terms(one, static, modal).combined(_other_terms(other, static, modal), -1.0)
    return difference.combined(rest, 1.0)


def _cell_terms(pieces: WingPieces, cells: IntArray, static: FloatArray, modal: FloatArray) -> ReducedTerms:
    """Stiffness of the cells and mass of the structure on the expanded bases (full, N) and (full, m)."""
    body, mesh, terms = pieces.body, pieces.mesh, len(pieces.body.parts)
    N, m = static.shape[1], modal.shape[1]
    both = np.hstack([static, modal])
    stiffness = np.zeros((terms, N, N))
    modal_stiffness = np.zeros((terms, m, m))
    mass = np.zeros((3, m, m))
    for term in range(terms):
        chosen = cells[pieces.body.part[cells] == term]
        for start in range(0, len(chosen), _BATCH):
            part = chosen[start : start + _BATCH]
            local, nodes = both[mesh.unknowns_of(part)], mesh.nodes[part]
            strained = local - _rigid_part(nodes, local)
            blocks = stiffness_blocks(mesh.kind, nodes, body.elasticity[part], body.variation[part])
            forces = (blocks @ strained).reshape(-1, N + m)
            flat = strained.reshape(-1, N + m)
            stiffness[term] += flat[:, :N].T @ forces[:, :N]
            modal_stiffness[term] += flat[:, N:].T @ forces[:, N:]
            blocks = mass_blocks(mesh.kind, nodes, body.density[part], mesh.kind.mass_rule)
            shapes = local[:, :, N:].reshape(len(part), len(blocks[0]), -1)
            mass[0] += shapes.reshape(-1, m).T @ (blocks @ shapes).reshape(-1, m)
    return ReducedTerms(
        stiffness, np.zeros(N), np.zeros(N), np.zeros((pieces.gauges.shape[0], N)), modal_stiffness, mass
    )


def _rigid_part(points: FloatArray, local: FloatArray) -> FloatArray:
    """Rigid motion (c, 60, k) nearest to displacements (c, 60, k) of cells with nodes (c, 20, 3).

    It carries no energy, but its rounding errors times the stiffness of a thin cell would swamp the small
    differences between two designs.
    """
    arm = points - points.mean(axis=1, keepdims=True)
    arm = arm / np.abs(arm).max(axis=(1, 2), keepdims=True)
    modes = np.zeros((*points.shape, 6))
    for axis in range(3):
        modes[:, :, axis, axis] = 1.0
        first, second = (axis + 1) % 3, (axis + 2) % 3
        modes[:, :, first, 3 + axis] = -arm[:, :, second]
        modes[:, :, second, 3 + axis] = arm[:, :, first]
    basis, _ = np.linalg.qr(modes.reshape(len(points), -1, 6))
    return np.asarray(basis @ (basis.swapaxes(1, 2) @ local))


def _other_terms(pieces: WingPieces, static: FloatArray, modal: FloatArray) -> ReducedTerms:
    """Springs, point masses, loads and outputs on bases of free unknowns."""
    terms, N, m = len(pieces.body.parts), static.shape[1], modal.shape[1]
    stiffness, modal_stiffness, mass = np.zeros((terms, N, N)), np.zeros((terms, m, m)), np.zeros((3, m, m))
    springs = pieces.body.supports.stiffness
    stiffness[-1], modal_stiffness[-1] = (basis.T @ (springs @ basis) for basis in (static, modal))
    full_static, full_modal = pieces.expansion @ static, pieces.expansion @ modal
    for kind, masses in enumerate(pieces.body.masses, start=1):
        for weights in masses.weights:
            for component in range(3):
                row = weights @ full_modal[component::3]
                mass[kind] += np.outer(row, row)
    return ReducedTerms(
        stiffness,
        pieces.lift @ full_static,
        pieces.tip @ full_static,
        np.asarray(pieces.gauges @ full_static),
        modal_stiffness,
        mass,
    )
