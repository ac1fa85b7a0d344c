"""Structures whose supports yield: closed forms, and the full model with springs."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.optimize import brentq

from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.reduction.change_basis import with_changes
from fe.reduction.reduced_basis import reduce_structure
from fe.runtime.arrays import FloatArray
from fe.runtime.changeable import ChangeableModel
from fe.runtime.changed_structure import ChangedStructure, compliance_gains
from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import (
    InterfaceCompliance,
    LoadOffset,
    LoadTilt,
    ModelPatch,
    PlaceMass,
    Primitive,
    RegionStiffnessLoss,
    SupportCompliance,
)
from fe.structure.affine import AffineStructure
from fe.structure.candidates import GAUGE_STEP, gauge_shifts, loss_places, mass_places
from fe.structure.gauges import gauge_rows
from fe.structure.nodal_loads import point_weights
from fe.structure.operators import Structure, assemble_structure

WriteBeam = Callable[..., Path]

LENGTH = 0.1
INERTIA = 0.02 * 0.01**3 / 12.0
MODULUS = 7e10
BENDING = MODULUS * INERTIA / LENGTH
"""Stiffness against a turn of the tip by a moment there [N m/rad]."""
SLENDER = {
    "poisson_ratio = 0.33": "poisson_ratio = 0.0",
    "free = true": "free = false",
    "mass = 0.05": "mass = 1e-9",
}
CLAMP_AT_ROOT = 'support = [{ set = "root", hold = ["x", "y", "z"] }]'
PROPPED = """support = [{ set = "root", hold = ["x", "y", "z"] }, { set = "end", hold = ["z"] }]"""
INNER_PUSH = {
    'set = "end", force': "point = [60, 10, 10], force",
    "point = [100, 10, 5]": "point = [70, 10, 5]",
}
"""Load and outputs between the supports."""
FLANGE = """support = [{ set = "root", rigid_about = [0, 10, 5], \
hold = ["x", "y", "z", "rx", "rz"], springs = [0, 0, 0, 0, 2000.0, 0], scaled_by = "k" }]"""
SCALED_SPRING = {
    CLAMP_AT_ROOT: FLANGE,
    'parameter = [{ name = "e" }]': 'parameter = [{ name = "e" }, { name = "k" }]',
}
PUSH = {"push": 50.0, "load_factor": 0.0}


class Yielding(NamedTuple):
    """A structure whose supports yield, and its reduced model."""

    full: AffineStructure
    model: ChangeableModel

    def changed(
        self, *primitives: Primitive, values: dict[str, float] | None = None
    ) -> ChangedStructure:
        vector = self.model.vector(values or {})
        return ChangedStructure(self.model, vector, ModelPatch(primitives))

    def outputs(self, structure: ChangedStructure, values: dict[str, float]) -> FloatArray:
        """Return strains and displacements at rest under the loads of the reduced model."""
        coefficients = self.model.load_coefficients(self.model.vector(values))
        static_count = len(self.model.gauges) + len(self.model.displacements)
        load = structure.basis.T @ self.model.whole_load.T @ coefficients
        displacements = structure.basis @ structure.static(load)
        return np.asarray(self.model.whole_output[:static_count] @ displacements)

    def full_system(self, compliances: dict[int, float], values: dict[str, float]):
        """Return stiffness, mass and load of the full model, its other supports held."""
        system = self.full.system_at(values)
        stiffness = system.stiffness.tolil()
        held = []
        for number, motion in enumerate(self.full.support_motions):
            if number in compliances:
                spring = motion.spring * values.get(motion.scaled_by or "", 1.0)
                stiffness[motion.unknown, motion.unknown] += (
                    1.0 / compliances[number]
                    if spring == 0.0
                    else 1.0 / (1.0 / spring + compliances[number]) - spring
                )
            elif motion.spring == 0.0:
                held.append(motion.unknown)
        free = np.setdiff1d(np.arange(self.full.unknowns), held)
        matrix = stiffness.tocsr()[free][:, free]
        return matrix, system.mass[free][:, free], system.load[free], free

    def full_answers(
        self, compliances: dict[int, float], values: dict[str, float]
    ) -> tuple[FloatArray, FloatArray]:
        """Return outputs at rest and natural frequencies of the full model."""
        stiffness, mass, load, free = self.full_system(compliances, values)
        displacements = Factorisation(stiffness).solve(load)
        full = self.full
        rows = np.concatenate((full.gauge_output.toarray(), full.displacement_output.toarray()))
        squares, _ = lowest_eigenpairs(stiffness, mass, self.model.mode_count)
        return rows[:, free] @ displacements, np.sqrt(squares) / (2.0 * np.pi)


def yielding_beam(file: Path) -> Yielding:
    """Return the structure of a file with yielding supports."""
    full = assemble_structure(file, yielding=True)
    return Yielding(full, with_changes(full, reduce_structure(full.with_held_supports())))


@pytest.fixture(scope="module")
def slender(write_beam: WriteBeam, tmp_path_factory: pytest.TempPathFactory) -> Yielding:
    """A cantilever that bends as an Euler-Bernoulli beam nearly does, without masses on it."""
    return yielding_beam(write_beam(tmp_path_factory.mktemp("slender"), SLENDER, cells=8))


@pytest.fixture(scope="module")
def propped(write_beam: WriteBeam, tmp_path_factory: pytest.TempPathFactory) -> Yielding:
    """The beam on two supports, which is statically indeterminate."""
    changes = {CLAMP_AT_ROOT: PROPPED, **INNER_PUSH}
    return yielding_beam(write_beam(tmp_path_factory.mktemp("propped"), changes))


@pytest.fixture(scope="module")
def flanged(write_beam: WriteBeam, tmp_path_factory: pytest.TempPathFactory) -> Yielding:
    """The beam behind a rigid flange, which turns about y against a spring."""
    return yielding_beam(write_beam(tmp_path_factory.mktemp("flanged"), SCALED_SPRING))


def test_a_clamp_that_turns_moves_the_tip_and_no_strain(slender: Yielding) -> None:
    """Under a force F at the tip the clamp turns by c F L."""
    compliance = 0.3 / BENDING
    held = slender.outputs(slender.changed(), PUSH)
    soft = slender.outputs(slender.changed(SupportCompliance("root", "ry", compliance)), PUSH)
    assert soft[:3] == pytest.approx(held[:3], rel=1e-9)
    assert soft[3] - held[3] == pytest.approx(50.0 * compliance * LENGTH**2, rel=1e-6)


def test_a_clamp_that_shifts_moves_the_tip_as_much(slender: Yielding) -> None:
    held = slender.outputs(slender.changed(), PUSH)
    soft = slender.outputs(slender.changed(SupportCompliance("root", "z", 2e-7)), PUSH)
    assert soft[3] - held[3] == pytest.approx(50.0 * 2e-7, rel=1e-6)


@pytest.mark.parametrize("relative_spring", [0.5, 3.0, 30.0])
def test_a_first_frequency_is_that_of_a_cantilever_on_a_rotational_spring(
    slender: Yielding, relative_spring: float
) -> None:
    """Blevins 1979: 1 + cos b cosh b + b (cos b sinh b - sin b cosh b) EI / (k L) = 0."""

    def root(spring: float) -> float:
        def equation(b: float) -> float:
            coupling = np.cos(b) * np.sinh(b) - np.sin(b) * np.cosh(b)
            return float(1.0 + np.cos(b) * np.cosh(b) + b * coupling / spring)

        return float(brentq(equation, 1e-3, 1.8752))

    soft = slender.changed(SupportCompliance("root", "ry", 1.0 / (relative_spring * BENDING)))
    ratio = soft.modes.frequency[0] / slender.changed().modes.frequency[0]
    assert ratio == pytest.approx((root(relative_spring) / 1.8751) ** 2, rel=5e-3)


MOTIONS_OF_BEAMS = [
    ("slender", 4),
    ("slender", 2),
    ("propped", 4),
    ("propped", 6),
    ("flanged", 0),
    ("flanged", 3),
]


@pytest.mark.parametrize("gain", [0.01, 1.0])
@pytest.mark.parametrize(("beam", "number"), MOTIONS_OF_BEAMS)
def test_both_ends_of_the_range_are_those_of_the_full_model(
    request, beam: str, number: int, gain: float
) -> None:
    """In a state with losses, for outputs and frequencies."""
    made: Yielding = request.getfixturevalue(beam)
    motion = made.full.support_motions[number]
    values = {"z1": 0.5, "z2": 0.3, **PUSH} | ({"k": 1.08} if beam == "flanged" else {})
    compliance = gain / float(compliance_gains(made.model, made.model.vector())[number].max())
    expected, frequency = made.full_answers({number: compliance}, values)
    structure = made.changed(
        SupportCompliance(motion.support, motion.motion, compliance), values=values
    )
    outputs = made.outputs(structure, values)
    for group in (slice(0, 3), slice(3, None)):
        assert np.abs(outputs[group] - expected[group]).max() < 1e-3 * np.abs(expected[group]).max()
    assert structure.modes.frequency == pytest.approx(frequency, rel=1e-3)


@pytest.mark.parametrize("beam", ["slender", "propped", "flanged"])
def test_the_stated_errors_are_small(request, beam: str) -> None:
    assert request.getfixturevalue(beam).model.change_errors.max() < 1e-3


def test_a_parameter_scales_a_spring(flanged: Yielding, write_beam, tmp_path: Path) -> None:
    stiffer = {**SCALED_SPRING, CLAMP_AT_ROOT: FLANGE.replace("2000.0", "2160.0")}
    other = assemble_structure(write_beam(tmp_path, stiffer))
    squares, _ = lowest_eigenpairs(other.stiffness(), other.mass(other.masses), 4)
    scaled = flanged.changed(values={"k": 1.08})
    assert scaled.modes.frequency[:4] == pytest.approx(np.sqrt(squares) / (2.0 * np.pi), rel=1e-4)


def test_two_supports_may_yield_at_once(propped: Yielding) -> None:
    names = [(motion.support, motion.motion) for motion in propped.full.support_motions]
    compliances = {names.index(("root", "ry")): 0.4 / BENDING, names.index(("end", "z")): 3e-7}
    primitives = [SupportCompliance(*names[number], value) for number, value in compliances.items()]
    structure = propped.changed(*primitives)
    expected, frequency = propped.full_answers(compliances, PUSH)
    assert propped.outputs(structure, PUSH)[:3] == pytest.approx(expected[:3], rel=1e-3)
    assert structure.modes.frequency[:3] == pytest.approx(frequency[:3], rel=1e-3)


def test_a_motion_that_moves_nothing_that_is_held_is_left_out(propped: Yielding) -> None:
    """The end, a face across x, is held along z alone: a turn about y moves it along x alone."""
    motions = [motion.motion for motion in propped.full.support_motions if motion.support == "end"]
    assert motions == ["z", "rx"]


@settings(max_examples=20, deadline=None)
@given(exponent=st.floats(-14.0, -8.0))
def test_a_support_that_hardly_yields_is_held(slender: Yielding, exponent: float) -> None:
    held, soft = slender.changed(), slender.changed(SupportCompliance("root", "ry", 10.0**exponent))
    assert soft.modes.frequency == pytest.approx(held.modes.frequency, rel=1e-4)
    assert slender.outputs(soft, PUSH) == pytest.approx(slender.outputs(held, PUSH), rel=1e-4)


JOINT = """
[[interface]]
name = "joint"
parts = ["left", "right"]
tangential = [0, 1e8]

[[material]]"""
HALVES = """set = [
    { name = "left", of = "cells", box = [[0, 0, 0], [50, 20, 10]] },
    { name = "right", of = "cells", box = [[50, 0, 0], [100, 20, 10]] },"""


def test_a_joint_that_yields_is_that_of_the_full_model(
    write_beam: WriteBeam, tmp_path: Path
) -> None:
    """A held turn against a spring, and a spring in series with that of the file."""
    file = write_beam(tmp_path, {"set = [": HALVES, "\n[[material]]": JOINT}, cells=2)
    jointed = yielding_beam(file)
    assert jointed.model.change_errors.max() < 1e-3
    names = list(zip(jointed.model.supports, jointed.model.motions, strict=True))
    compliances = {"rs": 1.0 / 400.0, "t": 3e-8}
    soft = jointed.changed(*[InterfaceCompliance("joint", *item) for item in compliances.items()])
    outputs, frequencies = jointed.full_answers(
        {names.index(("joint", motion)): value for motion, value in compliances.items()}, PUSH
    )
    assert jointed.outputs(soft, PUSH) == pytest.approx(outputs, rel=1e-5)
    assert soft.modes.frequency == pytest.approx(frequencies, rel=1e-4)


def test_compliances_of_one_motion_add_up(flanged: Yielding) -> None:
    one = flanged.changed(SupportCompliance("root", "ry", 5e-4))
    two = flanged.changed(*[SupportCompliance("root", "ry", 2.5e-4)] * 2)
    assert two.modes.frequency == pytest.approx(one.modes.frequency, rel=1e-12)


@pytest.mark.parametrize(
    ("primitive", "sentence"),
    [
        (
            SupportCompliance("flange", "rz", 1e-6),
            "no support 'flange' with the motion 'rz'; it has root x",
        ),
        (SupportCompliance("root", "ry", -1e-6), "'root' must not be negative, but is -1e-06"),
        (
            PlaceMass("nose", 1.0),
            "no place 'nose' for a mass; it has root|no place 'nose' for a mass; it has end",
        ),
        (RegionStiffnessLoss("nose", 0.5), "no place 'nose' for a loss"),
        (RegionStiffnessLoss("around", 1.0), "'around' must be at least 0 and below 1, but is 1"),
        (RegionStiffnessLoss("around", 0.5, extent=0.0), "of 'around' must be positive, but is 0"),
        (PlaceMass("end", 1.0, along=0.02), "0.02 m along .* 'end', .* must be at most 0 m"),
    ],
)
def test_what_cannot_change_is_refused(
    slender: Yielding, primitive: Primitive, sentence: str
) -> None:
    with pytest.raises(InvalidPatchError, match=sentence):
        slender.changed(primitive)


CHAIN = """
name = "chain"
length_unit = "m"
stiffness_matrix = "k.mtx"
mass_matrix = "m.mtx"
unknowns = "dof"
support = [{ nodes = [1], hold = ["x"] }]
control = [{ name = "push", unit = "N", nominal = 1 }]
load = [{ name = "push", control = "push", node = 3, force = [1, 0, 0] }]
damage = [{ name = "z1" }]
part = [{ matrix = "part.mtx", damage = "z1" }]
displacement = [{ name = "end", node = 3, direction = [1, 0, 0] }]
"""


def test_a_support_of_matrices_yields_in_series(tmp_path: Path) -> None:
    """Two springs of 1000 and 500 N/m behind one of 250 N/m: 1/1000 + 1/500 + 1/250."""
    header = "%%MatrixMarket matrix coordinate real symmetric\n"
    (tmp_path / "k.mtx").write_text(
        f"{header}3 3 5\n1 1 1000\n2 1 -1000\n2 2 1500\n3 2 -500\n3 3 500\n", encoding="utf-8"
    )
    (tmp_path / "part.mtx").write_text(
        f"{header}3 3 3\n2 2 500\n3 2 -500\n3 3 500\n", encoding="utf-8"
    )
    (tmp_path / "m.mtx").write_text(f"{header}3 3 3\n1 1 1\n2 2 1\n3 3 1\n", encoding="utf-8")
    (tmp_path / "dof").write_text("1.1\n2.1\n3.1\n", encoding="utf-8")
    file = tmp_path / "chain.toml"
    file.write_text(CHAIN, encoding="utf-8")
    full = assemble_structure(file, yielding=True)
    assert [motion[:2] for motion in full.support_motions] == [("node 1", "x")]
    made = Yielding(full, None)  # type: ignore[arg-type]
    stiffness, _, load, _ = made.full_system({0: 1.0 / 250.0}, {"push": 1.0})
    displacements = np.linalg.solve(stiffness.toarray(), load)
    assert displacements == pytest.approx([0.005, 0.007, 0.004])
    assert full.with_held_supports().unknowns == 2


# ---------------------------------------------------------------- masses and losses of stiffness


@pytest.mark.parametrize("ratio", [0.05, 0.5])
def test_a_mass_at_the_tip_has_the_frequency_of_the_closed_form(
    slender: Yielding, ratio: float
) -> None:
    """1 + cos b cosh b + mu b (cos b sinh b - sin b cosh b) = 0, mu: mass over that of the beam."""

    def equation(b: float) -> float:
        coupling = np.cos(b) * np.sinh(b) - np.sin(b) * np.cosh(b)
        return float(1.0 + np.cos(b) * np.cosh(b) + ratio * b * coupling)

    heavy = slender.changed(PlaceMass("end", ratio * 2700.0 * LENGTH * 0.02 * 0.01))
    change = heavy.modes.frequency[0] / slender.changed().modes.frequency[0]
    assert change == pytest.approx((brentq(equation, 1e-3, 1.8752) / 1.8751) ** 2, rel=5e-3)


def test_an_added_mass_has_the_frequencies_of_the_full_model(propped: Yielding) -> None:
    number = len(propped.model.mass_places) // 2
    structure = propped.changed(PlaceMass(propped.model.mass_places[number], 0.01))
    full = propped.full.with_held_supports()
    rows = mass_places(propped.full)[number].rows[:, : full.unknowns]
    mass = (full.mass(full.masses) + 0.01 * (rows.T @ rows)).tocsr()
    squares, _ = lowest_eigenpairs(full.stiffness(), mass, 4)
    assert structure.modes.frequency[:4] == pytest.approx(
        np.sqrt(squares) / (2.0 * np.pi), rel=1e-3
    )


def test_a_mass_beside_a_point_has_the_frequencies_of_one_there(propped: Yielding) -> None:
    """On a coarse mesh, where the point itself would be wrong by five times as much."""
    model = propped.model
    number = int(np.argmin(np.abs(model.mass_points[:, 0] - 0.05)))
    along, across = model.mass_axes[number] @ np.array([0.006, 0.0, 0.0])
    beside = PlaceMass(model.mass_places[number], 0.01, along=along, across=across)
    frequencies = propped.changed(beside).modes.frequency[:2]
    point = 1e3 * (model.mass_points[number] + np.array([0.006, 0.0, 0.0]))
    full = propped.full.with_held_supports()
    weights = point_weights(full.mesh, tuple(point.tolist()), "the mass")
    rows = sparse.kron(weights[np.newaxis], sparse.eye_array(3)) @ full.expansion
    mass = (full.mass(full.masses) + 0.01 * (rows.T @ rows)).tocsr()
    squares, _ = lowest_eigenpairs(full.stiffness(), mass, 2)
    expected = np.sqrt(squares) / (2.0 * np.pi)
    at_point = propped.changed(PlaceMass(model.mass_places[number], 0.01)).modes.frequency[:2]
    assert np.abs(at_point / expected - 1.0).max() > 3e-3
    assert frequencies == pytest.approx(expected, rel=1e-3)


def test_a_mass_that_is_added_and_lost_changes_nothing(propped: Yielding) -> None:
    place = propped.model.mass_places[0]
    both = propped.changed(PlaceMass(place, 0.01), PlaceMass(place, -0.01))
    plain = propped.changed().modes.frequency
    assert both.modes.frequency == pytest.approx(plain, rel=1e-4)


def test_a_mass_moves_nothing_at_rest(slender: Yielding) -> None:
    heavy = slender.changed(PlaceMass("end", 0.1))
    plain = slender.outputs(slender.changed(), PUSH)
    assert slender.outputs(heavy, PUSH) == pytest.approx(plain, rel=1e-4)


@pytest.mark.parametrize("loss", [0.05, 0.6])
@pytest.mark.parametrize("number", [0, -1])
def test_a_patch_that_loses_stiffness_is_that_of_the_full_model(
    slender: Yielding, number: int, loss: float
) -> None:
    structure = slender.changed(RegionStiffnessLoss(slender.model.loss_places[number], loss))
    full = slender.full.with_held_supports()
    free = slice(0, full.unknowns)
    system = full.system_at(PUSH)
    stiffness = system.stiffness - loss * sum(
        matrix[free, free] for matrix in loss_places(slender.full)[number].terms.values()
    )
    displacements = Factorisation(stiffness.tocsr()).solve(system.load)
    rows = np.concatenate((full.gauge_output.toarray(), full.displacement_output.toarray()))
    expected, outputs = rows @ displacements, slender.outputs(structure, PUSH)
    assert np.abs(outputs[:3] - expected[:3]).max() < 1e-3 * np.abs(expected[:3]).max()
    assert outputs[3] == pytest.approx(expected[3], rel=1e-3)
    squares, _ = lowest_eigenpairs(stiffness.tocsr(), system.mass, 4)
    assert structure.modes.frequency[:4] == pytest.approx(
        np.sqrt(squares) / (2.0 * np.pi), rel=1e-3
    )


def test_a_patch_lies_around_a_gauge(write_beam: WriteBeam, tmp_path: Path) -> None:
    beam = assemble_structure(
        write_beam(tmp_path, {"point = [20, 10, 10]": "point = [35, 10, 10]"}, 8)
    )
    assert next(iter(loss_places(beam))).name == "around (31.2, 10, 5) mm"


def test_patches_do_not_overlap_and_leave_out_damage_regions(slender: Yielding) -> None:
    """All of them and the damage regions together hold the stiffness of the beam once."""
    free = slice(0, slender.full.with_held_supports().unknowns)
    patches = sum(matrix for patch in loss_places(slender.full) for matrix in patch.terms.values())
    terms = slender.full.stiffness_terms
    outside = sum(term.matrix for term in terms if term.region is None)
    difference = (patches - outside)[free, free]
    assert abs(difference).max() < 1e-9 * abs(outside).max()


# ---------------------------------------------------------------- loads and gauges


def pushed_outputs(made: Yielding, *primitives: Primitive) -> FloatArray:
    """Return strains and displacements under 50 N of the control "push", as a patch changes it."""
    model = made.model
    of_push = model.load_factors[:, 0] == 1 + model.controls.index("push")
    load = 50.0 * model.changed_load(model.whole_load[of_push].sum(axis=0), "push", primitives)
    static_count = len(model.gauges) + len(model.displacements)
    structure = made.changed()
    displacements = structure.basis @ structure.static(structure.basis.T @ load)
    return np.asarray(model.whole_output[:static_count] @ displacements)


@pytest.mark.parametrize(
    ("primitive", "point", "force"),
    [
        (LoadOffset("push", "x", 5e-4), [60.5, 10.0, 10.0], [0.0, 0.0, 1.0]),
        (LoadTilt("push", "y", 0.1), [60.0, 10.0, 10.0], [0.0, np.sin(0.1), np.cos(0.1)]),
    ],
)
def test_a_load_that_is_moved_or_turned_is_that_of_another_file(
    write_beam: WriteBeam,
    tmp_path: Path,
    propped: Yielding,
    primitive: Primitive,
    point: list[float],
    force: list[float],
) -> None:
    moved = f"point = {point}, force = {[float(part) for part in force]}"
    changes = {
        CLAMP_AT_ROOT: PROPPED,
        'set = "end", force = [0, 0, 1]': moved,
        "point = [100, 10, 5]": "point = [70, 10, 5]",
    }
    other = assemble_structure(write_beam(tmp_path, changes))
    load = other.load("pushed", 1.0)
    displacements = Factorisation(other.stiffness()).solve(50.0 * load)
    rows = np.concatenate((other.gauge_output.toarray(), other.displacement_output.toarray()))
    expected = rows @ displacements
    plain, changed = pushed_outputs(propped), pushed_outputs(propped, primitive)
    assert np.abs(changed - expected)[:3].max() < 0.02 * np.abs(plain[:3]).max()
    assert changed[3] == pytest.approx(expected[3], rel=5e-3)
    change = np.abs(expected - plain).max()
    assert np.abs(changed - expected).max() < 0.35 * change  # the first derivative on a coarse mesh


def test_a_gauge_beside_its_place_reads_what_one_there_does(beam: Structure) -> None:
    shifts = {(shift.gauge, shift.axis): shift for shift in gauge_shifts(beam)}
    slope, curvature = shifts["g2", "along"].rows.toarray()
    gauge = beam.design.gauge[1]
    distance = -GAUGE_STEP * beam.mesh.size
    x, *others = gauge.point
    moved = gauge.model_copy(update={"point": (x + 1e3 * distance, *others)})
    rows, _ = gauge_rows(beam.mesh, (gauge, moved))
    middle, expected = (rows @ beam.expansion).toarray()

    found = middle + distance * slope + 0.5 * distance**2 * curvature

    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_a_strain_across_a_gauge_is_that_of_poisson(flanged: Yielding) -> None:
    """Of a beam in bending it is minus 0.33 times the strain along it, without shear."""
    model = flanged.model
    structure = flanged.changed()
    load = model.whole_load.T @ model.load_coefficients(model.vector(PUSH))
    displacements = structure.basis @ structure.static(structure.basis.T @ load)
    along = model.whole_output[:1] @ displacements
    across, shear = model.across_output[:, 0] @ displacements
    assert across == pytest.approx(-0.33 * along[0], rel=0.1)
    assert abs(shear) < 0.02 * abs(along[0])
