"""Structures against closed forms, CalculiX and each other; faults of their files."""

from dataclasses import dataclass

import numpy as np
import pytest

from fe.elements.kinds import KINDS
from fe.runtime import errors
from fe.runtime.arrays import FloatArray
from fe.structure.affine import static_responses
from fe.structure.design import MeshMaterial
from fe.structure.mesh_file import memory_estimate, read_mesh
from fe.structure.operators import (
    load_and_assemble,
    mass_and_centre,
    write_structure_vtu,
)
from fe.verification.calculix_comparison import agreement
from fe.verification.calculix_deck import structure_deck
from tests.calculix_decks import needs_calculix
from tests.fe.structure.bodies import CURVED_KINDS, RING_INNER, RING_OUTER
from tests.meshes import box
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)

# ---------------------------------------------------------------- a ring under pressure

PRESSURE = 1e6
# Lame: u(a) = (1 + nu) p a ((1 - 2 nu) a^2 + b^2) / (E (b^2 - a^2)) in plane strain, nu = 0.3.
BORE_DISPLACEMENT = (
    1.3
    * PRESSURE
    * RING_INNER
    * (0.4 * RING_INNER**2 + RING_OUTER**2)
    / (1e9 * (RING_OUTER**2 - RING_INNER**2))
)
RING_MASS = 1000.0 * 0.1 * 0.25 * np.pi * (RING_OUTER**2 - RING_INNER**2)
BORE_AREA = 0.5 * np.pi * RING_INNER * 0.1


def make_ring(make_structure, kind, count):
    """Return a quarter of a thick ring in plane strain, with `count` cells along its radius."""
    changes = []
    if kind == "tetra":  # straight edges leave the bore: the gauge is moved to them along x and y
        changes = [("0.7071067811865476", "0.70")] * 2
    return make_structure("ring", *changes, kind=kind, divisions=(count, 2 * count, 1))


@dataclass(frozen=True)
class RingAccuracy:
    """Errors of a ring on two meshes, and what is wanted.

    Attributes
    ----------
    coarse_work, fine_work : float
        Relative errors of the work of the pressure.
    coarse_mass, fine_mass : float
        Relative errors of the mass.
    least_order, largest_error : float
        The order of convergence, and the error of the work on the fine mesh.
    """

    coarse_work: float
    fine_work: float
    coarse_mass: float
    fine_mass: float
    least_order: float
    largest_error: float


def ring_errors(structure):
    """Return the relative errors of work and mass."""
    response = static_responses(structure)["p"]
    work = float(structure.load("p") @ response.displacement)
    mass, _ = mass_and_centre(structure)
    work_error = abs(work / (PRESSURE * BORE_DISPLACEMENT * BORE_AREA) - 1.0)
    return work_error, abs(mass / RING_MASS - 1.0)


@pytest.fixture(
    scope="module",
    params=[
        ("hexahedron", 1.7, 2e-2),
        ("tetra", 1.6, 5e-2),
        ("tetra10", 3.7, 1e-4),
        ("hexahedron20", 3.7, 1e-4),
        ("wedge15", 3.5, 1e-4),
    ],
    ids=lambda parameters: parameters[0],
)
def ring_accuracy(request, make_structure):
    kind, least_order, largest_error = request.param
    coarse_work, coarse_mass = ring_errors(make_ring(make_structure, kind, 2))
    fine_work, fine_mass = ring_errors(make_ring(make_structure, kind, 4))
    return RingAccuracy(coarse_work, fine_work, coarse_mass, fine_mass, least_order, largest_error)


def test_a_thick_ring_under_pressure_converges_to_lame(ring_accuracy):
    """The work of the pressure converges with twice the order of the strains."""
    order = np.log2(ring_accuracy.coarse_work / ring_accuracy.fine_work)

    assert ring_accuracy.fine_work < ring_accuracy.largest_error
    assert order > ring_accuracy.least_order


def test_the_mass_of_a_thick_ring_converges(ring_accuracy):
    order = np.log2(ring_accuracy.coarse_mass / ring_accuracy.fine_mass)

    assert order > ring_accuracy.least_order


@pytest.mark.parametrize("count", [2, 4])
def test_the_strain_at_the_bore_converges_to_lame(make_structure, count):
    structure = make_ring(make_structure, "hexahedron20", count)

    strain = static_responses(structure)["p"].strain[0]

    assert strain == pytest.approx(BORE_DISPLACEMENT / RING_INNER, rel=0.05 / count**2)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_the_field_of_every_kind_is_written(kind, make_structure, tmp_path):
    structure = make_ring(make_structure, kind, 2)

    write_structure_vtu(tmp_path / "field.vtu", structure)

    mesh = read_mesh(tmp_path / "field.vtu", 1.0, "m")
    assert mesh.kind is KINDS[kind]
    np.testing.assert_array_equal(mesh.cells, structure.mesh.cells)


# ---------------------------------------------------------------- a cantilever

LENGTH = 1.0
BENDING_STIFFNESS = 7e10 * 0.06 * 0.01**3 / 12.0
MASS_PER_LENGTH = 2700.0 * 0.06 * 0.01
FREE_MASS = 0.4
"""At half the length [kg]."""
TIP_DEFLECTION = 2.0 * LENGTH**3 / (3.0 * BENDING_STIFFNESS)
"""Under 2 N at the tip [m]."""
# Three times the weight of the beam and of the free mass at half its length, which deflects the
# tip by 5/48.
WEIGHT_DEFLECTION = (
    3.0 * 9.81 * (MASS_PER_LENGTH / 8.0 + FREE_MASS * 5.0 / 48.0) / BENDING_STIFFNESS
)


@pytest.fixture(scope="module")
def cantilever(make_structure):
    return make_structure("cantilever")


@pytest.fixture(scope="module")
def cantilever_responses(cantilever):
    return static_responses(cantilever)


def test_the_memory_of_a_cantilever_is_estimated(cantilever):
    assert 0.3 * 2**30 < memory_estimate(cantilever.mesh) < 0.5 * 2**30


@pytest.mark.parametrize(
    ("load", "deflection"),
    [("tip", TIP_DEFLECTION), ("at_a_point", TIP_DEFLECTION), ("weight", -WEIGHT_DEFLECTION)],
)
def test_a_cantilever_has_the_deflection_of_a_beam(cantilever_responses, load, deflection):
    assert cantilever_responses[load].output[0] == pytest.approx(deflection, rel=1e-3)


def test_a_cantilever_has_the_strains_of_a_beam(cantilever_responses):
    strain = 2.0 * 0.5 * 0.005 / BENDING_STIFFNESS

    np.testing.assert_allclose(cantilever_responses["tip"].strain, [-strain, strain], rtol=1e-6)


def test_a_force_is_spread_over_a_face_as_its_shape_functions(cantilever):
    """Corners of an 8-node face take -1/12, middles 1/3."""
    forces = (cantilever.expansion @ cantilever.load("tip"))[2::3]

    of_face = np.unique(forces[forces != 0.0].round(9))
    assert of_face == pytest.approx([-2.0 / 12.0, 2.0 / 3.0])


def test_a_cantilever_has_the_mass_of_a_beam_and_its_free_mass(cantilever):
    mass, centre = mass_and_centre(cantilever)

    assert mass == pytest.approx(MASS_PER_LENGTH + FREE_MASS)
    np.testing.assert_allclose(centre, [0.5, 0.03, 0.005], atol=1e-12)


# ---------------------------------------------------------------- terms of parameters and damage

OUTER_MATERIAL = (
    '[[set]]\nname = "outer"\nof = "cells"\nbox = [[250, 0, 0], [1000, 60, 10]]\n'
    '[[material]]\nname = "b"\nset = "outer"\ndensity = 2700\nyoung_modulus = 8.4e10\n'
    "poisson_ratio = 0\n[[support]]"
)


@pytest.fixture(scope="module")
def two_materials(make_structure):
    """The cantilever at e = 1.2 and z1 = 0.3, with these values written into its file."""
    return make_structure(
        "cantilever",
        ('scaled_by = "e"\n', 'set = "inner"\nscaled_by = "e"\n'),
        ("young_modulus = 7e10", "young_modulus = 5.88e10"),  # 1.2 (1 - 0.3) 7e10
        ("[[support]]", OUTER_MATERIAL),
        ("free = true", "free = false"),
    )


def names_of_terms(structure):
    return [(term.parameter, term.region) for term in structure.stiffness_terms]


def test_each_region_and_parameter_has_a_term(cantilever, two_materials):
    assert names_of_terms(cantilever) == [("e", "z1"), ("e", None)]
    assert names_of_terms(two_materials) == [("e", "z1"), (None, None)]


@pytest.mark.parametrize("losses", [{"z1": 0.3}, (0.3,)], ids=["by name", "in order"])
def test_terms_make_the_stiffness_that_a_changed_file_makes(cantilever, two_materials, losses):
    stiffness = cantilever.stiffness({"e": 1.2}, losses)

    difference = abs(stiffness - two_materials.stiffness()).max()
    assert difference < 1e-12 * abs(stiffness).max()


def test_a_material_may_have_several_sets(cantilever, make_structure):
    outer = (
        '[[set]]\nname = "outer"\nof = "cells"\nbox = [[250, 0, 0], [1000, 60, 10]]\n[[support]]'
    )
    both = make_structure(
        "cantilever",
        ('scaled_by = "e"\n', 'set = ["inner", "outer"]\nscaled_by = "e"\n'),
        ("[[support]]", outer),
    )
    assert abs(both.stiffness() - cantilever.stiffness()).max() == 0.0


def test_a_stiffness_loss_is_that_of_a_damage_region(cantilever, make_structure):
    loss = '[[stiffness_loss]]\nset = "inner"\nfraction = 0.3\n[[support]]'
    softer = make_structure("cantilever", ("[[support]]", loss))
    expected = cantilever.stiffness(None, {"z1": 0.3})
    assert abs(softer.stiffness() - expected).max() < 1e-12 * abs(expected).max()


def test_a_free_mass_makes_the_mass_that_a_fixed_one_makes(cantilever, two_materials):
    mass = cantilever.mass()

    assert abs(mass - two_materials.mass()).max() < 1e-14 * abs(mass).max()


def test_a_free_mass_makes_the_weight_that_a_fixed_one_makes(cantilever, two_materials):
    weight = cantilever.load("weight")

    np.testing.assert_allclose(weight, two_materials.load("weight"), atol=1e-12)
    np.testing.assert_allclose(cantilever.load("weight", 1.0), weight / 3.0)


def test_an_unknown_parameter_is_refused(cantilever):
    with pytest.raises(errors.InvalidStateError, match=r"has no parameter named"):
        cantilever.stiffness({"f": 1.0})


def test_an_unknown_free_mass_is_refused(cantilever):
    with pytest.raises(errors.InvalidStateError, match=r"has no free mass named"):
        cantilever.mass({"z1": 1.0})


# ---------------------------------------------------------------- gauges and materials


def test_a_gauge_reads_the_mean_over_its_area(make_structure):
    """Of u = x y^2, which the 20-node cell holds exactly.

    It is the mean of y^2 over ten strips of the width.
    """
    structure = make_structure("strip")
    x, y, z = structure.mesh.points.T
    field = np.column_stack((x * y**2, 0.0 * y, 0.0 * z))

    strain = structure.gauge_output @ (structure.expansion.T @ field.ravel())

    mean = 0.4**2 + 0.6**2 / 12.0 * (1.0 - 1.0 / 100.0)
    assert strain == pytest.approx([mean])


def test_a_gauge_wider_than_its_surface_is_refused(make_structure):
    sentence = r"0\.2 m long and 1\.2 m wide, the gauge reaches over"

    with refused(errors.InvalidDesignError, sentence):
        make_structure("strip", ("width = 0.6", "width = 1.2"))


def test_an_orthotropic_material_follows_its_axes(make_structure):
    """Axis 1 is along z, axis 2 along x, axis 3 along y."""
    strain = static_responses(make_structure("ply"))["p"].strain

    expected = 1e6 * np.array([1.0, -0.3, -0.25]) / 1.3e11
    np.testing.assert_allclose(strain, expected, rtol=1e-9)


def test_an_orthotropic_material_is_softer_between_its_axes():
    """Jones (1999), eq. 2.97.

    1 / E_x = c^4 / E_1 + (1 / G_12 - 2 nu_12 / E_1) s^2 c^2 + s^4 / E_2.
    """
    c = np.cos(np.radians(30.0))
    s = np.sin(np.radians(30.0))

    ply = MeshMaterial(
        name="ply",
        density=0.0,
        axes=((c, s, 0.0), (-s, c, 0.0)),
        young_moduli=(9e9, 7e9, 5e9),
        poisson_ratios=(0.3, 0.25, 0.2),
        shear_moduli=(4e9, 3e9, 2e9),
    )

    compliance = np.linalg.inv(ply.elasticity)
    expected = c**4 / 9e9 + (1.0 / 4e9 - 0.6 / 9e9) * s**2 * c**2 + s**4 / 7e9
    assert compliance[0, 0] == pytest.approx(expected, rel=1e-12)


# ---------------------------------------------------------------- CalculiX

ON_SPRINGS = (
    (
        '"root", hold = ["x", "y", "z"]',
        '"root", rigid_about = [-5, 10, 3], hold = ["x", "rz"], '
        "springs = [0, 2e6, 1e6, 300, 500, 0]",
    ),
    ("point = [31, 11, 10]", "point = [9, 11, 10]"),
    ('name = "push", set = "tip=1"', 'name = "push", set = "root"'),
)
"""A rigid flange on springs, which the push and two gauges near it load."""


@dataclass(frozen=True)
class CalculixCase:
    """A body that CalculiX solves, too."""

    kind: str
    changes: tuple[tuple[str, str], ...] = ()


CALCULIX_CASES = {kind: CalculixCase(kind) for kind in ("tetra", "hexahedron", *CURVED_KINDS)} | {
    "on springs": CalculixCase("hexahedron", ON_SPRINGS)
}


@pytest.fixture(scope="module", params=CALCULIX_CASES)
def calculix_case(request):
    return CALCULIX_CASES[request.param]


@pytest.fixture(scope="module")
def differences(calculix_case, make_structure, tmp_path_factory):
    """Differences between the body and CalculiX."""
    cells_up = 1 if calculix_case.kind in CURVED_KINDS else 2
    body = make_structure(
        "body",
        *calculix_case.changes,
        kind=calculix_case.kind,
        divisions=(4, 2, cells_up),
        mass_as_stiffness=True,
    )
    return agreement(structure_deck(body), tmp_path_factory.mktemp("body") / "ccx", 5)


@needs_calculix
def test_all_loads_and_places_are_compared_with_calculix(calculix_case, differences):
    places = ["nodal displacements", "gauge strains", "displacement outputs"]
    if calculix_case.kind == "hexahedron20":
        places.append("strains at integration points")

    assert list(differences.loads) == ["weight", "suction", "push"]
    for of_load in differences.loads.values():
        assert list(of_load) == places


@needs_calculix
def test_statics_of_a_body_agree_with_calculix(differences):
    for load, of_load in differences.loads.items():
        assert max(of_load.values()) < 1e-5, load


@needs_calculix
def test_frequencies_of_a_body_agree_with_calculix(differences):
    assert len(differences.ours) == 5
    assert differences.modal < 1e-6


def test_wedges_cannot_be_compared(make_structure):
    sentence = r"integrates 6-node wedges \(C3D6\) in another way"

    with pytest.raises(errors.CalculixError, match=sentence):
        structure_deck(make_structure("body", kind="wedge"))


# ---------------------------------------------------------------- its file


@pytest.fixture(scope="module")
def plate(make_structure):
    return make_structure("plate")


def test_a_file_without_a_fault_is_taken(plate):
    assert set(static_responses(plate)) == {"weight", "push"}
    assert plate.unknowns == 24
    assert len(plate.design_hash) == 64


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("[[support]]", "# a comment\n[[support]]"),
        ("[[support]]", "[reduction]\ntolerance = 1e-2\n[[support]]"),
    ],
    ids=["comment", "how well it is reduced"],
)
def test_what_is_not_the_structure_leaves_the_hash(make_structure, plate, old, new):
    assert make_structure("plate", (old, new)).design_hash == plate.design_hash


def test_another_density_is_another_hash(make_structure, plate):
    assert make_structure("plate", ("2700", "2701")).design_hash != plate.design_hash


@dataclass(frozen=True)
class RosetteRows:
    """Rows of a gauge at 0 degrees, and of a rosette at its place at 0, 45, 90 and 60 degrees."""

    gauge: FloatArray
    along: FloatArray
    diagonal: FloatArray
    across: FloatArray
    oblique: FloatArray


@pytest.fixture(scope="module")
def rosette(plate):
    return RosetteRows(*plate.gauge_output.toarray())


def test_rosettes_come_behind_gauges(plate):
    assert plate.gauges == ("a", "r_a", "r_b", "r_c", "r_d")


def test_the_first_grid_of_a_rosette_is_a_gauge(rosette):
    np.testing.assert_array_equal(rosette.along, rosette.gauge)


def test_strains_of_a_rosette_are_those_of_one_plane_strain_state(rosette):
    """The strain at 60 degrees by Mohr's circle."""
    half_shear = 0.5 * (2.0 * rosette.diagonal - rosette.along - rosette.across)

    expected = 0.25 * rosette.along + 0.75 * rosette.across + half_shear * np.sin(np.radians(120.0))
    tolerance = 1e-12 * np.abs(rosette.along).max()
    np.testing.assert_allclose(rosette.oblique, expected, atol=tolerance)


@pytest.mark.parametrize(
    ("name", "old", "new", "sentence"),
    [(name, *row) for name in ("plate", "cantilever") for row in INPUTS.refused(name)],
)
def test_a_fault_is_one_sentence(name, old, new, sentence, make_structure):
    with refused(errors.FiniteElementError, sentence):
        make_structure(name, (old, new))


def test_bodies_that_turn_on_a_hinge_cannot_be_solved(write_structure):
    """Two cubes share one edge only: no check of sets sees it, the factorisation does."""
    points, (cube,) = box("hexahedron", (1, 1, 1))
    two_cubes = np.concatenate((points[cube], points[cube] + (1.0, 1.0, 0.0)))
    corners, numbers = np.unique(two_cubes, axis=0, return_inverse=True)
    file = write_structure(corners, "hexahedron", numbers.reshape(2, 8), INPUTS.text("hinge.toml"))
    structure = load_and_assemble(file)

    sentence = r"some part of the structure is not held|hardly held"
    with pytest.raises(errors.SolutionError, match=sentence):
        static_responses(structure)
