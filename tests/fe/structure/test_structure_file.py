"""Every fault of a structure file is one sentence that names the place."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fe.runtime.errors import FiniteElementError, SolutionError
from fe.structure.affine import static_responses
from fe.structure.operators import load_and_assemble
from tests.refusals import Inputs

INPUTS = Inputs(__file__)
PLATE = INPUTS.text("plate.toml")
ROSETTE = (
    '[[rosette]]\nname = "r"\npoint = [10, 5, 10]\naxes = [[1, 0, 0], [1, 2, 0]]\nangles = [0, 45, 90, 60]\n'
)


@pytest.fixture
def make(box, write) -> Callable[[str], Path]:
    points, cells = box("hexahedron", (2, 1, 1))
    data = {"line": (points[:, 0] + points[:, 1] == 0.0).astype(np.int64)}
    return lambda text: write(points * (20, 10, 10), "hexahedron", cells, text, point_data=data)


def test_the_file_without_a_fault_is_taken(make) -> None:
    structure = load_and_assemble(make(PLATE))
    assert set(static_responses(structure)) == {"weight", "push"}
    assert structure.unknowns == 24
    assert len(structure.design_hash) == 64
    assert load_and_assemble(make(PLATE + "# a comment\n")).design_hash == structure.design_hash
    assert load_and_assemble(make(PLATE.replace("2700", "2701"))).design_hash != structure.design_hash


@pytest.mark.parametrize(("old", "new", "sentence"), [*INPUTS.refused("plate"), *INPUTS.refused("rosette")])
def test_a_fault_is_one_sentence(old: str, new: str, sentence: str, make) -> None:
    text = (file := make(PLATE + ROSETTE)).read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(FiniteElementError, match=sentence) as caught:
        load_and_assemble(file)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(FiniteElementError, match=r"structure file .*none\.toml"):
        load_and_assemble(tmp_path / "none.toml")


def test_parts_that_turn_on_a_hinge_cannot_be_solved(box, write) -> None:
    """Two cubes share one edge only: no check of sets sees it, the factorisation does."""
    points, (cube,) = box("hexahedron", (1, 1, 1))
    places = np.concatenate((points[cube], points[cube] + (1.0, 1.0, 0.0)))
    corners, numbers = np.unique(places, axis=0, return_inverse=True)
    file = write(corners, "hexahedron", numbers.reshape(2, 8), INPUTS.text("hinge.toml"))
    with pytest.raises(SolutionError, match=r"some part of the structure is not held|hardly held"):
        static_responses(load_and_assemble(file))


def test_a_rosette_is_gauges_at_one_point(make) -> None:
    """Its strains are those of one plane strain state; beside gauges of their own they come last."""
    structure = load_and_assemble(make(PLATE + ROSETTE))
    assert structure.gauges == ("a", "r_a", "r_b", "r_c", "r_d")
    own, first, middle, last, fourth = structure.gauge_output.toarray()
    np.testing.assert_array_equal(own, first)
    half = 0.5 * (2.0 * middle - first - last)
    wanted = 0.25 * first + 0.75 * last + half * np.sin(np.radians(120.0))
    np.testing.assert_allclose(fourth, wanted, atol=1e-12 * np.abs(first).max())
