"""The patched wing against the full model with the same change, each change made in its own way there."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.runtime import patch
from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import LoadPlace, LocalStiffnessLoss, ModelPatch, PointMass, RootCompliance
from fe.runtime.patched_wing import PatchedWing
from fe.wing.operators import (
    AffineOperators,
    assemble,
    gauge_output,
    point_masses,
    section_displacement,
)  # fmt: skip
from fe.wing.patch_operators import area_shares
from fe.wing.turn_load import DISTRIBUTIONS, STANDARD_GRAVITY, lift_load

FloatArray = np.ndarray[Any, np.dtype[np.float64]]

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

    def structure(
        self, *items: Any, state: Any = STATE, masses: Any = MASSES, temperature: float = 0.0
    ) -> Any:
        vector = np.array((state[0], *state[1], *masses, 0.0, 0.0))
        return self.wing.at(vector, ModelPatch(items), temperature)

    def load(self, load_factor: float, *items: Any) -> FloatArray:
        return np.array((load_factor, load_factor**2)) @ self.wing.load_parts(ModelPatch(items))

    def solved(self, load: FloatArray, stiffness: Any = None) -> FloatArray:
        """The full model's solution."""
        matrix = self.operators.stiffness(FACTOR, STATE[1]) if stiffness is None else stiffness
        return Factorisation(matrix).solve(load)

    def alike(self, reduced: FloatArray, full: FloatArray, operators: AffineOperators | None = None) -> None:
        given = operators or self.operators
        strain = given.gauge_output @ full
        assert np.abs(self.arrays.strain_rows[0] @ reduced - strain).max() <= STRAIN * np.abs(strain).max()
        tip = float(given.tip_row @ full)
        assert float(self.arrays.tip_row @ reduced) == pytest.approx(tip, rel=DISPLACEMENT)

    def alike_under_loads(
        self, structure: Any, stiffness: Any, operators: AffineOperators | None = None
    ) -> None:
        """Compare under the lift of 2.5 g and under a force at the tip."""
        given = operators or self.operators
        for reduced, full in ((self.load(2.5), 2.5 * given.load_lift), (self.row, given.load_tip)):
            self.alike(structure.static(reduced), self.solved(full, stiffness), given)

    def section(self, y: float, *webs: tuple[float, float]) -> FloatArray:
        """Unit force upwards at a distance from the root, in shares at chords."""
        full = np.zeros(self.mesh.unknowns)
        full[2::3] = sum(share * section_displacement(self.mesh, y, chord) for chord, share in webs)
        return np.asarray(self.operators.expansion.T @ full)

    def softened(self, operators: AffineOperators, start: float, end: float, loss: float) -> Any:
        """Stiffness with less in the skin between two lines, of the wing in `STATE` or a sound one."""
        mesh, middle = operators.wing_mesh, operators.wing_mesh.centres[:, 1]
        inside = (middle > start) & (middle < end)
        sound = operators is not self.operators
        factors = np.ones(3) if sound else operators.theta(FACTOR, STATE[1])[:3]
        whole = operators.stiffness() if sound else operators.stiffness(FACTOR, STATE[1])
        for region, factor in enumerate(factors):
            cells = np.flatnonzero((mesh.stiffness_term == region) & inside)
            if cells.size:
                whole = whole - loss * factor * operators.body.stiffness(cells)
        return whole.tocsr()

    @property
    def upwards(self) -> FloatArray:
        """Free unknowns of which the vertical ones are one."""
        root = np.flatnonzero(np.abs(self.mesh.points[:, 1]) < 1e-9)
        component = np.tile([0.0, 0.0, 1.0], len(self.mesh.points))
        kept = np.delete(component, (3 * root[:, None] + np.arange(3)).ravel())
        return np.concatenate((kept, [1.0, 0.0, 0.0]))

    @property
    def weight(self) -> FloatArray:
        """Weight along the free unknowns [N]."""
        masses = self.design.masses
        return STANDARD_GRAVITY * (
            self.operators.mass(point_masses(masses.servo, masses.pitot)) @ self.upwards
        )


def frequencies(stiffness: Any, mass: Any) -> FloatArray:
    """Lowest three frequencies [Hz] of the full model."""
    return np.asarray(np.sqrt(lowest_eigenpairs(stiffness, mass, 3)[0]) / (2.0 * np.pi))


@pytest.fixture(scope="module")
def both(coarse_patched_wing: PatchedWing, coarse_operators: AffineOperators) -> Compared:
    return Compared(coarse_patched_wing, coarse_operators)


# ---------------------------------------------------------------- structure


@pytest.mark.parametrize(
    ("e", "loss", "factor", "force"), [(*SOUND, 3.0, 0.0), (0.95, (0.6, 0.3), 2.0, 10.0)]
)
def test_without_a_patch_it_is_the_reduced_model_within_its_error_bound(
    both, model, e, loss, factor, force
) -> None:
    response = model.static_response(
        young_modulus_factor=e, stiffness_loss=loss, load_factor=factor, tip_force=force
    )
    structure = both.structure(state=(e, loss))
    u = structure.static(both.load(factor) + force * both.row)
    strain = both.arrays.strain_rows[0] @ u
    scale = np.abs(response.strain).max()
    assert np.abs(strain - response.strain).max() <= response.strain_error_bound + 3e-4 * scale
    assert float(both.arrays.tip_row @ u) == pytest.approx(response.displacement[0], rel=5e-4)
    masses = dict(zip(("servo_mass", "pitot_mass"), MASSES, strict=True))
    modes = model.modes({"young_modulus_factor": e, **masses}, loss)
    assert structure.lowest(3).frequency == pytest.approx(modes.frequency[:3], rel=FREQUENCY)


@pytest.mark.parametrize("share", [0.02, 0.3])
def test_root_compliance_is_a_softer_root_spring(both: Compared, share: float) -> None:
    compliance = share * both.arrays.largest_compliance / 0.4
    softer = 1.0 / (1.0 / both.design.root.flap_spring + compliance)
    operators = assemble(both.design.changed(root={"flap_spring": softer}))
    structure, stiffness = both.structure(RootCompliance(compliance)), operators.stiffness(FACTOR, STATE[1])
    both.alike_under_loads(structure, stiffness, operators)
    wanted = frequencies(stiffness, operators.mass(point_masses(*MASSES)))
    assert structure.lowest(3).frequency == pytest.approx(wanted, rel=FREQUENCY)


@pytest.mark.parametrize(("first", "last", "loss"), [(5, 6, 0.5), (2, 5, 0.3), (7, 10, 0.6)])
def test_local_loss_between_mesh_lines_is_softer_cells(
    both: Compared, first: int, last: int, loss: float
) -> None:
    start, end = both.arrays.strip_lines[[first, last]]
    stiffness = both.softened(both.operators, start, end, loss)
    structure = both.structure(LocalStiffnessLoss(loss, start, end - start))
    both.alike_under_loads(structure, stiffness)
    wanted = frequencies(stiffness, both.operators.mass(point_masses(*MASSES)))
    frequency = structure.lowest(3).frequency
    assert frequency[[0, 2]] == pytest.approx(wanted[[0, 2]], rel=FREQUENCY)  # flapwise
    assert frequency[1] == pytest.approx(wanted[1], rel=1e-3)


@pytest.fixture(scope="module")
def finer(both: Compared) -> AffineOperators:
    """The same wing in cells of 20 mm along the span."""
    return assemble(both.design.changed(mesh={"span_size": 0.005}))


@pytest.mark.parametrize(
    ("start", "end", "loss"),
    [
        pytest.param(0.2, 0.45, 0.4, marks=pytest.mark.long),
        pytest.param(0.75, 1.15, 0.3, marks=pytest.mark.long),
        (0.5, 0.6, 0.5),
    ],
)
def test_a_box_that_parts_strips_against_a_mesh_with_lines_there(both, finer, start, end, loss) -> None:
    lines = finer.wing_mesh.span_lines
    start, end = (float(lines[np.abs(lines - place).argmin()]) for place in (start, end))
    matrices = finer.stiffness(), both.softened(finer, start, end, loss)
    before, after = (both.solved(finer.load_lift, matrix) for matrix in matrices)
    # ratios, because the two meshes differ a little in themselves
    strain = finer.gauge_output @ before
    wanted = finer.gauge_output @ after / strain
    item = LocalStiffnessLoss(loss, start, end - start)
    plain, u = (both.structure(*items, state=SOUND).static(both.load(1.0)) for items in ((), (item,)))
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


def test_strips_make_the_skin_and_losses_that_overlap_multiply(both: Compared) -> None:
    everywhere = both.structure(LocalStiffnessLoss(0.25, 0.0, both.wing.span), state=SOUND).stiffness
    skin = np.tensordot((0.75, 0.75, 0.75, 1.0), both.arrays.stiffness, 1)
    assert np.abs(everywhere - skin).max() < 1e-6 * np.abs(skin).max()
    start, end = both.arrays.strip_lines[[4, 6]]
    once, as_one = (LocalStiffnessLoss(loss, start, end - start) for loss in (0.3, 0.51))
    assert np.abs(both.structure(once, once).stiffness - both.structure(as_one).stiffness).max() < 1e-12
    # strains need no factor where a box ends at strips
    start, end = both.arrays.strip_lines[[3, 6]]
    factors = both.wing.strain_factors(ModelPatch((LocalStiffnessLoss(0.4, start, end - start),)))
    assert factors == pytest.approx(1.0, abs=1e-12)
    nothing = ModelPatch((PointMass(0.1, 1.0), LocalStiffnessLoss(0.0, 0.1, 0.2)))
    assert both.wing.strain_factors(nothing) is None


@pytest.mark.parametrize(("station", "added"), [(0.75, 0.05), (0.4, 0.2)])
def test_point_mass_is_a_pitot_tube_that_was_moved(both: Compared, station: float, added: float) -> None:
    places = [place.model_dump() for place in both.design.point_masses if place.kind == "servo"]
    moved = {"kind": "pitot", "station": station, "chord": both.design.tip_load.chord}
    operators = assemble(both.design.changed(point_masses=[*places, moved]))
    mass = operators.mass(point_masses(MASSES[0], added))
    wanted = frequencies(operators.stiffness(FACTOR, STATE[1]), mass)
    structure = both.structure(PointMass(added, station * both.wing.span), masses=(MASSES[0], 0.0))
    assert structure.lowest(3).frequency == pytest.approx(wanted, rel=FREQUENCY)


def test_temperature_is_a_change_of_the_modulus_factor(both: Compared) -> None:
    warm, cold = (both.structure(patch.ModulusTemperature(2e-3), temperature=t) for t in (25.0, 0.0))
    stiffness = both.operators.stiffness({"young_modulus_factor": STATE[0] * 0.95}, STATE[1])
    both.alike(warm.static(both.load(1.0)), both.solved(both.operators.load_lift, stiffness))
    assert np.array_equal(cold.stiffness, both.structure().stiffness)


# ---------------------------------------------------------------- loads


@pytest.mark.parametrize("shift", [-0.09, -0.02, 0.03])
def test_load_place_along_the_span(both: Compared, shift: float) -> None:
    row = both.wing.force_row("tip_load", ModelPatch((LoadPlace(shift, 0.0),)))
    full = both.section(both.place + shift, (both.design.tip_load.chord, 1.0))
    both.alike(both.structure().static(row), both.solved(full))


def test_load_place_along_the_chord_follows_the_lever(both: Compared) -> None:
    plan, aft, (elastic, other) = both.design.planform, 0.04, (0.3, 0.6)
    assert {elastic, other} < set(both.arrays.line_chord.tolist())
    share = aft / ((other - elastic) * plan.chord(both.place / plan.semi_span))
    full = both.section(both.place, (elastic, 1.0 - share), (other, share))
    u = both.structure().static(both.wing.force_row("tip_load", ModelPatch((LoadPlace(0.0, aft),))))
    both.alike(u, both.solved(full))
    # the work of the force is the same on both ways, and the section twists tail up
    assert both.wing.displacement_row(1.8, 0.9) @ u > both.wing.displacement_row(1.8, 0.3) @ u


@pytest.mark.parametrize(("chord", "share"), [(0.03, 0.0), (0.15, 12.0 / 27.0), (0.9, 1.0 - 1.0 / 31.0)])
def test_a_force_before_or_behind_goes_to_the_webs_beside_it(
    both: Compared, chord: float, share: float
) -> None:
    webs = (0.03, 0.3) if chord < 0.3 else (0.6, 0.91)
    full = both.section(both.place, (webs[0], 1.0 - share), (webs[1], share))
    solution, row = both.solved(full), both.wing.force_row((both.place, chord))
    u = both.structure().static(row)
    both.alike(u, solution)
    # the place itself yields by what the trailing edge gives way under the force, too
    assert float(row @ u) == pytest.approx(float(full @ solution), rel=3e-3)


@pytest.mark.parametrize("place", ["tip_load", (1.778, 0.6), (1.778, 0.9)])
def test_a_displaced_force_has_no_kink_at_a_web(both: Compared, place: Any) -> None:
    before, there, behind = (
        both.wing.force_row(place, ModelPatch((LoadPlace(0.0, aft),))) for aft in (-0.02, 0.0, 0.02)
    )
    assert np.abs(before + behind - 2.0 * there).max() < 1e-9 * np.abs(behind - there).max()


@pytest.mark.parametrize("exponent", [0.7, 2.0, 4.0])
def test_washout_is_another_lift_distribution(both: Compared, exponent: float, monkeypatch) -> None:
    coefficient, factor, lift = 0.15, 3.0, both.design.lift
    course = DISTRIBUTIONS[lift.distribution](both.design.planform)
    points, weights = np.polynomial.legendre.leggauss(400)
    eta = 0.5 * (points + 1.0)
    kept = weights * course(eta) @ (1.0 - coefficient * factor * eta**exponent) / (weights @ course(eta))

    def washed(planform: Any) -> Any:
        return lambda station: course(station) * (1.0 - coefficient * factor * station**exponent)

    restriction = both.operators.expansion.T
    plain = restriction @ lift_load(both.mesh)
    monkeypatch.setitem(DISTRIBUTIONS, lift.distribution, washed)
    change = restriction @ lift_load(both.mesh) * kept - plain
    # what balances the weight is lift of the same course
    balanced = float(both.weight @ both.upwards) / (lift.force / lift.load_factor) * both.upwards
    wanted = both.solved(factor * (both.operators.load_lift + change * (1.0 + balanced)))
    both.alike(both.structure().static(both.load(factor, patch.Washout(coefficient, exponent))), wanted)


def test_inertia_relief_is_weight_where_it_lies(both: Compared) -> None:
    fraction, factor = 0.2, 2.5
    full = both.solved(factor * (both.operators.load_lift - fraction * both.weight * both.upwards))
    both.alike(both.structure().static(both.load(factor, patch.InertiaRelief(fraction))), full)


# ---------------------------------------------------------------- outputs


@pytest.mark.parametrize("degrees", [-15.0, 8.0, 90.0])
def test_a_turned_gauge_follows_from_the_three_components(both: Compared, degrees: float) -> None:
    angle, full = np.deg2rad(degrees), both.solved(both.operators.load_lift)
    wanted = gauge_output(both.mesh, angle) @ (both.operators.expansion @ full)
    along, across, shear = both.arrays.strain_rows @ both.structure().static(both.load(1.0))
    c, s = np.cos(angle), np.sin(angle)
    scale = np.abs(both.operators.gauge_output @ full).max()
    assert np.abs(c * c * along + s * s * across + s * c * shear - wanted).max() <= STRAIN * scale


def test_outputs_and_places_by_name(both: Compared) -> None:
    wing, elastic = both.wing, float(both.arrays.line_chord[0])
    u = both.structure().static(both.load(1.0))
    tip, there = wing.output_row("tip_displacement"), wing.output_row(f"displacement[{wing.span}, {elastic}]")
    assert float(tip @ u) == pytest.approx(float(there @ u), rel=1e-9)
    for component, part in enumerate(("", ".transverse", ".shear")):
        assert np.array_equal(wing.output_row(f"strain[24]{part}"), both.arrays.strain_rows[component, 23])
    for name in (
        "strain[0]",
        "strain[25]",
        "strain[-1]",
        "displacement[1.9, 0.3]",
        "displacement[a, b]",
        "speed",
    ):
        assert wing.output_row(name) is None
    by_place = wing.force_row((both.place, elastic))
    assert np.abs(by_place - both.row).max() < 1e-9 * np.abs(by_place).max()


# ---------------------------------------------------------------- no change, softer, impossible


@settings(max_examples=25, deadline=None)
@given(
    loss=st.floats(0.0, 0.9),
    start=st.floats(-0.2, 1.8),
    length=st.floats(0.0, 1.0),
    compliance=st.floats(0.0, 2e-4),
)
def test_softer_is_softer(
    both: Compared, loss: float, start: float, length: float, compliance: float
) -> None:
    softer = LocalStiffnessLoss(loss, start, length), RootCompliance(compliance)
    stiff, soft = (float(both.row @ both.structure(*items).static(both.row)) for items in ((), softer))
    assert soft >= stiff * (1.0 - 1e-9)
    # the full solutions of which the basis is made are good to some 1e-6
    assert soft >= stiff + (1.0 - 1e-5) * compliance * both.place**2 - 1e-9 * stiff


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (LocalStiffnessLoss(1.0, 0.2, 0.5), "must leave some stiffness"),
        (RootCompliance(-1.0), "cannot be reduced"),
        (patch.ModulusTemperature(0.2), "must be positive"),
        (PointMass(0.1, 3.0), "must lie on the wing"),
        (PointMass(0.1, -0.1), "must lie on the wing"),
        (lambda both: both.wing.force_row("nose"), "place 'nose' is not known"),
        (lambda both: both.load(1.0, patch.Washout(0.1, -1.0)), "must not be negative"),
    ],
)
def test_what_cannot_be_is_refused(both: Compared, ask: Any, message: str) -> None:
    with pytest.raises(InvalidPatchError, match=message):
        _ = ask(both) if callable(ask) else both.structure(ask, temperature=10.0).mass


def test_shares_of_the_area_integrate_a_parabola_on_each_cell() -> None:
    stations = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    # mean of y^2 with chord 2 - y: (2/3 - 1/4) / 1.5
    mean = area_shares(stations, 2.0, 1.0) @ stations**2
    assert mean == pytest.approx((2.0 / 3.0 - 0.25) / 1.5, rel=1e-12)
