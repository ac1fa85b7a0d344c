"""Every fault of a structure file is one sentence that names the place."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fe.runtime.errors import FiniteElementError, SolutionError
from fe.structure.field import static_responses
from fe.structure.operators import load_and_assemble

GOOD = """length_unit = "mm"
[[parameter]]
name = "e"
[[control]]
name = "g"
[[set]]
name = "root"
of = "nodes"
box = [[0, 0, 0], [0, 10, 10]]
[[set]]
name = "tip"
of = "nodes"
box = [[20, 0, 0], [20, 10, 10]]
[[set]]
name = "inner"
of = "cells"
box = [[0, 0, 0], [10, 10, 10]]
[[material]]
name = "alloy"
density = 2700
young_modulus = 7e10
poisson_ratio = 0.3
scaled_by = "e"
[[support]]
set = "root"
hold = ["x", "y", "z"]
[[load]]
name = "weight"
control = "g"
acceleration = [0, 0, -9.81]
[[load]]
name = "push"
set = "tip"
pressure = 1e5
[[damage]]
name = "z1"
set = "inner"
[[mass]]
name = "m"
point = [20, 5, 5]
mass = 1
[[gauge]]
name = "a"
point = [10, 5, 10]
direction = [1, 0, 0]
[[displacement]]
name = "w"
point = [20, 5, 5]
direction = [0, 0, 1]
"""
HOLD, GAUGE, ALONG = 'set = "root"\nhold = ["x", "y", "z"]', "point = [10, 5, 10]", "direction = [1, 0, 0]"
ISOTROPIC = "young_modulus = 7e10\npoisson_ratio = 0.3"


def orthotropic(last_ratio: float, second_axis: str) -> str:
    ratios, axes = f"[0.3, 0.3, {last_ratio}]", f"[[1, 0, 0], {second_axis}]"
    moduli = "young_moduli = [1e11, 1e10, 1e10]\nshear_moduli = [5e9, 5e9, 5e9]"
    return f"{moduli}\npoisson_ratios = {ratios}\naxes = {axes}"


@pytest.fixture
def make(box: Callable[..., Any], write: Callable[..., Path]) -> Callable[[str], Path]:
    points, cells = box("hexahedron", (2, 1, 1))
    data = {"line": (points[:, 0] + points[:, 1] == 0.0).astype(np.int64)}
    return lambda text: write(points * (20, 10, 10), "hexahedron", cells, text, point_data=data)


def test_the_file_without_a_fault_is_taken(make: Callable[[str], Path]) -> None:
    structure = load_and_assemble(make(GOOD))
    assert set(static_responses(structure)) == {"weight", "push"}
    assert structure.unknowns == 24
    assert len(structure.design_hash) == 64
    assert load_and_assemble(make(GOOD + "# a comment\n")).design_hash == structure.design_hash
    assert load_and_assemble(make(GOOD.replace("2700", "2701"))).design_hash != structure.design_hash


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('name = "test"', 'name = "be\\nam"', "name: one line of text is expected"),
        ('"mm"', '"furlong"', r"length_unit: input should be 'm', 'cm', .* but 'furlong' came"),
        ("density = 2700", "density = -1", r"material\[1\]\.density: .* but -1 came"),
        ("density = 2700", 'density = "x"', r"material\[1\]\.density: a number is expected, but 'x' came"),
        ("density = 2700", "densty = 2700", r"'material\[1\]\.densty' is not a key"),
        ("density = 2700\n", "", r"'material\[1\]\.density' is missing"),
        ("[[gauge]]", "[gauge]", r"there can be several of 'gauge', so write \[\[gauge\]\]"),
        ("[[gauge]]", "[[gauge]", "is not valid TOML"),
        (ISOTROPIC, "young_modulus = 7e10", r"material\[1\]: either young_modulus and poisson_ratio, or"),
        (ISOTROPIC, orthotropic(0.3, "[-2, 0, 0]"), "axes must not be parallel"),
        (ISOTROPIC, orthotropic(0.3, "[0, 0, 0]"), r"material\[1\]\.axes\[2\]: it must point somewhere"),
        (ISOTROPIC, orthotropic(1.2, "[0, 1, 0]"), "belong to no stable material"),
        ('scaled_by = "e"', 'scaled_by = "f"', r"material\[1\] is scaled by 'f', but no \[\[parameter\]\]"),
        ('scaled_by = "e"\n', "", "the parameter 'e' scales no material"),
        ('control = "g"', 'control = "h"', r"load\[1\] is tied to the control 'h', but no \[\[control\]\]"),
        ('control = "g"\n', "", "the control 'g' commands no load"),
        ('name = "g"', 'name = "g"\nnominal = 0', r"control\[1\]: with its nominal value 0 it would be 0"),
        ('name = "z1"', 'name = "e"', r"parameter\[1\] and damage\[1\] are both named 'e'"),
        ('name = "w"', 'name = "a"', r"gauge\[1\] and displacement\[1\] are both named 'a'"),
        ('hold = ["x", "y", "z"]', 'hold = ["u"]', r"support\[1\]\.hold\[1\]: .* but 'u' came"),
        ('hold = ["x", "y", "z"]', "", r"support\[1\]: either hold = .* or springs = .* is expected"),
        ("pressure = 1e5", "", r"load\[2\]: either force and set, or force and point, or pressure and set"),
        ("pressure = 1e5", "force = [0, 0, 0]", r"load\[2\]\.force: it must point somewhere"),
        ('set = "tip"\npressure', "pressure", r"load\[2\]: either .*, or pressure and set, or acceler"),
        ('control = "g"\n', 'control = "g"\nset = "tip"\n', r"load\[1\]: either .*, or acceleration is exp"),
        ("box = [[0, 0, 0], [0,", "box = [[0, 0, 0], [-1,", r"set\[1\]: box must give its lower"),
        (ALONG, "direction = [0, 0, 0]", r"gauge\[1\]\.direction: it must point somewhere"),
        (HOLD, HOLD.replace("root", "rot"), r"support\[1\]: .* no set of nodes or faces named 'rot'; .*tip"),
        ('set = "inner"', 'set = "outer"', r"damage\[1\]: .* no set of cells named 'outer'; .* inner, all"),
        ("[[20, 0, 0], [20, 10", "[[21, 0, 0], [22, 10", r"load\[2\]: the set 'tip' .* holds no node"),
        ("[0, 0, 0], [10, 10, 10]", "[0, 0, 0], [1, 1, 1]", r"damage\[1\]: the set 'inner' .* no cell"),
        ('set = "tip"', 'set = "line=1"', r"load\[2\]: no face of the surface lies in the set 'line=1'"),
        (ISOTROPIC, f'set = "inner"\n{ISOTROPIC}', r"1 of 2 elements have no .* them 2 at \(15, 5, 5\) mm"),
        (
            "[[support]]",
            f'[[material]]\nname = "b"\nset = "inner"\ndensity = 1\n{ISOTROPIC}\n[[support]]',
            r"material\[2\]: the materials 'b' and 'alloy' share 1 elements, such as 1 at \(5, 5, 5\) mm",
        ),
        (
            "[[mass]]",
            '[[damage]]\nname = "z2"\nset = "all"\n[[mass]]',
            r"damage\[2\]: the damage regions 'z2' and 'z1' share 1 elements",
        ),
        (HOLD, HOLD.replace('"y", ', ""), r"leave 1 of the six rigid motions .* a shift along \(0, 1, 0\)"),
        (HOLD, HOLD.replace("root", "line=1"), r"leave 1 .* a turn about .* \(0, 0, -?1\) through \(0, 0, "),
        (GAUGE, GAUGE.replace("10]", "9]"), r"\(a\): the point \(10, 5, 9\) mm lies 1 mm off .* inside"),
        (GAUGE, GAUGE.replace("10]", "13]"), r"3 mm off .* nearest point of the surface is \(10, 5, 10\) mm"),
        (ALONG, "direction = [0, 1, 4]", r"gauge\[1\] \(a\): its direction points 76 degrees out of"),
        (ALONG, f"{ALONG}\nlength = 25", r"gauge\[1\] \(a\): 25 mm long, .* over the edge"),
        ("[20, 5, 5]\nmass", "[25, 5, 5]\nmass", r"mass\[1\]: the point \(25, 5, 5\) mm lies 5 mm off"),
        ("[20, 5, 5]\ndirection", "[0, -9, 5]\ndirection", r"displacement\[1\]: the point .* lies 9 mm off"),
        ('"mesh.vtu"', '"nothing.vtu"', r"The mesh file .*nothing\.vtu is not there"),
    ],
)
def test_a_fault_is_one_sentence(old: str, new: str, sentence: str, make: Callable[[str], Path]) -> None:
    file = make(GOOD)
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(FiniteElementError, match=sentence) as caught:
        load_and_assemble(file)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(FiniteElementError, match=r"structure file .*none\.toml"):
        load_and_assemble(tmp_path / "none.toml")


def test_parts_that_turn_on_a_hinge_cannot_be_solved(tmp_path: Path) -> None:
    # Two cubes share one edge only: no check of sets sees it, the factorisation does.
    nodes = {}
    cells = []
    for shift in ((0, 0), (1, 1)):
        corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
        places = [(x + shift[0], y + shift[1], z) for x, y, z in corners]
        cells.append([nodes.setdefault(place, len(nodes) + 1) for place in places])
    deck = ["*NODE", *(f"{number}, {x}, {y}, {z}" for (x, y, z), number in nodes.items())]
    deck += ["*ELEMENT, TYPE=C3D8", *(f"{n}, {', '.join(map(str, row))}" for n, row in enumerate(cells, 1))]
    (tmp_path / "m.inp").write_text("\n".join([*deck, "*NSET, NSET=ROOT", "1, 2, 5, 6"]))
    text = f"""name = "hinge"\nmesh = "m.inp"\nlength_unit = "m"\n[[material]]\nname = "a"\ndensity = 1
{ISOTROPIC}\n[[support]]\nset = "ROOT"\nhold = ["x", "y", "z"]
[[load]]\nname = "g"\nacceleration = [1, 0, 0]\n"""
    (tmp_path / "s.toml").write_text(text)
    with pytest.raises(SolutionError, match=r"some part of the structure is not held|hardly held"):
        static_responses(load_and_assemble(tmp_path / "s.toml"))


def test_a_rosette_is_gauges_at_one_point(make: Callable[[str], Path]) -> None:
    """Its strains are those of one plane strain state; beside gauges of their own they come last."""
    rosette = '[[rosette]]\nname = "r"\npoint = [10, 5, 10]\naxes = [[1, 0, 0], [1, 2, 0]]\n'
    structure = load_and_assemble(make(GOOD + rosette + "angles = [0, 45, 90, 60]\n"))
    assert structure.gauges == ("a", "r_a", "r_b", "r_c", "r_d")
    own, first, middle, last, fourth = structure.gauge_output.toarray()
    np.testing.assert_array_equal(own, first)
    half = 0.5 * (2.0 * middle - first - last)
    wanted = 0.25 * first + 0.75 * last + half * np.sin(np.radians(120.0))
    np.testing.assert_allclose(fourth, wanted, atol=1e-12 * np.abs(first).max())
    for old, new, sentence in (
        ("[1, 2, 0]]", "[2, 0, 0]]", r"rosette\[1\]\.axes: the two axes .* must point in two directions"),
        ("axes", "axis", r"'rosette\[1\]\.axis' is not a key of a structure"),
        ("[1, 2, 0]]", "[0, 0, 1]]", r"gauge\[3\] \(r_b\): its direction points 45 degrees out of"),
        ('"r"', '"a"\nangles = []', r"rosette\[1\]\.angles: at least 2 entries are expected"),
    ):
        with pytest.raises(FiniteElementError, match=sentence):
            load_and_assemble(make(GOOD + rosette.replace(old, new)))
