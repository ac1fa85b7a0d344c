"""Elements and structures against closed forms, CalculiX and each other; faults of files."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fe.elements.cells import CellMesh
from fe.elements.elasticity import isotropic_compliance
from fe.elements.kinds import KINDS, meshio_with_wedges
from fe.runtime import errors
from fe.structure.affine import static_responses
from fe.structure.design import Gauge, MeshMaterial
from fe.structure.gauges import gauge_rows
from fe.structure.location import attach, on_surface
from fe.structure.mesh import StructureMesh
from fe.structure.mesh_file import memory_estimate, read_mesh
from fe.structure.operators import Structure, load_and_assemble, mass_and_centre, write_structure_vtu
from fe.verification.calculix_comparison import agreement
from fe.verification.calculix_deck import structure_deck
from tests.calculix_decks import needs_calculix
from tests.meshes import box
from tests.refusals import Inputs, refused

PRODUCTS = {  # of coordinates that a kind of element holds, by their powers
    "tetra": (1, 0, 0), "tetra10": (1, 0, 1), "wedge": (1, 0, 1), "wedge15": (1, 0, 2),
    "hexahedron": (1, 1, 1), "hexahedron20": (2, 1, 1),
}  # fmt: skip


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """A writer of a structure file and its mesh; returns the structure file."""

    def make(points: NDArray[np.float64], kind: str, cells: Any, text: str, **sets: Any) -> Path:
        meshio = meshio_with_wedges()
        meshio.write(tmp_path / "mesh.vtu", meshio.Mesh(points, [(kind, cells)], **sets))
        file = tmp_path / "structure.toml"
        file.write_text(text, encoding="utf-8")
        return file

    return make


@pytest.fixture(params=sorted(KINDS))
def distorted(request: pytest.FixtureRequest, write: Callable[..., Path]) -> StructureMesh:
    """A box whose inner nodes are moved; edges stay straight."""
    points, cells = box(request.param, (2, 2, 2))
    kind = KINDS[request.param]
    corners = np.unique(cells[:, : len(kind.corners)])
    moved = points.copy()
    inner = corners[((points[corners] > 0.0) & (points[corners] < 1.0)).all(axis=1)]
    moved[inner] += (0.07, -0.05, 0.06)
    for number, (a, b) in enumerate(kind.edges):
        moved[cells[:, len(kind.corners) + number]] = 0.5 * (moved[cells[:, a]] + moved[cells[:, b]])
    moved = moved * (1.0, 2.0, 0.5)
    return read_mesh(write(moved, request.param, cells, "").parent / "mesh.vtu", 1.0, "m")


def test_patch_test_and_gauges(distorted):
    gradient = 1e-3 * np.array([[1.0, 2.0, -0.5], [0.3, -1.5, 0.8], [0.6, -0.2, 0.9]])
    exact = distorted.points @ gradient.T
    elasticity = np.linalg.inv(isotropic_compliance(7e10, 0.3))
    K = distorted.stiffness(np.arange(len(distorted.cells)), elasticity)
    inner = ((distorted.points > 1e-9) & (distorted.points < np.array([1, 2, 0.5]) - 1e-9)).all(axis=1)
    assert inner.any()
    free = np.repeat(inner, 3)
    found = np.where(free, 0.0, exact.ravel())
    found[free] = np.linalg.solve(K[free][:, free].toarray(), -(K @ found)[free])
    np.testing.assert_allclose(found, exact.ravel(), atol=1e-12 * np.abs(exact).max())
    # The strain of that field along any direction of the surface, with and without a length.
    gauges = (
        Gauge(name="a", point=(0.31, 0.77, 0.5), direction=(1.0, 2.0, 0.0)),
        Gauge(name="b", point=(1.0, 1.2, 0.2), direction=(0.0, 1.0, 1.0), length=0.3),
        Gauge(name="c", point=(0.5, 1.0, 0.0), direction=(1.0, 0.0, 0.0)),  # on a node
    )
    rows, moved = gauge_rows(distorted, gauges)
    np.testing.assert_allclose(moved, 0.0, atol=1e-12)
    for gauge, strain in zip(gauges, rows @ exact.ravel(), strict=True):
        along = np.array(gauge.direction) / np.linalg.norm(gauge.direction)
        assert strain == pytest.approx(along @ gradient @ along, rel=1e-10)


def test_the_mass_of_every_kind_is_exact_for_its_shape_functions(distorted):
    points, cells = box(distorted.kind.file_type, (1, 1, 1))
    mass = CellMesh(distorted.kind, points, cells).mass(np.arange(len(cells)), 1.0)
    power = np.array(PRODUCTS[distorted.kind.file_type])
    field = (points**power).prod(axis=1)
    assert field @ (mass @ field) == pytest.approx((1.0 / (2.0 * power + 1.0)).prod())


def test_a_point_inside_is_found_and_one_outside_on_the_surface(distorted):
    size, random = np.array([1.0, 2.0, 0.5]), np.random.default_rng(1)
    for number, point in enumerate(random.random((12, 3)) * size):
        cell, local = attach(distorted, point, "here")
        assert np.abs(local - 0.5).max() < 0.5 + 1e-9
        places = [(cell, local, point, 1e-12)]
        aside = point.copy()
        aside[[number % 3, number // 3 % 3]] = -0.004  # beside a face or an edge
        found = on_surface(distorted, aside, "here")
        nearest = np.clip(aside, 0.0, size)
        assert found.distance == pytest.approx(np.linalg.norm(aside - nearest))
        places += [(*on_face, nearest, 1e-2) for on_face in zip(found.cell, found.local, strict=True)]
        for cell, local, wanted, tolerance in places:
            values, _ = distorted.kind.shape_functions(local[None])
            np.testing.assert_allclose(values[0] @ distorted.nodes[cell], wanted, atol=tolerance)


# ---------------------------------------------------------------- structures

INPUTS = Inputs(__file__)
INNER, OUTER = 1.0, 2.0
CURVED = ("hexahedron20", "tetra10", "wedge15")
ON_SPRINGS = (
    ('"root", hold = ["x", "y", "z"]',
     '"root", rigid_about = [-5, 10, 3], hold = ["x", "rz"], springs = [0, 2e6, 1e6, 300, 500, 0]'),
    ("point = [31, 11, 10]", "point = [9, 11, 10]"),
    ('name = "push", set = "tip=1"', 'name = "push", set = "root"'),
)  # fmt: skip
MADE = {  # its sets, and what it is of where nothing else is said
    "ring": ("bore all", "hexahedron20", (2, 4, 1)), "cantilever": ("", "hexahedron20", (20, 1, 1)),
    "plate": ("line", "hexahedron", (2, 1, 1)), "body": ("top tip", "hexahedron", (4, 2, 2)),
    "strip": ("x y z top all", "hexahedron20", (1, 1, 1)),
    "ply": ("x y z top all", "hexahedron20", (1, 1, 1)),
}  # fmt: skip


def bent(name: str, kind: str, points: np.ndarray) -> np.ndarray:
    """Points of the unit cube as those of a body; second order edges follow its curves."""
    if name == "ring":  # a quarter of a thick one
        radius, angle = INNER + (OUTER - INNER) * points[:, 0], 0.5 * np.pi * points[:, 1]
        place = np.column_stack((radius * np.cos(angle), radius * np.sin(angle), 0.1 * points[:, 2]))
        return np.where(np.abs(place) < 1e-12, 0.0, place)
    place = points * {"cantilever": (1000, 60, 10), "plate": (20, 10, 10), "body": (100, 25, 10)}.get(name, 1)
    if name == "body" and kind in CURVED:  # in the plane of the top
        place[:, 1] += 12.0 * (place[:, 0] / 100.0) ** 2 * (place[:, 1] / 25.0)
    return place


@pytest.fixture
def made(write) -> Callable[..., Structure]:
    """A maker of a structure on a mesh, with texts exchanged in its file; its sets are masks of nodes."""

    def make(
        name: str, *changes: tuple[str, str], kind: str | None = None, parts: Any = None, **options: bool
    ) -> Structure:
        used, *usual = MADE[name]
        kind, parts = kind or usual[0], parts or usual[1]
        points, cells = box(kind, parts)
        x, y, z = points.T
        sets = {"x": x == 0.0, "y": y == 0.0, "z": z == 0.0, "top": z == 1.0, "all": z >= 0.0}
        sets |= {"bore": x == 0.0, "tip": x == 1.0, "line": x + y == 0.0}
        data = {own: sets[own].astype(np.int64) for own in used.split()}
        text = INPUTS.text(f"{name}.toml", *changes)
        file = write(bent(name, kind, points), kind, cells, text, point_data=data)
        return load_and_assemble(file, **options)

    return make


def ring_of(made: Callable[..., Structure], kind: str, count: int) -> Structure:
    """A quarter of a thick ring in plane strain; cells with straight edges leave its bore."""
    straight = [("0.7071067811865476", "0.70")] * (2 * (kind == "tetra"))
    return made("ring", *straight, kind=kind, parts=(count, 2 * count, 1))


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
def test_a_thick_ring_under_pressure_converges_to_lame(kind, order, error, made):
    # Lame: u(a) = (1 + nu) p a ((1 - 2 nu) a^2 + b^2) / (E (b^2 - a^2)) in plane strain.
    wanted = 1.3 * 1e6 * (0.4 * INNER**2 + OUTER**2) / (1e9 * (OUTER**2 - INNER**2))
    mass = 1000.0 * 0.1 * 0.25 * np.pi * (OUTER**2 - INNER**2)
    errors, lost = [], []
    for count in (2, 4):
        structure = ring_of(made, kind, count)
        found = static_responses(structure)["p"]
        # The work of the pressure converges with twice the order of the strains.
        work = float(structure.load("p") @ found.displacement)
        errors.append(abs(work / (1e6 * wanted * 0.5 * np.pi * INNER * 0.1) - 1.0))
        lost.append(abs(mass_and_centre(structure)[0] / mass - 1.0))
        if kind == "hexahedron20":
            assert found.strain[0] == pytest.approx(wanted / INNER, rel=0.05 / count**2)
    assert errors[1] < error
    assert np.log2(errors[0] / errors[1]) > order
    assert np.log2(lost[0] / lost[1]) > order


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_the_field_of_every_kind_is_written(kind, made, tmp_path):
    structure = ring_of(made, kind, 2)
    write_structure_vtu(tmp_path / "field.vtu", structure)
    found = read_mesh(tmp_path / "field.vtu", 1.0, "m")
    assert found.kind is KINDS[kind]
    np.testing.assert_array_equal(found.cells, structure.mesh.cells)


def test_a_cantilever_has_the_figures_of_a_beam(made):
    structure, length, second = made("cantilever"), 1.0, 0.06 * 0.01**3 / 12.0
    assert 0.3 * 2**30 < memory_estimate(structure.mesh) < 0.5 * 2**30
    stiffness, area_mass = 7e10 * second, 2700.0 * 0.06 * 0.01
    found = static_responses(structure)
    deflection = 2.0 * length**3 / (3.0 * stiffness)
    # Three times the weight of the beam and of the free mass at half its length, which deflects 5/48 there.
    weight = 3.0 * 9.81 * (area_mass / 8.0 + 0.4 * 5.0 / 48.0) / stiffness
    shares = (structure.expansion @ structure.load("tip"))[2::3]
    assert np.unique(shares[shares != 0.0].round(9)) == pytest.approx([-2.0 / 12.0, 2.0 / 3.0])  # of its face
    for name, wanted in (("tip", deflection), ("at_a_point", deflection), ("weight", -weight)):
        assert found[name].output[0] == pytest.approx(wanted, rel=1e-3)
    strain = 2.0 * 0.5 * 0.005 / stiffness
    np.testing.assert_allclose(found["tip"].strain, [-strain, strain], rtol=1e-6)
    mass, centre = mass_and_centre(structure)
    assert mass == pytest.approx(area_mass + 0.4)
    np.testing.assert_allclose(centre, [0.5, 0.03, 0.005], atol=1e-12)


def test_terms_make_what_a_changed_file_makes(made):
    structure = made("cantilever")
    assert [(term.parameter, term.region) for term in structure.stiffness_terms] == [("e", "z1"), ("e", None)]
    outer = '[[set]]\nname = "outer"\nof = "cells"\nbox = [[250, 0, 0], [1000, 60, 10]]\n[[material]]\n'
    outer += (
        'name = "b"\nset = "outer"\ndensity = 2700\nyoung_modulus = 8.4e10\npoisson_ratio = 0\n[[support]]'
    )
    split = made(
        "cantilever",
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
        with pytest.raises(errors.InvalidStateError, match=r"has no (parameter|free mass) named"):
            ask(wrong)


def test_a_gauge_reads_the_mean_over_its_area(made):
    """Of u = x y^2, which the 20-node cell holds exactly: the mean of y^2 over ten strips of the width."""
    structure = made("strip")
    field = np.zeros_like(structure.mesh.points)
    field[:, 0] = structure.mesh.points[:, 0] * structure.mesh.points[:, 1] ** 2
    seen = structure.gauge_output @ (structure.expansion.T @ field.ravel())
    assert seen == pytest.approx([0.4**2 + 0.6**2 / 12.0 * (1.0 - 1.0 / 100.0)])
    with refused(errors.InvalidDesignError, r"0\.2 m long and 1\.2 m wide, the gauge reaches over"):
        made("strip", ("width = 0.6", "width = 1.2"))


def test_an_orthotropic_material_follows_its_axes(made):
    # Axis 1 along z, axis 2 along x, axis 3 along y.
    wanted = 1e6 * np.array([1.0, -0.3, -0.25]) / 1.3e11
    np.testing.assert_allclose(static_responses(made("ply"))["p"].strain, wanted, rtol=1e-9)


def test_an_orthotropic_material_is_softer_between_its_axes():
    # Jones (1999), eq. 2.97: 1 / E_x = c^4 / E_1 + (1 / G_12 - 2 nu_12 / E_1) s^2 c^2 + s^4 / E_2.
    c, s = np.cos(np.radians(30.0)), np.sin(np.radians(30.0))
    ply = MeshMaterial(
        name="ply", density=0.0, axes=((c, s, 0.0), (-s, c, 0.0)), young_moduli=(9e9, 7e9, 5e9),
        poisson_ratios=(0.3, 0.25, 0.2), shear_moduli=(4e9, 3e9, 2e9),
    )  # fmt: skip
    wanted = c**4 / 9e9 + (1.0 / 4e9 - 0.6 / 9e9) * s**2 * c**2 + s**4 / 7e9
    assert np.linalg.inv(ply.elasticity)[0, 0] == pytest.approx(wanted, rel=1e-12)


@needs_calculix
@pytest.mark.parametrize(
    ("kind", "changes"),
    [*((kind, ()) for kind in ("tetra", "hexahedron", *CURVED)), ("hexahedron", ON_SPRINGS)],
)
def test_both_codes_agree(kind, changes, made, tmp_path):
    """The last one stands on a rigid flange, which the push and two gauges near it load, on springs."""
    parts = (4, 2, 1 if kind in CURVED else 2)
    deck = structure_deck(made("body", *changes, kind=kind, parts=parts, mass_as_stiffness=True))
    found = agreement(deck, tmp_path / "ccx", 5)
    assert list(found.loads) == ["weight", "suction", "push"]
    for differences in found.loads.values():
        known = ["nodal displacements", "gauge strains", "displacement outputs"]
        assert list(differences) == known + ["strains at integration points"] * (kind == "hexahedron20")
        assert max(differences.values()) < 1e-5
    assert len(found.ours) == 5
    assert found.modal < 1e-6


def test_wedges_cannot_be_compared(made):
    with pytest.raises(errors.CalculixError, match=r"integrates 6-node wedges \(C3D6\) in another way"):
        structure_deck(made("body", kind="wedge"))


# ---------------------------------------------------------------- its file


def test_the_file_without_a_fault_is_taken_with_its_rosette(made):
    structure = made("plate")
    assert set(static_responses(structure)) == {"weight", "push"}
    assert structure.unknowns == 24
    assert len(structure.design_hash) == 64
    for old, new, same in (
        ("[[support]]", "# a comment\n[[support]]", True),
        ("[[support]]", "[reduction]\ntolerance = 1e-2\n[[support]]", True),  # how well, not what
        ("2700", "2701", False),
    ):
        assert (made("plate", (old, new)).design_hash == structure.design_hash) is same
    # A rosette's strains are those of one plane strain state; beside gauges of their own they come last.
    assert structure.gauges == ("a", "r_a", "r_b", "r_c", "r_d")
    own, first, middle, last, fourth = structure.gauge_output.toarray()
    np.testing.assert_array_equal(own, first)
    half = 0.5 * (2.0 * middle - first - last)
    wanted = 0.25 * first + 0.75 * last + half * np.sin(np.radians(120.0))
    np.testing.assert_allclose(fourth, wanted, atol=1e-12 * np.abs(first).max())


@pytest.mark.parametrize(
    ("name", "old", "new", "sentence"),
    [(name, *row) for name in ("plate", "cantilever") for row in INPUTS.refused(name)],
)
def test_a_fault_is_one_sentence(name, old, new, sentence, made):
    with refused(errors.FiniteElementError, sentence):
        made(name, (old, new))


def test_parts_that_turn_on_a_hinge_cannot_be_solved(write):
    """Two cubes share one edge only: no check of sets sees it, the factorisation does."""
    points, (cube,) = box("hexahedron", (1, 1, 1))
    places = np.concatenate((points[cube], points[cube] + (1.0, 1.0, 0.0)))
    corners, numbers = np.unique(places, axis=0, return_inverse=True)
    file = write(corners, "hexahedron", numbers.reshape(2, 8), INPUTS.text("hinge.toml"))
    with pytest.raises(errors.SolutionError, match=r"some part of the structure is not held|hardly held"):
        static_responses(load_and_assemble(file))
