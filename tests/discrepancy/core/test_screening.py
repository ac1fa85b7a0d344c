"""Screening against dense projections and against fits, for effects that are linear."""

from __future__ import annotations

import numpy as np
import pytest

from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.fitting import fit
from discrepancy.fits.screening import Screen, grid, rescaled
from discrepancy.search.hypotheses import pairs
from discrepancy.search_settings import SEARCH


@pytest.fixture(scope="module")
def screened(kit):  # type: ignore[no-untyped-def]
    """Problem, fit without effect, screen, two linear effects (wide priors) with their changes."""
    problem = kit.closed_problem(seed=12, effect=0.12)
    none = kit.fitted(problem, iterations=40)
    screen = Screen(problem, none)
    terms = (Term(kit.offset_effect(deviation=10.0), "y1"), Term(kit.drift_effect(deviation=10.0), "y1"))
    changes = [next(iter(screen.changes(term))) for term in terms]
    return problem, none, screen, terms, changes


def dense_projection(kit, problem, none, term, start):  # type: ignore[no-untyped-def]
    """Return, densely, change d, nuisances' derivatives A, Hessian, residual and gradient at the fit."""
    linear = kit.Linear(problem, Candidate((term,)))
    q = problem.shared.size
    zero = np.concatenate((none.point.shared, np.zeros(1), *none.point.local))
    moved = zero.copy()
    moved[q] = start[0]
    d = linear.residual(zero) - linear.residual(moved)
    bare = kit.Linear(problem, Candidate())
    _, a = bare.dense()
    residual = linear.residual(zero)
    gradient = a.T @ residual - bare.precision * np.delete(zero, q)
    return d, a, a.T @ a + np.diag(bare.precision), residual, gradient


def test_change_is_the_projected_one(kit, screened) -> None:  # type: ignore[no-untyped-def]
    problem, none, screen, terms, changes = screened
    vectors = []
    for term, change in zip(terms, changes, strict=True):
        d, a, hessian, residual, gradient = dense_projection(kit, problem, none, term, change.start)
        kernel = np.eye(len(d)) - a @ np.linalg.solve(hessian, a.T)
        assert change.size == pytest.approx(d @ kernel @ d, rel=1e-6)
        # b(d) = r.d - g' H^-1 J' d; the gradient g is small at the fit, and would be zero at its very end
        expected = residual @ d - gradient @ np.linalg.solve(hessian, a.T @ d)
        assert change.fits == pytest.approx(expected, rel=1e-6)
        assert float(change.vector * screen.sign @ change.vector) == pytest.approx(change.size, rel=1e-9)
        vectors.append((d, kernel))
    (one, kernel), (other, _) = vectors
    product = one @ kernel @ other
    assert float(changes[0].vector * screen.sign @ changes[1].vector) == pytest.approx(product, rel=1e-6)


def test_gain_is_what_a_fit_achieves(screened) -> None:  # type: ignore[no-untyped-def]
    """For a linear effect with a wide prior the screen is the fit."""
    problem, none, _, terms, changes = screened
    for term, change in zip(terms, changes, strict=True):
        candidate = Candidate((term,))
        found = fit(problem, candidate, problem.start(candidate), iterations=40)
        prior = 0.5 * float(found.point.effect @ found.point.effect)
        assert none.objective - found.objective + prior == pytest.approx(change.gain, rel=0.02, abs=0.03)
        assert rescaled(change)[0] == pytest.approx(found.point.effect[0], rel=0.02, abs=1e-4)


def test_pairs_are_fitted_together(kit, screened) -> None:  # type: ignore[no-untyped-def]
    problem, none, screen, terms, changes = screened
    options = {change.term.effect.identifier: [change] for change in changes}
    ((misfit, first, second),) = list(pairs(options, screen.sign))
    candidate = Candidate(terms)
    found = fit(problem, candidate, problem.start(candidate), iterations=40)
    assert none.objective - found.objective == pytest.approx(-misfit, rel=0.02, abs=0.05)
    np.testing.assert_allclose(
        np.concatenate((rescaled(first), rescaled(second))), found.point.effect, rtol=0.03, atol=1e-3
    )


def test_two_changes_that_are_one_are_no_pair(kit, screened) -> None:  # type: ignore[no-untyped-def]
    _, _, screen, _, changes = screened
    twin = {"one": [changes[0]], "other": [changes[0]]}
    assert not list(pairs(twin, screen.sign))


def test_noise_unknown_to_the_record_counts_by_what_is_left(kit) -> None:  # type: ignore[no-untyped-def]
    """With n0 = 0 the residual's own size stands for the noise: gains do not depend on the stand-in scale."""
    problem = kit.closed_problem(seed=13, effect=0.12, known_noise=False)
    none = kit.fitted(problem, iterations=40)
    term = Term(kit.offset_effect(), "y1")
    change = next(iter(Screen(problem, none).changes(term)))
    known = kit.closed_problem(seed=13, effect=0.12)
    at_known = kit.fitted(known, iterations=40)
    other = next(iter(Screen(known, at_known).changes(term)))
    # the stand-in is a thousandth of the range, the noise is not; sizes agree in units of what is left
    left = at_known.sums[0] / (known.counts[0] - at_known.spent[0])
    assert change.size == pytest.approx(other.size / left, rel=0.25)


def test_grids_hold_one_scale_and_every_level(catalogue) -> None:  # type: ignore[no-untyped-def]
    for effect in catalogue:
        term = Term(effect)
        points = list(grid(term))
        assert points
        assert all(point.shape == (len(term.parameters),) for point in points)
        magnitudes = [n for n, item in enumerate(effect.parameters) if item.magnitude]
        if magnitudes:
            signed = effect.parameters[magnitudes[0]].prior.value(0.0) == 0.0
            first = effect.parameters[magnitudes[0]]
            found = {float(point[magnitudes[0]]) for point in points}
            if first.levels:
                assert len(found) == first.levels
                assert min(found) == pytest.approx(-max(found))
            else:
                assert found == ({1.0, SEARCH.linear} if signed else {0.0})
        # none of them is the model as it was
        for point in points:
            values = term.values(point)
            assert any(values[effect.parameters[n].name] != 0.0 for n in magnitudes) or not magnitudes
