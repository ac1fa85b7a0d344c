"""A deck of shells as a user of CalculiX writes it, solved by it and stored as matrices."""

import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from fe.runtime.arrays import FloatArray
from fe.verification.calculix_run import calculix_program, read_frequencies, read_tables, run_calculix
from tests.refusals import Inputs

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


def stiffened_skin(*, skin: float = 1.0, patch: float = 1.0) -> Deck:
    """A skin of 300 x 200 x 4 mm with an upright web along its middle, clamped at x = 0.

    `patch` is times the modulus of a patch of the skin, `skin` of the rest of it.
    """
    nodes, number = dict[Point, int](), itertools.count(1)
    elements: dict[str, list[list[int]]] = {"SKIN": [], "PATCH": [], "WEB": []}

    def quad(corner: Point, along: Point, across: Point) -> list[int]:
        first, a, b = np.array(corner), np.array(along), np.array(across)
        parts = 0 * a, a, a + b, b, a / 2, a + b / 2, a / 2 + b, b / 2
        places: list[Point] = [tuple((first + part).tolist()) for part in parts]
        return [nodes.setdefault(place, len(nodes) + 1) for place in places]

    for i in range(6):
        for j in range(4):
            name = "PATCH" if i in (1, 2) and j < 2 else "SKIN"
            elements[name].append(quad((50.0 * i, 50.0 * j, 0.0), (50.0, 0.0, 0.0), (0.0, 50.0, 0.0)))
        elements["WEB"].append(quad((50.0 * i, 100.0, 0.0), (50.0, 0.0, 0.0), (0.0, 0.0, 20.0)))
    lines = ["*NODE, NSET=NALL", *(f"{n},{x},{y},{z}" for (x, y, z), n in nodes.items())]
    for name, factor in (("SKIN", skin), ("PATCH", patch), ("WEB", 1.0)):
        lines += [f"*MATERIAL, NAME={name}", "*ELASTIC", f"{7e4 * factor!r},0.3", "*DENSITY", "2.7e-9"]
        lines.append(f"*ELEMENT, TYPE=S8R, ELSET={name}")
        lines += [",".join(map(str, (next(number), *own))) for own in elements[name]]
        lines += [f"*SHELL SECTION, ELSET={name}, MATERIAL={name}", "4."]
    root = [number for place, number in nodes.items() if place[0] == 0.0]
    return Deck([*lines, "*BOUNDARY", *(f"{number},1,6" for number in root)], nodes, root)


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


def write_structure(folder: Path, tables: str) -> Path:
    """Store the whole structure, with half of `skin` and with half of `patch`, and write its file.

    Its parameter e scales skin and patch, and the patch may lose its stiffness; `tables` are what loads and
    reads it.
    """
    for name, factors in (("whole", {}), ("skin_half", {"skin": 0.5}), ("patch_half", {"patch": 0.5})):
        step = ["*STEP", "*FREQUENCY, SOLVER=MATRIXSTORAGE", "*END STEP"]
        run_calculix("\n".join([*stiffened_skin(**factors).lines, *step]) + "\n", folder, name)
    file = folder / "structure.toml"
    file.write_text(Inputs(__file__).text("stored.toml") + tables, encoding="utf-8")
    return file
