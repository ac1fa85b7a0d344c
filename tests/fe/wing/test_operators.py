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


def rigid(operators, lever=None):
    """Free unknowns of a heave, or of a flap where the lever is that of the nodes."""
    full = np.zeros(operators.expansion.shape[0])
    full[2::3] = 1.0 if lever is None else lever
    free = operators.expansion.T @ full
    if lever is None:
        free[-ROOT_UNKNOWNS:] = 1.0, 0.0, 0.0
    return free


def test_the_affine_sum_equals_direct_assembly(coarse_operators):
    factor, loss, mesh = 1.07, (0.35, 0.6), coarse_operators.wing_mesh
    kept = [mesh.region == SKIN, mesh.region == 1, mesh.region == 2]
    variation = (
        modulus_variation(mesh) * np.select(kept, [factor, 1.0 - loss[0], 1.0 - loss[1]], 1.0)[:, None]
    )
    direct = mesh.stiffness(np.arange(len(mesh.cells)), cell_elasticity(mesh), variation)
    direct = (coarse_operators.expansion.T @ direct @ coarse_operators.expansion).tocsr()
    springs = mesh.design.root
    affine = coarse_operators.stiffness({"young_modulus_factor": factor}, loss)
    difference = (affine - direct).tolil()
    for number, value in enumerate((springs.transverse_spring, springs.flap_spring, springs.yaw_spring)):
        at = coarse_operators.unknowns - ROOT_UNKNOWNS + number
        difference[at, at] -= value
    assert norm(difference.tocsr(), np.inf) < 1e-12 * norm(affine, np.inf)


def test_a_rigid_heave_meets_the_loads_of_the_design_and_moves_every_output_by_one(coarse_operators):
    wing, heave = coarse_operators, rigid(coarse_operators)
    assert heave @ wing.turn(3.0) == pytest.approx(wing.wing_mesh.design.lift.force)
    assert heave @ wing.turn(0.0, 2.5) == pytest.approx(2.5)
    assert wing.turn(2.0, 1.0) == pytest.approx(2.0 * wing.load_lift + wing.load_tip)
    assert (wing.load_tip @ heave, wing.tip_row @ heave) == pytest.approx((1.0, 1.0))
    assert heave @ (wing.mass_terms[1] @ heave) == pytest.approx(2.0)  # two servos of 1 kg
    assert heave @ (wing.mass_terms[2] @ heave) == pytest.approx(1.0)


def test_gauges_read_a_uniform_strain_exactly(coarse_operators):
    points, rows = coarse_operators.wing_mesh.points, gauge_output(coarse_operators.wing_mesh)
    # The upper skin falls towards the tip, so that a gauge sees a little less than the strain along y.
    reading = rows @ (points * [0.0, -1e-3, 0.0]).ravel()
    assert np.all((reading <= 1e-3) & (reading > 0.998e-3))
    assert np.abs(rows @ (points * [1.0, 0.0, 0.0]).ravel()).max() < 1e-4


def test_a_gauge_in_the_middle_does_not_see_the_bending_of_the_skin(coarse_design):
    # w = y^2 bends a plate at height h: strain -2 (z - h) on the surface, -2 * 0 in its middle plane.
    readings = []
    for surface in ("outer", "middle"):
        mesh = build_mesh(coarse_design.changed(gauges={"surface": surface}))
        _, y, z = mesh.points.T
        readings.append(gauge_output(mesh) @ np.stack((0.0 * y, -2.0 * y * z, y**2), axis=1).ravel())
    # The plane sections turn about z = 0: the surface reads more by the curvature times half the thickness.
    assert readings[0] - readings[1] == pytest.approx(np.full(24, coarse_design.skin.thickness), rel=0.15)


def test_the_weight_relieves_the_lift_and_keeps_its_sum(coarse_design):
    plain, relieved = (assemble(coarse_design.changed(lift={"inertia_relief": on})) for on in (False, True))
    heave, masses = rigid(plain), coarse_design.masses
    assert heave @ relieved.load_lift == pytest.approx(heave @ plain.load_lift, rel=1e-12)
    # Lift grows by the weight and the weight acts where it is: the moment of the difference is known.
    moved = plain.mass(point_masses(masses.servo, masses.pitot)) @ heave
    flap = rigid(plain, plain.wing_mesh.points[:, 1])
    arm, lift_arm = ((flap @ load) / (heave @ load) for load in (moved, plain.load_lift))
    found, weight = flap @ (relieved.load_lift - plain.load_lift), STANDARD_GRAVITY * (heave @ moved)
    assert found == pytest.approx(weight * (lift_arm - arm), rel=1e-6)


def test_the_exponent_moves_the_centre_of_the_lift(coarse_design):
    centre = []
    for exponent in (0.5, 1.0, 2.0):
        wing = assemble(coarse_design.changed(lift={"chordwise_exponent": exponent, "inertia_relief": False}))
        lift = (wing.expansion @ wing.load_lift)[2::3]
        centre.append(lift @ wing.wing_mesh.points[:, 0] / lift.sum())
    assert centre[0] > centre[1] + 0.01 > centre[2] + 0.02


def test_the_root_moves_as_a_rigid_rib(coarse_operators):
    free, points = np.zeros(coarse_operators.unknowns), coarse_operators.wing_mesh.points
    free[-ROOT_UNKNOWNS:] = 0.01, 0.002, 0.003
    root = np.abs(points[:, 1]) < 1e-9
    x, _, z = points[root].T
    wanted = np.stack((0.0 * x, -0.002 * z + 0.003 * x, 0.0 * x + 0.01), axis=1)
    assert coarse_operators.full_displacement(free)[root] == pytest.approx(wanted)


def test_a_rod_stiffens_and_weighs(coarse_design, coarse_operators):
    rod = {"web": 1, "reach": 0.25, "diameter": 0.01, "young_modulus": 120e9, "density": 1600.0}
    with_rod = assemble(coarse_design.changed(rods=[rod]))
    assert tip_stiffness(with_rod) > 1.01 * tip_stiffness(coarse_operators)
    heave = rigid(with_rod)
    added = heave @ ((with_rod.mass_terms[0] - coarse_operators.mass_terms[0]) @ heave)
    reach = max(c[1] for c in with_rod.wing_mesh.points if c[1] <= 0.25 * 1.828 + 1e-3)
    assert added == pytest.approx(1600.0 * np.pi * 0.005**2 * reach, rel=0.2)
