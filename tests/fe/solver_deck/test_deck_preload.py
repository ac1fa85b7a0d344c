"""Preloaded decks, against the theory of beams under tension and CalculiX' small changes."""

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pytest

from fe.runtime.errors import CalculixError, SolutionError
from fe.solver_deck.comparison import DeckReport
from fe.solver_deck.conversion import DeckOptions, convert_deck
from fe.solver_deck.linear_model import read_linear_model
from fe.solver_deck.regions import choose_regions, with_own_materials
from fe.structure.affine import static_responses
from fe.structure.operators import assemble_structure
from tests.calculix_decks import needs_calculix
from tests.refusals import refused

MODULUS, DENSITY = 7e4, 2.7e-9
LENGTH, WIDTH, HEIGHT = 200.0, 8.0, 4.0
ELEMENTS = 20
FORCE = 3.0
SECOND_MOMENT = WIDTH * HEIGHT**3 / 12.0
STRESS = 60.0
"""Tension of the preload [N/mm2]."""
EULER_STRESS = np.pi**2 * MODULUS * SECOND_MOMENT / (4.0 * LENGTH**2 * WIDTH * HEIGHT)
"""Compression at which the cantilever buckles [N/mm2]."""


def solid_beam(stress: float, *, step: str = "*STEP") -> str:
    """Return the deck of a cantilever of solids along x, with a stress at its end, then a force.

    Poisson's ratio is zero, because beam theory knows no lateral contraction at the clamp.
    """
    number: dict[tuple[float, float, float], int] = {}
    elements = []
    length = LENGTH / ELEMENTS
    corners = [
        (0, 0, 0),
        (1, 0, 0),
        (1, 1, 0),
        (0, 1, 0),
        (0, 0, 1),
        (1, 0, 1),
        (1, 1, 1),
        (0, 1, 1),
    ]
    edges = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4)]
    edges += [(0, 4), (1, 5), (2, 6), (3, 7)]
    mids = [np.add(corners[a], corners[b]) / 2.0 for a, b in edges]
    for i in range(ELEMENTS):
        nodes = []
        for x, y, z in [*corners, *mids]:
            place = (length * (i + x), WIDTH * y, HEIGHT * z)
            nodes.append(number.setdefault(place, len(number) + 1))
        elements.append(nodes)
    lines = ["*NODE", *(f"{n},{x},{y},{z}" for (x, y, z), n in number.items())]
    lines.append("*ELEMENT, TYPE=C3D20, ELSET=BEAM")
    for i, nodes in enumerate(elements, start=1):
        lines += [",".join(map(str, [i, *nodes[:10]])) + ",", ",".join(map(str, nodes[10:]))]
    root = [n for (x, _, _), n in number.items() if x == 0.0]
    tip = [n for (x, _, z), n in number.items() if x == LENGTH and z == HEIGHT / 2.0]
    lines += ["*NSET, NSET=TIP", ",".join(map(str, tip))]
    lines += ["*MATERIAL, NAME=METAL", "*ELASTIC", f"{MODULUS},0.", "*DENSITY", str(DENSITY)]
    lines += ["*SOLID SECTION, ELSET=BEAM, MATERIAL=METAL", "*BOUNDARY"]
    lines += [f"{n},1,3" for n in root]
    lines += [step, "*STATIC", "*DLOAD", f"{ELEMENTS},P4,{-stress}", "*END STEP"]
    lines += ["*STEP, PERTURBATION", "*STATIC", "*CLOAD", f"TIP,3,{FORCE / len(tip)}", "*END STEP"]
    return "\n".join(lines) + "\n"


class Conversion(NamedTuple):
    """A structure file that a deck became, and the report."""

    file: Path
    report: DeckReport

    def tip(self, load: str = "force") -> float:
        """Return the displacement [mm] of the tip under a load alone."""
        structure = assemble_structure(self.file)
        response = static_responses(structure)[load]
        (tip,) = 1e3 * structure.displacement_output @ response.displacement
        return float(tip)


def converted(
    folder: Path, text: str, preload: Literal["tangent", "none"] = "tangent"
) -> Conversion:
    out = folder / "out"
    out.mkdir(parents=True)
    deck = folder / "deck.inp"
    deck.write_text(text)
    options = DeckOptions(outputs=["TIP:z"], preload=preload)
    return Conversion(out / "structure.toml", convert_deck(deck, out, "structure", options))


@pytest.fixture(scope="module")
def tensioned(tmp_path_factory: pytest.TempPathFactory) -> Conversion:
    return converted(tmp_path_factory.mktemp("tensioned"), solid_beam(STRESS))


def tip_under_tension() -> float:
    """Return F (L - tanh(k L) / k) / P, with k^2 = P / (E I), for the tension P at the tip."""
    tension = STRESS * WIDTH * HEIGHT
    wave_number = np.sqrt(tension / (MODULUS * SECOND_MOMENT))
    return float(FORCE / tension * (LENGTH - np.tanh(wave_number * LENGTH) / wave_number))


@needs_calculix
def test_tension_stiffens_a_cantilever_as_it_does_beams(tensioned):
    """Without tension the tip moves by 1.9 times as much."""
    assert tensioned.tip() == pytest.approx(tip_under_tension(), rel=2e-3)


@needs_calculix
def test_a_preloaded_deck_agrees_with_small_changes_by_calculix(tensioned):
    assert tensioned.report.load_deviations["force"] < 2e-6
    assert tensioned.report.frequency_deviation < 2e-6


@needs_calculix
def test_a_preload_with_large_displacements_agrees_with_calculix(tmp_path):
    """The tension lengthens the beam by 0.09 %, which large displacements take into account."""
    structure = converted(tmp_path, solid_beam(STRESS, step="*STEP, NLGEOM"))
    assert structure.tip() == pytest.approx(tip_under_tension(), rel=1e-2)
    assert structure.report.load_deviations["force"] < 2e-6
    assert structure.report.frequency_deviation < 2e-6


@needs_calculix
def test_the_remarks_say_what_of_a_preload_is_constant(tensioned):
    assert tensioned.report.remarks == [
        "the stiffness is that at the end of the preload of 1 step, and stays as it is there",
        "the loads of the preload keep size and direction: they are no loads of the structure",
        "a region loses the stiffness that it has without preload",
    ]


def test_the_copies_of_a_material_of_regions_are_as_plastic_as_the_material(tmp_path):
    """Without it the preload of a region would be elastic, and CalculiX would not tell."""
    deck = tmp_path / "deck.inp"
    deck.write_text(solid_beam(STRESS).replace("*DENSITY", "*PLASTIC\n40.,0.\n80.,0.1\n*DENSITY"))
    model = read_linear_model(deck)
    blocks = with_own_materials(model, choose_regions(model, ["BEAM"]))
    materials = [block.parameters["NAME"] for block in blocks if block.keyword == "MATERIAL"]
    assert materials == ["METAL_UAVR1", "METAL"]
    assert [block.keyword for block in blocks].count("PLASTIC") == len(materials)


@needs_calculix
def test_without_its_preload_a_cantilever_bends_freely(tmp_path):
    structure = converted(tmp_path, solid_beam(STRESS), preload="none")
    expected = FORCE * LENGTH**3 / (3.0 * MODULUS * SECOND_MOMENT)
    assert structure.tip("force_2") == pytest.approx(expected, rel=2e-3)
    assert "preload is left out: the stiffness is that of the unloaded structure" in (
        structure.report.remarks
    )


@needs_calculix
def test_compression_near_buckling_lets_a_region_lose_less(tmp_path):
    """At half of Euler's stress a loss of more than half of the modulus makes it unstable."""
    report = converted(tmp_path, solid_beam(-0.5 * EULER_STRESS)).report
    assert any("stands for a loss of 0.5 of its modulus" in text for text in report.remarks)
    assert report.frequency_deviation < 2e-6


@needs_calculix
def test_compression_lowers_the_first_frequency_by_what_it_takes_of_the_stiffness(tmp_path):
    """By Galloway's rule the square falls by the stress over that of buckling, to some 2 %."""
    squares = {}
    for share in (0.0, 0.5):
        deck = solid_beam(-share * EULER_STRESS)
        structure = converted(tmp_path / str(share), deck)
        squares[share] = structure.report.frequencies[0] ** 2
    assert squares[0.5] / squares[0.0] == pytest.approx(0.5, abs=0.02)


@needs_calculix
def test_a_preload_beyond_buckling_is_refused(tmp_path):
    with refused(SolutionError, "the preload makes the structure unstable|not held|negative"):
        converted(tmp_path, solid_beam(-1.5 * EULER_STRESS))


@needs_calculix
def test_a_preload_on_a_node_of_a_beam_is_refused_with_advice(tmp_path):
    lines = [
        "*NODE",
        "1,0,0,0",
        "2,50,0,0",
        "3,100,0,0",
        "*ELEMENT, TYPE=B32R, ELSET=BEAM",
        "1,1,2,3",
    ]
    lines += [
        "*NSET, NSET=TIP",
        "3",
        "*MATERIAL, NAME=METAL",
        "*ELASTIC",
        "7e4,0.",
        "*DENSITY",
        "2.7e-9",
    ]
    lines += ["*BEAM SECTION, ELSET=BEAM, MATERIAL=METAL, SECTION=RECT", "8.,4.", "0.,1.,0."]
    lines += ["*BOUNDARY", "1,1,6", "*STEP", "*STATIC", "*CLOAD", "3,1,500.", "*END STEP"]
    lines += ["*STEP, PERTURBATION", "*FREQUENCY", "2", "*END STEP"]
    with refused(CalculixError, "leave it out by --preload none"):
        converted(tmp_path, "\n".join(lines) + "\n")
