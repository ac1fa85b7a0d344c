"""The offline reduction on a small affine system, against pyMOR's own reductor and direct solutions."""

from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pymor.models.basic import StationaryModel
from pymor.operators.constructions import LincombOperator, VectorOperator
from pymor.operators.numpy import NumpyMatrixOperator
from pymor.parameters.functionals import MinThetaParameterFunctional, ProjectionParameterFunctional
from pymor.reductors.coercive import CoerciveRBReductor
from scipy import sparse
from scipy.linalg import eigh

from fe.full.affine import affine_sum
from fe.full.subspace import Norm, ProjectedBasis, conjugate_gradients
from fe.reduction.certified_basis import compressed
from fe.reduction.reduced_basis import Reduction, reduce_model
from fe.reduction.settings import ModalSettings, ReductionSettings, loss_splits, remaining_levels
from fe.reduction.terms import ReductionTerms
from fe.runtime.errors import ReductionError, SolutionError
from fe.runtime.reduced import ReducedModel
from fe.runtime.state import region_names
from fe.wing.operators import AffineWing

PIECES = ((6, 20), (30, 48), (48, 56), (20, 24), (24, 28), (2, 6), (28, 30), (56, 60))
"""First and last spring, of sixty, of the damage regions of a chain; the first holds every other one."""


def chain(count: int = 60, seed: int = 0, root: float = 1.0, regions: int = 2) -> AffineWing:
    """Springs of several kinds in a row, masses along it; the first is `root` times as stiff."""
    random = np.random.default_rng(seed)
    stretch = sparse.csr_array(np.eye(count) - np.eye(count, k=-1))
    kind = np.zeros((regions + 2, count))
    kind[0, ::2] = 1.0
    for number, (first, last) in enumerate(PIECES[:regions], start=1):
        kind[number, first * count // 60 : last * count // 60 : 2 if number == 1 else 1] = 1.0
    kind[0] *= 1 - kind[1:-1].max(axis=0)
    kind[-1] = 0.2 + random.uniform(0, 0.2, count)
    kind[:, 0] *= root
    terms = tuple((stretch.T @ sparse.diags_array(1e3 * row) @ stretch).tocsr() for row in kind)
    masses = np.zeros((3, count))
    masses[0] = 0.01
    masses[1, [count // 2, 3 * count // 4]] = 1.0
    masses[2, -1] = 1.0
    tip = np.zeros(count)
    tip[-1] = 1.0
    # each gauge is a mean over a piece of the chain, so that no spring decides alone
    gauges = np.array(
        [(np.eye(count)[k + 8] - np.eye(count)[k]) / 8 for k in np.linspace(0, count - 9, 24).astype(int)]
    )
    return AffineWing.of(
        regions=region_names(regions),
        stiffness=terms,
        mass_terms=tuple(sparse.diags_array(row).tocsr() for row in masses),
        load_lift=random.uniform(0.5, 1.5, count),
        load_tip=tip,
        gauge_output=sparse.csr_array(gauges),
        tip=tip,
        expansion=sparse.eye_array(count).tocsr(),
        design_hash="a chain",
    )


SYSTEM = chain()
STIFFNESS = tuple(term.matrix for term in SYSTEM.stiffness_terms)
SMALL_MODES = ModalSettings(mode_count=4, frequency_tolerance=1e-5)
SETTINGS = ReductionSettings(modal=SMALL_MODES)


@pytest.fixture(scope="module")
def reduction() -> Reduction:
    return reduce_model(SYSTEM, SETTINGS)


TERMS = ReductionTerms(replace(SYSTEM, ranges=SETTINGS.named_ranges(SYSTEM.regions)))


@pytest.fixture(scope="module")
def rough(reduction: Reduction) -> ReducedModel:
    """A model so small that its errors are far above rounding."""
    model = reduction.model
    return compressed(model, np.eye(len(model.static_load.T))[:, :4])


def full_outputs(e: float, z1: float, z2: float, load: tuple[float, float]) -> NDArray[np.float64]:
    matrix = affine_sum((e, 1 - z1, 1 - z2, 1.0), STIFFNESS).toarray()
    solution = np.linalg.solve(matrix, load[0] * SYSTEM.load_lift + load[1] * SYSTEM.load_tip)
    return np.append(SYSTEM.gauge_output @ solution, SYSTEM.tip_row @ solution)


parameters = st.tuples(
    st.sampled_from((0.9, 1.1)) | st.floats(0.9, 1.1),
    st.sampled_from((0.0, 0.8)) | st.floats(0.0, 0.8),
    st.sampled_from((0.0, 0.8)) | st.floats(0.0, 0.8),
)


def not_tiny(value: float) -> float:
    """Loads so small that their squares underflow are no loads."""
    return value if abs(value) > 1e-9 else 0.0


loads = st.tuples(st.floats(-4.0, 6.0).map(not_tiny), st.floats(-100.0, 100.0).map(not_tiny))


@settings(max_examples=200)
@given(state=parameters, load=loads)
def test_bound_holds_where_the_error_is_large(
    rough: ReducedModel, state: tuple[float, float, float], load: tuple[float, float]
) -> None:
    e, z1, z2 = state
    reduced = rough.static_response(
        rough.vector(stiffness_loss=(z1, z2), young_modulus_factor=e), load=np.array(load)
    )
    full = full_outputs(e, z1, z2, load)
    assert np.abs(reduced.strain - full[:-1]).max() <= reduced.strain_error_bound
    assert abs(reduced.displacement[0] - full[-1]) <= reduced.displacement_error_bound


def test_bound_is_not_wildly_pessimistic(rough: ReducedModel) -> None:
    ratios = []
    for state in TERMS.training()[::5]:
        reduced = rough.static_response(young_modulus_factor=state[0], stiffness_loss=state[1:])
        error = np.abs(reduced.strain - full_outputs(*state, (1.0, 0.0))[:-1]).max()
        ratios.append(reduced.strain_error_bound / error)
    assert min(ratios) >= 1.0
    assert np.median(ratios) < 30.0


@settings(max_examples=100)
@given(state=parameters)
def test_asked_accuracy_is_reached(reduction: Reduction, state: tuple[float, float, float]) -> None:
    e, z1, z2 = state
    model = reduction.model
    for load in ((1.0, 0.0), (0.0, 1.0)):
        reduced = model.static_response(
            model.vector(stiffness_loss=(z1, z2), young_modulus_factor=e), load=np.array(load)
        )
        full = full_outputs(e, z1, z2, load)
        error = np.abs(reduced.strain - full[:-1]).max()
        largest = np.abs(full[:-1]).max()
        assert error <= reduced.strain_error_bound <= 2 * SETTINGS.bound_tolerance * largest


def test_the_rounding_that_was_measured_is_allowed_for(reduction: Reduction) -> None:
    """On a soft first spring the chain moves far and stretches little: digits of the stretches are lost."""
    assert reduction.model.rounding_allowance == 5e-6  # the least
    root = 1e-10
    model = reduce_model(chain(root=root), replace(SETTINGS, bound_tolerance=1e-2)).model
    # in doubles a displacement of all is known to 2^-53 of itself, and moves by (pull / stretch) / root
    assert 5e-6 < model.rounding_allowance < 2.0**-53 / root * 60 * 8
    assert model.static_response({"load_factor": 1.0}).strain_error_bound > 5e-6


def test_pymor_reduces_and_bounds_alike(reduction: Reduction) -> None:
    """On the same basis pyMOR's coercive reductor must give the same solution and the same energy bound."""
    model, basis = reduction.model, reduction.static_basis
    coefficients = [ProjectionParameterFunctional("theta", 4, k) for k in range(4)]
    operators = [NumpyMatrixOperator(term) for term in STIFFNESS]
    reference = {"theta": np.append(model.bound_reference, 1.0)}
    product = NumpyMatrixOperator(affine_sum(reference["theta"], STIFFNESS))
    full = StationaryModel(
        LincombOperator(operators, coefficients),
        VectorOperator(operators[0].range.from_numpy(SYSTEM.load_lift[:, np.newaxis])),
    )
    reductor = CoerciveRBReductor(
        full,
        RB=full.solution_space.from_numpy(np.ascontiguousarray(basis)),
        product=product,
        coercivity_estimator=MinThetaParameterFunctional(coefficients, reference),
    )
    reduced = reductor.reduce()
    for e, z1, z2 in TERMS.training()[::17]:
        theta = np.array((e, 1 - z1, 1 - z2, 1.0))
        mu = reduced.parameters.parse({"theta": theta})
        ours = model.static_response({"young_modulus_factor": e, "load_factor": 1.0}, (z1, z2))
        np.testing.assert_allclose(reduced.solve(mu).to_numpy().ravel(), ours.coordinates, rtol=1e-8)
        residual = model.residual_load[:, 0] - np.einsum(
            "rqj,q,j->r", model.residual_stiffness, theta, ours.coordinates
        )
        coercivity = min(*(theta / reference["theta"]))
        energy_bound = float(reduced.estimate_error(mu).ravel()[0])
        assert np.linalg.norm(residual) / coercivity == pytest.approx(energy_bound, rel=1e-6)


def _relative_bound(model: ReducedModel, state: tuple[float, ...]) -> float:
    vector = model.nominal.copy()
    vector[: len(state)] = state
    found = [model.static_response(vector, load=load) for load in np.eye(2)]
    outputs = [(one.strain, one.strain_error_bound) for one in found]
    outputs += [(one.displacement, one.displacement_error_bound) for one in found]
    return max(bound / float(np.abs(values).max()) for values, bound in outputs)


def test_search_ends_below_the_tolerance_and_starts_high(reduction: Reduction) -> None:
    assert reduction.bound_history[-1] <= SETTINGS.bound_tolerance < reduction.bound_history[0]
    assert len(reduction.bound_history) <= len(reduction.snapshots)
    assert len(set(reduction.snapshots)) == len(reduction.snapshots)
    worst = max(_relative_bound(reduction.model, state) for state in TERMS.training())
    assert worst <= SETTINGS.bound_tolerance


def test_same_system_gives_the_same_bytes(reduction: Reduction) -> None:
    assert reduce_model(chain(), SETTINGS).model.to_bytes() == reduction.model.to_bytes()


def test_frequencies_of_the_chain_are_kept(reduction: Reduction) -> None:
    model = reduction.model
    states = (0.9, 0.8, 0.0, 0.05, 0.3), (1.1, 0.2, 0.5, 0.3, 0.0), (1.0, 0, 0, 0.2, 0.1)
    for e, z1, z2, servo, pitot in states:
        stiffness = affine_sum((e, 1 - z1, 1 - z2, 1.0), STIFFNESS).toarray()
        mass = affine_sum((1.0, servo, pitot), SYSTEM.mass_terms).toarray()
        square = np.sort(np.linalg.eigvals(np.linalg.solve(mass, stiffness)).real)[: model.mode_count]
        masses = {"servo_mass": servo, "pitot_mass": pitot}
        found = model.modes({"young_modulus_factor": e, **masses}, (z1, z2)).frequency
        np.testing.assert_allclose(found, np.sqrt(square) / (2 * np.pi), rtol=1e-4)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"most_snapshots": 2}, "After 2 full solutions the error bound of uav_wing"),
        ({"modal": ModalSettings(mode_count=29)}, "29 modes cannot be had from 60 unknowns"),
    ],
)
def test_what_cannot_be_reached_is_reported(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ReductionError, match=sentence):
        reduce_model(SYSTEM, replace(SETTINGS, **changes))


def test_a_part_that_is_not_held_is_reported() -> None:
    loose = np.zeros(60)
    loose[-1] = 1.0
    cut = tuple(
        replace(term, matrix=(term.matrix * np.outer(1 - loose, 1 - loose)).tocsr())
        for term in SYSTEM.stiffness_terms
    )
    with pytest.raises(SolutionError):
        reduce_model(replace(SYSTEM, stiffness_terms=cut), SETTINGS)


def test_progress_is_told() -> None:
    told: list[str] = []

    class Listener:
        @contextmanager
        def stage(self, description: str, total: int | None = None, unit: str = ""):
            told.append(description)
            yield self

        def advance(self, amount: int = 1, detail: str | None = None) -> None:
            told.append(detail or "")

    reduce_model(SYSTEM, SETTINGS, Listener())
    assert "Reducing the modes" in told
    assert "full solution 1" in told


def test_conjugate_gradients_solve_and_give_up() -> None:
    norm = Norm(affine_sum((1, 0.45, 0.45, 1), STIFFNESS))
    matrix = affine_sum((0.9, 1.0, 0.2, 1), STIFFNESS)
    right = np.stack((SYSTEM.load_lift, SYSTEM.load_tip, np.zeros(60)), axis=1)
    found = conjugate_gradients([matrix], norm, right, np.zeros_like(right), tolerance=1e-12)
    np.testing.assert_allclose(found, np.linalg.solve(matrix.toarray(), right), rtol=1e-9, atol=1e-15)
    with pytest.raises(SolutionError, match="Conjugate gradients reached"):
        conjugate_gradients([matrix], norm, right, np.zeros_like(right), tolerance=1e-12, most_iterations=2)


def test_basis_stays_orthonormal_with_nearly_dependent_vectors() -> None:
    whole = affine_sum((1, 1, 1, 1), STIFFNESS)
    random = np.random.default_rng(5)
    basis = ProjectedBasis(Norm(whole), [(whole,)], drop=1e-9)
    first = random.normal(size=(60, 5))
    basis.extend(first)
    assert basis.vectors.shape[1] == 5
    near = first + 1e-6 * random.normal(size=first.shape)
    both = np.concatenate((near, first @ random.normal(size=(5, 3)), np.zeros((60, 1))), axis=1)
    basis.extend(both)
    np.testing.assert_allclose(basis.vectors.T @ whole @ basis.vectors, np.eye(10), atol=1e-9)
    np.testing.assert_allclose(basis.inner[0][0], np.eye(10), atol=1e-9)


def test_anchors_part_the_losses_in_equal_ratios() -> None:
    np.testing.assert_allclose(1 - loss_splits((0.0, 0.8), 2), [np.sqrt(0.2)])
    np.testing.assert_allclose(remaining_levels((0.0, 0.8), 1), [np.sqrt(0.2)])
    levels, splits = remaining_levels((0.0, 0.8), 3), 1 - loss_splits((0.0, 0.8), 3)
    assert np.all(levels[:-1] > splits)
    assert np.all(splits > levels[1:])


@pytest.mark.parametrize("regions", [1, 4])
def test_any_number_of_regions_is_reduced_with_a_certified_bound(regions: int) -> None:
    system = chain(regions=regions)
    found = reduce_model(system, replace(SETTINGS, bound_tolerance=5e-3, most_snapshots=30))
    model = ReducedModel.from_bytes(found.model.to_bytes())
    assert model.regions == region_names(regions)
    combined = regions > 3
    assert (model.dual_counts.prod(), model.dual_output.shape[1] > 0) == (1 if combined else 2, combined)
    assert found.bound_history[-1] <= 5e-3
    random = np.random.default_rng(regions)
    strains = []
    states = [(random.uniform(0.9, 1.1), *random.choice((0.0, 0.3, 0.8), regions)) for _ in range(40)]
    for e, *loss in states:
        theta = (e, *(1.0 - z for z in loss), 1.0)
        matrix = affine_sum(theta, tuple(term.matrix for term in system.stiffness_terms)).toarray()
        for lift, force in ((1.0, 0.0), (0.0, 1.0), (3.0, -20.0)):
            load = lift * system.load_lift + force * system.load_tip
            wanted = system.gauge_output @ np.linalg.solve(matrix, load)
            chosen = {"young_modulus_factor": e, "load_factor": lift, "tip_force": force}
            seen = model.static_response(chosen, loss)
            error = float(np.abs(seen.strain - wanted).max())
            assert error <= seen.strain_error_bound <= 0.05 * np.abs(wanted).max()
        strains.append(seen.strain)
        mass = affine_sum((1.0, 0.2, 0.1), system.mass_terms).toarray()
        frequency = np.sqrt(eigh(matrix, mass, eigvals_only=True)[:4]) / (2.0 * np.pi)
        modes = model.modes({"young_modulus_factor": e, "servo_mass": 0.2, "pitot_mass": 0.1}, loss)
        assert modes.frequency == pytest.approx(frequency, rel=2e-3)
    together = np.array(states)
    names = ("young_modulus_factor", *model.regions)
    columns = dict(zip(names, together.T, strict=True)) | {"load_factor": 3.0, "tip_force": -20.0}
    outputs = model.static_outputs(model.vectors(columns))
    assert outputs[:, :-1] == pytest.approx(np.array(strains), rel=1e-12)
