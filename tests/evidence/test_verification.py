"""A second idealisation of the wing beside closed forms and the box, and the known answers of elements."""

import itertools

import numpy as np
import pytest

from evidence.sandwich_plate import __main__ as command
from evidence.sandwich_plate import plate_known_answers as plates
from evidence.sandwich_plate.plate import FIELDS, B, W
from evidence.sandwich_plate.plate_comparison import compare_with_plate, gauges_at_edges
from evidence.sandwich_plate.plate_frame import strip_stiffness
from evidence.sandwich_plate.plate_layout import PlateLayout
from evidence.sandwich_plate.sandwich_plate import assemble_plate
from evidence.verification import calculix_examples as examples
from evidence.verification import known_answers as answers
from evidence.verification.__main__ import element_checks, ring_down_checks
from fe.full.factorisation import Factorisation
from fe.runtime.state import STANDARD_GRAVITY
from fe.verification.wing_checks import wing_balance
from fe.wing.operators import point_masses
from tests import command_line
from tests.calculix_decks import needs_calculix

CHECKS = (plates.square_plate_deflection, plates.square_plate_frequency, plates.cantilever_strip)


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize(
    ("core_shear", "cells", "error", "orders"),
    [(20e6, (4, 8), 2e-4, (3.6, 4.4)), (200e9, (4, 8, 16), 2e-3, (1.8, 2.5))],
)
def test_closed_forms_are_met_with_the_order_of_the_element(check, core_shear, cells, error, orders):
    """Four where the core shears as much as the plate bends; one that hardly shears locks mildly."""
    ratio = 0.0 if check is plates.cantilever_strip else 0.3
    plate = plates.FlatSandwich(core_shear=core_shear, poisson_ratio=ratio)
    errors = [abs(check(count, plate).relative_error) for count in cells]
    assert errors[-1] < error
    assert all(orders[0] < np.log2(coarse / fine) < orders[1] for coarse, fine in itertools.pairwise(errors))


def test_a_strip_is_a_beam():
    stiffness = strip_stiffness(np.array([0.5, 2.0]))[1]
    assert np.linalg.eigvalsh(stiffness)[:2] == pytest.approx(0.0, abs=1e-12)
    # Clamped on the left, a unit force on the right: L^3 / 3 and L^2 / 2.
    assert np.linalg.solve(stiffness[2:, 2:], [1.0, 0.0]) == pytest.approx([8.0 / 3.0, 2.0])


@pytest.fixture(scope="module")
def plate(coarse_design):
    return assemble_plate(coarse_design)


def rigid(plate):
    """Heave and flap of the whole wing, as free unknowns."""
    y = plate.plate.node_points[:, 1]
    fields = np.zeros((len(FIELDS), len(y)))
    fields[W] = 1.0
    heave = plate.free_unknowns(fields)
    heave[-3] = 1.0
    fields[W], fields[B] = y, -1.0
    flap = plate.free_unknowns(fields)
    flap[-2] = 1.0
    return heave, flap


def bent(operators, curvature=0.01):
    """Return the free unknowns of a wing of one curvature along its span."""
    y = operators.plate.node_points[:, 1]
    fields = np.zeros((len(FIELDS), len(y)))
    fields[B], fields[W] = curvature * y, -0.5 * curvature * y**2
    return operators.free_unknowns(fields)


def test_the_mass_of_the_plate_is_that_of_the_box(plate, coarse_operators):
    """The box's section is straight between mesh lines, its skin cells are as thick as they stand upright."""
    heave, _ = rigid(plate)
    wing, servos, pitot = (heave @ (term @ heave) for term in plate.mass_terms[:3])
    assert wing == pytest.approx(wing_balance(coarse_operators)["mass"].value, rel=0.02)
    assert servos == pytest.approx(2.0)  # two servos of 1 kg
    assert pitot == pytest.approx(1.0)


def test_force_and_moment_of_a_load_at_the_tip_are_those_of_the_box(plate, coarse_design):
    heave, flap = rigid(plate)
    assert heave @ plate.load_tip == pytest.approx(1.0)
    assert flap @ plate.load_tip == pytest.approx(coarse_design.planform.semi_span - 0.05)


def test_the_springs_of_the_root_hold_force_and_moment_of_the_lift(plate, coarse_design):
    heave, flap = rigid(plate)
    root = coarse_design.root
    turn = Factorisation(plate.stiffness()).solve(plate.load_lift)
    assert turn[-3] * root.transverse_spring == pytest.approx(heave @ plate.load_lift, rel=1e-6)
    assert turn[-2] * root.flap_spring == pytest.approx(flap @ plate.load_lift, rel=1e-6)


@pytest.fixture(scope="module")
def plate_without_relief(coarse_design):
    """The plate under the lift alone, without the weight that relieves it."""
    return assemble_plate(coarse_design.changed(lift={"inertia_relief": False}))


def test_the_net_force_of_a_turn_is_the_same_with_and_without_relief(
    plate, plate_without_relief, coarse_design
):
    heave, _ = rigid(plate)
    per_load_factor = coarse_design.lift.force / coarse_design.lift.load_factor
    for model in (plate, plate_without_relief):
        assert heave @ model.load_lift == pytest.approx(per_load_factor, rel=1e-12)


def test_relief_lowers_the_moment_because_the_weight_lies_further_out_than_the_lift(
    plate, plate_without_relief, coarse_design
):
    heave, flap = rigid(plate)
    masses = point_masses(coarse_design.masses.servo, coarse_design.masses.pitot)
    weight = STANDARD_GRAVITY * (plate.mass(masses) @ heave)
    arm_of_lift = (flap @ plate_without_relief.load_lift) / (heave @ plate_without_relief.load_lift)
    fall = flap @ plate_without_relief.load_lift - flap @ plate.load_lift
    assert fall == pytest.approx(flap @ weight - arm_of_lift * (heave @ weight), rel=1e-6)


@pytest.mark.parametrize("surface", ["outer", "middle"])
def test_gauges_read_a_curvature_times_the_height(coarse_design, surface):
    # v + z b with b = y c and w = -c y^2 / 2: on the upper surface the strain along the span is z c.
    patch = {"averaging_chordwise": 0.03, "averaging_spanwise": 0.02}
    for gauges, exact in (({"averaging_chordwise": 0.0, "averaging_spanwise": 0.0}, 5e-4), (patch, 3e-3)):
        design = coarse_design.changed(gauges={"surface": surface, **gauges})
        operators, layout, plan = assemble_plate(design), PlateLayout(design), design.planform
        strain = operators.gauge_output @ bent(operators)
        middles = np.array(
            [
                ((c - plan.straight_chord_line) * plan.chord(d / plan.semi_span), d)
                for d, c in design.gauges.positions
            ]
        )
        # Over a patch near the leading edge the mean height is 1 % less than that at its middle.
        share = (np.arange(40) + 0.5) / 40 - 0.5
        offsets = np.stack(np.meshgrid(*(size * share for size in gauges.values())), axis=-1).reshape(-1, 2)
        depth = 0.0 if surface == "outer" else 0.5 * design.skin.thickness
        height = layout.surface(middles[:, None] + offsets, depth).height.mean(axis=1)
        # The deflection is straight between the webs on tapered lines, so that it follows y^2 nearly.
        assert -strain == pytest.approx(0.01 * height, rel=exact)


def test_a_gauge_is_at_an_edge_that_its_widened_patch_reaches(shipped_design):
    """Widened by the cells at edges, or by the largest cells where the mesh names none."""
    wider = shipped_design.changed(mesh={"edge_size": None})
    assert np.flatnonzero(gauges_at_edges(shipped_design)).tolist() == [16, 17, 22, 23]
    assert np.flatnonzero(gauges_at_edges(wider)).tolist() == [16, 17, 18, 21, 22, 23]


def kept(checks, limits):
    """Look at differences of both models, by name, beside limits."""
    found = {check.name: check.value for check in checks}
    assert {name: found[name] for name, limit in limits.items() if found[name] > limit} == {}
    return found


@pytest.mark.long
def test_both_models_of_the_wing_agree(shipped_operators):
    """Nothing is fitted to either; docs/explanation/verification.md says what is left and why."""
    checks = [*command.plate_checks(shipped_operators)]
    assert [check.name for check in checks if not check.passed] == []


@pytest.fixture(scope="module")
def comparisons(coarse_design, coarse_operators):
    """Comparisons of the coarse box with the plate, by whether the plate has the box's straight section."""
    return {
        straight: compare_with_plate(coarse_design, coarse_operators, straight_section=straight)
        for straight in (False, True)
    }


@pytest.fixture
def compared_once(comparisons, monkeypatch):
    """Have the command take these comparisons, which take seconds."""
    monkeypatch.setattr(
        command, "compare_with_plate", lambda *_, straight_section: comparisons[straight_section]
    )


@pytest.fixture
def plate_checks(compared_once, coarse_operators):
    """The checks of the command in its three groups: closed forms, true section, the box's section."""
    groups = {}
    for check in command.plate_checks(coarse_operators):
        groups.setdefault(check.group, []).append(check)
    closed_forms, true_section, straight_section = groups.values()
    return closed_forms, true_section, straight_section


def test_the_plate_passes_its_checks_beside_the_box(plate_checks):
    """All but that of the second bending, which has the limit of the mesh of the design."""
    checks = [check for group in plate_checks for check in group]
    assert len(plate_checks[0]) == 3
    assert {check.name for check in checks if not check.passed} <= {"second bending"}
    assert all(check.limit is not None for check in checks if "rms" in check.name)


LARGEST_DIFFERENCES = {
    "tip stiffness": 0.003,
    "first bending": 0.002,
    "d ln k / d ln e": 0.002,
    "d ln strain / d ln e, rms": 0.0105,
    "strain ratio, z1 = 0.8, rms": 0.011,
    "strain ratio, z2 = 0.8, rms": 0.007,
}


def test_the_plate_differs_little_from_the_box(plate_checks):
    """Second bending of a coarse box lies 0.8 % above that of a fine one, of a plate of its section 0.2 %."""
    _, true_section, straight_section = plate_checks
    true = kept(true_section, LARGEST_DIFFERENCES | {"second bending": 0.006})
    straight = kept(straight_section, LARGEST_DIFFERENCES | {"second bending": 0.0105})
    assert true["unknowns, over those of the box"] < 0.5
    # What is left of single strains is the section's: the same one brings them nearer.
    assert straight["gauges, rms"] < 0.5 * true["gauges, rms"] < 0.012


@pytest.mark.usefixtures("compared_once")
def test_the_command_prints_the_checks_of_the_plate(monkeypatch, capsys):
    """Of the closed forms it says that they are kept; differences have limits on the mesh of the design."""
    exit_code = command_line.call(monkeypatch, "--quick", main=command.main)
    text = capsys.readouterr().out
    assert exit_code == 0
    assert text.count("kept") == 3
    assert "plate of the box's section" in text


# ---------------------------------------------------------------- known answers of the elements


def test_every_known_answer_is_met():
    checks = list(element_checks())
    assert [check.name for check in checks if not check.passed] == []
    assert {check.group for check in checks} == {
        "patch test", "unsupported body", "cantilever", "MacNeal-Harder",
    }  # fmt: skip
    assert answers.rigid_body_values()[6] > 1e-6


def test_a_cantilever_converges_to_timoshenkos_beam():
    coarse, middle, fine = (abs(answers.cantilever_check(cells)) for cells in (5, 10, 20))
    assert fine < middle < coarse < 0.01
    assert 2.5 < np.log2(coarse / middle) < 4.5  # the tip of a quadratic element: third to fourth order


@pytest.mark.skipif(not examples.DECKS.is_dir(), reason="Debian's calculix-ccx-test is not installed")
@pytest.mark.parametrize("name", examples.NAMES)
def test_decks_of_calculix_give_its_published_results(name, tmp_path):
    assert examples.published_difference(name, tmp_path) < 1e-6


@pytest.mark.long
@needs_calculix
def test_a_ring_down_agrees(coarse_operators, tmp_path):
    direct, same_rule = ring_down_checks(coarse_operators, tmp_path, 0.125)
    assert direct.passed
    assert same_rule.value < 3e-4  # what is left is not the time integration
