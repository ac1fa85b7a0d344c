"""Structures against closed forms and against each other: loads, supports, masses, regions, parameters."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fe.elements.kinds import KINDS
from fe.runtime.errors import InvalidDesignError, InvalidStateError, MeshError
from fe.structure.field import natural_frequencies, static_responses, weighed, write_structure_vtu
from fe.structure.mesh_file import check_memory, memory_estimate, read_mesh
from fe.structure.operators import Structure, load_and_assemble

INNER, OUTER = 1.0, 2.0
RING = """
length_unit = "m"
set = [
  {name = "x", of = "nodes", box = [[0, -1, -1], [0, 3, 3]]},
  {name = "y", of = "nodes", box = [[-1, 0, -1], [3, 0, 3]]},
]
material = [{name = "rubber", density = 1000, young_modulus = 1e9, poisson_ratio = 0.3}]
support = [{set = "x", hold = ["x"]}, {set = "y", hold = ["y"]}, {set = "all=1", hold = ["z"]}]
load = [{name = "p", set = "bore=1", pressure = 1e6}]
gauge = [{name = "hoop", point = [0.7071067811865476, 0.7071067811865476, 0.05], direction = [-1, 1, 0]}]
"""


def ring(box: Callable[..., Any], write: Callable[..., Path], kind: str, count: int) -> Structure:
    """A quarter of a thick ring in plane strain; second order edges follow the circle."""
    points, cells = box(kind, (count, 2 * count, 1))
    radius, angle = INNER + (OUTER - INNER) * points[:, 0], 0.5 * np.pi * points[:, 1]
    bent = np.column_stack((radius * np.cos(angle), radius * np.sin(angle), 0.1 * points[:, 2]))
    bent[np.abs(bent) < 1e-12] = 0.0
    data = {"bore": (points[:, 0] == 0.0).astype(np.int64), "all": np.ones(len(points), dtype=np.int64)}
    text = RING if kind != "tetra" else RING.replace("0.7071067811865476", "0.70")
    return load_and_assemble(write(bent, kind, cells, text, point_data=data))


@pytest.mark.parametrize(
    ("kind", "order", "error"),
    [
        ("hexahedron", 1.7, 2e-2),
        ("tetra", 1.6, 5e-2),
        ("tetra10", 3.7, 1e-4),
        ("hexahedron20", 3.7, 1e-4),
        ("wedge15", 3.5, 1e-4),
    ],
)
def test_a_thick_ring_under_pressure_converges_to_lame(
    kind: str, order: float, error: float, box: Callable[..., Any], write: Callable[..., Path]
) -> None:
    # Lame: u(a) = (1 + nu) p a ((1 - 2 nu) a^2 + b^2) / (E (b^2 - a^2)) in plane strain.
    wanted = 1.3 * 1e6 * (0.4 * INNER**2 + OUTER**2) / (1e9 * (OUTER**2 - INNER**2))
    mass = 1000.0 * 0.1 * 0.25 * np.pi * (OUTER**2 - INNER**2)
    errors, lost = [], []
    for count in (2, 4):
        structure = ring(box, write, kind, count)
        found = static_responses(structure)["p"]
        # The work of the pressure converges with twice the order of the strains.
        work = float(structure.load("p") @ found.displacement)
        errors.append(abs(work / (1e6 * wanted * 0.5 * np.pi * INNER * 0.1) - 1.0))
        lost.append(abs(weighed(structure)[0] / mass - 1.0))
        if kind == "hexahedron20":
            assert found.strain[0] == pytest.approx(wanted / INNER, rel=0.05 / count**2)
    assert errors[1] < error
    assert np.log2(errors[0] / errors[1]) > order
    assert np.log2(lost[0] / lost[1]) > order


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_the_field_of_every_kind_is_written(
    kind: str, box: Callable[..., Any], write: Callable[..., Path], tmp_path: Path
) -> None:
    structure = ring(box, write, kind, 2)
    write_structure_vtu(tmp_path / "field.vtu", structure)
    found = read_mesh(tmp_path / "field.vtu", 1.0, "m")
    assert found.kind is KINDS[kind]
    np.testing.assert_array_equal(found.cells, structure.mesh.cells)


BEAM = """
length_unit = "mm"
parameter = [{name = "e"}]
control = [{name = "load_factor", nominal = 3.0}]
damage = [{name = "z1", set = "inner"}]
mass = [{name = "m", point = [500, 30, 5], mass = 0.4, free = true}]
gauge = [
  {name = "top", point = [500, 30, 10], direction = [1, 0, 0]},
  {name = "bottom", point = [500, 30, 0], direction = [1, 0, 0], length = 40},
]
displacement = [{name = "w", point = [1000, 30, 5], direction = [0, 0, 2]}]
acceleration = [{name = "a", point = [1000, 30, 5], direction = [0, 0, 1]}]
[[set]]
name = "root"
of = "nodes"
box = [[0, 0, 0], [0, 60, 10]]
[[set]]
name = "tip"
of = "nodes"
box = [[1000, 0, 0], [1000, 60, 10]]
[[set]]
name = "inner"
of = "cells"
box = [[0, 0, 0], [250, 60, 10]]
[[material]]
name = "alloy"
density = 2700
young_modulus = 7e10
poisson_ratio = 0.0
scaled_by = "e"
[[support]]
set = "root"
hold = ["x", "y", "z"]
[[load]]
name = "tip"
set = "tip"
force = [0, 0, 2]
[[load]]
name = "weight"
control = "load_factor"
acceleration = [0, 0, -9.81]
[[load]]
name = "at_a_point"
point = [1000, 30, 10]
force = [0, 0, 2]
[damping]
alpha = 0.1
"""


@pytest.fixture
def beam(box: Callable[..., Any], write: Callable[..., Path]) -> Callable[..., Structure]:
    points, cells = box("hexahedron20", (20, 1, 1))

    def make(*changes: tuple[str, str]) -> Structure:
        text = BEAM
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        return load_and_assemble(write(points * (1000, 60, 10), "hexahedron20", cells, text))

    return make


def test_a_cantilever_has_the_figures_of_a_beam(beam: Callable[..., Structure]) -> None:
    structure = beam()
    length, second = 1.0, 0.06 * 0.01**3 / 12.0
    stiffness = 7e10 * second
    area_mass = 2700.0 * 0.06 * 0.01
    found = static_responses(structure)
    deflection = 2.0 * length**3 / (3.0 * stiffness)
    assert found["tip"].output[0] == pytest.approx(deflection, rel=1e-3)
    assert found["at_a_point"].output[0] == pytest.approx(deflection, rel=1e-3)
    strain = 2.0 * 0.5 * 0.005 / stiffness
    np.testing.assert_allclose(found["tip"].strain, [-strain, strain], rtol=1e-6)
    # Three times the weight of the beam and of the free mass at half its length, which deflects 5/48 there.
    weight = 3.0 * 9.81 * (area_mass / 8.0 + 0.4 * 5.0 / 48.0) / stiffness
    assert found["weight"].output[0] == pytest.approx(-weight, rel=1e-3)
    mass, centre = weighed(structure)
    assert mass == pytest.approx(area_mass + 0.4)
    np.testing.assert_allclose(centre, [0.5, 0.03, 0.005], atol=1e-12)
    bare = beam(("mass = 0.4", "mass = 0.0"))
    frequency, _ = natural_frequencies(bare, 3)
    roots = np.array([1.8751040687, 4.6940911330])
    first, second = roots**2 / (2.0 * np.pi) * np.sqrt(stiffness / area_mass)
    np.testing.assert_allclose(frequency, [first, 6.0 * first, second], rtol=3e-3)  # the second one sideways
    assert (structure.damping_alpha, structure.damping_beta) == (0.1, 0.0)
    names = structure.gauges, structure.displacements, structure.accelerations
    assert names == (("top", "bottom"), ("w",), ("a",))
    assert abs(structure.acceleration_output - structure.displacement_output).max() == 0.0


def test_terms_make_what_a_changed_file_makes(beam: Callable[..., Structure]) -> None:
    structure = beam()
    assert [(term.parameter, term.region) for term in structure.stiffness_terms] == [("e", "z1"), ("e", None)]
    split = beam(
        ('scaled_by = "e"\n', 'set = "inner"\nscaled_by = "e"\n'),
        ("young_modulus = 7e10", "young_modulus = 5.88e10"),  # 1.2 (1 - 0.3) 7e10
        (
            "[[support]]",
            '[[set]]\nname = "outer"\nof = "cells"\nbox = [[250, 0, 0], [1000, 60, 10]]\n'
            '[[material]]\nname = "b"\nset = "outer"\ndensity = 2700\nyoung_modulus = 8.4e10\n'
            "poisson_ratio = 0\n[[support]]",
        ),
        ("free = true", "free = false"),
    )
    assert [(term.parameter, term.region) for term in split.stiffness_terms] == [("e", "z1"), (None, None)]
    for loss in ({"z1": 0.3}, (0.3,)):
        ours = structure.stiffness({"e": 1.2}, loss)
        assert abs(ours - split.stiffness()).max() < 1e-12 * abs(ours).max()
    assert abs(structure.mass() - split.mass()).max() < 1e-14 * abs(structure.mass()).max()
    np.testing.assert_allclose(structure.load("weight"), split.load("weight"), atol=1e-12)
    np.testing.assert_allclose(structure.load("weight", 1.0), structure.load("weight") / 3.0)
    for wrong in (lambda: structure.stiffness({"f": 1.0}), lambda: structure.mass({"z1": 1.0})):
        with pytest.raises(InvalidStateError, match=r"has no (parameter|free mass) named"):
            wrong()


def test_springs_carry_the_weight(beam: Callable[..., Structure]) -> None:
    structure = beam(
        ('set = "root"\nhold = ["x", "y", "z"]', 'set = "root"\nsprings = [1e7, 1e7, 1e4]'),
        ('[[load]]\nname = "tip"', '[[support]]\nset = "tip"\nsprings = [0, 0, 1e4]\n[[load]]\nname = "tip"'),
    )
    down = structure.full_displacement(static_responses(structure)["weight"].displacement)[:, 2]
    springs = structure.unknowns_held.springs.reshape(-1, 3)
    assert springs.sum(axis=0) == pytest.approx([1e7, 1e7, 2e4])
    assert springs[:, 2] @ down == pytest.approx(-3.0 * 9.81 * weighed(structure)[0], rel=1e-7)


HELD = 'set = "root"\nhold = ["x", "y", "z"]'
FLANGE = 'set = "root"\nrigid_about = [0, 30, 5]\n'


def test_a_rigid_root_on_springs_shifts_and_turns(beam: Callable[..., Structure]) -> None:
    """The whole is statically determinate: what the springs add to the bending is F / k and F L^2 / k_r."""
    held = static_responses(beam())
    springs = 'hold = ["x", "y", "rx", "rz"]\nsprings = [0, 0, 1e4, 0, 3e3, 0]'
    structure = beam((HELD, FLANGE + springs))
    sprung = static_responses(structure)
    assert structure.unknowns == beam().unknowns + 2
    moved = 2.0 / 1e4 + 2.0 / 3e3
    for name in ("tip", "at_a_point"):
        np.testing.assert_allclose(sprung[name].output[0] - held[name].output[0], moved, rtol=1e-7)
        np.testing.assert_allclose(sprung[name].strain, held[name].strain, rtol=1e-7)
    fixed = static_responses(beam((HELD, FLANGE + 'hold = ["x", "y", "z", "rx", "ry", "rz"]')))
    np.testing.assert_allclose(fixed["weight"].displacement, held["weight"].displacement, rtol=1e-9)


@pytest.mark.parametrize(
    ("support", "sentence"),
    [
        (HELD.replace('"z"', '"rz"'), "with the point `rigid_about`"),
        (FLANGE + 'hold = ["rx"]\nsprings = [0, 0, 0, 1, 0, 0]', "rx is held"),
        (FLANGE, "a rigid set needs hold, springs or both"),
        (FLANGE + 'hold = ["x", "y", "z", "rx", "rz"]', "a turn about the axis along \\(0, -?1, 0\\)"),
        (f'{FLANGE}hold = ["x"]\n[[support]]\n{HELD}', "nodes of the rigid set belong to another support"),
        (
            FLANGE.replace("root", "line") + 'hold = ["x"]\n[[set]]\nname = "line"\nof = "nodes"\n'
            "box = [[0, 0, 0], [1000, 0, 0]]",
            "lie on a line",
        ),
    ],
)
def test_a_rigid_set_that_cannot_be(support: str, sentence: str, beam: Callable[..., Structure]) -> None:
    with pytest.raises((InvalidDesignError, MeshError), match=sentence):
        beam((HELD, support))


def test_a_gauge_reads_the_mean_over_its_area(box: Callable[..., Any], write: Callable[..., Path]) -> None:
    """Of u = x y^2, which the 20-node cell holds exactly: the mean of y^2 over ten strips of the width."""
    points, cells = box("hexahedron20", (1, 1, 1))
    text = """
length_unit = "m"
material = [{name = "ply", density = 1500, young_modulus = 1e9, poisson_ratio = 0.3}]
support = [{set = "all=1", hold = ["y"]}, {set = "x", hold = ["x", "z"]}]
set = [{name = "x", of = "nodes", box = [[0, 0, 0], [0, 0, 1]]}]
gauge = [{name = "g", point = [0.5, 0.4, 1], direction = [1, 0, 0], length = 0.2, width = 0.6}]
"""

    def made(text: str) -> Structure:
        data = {"all": np.ones(len(points), dtype=np.int64)}
        return load_and_assemble(write(points, "hexahedron20", cells, text, point_data=data))

    structure = made(text)
    field = np.zeros_like(structure.mesh.points)
    field[:, 0] = structure.mesh.points[:, 0] * structure.mesh.points[:, 1] ** 2
    moved = structure.expansion.T @ field.ravel()
    assert structure.gauge_output @ moved == pytest.approx([0.4**2 + 0.6**2 / 12.0 * (1.0 - 1.0 / 100.0)])
    with pytest.raises(InvalidDesignError, match=r"0\.2 m long and 1\.2 m wide, the gauge reaches over"):
        made(text.replace("width = 0.6", "width = 1.2"))


def test_an_orthotropic_material_follows_its_axes(
    box: Callable[..., Any], write: Callable[..., Path]
) -> None:
    points, cells = box("hexahedron20", (1, 1, 1))
    text = """
length_unit = "m"
support = [{set = "x=1", hold = ["x"]}, {set = "y=1", hold = ["y"]}, {set = "z=1", hold = ["z"]}]
load = [{name = "p", set = "top=1", pressure = -1e6}]
gauge = [
  {name = "a", point = [0, 0.5, 0.5], direction = [0, 0, 1]},
  {name = "b", point = [0.5, 0, 0.5], direction = [1, 0, 0]},
  {name = "c", point = [0, 0.5, 0.5], direction = [0, 1, 0]},
]
[[material]]
name = "ply"
density = 1500
young_moduli = [1.3e11, 9e9, 8e9]
poisson_ratios = [0.3, 0.25, 0.4]
shear_moduli = [5e9, 4e9, 3e9]
axes = [[0, 0, 1], [1, 0, 1]]
"""
    data = {name: (points[:, axis] == 0.0).astype(int) for axis, name in enumerate("xyz")}
    data["top"] = (points[:, 2] == 1.0).astype(int)
    structure = load_and_assemble(write(points, "hexahedron20", cells, text, point_data=data))
    # Axis 1 along z, axis 2 along x, axis 3 along y.
    wanted = 1e6 * np.array([1.0, -0.3, -0.25]) / 1.3e11
    np.testing.assert_allclose(static_responses(structure)["p"].strain, wanted, rtol=1e-9)


def test_memory_is_estimated_before_it_is_taken(beam: Callable[..., Structure]) -> None:
    mesh = beam().mesh
    assert 0.3 * 2**30 < memory_estimate(mesh) < 0.5 * 2**30
    check_memory(mesh)
    with pytest.raises(MeshError, match=r"744 unknowns would take about 0\.\d GiB, but 0\.1 GiB are allowed"):
        check_memory(mesh, 0.1 * 2**30)
