"""Structures and wings with more damage regions than a grid of states would take."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.study_regions import bracket, plate, tube
from fe.full.affine import AffineSum
from fe.full.subspace import Norm
from fe.reduction.dual_solutions import DualProblem
from fe.reduction.model_cache import reduced, reduced_structure
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
    errors = measured_errors(structure, reduced(structure), 60)
    assert max(errors.strain, errors.displacement) <= errors.bound < 1e-3


def test_combined_dual_solutions_know_their_residuals(coarse_plate: Structure) -> None:
    """At any state the factors give the dual norm of what the Galerkin solution leaves of each output."""
    terms = tuple(term.matrix for term in coarse_plate.stiffness_terms)
    sums = AffineSum(terms).matrix
    norm = Norm(sums(np.full(len(terms), 0.5)))
    outputs = np.asarray(coarse_plate.gauge_output.toarray().T[:, :3])
    told: list[str] = []
    problem = DualProblem(terms, outputs, norm, sums, lambda _, what: told.append(what))
    states = [np.full(len(terms), value) for value in (0.3, 0.5)] + [np.linspace(0.2, 1.0, len(terms))]
    data = problem.combined(states)
    assert told == ["dual solutions"] * 3
    theta = np.linspace(0.9, 0.25, len(terms))
    stiffness = sums(theta)
    for number, output in enumerate(outputs.T):
        weights = np.linalg.solve(np.tensordot(theta, data.stiffness[number], 1), data.output[number])
        coefficients = np.concatenate(([1.0], -np.outer(theta, weights).ravel()))
        told_length = np.linalg.norm(data.factors[0, number] @ coefficients)
        # equal multiples of one stiffness give the same function, so that two are left and one is empty
        whitened = np.tensordot(weights, data.products[:, :, number], 1)
        dual = norm.riesz(_unwhitened(norm, whitened))
        left = norm.whitened(output - stiffness @ dual)
        assert np.linalg.norm(left) == pytest.approx(told_length, rel=1e-6)
        assert told_length < 0.5 * np.linalg.norm(norm.whitened(output))


def _unwhitened(norm: Norm, vector: Any) -> Any:
    """Functional (n,) whose whitened form is given: by least squares, which is exact for few unknowns."""
    unit = norm.whitened(np.eye(len(vector)))
    return np.linalg.solve(unit, vector)


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
