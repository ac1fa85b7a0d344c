"""Draws from posteriors and predictions of held-out trials: known densities, coverage."""

from __future__ import annotations

from dataclasses import replace
from math import inf, sin

import numpy as np
import pytest

from discrepancy.campaign.records import NoiseRecord
from discrepancy.catalogue.entry import Effect
from discrepancy.fits.candidate import Candidate, Point, Term
from discrepancy.fits.fitting import fit
from discrepancy.fits.predictive import ensemble, residual_set, with_draws
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Screen
from discrepancy.judgement.conclusion import named_effects
from discrepancy.workflow import patch_draws
from fe.runtime.patch import ModelPatch, RunOffset

RIPPLES = 200.0
"""Waves of the ripple in a metre, over 2 pi."""


def test_ensembles_have_the_moments_of_a_gaussian() -> None:
    """Spread a hundredth of what it should be at first."""
    root = np.array([[1.0, 0.0], [0.9, 0.2]])
    precision = np.linalg.inv(root @ root.T)
    draws = ensemble(lambda x: 0.5 * float((x - 1.0) @ precision @ (x - 1.0)), np.ones(2), 0.01 * np.eye(2))
    np.testing.assert_allclose(draws.mean(axis=0), 1.0, atol=0.35)
    np.testing.assert_allclose(draws.std(axis=0), np.sqrt(np.diag(root @ root.T)), rtol=0.35)
    again = ensemble(lambda x: 0.5 * float((x - 1.0) @ precision @ (x - 1.0)), np.ones(2), 0.01 * np.eye(2))
    assert draws.tobytes() == again.tobytes()


def test_ensembles_follow_a_bent_ridge() -> None:
    draws = ensemble(
        lambda x: 0.5 * x[0] ** 2 + 0.5 * ((x[1] - x[0] ** 2) / 0.2) ** 2,
        np.zeros(2),
        0.1 * np.eye(2),
    )
    assert draws[:, 0].std() == pytest.approx(1.0, rel=0.4)
    assert np.abs(draws[:, 1] - draws[:, 0] ** 2).mean() < 0.2


def test_the_misfit_rises_by_the_covariance_where_all_is_linear(kit) -> None:  # type: ignore[no-untyped-def]
    problem = kit.closed_problem(seed=3, effect=0.2)
    found = kit.fitted(problem, Term(kit.offset_effect(), "y1"), iterations=40)
    screen = Screen(problem, found, record_noise=False)
    (centre,), deviation = found.point.effect, float(np.sqrt(found.effect_covariance[0, 0]))
    for steps in (-2.0, 0.5, 1.0):
        moved = centre + steps * deviation
        rise = screen.rise(np.array([moved])) + 0.5 * (moved**2 - centre**2)
        # a fit ends a little beside its optimum
        assert rise == pytest.approx(0.5 * steps**2, rel=0.01)
    assert with_draws(problem, found) is found


def rippled(kit, steepest: float) -> Effect:  # type: ignore[no-untyped-def]
    """An offset with a ripple on it, whose slope is nearly twice that of its course at one value."""
    smooth = kit.offset_effect()

    def build(setting, values, place):  # type: ignore[no-untyped-def]
        size = values["offset"]
        offset = size + 0.9 / RIPPLES * sin(RIPPLES * (size - steepest))
        return ModelPatch((RunOffset("A", offset, channel=place, quantity=""),))

    return replace(smooth, identifier="rippled", build=build)


def test_intervals_are_as_wide_as_the_posterior_behind_ripples(kit) -> None:  # type: ignore[no-untyped-def]
    problem = kit.closed_problem(seed=3, effect=0.2)
    candidate = Candidate((Term(kit.offset_effect(), "y1"),))
    smooth = fit(problem, candidate, problem.start(candidate), iterations=40)
    steepest = named_effects(problem, smooth)[0].parameters[0].value
    candidate = Candidate((Term(rippled(kit, steepest), "y1"),))
    found = fit(problem, candidate, smooth.point, iterations=40)
    drawn = with_draws(problem, found)
    (narrow,) = named_effects(problem, found)[0].parameters
    (wide,) = named_effects(problem, drawn)[0].parameters
    (course,) = named_effects(problem, smooth)[0].parameters
    assert narrow.high - narrow.low < 0.65 * (course.high - course.low)
    assert wide.high - wide.low == pytest.approx(course.high - course.low, rel=0.3)
    assert with_draws(problem, found).draws.tobytes() == drawn.draws.tobytes()
    (patches,) = patch_draws(problem, drawn, seed=1, count=300)
    offsets = np.array([item.offset for patch in patches for item in patch])
    assert np.ptp(np.quantile(offsets, (0.05, 0.95))) == pytest.approx(course.high - course.low, rel=0.3)


# ---------------------------------------------------------------- predictions of held-out trials


def held_out_problem(kit, seed, **more):  # type: ignore[no-untyped-def]
    problem = kit.closed_problem(seed=seed, noise=NoiseRecord(0.02, inf), samples=25, **more)
    trials = tuple(
        replace(trial, held_out=trial.name in ("down", "two")) for trial in problem.campaign.trials
    )
    campaign = replace(problem.campaign, trials=trials)
    return Problem(campaign, problem.model, problem.setting)


def test_intervals_cover_under_the_right_model(kit) -> None:  # type: ignore[no-untyped-def]
    """90 % intervals of held-out readings hold 90 % of them, over many short campaigns."""
    inside, square, count = 0, 0.0, 0
    for seed in range(60):
        problem = held_out_problem(kit, seed, gain_deviation=0.02)
        found = kit.fitted(problem)
        for item in residual_set(problem, found, sensitivities=False).trials:
            if item.trial.held_out:
                z = item.residual / item.predictive_deviation
                inside += int(np.count_nonzero(np.abs(z) < 1.6448536))
                square += float((z**2).sum())
                count += z.size
    # readings of a campaign are not independent: three times the binomial error
    error = 3.0 * np.sqrt(0.09 / count)
    assert abs(inside / count - 0.9) < 2.0 * error
    assert abs(square / count - 1.0) < 0.08


def test_covariance_of_fitted_residuals_is_that_of_the_dense_problem(kit) -> None:  # type: ignore[no-untyped-def]
    problem = held_out_problem(kit, 3)
    found = kit.fitted(problem)
    linear = kit.Linear(problem, Candidate())
    _, a = linear.dense()
    covariance = a @ np.linalg.solve(a.T @ a + np.diag(linear.precision), a.T)
    fitted = [item for item in residual_set(problem, found).trials if not item.trial.held_out]
    leverage = np.concatenate([item.leverage.ravel() for item in fitted])
    np.testing.assert_allclose(leverage, np.diag(covariance), rtol=1e-6, atol=1e-9)
    rows = np.concatenate([item.sensitivity.reshape(-1, item.sensitivity.shape[2]) for item in fitted])
    np.testing.assert_allclose(rows @ rows.T, covariance, rtol=1e-5, atol=1e-8)


def test_held_out_trials_move_nothing_that_is_shared(kit) -> None:  # type: ignore[no-untyped-def]
    problem = held_out_problem(kit, 5)
    found = kit.fitted(problem)
    there = problem.with_trials(problem.campaign.held_out)
    start = Point(found.point.shared, tuple(np.zeros(d.unknowns.size) for d in there.trials), np.empty(0))
    adapted = fit(there, Candidate(), start, local_only=True)
    np.testing.assert_array_equal(adapted.point.shared, found.point.shared)
    assert any(np.any(u != 0.0) for u in adapted.point.local)
    # its own nuisances are at their optimum given the rest: the dense solution of one trial
    for number, data in enumerate(there.trials):
        parts = there.linearise(number, start, Candidate())
        local, _ = there.derivatives(number, start, parts, Candidate()).dense()
        residual = there.residual(number, start, parts.response).ravel()
        exact = np.linalg.solve(local @ local.T + np.diag(data.unknowns.precision), local @ residual)
        np.testing.assert_allclose(adapted.point.local[number], exact, atol=0.02)


def test_held_out_readings_do_not_reach_the_fit(kit) -> None:  # type: ignore[no-untyped-def]
    problem = held_out_problem(kit, 6)
    wild = tuple(
        replace(trial, values=trial.values + 7.0) if trial.held_out else trial
        for trial in problem.campaign.trials
    )
    other = Problem(replace(problem.campaign, trials=wild), problem.model, problem.setting)
    first, second = (kit.fitted(p) for p in (problem, other))
    np.testing.assert_array_equal(first.point.shared, second.point.shared)
    assert first.log_evidence == second.log_evidence
