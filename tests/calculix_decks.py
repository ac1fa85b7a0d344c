"""Decks of shells and beams as a user of CalculiX writes them, solved by it and stored as matrices."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from fe.verification.calculix_comparison import calculix_program, read_frequencies, read_tables, run_calculix
from tests.refusals import Inputs

FloatArray = NDArray[np.float64]
Point = tuple[float, float, float]

needs_calculix = pytest.mark.skipif(
    calculix_program() is None,
    reason="CalculiX (ccx) is not installed; on Debian and Ubuntu: apt-get install calculix-ccx",
)


class Deck(NamedTuple):
    """A model in mm, N and t, and the numbers of its nodes by their places."""

    lines: list[str]
    node: dict[Point, int]
    held: list[int]


class _Nodes(dict[Point, int]):
    def number(self, place: FloatArray) -> int:
        x, y, z = (round(float(value), 6) for value in place)
        return self.setdefault((x, y, z), len(self) + 1)


def _deck(
    nodes: _Nodes, elements: dict[str, list[list[int]]], kind: str, rest: Iterable[str], held: list[int]
) -> Deck:
    lines = ["*NODE, NSET=NALL", *(f"{n},{x},{y},{z}" for (x, y, z), n in nodes.items())]
    count = 0
    for name, members in elements.items():
        lines.append(f"*ELEMENT, TYPE={kind}, ELSET={name}")
        for own in members:
            count += 1
            lines.append(",".join(map(str, (count, *own))))
    return Deck([*lines, *rest, "*BOUNDARY", *(f"{number},1,6" for number in held)], nodes, held)


def _material(name: str, factor: float) -> list[str]:
    return [f"*MATERIAL, NAME={name}", "*ELASTIC", f"{7e4 * factor!r},0.3", "*DENSITY", "2.7e-9"]


def stiffened_skin(*, skin: float = 1.0, patch: float = 1.0) -> Deck:
    """A skin of 300 x 200 x 4 mm with an upright web along its middle, clamped at x = 0.

    `patch` is times the modulus of a patch of the skin, `skin` of the rest of it.
    """
    nodes = _Nodes()
    elements: dict[str, list[list[int]]] = {"SKIN": [], "PATCH": [], "WEB": []}

    def quad(corner: Point, along: Point, across: Point) -> list[int]:
        first, a, b = np.array(corner), np.array(along), np.array(across)
        middles = a / 2, a + b / 2, a / 2 + b, b / 2
        return [nodes.number(first + part) for part in (0 * a, a, a + b, b, *middles)]

    for i in range(6):
        for j in range(4):
            name = "PATCH" if i in (1, 2) and j < 2 else "SKIN"
            elements[name].append(quad((50.0 * i, 50.0 * j, 0.0), (50.0, 0.0, 0.0), (0.0, 50.0, 0.0)))
        elements["WEB"].append(quad((50.0 * i, 100.0, 0.0), (50.0, 0.0, 0.0), (0.0, 0.0, 20.0)))
    rest: list[str] = []
    for name, factor in (("SKIN", skin), ("PATCH", patch), ("WEB", 1.0)):
        rest += [*_material(name, factor), f"*SHELL SECTION, ELSET={name}, MATERIAL={name}", "4."]
    root = [number for place, number in nodes.items() if place[0] == 0.0]
    return _deck(nodes, elements, "S8R", rest, root)


def frame(*, skin: float = 1.0, patch: float = 1.0) -> Deck:
    """A portal of 600 x 400 mm with an arm out of its plane, of beams 30 x 20 mm, clamped at its feet.

    `patch` is times the modulus of the first column, `skin` of the other beams.
    """
    nodes = _Nodes()
    elements: dict[str, list[list[int]]] = {}
    members = {
        "PATCH": ((0.0, 0.0, 0.0), (0.0, 0.0, 400.0)),
        "TOP": ((0.0, 0.0, 400.0), (600.0, 0.0, 400.0)),
        "COLUMN": ((600.0, 0.0, 400.0), (600.0, 0.0, 0.0)),
        "ARM": ((600.0, 0.0, 400.0), (600.0, 300.0, 400.0)),
    }
    rest: list[str] = []
    for name, (start, end) in members.items():
        places = np.linspace(start, end, 9)
        numbers = [nodes.number(place) for place in places]
        elements[name] = [numbers[i : i + 3] for i in range(0, 8, 2)]
        normal = "1.,0.,0." if name == "ARM" else "0.,1.,0."
        rest += _material(name, patch if name == "PATCH" else skin)
        rest += [f"*BEAM SECTION, ELSET={name}, MATERIAL={name}, SECTION=RECT", "30.,20.", normal]
    return _deck(nodes, elements, "B32", rest, [nodes[0.0, 0.0, 0.0], nodes[600.0, 0.0, 0.0]])


def solved(deck: Deck, folder: Path, forces: Iterable[tuple[int, Point]]) -> list[dict[int, FloatArray]]:
    """Displacements (3,) [mm] of all nodes under a force [N] at each of some nodes, by CalculiX."""
    lines = list(deck.lines)
    for node, force in forces:
        lines += ["*STEP", "*STATIC", "*CLOAD, OP=NEW"]
        lines += [f"{node},{axis},{value}" for axis, value in enumerate(force, start=1) if value]
        lines += ["*NODE PRINT, NSET=NALL", "U", "*END STEP"]
    tables = read_tables(run_calculix("\n".join(lines) + "\n", folder, "static"))
    return [{int(row[0]): row[1:] for row in rows} for rows in tables["NALL"]]


def frequencies(deck: Deck, folder: Path) -> FloatArray:
    """Lowest six frequencies [Hz] by CalculiX."""
    text = "\n".join([*deck.lines, "*STEP", "*FREQUENCY", "6", "*END STEP"]) + "\n"
    return read_frequencies(run_calculix(text, folder, "modes"))[:6]


def write_structure(folder: Path, build: Callable[..., Deck], tables: str) -> Path:
    """Store the whole structure, with half of `skin` and with half of `patch`, and write its file.

    Its parameter e scales skin and patch, and the patch may lose its stiffness; `tables` are what loads and
    reads it.
    """
    for name, factors in (("whole", {}), ("skin_half", {"skin": 0.5}), ("patch_half", {"patch": 0.5})):
        step = ["*STEP", "*FREQUENCY, SOLVER=MATRIXSTORAGE", "*END STEP"]
        run_calculix("\n".join([*build(**factors).lines, *step]) + "\n", folder, name)
    file = folder / "structure.toml"
    file.write_text(Inputs(__file__).text("stored.toml") + tables, encoding="utf-8")
    return file
