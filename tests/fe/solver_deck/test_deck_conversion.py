"""Structures that CalculiX makes of decks, against beam theory, other decks and forces by hand."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy import sparse

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import CalculixError
from fe.solver_deck.comparison import DeckReport
from fe.solver_deck.conversion import DeckOptions, convert_deck
from fe.solver_deck.linear_model import read_linear_model
from fe.solver_deck.loads import DeckLoads, read_loads
from fe.solver_deck.shell_sides import ShellSide
from fe.structure.affine import static_responses
from fe.structure.operators import assemble_structure
from fe.verification.calculix_run import run_calculix
from tests.calculix_decks import needs_calculix
from tests.refusals import refused

SKIN_DECK = Path(__file__).parents[3] / "docs" / "how_to" / "decks" / "stiffened_skin.inp"


class Conversion(NamedTuple):
    """A structure file that a deck became, and the report."""

    file: Path
    report: DeckReport

    def matrix(self, name: str) -> sparse.csr_array:
        """Return a matrix beside the structure file."""
        return sparse.load_npz(self.file.parent / f"{name}.npz").tocsr()


def converted(
    deck: Path, folder: Path, regions: Sequence[str] = (), outputs: Sequence[str] = ()
) -> Conversion:
    report = convert_deck(deck, folder, "structure", DeckOptions(regions=regions, outputs=outputs))
    return Conversion(folder / "structure.toml", report)


MODULUS, DENSITY = 7e4, 2.7e-9
LENGTH, WIDTH, HEIGHT = 200.0, 8.0, 4.0
FORCE = 3.0


def cantilever(
    *, density: bool = True, load: bool = True, held: bool = True, kind: str = "B32R"
) -> str:
    """Return the deck of a cantilever of ten beams along x, with a force at its tip.

    Poisson's ratio is zero, because beam theory knows no lateral contraction at the clamp.
    """
    nodes = [f"{number},{LENGTH * (number - 1) / 20.0},0.,0." for number in range(1, 22)]
    elements = [f"{i + 1},{2 * i + 1},{2 * i + 2},{2 * i + 3}" for i in range(10)]
    lines = ["*NODE", *nodes, f"*ELEMENT, TYPE={kind}, ELSET=BEAM", *elements]
    lines += ["*NSET, NSET=TIP", "21", "*MATERIAL, NAME=METAL", "*ELASTIC", f"{MODULUS},0."]
    lines += ["*DENSITY", str(DENSITY)] if density else []
    lines += [
        "*BEAM SECTION, ELSET=BEAM, MATERIAL=METAL, SECTION=RECT",
        f"{WIDTH},{HEIGHT}",
        "0.,1.,0.",
    ]
    lines += ["*BOUNDARY", "1,1,6"] if held else []
    lines += ["*STEP", "*STATIC", "*CLOAD", f"TIP,3,{FORCE}", "*END STEP"] if load else []
    return "\n".join(lines) + "\n"


def written(folder: Path, text: str) -> Path:
    """Return a deck with a text, beside an empty folder `out`."""
    (folder / "out").mkdir()
    deck = folder / "deck.inp"
    deck.write_text(text)
    return deck


@pytest.fixture(scope="module")
def beam(tmp_path_factory: pytest.TempPathFactory) -> Conversion:
    folder = tmp_path_factory.mktemp("cantilever")
    return converted(written(folder, cantilever()), folder / "out", outputs=["TIP:z"])


SECOND_MOMENT = WIDTH * HEIGHT**3 / 12.0


@needs_calculix
def test_the_tip_of_a_cantilever_moves_as_beams_do(beam):
    """Shear, which Euler and Bernoulli leave out, adds 0.6 (h / L)^2 = 0.024 %."""
    structure = assemble_structure(beam.file)
    response = static_responses(structure)["force"]
    (tip,) = structure.displacement_output @ response.displacement
    expected = FORCE * LENGTH**3 / (3.0 * MODULUS * SECOND_MOMENT)
    assert 1e3 * tip == pytest.approx(expected, rel=1e-3)


@needs_calculix
def test_the_first_frequency_of_a_cantilever_is_that_of_beams(beam):
    """Shear and rotary inertia lower it by some 0.03 %."""
    bending = np.sqrt(MODULUS * SECOND_MOMENT / (DENSITY * WIDTH * HEIGHT * LENGTH**4))
    expected = 1.8751041**2 * bending / (2.0 * np.pi)
    assert beam.report.frequencies[0] == pytest.approx(expected, rel=1e-3)


@needs_calculix
def test_the_cantilever_agrees_with_calculix(beam):
    assert beam.report.load_deviations["force"] < 2e-6
    assert beam.report.frequency_deviation < 2e-6


@pytest.fixture(scope="module")
def stiffness_alone(tmp_path_factory: pytest.TempPathFactory) -> Conversion:
    """The cantilever without density and load."""
    folder = tmp_path_factory.mktemp("stiffness_alone")
    return converted(written(folder, cantilever(density=False, load=False)), folder / "out")


@needs_calculix
def test_a_deck_without_density_and_load_is_compared_by_frequencies(stiffness_alone):
    assert stiffness_alone.report.load_deviations == {}
    assert len(stiffness_alone.report.frequencies) == 6
    assert stiffness_alone.report.frequency_deviation < 2e-6


@needs_calculix
def test_a_deck_without_density_has_no_mass_and_says_so(stiffness_alone):
    mass = stiffness_alone.matrix("mass")
    assert mass.nnz == 0 or abs(mass).max() == 0.0
    remark = "the deck has no *DENSITY: the structure has no mass, hence no modes"
    assert remark in stiffness_alone.report.remarks


@needs_calculix
def test_gravity_without_density_is_left_out(tmp_path):
    gravity = "*DLOAD\nBEAM, GRAV, 9810., 0., 0., -1.\n*END STEP"
    deck = written(tmp_path, cantilever(density=False).replace("*END STEP", gravity))
    report = converted(deck, tmp_path / "out").report
    assert list(report.load_deviations) == ["force"]
    assert "the load gravity is left out: the deck has no *DENSITY" in report.remarks


@needs_calculix
def test_a_sentence_names_the_deck_in_place_of_scratch_files(tmp_path):
    deck = written(tmp_path, cantilever())
    with refused(CalculixError, r"^CalculiX took more than 0\.001 s for .*deck\.inp\.$") as caught:
        convert_deck(deck, tmp_path / "out", "structure", DeckOptions(time_limit=1e-3))
    assert str(tmp_path / "out") not in str(caught.value)


@needs_calculix
def test_a_fault_that_calculix_finds_is_cited_with_its_line(tmp_path):
    text = cantilever().replace("1,1,2,3\n", "1,1,2,99\n", 1)
    deck = written(tmp_path, text)
    with refused(CalculixError, r"deck\.inp.*CalculiX did not finish: \*ERROR"):
        converted(deck, tmp_path / "out")


@pytest.fixture(scope="module")
def skin(tmp_path_factory: pytest.TempPathFactory) -> Conversion:
    """The stiffened skin, in which each set with a section is a region."""
    return converted(SKIN_DECK, tmp_path_factory.mktemp("skin"))


def largest(matrix: sparse.sparray) -> float:
    return float(abs(matrix).max())


@needs_calculix
def test_the_stiffness_of_all_regions_is_that_of_the_whole(skin):
    whole = skin.matrix("stiffness")
    regions = [skin.matrix(region.name) for region in skin.report.regions]
    assert [region.set_name for region in skin.report.regions] == ["SKIN", "BAY", "STIFFENER"]
    assert largest(whole - sum(regions[1:], regions[0])) < 1e-11 * largest(whole)


@needs_calculix
def test_twice_the_modulus_doubles_the_stiffness_of_a_region(skin, tmp_path):
    """The deck in which the bay has another material is written by hand."""
    section = "*SHELL SECTION, ELSET=BAY, MATERIAL="
    text = SKIN_DECK.read_text()
    assert "70000., 0.33" in text
    assert f"{section}ALUMINIUM" in text
    stiff = "*MATERIAL, NAME=STIFF\n*ELASTIC\n140000., 0.33\n*DENSITY\n2.7e-9\n"
    text = text.replace(f"{section}ALUMINIUM", f"{stiff}{section}STIFF")
    before_steps, _, _ = text.partition("*STEP")
    run_calculix(
        f"{before_steps}*STEP\n*FREQUENCY, SOLVER=MATRIXSTORAGE\n*END STEP\n", tmp_path, "stiff"
    )
    doubled = stored_matrix(tmp_path / "stiff.sti")
    bay = skin.matrix("z_bay")
    assert largest(doubled - skin.matrix("stiffness") - bay) < 1e-9 * largest(bay)


def stored_matrix(file: Path) -> sparse.csr_array:
    """Return a matrix that CalculiX stored as its lower or upper half."""
    rows, columns, values = np.loadtxt(file, unpack=True)
    places = (rows.astype(int) - 1, columns.astype(int) - 1)
    half = sparse.coo_array((values, places)).tocsr()
    return (half + half.T - sparse.diags_array(half.diagonal())).tocsr()


CUBE = """*NODE
1,0,0,0
2,2,0,0
3,2,3,0
4,0,3,0
5,0,0,1
6,2,0,1
7,2,3,1
8,0,3,1
9,9,9,9
*ELEMENT, TYPE=C3D8, ELSET=CUBE
1,1,2,3,4,5,6,7,8
*MATERIAL, NAME=METAL
*ELASTIC
70000,0.3
*SOLID SECTION, ELSET=CUBE, MATERIAL=METAL
*STEP
*STATIC
*DLOAD
CUBE,P2,5.
*END STEP
"""


def loads_of(folder: Path, *change: str) -> DeckLoads:
    """Return the loads of the cube, whose text is changed."""
    return read_loads(read_linear_model(written(folder, CUBE.replace(*change) if change else CUBE)))


def total_force(loads: DeckLoads) -> FloatArray:
    """Return the sum (3,) of the nodal forces of all loads."""
    total = np.zeros(3)
    for load in loads.loads:
        for (_, axis), force in load.forces.items():
            total[axis - 1] += force
    return total


def test_pressure_on_a_face_of_a_solid_pushes_inwards(tmp_path):
    """The second face is the top: 5 N/mm2 on 6 mm2."""
    assert total_force(loads_of(tmp_path)) == pytest.approx([0.0, 0.0, -30.0])


def test_pressure_on_a_shell_pushes_along_its_normal(tmp_path):
    text = CUBE.replace(
        "TYPE=C3D8, ELSET=CUBE\n1,1,2,3,4,5,6,7,8", "TYPE=S4, ELSET=CUBE\n1,1,2,3,4"
    )
    loads = read_loads(read_linear_model(written(tmp_path, text.replace("CUBE,P2", "CUBE,P"))))
    (load,) = loads.loads
    forces = load.side_forces[ShellSide.BOTTOM]
    assert sum(force for (_, axis), force in forces.items() if axis == 3) == pytest.approx(30.0)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("7,8\n", "7,8,9\n", "an element C3D8 has 8 nodes, but one here has 9"),
        (
            "CUBE,P2",
            "CUBE,P7",
            "a load P7 on elements C3D8 is left out: they have the faces 1 to 6",
        ),
        ("CUBE,P2", "CUBE,P0", "a load P0 on elements C3D8 is left out"),
        ("C3D8,", "C3D8Q,", "a load P2 on elements C3D8Q is left out"),
    ],
)
def test_a_pressure_that_is_not_read_is_left_out_with_a_sentence(tmp_path, old, new, sentence):
    loads = loads_of(tmp_path, old, new)
    assert loads.loads == []
    (remark,) = loads.remarks
    assert sentence in remark
