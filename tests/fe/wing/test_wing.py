"""A wing: design, lift, mesh, operators, balances; its responses against what is published, and CalculiX."""

import math
import tomllib
from functools import reduce
from operator import getitem

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fe.elements.cells import jacobians
from fe.elements.kinds import gauss_points
from fe.runtime.errors import CalculixError, InvalidDesignError, MeshError
from fe.runtime.state import STANDARD_GRAVITY, DigitalState
from fe.structure.affine import natural_frequencies
from fe.verification import wing_checks
from fe.verification.calculix_comparison import agreement
from fe.verification.calculix_deck import wing_deck
from fe.verification.calculix_run import read_frequencies, read_tables, run_calculix
from fe.wing import operators as modelled
from fe.wing.design import SHIPPED_DESIGN, parse_design
from fe.wing.gauges import gauge_output
from fe.wing.mesh import build_mesh
from fe.wing.operators import assemble, flapwise_bending_modes, lift_load, point_masses
from fe.wing.parts import DISTRIBUTIONS, Planform, lifting_line
from tests.calculix_decks import needs_calculix
from tests.refusals import Inputs, refused
from tests.wings import rigid, tip_stiffness

INPUTS = Inputs(__file__)


def test_the_wing_with_a_third_region_is_the_shipped_one_with_a_third_region():
    shipped, three = (
        tomllib.loads(SHIPPED_DESIGN.with_name(name).read_text(encoding="utf-8"))
        for name in ("uav_wing.toml", "uav_wing_three_regions.toml")
    )
    assert set(three["defects"].pop()) == {"span_start", "span_end", "chord_start", "chord_end"}
    assert (three.pop("name"), shipped.pop("name")) == ("UAV wing, three regions", "UAV wing")
    assert three == shipped


@pytest.mark.parametrize(("path", "value", "sentence"), INPUTS.refused("wing"))
def test_a_wrong_design_is_refused_with_one_sentence_that_names_the_place(path, value, sentence):
    content = tomllib.loads(SHIPPED_DESIGN.read_text(encoding="utf-8"))
    if path == ["defects", 1, "span_start"]:
        content["defects"][1]["chord_end"] = 0.3
    reduce(getitem, path[:-1], content)[path[-1]] = value
    with refused(InvalidDesignError, rf"^wing\.toml: .*({sentence}).*\.$"):
        parse_design(content, source="wing.toml")


def test_the_modulus_runs_straight_between_stations_and_steps_between_bands(shipped_design):
    stations = [{"station": s, "young_modulus": m} for s, m in ((0.0, 8e9), (0.5, 10e9), (1.0, 6e9))]
    skin = shipped_design.changed(skin={"stations": stations}).skin
    assert skin.young_modulus(np.array([0.0, 0.25, 0.5, 0.75])) == pytest.approx([8e9, 9e9, 10e9, 8e9])

    def banded(*ends, moduli=(8e9, 6e9)):
        bands = [{"end": end, "young_modulus": own} for end, own in zip(ends, moduli, strict=True)]
        return shipped_design.changed(skin={"stations": [], "bands": bands}).skin

    assert banded(0.5, 1.0).young_modulus(np.array([0.1, 0.5, 0.51])).tolist() == [8e9, 8e9, 6e9]
    for last in (0.4, 0.9):
        with pytest.raises(InvalidDesignError, match="the ends of the bands must rise"):
            banded(0.5, last)


# ---------------------------------------------------------------- lift


@pytest.mark.parametrize("name", sorted(DISTRIBUTIONS))
@given(span=st.floats(0.5, 10.0), root=st.floats(0.1, 1.0), taper=st.floats(0.3, 1.0))
def test_a_distribution_integrates_to_one_over_the_half_wing(name, span, root, taper):
    plan = Planform(semi_span=span, root_chord=root, tip_chord=root * taper, straight_chord_line=0.25)
    angle = np.linspace(0.0, 0.5 * np.pi, 2001)
    station = np.sin(angle)
    lift = DISTRIBUTIONS[name](plan, station)
    assert np.trapezoid(lift * span, station) == pytest.approx(1.0, rel=1e-4)
    assert np.all(lift[:-1] > 0.0)


def test_the_lifting_line_has_the_induced_drag_of_glauerts_table():
    """Glauert 1926, four terms: beyond an ellipse's, of rectangular wings by aspect ratio over slope."""
    angle, order = (np.arange(400) + 0.5) * np.pi / 800.0, np.arange(1, 20, 2)
    for ratio, beyond in ((0.75, 0.034), (1.0, 0.049), (1.25, 0.063), (1.5, 0.076), (1.75, 0.088)):
        plan = Planform(semi_span=np.pi * ratio, root_chord=1.0, tip_chord=1.0, straight_chord_line=0.25)
        shares = np.sin(np.outer(order, angle)) @ lifting_line(plan, np.cos(angle), 4)
        assert order[1:] @ (shares[1:] / shares[0]) ** 2 == pytest.approx(beyond, abs=5e-4)


# ---------------------------------------------------------------- mesh

RIB = {"thickness": 0.003, "young_modulus": 6e9, "poisson_ratio": 0.3, "density": 500.0}


def test_parts_have_the_edges_and_volumes_of_the_design(coarse_design):
    coarse_mesh = build_mesh(coarse_design)
    plan, (local, weight) = coarse_design.planform, gauss_points(3)
    volume = np.linalg.det(jacobians(coarse_mesh.kind, coarse_mesh.nodes, local)) @ weight
    for name, defect in zip(coarse_design.regions, coarse_design.defects, strict=True):
        inside = np.flatnonzero(coarse_mesh.region == coarse_mesh.region_names.index(name))
        x, y, _ = coarse_mesh.corners[inside].reshape(-1, 3).T
        fraction = x / plan.chord(y / plan.semi_span) + plan.straight_chord_line
        assert (y.min(), y.max()) == pytest.approx((defect.span_start, defect.span_end))
        assert (fraction.min(), fraction.max()) == pytest.approx((defect.chord_start, defect.chord_end))
        middle = plan.chord(0.5 * (defect.span_start + defect.span_end) / plan.semi_span)
        area = (defect.span_end - defect.span_start) * (defect.chord_end - defect.chord_start) * middle
        # The skin is curved, so that the patch is a little larger than its shadow.
        assert 1.0 <= volume[inside].sum() / (area * 0.0006) <= 1.1
    for index, web in enumerate(coarse_design.webs):
        inside = coarse_mesh.web == index
        _, length, height = np.ptp(coarse_mesh.corners[inside], axis=1).T
        assert volume[inside].sum() == pytest.approx((height * length * web.thickness).sum(), rel=0.1)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(stations=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=4))
def test_a_rib_never_vanishes(coarse_design, stations):
    try:
        mesh = build_mesh(coarse_design.changed(ribs=[{**RIB, "station": station} for station in stations]))
    except (InvalidDesignError, MeshError) as error:
        refusal = str(error)
    else:
        refusal = ""
        for index in range(len(stations)):
            corners = mesh.corners[mesh.rib == index].reshape(-1, 3)
            assert np.ptp(corners[:, 1]) == pytest.approx(RIB["thickness"])
    # What cannot be meshed is said, with the rib's name, and never swallowed.
    assert refusal == "" or "ribs[" in refusal


def test_mesh_lines_that_nearly_coincide_are_named(coarse_design):
    plan, defects = coarse_design.planform, [dict(defect) for defect in coarse_design.defects]
    station = (defects[0]["span_start"] + 0.0015 + 1e-5) / plan.semi_span
    defects[0]["chord_start"] = 0.29999 - 0.0015 / plan.root_chord
    for changes, sentence in (
        ({"ribs": [{**RIB, "station": station}]}, r"inner face of ribs\[0\].*inner edge of defects\[0\]"),
        ({"defects": defects}, r"webs\[1\].*come closer"),
    ):
        with pytest.raises(MeshError, match=sentence):
            build_mesh(coarse_design.changed(**changes))


# ---------------------------------------------------------------- operators


def test_a_rigid_heave_meets_the_loads_of_the_design_and_moves_every_output_by_one(coarse_operators):
    wing, heave = coarse_operators, rigid(coarse_operators)
    assert heave @ wing.turn(3.0) == pytest.approx(wing.wing_mesh.design.lift.force)
    assert lift_load(wing.wing_mesh)[::3].sum() * 3.0 == pytest.approx(
        -wing.wing_mesh.design.lift.forward_force
    )
    assert heave @ wing.turn(0.0, 2.5) == pytest.approx(2.5)
    assert wing.turn(2.0, 1.0) == pytest.approx(2.0 * wing.load_lift + wing.load_tip)
    assert (wing.load_tip @ heave, wing.tip_row @ heave) == pytest.approx((1.0, 1.0))
    assert heave @ (wing.mass_terms[1] @ heave) == pytest.approx(2.0)  # two servos of 1 kg
    assert heave @ (wing.mass_terms[2] @ heave) == pytest.approx(1.0)


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
    plain, relieved = (
        modelled.assemble(coarse_design.changed(lift={"inertia_relief": on})) for on in (False, True)
    )
    heave, masses = rigid(plain), coarse_design.masses
    assert heave @ relieved.load_lift == pytest.approx(heave @ plain.load_lift, rel=1e-12)
    # Lift grows by the weight and the weight acts where it is: the moment of the difference is known.
    moved = plain.mass(modelled.point_masses(masses.servo, masses.pitot)) @ heave
    flap = rigid(plain, plain.wing_mesh.points[:, 1])
    arm, lift_arm = ((flap @ load) / (heave @ load) for load in (moved, plain.load_lift))
    found, weight = flap @ (relieved.load_lift - plain.load_lift), STANDARD_GRAVITY * (heave @ moved)
    assert found == pytest.approx(weight * (lift_arm - arm), rel=1e-6)


# ---------------------------------------------------------------- responses against what is published

MASSES = point_masses(0.16875, 0.1345)


def test_bending_is_found_wherever_the_lag_mode_lies(coarse_design, coarse_operators):
    plain = natural_frequencies(coarse_operators, 6, MASSES)
    wanted = plain.frequency[flapwise_bending_modes(coarse_operators, plain)]
    for yaw_spring, places in ((1.5e3, ([1, 2],)), (1e9, ([0, 1], [0, 2]))):
        operators = assemble(coarse_design.changed(root={"yaw_spring": yaw_spring}))
        modes = natural_frequencies(operators, 6, MASSES)
        bending = flapwise_bending_modes(operators, modes)
        assert bending.tolist() in places
        assert modes.frequency[bending] == pytest.approx(wanted, rel=2e-3)


def test_the_wing_has_the_published_stiffness_and_frequencies(shipped_operators):
    # Kapteyn et al. 2021, eq. (14): k(e) = 0.5752 e + 0.1018 N/mm.
    for factor in (0.98, 1.02):
        assert tip_stiffness(shipped_operators, factor) == pytest.approx(575.2 * factor + 101.8, rel=0.001)
    # The published model after calibration: 5.632 Hz and 28.544 Hz at e = 1, one other mode between them.
    modes = natural_frequencies(shipped_operators, 6, MASSES)
    bending = flapwise_bending_modes(shipped_operators, modes)
    assert modes.frequency[bending] == pytest.approx([5.632, 28.544], rel=0.0007)
    assert bending.tolist() == [0, 2]
    # No weight is published: this is what the parts of the design weigh on its mesh.
    heave = rigid(shipped_operators)
    assert heave @ (shipped_operators.mass_terms[0] @ heave) == pytest.approx(0.947, rel=0.002)


# ---------------------------------------------------------------- balances and convergence


def test_sums_agree_and_every_gauge_converges_by_name(coarse_design, coarse_operators):
    checks = list(wing_checks.balance_checks(coarse_operators))
    assert [check.name for check in checks[1:]] == ["mass", "reaction", "root moment", "energy and work"]
    assert all(check.limit is not None and check.passed and check.value < 1e-6 for check in checks)
    # Three coarse meshes: the names and the kind of figures, not their size.
    checks = list(wing_checks.convergence_checks(coarse_design, (0.25, 0.3, 0.36), limited=False))
    names = [check.name for check in checks]
    assert names[:3] == ["tip stiffness", "first bending", "second bending"]
    assert [name for name in names if name.startswith("gauge ")] == [f"gauge {n}" for n in range(1, 25)]
    assert all("order" in check.note or "monotone" in check.note for check in checks[:3])


@pytest.mark.long
def test_the_mesh_converges(shipped_design):
    meshes = wing_checks.mesh_convergence(shipped_design, (0.25, 0.5, 1.0))
    assert (np.diff([mesh.unknowns for mesh in meshes]) > 0).all()
    for name in ("tip_stiffness", "first_bending", "second_bending"):
        coarse, half, one = (getattr(mesh, name) for mesh in meshes)
        assert one == pytest.approx(half, rel=0.025)
        assert half == pytest.approx(coarse, rel=0.025)
    _, half, one = (mesh.strain for mesh in meshes)
    assert np.sqrt(np.mean((one / half - 1.0) ** 2)) < 0.05


@pytest.mark.parametrize("order", [0.5, 1.0, 2.0, 3.7])
@pytest.mark.parametrize("refinements", [(0.5, 1.0, 2.0), (1.0, 1.5, 2.25), (0.25, 0.5, 1.5, 4.5)])
def test_the_order_of_a_power_law_is_found(refinements, order):
    values = [7.0 - 0.3 * refinement**-order for refinement in refinements]
    found = wing_checks.observed_order(refinements[-1] / refinements[-2], values)
    assert found == pytest.approx(order, abs=1e-6)


@pytest.mark.parametrize("values", [(1.0, 2.0, 1.5), (1.0, 2.0, 4.0), (1.0, 1.0, 1.0)])
def test_no_order_where_values_do_not_settle(values):  # to and fro, running away, standing still
    assert math.isnan(wing_checks.observed_order(2.0, values))


# ---------------------------------------------------------------- the wing against CalculiX


ROD = {"web": 1, "reach": 0.25, "diameter": 0.012, "young_modulus": 120e9, "density": 1600.0}
DAMAGED = {"young_modulus_factor": 1.0073, "stiffness_loss": (0.4, 0.6), "servo_mass": 0.0, "pitot_mass": 0.3}
FEW_CELLS = {"edge_size": None, "span_size": 0.2, "chord_size": 0.2}
PLACES = {"nodal displacements": 1e-5, "displacement outputs": 1e-5, "strains at integration points": 2e-5}


@needs_calculix
@pytest.mark.parametrize(
    ("state", "changes"),
    [
        (DAMAGED, {}),
        ({}, {"rods": [ROD], "skin": {"closed_leading_edge": False}}),
    ],
    ids=["damaged, with other masses", "with a rod and no wall at its nose"],
)
def test_statics_and_frequencies_agree(state, changes, coarse_design, tmp_path):
    wing = assemble(coarse_design.changed(mesh=FEW_CELLS, **changes))
    found = agreement(wing_deck(wing, DigitalState(**state)), tmp_path, 6)
    assert list(found.loads) == ["tip force", "lift"]
    for differences in found.loads.values():
        assert all(differences[name] < most for name, most in PLACES.items())
        assert changes or differences["gauge strains"] < 1e-5
    assert len(found.ours) == 6
    assert found.modal < 1e-5


@needs_calculix
def test_an_input_that_calculix_refuses_is_one_sentence(tmp_path):
    with pytest.raises(CalculixError, match=r"did not finish .*bad\.inp.*bad\.log"):
        run_calculix("*NONSENSE\n*STEP\n*STATIC\n*END STEP\n", tmp_path, "bad")


def test_calculix_that_is_not_there_is_one_sentence(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(CalculixError, match="apt-get install calculix-ccx"):
        run_calculix("", tmp_path, "job")


TABLES, EIGENVALUES = (INPUTS.text(f"{name}.dat") for name in ("tables", "eigenvalues"))


def test_printed_tables_are_read_or_refused():
    tables = {name: [rows.tolist() for rows in own] for name, own in read_tables(TABLES).items()}
    assert tables == {"NALL": [[[1, 0.1, -2, 0], [2, 0.3, 4, 5]]], "E0": [[[1, 1, 2.5]]]}
    assert read_frequencies(EIGENVALUES).tolist() == [5.632151, 15.09876]
    with pytest.raises(CalculixError, match="not a row of numbers"):
        read_tables(TABLES.replace("-2.000000E+00", "*************"))
    with pytest.raises(CalculixError, match="no eigenvalues"):
        read_frequencies(TABLES)
