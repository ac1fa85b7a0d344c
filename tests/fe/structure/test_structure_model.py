"""Structures against closed forms and against each other: loads, supports, masses, regions, parameters."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fe.elements.kinds import KINDS
from fe.runtime.errors import FiniteElementError, InvalidDesignError, InvalidStateError, MeshError
from fe.structure.affine import natural_frequencies, static_responses
from fe.structure.mesh_file import check_memory, memory_estimate, read_mesh
from fe.structure.operators import Structure, load_and_assemble, weighed, write_structure_vtu
from tests.refusals import Inputs

INPUTS = Inputs(__file__)
INNER, OUTER = 1.0, 2.0
HELD = 'set = "root"\nhold = ["x", "y", "z"]'
FLANGE = 'set = "root"\nrigid_about = [0, 30, 5]\n'


@pytest.fixture
def ring(box, write) -> Callable[[str, int], Structure]:
    """A quarter of a thick ring in plane strain; second order edges follow the circle."""

    def make(kind: str, count: int) -> Structure:
        points, cells = box(kind, (count, 2 * count, 1))
        radius, angle = INNER + (OUTER - INNER) * points[:, 0], 0.5 * np.pi * points[:, 1]
        bent = np.column_stack((radius * np.cos(angle), radius * np.sin(angle), 0.1 * points[:, 2]))
        bent[np.abs(bent) < 1e-12] = 0.0
        data = {"bore": (points[:, 0] == 0.0).astype(np.int64), "all": np.ones(len(points), dtype=np.int64)}
        text = INPUTS.text("ring.toml", *[("0.7071067811865476", "0.70")] * (2 * (kind == "tetra")))
        return load_and_assemble(write(bent, kind, cells, text, point_data=data))

    return make


@pytest.fixture
def beam(box, write) -> Callable[..., Structure]:
    """A cantilever of 1000 x 60 x 10 mm with texts of its file exchanged."""
    points, cells = box("hexahedron20", (20, 1, 1))
    place = points * (1000, 60, 10)
    return lambda *changes: load_and_assemble(
        write(place, "hexahedron20", cells, INPUTS.text("cantilever.toml", *changes))
    )


@pytest.fixture
def cube(box, write) -> Callable[..., Structure]:
    """One cell, with sets of the faces through the origin, of the top, and of all."""
    points, cells = box("hexahedron20", (1, 1, 1))
    sets = {name: points[:, axis] == 0.0 for axis, name in enumerate("xyz")}
    sets |= {"top": points[:, 2] == 1.0, "all": points[:, 2] >= 0.0}
    data = {name: chosen.astype(np.int64) for name, chosen in sets.items()}
    return lambda name, *changes: load_and_assemble(
        write(points, "hexahedron20", cells, INPUTS.text(name, *changes), point_data=data)
    )


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
def test_a_thick_ring_under_pressure_converges_to_lame(kind: str, order: float, error: float, ring) -> None:
    # Lame: u(a) = (1 + nu) p a ((1 - 2 nu) a^2 + b^2) / (E (b^2 - a^2)) in plane strain.
    wanted = 1.3 * 1e6 * (0.4 * INNER**2 + OUTER**2) / (1e9 * (OUTER**2 - INNER**2))
    mass = 1000.0 * 0.1 * 0.25 * np.pi * (OUTER**2 - INNER**2)
    errors, lost = [], []
    for count in (2, 4):
        structure = ring(kind, count)
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
def test_the_field_of_every_kind_is_written(kind: str, ring, tmp_path: Path) -> None:
    structure = ring(kind, 2)
    write_structure_vtu(tmp_path / "field.vtu", structure)
    found = read_mesh(tmp_path / "field.vtu", 1.0, "m")
    assert found.kind is KINDS[kind]
    np.testing.assert_array_equal(found.cells, structure.mesh.cells)


def test_a_cantilever_has_the_figures_of_a_beam(beam) -> None:
    structure, length, second = beam(), 1.0, 0.06 * 0.01**3 / 12.0
    stiffness, area_mass = 7e10 * second, 2700.0 * 0.06 * 0.01
    found = static_responses(structure)
    deflection = 2.0 * length**3 / (3.0 * stiffness)
    # Three times the weight of the beam and of the free mass at half its length, which deflects 5/48 there.
    weight = 3.0 * 9.81 * (area_mass / 8.0 + 0.4 * 5.0 / 48.0) / stiffness
    for name, wanted in (("tip", deflection), ("at_a_point", deflection), ("weight", -weight)):
        assert found[name].output[0] == pytest.approx(wanted, rel=1e-3)
    strain = 2.0 * 0.5 * 0.005 / stiffness
    np.testing.assert_allclose(found["tip"].strain, [-strain, strain], rtol=1e-6)
    mass, centre = weighed(structure)
    assert mass == pytest.approx(area_mass + 0.4)
    np.testing.assert_allclose(centre, [0.5, 0.03, 0.005], atol=1e-12)
    frequency, _ = natural_frequencies(beam(("mass = 0.4", "mass = 0.0")), 3)
    roots = np.array([1.8751040687, 4.6940911330])
    first, second = roots**2 / (2.0 * np.pi) * np.sqrt(stiffness / area_mass)
    np.testing.assert_allclose(frequency, [first, 6.0 * first, second], rtol=3e-3)  # the second one sideways
    assert (structure.damping_alpha, structure.damping_beta) == (0.1, 0.0)
    names = structure.gauges, structure.displacements, structure.accelerations
    assert names == (("top", "bottom"), ("w",), ("a",))
    assert abs(structure.acceleration_output - structure.displacement_output).max() == 0.0


def test_terms_make_what_a_changed_file_makes(beam) -> None:
    structure = beam()
    assert [(term.parameter, term.region) for term in structure.stiffness_terms] == [("e", "z1"), ("e", None)]
    outer = '[[set]]\nname = "outer"\nof = "cells"\nbox = [[250, 0, 0], [1000, 60, 10]]\n[[material]]\n'
    outer += (
        'name = "b"\nset = "outer"\ndensity = 2700\nyoung_modulus = 8.4e10\npoisson_ratio = 0\n[[support]]'
    )
    split = beam(
        ('scaled_by = "e"\n', 'set = "inner"\nscaled_by = "e"\n'),
        ("young_modulus = 7e10", "young_modulus = 5.88e10"),  # 1.2 (1 - 0.3) 7e10
        ("[[support]]", outer),
        ("free = true", "free = false"),
    )
    assert [(term.parameter, term.region) for term in split.stiffness_terms] == [("e", "z1"), (None, None)]
    for loss in ({"z1": 0.3}, (0.3,)):
        ours = structure.stiffness({"e": 1.2}, loss)
        assert abs(ours - split.stiffness()).max() < 1e-12 * abs(ours).max()
    assert abs(structure.mass() - split.mass()).max() < 1e-14 * abs(structure.mass()).max()
    np.testing.assert_allclose(structure.load("weight"), split.load("weight"), atol=1e-12)
    np.testing.assert_allclose(structure.load("weight", 1.0), structure.load("weight") / 3.0)
    for ask, wrong in ((structure.stiffness, {"f": 1.0}), (structure.mass, {"z1": 1.0})):
        with pytest.raises(InvalidStateError, match=r"has no (parameter|free mass) named"):
            ask(wrong)


def test_springs_carry_the_weight(beam) -> None:
    tip = '[[support]]\nset = "tip"\nsprings = [0, 0, 1e4]\n[[load]]\nname = "tip"'
    structure = beam((HELD, 'set = "root"\nsprings = [1e7, 1e7, 1e4]'), ('[[load]]\nname = "tip"', tip))
    down = structure.full_displacement(static_responses(structure)["weight"].displacement)[:, 2]
    springs = structure.unknowns_held.springs.reshape(-1, 3)
    assert springs.sum(axis=0) == pytest.approx([1e7, 1e7, 2e4])
    assert springs[:, 2] @ down == pytest.approx(-3.0 * 9.81 * weighed(structure)[0], rel=1e-7)


def test_a_rigid_root_on_springs_shifts_and_turns(beam) -> None:
    """The whole is statically determinate: what the springs add to the bending is F / k and F L^2 / k_r."""
    held = static_responses(beam())
    structure = beam((HELD, f'{FLANGE}hold = ["x", "y", "rx", "rz"]\nsprings = [0, 0, 1e4, 0, 3e3, 0]'))
    sprung = static_responses(structure)
    assert structure.unknowns == beam().unknowns + 2
    moved = 2.0 / 1e4 + 2.0 / 3e3
    for name in ("tip", "at_a_point"):
        np.testing.assert_allclose(sprung[name].output[0] - held[name].output[0], moved, rtol=1e-7)
        np.testing.assert_allclose(sprung[name].strain, held[name].strain, rtol=1e-7)
    fixed = static_responses(beam((HELD, FLANGE + 'hold = ["x", "y", "z", "rx", "ry", "rz"]')))
    np.testing.assert_allclose(fixed["weight"].displacement, held["weight"].displacement, rtol=1e-9)


@pytest.mark.parametrize(("old", "new", "sentence"), INPUTS.refused("cantilever"))
def test_a_rigid_set_that_cannot_be(old: str, new: str, sentence: str, beam) -> None:
    with pytest.raises(FiniteElementError, match=sentence):
        beam((old, new))


def test_a_gauge_reads_the_mean_over_its_area(cube) -> None:
    """Of u = x y^2, which the 20-node cell holds exactly: the mean of y^2 over ten strips of the width."""
    structure = cube("strip.toml")
    field = np.zeros_like(structure.mesh.points)
    field[:, 0] = structure.mesh.points[:, 0] * structure.mesh.points[:, 1] ** 2
    seen = structure.gauge_output @ (structure.expansion.T @ field.ravel())
    assert seen == pytest.approx([0.4**2 + 0.6**2 / 12.0 * (1.0 - 1.0 / 100.0)])
    with pytest.raises(InvalidDesignError, match=r"0\.2 m long and 1\.2 m wide, the gauge reaches over"):
        cube("strip.toml", ("width = 0.6", "width = 1.2"))


def test_an_orthotropic_material_follows_its_axes(cube) -> None:
    # Axis 1 along z, axis 2 along x, axis 3 along y.
    wanted = 1e6 * np.array([1.0, -0.3, -0.25]) / 1.3e11
    np.testing.assert_allclose(static_responses(cube("ply.toml"))["p"].strain, wanted, rtol=1e-9)


def test_memory_is_estimated_before_it_is_taken(beam) -> None:
    mesh = beam().mesh
    assert 0.3 * 2**30 < memory_estimate(mesh) < 0.5 * 2**30
    check_memory(mesh)
    with pytest.raises(MeshError, match=r"744 unknowns would take about 0\.\d GiB, but 0\.1 GiB are allowed"):
        check_memory(mesh, 0.1 * 2**30)
