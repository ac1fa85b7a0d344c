"""The gate of consistency: its statistic against dense least squares, its level, its power."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from scipy.stats import binom, kstest

from discrepancy.campaign.records import NoiseRecord, TrialKind
from discrepancy.catalogue.entry import Setting
from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.fitting import fit
from discrepancy.fits.gates import absolute_gate
from discrepancy.fits.problem import Problem
from discrepancy.judgement.consistency_gate import (
    CONSISTENCY_LEVEL,
    consistency_gate,
    directions,
    score_tests,
)
from discrepancy.judgement.naming import name
from discrepancy.verdict import VerdictKind

STATIONS = {"y1": 0.2, "y2": 0.6, "y3": 0.9}


def changed(problem, *, record=None, size=None, shift=0.0, place="middle", flight=False):  # type: ignore[no-untyped-def]
    """Return the problem with stations, its second static trial under another load place or in flight.

    `record` replaces the channels' noise records; `size` multiplies the readings of channels in that trial,
    `shift` is added to all of them.
    """
    campaign = problem.campaign
    channels = {
        key: replace(item, station=STATIONS[key], noise=record or item.noise)
        for key, item in campaign.channels.items()
    }
    trials = []
    for trial in campaign.trials:
        if trial.kind is TrialKind.STATIC and trial.run == "B":
            values = trial.values * [(size or {}).get(key, 1.0) for key in trial.channels] + shift
            trial = replace(trial, load_place=place, values=values)
            if flight:
                trial = replace(
                    trial, kind=TrialKind.FLIGHT, load_factor=trial.force, force=0.0 * trial.force
                )
        trials.append(trial)
    campaign = replace(campaign, channels=channels, trials=tuple(trials))
    return Problem(campaign, problem.model, Setting(campaign, problem.model, problem.model.scales(campaign)))


def fitted(problem, effect, place):  # type: ignore[no-untyped-def]
    candidate = Candidate((Term(effect, place),))
    return fit(problem, candidate, problem.start(candidate), iterations=40)


def _tests_of(problem, found):  # type: ignore[no-untyped-def]
    return score_tests(problem, found, directions(problem, found))


def test_statistic_is_the_fall_of_the_penalised_sum_of_squares(kit) -> None:  # type: ignore[no-untyped-def]
    """Dense least squares with and without the directions; the effect without its prior in both."""
    problem = kit.closed_problem(seed=3, effect=0.4, samples=30, noise=NoiseRecord(0.02, inf))
    found = fitted(problem, kit.offset_effect(), "y1")
    generator = np.random.default_rng(5)
    columns = [
        {0: 0.02 * generator.standard_normal(problem.trials[0].weight.shape)},
        {n: 0.02 * generator.standard_normal(problem.trials[n].weight.shape) for n in (1, 2, 3)},
    ]
    (test,) = score_tests(problem, found, {"both": {"a": columns[0], "b": columns[1]}})
    dense = kit.Linear(problem, found.candidate)
    y, matrix = dense.dense()
    extra = np.zeros((len(y), 2))
    ends = np.cumsum([0, *(int((data.weight > 0.0).sum()) for data in problem.trials)])
    for k, direction in enumerate(columns):
        for number, column in direction.items():
            data = problem.trials[number]
            extra[ends[number] : ends[number + 1], k] = data.standardised(column)[data.weight > 0.0]
    precision = dense.precision.copy()
    shared = problem.shared.size
    precision[shared : shared + found.candidate.size] = 0.0
    left = []
    for a, p in ((matrix, precision), (np.hstack((matrix, extra)), np.concatenate((precision, [0.0, 0.0])))):
        x = np.linalg.solve(a.T @ a + np.diag(p), a.T @ y)
        left.append(float(np.sum((y - a @ x) ** 2) + p @ x**2))
    assert test.count == 2
    assert test.statistic == pytest.approx(left[0] - left[1], rel=1e-5)


@pytest.mark.parametrize("freedom", [pytest.param(inf, marks=pytest.mark.long), 30.0])
def test_p_values_are_uniform_where_the_name_is_right(kit, freedom: float) -> None:  # type: ignore[no-untyped-def]
    """100 campaigns with the effect that is named: Kolmogorov-Smirnov, and the rejections at 5 %."""
    generator = np.random.default_rng(11)
    effect = kit.offset_effect()
    found: dict[str, list[float]] = {"static loads": [], "zeros of the static runs": [], "channel y1": []}
    for seed in range(100):
        scale = 1.0 if freedom == inf else float(np.sqrt(generator.chisquare(freedom) / freedom))
        drawn = kit.closed_problem(
            seed=seed, effect=0.3 * generator.standard_normal(), samples=20, noise=NoiseRecord(0.02, inf)
        )
        problem = changed(drawn, record=NoiseRecord(0.02 * scale, freedom))
        for test in _tests_of(problem, fitted(problem, effect, "y1")):
            found[test.name].append(test.p_value)
    for values in found.values():
        assert len(values) == 100
        assert kstest(values, "uniform").pvalue > 1e-3
        assert sum(p < 0.05 for p in values) <= binom.isf(1e-3, 100, 0.05)


MIDDLE = np.mean(list(STATIONS.values()))
OFFSET = {"seed": 4, "effect": 0.5}


@pytest.mark.parametrize(
    ("made", "place", "change", "words"),
    [
        # drift of y2 named where y2 reads 15 % more under one of two loads
        ({"seed": 2}, "y2", {"size": {"y2": 1.15}}, ("channel y2", "middle")),
        # a load 5 % too large at one of two places
        (OFFSET, "y1", {"size": dict.fromkeys(STATIONS, 1.05)}, ("static loads",)),
        # lift 4 % too small inboard and too large outboard, which a size alone does not hold
        (OFFSET, "y1",
         {"flight": True, "size": {name: 1.0 + 0.12 * (at - MIDDLE) for name, at in STATIONS.items()}},
         ("loads of flight", "the slope over the span in flight")),
        # all displacements of one run off by four deviations, with zeros that are known to be small
        ({**OFFSET, "offset_deviation": 0.005}, "y1", {"shift": 0.08}, ("zero of displacement in run B",)),
    ],
)  # fmt: skip
def test_what_the_sum_of_squares_does_not_show_is_seen(kit, made, place, change, words) -> None:  # type: ignore[no-untyped-def]
    """Few wrong readings among many samples of motion."""
    truth = kit.closed_problem(samples=1500, **made)
    effect = kit.offset_effect() if place == "y1" else kit.drift_effect()
    flight = change.get("flight", False)
    right = changed(truth, flight=flight)
    assert consistency_gate(right, fitted(right, effect, place)).passed
    wrong = changed(truth, **change)
    found = fitted(wrong, effect, place)
    assert absolute_gate(wrong, found).passed
    gate = consistency_gate(wrong, found)
    assert gate.passed is False
    assert gate.statistic < CONSISTENCY_LEVEL
    assert all(word in gate.reason for word in words)
    flights = ["loads of flight"] * flight
    names = [test.name for test in _tests_of(wrong, found)]
    assert names == ["static loads", *flights, "zeros of the static runs", f"channel {place}"]


def test_runs_without_a_label_have_one_zero(kit) -> None:  # type: ignore[no-untyped-def]
    problem = changed(kit.closed_problem(seed=4, effect=0.5))
    trials = tuple(replace(trial, run="") for trial in problem.campaign.trials)
    whole = Problem(replace(problem.campaign, trials=trials), problem.model, problem.setting)
    tests = _tests_of(whole, fitted(whole, kit.offset_effect(), "y1"))
    (zeros,) = (test for test in tests if test.name == "zeros of the static runs")
    assert zeros.strongest.startswith("the zero of displacement in the runs without a label (")


def test_a_zero_that_moves_is_as_large_in_a_noisy_trial(kit) -> None:  # type: ignore[no-untyped-def]
    """The second ring-down has 1.5 times the noise; two static trials of one run have other channels."""
    problem = changed(kit.closed_problem(seed=4, effect=0.5))
    assert {data.trial.noise_factor for data in problem.trials} == {1.0, 1.5}
    along = directions(problem, fitted(problem, kit.offset_effect(), "y1"))["channel y1"]
    starts = {n: data.trial.start for n, data in enumerate(problem.trials)}
    assert len(set(starts.values())) == 4
    drift = {n: column.max() for n, column in along["the zero over time"].items()}
    assert drift == pytest.approx({n: drift[3] * start / starts[3] for n, start in starts.items()})

    channels = dict(problem.campaign.channels)
    channels["y3"] = replace(channels["y3"], noise=NoiseRecord(0.1, inf))
    first, second, *others = (replace(trial, run="A") for trial in problem.campaign.trials)
    kept = {"channels": second.channels[1:], "values": second.values[:, 1:], "used": second.used[:, 1:]}
    assert "y3" not in kept["channels"]
    campaign = replace(problem.campaign, channels=channels, trials=(first, replace(second, **kept), *others))
    other = Problem(campaign, problem.model, problem.setting)
    along = directions(other, fitted(other, kit.offset_effect(), "y1"))
    (zeros,) = along["zeros of the static runs"].values()
    assert {float(value) for column in zeros.values() for value in column.ravel()} == {0.02}


def test_what_fails_the_gate_is_not_named(kit) -> None:  # type: ignore[no-untyped-def]
    truth = kit.closed_problem(seed=4, effect=0.5, samples=1500)
    effects = (kit.offset_effect(),)
    verdict, _, _ = name(changed(truth), effects)
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    assert [gate.name for gate in verdict.gates] == [
        "absolute fit", "shape", "consistency", "held-out trials",
    ]  # fmt: skip
    verdict, _, _ = name(changed(truth, size=dict.fromkeys(STATIONS, 1.05)), effects)
    assert verdict.kind is VerdictKind.UNEXPLAINED, verdict.sentence
    assert "static loads" in verdict.sentence
    assert verdict.effects == ()


def test_without_loads_the_gate_is_not_applied(kit) -> None:  # type: ignore[no-untyped-def]
    problem = kit.closed_problem(seed=1, kinds=("ringdown",))
    found = kit.fitted(problem)
    gate = consistency_gate(problem, found)
    assert gate.passed is None
    assert np.isnan(gate.statistic)


def test_what_is_free_already_is_no_direction(kit) -> None:  # type: ignore[no-untyped-def]
    """The derivative by the effect itself, whatever its prior, and a direction that is nothing."""
    problem = kit.closed_problem(seed=3, effect=0.4, samples=30)
    found = fitted(problem, kit.offset_effect(), "y1")
    own = {n: part.effect[0] for n, part in enumerate(found.linearisations) if np.any(part.effect)}
    nothing = {0: np.zeros_like(problem.trials[0].weight)}
    assert score_tests(problem, found, {"own": {"offset": own}, "nothing": {"zero": nothing}}) == []
    assert score_tests(problem, found, {}) == []
