"""Structures and wings with more damage regions than a grid of states would take."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from benchmarks.study_regions import bracket, plate, tube
from fe.reduction.model_cache import reduced_structure
from fe.reduction.reduced_basis import reduce_structure
from fe.reduction.settings import StructureSettings
from fe.reduction.structure_errors import measured_errors
from fe.runtime.errors import ReductionError
from fe.runtime.reduced import ReducedModel
from fe.structure.design import load_structure, structure_hash
from fe.structure.operators import Structure, load_and_assemble


def test_four_regions_around_a_hole(coarse_plate: Structure, plate_model: ReducedModel) -> None:
    """The bound holds at random states, nearly as asked for, and tells the error within a few times."""
    errors = measured_errors(coarse_plate, plate_model, 20)
    assert max(errors.strain, errors.displacement) <= errors.bound < 8e-3
    assert errors.bound < 30 * errors.strain


@pytest.mark.long  # what the documentation says of six regions, in minutes
@pytest.mark.parametrize("make", [plate, bracket, tube])
def test_six_regions_by_default(tmp_path: Path, make: Any) -> None:
    structure = load_and_assemble(make(tmp_path, 6))
    errors = measured_errors(structure, reduce_structure(structure, structure.design.name).model, 60)
    assert max(errors.strain, errors.displacement) <= errors.bound < 1e-3


def test_the_file_says_how_well_and_the_structure_stays_the_same(plate_file: Path, tmp_path: Path) -> None:
    design = load_structure(plate_file)
    assert StructureSettings.of(design).bound_tolerance == pytest.approx(5e-3)
    other = tmp_path / "plate.toml"
    other.write_text(plate_file.read_text(encoding="utf-8").replace("5e-3", "1e-2"), encoding="utf-8")
    assert tomllib.loads(other.read_text(encoding="utf-8"))["reduction"] == {"tolerance": 1e-2}
    folder = plate_file.parent
    assert structure_hash(load_structure(other), folder) == structure_hash(design, folder)


@pytest.mark.parametrize(("most", "taken"), [(1, "1 full solution"), (4, "4 full solutions")])
def test_a_bound_that_is_not_reached_names_the_keys(
    most: int, taken: str, write_beam: Callable[..., Path], tmp_path: Path
) -> None:
    """All solutions that are allowed are taken, though they come several at once."""
    file = write_beam(tmp_path, cells=2)
    file.write_text(
        file.read_text(encoding="utf-8") + f"\n[reduction]\nmost_solutions = {most}\n", encoding="utf-8"
    )
    words = rf"After {taken} the .* raise most_solutions \(now {most}\) or tolerance .*\[red"
    with pytest.raises(ReductionError, match=words):
        reduced_structure(file)
