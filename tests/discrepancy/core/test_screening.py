"""Screening and gates: dense projections, fits, level and power."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from scipy.stats import binom

from discrepancy.campaign.records import NoiseRecord
from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.fitting import fit
from discrepancy.fits.gates import ABSOLUTE_LEVEL, SHAPE_GAIN, absolute_gate, absolute_tests, shape_gate
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


# ---------------------------------------------------------------- level and power of the gates


DRAWS = 1500


def null_gates(kit, freedom, kinds, samples, draws=DRAWS, gap=0.0):  # type: ignore[no-untyped-def]
    """Return a fit and, at sums drawn under the null (or with a gap), whether the gate passed."""
    noise = NoiseRecord(0.02, freedom)
    problem = kit.closed_problem(seed=1, noise=noise, kinds=kinds, samples=samples)
    found = kit.fitted(problem)
    generator = np.random.default_rng(17)
    left = problem.counts - found.spent
    passed = []
    for _ in range(draws):
        scale = 1.0 if freedom == inf else generator.chisquare(freedom, 3) / freedom
        sums = (1.0 + gap) * generator.chisquare(left) / scale
        residuals = tuple(generator.standard_normal(r.shape) for r in found.residuals)
        passed.append(absolute_gate(problem, replace(found, sums=sums, residuals=residuals)).passed)
    return problem, found, passed


@pytest.mark.parametrize(
    ("freedom", "kinds", "samples"),
    [
        (inf, ("static",), 0),
        (30.0, ("static",), 0),
        *(
            pytest.param(*row, 60, marks=pytest.mark.long)  # between the two above and the one below
            for row in ((inf, ("ringdown",)), (30.0, ("ringdown",)), (200.0, ("static", "ringdown")))
        ),
        (20.0, ("static", "ringdown"), 60),
    ],
)
def test_absolute_gate_has_its_level(kit, freedom: float, kinds: tuple[str, ...], samples: int) -> None:  # type: ignore[no-untyped-def]
    """Rejected at most 1e-3 of the time where nothing is missing; of 1500 draws more than 7 are too many."""
    _, _, passed = null_gates(kit, freedom, kinds, samples)
    assert passed.count(False) <= binom.isf(1e-3, DRAWS, ABSOLUTE_LEVEL)


def test_absolute_gate_has_its_level_with_whiteness(kit) -> None:  # type: ignore[no-untyped-def]
    problem, found, passed = null_gates(kit, 200.0, ("ringdown",), 120, draws=1500)
    assert any(name.startswith("whiteness") for name, _ in absolute_tests(problem, found))
    assert passed.count(False) <= binom.isf(1e-3, 1500, ABSOLUTE_LEVEL)


def test_absolute_gate_rejects_a_gap_in_all_channels(kit) -> None:  # type: ignore[no-untyped-def]
    """A third more variance, spread evenly: 60 samples, 5 channels of record."""
    _, _, passed = null_gates(kit, inf, ("ringdown",), 80, draws=300, gap=0.5)
    assert passed.count(False) > 280


def test_residuals_of_the_truth_pass_and_of_a_gap_fail(kit) -> None:  # type: ignore[no-untyped-def]
    """Fits, not drawn sums: the degrees of freedom that nuisances take are counted right."""
    shares = []
    for seed in range(40):
        problem = kit.closed_problem(seed=100 + seed, noise=NoiseRecord(0.02, inf), samples=40)
        found = kit.fitted(problem)
        assert absolute_gate(problem, found).passed
        shares.append(found.sums.sum() / (problem.counts.sum() - found.spent.sum()))
    assert np.mean(shares) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / (40 * 200)))
    problem = kit.closed_problem(seed=1, extra=lambda rows: 0.1 * np.sin(2.0 * rows))
    found = kit.fitted(problem)
    gate = absolute_gate(problem, found)
    assert gate.passed is False
    assert gate.statistic < ABSOLUTE_LEVEL


def test_without_a_record_nothing_absolute_is_said_but_of_colour(kit) -> None:  # type: ignore[no-untyped-def]
    problem = kit.closed_problem(seed=1, known_noise=False, samples=150)
    found = kit.fitted(problem)
    gate = absolute_gate(problem, found)
    assert gate.passed is None
    assert "No noise record" in gate.reason
    wave = 30.0 * np.sin(0.3 * np.arange(150))[:, np.newaxis]
    swung = replace(found, residuals=tuple(r + wave if len(r) == 150 else r for r in found.residuals))
    assert absolute_gate(problem, swung).passed is False


def test_shape_gate_compares_evidence(kit) -> None:  # type: ignore[no-untyped-def]
    problem = kit.closed_problem(seed=1)
    found = kit.fitted(problem, Term(kit.offset_effect(), "y1"))
    for gain, passes in ((-3.0, True), (SHAPE_GAIN - 0.01, True), (SHAPE_GAIN + 0.01, False)):
        gate = shape_gate(found, replace(found, log_evidence=found.log_evidence + gain))
        assert gate.passed is passes
        assert gate.statistic == pytest.approx(gain)
    assert shape_gate(found, None).passed is True
