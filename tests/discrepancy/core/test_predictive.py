"""Predictions of held-out trials: coverage, and what may adapt to them."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np

from discrepancy.campaign.records import NoiseRecord
from discrepancy.fits.candidate import Candidate, Point
from discrepancy.fits.fitting import fit
from discrepancy.fits.predictive import residual_set
from discrepancy.fits.problem import Problem


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
