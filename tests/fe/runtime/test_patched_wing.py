"""The patched wing, and structures in motion, against full models that are changed in their own way."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.runtime import patch
from fe.runtime.arrays import POSITION, FloatArray
from fe.runtime.errors import InvalidPatchError, InvalidStateError, OutsideModelError
from fe.runtime.patch import LoadPlace, LocalStiffnessLoss, ModelPatch, PointMass, RootCompliance
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.patched_wing import PatchedStructure, PatchedWing
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import STANDARD_GRAVITY, TIP_FORCE
from fe.runtime.transient import ModalIntegrator
from fe.wing.gauges import gauge_output
from fe.wing.operators import (
    AffineOperators,
    assemble,
    lift_load,
    point_masses,
    section_displacement,
    upward,
)  # fmt: skip
from fe.wing.parts import DISTRIBUTIONS
from tests.fe.runtime.stepping import second_order
from tests.refusals import Inputs, refused
from tests.wings import rigid, wing_integrator

HOLDING = PatchedStructure.holding_load
STATE, MASSES = (1.0073, (0.2, 0.1)), (0.1688, 0.1344)
SOUND = (1.0, (0.0, 0.0))
FACTOR = {"young_modulus_factor": STATE[0]}
STRAIN, DISPLACEMENT, FREQUENCY = 1e-3, 1e-3, 1e-4
"""Accuracy wanted, relative to the largest strain, the largest displacement, and of the first frequencies."""


class Compared:
    """The patched wing, and its full model to compare with."""

    def __init__(self, wing: PatchedWing, operators: AffineOperators) -> None:
        self.wing, self.operators, self.arrays = wing, operators, wing.arrays
        self.mesh, self.design = operators.wing_mesh, operators.wing_mesh.design
        self.place, self.row = wing.arrays.load_place, wing.force_row("tip_load")
        self.factors = Factorisation(operators.stiffness(FACTOR, STATE[1]))
        masses = self.design.masses
        mass, self.upwards = (
            operators.mass(point_masses(masses.servo, masses.pitot)),
            rigid(operators),
        )
        self.weight = STANDARD_GRAVITY * (mass @ self.upwards)  # along the free unknowns [N]

    def structure(
        self, *items: Any, state: Any = STATE, masses: Any = MASSES, temperature: float = 0.0
    ) -> Any:
        vector = np.array((state[0], *state[1], *masses, 0.0, 0.0))
        return self.wing.structure_at(vector, ModelPatch(items), temperature)

    def load(self, load_factor: float, *items: Any) -> FloatArray:
        return np.array((load_factor, load_factor**2)) @ self.wing.manoeuvre_loads(
            ModelPatch(items)
        )

    def alike(self, reduced: FloatArray, full: FloatArray, operators: AffineOperators) -> None:
        strain, tip = operators.gauge_output @ full, float(operators.tip_row @ full)
        assert (
            np.abs(self.arrays.strain_rows[0] @ reduced - strain).max()
            <= STRAIN * np.abs(strain).max()
        )
        assert float(self.arrays.tip_row @ reduced) == pytest.approx(tip, rel=DISPLACEMENT)

    def softened(self, operators: AffineOperators, start: float, end: float, loss: float) -> Any:
        """Stiffness with less in the skin between two lines, of the wing in `STATE` or a sound one."""
        mesh, middle = operators.wing_mesh, operators.wing_mesh.centres[:, 1]
        inside = (middle > start) & (middle < end)
        state = (FACTOR, STATE[1]) if operators is self.operators else (None, ())
        whole = operators.stiffness(*state)
        for region, factor in enumerate(operators.theta(*state)[:3]):
            cells = np.flatnonzero((mesh.stiffness_term == region) & inside)
            if cells.size:
                whole = whole - loss * factor * operators.body.stiffness(cells)
        return whole.tocsr()


@pytest.fixture(scope="module")
def both(coarse_patch_arrays: PatchArrays, coarse_operators: AffineOperators) -> Compared:
    return Compared(PatchedWing(coarse_patch_arrays), coarse_operators)


# ---------------------------------------------------------------- structure


def sprung(both: Compared, share: float) -> Any:
    """A compliance of the root is a softer spring."""
    compliance = share * both.arrays.largest_compliance / 0.4
    softer = 1.0 / (1.0 / both.design.root.flap_spring + compliance)
    other = assemble(both.design.changed(root={"flap_spring": softer}))
    return both.structure(RootCompliance(compliance)), other, None, MASSES


def softer(both: Compared, first: int, last: int, loss: float) -> Any:
    """A local loss between mesh lines is softer cells."""
    start, end = both.arrays.strip_lines[[first, last]]
    stiffness = both.softened(both.operators, start, end, loss)
    return (
        both.structure(LocalStiffnessLoss(loss, start, end - start)),
        both.operators,
        stiffness,
        MASSES,
    )


def moved(both: Compared, station: float, added: float) -> Any:
    """A point mass is a pitot tube that was moved."""
    places = [place.model_dump() for place in both.design.point_masses if place.kind == "servo"]
    pitot = {"kind": "pitot", "station": station, "chord": both.design.tip_load.chord}
    other = assemble(both.design.changed(point_masses=[*places, pitot]))
    structure = both.structure(PointMass(added, station * both.wing.span), masses=(MASSES[0], 0.0))
    return structure, other, None, (MASSES[0], added)


def warm(both: Compared, coefficient: float, e: float = STATE[0], loss: Any = STATE[1]) -> Any:
    """A temperature is a change of the modulus factor; without a coefficient nothing is changed."""
    stiffness = both.operators.stiffness(
        {"young_modulus_factor": e * (1.0 - 25.0 * coefficient)}, loss
    )
    structure = both.structure(
        patch.ModulusTemperature(coefficient), state=(e, loss), temperature=25.0
    )
    return structure, both.operators, stiffness, MASSES


@pytest.mark.parametrize(
    ("change", "given"),
    [
        (sprung, (0.3,)),
        *((softer, given) for given in ((5, 6, 0.5), (7, 10, 0.6))),
        *((moved, given) for given in ((0.75, 0.05), (0.4, 0.2))),
        *((warm, given) for given in ((2e-3,), (0.0, 0.95, (0.6, 0.3)))),
    ],
)
def test_a_change_of_the_structure_is_that_of_the_full_model(both, change, given):
    """Under the lift of 2.5 g and under a force at the tip, and in the first three modes."""
    structure, operators, stiffness, masses = change(both, *given)
    stiffness = operators.stiffness(FACTOR, STATE[1]) if stiffness is None else stiffness
    loads = np.column_stack((2.5 * both.operators.load_lift, operators.load_tip))
    for reduced, full in zip(
        (both.load(2.5), both.row), Factorisation(stiffness).solve(loads).T, strict=True
    ):
        both.alike(structure.static(reduced), full, operators)
    squares = lowest_eigenpairs(stiffness, operators.mass(point_masses(*masses)), 3)[0]
    found, wanted = structure.lowest_modes(3).frequency, np.sqrt(squares) / (2.0 * np.pi)
    assert found[[0, 2]] == pytest.approx(wanted[[0, 2]], rel=FREQUENCY)  # flapwise
    assert found[1] == pytest.approx(wanted[1], rel=1e-3 if change is softer else FREQUENCY)


def test_a_box_that_parts_strips_against_a_mesh_with_lines_there(both):
    """On the same wing in cells of 40 mm along the span."""
    finer, start, end, loss = (
        assemble(both.design.changed(mesh={"span_size": 0.01})),
        0.2,
        0.45,
        0.4,
    )
    lines = finer.wing_mesh.span_lines
    start, end = (float(lines[np.abs(lines - place).argmin()]) for place in (start, end))
    matrices = finer.stiffness(), both.softened(finer, start, end, loss)
    before, after = (Factorisation(matrix).solve(finer.load_lift) for matrix in matrices)
    # ratios, because the two meshes differ a little in themselves
    strain = finer.gauge_output @ before
    wanted = finer.gauge_output @ after / strain
    item = LocalStiffnessLoss(loss, start, end - start)
    plain, u = (
        both.structure(*items, state=SOUND).static(both.load(1.0)) for items in ((), (item,))
    )
    rows = both.arrays.strain_rows[0]
    ratio = both.wing.strain_factors(ModelPatch((item,))) * (rows @ u) / (rows @ plain)
    scale = np.abs(strain) / np.abs(strain).max()
    assert np.abs((ratio - wanted) * scale).max() < 0.03 * np.abs((wanted - 1.0) * scale).max()
    # the strips of this mesh are 0.26 m long, four times those of the shipped one
    effect, found = (
        float(row @ new) / float(row @ old)
        for row, old, new in ((finer.tip_row, before, after), (both.arrays.tip_row, plain, u))
    )
    assert found - 1.0 == pytest.approx(effect - 1.0, rel=0.05)


def test_strips_make_the_skin_and_losses_that_overlap_multiply(both):
    everywhere = both.structure(
        LocalStiffnessLoss(0.25, 0.0, both.wing.span), state=SOUND
    ).stiffness
    skin = np.tensordot((0.75, 0.75, 0.75, 1.0), both.arrays.stiffness, 1)
    assert np.abs(everywhere - skin).max() < 1e-6 * np.abs(skin).max()
    start, end = both.arrays.strip_lines[[4, 6]]
    once, as_one = (LocalStiffnessLoss(loss, start, end - start) for loss in (0.3, 0.51))
    assert (
        np.abs(both.structure(once, once).stiffness - both.structure(as_one).stiffness).max()
        < 1e-12
    )
    beyond, within = (LocalStiffnessLoss(0.3, start, end - start) for start in (-0.2, 0.0))
    assert np.array_equal(both.structure(beyond).stiffness, both.structure(within).stiffness)
    # strains need no factor where a box ends at strips
    assert both.wing.strain_factors(ModelPatch((once,))) == pytest.approx(1.0, abs=1e-12)
    nothing = ModelPatch((PointMass(0.1, 1.0), LocalStiffnessLoss(0.0, 0.1, 0.2)))
    assert both.wing.strain_factors(nothing) is None


# ---------------------------------------------------------------- loads


def placed(
    both: Compared, shift: float, way: float, chord: float | None = None
) -> tuple[FloatArray, FloatArray]:
    """A force follows the lever of the two webs beside its place, without a kink where it crosses one."""
    lines, at = (0.03, 0.3, 0.6, 0.91), both.design.tip_load.chord if chord is None else chord
    behind, y = int(np.searchsorted(lines, at, side="right")), both.place + shift
    fraction = at + way / both.design.planform.chord(y / both.design.planform.semi_span)
    first, last = lines[behind - 1 : behind + 1]
    share = (fraction - first) / (last - first)
    shares = ((first, 1.0 - share), (last, share))
    full = sum(part * section_displacement(both.mesh, y, web) for web, part in shares)
    place = "tip_load" if chord is None else (both.place, chord)
    row = both.wing.force_row(place, ModelPatch((LoadPlace(shift, way),)))
    return row, np.asarray(both.operators.expansion.T @ upward(full))


def washed(both: Compared, exponent: float) -> tuple[FloatArray, FloatArray]:
    """A washout is another distribution of the lift."""
    coefficient, factor, lift = 0.15, 3.0, both.design.lift
    course = partial(DISTRIBUTIONS[lift.distribution], both.design.planform)
    points, weights = np.polynomial.legendre.leggauss(400)
    eta = 0.5 * (points + 1.0)
    kept = (
        weights
        * course(eta)
        @ (1.0 - coefficient * factor * eta**exponent)
        / (weights @ course(eta))
    )

    def less(planform: Any, station: Any) -> Any:
        return course(station) * (1.0 - coefficient * factor * station**exponent)

    restriction = both.operators.expansion.T
    with pytest.MonkeyPatch.context() as other:
        plain = restriction @ lift_load(both.mesh)
        other.setitem(DISTRIBUTIONS, lift.distribution, less)
        change = restriction @ lift_load(both.mesh) * kept - plain
    # what balances the weight is lift of the same course
    balanced = float(both.weight @ both.upwards) / (lift.force / lift.load_factor) * both.upwards
    full = factor * (both.operators.load_lift + change * (1.0 + balanced))
    return both.load(factor, patch.Washout(coefficient, exponent)), full


def relieved(both: Compared, fraction: float) -> tuple[FloatArray, FloatArray]:
    """Inertia relief is weight where it lies."""
    full = 2.5 * (both.operators.load_lift - fraction * both.weight * both.upwards)
    return both.load(2.5, patch.InertiaRelief(fraction)), full


@pytest.mark.parametrize(
    ("change", "given"),
    [
        *((placed, (shift, 0.0)) for shift in (-0.09, -0.02, 0.03)),
        *((placed, (0.0, way)) for way in (-0.02, 0.04)),
        *((placed, (0.0, 0.0, chord)) for chord in (0.03, 0.15, 0.9)),
        *((placed, (0.0, way, 0.6)) for way in (-0.02, 0.02)),
        *((washed, (exponent,)) for exponent in (0.7, 2.0, 4.0)),
        (relieved, (0.2,)),
    ],
)
def test_a_change_of_the_loads_is_that_of_the_full_model(both, change, given):
    reduced, full = change(both, *given)
    u, solution = both.structure().static(reduced), both.factors.solve(full)
    both.alike(u, solution, both.operators)
    if (
        change is placed
    ):  # the place itself yields by what the trailing edge gives way under the force, too
        assert float(reduced @ u) == pytest.approx(float(full @ solution), rel=3e-3)


# ---------------------------------------------------------------- outputs


@pytest.mark.parametrize("degrees", [-15.0, 8.0, 90.0])
def test_a_turned_gauge_follows_from_the_three_components(both, degrees):
    angle, full = np.deg2rad(degrees), both.factors.solve(both.operators.load_lift)
    wanted = gauge_output(both.mesh, angle) @ (both.operators.expansion @ full)
    along, across, shear = both.arrays.strain_rows @ both.structure().static(both.load(1.0))
    c, s = np.cos(angle), np.sin(angle)
    scale = np.abs(both.operators.gauge_output @ full).max()
    assert np.abs(c * c * along + s * s * across + s * c * shear - wanted).max() <= STRAIN * scale


def test_outputs_and_places_by_name(both):
    wing, elastic = both.wing, float(both.arrays.line_chord[0])
    u = both.structure().static(both.load(1.0))
    tip, there = (
        wing.output_row("tip_displacement"),
        wing.output_row(f"displacement[{wing.span}, {elastic}]"),
    )
    assert float(tip @ u) == pytest.approx(float(there @ u), rel=1e-9)
    components = [wing.output_row(f"strain[24]{part}") for part in ("", ".transverse", ".shear")]
    np.testing.assert_array_equal(components, both.arrays.strain_rows[:, 23])
    unknown = (
        "strain[0] | strain[25] | strain[-1] | displacement[1.9, 0.3] | displacement[a, b] | speed"
    )
    assert [wing.output_row(name) for name in unknown.split(" | ")] == [None] * 6
    by_place = wing.force_row((both.place, elastic))
    assert np.abs(by_place - both.row).max() < 1e-9 * np.abs(by_place).max()


# ---------------------------------------------------------------- what cannot be


@pytest.mark.parametrize(("kind", "values", "sentence"), Inputs(__file__).refused("wing"))
def test_what_cannot_be_is_refused(both, kind, values, sentence):
    item = patch.PRIMITIVES[kind](*values)
    with refused(InvalidPatchError, sentence):
        _ = both.structure(item, temperature=10.0).answers
    with refused(InvalidPatchError, "place 'nose' is not known"):
        both.wing.force_row("nose")


# ---------------------------------------------------------------- in motion, patched or not, and of a beam

ALPHA, BETA = 1.0735, 7.3124e-4  # Kapteyn et al. 2021, fitted to the ring-down of the real wing
HEALTHY = {"servo_mass": 0.169, "pitot_mass": 0.134, "damping_alpha": ALPHA, "damping_beta": BETA}


@pytest.fixture(scope="module")
def integrator(model: ReducedModel) -> ModalIntegrator:
    return wing_integrator(model, **HEALTHY)


@pytest.mark.parametrize("kind", ["wing", "beam"])
def test_rest_is_the_static_response_and_stays(kind, model, beam_reduction, integrator):
    values, motion = {"load_factor": 3.0, "tip_force": 5.0}, integrator
    if kind == "beam":
        model, values = (
            beam_reduction.model,
            {"z1": 0.3, "pump": 0.07, "load_factor": 3.0, "push": 50.0},
        )
        motion = ModalIntegrator(model.structure_at(model.vector(values)), 5.0, 2e-5)
    load, static = model.load_coefficients(model.vector(values)), model.static_response(values)
    state, wanted = motion.state_at_rest(load), np.append(static.strain, static.displacement)
    for _ in range(5):
        np.testing.assert_allclose(motion.outputs(state)[: len(wanted)], wanted, rtol=1e-9)
        assert motion.modes.output[-1] @ state.velocity == pytest.approx(0.0, abs=1e-9)
        state = motion.advance(state, 0.7, load)


def test_a_released_beam_moves_as_the_full_model(beam, beam_reduction):
    """Once the high modes have died away, strain, position and acceleration agree."""
    model, values = (
        beam_reduction.model,
        {"e": 1.05, "z1": 0.6, "z2": 0.3, "pump": 0.07, "load_factor": 0.0},
    )
    vector, let_go = (model.vector({**values, "push": push}) for push in (100.0, 0.0))
    motion = ModalIntegrator(model.structure_at(vector), *model.damping)
    state = motion.state_at_rest(model.load_coefficients(vector))
    for _ in range(3):
        state = motion.advance(state, 2e-3, model.load_coefficients(let_go))
    stiffness, mass, load = beam.system_at({**values, "push": 100.0})
    stiffness, inverse, n = stiffness.toarray(), np.linalg.inv(mass.toarray()), len(load)
    start = np.linalg.solve(stiffness, load)
    damping = model.damping[0] * np.eye(n) + model.damping[1] * inverse @ stiffness
    generator = second_order(inverse @ stiffness, damping)
    moved = expm(generator * 6e-3) @ np.concatenate((start, np.zeros(n)))
    rows = np.vstack((beam.gauge_output.toarray(), beam.displacement_output.toarray()))
    acceleration = beam.acceleration_output @ (generator @ moved)[n:]
    wanted = np.concatenate((rows @ moved[:n], acceleration))
    size = np.concatenate((np.abs(rows @ start), np.abs(acceleration)))
    assert np.all(np.abs(motion.outputs(state) - wanted) < 5e-3 * size)
    same = ModalIntegrator(model.structure_at(vector), *model.damping)
    taken = motion.outputs(same.take_over(state, motion))
    np.testing.assert_allclose(
        taken, motion.outputs(state), rtol=1e-6, atol=1e-9 * float(size.max())
    )


def test_a_released_wing_for_patches_moves_as_all_its_unknowns(both):
    """What its modes leave out fades as the damping has it, for a law as well."""
    vector = np.array((1.0, 0.0, 0.0, 0.169, 0.134, 1.0, 0.0))
    weak = patch.PowerStiffness("tip", 1e-6, 1.0, 0, 1.0)  # which only tells where the tip is
    motion = ModalIntegrator(both.wing.structure_at(vector, ModelPatch((weak,))), ALPHA, BETA)
    structure, load = motion.structure, motion.structure.load_coefficients(vector)
    answers, tip = structure.unit_responses, both.wing.port_rows["tip"]
    held = 0.03 / (structure.output_rows[-1] @ answers[:, HOLDING]) * answers[:, HOLDING]
    rest, n = answers[:, :4] @ load, len(held)
    state = motion.advance(motion.state_after_release(0.03, load, HOLDING), 5e-4, load)
    ratio = np.linalg.solve(structure.mass, structure.stiffness)
    generator = second_order(ratio, ALPHA * np.eye(n) + BETA * ratio)
    wanted = rest + (expm(5e-4 * generator) @ np.concatenate((held, np.zeros(n))))[:n]
    assert state.memory[0, POSITION] == pytest.approx(tip @ wanted, rel=1e-4)
    assert motion.point_displacement(state, HOLDING) == pytest.approx(tip @ wanted, rel=1e-4)
    error = np.abs(motion.outputs(state) - structure.output_rows @ wanted)
    assert np.all(error < 5e-3 * np.abs(structure.output_rows @ held))


def test_damage_in_flight_keeps_motion_and_changes_strain(model, integrator):
    damaged = wing_integrator(model, **{**HEALTHY, "stiffness_loss": (0.4, 0.2)})
    for duration in (0.003, 0.05, 0.11):
        before = integrator.advance(
            integrator.state_after_release(0.03, (3.0, 0.0), TIP_FORCE), duration, (3.0, 0.0)
        )
        after = damaged.take_over(before, integrator)
        assert damaged.outputs(after)[-1] == pytest.approx(
            integrator.outputs(before)[-1], abs=2e-3 * 0.1
        )
        kept = damaged.modes.shape.T @ damaged.modes.mass @ integrator.modes.shape @ before.velocity
        np.testing.assert_allclose(after.velocity, kept, atol=1e-9 * np.abs(kept).max())
        was = integrator.modes.output[-1] @ before.velocity
        assert damaged.modes.output[-1] @ after.velocity == pytest.approx(was, abs=2e-2 * 1.0)
    # long after, it rests where the damaged wing rests
    late = damaged.advance(after, 60.0, (3.0, 0.0))
    static = model.static_response({"z1": 0.4, "z2": 0.2, "load_factor": 3.0})
    np.testing.assert_allclose(damaged.outputs(late)[:-1], static.strain, rtol=1e-6)
    # 5 cm inboard of the tip, which is released at 3 cm, the load point moves less and in time with it
    released = integrator.state_after_release(0.03, (0.0, 0.0), TIP_FORCE)
    assert 0.9 * 0.03 < integrator.point_displacement(released, TIP_FORCE) < 0.03
    # from rest, damage sets the wing moving about its new, lower-stiffness equilibrium
    taken = damaged.take_over(integrator.state_at_rest((3.0, 0.0)), integrator)
    kept = (
        damaged.structure.modal_projection @ integrator.structure.unit_responses[:, :2] @ (3.0, 0.0)
    )
    np.testing.assert_allclose(taken.displacement, kept, atol=1e-9 * np.abs(kept).max())


def test_bad_input_is_refused(model, integrator):
    for duration, load in ((0.0, 1.0), (-1.0, 1.0), (np.nan, 1.0), (np.inf, 1.0), (0.1, np.nan)):
        with pytest.raises(InvalidStateError, match="needs a positive duration and a finite load"):
            integrator.advance(integrator.state_at_rest((1.0, 0.0)), duration, (load, 0.0))
    for name, value, kind in (
        ("damping_alpha", -1.0, InvalidStateError),
        ("damping_beta", np.nan, InvalidStateError),
        ("servo_mass", 5.0, OutsideModelError),
    ):
        with pytest.raises(kind, match=name):
            wing_integrator(model, **{**HEALTHY, name: value})
