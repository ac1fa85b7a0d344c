"""A wing: mesh, operators, balances, convergence; its responses against what is published."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fe.elements.cells import jacobians
from fe.elements.kinds import gauss_points
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import InvalidDesignError, MeshError
from fe.runtime.state import STANDARD_GRAVITY
from fe.structure.affine import natural_frequencies
from fe.verification import wing_checks
from fe.wing.gauges import gauge_output
from fe.wing.mesh import build_mesh
from fe.wing.operators import (
    AffineOperators,
    assemble,
    flapwise_bending_modes,
    lift_load,
    point_masses,
)
from tests.wings import rigid, tip_stiffness

# ---------------------------------------------------------------- mesh

RIB = {"thickness": 0.003, "young_modulus": 6e9, "poisson_ratio": 0.3, "density": 500.0}


@dataclass(frozen=True)
class MeasuredMesh:
    """A mesh and the volumes of its cells."""

    mesh: Any
    volume: FloatArray


@pytest.fixture(scope="module")
def measured_mesh(coarse_design):
    mesh = build_mesh(coarse_design)
    local_points, weights = gauss_points(3)
    volume = np.linalg.det(jacobians(mesh.kind, mesh.nodes, local_points)) @ weights
    return MeasuredMesh(mesh=mesh, volume=volume)


@pytest.fixture(params=[0, 1])
def region(request, coarse_design):
    """Name and definition of a region of damage."""
    return coarse_design.regions[request.param], coarse_design.defects[request.param]


def test_a_region_has_the_edges_of_the_design(coarse_design, measured_mesh, region):
    name, defect = region
    mesh = measured_mesh.mesh
    planform = coarse_design.planform
    cells = np.flatnonzero(mesh.region == mesh.region_names.index(name))

    x, y, _ = mesh.corners[cells].reshape(-1, 3).T
    fraction = x / planform.chord(y / planform.semi_span) + planform.straight_chord_line

    assert (y.min(), y.max()) == pytest.approx((defect.span_start, defect.span_end))
    chord_edges = (defect.chord_start, defect.chord_end)
    assert (fraction.min(), fraction.max()) == pytest.approx(chord_edges)


def test_a_region_has_the_volume_of_the_design(coarse_design, measured_mesh, region):
    name, defect = region
    mesh = measured_mesh.mesh
    planform = coarse_design.planform
    cells = np.flatnonzero(mesh.region == mesh.region_names.index(name))

    middle = 0.5 * (defect.span_start + defect.span_end)
    length = defect.span_end - defect.span_start
    width = (defect.chord_end - defect.chord_start) * planform.chord(middle / planform.semi_span)

    # The skin of 0.6 mm is curved, so that the patch is a little larger than its shadow.
    assert 1.0 <= measured_mesh.volume[cells].sum() / (length * width * 0.0006) <= 1.1


def test_the_design_has_two_regions(coarse_design):
    assert len(coarse_design.regions) == len(coarse_design.defects) == 2


def test_webs_have_the_volume_of_the_design(coarse_design, measured_mesh):
    for index, web in enumerate(coarse_design.webs):
        is_web = measured_mesh.mesh.web == index
        _, length, height = np.ptp(measured_mesh.mesh.corners[is_web], axis=1).T

        volume = measured_mesh.volume[is_web].sum()

        assert volume == pytest.approx((height * length * web.thickness).sum(), rel=0.1)


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(stations=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=4))
def test_a_rib_never_vanishes(coarse_design, stations):
    """What cannot be meshed is said, with the rib's name, and never swallowed."""
    ribs = [{**RIB, "station": station} for station in stations]
    refusal = None

    try:
        mesh = build_mesh(coarse_design.changed(ribs=ribs))
    except (InvalidDesignError, MeshError) as error:
        refusal = str(error)

    if refusal is None:
        for index in range(len(stations)):
            _, y, _ = mesh.corners[mesh.rib == index].reshape(-1, 3).T
            assert np.ptp(y) == pytest.approx(RIB["thickness"])
    else:
        assert "ribs[" in refusal


def test_a_rib_that_nearly_ends_at_a_region_is_named(coarse_design):
    region_start = coarse_design.defects[0].span_start
    station = (region_start + 0.0015 + 1e-5) / coarse_design.planform.semi_span
    design = coarse_design.changed(ribs=[{**RIB, "station": station}])

    with pytest.raises(MeshError, match=r"inner face of ribs\[0\].*inner edge of defects\[0\]"):
        build_mesh(design)


def test_a_region_that_nearly_ends_at_a_web_is_named(coarse_design):
    defects = [dict(defect) for defect in coarse_design.defects]
    defects[0]["chord_start"] = 0.29999 - 0.0015 / coarse_design.planform.root_chord

    with pytest.raises(MeshError, match=r"webs\[1\].*come closer"):
        build_mesh(coarse_design.changed(defects=defects))


# ---------------------------------------------------------------- operators


@pytest.fixture(scope="module")
def heave(coarse_operators):
    """The free unknowns of a rigid heave by one."""
    return rigid(coarse_operators)


def test_the_lift_has_the_force_of_the_design(coarse_operators, heave):
    lift = coarse_operators.wing_mesh.design.lift

    assert heave @ coarse_operators.turn(3.0) == pytest.approx(lift.force)


def test_the_lift_has_the_forward_force_of_the_design(coarse_operators):
    lift = coarse_operators.wing_mesh.design.lift
    along_x = lift_load(coarse_operators.wing_mesh)[::3]

    assert along_x.sum() * 3.0 == pytest.approx(-lift.forward_force)


def test_the_force_at_the_tip_is_the_one_that_is_asked_for(coarse_operators, heave):
    assert heave @ coarse_operators.turn(0.0, 2.5) == pytest.approx(2.5)


def test_the_load_of_a_turn_is_linear(coarse_operators):
    turn = coarse_operators.turn(2.0, 1.0)

    assert turn == pytest.approx(2.0 * coarse_operators.load_lift + coarse_operators.load_tip)


def test_a_heave_moves_the_tip_by_one(coarse_operators, heave):
    work = coarse_operators.load_tip @ heave
    displacement = coarse_operators.tip_row @ heave

    assert (work, displacement) == pytest.approx((1.0, 1.0))


def test_mass_terms_are_two_servos_and_a_pitot_tube_of_one_kilogram(coarse_operators, heave):
    _, servo_term, pitot_term = coarse_operators.mass_terms

    assert heave @ (servo_term @ heave) == pytest.approx(2.0)
    assert heave @ (pitot_term @ heave) == pytest.approx(1.0)


def read_gauges_in_bending(design, surface):
    """Return the strains (G,) of gauges in a curvature of two.

    w = y^2 bends a plate at height h: strain -2 (z - h) on the surface, -2 * 0 in its middle plane.
    """
    mesh = build_mesh(design.changed(gauges={"surface": surface}))
    _, y, z = mesh.points.T
    displacement = np.stack((0.0 * y, -2.0 * y * z, y**2), axis=1)
    return gauge_output(mesh) @ displacement.ravel()


def test_a_gauge_in_the_middle_does_not_see_the_bending_of_the_skin(coarse_design):
    on_surface = read_gauges_in_bending(coarse_design, "outer")
    in_middle = read_gauges_in_bending(coarse_design, "middle")

    # Plane sections turn about z = 0: the surface reads more by the curvature times half the
    # thickness.
    bending = np.full(24, coarse_design.skin.thickness)
    assert on_surface - in_middle == pytest.approx(bending, rel=0.15)


@dataclass(frozen=True)
class WeightRelief:
    """The wing without and with weight that relieves the lift."""

    plain: AffineOperators
    relieved: AffineOperators


@pytest.fixture(scope="module")
def weight_relief(coarse_design):
    return WeightRelief(
        plain=assemble(coarse_design.changed(lift={"inertia_relief": False})),
        relieved=assemble(coarse_design.changed(lift={"inertia_relief": True})),
    )


def test_the_weight_keeps_the_sum_of_the_lift(weight_relief):
    heave = rigid(weight_relief.plain)

    force = heave @ weight_relief.relieved.load_lift

    assert force == pytest.approx(heave @ weight_relief.plain.load_lift, rel=1e-12)


def test_the_weight_relieves_the_moment_of_the_lift(coarse_design, weight_relief):
    """Lift grows by the weight, and the weight acts where it is."""
    plain = weight_relief.plain
    masses = coarse_design.masses
    heave = rigid(plain)
    _, y, _ = plain.wing_mesh.points.T
    flap = rigid(plain, y)
    inertia = plain.mass(point_masses(masses.servo, masses.pitot)) @ heave

    moment = flap @ (weight_relief.relieved.load_lift - plain.load_lift)

    weight = STANDARD_GRAVITY * (heave @ inertia)
    weight_arm = (flap @ inertia) / (heave @ inertia)
    lift_arm = (flap @ plain.load_lift) / (heave @ plain.load_lift)
    assert moment == pytest.approx(weight * (lift_arm - weight_arm), rel=1e-6)


# ---------------------------------------------------------------- what is published

MASSES = point_masses(0.16875, 0.1345)


@dataclass(frozen=True)
class BendingModes:
    """The flapwise bending modes among the first six.

    Attributes
    ----------
    places : list of int
        Their numbers.
    frequency : (B,) array
        [Hz].
    """

    places: list[int]
    frequency: FloatArray


def find_bending(operators):
    """Return the flapwise bending modes of a wing with the published masses."""
    modes = natural_frequencies(operators, 6, MASSES)
    places = flapwise_bending_modes(operators, modes)
    return BendingModes(places=places.tolist(), frequency=modes.frequency[places])


@pytest.fixture(scope="module")
def coarse_bending(coarse_operators):
    return find_bending(coarse_operators)


@pytest.mark.parametrize(
    ("yaw_spring", "possible_places"),
    [(1.5e3, ([1, 2],)), (1e9, ([0, 1], [0, 2]))],
    ids=["soft", "stiff"],
)
def test_bending_is_found_wherever_the_lag_mode_lies(
    coarse_design, coarse_bending, yaw_spring, possible_places
):
    bending = find_bending(assemble(coarse_design.changed(root={"yaw_spring": yaw_spring})))

    assert bending.places in possible_places
    assert bending.frequency == pytest.approx(coarse_bending.frequency, rel=2e-3)


@pytest.mark.parametrize("modulus_factor", [0.98, 1.02])
def test_the_wing_has_the_published_stiffness(shipped_operators, modulus_factor):
    """Kapteyn et al. 2021, eq. (14): k(e) = 0.5752 e + 0.1018 N/mm."""
    stiffness = tip_stiffness(shipped_operators, modulus_factor)

    assert stiffness == pytest.approx(575.2 * modulus_factor + 101.8, rel=0.001)


def test_the_wing_has_the_published_frequencies(shipped_operators):
    """Those of the published model after calibration at e = 1, one other mode between them."""
    bending = find_bending(shipped_operators)

    assert bending.frequency == pytest.approx([5.632, 28.544], rel=0.0007)
    assert bending.places == [0, 2]


def test_the_wing_has_the_weight_of_its_parts(shipped_operators):
    """No weight is published: this is what the parts of the design weigh on its mesh."""
    heave = rigid(shipped_operators)
    structural_mass, *_ = shipped_operators.mass_terms

    assert heave @ (structural_mass @ heave) == pytest.approx(0.947, rel=0.002)


# ---------------------------------------------------------------- balances and convergence


@pytest.fixture(scope="module")
def balances(coarse_operators):
    return list(wing_checks.balance_checks(coarse_operators))


def test_every_sum_of_the_wing_has_a_name(balances):
    names = [check.name for check in balances]
    assert names[1:] == ["mass", "reaction", "root moment", "energy and work"]


def test_sums_of_the_coarse_wing_agree(balances):
    for check in balances:
        assert check.limit is not None, check.name
        assert check.passed, check.name


@pytest.fixture(scope="module")
def convergence(coarse_design):
    """Checks on three coarse meshes: their names and the kind of figures, not their size."""
    refinements = (0.25, 0.3, 0.36)
    return list(wing_checks.convergence_checks(coarse_design, refinements, limited=False))


def test_every_figure_converges_by_name(convergence):
    names = [check.name for check in convergence]

    assert names[:3] == ["tip stiffness", "first bending", "second bending"]
    gauges = [name for name in names if name.startswith("gauge ")]
    assert gauges == [f"gauge {number}" for number in range(1, 25)]


def test_the_first_figures_have_an_order_or_say_that_they_have_none(convergence):
    for check in convergence[:3]:
        assert "order" in check.note or "monotone" in check.note


@pytest.fixture(scope="module")
def meshes(shipped_design):
    """The wing on a mesh of a quarter, of a half and of the whole refinement."""
    return wing_checks.mesh_convergence(shipped_design, (0.25, 0.5, 1.0))


@pytest.mark.long
@pytest.mark.parametrize("name", ["tip_stiffness", "first_bending", "second_bending"])
def test_stiffness_and_frequencies_converge_with_the_mesh(meshes, name):
    assert (np.diff([mesh.unknowns for mesh in meshes]) > 0).all()
    quarter, half, whole = (getattr(mesh, name) for mesh in meshes)
    assert whole == pytest.approx(half, rel=0.025)
    assert half == pytest.approx(quarter, rel=0.025)


@pytest.mark.long
def test_strains_converge_with_the_mesh(meshes):
    _, half, whole = (mesh.strain for mesh in meshes)
    assert np.sqrt(np.mean((whole / half - 1.0) ** 2)) < 0.05


@pytest.mark.parametrize("order", [0.5, 1.0, 2.0, 3.7])
@pytest.mark.parametrize("refinements", [(0.5, 1.0, 2.0), (1.0, 1.5, 2.25), (0.25, 0.5, 1.5, 4.5)])
def test_the_order_of_a_power_law_is_found(refinements, order):
    values = [7.0 - 0.3 * refinement**-order for refinement in refinements]

    observed = wing_checks.observed_order(refinements[-1] / refinements[-2], values)

    assert observed == pytest.approx(order, abs=1e-6)


@pytest.mark.parametrize(
    "values",
    [(1.0, 2.0, 1.5), (1.0, 2.0, 4.0), (1.0, 1.0, 1.0)],
    ids=["to and fro", "running away", "standing still"],
)
def test_values_that_do_not_settle_have_no_order(values):
    assert math.isnan(wing_checks.observed_order(2.0, values))
