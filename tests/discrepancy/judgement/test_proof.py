"""Trials held out for the proof; scores, gaps, errors over trials. Consistency: statistic, level, power."""

from dataclasses import replace
from math import isnan, log, pi

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter

from discrepancy.campaign.held_out import choose_held_out
from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.errors import FitError
from discrepancy.fits.gates import check_absolute_fit
from discrepancy.judgement.closed_share import closed_share
from discrepancy.judgement.consistency_gate import check_consistency, directions_by_test, score_tests
from discrepancy.judgement.naming import reach_verdict
from discrepancy.judgement.proof import (
    check_held_out,
    compute_scores,
    correlation_time,
    log_density,
    prove_effects,
)
from discrepancy.verdict import VerdictKind
from tests.discrepancy.bench import Bench, with_noise
from tests.discrepancy.core import kit


def lacking(bench, size):
    """Return what a model lacks in every release."""
    shape = np.array([1.0, 0.8, 0.5, 0.2])
    return {
        n: np.outer(size * np.cos(2 * np.pi * 9.0 * t.time) * np.exp(-0.8 * t.time), shape)
        for n, t in enumerate(bench.trials)
        if t.release is not None
    }


MANY = (200.0, 180.0, 150.0, 120.0, 100.0, 80.0)
HELD = (False, True, False, True, True, True)


def test_scores_of_a_right_model():
    bench = Bench(count=400, amplitudes=MANY, held_out=HELD, noise_freedom=2000.0)
    fitted = bench.fit(np.random.default_rng(13))
    for part in (fitted.fitted, fitted.held_out):
        found = compute_scores(part)
        expected = pytest.approx(found.chi_square_expected, abs=4.0 * found.chi_square_deviation)
        assert found.chi_square_per_sample == expected
        assert found.coverage_50 == pytest.approx(0.5, abs=0.03)
        assert found.coverage_90 == pytest.approx(0.9, abs=0.02)
        assert found.log_score == pytest.approx(-0.5 * (1.0 + log(2.0 * pi)), abs=0.06)
        assert found.whiteness > 0.01
        assert found.pit_p_value > 0.01
        assert sum(found.pit) == pytest.approx(1.0)
        assert found.rms["g1"] == pytest.approx(2.0, rel=0.1)
        wide = [replace(item, predictive_deviation=1.5 * item.predictive_deviation) for item in part.trials]
        assert compute_scores(replace(part, trials=tuple(wide))).pit_p_value < 1e-6
        again = [replace(item, residual=np.repeat(item.residual[::8], 8, axis=0)) for item in part.trials]
        assert (
            compute_scores(replace(part, trials=tuple(again))).pit_p_value > 0.01
        )  # what repeats itself counts once


def test_the_share_closed_is_one_less_the_square_of_the_errors_over_each_other():
    """Half the error leaves a quarter of it; where nothing changed the share is zero."""
    bench = Bench(amplitudes=MANY, held_out=HELD)
    before = bench.fit(np.random.default_rng(5), extra=lacking(bench, 25.0))
    after = bench.fit(np.random.default_rng(5))
    assert [check_held_out(item).passed for item in (before, after)] == [False, True]
    proof = prove_effects(before, after)
    assert proof.held_out_before.chi_square_per_sample > 3.0
    left = proof.held_out_after.chi_square_per_sample / proof.held_out_before.chi_square_per_sample
    assert proof.closed.value == pytest.approx(1.0 - left)
    assert proof.closed.low < proof.closed.value < proof.closed.high
    assert proof.closed_reason == ""
    assert proof.log_score_gain > 5.0 * proof.log_score_gain_error > 0.0
    other = [replace(item, noise_deviation=3.0 * item.noise_deviation) for item in after.trials]  # its own
    gain = prove_effects(before, replace(after, trials=tuple(other))).log_score_gain
    assert gain == pytest.approx(proof.log_score_gain)
    assert proof.remaining.startswith("These data show no remaining error")
    none = prove_effects(before, before)
    assert none.closed.value == 0.0
    assert none.log_score_gain == none.log_score_gain_error == 0.0
    assert none.remaining.startswith("Still unexplained: χ² per sample")
    exact = Bench(amplitudes=MANY, held_out=HELD, noise_freedom=np.inf)
    sets = [exact.fit(np.random.default_rng(6), extra=lacking(exact, size)) for size in (400.0, 200.0)]
    assert prove_effects(*sets).closed.value == pytest.approx(0.75, abs=0.03)


def test_no_gap_is_said_and_not_divided_by():
    """Nor is there one without a held-out trial or a noise record."""
    fitted = Bench(amplitudes=(200.0, 150.0), held_out=(False, True)).fit(np.random.default_rng(7))
    proof = prove_effects(fitted, fitted)
    assert proof.closed is None
    assert "show no gap before" in proof.closed_reason
    bare = with_noise(fitted, None)
    assert check_held_out(bare).passed is None
    proof = prove_effects(bare, bare)
    assert isnan(proof.held_out_after.chi_square_per_sample)
    assert proof.closed.value == 0.0  # of the error itself
    assert "not known" in proof.remaining
    without = Bench().fit(np.random.default_rng(7))
    proof = prove_effects(without, without)
    assert proof.closed.trials == "fitted"
    assert isnan(proof.log_score_gain)
    assert proof.closed_reason == "No trial was held out."
    assert proof.held_out_after is None


def with_error(residuals, factor):
    """Return residuals so many times as large, of a posterior so wide that all of them are within it."""
    trials = [
        replace(
            item,
            residual=factor * item.residual,
            predictive_deviation=100.0 * item.predictive_deviation,
            leverage=item.leverage + (1e4 if item.trial.held_out else 0.0),
            sensitivity=None,
        )
        for item in residuals.trials
    ]
    return replace(residuals, trials=tuple(trials))


def test_an_error_that_grew_is_a_negative_share_however_wide_the_posterior():
    bench = Bench(amplitudes=MANY, held_out=HELD)
    before = bench.fit(np.random.default_rng(5), extra=lacking(bench, 25.0))
    proof = prove_effects(before, with_error(before, 1.4))
    assert proof.closed.value == pytest.approx(1.0 - 1.4**2)
    assert proof.closed.high < 0.0
    assert proof.has_grown
    ratio = proof.held_out_after.chi_square_per_sample / proof.held_out_before.chi_square_per_sample
    assert ratio == pytest.approx(1.4**2)


def test_a_share_of_few_blocks_has_no_interval():
    fitted = Bench(count=12, amplitudes=(200.0,)).fit(np.random.default_rng(3))
    closed = closed_share(fitted, with_error(fitted, 0.5))
    assert closed.value == pytest.approx(0.75)
    assert isnan(closed.low)
    assert isnan(closed.high)


def test_one_noise_is_under_both_errors_where_none_is_recorded():
    """What each hypothesis leaves in fitted trials is its own noise, which is not a measure of its error."""
    bare = with_noise(Bench(amplitudes=MANY, held_out=HELD).fit(np.random.default_rng(7)), None)
    trials = [replace(item, noise_deviation=0.01 * item.noise_deviation) for item in bare.trials]
    assert closed_share(bare, replace(bare, trials=tuple(trials))).value == pytest.approx(0.0)


def test_scores_of_one_set():
    """Density beside scipy; a short record widens the deviation; without a used sample there is none."""
    fitted = Bench(count=40, noise_freedom=np.inf).fit(np.random.default_rng(2))
    item = fitted.trials[0]
    expected = stats.norm.logpdf(item.residual, scale=item.predictive_deviation)
    np.testing.assert_allclose(log_density(item), expected + np.log(item.noise_deviation), rtol=1e-12)
    exact, loose = (
        compute_scores(residuals).chi_square_deviation / compute_scores(residuals).chi_square_expected
        for residuals in (fitted, with_noise(fitted, NoiseRecord(2.0, 10.0)))
    )
    assert loose**2 == pytest.approx(exact**2 + 0.2)
    unused = replace(item, trial=replace(item.trial, used=np.zeros_like(item.used)))
    with pytest.raises(FitError, match="at least one used sample"):
        compute_scores(replace(fitted, trials=(unused,)))


def test_standard_error_is_that_of_trials_not_of_samples():
    # Gains differ from trial to trial by a random size: only the number of trials can shrink the error.
    bench = Bench(count=200, amplitudes=MANY, held_out=HELD, noise_freedom=np.inf)
    generator = np.random.default_rng(9)
    found = []
    for _ in range(120):
        held = [n for n, t in enumerate(bench.trials) if t.held_out]
        extra = {n: generator.standard_normal() * 1.5 * np.ones((1, 4)) for n in held}
        seed = generator.integers(1 << 30)
        proof = prove_effects(*(bench.fit(np.random.default_rng(seed), extra=more) for more in (extra, None)))
        found.append((proof.log_score_gain, proof.log_score_gain_error))
    gains, errors = np.array(found).T
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.std(gains), rel=0.35)


def test_correlation_time_of_an_autoregression():
    white = np.random.default_rng(10).standard_normal((40, 4000))
    found = [correlation_time(series) for series in lfilter([1.0], [1.0, -0.8], white)]
    assert np.mean(found) == pytest.approx(1.8 / 0.2, rel=0.15)
    assert correlation_time(np.ones(10)) == 1.0
    assert correlation_time(np.array([1.0, -1.0] * 50)) == 1.0


# ---------------------------------------------------------------- the gate of consistency


STATIONS = {"y1": 0.2, "y2": 0.6, "y3": 0.9}


def changed(problem, *, record=None, size=None, shift=0.0, place="middle", flight=False):
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
        if trial.run == "B":
            values = trial.values * [(size or {}).get(key, 1.0) for key in trial.channels] + shift
            trial = replace(trial, load_place=place, values=values)
        if trial.run == "B" and flight:
            load = {"load_factor": trial.force, "force": 0.0 * trial.force}
            trial = replace(trial, kind=TrialKind.FLIGHT, **load)
        trials.append(trial)
    return kit.problem_of(replace(campaign, channels=channels, trials=tuple(trials)), problem.model)


def asked(problem, term=kit.OFFSET):
    """Return the fit of a term, the directions beside it and their tests."""
    found = kit.fitted(problem, term)
    along = directions_by_test(problem, found)
    return found, along, score_tests(problem, found, along)


def test_statistic_is_the_fall_of_the_penalised_sum_of_squares():
    """Dense least squares with and without the directions; the effect without its prior in both."""
    problem = kit.closed_problem(seed=3, effect=0.4, samples=30)
    found, _, _ = asked(problem)
    generator = np.random.default_rng(5)
    columns = [
        {n: 0.02 * generator.standard_normal(problem.trials[n].weight.shape) for n in numbers}
        for numbers in ((0,), (1, 2, 3))
    ]
    (test,) = score_tests(problem, found, {"both": {"a": columns[0], "b": columns[1]}})
    dense = kit.Linear(problem, found.candidate)
    y, matrix, _ = dense.dense()
    extra = np.zeros((len(y), 2))
    ends = np.cumsum([0, *(int((data.weight > 0.0).sum()) for data in problem.trials)])
    for k, direction in enumerate(columns):
        for number, column in direction.items():
            data = problem.trials[number]
            extra[ends[number] : ends[number + 1], k] = data.standardise(column)[data.weight > 0.0]
    precision = dense.precision.copy()
    first_effect = problem.shared.unknown_count
    precision[first_effect : first_effect + found.candidate.parameter_count] = 0.0
    left = []
    for a, p in ((matrix, precision), (np.hstack((matrix, extra)), np.concatenate((precision, [0.0, 0.0])))):
        x = np.linalg.solve(a.T @ a + np.diag(p), a.T @ y)
        left.append(float(np.sum((y - a @ x) ** 2) + p @ x**2))
    assert test.count == 2
    assert test.statistic == pytest.approx(left[0] - left[1], rel=1e-5)
    # what is free already is not a direction: the derivative by the effect itself, and one that is nothing
    own = {n: part.by_effect[0] for n, part in enumerate(found.trial_derivatives) if np.any(part.by_effect)}
    nothing = {0: np.zeros_like(problem.trials[0].weight)}
    assert score_tests(problem, found, {"own": {"offset": own}, "nothing": {"zero": nothing}}) == []
    assert score_tests(problem, found, {}) == []


def test_p_value_beside_a_short_noise_record_is_that_of_the_f_test():
    """Of the sums of squares without and with the directions, in deviations of the record."""
    problem = kit.with_noise(kit.closed_problem(seed=3, effect=0.4), y1=NoiseRecord(0.02, 12.0))
    found, _, _ = asked(problem)
    columns = 0.02 * np.random.default_rng(5).standard_normal((2, 9, 1)) * [1.0, 0.0, 0.0]
    (test,) = score_tests(problem, found, {"both": {"a": {0: columns[0]}, "b": {0: columns[1]}}})
    known = 12.0 + problem.sample_counts[0]
    square, freedom = 12.0 + found.squares_by_channel[0], known - found.absorbed_freedom[0] - 2
    fall = test.statistic * square / known
    assert test.p_value == pytest.approx(stats.f.sf(0.5 * fall / ((square - fall) / freedom), 2, freedom))


MIDDLE = np.mean(list(STATIONS.values()))
OFFSET = {"seed": 4, "effect": 0.5}


@pytest.mark.parametrize(
    ("made", "term", "change", "words"),
    [
        # drift of y2 named where y2 reads 15 % more under one of two loads
        ({"seed": 2}, kit.DRIFT, {"size": {"y2": 1.15}}, ("channel y2", "middle")),
        # a load 5 % too large at one of two places
        (OFFSET, kit.OFFSET, {"size": dict.fromkeys(STATIONS, 1.05)}, ("static loads",)),
        # lift 4 % too small inboard and too large outboard, which a size alone does not hold
        (OFFSET, kit.OFFSET,
         {"flight": True, "size": {name: 1.0 + 0.12 * (at - MIDDLE) for name, at in STATIONS.items()}},
         ("loads of flight", "the slope over the span in flight")),
        # all displacements of one run off by four deviations, with zeros that are known to be small
        ({**OFFSET, "offset_deviation": 0.005}, kit.OFFSET, {"shift": 0.08},
         ("zero of displacement in run B",)),
    ],
)  # fmt: skip
def test_what_the_sum_of_squares_does_not_show_is_seen(made, term, change, words):
    """Few wrong readings among many samples of motion; what fails the gate is not named."""
    truth = kit.closed_problem(samples=1500, **made)
    flight = change.get("flight", False)
    right, wrong = changed(truth, flight=flight), changed(truth, **change)
    assert check_consistency(right, asked(right, term)[0]).passed
    found, _, tests = asked(wrong, term)
    assert check_absolute_fit(wrong, found).passed
    gate = check_consistency(wrong, found)
    assert gate.passed is False
    assert gate.statistic < 1e-3
    assert all(word in gate.reason for word in words)
    loads = {"static loads", "loads of flight"} if flight else {"static loads"}
    assert {test.name for test in tests} == {*loads, "zeros of the static runs", f"channel {term.place}"}
    if words != ("static loads",):
        return
    verdict, _, _ = reach_verdict(right, (term.effect,))
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    assert [gate.name for gate in verdict.gates] == [
        "absolute fit",
        "shape",
        "consistency",
        "held-out trials",
    ]
    verdict, _, _ = reach_verdict(wrong, (term.effect,))
    assert verdict.kind is VerdictKind.UNEXPLAINED, verdict.sentence
    assert "static loads" in verdict.sentence
    assert verdict.effects == ()


def test_without_loads_there_is_nothing_to_be_consistent_with():
    without = kit.closed_problem(seed=1, kinds=("ringdown",))
    gate = check_consistency(without, kit.fitted(without))
    assert gate.passed is None
    assert np.isnan(gate.statistic)


# ---------------------------------------------------------------- what is held out


def trial(name, kind, top, count=4, run="A", channels=("x",)):
    rows = np.linspace(0.0, top, count)
    drive = {
        TrialKind.RINGDOWN: {"release": Release(top)},
        TrialKind.STATIC: {"force": rows},
        TrialKind.FLIGHT: {"load_factor": rows},
    }.get(kind, {})
    values = np.arange(float(count * len(channels))).reshape(count, len(channels))
    return Trial.plain(name, kind, tuple(channels), rows, values=values, load_place="x", run=run, **drive)


def chosen_of(*trials):
    channels = {name: Channel(name, Quantity.DISPLACEMENT, "x", None) for name in ("x", "y")}
    return choose_held_out(Campaign("", channels, trials, None, {}, ""))


def held(*trials):
    return [item.name for item in chosen_of(*trials).held_out]


def releases(*levels):
    return [trial(f"r{n}", TrialKind.RINGDOWN, value) for n, value in enumerate(levels)]


def test_what_only_one_trial_has_stays_and_what_is_marked_is_respected():
    first, second, third = releases(1.0, 0.5, 0.2)
    assert held(first, replace(second, run="B"), third) == []
    assert held(first, trial("r1", TrialKind.RINGDOWN, 0.5, channels=("x", "y")), third) == []
    marked = chosen_of(first, second, replace(third, held_out=True))
    assert [item.name for item in marked.held_out] == ["r2"]
    assert choose_held_out(marked) is marked
    few = chosen_of(first, second)
    assert not few.held_out
    assert "Nothing is held out" in few.remarks[-1]
    assert [item.name for item in few.trials] == ["r0", "r1"]


def test_amplitudes_inside_come_first():
    assert held(*releases(1.0, 0.5, 0.2)) == ["r1"]
    assert held(*releases(0.2, 1.0, 0.3, 0.6)) == ["r3"]
    assert held(*releases(1.0, 0.9, 0.6, 0.5, 0.3, 0.2)) == ["r2", "r3"]
    # The extremes stay: with three trials at two levels the one that repeats can go.
    assert held(*releases(1.0, 1.0, 0.2)) == ["r1"]
    assert held(*releases(1.0, 1.0, 1.0, 1.0, 1.0)) == ["r4"]


@pytest.mark.parametrize("kind", [TrialKind.STATIC, TrialKind.FLIGHT])
def test_load_levels_of_a_single_trial(kind):
    single = trial("s", kind, 8.0, count=9)
    chosen = chosen_of(single)
    (fitted,), (proof,) = chosen.fitted, chosen.held_out
    load = "force" if kind is TrialKind.STATIC else "load_factor"
    assert getattr(proof, load).tolist() == [2.0, 5.0]
    assert getattr(fitted, load).tolist() == [0.0, 1.0, 3.0, 4.0, 6.0, 7.0, 8.0]
    assert proof.values.tolist() == [[2.0], [5.0]]
    assert proof.name == "s, levels held out"
    assert held(trial("s", kind, 8.0, count=5)) == []
    path = np.concatenate([np.arange(5.0), np.arange(3.0, -1.0, -1.0)])
    assert held(replace(single, force=path, load_factor=0 * path)) == []  # a path that turns stays whole
