"""The patched wing at rest, against full models that are changed in their own way."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest

from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.runtime import patch
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import LoadPlace, LocalStiffnessLoss, ModelPatch, PointMass, SupportCompliance
from fe.wing.gauges import gauge_output
from fe.wing.operators import (
    AffineOperators,
    assemble,
    lift_load,
    point_masses,
    section_displacement,
    upward,
)
from fe.wing.parts import DISTRIBUTIONS
from tests.fe.runtime.full_wing import (
    FREQUENCY_ACCURACY,
    LOSSES,
    MASSES,
    MODULUS_FACTOR,
    SOUND,
    STRAIN_ACCURACY,
    WingComparison,
)
from tests.refusals import Inputs, refused

# ---------------------------------------------------------------- structure


@dataclass(frozen=True)
class ChangedStructure:
    """A structure that a patch changed, and the full model of the same change.

    Attributes
    ----------
    patched
        The patched structure.
    operators : AffineOperators
        The full model.
    stiffness : sparse matrix
        The stiffness of the full model.
    masses : tuple of float
        Servo and pitot mass of the full model [kg].
    lag_accuracy : float
        Accuracy wanted of the second frequency, which is that of the lag mode.
    """

    patched: Any
    operators: AffineOperators
    stiffness: Any
    masses: tuple[float, float] = MASSES
    lag_accuracy: float = FREQUENCY_ACCURACY


def full_stiffness(operators: AffineOperators) -> Any:
    """Return the stiffness of a full model in the state of the tests."""
    return operators.stiffness({"young_modulus_factor": MODULUS_FACTOR}, LOSSES)


def change_root(wings: WingComparison, fraction: float) -> ChangedStructure:
    """A compliance of the root is a softer spring; the fraction is of 2.5 times the largest one."""
    compliance = fraction * wings.arrays.largest_compliance / 0.4
    softer_spring = 1.0 / (1.0 / wings.design.root.flap_spring + compliance)
    operators = assemble(wings.design.changed(root={"flap_spring": softer_spring}))
    return ChangedStructure(
        patched=wings.patched_structure(SupportCompliance("root", "rx", compliance)),
        operators=operators,
        stiffness=full_stiffness(operators),
    )


def soften_cells(
    wings: WingComparison, first_line: int, last_line: int, loss: float
) -> ChangedStructure:
    """A local loss between mesh lines is softer cells."""
    start, end = wings.arrays.strip_lines[[first_line, last_line]]
    return ChangedStructure(
        patched=wings.patched_structure(LocalStiffnessLoss(loss, start, end - start)),
        operators=wings.operators,
        stiffness=wings.softened_stiffness(wings.operators, start, end, loss),
        lag_accuracy=1e-3,
    )


def move_pitot_tube(wings: WingComparison, station: float, mass: float) -> ChangedStructure:
    """A point mass is a pitot tube that was moved."""
    servo_mass, _ = MASSES
    servos = [point.model_dump() for point in wings.design.point_masses if point.kind == "servo"]
    pitot = {"kind": "pitot", "station": station, "chord": wings.design.tip_load.chord}
    operators = assemble(wings.design.changed(point_masses=[*servos, pitot]))
    added = PointMass(mass, station * wings.wing.span)
    return ChangedStructure(
        patched=wings.patched_structure(added, masses=(servo_mass, 0.0)),
        operators=operators,
        stiffness=full_stiffness(operators),
        masses=(servo_mass, mass),
    )


def warm_wing(
    wings: WingComparison,
    coefficient: float,
    modulus_factor: float = MODULUS_FACTOR,
    losses: tuple[float, float] = LOSSES,
) -> ChangedStructure:
    """A temperature changes the factor of the modulus; without a coefficient nothing is changed."""
    warm_factor = modulus_factor * (1.0 - 25.0 * coefficient)
    return ChangedStructure(
        patched=wings.patched_structure(
            patch.ModulusTemperature(coefficient),
            state=(modulus_factor, losses),
            temperature=25.0,
        ),
        operators=wings.operators,
        stiffness=wings.operators.stiffness({"young_modulus_factor": warm_factor}, losses),
    )


STRUCTURAL_CHANGES: dict[str, Callable[[WingComparison], ChangedStructure]] = {
    "soft root": partial(change_root, fraction=0.3),
    "loss in one strip": partial(soften_cells, first_line=5, last_line=6, loss=0.5),
    "loss in three strips": partial(soften_cells, first_line=7, last_line=10, loss=0.6),
    "light mass outboard": partial(move_pitot_tube, station=0.75, mass=0.05),
    "heavy mass inboard": partial(move_pitot_tube, station=0.4, mass=0.2),
    "warm": partial(warm_wing, coefficient=2e-3),
    "another state": partial(warm_wing, coefficient=0.0, modulus_factor=0.95, losses=(0.6, 0.3)),
}


@pytest.fixture(scope="module", params=STRUCTURAL_CHANGES)
def changed_structure(request, wings):
    return STRUCTURAL_CHANGES[request.param](wings)


@pytest.fixture(scope="module")
def full_responses(wings, changed_structure):
    """Full solutions under the lift of 2.5 g and under a force at the tip."""
    operators = changed_structure.operators
    loads = np.column_stack((2.5 * wings.operators.load_lift, operators.load_tip))
    under_lift, under_tip_force = Factorisation(changed_structure.stiffness).solve(loads).T
    return {"lift": under_lift, "tip force": under_tip_force}


def test_a_changed_structure_responds_to_lift_as_the_full_model(
    wings, changed_structure, full_responses
):
    response = changed_structure.patched.static(wings.manoeuvre_load(2.5))

    wings.assert_same_response(response, full_responses["lift"], changed_structure.operators)


def test_a_changed_structure_responds_to_a_tip_force_as_the_full_model(
    wings, changed_structure, full_responses
):
    response = changed_structure.patched.static(wings.tip_load)

    wings.assert_same_response(response, full_responses["tip force"], changed_structure.operators)


def test_a_changed_structure_has_the_first_frequencies_of_the_full_model(changed_structure):
    first, lag, second = changed_structure.patched.lowest_modes(3).frequency

    mass = changed_structure.operators.mass(point_masses(*changed_structure.masses))
    squares, _ = lowest_eigenpairs(changed_structure.stiffness, mass, 3)
    full_first, full_lag, full_second = np.sqrt(squares) / (2.0 * np.pi)
    bending = (full_first, full_second)
    assert (first, second) == pytest.approx(bending, rel=FREQUENCY_ACCURACY)
    assert lag == pytest.approx(full_lag, rel=changed_structure.lag_accuracy)


# ---------------------------------------------------------------- a loss that parts strips


@dataclass(frozen=True)
class PartedStrips:
    """Relative changes by a loss between lines of a finer mesh that part strips of the coarse one.

    They are ratios, because the two meshes differ a little in themselves.

    Attributes
    ----------
    strain_ratio, full_strain_ratio : (G,) array
        Strain with the loss over strain without it, of the patched and of the full wing.
    strain_weight : (G,) array
        Strain of each gauge over the largest one.
    tip_ratio, full_tip_ratio : float
        The same of the displacement at the tip.
    """

    strain_ratio: FloatArray
    full_strain_ratio: FloatArray
    strain_weight: FloatArray
    tip_ratio: float
    full_tip_ratio: float


def nearest_line(lines: FloatArray, y: float) -> float:
    """Return the mesh line next to a place along the span."""
    return float(lines[np.abs(lines - y).argmin()])


@pytest.fixture(scope="module")
def parted_strips(wings):
    """A loss of 0.4 from 0.2 m to 0.45 m, and the wing in cells of 40 mm along the span."""
    finer = assemble(wings.design.changed(mesh={"span_size": 0.01}))
    start = nearest_line(finer.wing_mesh.span_lines, 0.2)
    end = nearest_line(finer.wing_mesh.span_lines, 0.45)
    loss = 0.4

    # the full model with cells that end at these lines
    full_sound = Factorisation(finer.stiffness()).solve(finer.load_lift)
    softened = wings.softened_stiffness(finer, start, end, loss)
    full_damaged = Factorisation(softened).solve(finer.load_lift)
    full_strain = finer.gauge_output @ full_sound

    # the patched wing, whose strips end elsewhere
    local_loss = LocalStiffnessLoss(loss, start, end - start)
    load = wings.manoeuvre_load(1.0)
    sound = wings.patched_structure(state=SOUND).static(load)
    damaged = wings.patched_structure(local_loss, state=SOUND).static(load)
    strain_factors = wings.wing.strain_factors(ModelPatch((local_loss,)))
    damaged_strain = strain_factors * (wings.strain_rows @ damaged)

    full_tip_ratio = float(finer.tip_row @ full_damaged) / float(finer.tip_row @ full_sound)
    return PartedStrips(
        strain_ratio=damaged_strain / (wings.strain_rows @ sound),
        full_strain_ratio=finer.gauge_output @ full_damaged / full_strain,
        strain_weight=np.abs(full_strain) / np.abs(full_strain).max(),
        tip_ratio=wings.tip_displacement(damaged) / wings.tip_displacement(sound),
        full_tip_ratio=full_tip_ratio,
    )


def test_a_loss_that_parts_strips_changes_strains_as_a_mesh_with_lines_there(parted_strips):
    error = parted_strips.strain_ratio - parted_strips.full_strain_ratio
    effect = parted_strips.full_strain_ratio - 1.0

    largest_error = np.abs(error * parted_strips.strain_weight).max()
    assert largest_error < 0.03 * np.abs(effect * parted_strips.strain_weight).max()


def test_a_loss_that_parts_strips_changes_the_tip_as_a_mesh_with_lines_there(parted_strips):
    # the strips of this mesh are 0.26 m long, four times those of the shipped one
    effect = parted_strips.full_tip_ratio - 1.0

    assert parted_strips.tip_ratio - 1.0 == pytest.approx(effect, rel=0.05)


# ---------------------------------------------------------------- losses of whole strips


@pytest.fixture(scope="module")
def strip_bounds(wings):
    """Start and end of two strips."""
    start, end = wings.arrays.strip_lines[[4, 6]]
    return start, end


def test_all_strips_together_are_the_skin(wings):
    everywhere = LocalStiffnessLoss(0.25, 0.0, wings.wing.span)

    stiffness = wings.patched_structure(everywhere, state=SOUND).stiffness

    softer_skin = np.tensordot((0.75, 0.75, 0.75, 1.0), wings.arrays.stiffness, 1)
    assert np.abs(stiffness - softer_skin).max() < 1e-6 * np.abs(softer_skin).max()


def test_losses_that_overlap_multiply(wings, strip_bounds):
    start, end = strip_bounds
    loss = LocalStiffnessLoss(0.3, start, end - start)
    as_one = LocalStiffnessLoss(0.51, start, end - start)

    twice = wings.patched_structure(loss, loss).stiffness

    assert np.abs(twice - wings.patched_structure(as_one).stiffness).max() < 1e-12


def test_a_loss_that_begins_beyond_the_root_begins_at_the_root(wings, strip_bounds):
    _, end = strip_bounds
    beyond = LocalStiffnessLoss(0.3, -0.2, end + 0.2)
    within = LocalStiffnessLoss(0.3, 0.0, end)

    stiffness = wings.patched_structure(beyond).stiffness

    assert np.array_equal(stiffness, wings.patched_structure(within).stiffness)


def test_strains_need_no_factor_where_a_loss_ends_at_strips(wings, strip_bounds):
    start, end = strip_bounds
    loss = LocalStiffnessLoss(0.3, start, end - start)

    factors = wings.wing.strain_factors(ModelPatch((loss,)))

    assert factors == pytest.approx(1.0, abs=1e-12)


def test_strains_need_no_factor_without_a_loss(wings):
    without_loss = ModelPatch((PointMass(0.1, 1.0), LocalStiffnessLoss(0.0, 0.1, 0.2)))

    assert wings.wing.strain_factors(without_loss) is None


# ---------------------------------------------------------------- loads

Loads = tuple[FloatArray, FloatArray]
"""The same load of the patched and of the full wing."""
WEBS = (0.03, 0.3, 0.6, 0.91)
"""Where the webs lie, in fractions of the chord."""


def move_force(
    wings: WingComparison, shift: float, chordwise: float, chord: float | None = None
) -> Loads:
    """Move the force at the tip along the span and along the chord [m].

    A force follows the lever of the two webs beside its place, without a kink where it crosses one.
    `chord` is the place before, in fractions of the chord, if it is not that of the design.
    """
    nominal = wings.design.tip_load.chord if chord is None else chord
    outer_web = int(np.searchsorted(WEBS, nominal, side="right"))
    forward, aft = WEBS[outer_web - 1 : outer_web + 1]
    y = wings.load_place + shift
    chord_length = wings.design.planform.chord(y / wings.design.planform.semi_span)
    fraction = nominal + chordwise / chord_length
    aft_weight = (fraction - forward) / (aft - forward)
    on_forward_web = section_displacement(wings.mesh, y, forward)
    on_aft_web = section_displacement(wings.mesh, y, aft)
    full = (1.0 - aft_weight) * on_forward_web + aft_weight * on_aft_web
    place = "tip_load" if chord is None else (wings.load_place, chord)
    reduced = wings.wing.force_row(place, ModelPatch((LoadPlace(shift, chordwise),)))
    return reduced, np.asarray(wings.operators.expansion.T @ upward(full))


def wash_out(wings: WingComparison, exponent: float) -> Loads:
    """Return the lift at 3 g with a washout, which is another distribution of the lift."""
    coefficient = 0.15
    load_factor = 3.0
    lift = wings.design.lift
    distribution = partial(DISTRIBUTIONS[lift.distribution], wings.design.planform)

    def washed_distribution(_: Any, station: FloatArray) -> FloatArray:
        reduction = 1.0 - coefficient * load_factor * station**exponent
        return np.asarray(distribution(station) * reduction)

    # what remains of the lift, by quadrature over the half wing
    points, weights = np.polynomial.legendre.leggauss(400)
    station = 0.5 * (points + 1.0)
    remaining = (weights @ washed_distribution(None, station)) / (weights @ distribution(station))

    restriction = wings.operators.expansion.T
    plain = restriction @ lift_load(wings.mesh)
    with pytest.MonkeyPatch.context() as other:
        other.setitem(DISTRIBUTIONS, lift.distribution, washed_distribution)
        change = restriction @ lift_load(wings.mesh) * remaining - plain
    # what balances the weight is lift of the same distribution
    weight_fraction = float(wings.weight @ wings.upwards) / (lift.force / lift.load_factor)
    balanced = weight_fraction * wings.upwards
    full = load_factor * (wings.operators.load_lift + change * (1.0 + balanced))
    return wings.manoeuvre_load(load_factor, patch.Washout(coefficient, exponent)), full


def relieve_inertia(wings: WingComparison, fraction: float) -> Loads:
    """Return the lift at 2.5 g with inertia relief, which is weight where it lies."""
    relief = fraction * wings.weight * wings.upwards
    full = 2.5 * (wings.operators.load_lift - relief)
    return wings.manoeuvre_load(2.5, patch.InertiaRelief(fraction)), full


FORCE_MOVES = [
    {"shift": -0.09, "chordwise": 0.0},
    {"shift": -0.02, "chordwise": 0.0},
    {"shift": 0.03, "chordwise": 0.0},
    {"shift": 0.0, "chordwise": -0.02},
    {"shift": 0.0, "chordwise": 0.04},
    {"shift": 0.0, "chordwise": 0.0, "chord": 0.03},
    {"shift": 0.0, "chordwise": 0.0, "chord": 0.15},
    {"shift": 0.0, "chordwise": 0.0, "chord": 0.9},
    {"shift": 0.0, "chordwise": -0.02, "chord": 0.6},
    {"shift": 0.0, "chordwise": 0.02, "chord": 0.6},
]


@pytest.mark.parametrize("move", FORCE_MOVES, ids=str)
def test_a_moved_force_is_that_of_the_full_model(wings, move):
    reduced, full = move_force(wings, **move)

    response = wings.patched_structure().static(reduced)

    full_response = wings.factors.solve(full)
    wings.assert_same_response(response, full_response, wings.operators)
    # the place itself yields by what the trailing edge gives way under the force, too
    assert float(reduced @ response) == pytest.approx(float(full @ full_response), rel=3e-3)


@pytest.mark.parametrize("exponent", [0.7, 2.0, 4.0])
def test_a_washout_is_another_distribution_of_the_lift(wings, exponent):
    reduced, full = wash_out(wings, exponent)

    response = wings.patched_structure().static(reduced)

    wings.assert_same_response(response, wings.factors.solve(full), wings.operators)


def test_inertia_relief_is_weight_where_it_lies(wings):
    reduced, full = relieve_inertia(wings, 0.2)

    response = wings.patched_structure().static(reduced)

    wings.assert_same_response(response, wings.factors.solve(full), wings.operators)


# ---------------------------------------------------------------- outputs


@pytest.fixture(scope="module")
def lifted_wing(wings):
    """The reduced solution under the lift of 1 g."""
    return wings.patched_structure().static(wings.manoeuvre_load(1.0))


@pytest.mark.parametrize("degrees", [-15.0, 8.0, 90.0])
def test_a_turned_gauge_follows_from_the_three_components(wings, lifted_wing, degrees):
    angle = np.deg2rad(degrees)
    full = wings.factors.solve(wings.operators.load_lift)

    along, across, shear = wings.arrays.strain_rows @ lifted_wing
    c = np.cos(angle)
    s = np.sin(angle)
    turned = c * c * along + s * s * across + s * c * shear

    full_turned = gauge_output(wings.mesh, angle) @ (wings.operators.expansion @ full)
    largest = np.abs(wings.operators.gauge_output @ full).max()
    assert np.abs(turned - full_turned).max() <= STRAIN_ACCURACY * largest


def test_the_tip_displacement_is_that_of_its_place(wings, lifted_wing):
    elastic_axis = float(wings.arrays.line_chord[0])

    by_name = wings.wing.output_row("tip_displacement")
    by_place = wings.wing.output_row(f"displacement[{wings.wing.span}, {elastic_axis}]")

    assert float(by_name @ lifted_wing) == pytest.approx(float(by_place @ lifted_wing), rel=1e-9)


def test_strains_of_a_gauge_have_names_by_component(wings):
    names = ["strain[24]", "strain[24].transverse", "strain[24].shear"]

    rows = [wings.wing.output_row(name) for name in names]

    last_gauge = [component[23] for component in wings.arrays.strain_rows]
    np.testing.assert_array_equal(rows, last_gauge)


@pytest.mark.parametrize(
    "name",
    [
        "strain[0]",
        "strain[25]",
        "strain[-1]",
        "displacement[1.9, 0.3]",
        "displacement[a, b]",
        "speed",
    ],
)
def test_an_unknown_output_has_no_row(wings, name):
    assert wings.wing.output_row(name) is None


def test_the_tip_load_is_a_force_at_its_place(wings):
    elastic_axis = float(wings.arrays.line_chord[0])

    by_place = wings.wing.force_row((wings.load_place, elastic_axis))

    assert np.abs(by_place - wings.tip_load).max() < 1e-9 * np.abs(by_place).max()


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(("kind", "values", "sentence"), Inputs(__file__).refused("wing"))
def test_an_impossible_patch_is_refused(wings, kind, values, sentence):
    primitive = patch.PRIMITIVES[kind](*values)

    with refused(InvalidPatchError, sentence):
        _ = wings.patched_structure(primitive, temperature=10.0).answers


def test_a_force_at_an_unknown_place_is_refused(wings):
    with refused(InvalidPatchError, "place 'nose' is not known"):
        wings.wing.force_row("nose")
