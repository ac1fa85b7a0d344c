"""Every column of the Jacobian against central differences of the residual."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from discrepancy.campaign.records import NoiseRecord
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import effect_by_identifier
from discrepancy.fits.candidate import PARAMETER_STEP, Candidate, Term
from discrepancy.fits.problem import Problem

FloatArray = NDArray[np.float64]

STEP = 1e-4
TOLERANCE = 0.03  # of the column's norm: the code's one-sided step by nuisances is 1e-2 of a prior deviation


def coloured_record(deviation: float, interval: float) -> NoiseRecord:
    generator = np.random.default_rng(11)
    samples, state = np.empty(3000), 0.0
    for n in range(len(samples)):
        state = 0.7 * state + generator.standard_normal()
        samples[n] = deviation * np.sqrt(1.0 - 0.49) * state
    return NoiseRecord(float(samples.std()), 2999.0, samples, interval, "pre-trigger")


def check(kit, problem, candidate, effect=None, tolerance=TOLERANCE, spread=0.5):  # type: ignore[no-untyped-def]
    linear = kit.Linear(problem, candidate)
    x = spread * np.random.default_rng(1).standard_normal(linear.size)
    if effect is not None:
        x[problem.shared.size : problem.shared.size + candidate.size] = effect
    point = linear.point(x)
    numerical = np.stack(
        [
            (linear.residual(x - STEP * e) - linear.residual(x + STEP * e)) / (2.0 * STEP)
            for e in np.eye(linear.size)
        ]
    )
    columns = np.zeros_like(numerical)
    at, first = 0, problem.shared.size + candidate.size
    for number, data in enumerate(problem.trials):
        parts = problem.linearise(number, point, candidate)
        derivatives = problem.derivatives(number, point, parts, candidate)
        (local, shared), index = derivatives.dense(), derivatives.index
        counts = (data.weight > 0.0).ravel()
        assert np.all(local[:, ~counts] == 0.0)
        assert np.all(shared[:, ~counts] == 0.0)
        stop = at + int(counts.sum())
        columns[index, at:stop] = shared[:, counts]
        columns[first : first + len(local), at:stop] = local[:, counts]
        at, first = stop, first + len(local)
    for number, (have, want) in enumerate(zip(columns, numerical, strict=True)):
        error = np.linalg.norm(have - want)
        assert error <= tolerance * np.linalg.norm(want) + 1e-9, f"unknown {number}: {error}"


@pytest.mark.parametrize("at_rest", [True, False])
@pytest.mark.parametrize("coloured", [True, False])
def test_all_unknowns_of_the_closed_form(kit, at_rest: bool, coloured: bool) -> None:  # type: ignore[no-untyped-def]
    """Parameters, gains, zeros, initial state, time zero, health of every load level, effect."""
    noise = coloured_record(0.02, 0.01) if coloured else None
    problem = kit.closed_problem(
        bent=True, noise=noise, gain_deviation=0.1, health=True, at_rest=at_rest, time_zero=0.003,
        left_out={0: ((2, 1),), 2: ((0, 0), (30, 2), (59, 1))}, samples=80,
    )  # fmt: skip
    if coloured:
        assert all(problem.noise[name].applies(0.01) for name in problem.channel_names)
    effects = (Term(kit.offset_effect(), "y1"), Term(kit.drift_effect(), "y2"))
    check(kit, problem, Candidate(effects))


EFFECTS = {
    "coulomb_friction": ("joint", 0.1),  # sticking ends at a sample or the next: not smooth
    "quadratic_damping": ("end", TOLERANCE),
    "cubic_stiffness": ("joint", TOLERANCE),
    "point_mass": ("", TOLERANCE),
    "root_compliance": ("", TOLERANCE),
    "gauge_gain": ("g1", TOLERANCE),
    "clock_error": ("", TOLERANCE),
}


@pytest.mark.parametrize("identifier", EFFECTS)
def test_effects_on_the_chain(kit, bench, catalogue, identifier: str) -> None:  # type: ignore[no-untyped-def]
    problem = bench.problem(bench.measured(1))
    place, tolerance = EFFECTS[identifier]
    term = Term(effect_by_identifier(identifier, catalogue), place)
    check(kit, problem, Candidate((term,)), effect=0.3, spread=0.3, tolerance=tolerance)


def test_free_shape_has_its_own_columns(kit, bench, catalogue) -> None:  # type: ignore[no-untyped-def]
    problem = bench.problem(bench.measured(1))
    effect = effect_by_identifier("quadratic_damping", catalogue)
    candidate = Candidate((Term(effect, "end", free_shape=True),))
    assert candidate.size == len(effect.parameters) + len(effect.shape)
    check(kit, problem, candidate, effect=candidate.start() + 0.1, spread=0.2, tolerance=0.06)


def test_chord_steps_are_exact_at_the_base_and_second_order_away(kit, bench, catalogue) -> None:  # type: ignore[no-untyped-def]
    """A chord response differs from the true one by the square of the distance from the base."""
    problem = bench.problem(bench.measured(1))
    candidate = Candidate((Term(effect_by_identifier("gauge_gain", catalogue), "g1"),))
    none = kit.fitted(problem)
    number = len(problem.trials) - 1
    generator = np.random.default_rng(0)
    away = (
        generator.standard_normal(problem.shared.size),
        generator.standard_normal(none.point.local[number].size),
    )
    errors = []
    for size in (0.0, 0.02, 0.04):
        point = replace(
            none.point,
            shared=none.point.shared + size * away[0],
            local=(*none.point.local[:number], none.point.local[number] + size * away[1]),
            effect=np.array([0.3]),
        )
        chord = problem.linearise(number, point, candidate, none, derivatives=False).response
        exact = problem.linearise(number, point, candidate, derivatives=False).response
        errors.append(float(np.abs((chord - exact) / problem.trials[number].deviation).max()))
    assert errors[0] < 1e-9
    assert errors[1] < 0.05 * float(np.abs(away[0]).max())
    assert errors[2] < 4.5 * errors[1]


def test_samples_that_do_not_count_change_nothing(kit) -> None:  # type: ignore[no-untyped-def]
    """Readings left out, and what the whitening filter smears of them, weigh zero whatever they are."""
    noise = coloured_record(0.02, 0.01)
    problem = kit.closed_problem(noise=noise, left_out={2: ((30, 1), (31, 1)), 0: ((3, 0),)})
    wild = []
    for trial in problem.campaign.trials:
        values = trial.values.copy()
        values[~trial.used] = 1e6
        wild.append(replace(trial, values=values))
    campaign = replace(problem.campaign, trials=tuple(wild))
    other = Problem(campaign, problem.model, Setting(campaign, problem.model, problem.setting.scales))
    linear = kit.Linear(problem, Candidate())
    x = 0.3 * np.random.default_rng(0).standard_normal(linear.size)
    point = linear.point(x)
    for number in range(len(problem.trials)):
        first, second = (
            p.residual(number, point, p.linearise(number, point, Candidate(), derivatives=False).response)
            for p in (problem, other)
        )
        np.testing.assert_allclose(first, second, atol=1e-9)


def test_products_by_channel_are_those_of_all_readings(kit) -> None:  # type: ignore[no-untyped-def]
    """J W J^T, J d and the trace of J^T covariance J by channel, beside the same with dense matrices."""
    noise = coloured_record(0.02, 0.01)
    problem = kit.closed_problem(
        bent=True, noise=noise, gain_deviation=0.1, health=True, time_zero=0.003, left_out={1: ((3, 1),)},
        samples=80,
    )  # fmt: skip
    candidate = Candidate((Term(kit.offset_effect(), "y1"), Term(kit.drift_effect(), "y2")))
    generator = np.random.default_rng(2)
    point = kit.Linear(problem, candidate).point(
        generator.standard_normal(kit.Linear(problem, candidate).size)
    )
    for number, data in enumerate(problem.trials):
        found = problem.derivatives(number, point, problem.linearise(number, point, candidate), candidate)
        dense = np.vstack(found.dense())
        count = len(data.trial.channels)
        weights = generator.uniform(0.5, 2.0, count)
        products = found.products()
        every = np.tile(weights, dense.shape[1] // count)
        np.testing.assert_allclose(
            found.normal(products, weights), (dense * every) @ dense.T, rtol=1e-12, atol=1e-9
        )
        readings = generator.standard_normal((count, dense.shape[1] // count))
        np.testing.assert_allclose(found.onto(readings), dense @ readings.T.ravel(), rtol=1e-12, atol=1e-9)
        only = np.zeros_like(readings)
        only[1] = readings[1]
        np.testing.assert_allclose(
            found.onto(readings[1:2], [1]), dense @ only.T.ravel(), rtol=1e-12, atol=1e-9
        )
        root = generator.standard_normal((found.size, found.size))
        covariance = root @ root.T
        leverage = np.einsum("kn,kl,ln->n", dense, covariance, dense) * every
        np.testing.assert_allclose(
            found.spread(products, weights, covariance),
            leverage.reshape(-1, count).sum(axis=0), rtol=1e-10, atol=1e-9,
        )  # fmt: skip


def test_derivatives_by_an_effect_have_no_curvature_in_them(bench, catalogue) -> None:  # type: ignore[no-untyped-def]
    """Of an effect on frequencies nuisances leave less than a one-sided difference errs by."""
    problem = bench.problem(bench.measured(4, bench.patch("root_compliance", {"compliance_share": 0.3})))
    effect = next(item for item in catalogue if item.identifier == "root_compliance")
    candidate = Candidate((Term(effect),))
    point = problem.start(candidate)

    def response(number: int, move: float) -> FloatArray:
        patch = candidate.patch(problem.setting, point.effect + move)
        return problem.response(number, point.shared, point.local[number], patch)[0]

    rings = [n for n, data in enumerate(problem.trials) if data.trial.is_dynamic]
    assert rings
    for number in rings:
        exact = (response(number, STEP) - response(number, -STEP)) / (2.0 * STEP)
        one_sided = (response(number, PARAMETER_STEP) - response(number, 0.0)) / PARAMETER_STEP
        found = problem.linearise(number, point, candidate).effect[0]
        size = np.linalg.norm(exact)
        assert np.linalg.norm(one_sided - exact) > 2e-3 * size
        assert np.linalg.norm(found - exact) < 1e-4 * size
