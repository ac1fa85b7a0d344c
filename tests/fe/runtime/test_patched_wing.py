"""The patched wing against the full model with the same change, each change made in its own way there."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.linalg import LinearOperator, eigsh

from fe.full.statics import Factorisation
from fe.reduction.reduced_basis import Reduction
from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import (
    InertiaRelief,
    LoadPlace,
    LocalStiffnessLoss,
    ModelPatch,
    ModulusTemperature,
    PointMass,
    PowerDamping,
    Primitive,
    RootCompliance,
    Washout,
)
from fe.runtime.patched_wing import PatchedWing
from fe.runtime.wing_rows import EMPTY
from fe.wing.design import WingDesign
from fe.wing.operators import (
    AffineOperators,
    assemble,
    cell_elasticity,
    gauge_output,
    modulus_variation,
    point_masses,
    section_displacement,
)
from fe.wing.turn_load import DISTRIBUTIONS, STANDARD_GRAVITY, lift_load

FloatArray = np.ndarray[Any, np.dtype[np.float64]]

STATE = (1.0073, (0.2, 0.1))
FACTOR = {"young_modulus_factor": STATE[0]}
MASSES = (0.1688, 0.1344)
STRAIN, DISPLACEMENT, FREQUENCY = 1e-3, 1e-3, 1e-4
"""Accuracy wanted, relative to the largest strain, the largest displacement, and of the first frequencies."""


@pytest.fixture(scope="module")
def wing(coarse_patched_wing: PatchedWing) -> PatchedWing:
    return coarse_patched_wing


@pytest.fixture(scope="module")
def operators(coarse_operators: AffineOperators) -> AffineOperators:
    return coarse_operators


@pytest.fixture(scope="module")
def design(coarse_design: WingDesign) -> WingDesign:
    return coarse_design


def patched(*primitives: Primitive) -> ModelPatch:
    return ModelPatch(primitives)


def load(wing: PatchedWing, load_factor: float, patch: ModelPatch = EMPTY) -> FloatArray:
    return np.array((load_factor, load_factor**2)) @ wing.load_parts(patch)


def compare(wing: PatchedWing, reduced: FloatArray, operators: AffineOperators, full: FloatArray) -> None:
    strain = operators.gauge_output @ full
    assert np.abs(wing.arrays.strain_rows[0] @ reduced - strain).max() <= STRAIN * np.abs(strain).max()
    tip = float(operators.tip_row @ full)
    assert float(wing.arrays.tip_row @ reduced) == pytest.approx(tip, rel=DISPLACEMENT)


def solved(operators: AffineOperators, loads: FloatArray, stiffness: Any = None) -> FloatArray:
    matrix = operators.stiffness(FACTOR, STATE[1]) if stiffness is None else stiffness
    return Factorisation(matrix).solve(loads)


def compare_loads(wing: PatchedWing, structure: Any, operators: AffineOperators, matrix: Any = None) -> None:
    """Compare under the lift of 2.5 g and under a force at the tip."""
    loads = (load(wing, 2.5), 2.5 * operators.load_lift), (wing.force_row("tip_load"), operators.load_tip)
    for reduced, full in loads:
        compare(wing, structure.static(reduced), operators, solved(operators, full, matrix))


def frequencies(stiffness: Any, mass: Any, count: int = 3) -> FloatArray:
    factors = Factorisation(stiffness)
    n = stiffness.shape[0]
    inverse = LinearOperator((n, n), matvec=factors.riesz, dtype=np.float64)
    start = np.random.default_rng(2).normal(size=n)
    square = eigsh(stiffness, count, mass, sigma=0.0, OPinv=inverse, v0=start, return_eigenvectors=False)
    return np.sort(np.sqrt(square))


# ---------------------------------------------------------------- structure


def test_without_a_patch_it_is_the_reduced_model_within_its_error_bound(
    wing: PatchedWing, coarse_reduction: Reduction
) -> None:
    model = coarse_reduction.model
    for e, loss, factor, force in ((1.0, (0.0, 0.0), 3.0, 0.0), (0.95, (0.6, 0.3), 2.0, 10.0)):
        response = model.static_response(
            young_modulus_factor=e, stiffness_loss=loss, load_factor=factor, tip_force=force
        )
        u = wing.structure(e, loss, *MASSES).static(load(wing, factor) + force * wing.force_row("tip_load"))
        scale = np.abs(response.strain).max()
        strain = wing.arrays.strain_rows[0] @ u
        assert np.abs(strain - response.strain).max() <= response.strain_error_bound + 3e-4 * scale
        assert float(wing.arrays.tip_row @ u) == pytest.approx(response.displacement[0], rel=5e-4)
        frequency = wing.structure(e, loss, *MASSES).lowest(3).frequency
        names = ("servo_mass", "pitot_mass")
        modes = model.modes({"young_modulus_factor": e, **dict(zip(names, MASSES, strict=True))}, loss)
        assert frequency == pytest.approx(modes.frequency[:3], rel=FREQUENCY)


@pytest.mark.parametrize("share", [0.02, 0.3])
def test_root_compliance_is_a_softer_root_spring(wing: PatchedWing, design: WingDesign, share: float) -> None:
    compliance = share * wing.arrays.largest_compliance / 0.4
    softer = 1.0 / (1.0 / design.root.flap_spring + compliance)
    operators = assemble(design.changed(root={"flap_spring": softer}))
    structure = wing.structure(*STATE, *MASSES, patched(RootCompliance(compliance)))
    compare_loads(wing, structure, operators)
    wanted = frequencies(operators.stiffness(FACTOR, STATE[1]), operators.mass(point_masses(*MASSES)))
    assert 2.0 * np.pi * structure.lowest(3).frequency == pytest.approx(wanted, rel=FREQUENCY)


@pytest.mark.parametrize(("first", "last", "loss"), [(5, 6, 0.5), (2, 5, 0.3), (7, 10, 0.6)])
def test_local_loss_between_mesh_lines_is_softer_cells(
    wing: PatchedWing, operators: AffineOperators, first: int, last: int, loss: float
) -> None:
    mesh = operators.wing_mesh
    start, end = wing.arrays.strip_lines[[first, last]]
    stiffness = operators.stiffness(FACTOR, STATE[1])
    elasticity, variation = cell_elasticity(mesh), modulus_variation(mesh)
    restriction = operators.expansion.T.tocsr()
    for region, factor in zip(range(3), operators.theta(FACTOR, STATE[1])[:3], strict=True):
        middle = mesh.centres[:, 1]
        cells = np.flatnonzero((mesh.region == region) & (middle > start) & (middle < end))
        if cells.size:
            part = operators.wing_mesh.stiffness(cells, elasticity[cells], variation[cells])
            stiffness = stiffness - loss * factor * (restriction @ (part @ operators.expansion))
    patch = patched(LocalStiffnessLoss(loss, start, end - start))
    structure = wing.structure(*STATE, *MASSES, patch)
    compare_loads(wing, structure, operators, stiffness.tocsr())
    wanted = frequencies(stiffness.tocsr(), operators.mass(point_masses(*MASSES)))
    frequency = 2.0 * np.pi * structure.lowest(3).frequency
    assert frequency[[0, 2]] == pytest.approx(wanted[[0, 2]], rel=FREQUENCY)  # flapwise
    assert frequency[1] == pytest.approx(wanted[1], rel=1e-3)


@pytest.mark.parametrize(
    ("start", "end", "loss"),
    [
        pytest.param(0.2, 0.45, 0.4, marks=pytest.mark.long),
        pytest.param(0.75, 1.15, 0.3, marks=pytest.mark.long),
        (0.5, 0.6, 0.5),
    ],
)
def test_a_box_that_parts_strips_against_a_mesh_with_lines_there(
    wing: PatchedWing, design: WingDesign, start: float, end: float, loss: float
) -> None:
    operators = assemble(design.changed(mesh={"span_size": 0.005}))  # cells of 20 mm
    mesh = operators.wing_mesh
    start, end = (float(mesh.span_lines[np.abs(mesh.span_lines - place).argmin()]) for place in (start, end))
    elasticity, variation = cell_elasticity(mesh), modulus_variation(mesh)
    inside = (mesh.centres[:, 1] > start) & (mesh.centres[:, 1] < end)
    cells = np.flatnonzero(inside & (mesh.stiffness_term < 3))
    part = operators.wing_mesh.stiffness(cells, elasticity[cells], variation[cells])
    whole = operators.stiffness()
    softer = whole - loss * (operators.expansion.T @ (part @ operators.expansion))
    before, after = (solved(operators, operators.load_lift, matrix) for matrix in (whole, softer.tocsr()))
    # ratios, because the two meshes differ a little in themselves
    strain = operators.gauge_output @ before
    wanted = operators.gauge_output @ after / strain
    patch = patched(LocalStiffnessLoss(loss, start, end - start))
    plain = wing.structure(1.0, (0.0, 0.0), *MASSES).static(load(wing, 1.0))
    u = wing.structure(1.0, (0.0, 0.0), *MASSES, patch).static(load(wing, 1.0))
    factors = wing.strain_factors(patch)
    ratio = factors * (wing.arrays.strain_rows[0] @ u) / (wing.arrays.strain_rows[0] @ plain)
    scale = np.abs(strain) / np.abs(strain).max()
    assert np.abs((ratio - wanted) * scale).max() < 0.03 * np.abs((wanted - 1.0) * scale).max()
    # the strips of this mesh are 0.26 m long, four times those of the shipped one
    tip = operators.tip_row
    moved = wing.arrays.tip_row
    effect = float(tip @ after) / float(tip @ before) - 1.0
    assert float(moved @ u) / float(moved @ plain) - 1.0 == pytest.approx(effect, rel=0.05)


def test_strains_need_no_factor_where_a_box_ends_at_strips(wing: PatchedWing) -> None:
    start, end = wing.arrays.strip_lines[[3, 6]]
    factors = wing.strain_factors(patched(LocalStiffnessLoss(0.4, start, end - start)))
    assert factors == pytest.approx(1.0, abs=1e-12)
    assert wing.strain_factors(patched(PointMass(0.1, 1.0), LocalStiffnessLoss(0.0, 0.1, 0.2))) is None


def test_the_strips_together_are_the_skin(wing: PatchedWing) -> None:
    span = wing.span
    everywhere = wing.structure(1.0, (0.0, 0.0), *MASSES, patched(LocalStiffnessLoss(0.25, 0.0, span)))
    skin = np.tensordot((0.75, 0.75, 0.75, 1.0), wing.arrays.stiffness, 1)
    assert np.abs(everywhere.stiffness - skin).max() < 1e-6 * np.abs(skin).max()


def test_local_losses_that_overlap_multiply(wing: PatchedWing) -> None:
    start, end = wing.arrays.strip_lines[[4, 6]]
    once = LocalStiffnessLoss(0.3, start, end - start)
    twice = wing.structure(*STATE, *MASSES, patched(once, once)).stiffness
    as_one = wing.structure(*STATE, *MASSES, patched(LocalStiffnessLoss(0.51, start, end - start))).stiffness
    assert np.abs(twice - as_one).max() < 1e-12


def test_point_mass_is_a_pitot_tube_that_was_moved(wing: PatchedWing, design: WingDesign) -> None:
    for station, added in ((0.75, 0.05), (0.4, 0.2)):
        places = [place.model_dump() for place in design.point_masses if place.kind == "servo"]
        moved = {"kind": "pitot", "station": station, "chord": design.tip_load.chord}
        operators = assemble(design.changed(point_masses=[*places, moved]))
        mass = operators.mass(point_masses(MASSES[0], added))
        wanted = frequencies(operators.stiffness(FACTOR, STATE[1]), mass)
        patch = patched(PointMass(added, station * wing.span))
        frequency = wing.structure(*STATE, MASSES[0], 0.0, patch).lowest(3).frequency * 2.0 * np.pi
        assert frequency == pytest.approx(wanted, rel=FREQUENCY)


def test_temperature_is_a_change_of_the_modulus_factor(wing: PatchedWing, operators: AffineOperators) -> None:
    patch = patched(ModulusTemperature(2e-3))
    u = wing.structure(*STATE, *MASSES, patch, 25.0).static(load(wing, 1.0))
    warm = operators.stiffness({"young_modulus_factor": STATE[0] * 0.95}, STATE[1])
    full = solved(operators, operators.load_lift, warm)
    compare(wing, u, operators, full)
    cold = wing.structure(*STATE, *MASSES, patch, 0.0).stiffness
    assert np.array_equal(cold, wing.structure(*STATE, *MASSES).stiffness)


# ---------------------------------------------------------------- loads


def _section_force(operators: AffineOperators, y: float, chord: float) -> FloatArray:
    mesh = operators.wing_mesh
    full = np.zeros(operators.wing_mesh.unknowns)
    full[2::3] = section_displacement(mesh, y, chord)
    return np.asarray(operators.expansion.T @ full)


def test_load_place_along_the_span(wing: PatchedWing, operators: AffineOperators) -> None:
    place = wing.arrays.load_place
    for shift in (-0.09, -0.02, 0.03):
        row = wing.force_row("tip_load", patched(LoadPlace(shift, 0.0)))
        full = _section_force(operators, place + shift, operators.wing_mesh.design.tip_load.chord)
        compare(wing, wing.structure(*STATE, *MASSES).static(row), operators, solved(operators, full))


def test_load_place_along_the_chord_follows_the_lever(
    wing: PatchedWing, operators: AffineOperators, design: WingDesign
) -> None:
    place, plan = wing.arrays.load_place, design.planform
    elastic, other = 0.3, 0.6
    assert {elastic, other} < set(wing.arrays.line_chord.tolist())
    aft = 0.04
    share = aft / ((other - elastic) * plan.chord(place / plan.semi_span))
    full = (1.0 - share) * _section_force(operators, place, elastic) + share * _section_force(
        operators, place, other
    )
    row = wing.force_row("tip_load", patched(LoadPlace(0.0, aft)))
    u = wing.structure(*STATE, *MASSES).static(row)
    compare(wing, u, operators, solved(operators, full))
    # the work of the force is the same on both ways, and the section twists tail up
    assert wing.displacement_row(1.8, 0.9) @ u > wing.displacement_row(1.8, 0.3) @ u


@pytest.mark.parametrize(("chord", "share"), [(0.03, 0.0), (0.15, 12.0 / 27.0), (0.9, 1.0 - 1.0 / 31.0)])
def test_a_force_before_or_behind_goes_to_the_webs_beside_it(
    wing: PatchedWing, operators: AffineOperators, chord: float, share: float
) -> None:
    place = wing.arrays.load_place
    webs = (0.03, 0.3) if chord < 0.3 else (0.6, 0.91)
    full = (1.0 - share) * _section_force(operators, place, webs[0]) + share * _section_force(
        operators, place, webs[1]
    )
    solution = solved(operators, full)
    row = wing.force_row((place, chord))
    u = wing.structure(*STATE, *MASSES).static(row)
    compare(wing, u, operators, solution)
    # the place itself yields by what the trailing edge gives way under the force, too
    assert float(row @ u) == pytest.approx(float(full @ solution), rel=3e-3)


@pytest.mark.parametrize("place", ["tip_load", (1.778, 0.6), (1.778, 0.9)])
def test_a_displaced_force_has_no_kink_at_a_web(wing: PatchedWing, place: str | tuple[float, float]) -> None:
    nominal = wing.force_row(place)
    before, behind = (wing.force_row(place, patched(LoadPlace(0.0, aft))) - nominal for aft in (-0.02, 0.02))
    assert np.abs(before + behind).max() < 1e-9 * np.abs(behind).max()


def test_a_named_place_and_its_coordinates_are_the_same(wing: PatchedWing) -> None:
    by_place = wing.force_row((wing.arrays.load_place, float(wing.arrays.line_chord[0])))
    assert np.abs(by_place - wing.force_row("tip_load")).max() < 1e-9 * np.abs(by_place).max()


@pytest.mark.parametrize("exponent", [0.7, 2.0, 4.0])
def test_washout_is_another_lift_distribution(
    wing: PatchedWing,
    operators: AffineOperators,
    design: WingDesign,
    exponent: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    coefficient, factor = 0.15, 3.0
    plan, lift = design.planform, design.lift
    course = DISTRIBUTIONS[lift.distribution](plan)
    points, weights = np.polynomial.legendre.leggauss(400)
    eta = 0.5 * (points + 1.0)
    kept = 1.0 - coefficient * factor * eta**exponent
    share = float((weights * course(eta) * kept).sum() / (weights * course(eta)).sum())

    def washed(planform: Any) -> Any:
        return lambda station: course(station) * (1.0 - coefficient * factor * station**exponent)

    restriction = operators.expansion.T
    plain = restriction @ lift_load(operators.wing_mesh)
    monkeypatch.setitem(DISTRIBUTIONS, lift.distribution, washed)
    changed = restriction @ lift_load(operators.wing_mesh) * share
    # what balances the weight is lift of the same course
    z_force = lift.force / lift.load_factor
    wanted = solved(operators, factor * (operators.load_lift + changed - plain))
    lifted = (changed - plain) * (_weight(operators, design) / z_force)
    lifted_full = solved(operators, factor * lifted * _upwards(operators))
    u = wing.structure(*STATE, *MASSES).static(load(wing, factor, patched(Washout(coefficient, exponent))))
    compare(wing, u, operators, wanted + lifted_full)


def _weight(operators: AffineOperators, design: WingDesign) -> float:
    rigid, mass = _upwards(operators), operators.mass(point_masses(design.masses.servo, design.masses.pitot))
    return STANDARD_GRAVITY * float(rigid @ (mass @ rigid))


def _held(operators: AffineOperators) -> FloatArray:
    points = operators.wing_mesh.points
    root = np.flatnonzero(np.abs(points[:, 1]) < 1e-9)
    return (3 * root[:, None] + np.arange(3)).ravel()


def _upwards(operators: AffineOperators) -> FloatArray:
    """Free unknowns of which the vertical ones are one."""
    component = np.zeros(operators.wing_mesh.unknowns)
    component[2::3] = 1.0
    free = np.zeros(operators.unknowns)
    free[:-3] = component[np.setdiff1d(np.arange(len(component)), _held(operators))]
    free[-3] = 1.0
    return free


def test_inertia_relief_is_weight_where_it_lies(
    wing: PatchedWing, operators: AffineOperators, design: WingDesign
) -> None:
    up, mass = _upwards(operators), operators.mass(point_masses(design.masses.servo, design.masses.pitot))
    weight = -STANDARD_GRAVITY * (mass @ up)
    fraction, factor = 0.2, 2.5
    full = solved(operators, factor * (operators.load_lift + fraction * weight * up))
    u = wing.structure(*STATE, *MASSES).static(load(wing, factor, patched(InertiaRelief(fraction))))
    compare(wing, u, operators, full)


# ---------------------------------------------------------------- outputs


@pytest.mark.parametrize("degrees", [-15.0, 8.0, 90.0])
def test_a_turned_gauge_follows_from_the_three_components(
    wing: PatchedWing, operators: AffineOperators, degrees: float
) -> None:
    angle = np.deg2rad(degrees)
    turned = gauge_output(operators.wing_mesh, angle)
    full = solved(operators, operators.load_lift)
    wanted = turned @ (operators.expansion @ full)
    u = wing.structure(*STATE, *MASSES).static(load(wing, 1.0))
    along, across, shear = wing.arrays.strain_rows @ u
    c, s = np.cos(angle), np.sin(angle)
    scale = np.abs(operators.gauge_output @ full).max()
    assert np.abs(c * c * along + s * s * across + s * c * shear - wanted).max() <= STRAIN * scale


def test_outputs_by_name(wing: PatchedWing) -> None:
    u = wing.structure(*STATE, *MASSES).static(load(wing, 1.0))
    elastic = float(wing.arrays.line_chord[0])
    tip = wing.output_row("tip_displacement")
    there = wing.output_row(f"displacement[{wing.span}, {elastic}]")
    assert float(tip @ u) == pytest.approx(float(there @ u), rel=1e-9)
    strain = wing.output_row("strain[24]")
    assert np.array_equal(strain, wing.arrays.strain_rows[0, 23])
    across = wing.output_row("strain[24]", 1)
    assert np.array_equal(across, wing.arrays.strain_rows[1, 23])
    unknown = (
        "strain[0]",
        "strain[25]",
        "strain[-1]",
        "displacement[1.9, 0.3]",
        "displacement[a, b]",
        "velocity",
    )
    assert all(wing.output_row(name) is None for name in unknown)


def test_the_span_port_weighs_by_area(wing: PatchedWing) -> None:
    arrays = wing.arrays
    assert arrays.station_weights.sum() == pytest.approx(1.0)
    root, tip, span = arrays.root_chord, arrays.tip_chord, arrays.semi_span
    mean = (root / 2.0 + (tip - root) / 3.0) * span / (0.5 * (root + tip))  # of y over the trapezium
    assert arrays.station_weights @ arrays.stations == pytest.approx(mean, rel=1e-12)


# ---------------------------------------------------------------- no change, softer, impossible


def test_no_change_is_no_change_to_the_last_bit(wing: PatchedWing) -> None:
    nothing = patched(
        PointMass(0.0, 1.0),
        RootCompliance(0.0),
        LocalStiffnessLoss(0.0, 0.3, 0.2),
        ModulusTemperature(0.0),
        PowerDamping("tip", 1.0, 1.0, 0.0, 1.0, 1.0),
    )
    one, other = wing.structure(*STATE, *MASSES, nothing, 10.0), wing.structure(*STATE, *MASSES)
    assert np.array_equal(one.stiffness, other.stiffness)
    assert np.array_equal(one.mass, other.mass)
    loads = patched(LoadPlace(0.0, 0.0), Washout(0.0, 2.0), InertiaRelief(0.0))
    assert np.array_equal(load(wing, 2.0, loads), load(wing, 2.0))
    assert np.array_equal(wing.force_row("tip_load", loads), wing.force_row("tip_load"))
    factors = wing.strain_factors(nothing)
    assert factors is None or np.array_equal(factors, np.ones(len(wing.arrays.gauge_stations)))


@settings(max_examples=25, deadline=None)
@given(
    loss=st.floats(0.0, 0.9),
    start=st.floats(-0.2, 1.8),
    length=st.floats(0.0, 1.0),
    compliance=st.floats(0.0, 2e-4),
)
def test_softer_is_softer(
    wing: PatchedWing, loss: float, start: float, length: float, compliance: float
) -> None:
    row = wing.force_row("tip_load")
    patch = patched(LocalStiffnessLoss(loss, start, length), RootCompliance(compliance))
    stiff = float(row @ wing.structure(*STATE, *MASSES).static(row))
    soft = float(row @ wing.structure(*STATE, *MASSES, patch).static(row))
    assert soft >= stiff * (1.0 - 1e-9)
    lever = wing.arrays.load_place
    # the full solutions of which the basis is made are good to some 1e-6
    assert soft >= stiff + (1.0 - 1e-5) * compliance * lever**2 - 1e-9 * stiff


@pytest.mark.parametrize(
    ("patch", "message"),
    [
        (patched(LocalStiffnessLoss(1.0, 0.2, 0.5)), "must leave some stiffness"),
        (patched(RootCompliance(-1.0)), "cannot be reduced"),
        (patched(ModulusTemperature(0.2)), "must be positive"),
        (patched(PointMass(0.1, 3.0)), "must lie on the wing"),
        (patched(PointMass(0.1, -0.1)), "must lie on the wing"),
    ],
)
def test_impossible_changes_are_refused(wing: PatchedWing, patch: ModelPatch, message: str) -> None:
    with pytest.raises(InvalidPatchError, match=message):
        _ = wing.structure(*STATE, *MASSES, patch, 10.0).mass


def test_impossible_places_are_refused(wing: PatchedWing) -> None:
    with pytest.raises(InvalidPatchError, match="place 'nose' is not known"):
        wing.force_row("nose")
    with pytest.raises(InvalidPatchError, match="must not be negative"):
        load(wing, 1.0, patched(Washout(0.1, -1.0)))
