"""Moments, loads on tied nodes and pressures of decks, against beam theory and CalculiX."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import MeshError
from fe.solver_deck.comparison import DeckReport
from fe.solver_deck.conversion import DeckOptions, convert_deck
from fe.solver_deck.linear_model import read_linear_model, real_text
from fe.solver_deck.loads import DeckLoads, read_loads
from fe.solver_deck.shell_sides import ShellSide
from fe.structure.affine import static_responses
from fe.structure.matrix_tables import read_unknowns
from fe.structure.operators import assemble_structure
from tests.calculix_decks import needs_calculix
from tests.refusals import refused

DECKS = Path(__file__).parents[3] / "docs" / "how_to" / "decks"
MODULUS = 7e4
LENGTH, WIDTH, HEIGHT = 200.0, 8.0, 4.0


class Conversion(NamedTuple):
    """A structure file that a deck became, and the report."""

    file: Path
    report: DeckReport

    def displacement(self, load: str) -> FloatArray:
        """Return the outputs [mm] under a load alone."""
        structure = assemble_structure(self.file)
        response = static_responses(structure)[load]
        return np.asarray(1e3 * structure.displacement_output @ response.displacement)


def converted(folder: Path, text: str, *outputs: str) -> Conversion:
    """Return what the deck with a text becomes."""
    out = folder / "out"
    out.mkdir()
    deck = folder / "deck.inp"
    deck.write_text(text)
    return Conversion(
        out / "structure.toml", convert_deck(deck, out, "structure", DeckOptions(outputs=outputs))
    )


def beams(*loads: str, second_leg: bool = False) -> str:
    """Return the deck of a cantilever of ten beams along x, perhaps with a second leg along y.

    The set MIDDLE is its eleventh node, TIP its last one along x.
    """
    nodes = [f"{number},{LENGTH * (number - 1) / 20.0},0.,0." for number in range(1, 22)]
    elements = [f"{i + 1},{2 * i + 1},{2 * i + 2},{2 * i + 3}" for i in range(10)]
    if second_leg:
        nodes += [f"{21 + number},{LENGTH},{25.0 * number},0." for number in range(1, 5)]
    lines = ["*NODE", *nodes, "*ELEMENT, TYPE=B32R, ELSET=BEAM", *elements]
    if second_leg:
        lines += ["*ELEMENT, TYPE=B32R, ELSET=LEG", "11,21,22,23", "12,23,24,25"]
    lines += ["*NSET, NSET=TIP", "21", "*NSET, NSET=MIDDLE", "11"]
    lines += ["*MATERIAL, NAME=METAL", "*ELASTIC", f"{MODULUS},0.", "*DENSITY", "2.7e-9"]
    section = "MATERIAL=METAL, SECTION=RECT"
    lines += [f"*BEAM SECTION, ELSET=BEAM, {section}", f"{WIDTH},{HEIGHT}", "0.,1.,0."]
    if second_leg:
        lines += [f"*BEAM SECTION, ELSET=LEG, {section}", f"{WIDTH},{HEIGHT}", "1.,0.,0."]
    lines += ["*BOUNDARY", "1,1,6", "*STEP", "*STATIC", *loads, "*END STEP"]
    return "\n".join(lines) + "\n"


@needs_calculix
@pytest.mark.parametrize(
    ("direction", "axis", "sign", "width", "height"),
    [(5, 2, -1.0, WIDTH, HEIGHT), (6, 1, 1.0, HEIGHT, WIDTH)],
)
def test_a_moment_bends_a_cantilever_as_beams_do(tmp_path, direction, axis, sign, width, height):
    """The tip moves by M L^2 / (2 E I): up under a moment about z, down under one about y."""
    moment = 40.0
    structure = converted(tmp_path, beams("*CLOAD", f"TIP,{direction},{moment}"), "TIP")
    second_moment = width * height**3 / 12.0
    expected = sign * moment * LENGTH**2 / (2.0 * MODULUS * second_moment)
    assert structure.displacement("moment")[axis] == pytest.approx(expected, rel=1e-3)
    assert structure.report.load_deviations["moment"] < 1e-4


def vector_at_middle(structure: Conversion) -> FloatArray:
    """Return the forces of the load `moment` on the rows of the node MIDDLE."""
    places = read_unknowns(structure.file.parent / "unknowns.dof")
    vector = np.load(structure.file.parent / "moment.npy")
    return np.array([vector[row] for row, (node, _) in enumerate(places) if node == 11])


@needs_calculix
def test_torsion_that_moves_no_node_has_the_sign_of_torsion_that_moves_a_second_leg(tmp_path):
    """CalculiX' displacements tell the sign with a second leg, and say nothing without it."""
    vectors = []
    for second_leg in (False, True):
        folder = tmp_path / str(second_leg)
        folder.mkdir()
        deck = beams("*CLOAD", "MIDDLE,4,70.", second_leg=second_leg)
        structure = converted(folder, deck)
        assert structure.report.load_deviations["moment"] < 1e-4
        vectors.append(vector_at_middle(structure))
    straight, with_leg = vectors
    np.testing.assert_allclose(straight, with_leg, atol=1e-4 * np.abs(with_leg).max())


@needs_calculix
def test_a_moment_acts_where_beams_of_two_directions_meet(tmp_path):
    """CalculiX makes the section of node 21 rigid, with rotations as unknowns."""
    loads = ("*CLOAD", "TIP,4,70.", "TIP,5,-20.")
    report = converted(tmp_path, beams(*loads, second_leg=True)).report
    assert report.load_deviations["moment"] < 1e-4


@needs_calculix
def test_a_moment_acts_on_a_shell(tmp_path):
    text = (DECKS / "stiffened_skin.inp").read_text()
    report = converted(tmp_path, text.replace("TIP, 3, 10.", "TIP, 5, 10.")).report
    assert report.load_deviations["moment"] < 2e-6
    assert report.remarks == []


@needs_calculix
def test_a_moment_on_a_solid_is_left_out_with_a_sentence(tmp_path):
    text = (DECKS / "bolted_joint.inp").read_text()
    _, _, step = text.partition("*CLOAD\n")
    line = step.splitlines()[0]
    node = line.split(",")[0]
    report = converted(tmp_path, text.replace(line, f"{line}\n{node}, 5, 100.")).report
    assert "moment" not in report.load_deviations
    assert any("no rotation on which its moment could act" in text for text in report.remarks)


def tied_blocks(*loads: str) -> str:
    """Return the deck of two cubes, the upper one of two times two elements and tied to the lower.

    The nodes 21 to 29 are the bottom of the upper cube and follow the top of the lower one.
    """
    corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
    lines = ["*NODE"]
    for height, first in ((0.0, 1), (10.0, 5)):
        lines += [f"{first + k},{10.0 * x},{10.0 * y},{height}" for k, (x, y) in enumerate(corners)]
    grid = [(x, y) for y in range(3) for x in range(3)]
    for height, first in ((10.0, 21), (20.0, 31)):
        lines += [f"{first + k},{5.0 * x},{5.0 * y},{height}" for k, (x, y) in enumerate(grid)]
    lines += ["*ELEMENT, TYPE=C3D8, ELSET=LOWER", "1,1,2,3,4,5,6,7,8"]
    lines += ["*ELEMENT, TYPE=C3D8, ELSET=UPPER"]
    for number, corner in enumerate((21, 22, 24, 25), start=2):
        bottom = [corner, corner + 1, corner + 4, corner + 3]
        lines.append(",".join(map(str, [number, *bottom, *(node + 10 for node in bottom)])))
    lines += ["*NSET, NSET=TOP", "31,32,33,34,35,36,37,38,39"]
    lines += ["*SURFACE, NAME=SLAVE", "UPPER,S1", "*SURFACE, NAME=MASTER", "LOWER,S2"]
    lines += ["*SURFACE, NAME=SIDE", "2,S6", "4,S6"]
    lines += ["*TIE, NAME=GLUE, POSITION TOLERANCE=0.1", "SLAVE,MASTER"]
    lines += ["*MATERIAL, NAME=METAL", "*ELASTIC", f"{MODULUS},0.3", "*DENSITY", "2.7e-9"]
    for name in ("LOWER", "UPPER"):
        lines += [f"*SOLID SECTION, ELSET={name}, MATERIAL=METAL"]
    lines += ["*BOUNDARY", "1,1,3", "2,1,3", "3,1,3", "4,1,3"]
    lines += ["*STEP", "*STATIC", *loads, "*END STEP"]
    return "\n".join(lines) + "\n"


@needs_calculix
def test_forces_on_tied_nodes_act_on_the_nodes_they_follow(tmp_path):
    """The middle of the tied face follows the four corners below it to equal parts."""
    structure = converted(tmp_path, tied_blocks("*CLOAD", "25,1,8.", "22,3,-4."))
    assert structure.report.load_deviations["force"] < 2e-6
    places = read_unknowns(structure.file.parent / "unknowns.dof")
    vector = np.load(structure.file.parent / "force.npy")
    forces = {place: force for place, force in zip(places, vector, strict=True) if force}
    expected = {(node, 1): 2.0 for node in (5, 6, 7, 8)} | {(5, 3): -2.0, (6, 3): -2.0}
    assert forces == pytest.approx(expected, rel=1e-9)


@needs_calculix
def test_pressure_on_a_surface_with_tied_nodes_agrees_with_calculix(tmp_path):
    report = converted(tmp_path, tied_blocks("*DSLOAD", "SIDE,P,3.")).report
    assert report.load_deviations["pressure"] < 2e-6
    assert report.frequency_deviation < 2e-6


@needs_calculix
def test_pressure_on_flat_shells_agrees_at_the_usual_tolerance(tmp_path):
    """CalculiX applies it to the bottom of the expanded shell, which squeezes the thickness."""
    text = (DECKS / "stiffened_skin.inp").read_text()
    before, _, _ = text.partition("*STEP")
    step = "*STEP\n*STATIC\n*DLOAD\nSKIN,P,0.01\nBAY,P,0.02\n*END STEP\n"
    assert converted(tmp_path, before + step).report.load_deviations["pressure"] < 2e-6


def quarter_cylinder(load: str) -> str:
    """Return the deck of a quarter of a cylinder, of radius 100 and thickness 4, of S8R.

    It is clamped along one straight edge.
    """
    around, along = 8, 2
    nodes: dict[tuple[int, int], int] = {}
    elements = []
    for i in range(0, 2 * around, 2):
        for j in range(0, 2 * along, 2):
            corners = [(i, j), (i + 2, j), (i + 2, j + 2), (i, j + 2)]
            edges = [(i + 1, j), (i + 2, j + 1), (i + 1, j + 2), (i, j + 1)]
            elements.append([nodes.setdefault(place, len(nodes) + 1) for place in corners + edges])
    lines = ["*NODE"]
    for (i, j), number in nodes.items():
        angle = 0.25 * np.pi * i / around
        x, y = 100.0 * np.cos(angle), 100.0 * np.sin(angle)
        lines.append(f"{number},{x:.12f},{y:.12f},{25.0 * j}")
    lines.append("*ELEMENT, TYPE=S8R, ELSET=SHELL")
    for number, corners in enumerate(elements, start=1):
        lines.append(",".join(map(str, [number, *corners])))
    lines += ["*SURFACE, NAME=INSIDE", "SHELL,SNEG", "*SURFACE, NAME=OUTSIDE", "SHELL,SPOS"]
    lines += ["*MATERIAL, NAME=METAL", "*ELASTIC", f"{MODULUS},0.3", "*DENSITY", "2.7e-9"]
    lines += ["*SHELL SECTION, ELSET=SHELL, MATERIAL=METAL", "4.", "*BOUNDARY"]
    lines += [f"{number},1,6" for (i, _), number in nodes.items() if i == 0]
    lines += ["*STEP", "*STATIC", load, "*END STEP"]
    return "\n".join(lines) + "\n"


@needs_calculix
@pytest.mark.parametrize(
    "load", ["*DLOAD\nSHELL,P,0.1", "*DSLOAD\nINSIDE,P,0.1", "*DSLOAD\nOUTSIDE,P,0.1"]
)
def test_pressure_on_curved_shells_acts_on_the_radius_of_their_side(tmp_path, load):
    """At half the thickness inwards the area is 2 % smaller than at the nodes."""
    assert converted(tmp_path, quarter_cylinder(load)).report.load_deviations["pressure"] < 5e-6


def loads_of(folder: Path, text: str) -> DeckLoads:
    deck = folder / "deck.inp"
    deck.write_text(text)
    return read_loads(read_linear_model(deck))


def test_pressure_on_two_sides_of_a_shell_has_the_force_of_pressure_on_two_circles(tmp_path):
    """Over a quarter of a circle, p r L is the force along x and along y."""
    total = {}
    for name, side in (("INSIDE", ShellSide.BOTTOM), ("OUTSIDE", ShellSide.TOP)):
        (load,) = loads_of(tmp_path, quarter_cylinder(f"*DSLOAD\n{name},P,0.1")).loads
        forces = load.side_forces[side]
        total[name] = [sum(f for (_, a), f in forces.items() if a == axis) for axis in (1, 2)]
    assert total["INSIDE"] == pytest.approx([980.0, 980.0], rel=1e-4)
    assert total["OUTSIDE"] == pytest.approx([-1020.0, -1020.0], rel=1e-4)


def test_an_unknown_surface_is_refused_with_its_line(tmp_path):
    with refused(
        MeshError, r"deck\.inp, line \d+: the name of a \*SURFACE of faces is expected, but 'ROOF'"
    ):
        loads_of(tmp_path, tied_blocks("*DSLOAD", "ROOF,P,3."))


def test_another_load_on_a_surface_is_left_out_with_a_sentence(tmp_path):
    loads = loads_of(tmp_path, tied_blocks("*DSLOAD", "SIDE,TRVEC,3."))
    assert loads.loads == []
    assert loads.remarks[0].endswith("*DSLOAD TRVEC is left out; a pressure P is read")


@pytest.mark.parametrize("value", [0.1, -1.2345678901234567e-11, 6.123233995736766e-15, 3.5e10])
def test_numbers_in_decks_are_short_enough_for_calculix(value):
    assert len(real_text(value)) <= 20
    assert float(real_text(value)) == pytest.approx(value, rel=1e-12)
