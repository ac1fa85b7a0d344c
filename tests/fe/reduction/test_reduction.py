"""The offline reduction, against pyMOR's own reductor and direct solutions; what cannot be reduced."""

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from pymor.models.basic import StationaryModel
from pymor.operators.constructions import LincombOperator, VectorOperator
from pymor.operators.numpy import NumpyMatrixOperator
from pymor.parameters.functionals import MinThetaParameterFunctional, ProjectionParameterFunctional
from pymor.reductors.coercive import CoerciveRBReductor

from benchmarks.study_regions import bracket, plate, tube
from fe.reduction.model_cache import reduced_structure
from fe.reduction.reduced_basis import Reduction, measured_errors, reduce_structure
from fe.reduction.settings import StructureSettings
from fe.reduction.terms import ReductionTerms
from fe.runtime.errors import FiniteElementError
from fe.structure.affine import affine_sum, static_response
from fe.structure.design import load_structure, structure_hash
from fe.structure.operators import load_and_assemble
from tests.fe.springs import SETTINGS, reduced_springs, rough_springs, springs
from tests.refusals import Inputs, refused

SYSTEM = springs()
STIFFNESS = tuple(term.matrix for term in SYSTEM.stiffness_terms)
TERMS = ReductionTerms(SYSTEM)


@pytest.fixture(scope="module")
def reduction() -> Reduction:
    return reduced_springs(2)


def values(state: Any) -> dict[str, float]:
    return dict(zip(("young_modulus_factor", *SYSTEM.regions), state, strict=True))


def test_bound_is_not_wildly_pessimistic() -> None:
    """Of a model so small that its errors are far above rounding."""
    rough = rough_springs().model
    ratios = []
    for state in TERMS.training()[::5]:
        found = rough.static_response(values(state))
        wanted = static_response(SYSTEM, values(state) | {"load_factor": 1.0, "tip_force": 0.0}).strain
        ratios.append(found.strain_error_bound / np.abs(found.strain - wanted).max())
    assert min(ratios) >= 1.0
    assert np.median(ratios) < 1.8


def test_the_rounding_that_was_measured_is_allowed_for(reduction: Reduction) -> None:
    """On a soft first spring the chain moves far and stretches little: digits of the stretches are lost."""
    assert reduction.model.rounding_allowance == 5e-6  # the least
    root = 1e-10
    model = reduce_structure(springs(root=root), replace(SETTINGS, bound_tolerance=1e-2)).model
    # in doubles a displacement of all is known to 2^-53 of itself, and moves by (pull / stretch) / root
    assert 5e-6 < model.rounding_allowance < 2.0**-53 / root * 60 * 8
    assert model.static_response({"load_factor": 1.0}).strain_error_bound > 5e-6


def test_pymor_reduces_and_bounds_alike(reduction: Reduction) -> None:
    """On the same basis pyMOR's coercive reductor must give the same solution and the same energy bound."""
    model, basis = reduction.model, reduction.static_basis
    coefficients = [ProjectionParameterFunctional("theta", 4, k) for k in range(4)]
    operators = [NumpyMatrixOperator(term) for term in STIFFNESS]
    reference = {"theta": np.append(model.bound_reference, 1.0)}
    load = VectorOperator(operators[0].range.from_numpy(SYSTEM.load_lift[:, np.newaxis]))
    full = StationaryModel(LincombOperator(operators, coefficients), load)
    reduced = CoerciveRBReductor(
        full,
        RB=full.solution_space.from_numpy(np.ascontiguousarray(basis)),
        product=NumpyMatrixOperator(affine_sum(reference["theta"], STIFFNESS)),
        coercivity_estimator=MinThetaParameterFunctional(coefficients, reference),
    ).reduce()
    for e, z1, z2 in TERMS.training()[::17]:
        theta = np.array((e, 1 - z1, 1 - z2, 1.0))
        mu = reduced.parameters.parse({"theta": theta})
        ours = model.static_response({"young_modulus_factor": e, "load_factor": 1.0}, (z1, z2)).coordinates
        np.testing.assert_allclose(reduced.solve(mu).to_numpy().ravel(), ours, rtol=1e-8)
        change = (theta - reference["theta"])[:-1]
        residual = model.residual_load[:, 0] - np.einsum("rqj,q,j->r", model.residual_stiffness, change, ours)
        energy_bound = float(reduced.estimate_error(mu).ravel()[0])
        coercivity = min(theta / reference["theta"])
        assert np.linalg.norm(residual) / coercivity == pytest.approx(energy_bound, rel=1e-6)


@pytest.mark.parametrize(("regions", "tolerance"), [(1, 5e-3), (2, SETTINGS.bound_tolerance), (4, 5e-3)])
def test_search_ends_below_the_tolerance_and_starts_high(regions: int, tolerance: float) -> None:
    """Few regions have a bound of each, and many one together."""
    found = reduced_springs(regions)
    assert found.bound_history[-1] <= tolerance < found.bound_history[0]
    assert len(found.bound_history) <= len(found.snapshots) == len(set(found.snapshots))
    assert found.model.dual_output.shape[::2] == {1: (2, 1), 2: (4, 1), 4: (1, 12)}[regions]


def test_same_system_gives_the_same_bytes(reduction: Reduction) -> None:
    assert reduce_structure(springs(), SETTINGS).model.to_bytes() == reduction.model.to_bytes()


def test_progress_is_told() -> None:
    listener = MagicMock()
    reduce_structure(SYSTEM, SETTINGS, listener)
    assert "Reducing the modes" in str(listener.stage.mock_calls)
    assert "'full solution 1'" in str(listener.mock_calls)


def test_anchors_part_the_losses_in_equal_ratios(reduction: Reduction) -> None:
    np.testing.assert_allclose(1.0 - reduction.model.dual_split, np.sqrt(0.2))
    kept = np.array([anchor[1:3] for (anchor,) in TERMS.anchors()])
    np.testing.assert_allclose(
        kept, 0.2 ** np.array([(0.25, 0.25), (0.25, 0.75), (0.75, 0.25), (0.75, 0.75)])
    )


# ---------------------------------------------------------------- of a structure file


@pytest.mark.long  # what the documentation says of six regions, in minutes
@pytest.mark.parametrize("make", [plate, bracket, tube])
def test_six_regions_by_default(tmp_path: Path, make: Any) -> None:
    structure = load_and_assemble(make(tmp_path, 6))
    errors = measured_errors(structure, reduce_structure(structure).model, 60)
    assert max(errors.strain, errors.displacement) <= errors.bound < 1e-3


def test_the_file_says_how_well_and_the_structure_stays_the_same(plate_file: Path, tmp_path: Path) -> None:
    design, other = load_structure(plate_file), tmp_path / "plate.toml"
    assert StructureSettings.of(design).bound_tolerance == pytest.approx(5e-3)
    other.write_text(plate_file.read_text(encoding="utf-8").replace("5e-3", "1e-2"), encoding="utf-8")
    assert tomllib.loads(other.read_text(encoding="utf-8"))["reduction"] == {"tolerance": 1e-2}
    folder = plate_file.parent
    assert structure_hash(load_structure(other), folder) == structure_hash(design, folder)


@pytest.mark.parametrize(("changes", "cells", "sentence"), Inputs(__file__).refused("beam"))
def test_what_cannot_be_reduced_is_refused(changes, cells, sentence: str, write_beam, tmp_path) -> None:
    with refused(FiniteElementError, sentence):
        reduced_structure(write_beam(tmp_path, changes, cells=cells))
