import numpy as np
import pytest
from scipy.sparse.linalg import norm

from fe.wing.mesh import SKIN, build_mesh
from fe.wing.operators import (
    ROOT_UNKNOWNS,
    assemble,
    cell_elasticity,
    gauge_output,
    modulus_variation,
    point_masses,
)
from fe.wing.turn_load import STANDARD_GRAVITY
from tests.wings import tip_stiffness


def _heave(operators):
    full = np.zeros(operators.expansion.shape[0])
    full[2::3] = 1.0
    free = operators.expansion.T @ full
    free[-ROOT_UNKNOWNS:] = 1.0, 0.0, 0.0
    return free


def test_the_affine_sum_equals_direct_assembly(coarse_operators):
    factor, loss = 1.07, (0.35, 0.6)
    mesh = coarse_operators.wing_mesh
    scale = np.ones(len(mesh.cells))
    scale[mesh.region == SKIN] = factor
    scale[mesh.region == 1] = 1.0 - loss[0]
    scale[mesh.region == 2] = 1.0 - loss[1]
    direct = mesh.stiffness(
        np.arange(len(scale)), cell_elasticity(mesh), modulus_variation(mesh) * scale[:, None]
    )
    direct = (coarse_operators.expansion.T @ direct @ coarse_operators.expansion).tocsr()
    springs = mesh.design.root
    spring_values = np.array([springs.transverse_spring, springs.flap_spring, springs.yaw_spring])
    affine = coarse_operators.stiffness({"young_modulus_factor": factor}, loss)
    difference = (affine - direct).tolil()
    for number, value in enumerate(spring_values):
        at = coarse_operators.unknowns - ROOT_UNKNOWNS + number
        difference[at, at] -= value
    assert norm(difference.tocsr(), np.inf) < 1e-12 * norm(affine, np.inf)


def test_every_matrix_is_symmetric(coarse_operators):
    for shared in (*(term.matrix for term in coarse_operators.stiffness_terms), *coarse_operators.mass_terms):
        term = shared.copy()  # arithmetic sorts the entries of its operands, and sums follow their order
        assert abs(term - term.T).max() <= 1e-12 * abs(term).max()


def test_loads_sum_to_those_of_the_design(coarse_operators):
    lift = coarse_operators.wing_mesh.design.lift
    heave = _heave(coarse_operators)
    assert heave @ coarse_operators.turn(3.0) == pytest.approx(lift.force)
    assert heave @ coarse_operators.turn(0.0, 2.5) == pytest.approx(2.5)
    assert coarse_operators.turn(2.0, 1.0) == pytest.approx(
        2.0 * coarse_operators.load_lift + coarse_operators.load_tip
    )


def test_a_rigid_heave_moves_every_output_by_one(coarse_operators):
    heave = _heave(coarse_operators)
    assert coarse_operators.load_tip @ heave == pytest.approx(1.0)
    assert coarse_operators.tip_row @ heave == pytest.approx(1.0)
    assert heave @ (coarse_operators.mass_terms[1] @ heave) == pytest.approx(2.0)  # two servos of 1 kg
    assert heave @ (coarse_operators.mass_terms[2] @ heave) == pytest.approx(1.0)


def test_gauges_read_a_uniform_strain_exactly(coarse_operators):
    mesh = coarse_operators.wing_mesh
    points = mesh.points
    field = np.zeros_like(points)
    field[:, 1] = -1e-3 * points[:, 1]
    reading = gauge_output(mesh) @ field.ravel()
    # The upper skin falls towards the tip, so that a gauge sees a little less than the strain along y.
    assert np.all((reading <= 1e-3) & (reading > 0.998e-3))
    sideways = np.zeros_like(points)
    sideways[:, 0] = points[:, 0]
    assert np.abs(gauge_output(mesh) @ sideways.ravel()).max() < 1e-4


def test_a_gauge_in_the_middle_does_not_see_the_bending_of_the_skin(coarse_design):
    # w = y^2 bends a plate at height h: strain -2 (z - h) on the surface, -2 * 0 in its middle plane.
    readings = {}
    for surface in ("outer", "middle"):
        design = coarse_design.changed(gauges={"surface": surface})
        mesh = build_mesh(design)
        field = np.zeros_like(mesh.points)
        field[:, 1] = -2.0 * mesh.points[:, 1] * mesh.points[:, 2]
        field[:, 2] = mesh.points[:, 1] ** 2
        readings[surface] = gauge_output(mesh) @ field.ravel()
    half = 0.5 * coarse_design.skin.thickness
    # The plane sections turn about z = 0: the surface reads more by the curvature times half the thickness.
    assert readings["outer"] - readings["middle"] == pytest.approx(np.full(24, 2.0 * half), rel=0.15)


def test_the_weight_relieves_the_lift_and_keeps_its_sum(coarse_design):
    plain = assemble(coarse_design.changed(lift={"inertia_relief": False}))
    relieved = assemble(coarse_design.changed(lift={"inertia_relief": True}))
    heave = _heave(plain)
    assert heave @ relieved.load_lift == pytest.approx(heave @ plain.load_lift, rel=1e-12)
    # Lift grows by the weight and the weight acts where it is: the moment of the difference is known.
    masses = coarse_design.masses
    mass = plain.mass(point_masses(masses.servo, masses.pitot))
    flap = np.zeros(plain.expansion.shape[0])
    flap[2::3] = plain.wing_mesh.points[:, 1]
    flap_free = plain.expansion.T @ flap
    weight = STANDARD_GRAVITY * (heave @ (mass @ heave))
    arm = (flap_free @ (mass @ heave)) / (heave @ (mass @ heave))
    lift_arm = (flap_free @ plain.load_lift) / (heave @ plain.load_lift)
    found = flap_free @ (relieved.load_lift - plain.load_lift)
    assert found == pytest.approx(weight * (lift_arm - arm), rel=1e-6)


def test_the_exponent_moves_the_centre_of_the_lift(coarse_design):
    centre = {}
    for exponent in (0.5, 1.0, 2.0):
        operators = assemble(
            coarse_design.changed(lift={"chordwise_exponent": exponent, "inertia_relief": False})
        )
        points = operators.wing_mesh.points
        lift = (operators.expansion @ operators.load_lift)[2::3]
        centre[exponent] = lift @ points[:, 0] / lift.sum()
    assert centre[0.5] > centre[1.0] + 0.01 > centre[2.0] + 0.02


def test_the_root_moves_as_a_rigid_rib(coarse_operators):
    free = np.zeros(coarse_operators.unknowns)
    free[-ROOT_UNKNOWNS:] = 0.01, 0.002, 0.003
    points = coarse_operators.wing_mesh.points
    on_root = np.abs(points[:, 1]) < 1e-9
    moved = coarse_operators.full_displacement(free)[on_root]
    x, z = points[on_root, 0], points[on_root, 2]
    assert moved[:, 0] == pytest.approx(0.0)
    assert moved[:, 1] == pytest.approx(-0.002 * z + 0.003 * x)
    assert moved[:, 2] == pytest.approx(0.01)


def test_a_rod_stiffens_and_weighs(coarse_design, coarse_operators):
    rod = {"web": 1, "reach": 0.25, "diameter": 0.01, "young_modulus": 120e9, "density": 1600.0}
    with_rod = assemble(coarse_design.changed(rods=[rod]))
    assert tip_stiffness(with_rod) > 1.01 * tip_stiffness(coarse_operators)
    heave = _heave(with_rod)
    added = heave @ (with_rod.mass_terms[0] @ heave) - heave @ (coarse_operators.mass_terms[0] @ heave)
    reach = max(c[1] for c in with_rod.wing_mesh.points if c[1] <= 0.25 * 1.828 + 1e-3)
    assert added == pytest.approx(1600.0 * np.pi * 0.005**2 * reach, rel=0.2)


def test_the_same_design_gives_the_same_operators(coarse_design, coarse_operators):
    again = assemble(coarse_design)
    assert again.design_hash == coarse_operators.design_hash == coarse_design.hash
    for ours, shared in zip(again.stiffness_terms, coarse_operators.stiffness_terms, strict=True):
        theirs = shared.matrix.copy()
        assert abs(ours.matrix - theirs).max() <= 1e-13 * abs(theirs).max()
