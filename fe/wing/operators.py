"""Affine operators of the wing: the full finite element model as a few matrices.

K(e, z) = e K_skin + (1 - z1) K_1 + ... + K_0 and M(m) = M_0 + m_servo M_s + m_pitot M_p, where
K_skin is the skin without the damage regions: in the published model the factor e does not scale
them. The root is a rigid rib on three springs. Its held motions are eliminated, so that all
matrices act on the free unknowns: those of the nodes outside the root section, then root heave [m],
flap [rad] and yaw [rad]. Gauge strains are weighted sums of nodal displacements, Kapteyn et al.
2021, eq. (15). Statics and modes of the full wing follow eqs. (13), (15) and (16).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import overload

import numpy as np
from scipy import sparse

from fe.elements.cells import jacobians
from fe.elements.kinds import gauss_points
from fe.full.factorisation import most_compliant_modes
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.state import STANDARD_GRAVITY, TIP_FORCE, Losses, losses_of
from fe.structure.affine import AffineStructure, NaturalModes
from fe.structure.affine_fields import OutputRows
from fe.structure.body import Body, MassAtPoints
from fe.structure.operators import assemble_structure
from fe.structure.supports import RigidSet, Supports, supports

from .design import WingDesign, wing_structure
from .gauges import gauge_output
from .materials import cell_density, cell_elasticity, modulus_variation
from .mesh import WingMesh, build_mesh
from .parts import DISTRIBUTIONS

ROOT_UNKNOWNS = 3
"""The last unknowns are the motions of the root: heave, flap and yaw."""


@dataclass(frozen=True)
class AffineWing(AffineStructure):
    """A wing as a structure: a factor on its skin, two masses, the load of a turn, a tip force."""

    followed_load = TIP_FORCE

    @property
    def load_lift(self) -> FloatArray:
        """Load (n,) [N] of a turn at load factor 1."""
        return self.load_terms[0].vector

    @property
    def load_tip(self) -> FloatArray:
        """Load (n,) of 1 N upwards at the point of the static test; as a row, its displacement."""
        return self.load_terms[1].vector

    @property
    def tip_row(self) -> FloatArray:
        """Upward displacement (n,) at the tip, on the chord line of the static test."""
        return np.asarray(self.displacement_output.todense()).ravel()

    def turn(self, load_factor: float, tip_force: float = 0.0) -> FloatArray:
        """Return the load (n,) [N] for a load factor and an upward tip force [N]."""
        return load_factor * self.load_lift + tip_force * self.load_tip


def point_masses(servo: float, pitot: float) -> dict[str, float]:
    """Return the masses [kg] of one servo and of the pitot tube by their input names."""
    return {"servo_mass": servo, "pitot_mass": pitot}


def stiffness_parts(regions: Iterable[str]) -> tuple[tuple[str | None, str | None], ...]:
    """Return the parameter and the region of each part of the stiffness.

    The parts are the skin without the damage regions, each of these, and all others.
    """
    skin = ("young_modulus_factor", None)
    all_else = (None, None)
    return skin, *((None, region) for region in regions), all_else


def outputs(gauges: sparse.csr_array, tip: FloatArray) -> OutputRows:
    """Return the outputs of a wing as rows on all displacements.

    Parameters
    ----------
    gauges : csr (gauges, full)
        Strains of the gauges, positive in compression.
    tip : (full,) array
        Upward displacement at the tip.
    """
    no_rows = sparse.csr_array((0, len(tip)))
    return OutputRows(
        gauge=gauges,
        displacement=sparse.csr_array(tip[np.newaxis]),
        acceleration=no_rows,
        port=no_rows,
    )


@dataclass(frozen=True)
class AffineOperators(AffineWing):
    """Affine finite element model of the wing on its n free unknowns.

    Attributes
    ----------
    body : Body
        Its mesh with materials and supports; `expansion` gives the displacements of the nodes.
    """

    body: Body[WingMesh]

    @property
    def wing_mesh(self) -> WingMesh:
        """Nodes and cells with named regions."""
        return self.body.mesh


def structural_mass(design: WingDesign) -> float:
    """Return the mass of the structure without point masses [kg], from the cells' volumes."""
    mesh = build_mesh(design)
    return float(mesh.mass(np.arange(len(mesh.cells)), cell_density(mesh)).sum())


def root_support(mesh: WingMesh) -> Supports:
    """Return the support of the wing: its root section is a rigid rib on springs.

    The rib may heave along z, flap about x and yaw about z, both about the straight chord line. Its
    three unknowns come last. Its other motions are held.
    """
    root = mesh.design.root
    no_springs = np.zeros(mesh.points.shape)
    _, span_position, _ = mesh.points.T
    tolerance = 1e-9 * mesh.design.planform.semi_span
    root_nodes = np.flatnonzero(np.abs(span_position) < tolerance)
    # springs along x, y, z and about x, y, z; motions without a spring are held
    along_axes = (0.0, 0.0, root.transverse_spring)
    about_axes = (root.flap_spring, 0.0, root.yaw_spring)
    springs = np.array([*along_axes, *about_axes])
    rib = RigidSet(
        root_nodes,
        point=np.zeros(3),
        held=springs == 0.0,
        springs=springs,
    )
    nothing_held = no_springs.astype(bool)
    return supports(mesh.points, nothing_held, no_springs, [rib])


def section_displacement(mesh: WingMesh, distance: float, chord_fraction: float) -> FloatArray:
    """Return nodal weights (nodes,) that give the displacement of a section at a chord position.

    It is the mean of the displacements of the upper and the lower skin there.

    Parameters
    ----------
    distance : float
        Distance from the root [m].
    chord_fraction : float
        Position along the local chord.
    """
    planform = mesh.design.planform
    distance_aft = chord_fraction * planform.chord(distance / planform.semi_span)
    weights = np.zeros(len(mesh.points))
    for upper in (True, False):
        cell, local_position = mesh.skin_point(distance, distance_aft, upper=upper)
        (values,), _ = mesh.kind.shape_functions(local_position[np.newaxis])
        weights[mesh.cells[cell]] += 0.5 * values
    return weights


def upward(weights: FloatArray) -> FloatArray:
    """Expand nodal weights (nodes,) to weights (full,) of upward displacements."""
    return np.kron(weights, np.array([0.0, 0.0, 1.0]))


def wing_body(mesh: WingMesh) -> Body[WingMesh]:
    """Return the mesh with materials, supports and the nominal point masses of the design."""
    design = mesh.design
    weights_of_servos = [np.zeros((0, len(mesh.points)))]
    weights_of_pitots = [np.zeros((0, len(mesh.points)))]
    for point_mass in design.point_masses:
        distance = point_mass.station * design.planform.semi_span
        weights = section_displacement(mesh, distance, point_mass.chord)[np.newaxis]
        if point_mass.kind == "servo":
            weights_of_servos.append(weights)
        else:
            weights_of_pitots.append(weights)
    return Body(
        mesh=mesh,
        supports=root_support(mesh),
        elasticity=cell_elasticity(mesh),
        density=cell_density(mesh),
        part=mesh.stiffness_term,
        parts=stiffness_parts(design.regions),
        masses=(
            MassAtPoints("servo_mass", design.masses.servo, np.vstack(weights_of_servos)),
            MassAtPoints("pitot_mass", design.masses.pitot, np.vstack(weights_of_pitots)),
        ),
        variation=modulus_variation(mesh),
    )


def lift_load(mesh: WingMesh) -> FloatArray:
    """Return the aerodynamic load (3 nodes,) [N] at load factor 1, upward and forward.

    Half of the load acts on each skin, on the outer faces of its cells. Along the span it follows
    the distribution of the design. Along the chord it is proportional to (1 - xi)^p, where xi is
    the fraction of the chord from the leading edge and p the exponent of the design. Its sum over
    all nodes is exactly the force of the design, divided by the load factor of that force. The
    components are x aft, y along the span, z up.
    """
    lift = mesh.design.lift
    distribution = np.zeros(len(mesh.points))
    for upper in (True, False):
        _add_skin_pressure(mesh, distribution, upper=upper)
    distribution /= distribution.sum() * lift.load_factor
    load = np.zeros(mesh.unknowns)
    load[2::3] = lift.force * distribution
    load[0::3] = -lift.forward_force * distribution
    return load


def _add_skin_pressure(mesh: WingMesh, load: FloatArray, *, upper: bool) -> None:
    """Add the pressure on the upper or lower skin to a load (nodes,), up to a common factor."""
    planform = mesh.design.planform
    lift = mesh.design.lift
    # integration points on the outer faces
    face = gauss_points(4, 2)
    local_height = 1.0 if upper else 0.0
    local_heights = np.full(len(face.points), local_height)
    local_positions = np.column_stack([face.points, local_heights])
    cells = mesh.skin_cells(upper=upper)
    shape_values, _ = mesh.kind.shape_functions(local_positions)
    positions = mesh.positions(cells, local_positions)
    x, y, _ = np.moveaxis(positions, 2, 0)
    # their areas in the plan view
    jacobian = jacobians(mesh.kind, mesh.nodes[cells], local_positions)
    plan_jacobian = jacobian[..., :2, :2]
    area = np.linalg.det(plan_jacobian)
    # pressure at these points
    station = np.clip(y / planform.semi_span, 0.0, 1.0)
    chord = planform.chord(station)
    chord_fraction = x / chord + planform.straight_chord_line
    lift_per_length = DISTRIBUTIONS[lift.distribution]
    span_distribution = lift_per_length(planform, station)
    chord_distribution = (1.0 - chord_fraction) ** lift.chordwise_exponent
    pressure = span_distribution * chord_distribution / chord
    force_at_points = pressure * area * face.weights
    nodal_force = force_at_points @ shape_values
    np.add.at(load, mesh.cells[cells], nodal_force)


def turn_load(body: Body[WingMesh]) -> FloatArray:
    """Return the load (full,) [N] of load factor 1, with inertia relief if the design has it.

    With inertia relief, the weight acts downwards at the nodes, and the lift is scaled up by as
    much, so that the net force is that of the design.
    """
    load = lift_load(body.mesh)
    if body.mesh.design.lift.inertia_relief:
        weight = STANDARD_GRAVITY * body.nodal_mass
        lift = load[2::3].copy()
        weight_over_lift = weight.sum() / lift.sum()
        load[2::3] += lift * weight_over_lift - weight
    return load


@overload
def assemble(source: WingDesign) -> AffineOperators: ...


@overload
def assemble(source: Path | str, memory_limit: float | None = None) -> AffineStructure: ...


def assemble(source: WingDesign | Path | str, memory_limit: float | None = None) -> AffineStructure:
    """Assemble the full finite element model of a wing, or of a structure file.

    Parameters
    ----------
    source : WingDesign, Path or str
        The design of a wing, or the path of a structure file beside its mesh or matrices.
    memory_limit : float, optional
        Memory that assembly and factorisation of a structure may take [bytes]; by default all that
        is free.

    Returns
    -------
    AffineStructure
        The affine operators; those of a wing are `AffineOperators`.

    Raises
    ------
    DesignFileError, InvalidDesignError
        If the structure file cannot be read, or does not describe a structure.
    MeshError
        If lines of a wing's design nearly coincide, or the mesh of a structure is faulty.
    """
    if isinstance(source, WingDesign):
        return _assemble_wing(source)
    return assemble_structure(source, memory_limit)


def _assemble_wing(design: WingDesign) -> AffineOperators:
    """Mesh a wing design and assemble its affine operators.

    Raises `MeshError` if lines of the design nearly coincide.
    """
    mesh = build_mesh(design)
    body = wing_body(mesh)
    span = design.planform.semi_span
    tip_load = design.tip_load
    # The test load acts near the tip; the displacement is read at the tip itself.
    test_point = section_displacement(mesh, span - tip_load.distance_from_tip, tip_load.chord)
    tip = section_displacement(mesh, span, tip_load.chord)
    structure_design = wing_structure(design.regions, len(design.gauges.positions))
    # mass terms, load terms, output rows and the reduction to free unknowns
    affine_fields = body.affine_fields(
        structure_design,
        loads=(turn_load(body), upward(test_point)),
        outputs=outputs(gauge_output(mesh), upward(tip)),
    )
    return AffineOperators(
        design=structure_design,
        **affine_fields,
        stiffness_terms=body.stiffness_terms,
        body=body,
        design_hash=design.hash,
    )


def wing_values(
    wing: AffineWing, young_modulus_factor: float, stiffness_loss: Losses, **others: float
) -> dict[str, float]:
    """Return the values of a wing's inputs by name.

    Parameters
    ----------
    young_modulus_factor, stiffness_loss
        As in `fe.runtime.state.DigitalState`.
    **others : float
        Masses [kg], load factor and tip force [N].
    """
    losses = dict(zip(wing.regions, losses_of(stiffness_loss, wing.regions), strict=True))
    return {"young_modulus_factor": young_modulus_factor, **losses, **others}


def flapwise_bending_modes(wing: AffineWing, modes: NaturalModes) -> IntArray:
    """Return the indices (2,) of the first two flapwise bending modes of a wing.

    These are the two modes that contribute most to the compliance under a force near the tip; a
    lead-lag mode may lie between them.

    Parameters
    ----------
    modes : NaturalModes
        At least three modes, from `natural_frequencies`.
    """
    return most_compliant_modes(wing.load_tip, modes.frequency**2, modes.shape)
