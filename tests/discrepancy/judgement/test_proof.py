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
from discrepancy.judgement.decide import reach_verdict
from discrepancy.judgement.proof import (
    check_held_out,
    compute_scores,
    log_density,
    prove_effects,
    samples_per_independent_sample,
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


@pytest.fixture(scope="module")
def right_model():
    """Residuals of a right model with 400 samples a trial."""
    bench = Bench(count=400, amplitudes=MANY, held_out=HELD, noise_freedom=2000.0)
    return bench.fit(np.random.default_rng(13))


@pytest.fixture(params=["fitted", "held_out"])
def right_residuals(request, right_model):
    return getattr(right_model, request.param)


def with_trials(residuals, change):
    """Return the residuals with each of their trials changed."""
    return replace(residuals, trials=tuple(change(trial) for trial in residuals.trials))


def test_a_right_model_has_the_chi_square_that_is_expected(right_residuals):
    scores = compute_scores(right_residuals)
    expected = pytest.approx(scores.chi_square_expected, abs=4.0 * scores.chi_square_deviation)
    assert scores.chi_square_per_sample == expected
    assert scores.rms["g1"] == pytest.approx(2.0, rel=0.1)


def test_intervals_of_a_right_model_cover_as_often_as_they_say(right_residuals):
    scores = compute_scores(right_residuals)
    assert scores.coverage_50 == pytest.approx(0.5, abs=0.03)
    assert scores.coverage_90 == pytest.approx(0.9, abs=0.02)


def test_a_right_model_has_the_log_score_of_a_normal_and_leaves_white_noise(right_residuals):
    scores = compute_scores(right_residuals)
    assert scores.log_score == pytest.approx(-0.5 * (1.0 + log(2.0 * pi)), abs=0.06)
    assert scores.whiteness > 0.01


def test_a_right_model_has_a_uniform_probability_integral_transform(right_residuals):
    scores = compute_scores(right_residuals)
    assert scores.pit_p_value > 0.01
    assert sum(scores.pit) == pytest.approx(1.0)


def test_a_deviation_that_is_too_large_shows_in_the_probability_integral_transform(right_residuals):
    wide = with_trials(
        right_residuals,
        lambda trial: replace(trial, predictive_deviation=1.5 * trial.predictive_deviation),
    )
    assert compute_scores(wide).pit_p_value < 1e-6


def test_a_residual_that_repeats_itself_counts_once(right_residuals):
    repeated = with_trials(
        right_residuals, lambda trial: replace(trial, residual=np.repeat(trial.residual[::8], 8, axis=0))
    )
    assert compute_scores(repeated).pit_p_value > 0.01


@pytest.fixture(scope="module")
def before():
    """Residuals before the model gets what it lacks."""
    bench = Bench(amplitudes=MANY, held_out=HELD)
    return bench.fit(np.random.default_rng(5), extra=lacking(bench, 25.0))


@pytest.fixture(scope="module")
def after():
    """Residuals of the model that has what it lacked."""
    return Bench(amplitudes=MANY, held_out=HELD).fit(np.random.default_rng(5))


@pytest.fixture(scope="module")
def closing_proof(before, after):
    return prove_effects(before, after)


def test_held_out_trials_tell_a_lacking_model_from_a_right_one(before, after, closing_proof):
    assert [check_held_out(residuals).passed for residuals in (before, after)] == [False, True]
    assert closing_proof.held_out_before.chi_square_per_sample > 3.0


def test_the_share_closed_is_one_less_the_square_of_the_errors_over_each_other(closing_proof):
    chi_square_before = closing_proof.held_out_before.chi_square_per_sample
    remaining = closing_proof.held_out_after.chi_square_per_sample / chi_square_before
    closed = closing_proof.closed
    assert closed.value == pytest.approx(1.0 - remaining)
    assert closed.low < closed.value < closed.high
    assert closing_proof.closed_reason == ""


def test_a_closed_gap_gains_log_score_and_leaves_nothing(closing_proof):
    assert closing_proof.log_score_gain > 5.0 * closing_proof.log_score_gain_error > 0.0
    assert closing_proof.remaining.startswith("These data show no remaining error")


def test_the_gain_of_log_score_does_not_depend_on_the_own_noise_of_the_later_fit(
    before, after, closing_proof
):
    noisier = with_trials(after, lambda trial: replace(trial, noise_deviation=3.0 * trial.noise_deviation))
    gain = prove_effects(before, noisier).log_score_gain
    assert gain == pytest.approx(closing_proof.log_score_gain)


def test_where_nothing_changed_the_share_is_zero(before):
    proof = prove_effects(before, before)
    assert proof.closed.value == 0.0
    assert proof.log_score_gain == proof.log_score_gain_error == 0.0
    assert proof.remaining.startswith("Still unexplained: χ² per sample")


def test_half_the_error_leaves_a_quarter_of_it():
    bench = Bench(amplitudes=MANY, held_out=HELD, noise_freedom=np.inf)
    whole, half = (bench.fit(np.random.default_rng(6), extra=lacking(bench, size)) for size in (400.0, 200.0))
    assert prove_effects(whole, half).closed.value == pytest.approx(0.75, abs=0.03)


@pytest.fixture(scope="module")
def without_gap():
    """Residuals of a right model, with a trial held out."""
    return Bench(amplitudes=(200.0, 150.0), held_out=(False, True)).fit(np.random.default_rng(7))


def test_no_gap_is_said_and_not_divided_by(without_gap):
    proof = prove_effects(without_gap, without_gap)
    assert proof.closed is None
    assert "do not test it" in proof.closed_reason


def test_without_a_noise_record_the_share_is_that_of_the_error_itself(without_gap):
    without_noise = with_noise(without_gap, None)
    proof = prove_effects(without_noise, without_noise)
    assert check_held_out(without_noise).passed is None
    assert isnan(proof.held_out_after.chi_square_per_sample)
    assert (proof.closed.value, "not known" in proof.remaining) == (0.0, True)


def test_without_a_held_out_trial_the_share_is_that_of_fitted_trials():
    without_proof = Bench().fit(np.random.default_rng(7))
    proof = prove_effects(without_proof, without_proof)
    assert (proof.closed.trials, proof.closed_reason) == ("fitted", "No trial was held out.")
    assert isnan(proof.log_score_gain)
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


def test_an_error_that_grew_is_a_negative_share_however_wide_the_posterior(before):
    proof = prove_effects(before, with_error(before, 1.4))
    assert proof.closed.value == pytest.approx(1.0 - 1.4**2)
    assert proof.closed.high < 0.0
    assert proof.has_grown


def test_an_error_that_grew_has_a_larger_chi_square(before):
    proof = prove_effects(before, with_error(before, 1.4))
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
    for _ in range(60):
        held = [n for n, t in enumerate(bench.trials) if t.held_out]
        extra = {n: generator.standard_normal() * 1.5 * np.ones((1, 4)) for n in held}
        seed = generator.integers(1 << 30)
        proof = prove_effects(*(bench.fit(np.random.default_rng(seed), extra=more) for more in (extra, None)))
        found.append((proof.log_score_gain, proof.log_score_gain_error))
    gains, errors = np.array(found).T
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.std(gains), rel=0.35)


def test_correlation_time_of_an_autoregression():
    white = np.random.default_rng(10).standard_normal((40, 4000))
    found = [samples_per_independent_sample(series) for series in lfilter([1.0], [1.0, -0.8], white)]
    assert np.mean(found) == pytest.approx(1.8 / 0.2, rel=0.15)
    assert samples_per_independent_sample(np.ones(10)) == 1.0
    assert samples_per_independent_sample(np.array([1.0, -1.0] * 50)) == 1.0


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


@pytest.fixture(scope="module")
def tested_problem():
    """A problem with an offset, and the fit of that offset."""
    problem = kit.closed_problem(seed=3, effect=0.4, samples=30)
    return problem, asked(problem)[0]


def penalised_sum_of_squares(matrix, precision, y):
    """Return the least sum of squares of a linear model with a Gaussian prior about zero."""
    x = np.linalg.solve(matrix.T @ matrix + np.diag(precision), matrix.T @ y)
    return float(np.sum((y - matrix @ x) ** 2) + precision @ x**2)


def standardised_columns(problem, directions, count):
    """Return directions as columns of the dense problem, in standard deviations of the noise."""
    columns = np.zeros((count, len(directions)))
    ends = np.cumsum([0, *(int((data.weight > 0.0).sum()) for data in problem.trials)])
    for column, direction in enumerate(directions):
        for number, values in direction.items():
            data = problem.trials[number]
            rows = slice(ends[number], ends[number + 1])
            columns[rows, column] = data.standardise(values)[data.weight > 0.0]
    return columns


def test_statistic_is_the_fall_of_the_penalised_sum_of_squares(tested_problem):
    """Dense least squares with and without the directions; the effect without its prior in both."""
    problem, fit = tested_problem
    generator = np.random.default_rng(5)
    first, second = (
        {n: 0.02 * generator.standard_normal(problem.trials[n].weight.shape) for n in numbers}
        for numbers in ((0,), (1, 2, 3))
    )
    (test,) = score_tests(problem, fit, {"both": {"a": first, "b": second}})
    dense = kit.Linear(problem, fit.candidate)
    y, matrix, _ = dense.dense()
    with_directions = np.hstack((matrix, standardised_columns(problem, [first, second], len(y))))
    precision = dense.precision.copy()
    first_effect = problem.shared.unknown_count
    precision[first_effect : first_effect + fit.candidate.parameter_count] = 0.0
    without = penalised_sum_of_squares(matrix, precision, y)
    beside = penalised_sum_of_squares(with_directions, np.concatenate((precision, [0.0, 0.0])), y)
    assert test.count == 2
    assert test.statistic == pytest.approx(without - beside, rel=1e-5)


def test_what_is_free_already_is_no_direction(tested_problem):
    """Neither the derivative by the effect itself, nor one that is nothing."""
    problem, fit = tested_problem
    derivatives = enumerate(fit.trial_derivatives)
    by_effect = {n: part.by_effect[0] for n, part in derivatives if np.any(part.by_effect)}
    nothing = {0: np.zeros_like(problem.trials[0].weight)}
    free = {"own": {"offset": by_effect}, "nothing": {"zero": nothing}}
    assert score_tests(problem, fit, free) == []
    assert score_tests(problem, fit, {}) == []


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


class HiddenInconsistency:
    """A problem with few wrong readings among many samples of motion, and the same without them."""

    def __init__(self, made, term, change, words):
        truth = kit.closed_problem(samples=1500, **made)
        self.is_flown = change.get("flight", False)
        self.term, self.words = term, words
        self.right = changed(truth, flight=self.is_flown)
        self.wrong = changed(truth, **change)
        self.right_fit = asked(self.right, term)[0]
        self.wrong_fit, _, self.tests = asked(self.wrong, term)
        self.gate = check_consistency(self.wrong, self.wrong_fit)


WRONG_LOADS = (OFFSET, kit.OFFSET, {"size": dict.fromkeys(STATIONS, 1.05)}, ("static loads",))
"""A load that is 5 % too large at one of two places."""


@pytest.fixture(
    scope="module",
    params=[
        # drift of y2 named where y2 reads 15 % more under one of two loads
        ({"seed": 2}, kit.DRIFT, {"size": {"y2": 1.15}}, ("channel y2", "middle")),
        WRONG_LOADS,
        # lift 4 % too small inboard and too large outboard, which a size alone does not hold
        (OFFSET, kit.OFFSET,
         {"flight": True, "size": {name: 1.0 + 0.12 * (at - MIDDLE) for name, at in STATIONS.items()}},
         ("loads of flight", "the slope over the span in flight")),
        # all displacements of one run off by four deviations, with zeros that are known to be small
        ({**OFFSET, "offset_deviation": 0.005}, kit.OFFSET, {"shift": 0.08},
         ("zero of displacement in run B",)),
    ],
    ids=["gauge", "load", "lift", "zeros"],
)  # fmt: skip
def inconsistent(request):
    return HiddenInconsistency(*request.param)


def test_the_sum_of_squares_does_not_show_few_wrong_readings(inconsistent):
    assert check_consistency(inconsistent.right, inconsistent.right_fit).passed
    assert check_absolute_fit(inconsistent.wrong, inconsistent.wrong_fit).passed


def test_what_the_sum_of_squares_does_not_show_is_seen(inconsistent):
    gate = inconsistent.gate
    assert gate.passed is False
    assert gate.statistic < 1e-3
    assert all(word in gate.reason for word in inconsistent.words)


def test_loads_zeros_and_the_channel_of_an_effect_are_tested(inconsistent):
    loads = {"static loads", "loads of flight"} if inconsistent.is_flown else {"static loads"}
    names = {test.name for test in inconsistent.tests}
    assert names == {*loads, "zeros of the static runs", f"channel {inconsistent.term.place}"}


@pytest.mark.parametrize("inconsistent", [WRONG_LOADS], indirect=True, ids=["load"])
def test_what_passes_the_gate_is_named(inconsistent):
    verdict, _, _ = reach_verdict(inconsistent.right, (inconsistent.term.effect,))
    names = [gate.name for gate in verdict.gates]
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    assert names == ["absolute fit", "shape", "consistency", "held-out trials"]


@pytest.mark.parametrize("inconsistent", [WRONG_LOADS], indirect=True, ids=["load"])
def test_what_fails_the_gate_is_not_named(inconsistent):
    verdict, _, _ = reach_verdict(inconsistent.wrong, (inconsistent.term.effect,))
    assert verdict.kind is VerdictKind.UNEXPLAINED, verdict.sentence
    assert "static loads" in verdict.text
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


def test_what_only_one_trial_has_stays():
    first, second, third = releases(1.0, 0.5, 0.2)
    of_two_channels = trial("r1", TrialKind.RINGDOWN, 0.5, channels=("x", "y"))
    assert held(first, replace(second, run="B"), third) == []
    assert held(first, of_two_channels, third) == []


def test_what_is_marked_as_held_out_is_respected():
    first, second, third = releases(1.0, 0.5, 0.2)
    marked = chosen_of(first, second, replace(third, held_out=True))
    assert [item.name for item in marked.held_out] == ["r2"]
    assert choose_held_out(marked) is marked


def test_of_two_trials_nothing_is_held_out():
    first, second, _ = releases(1.0, 0.5, 0.2)
    few = chosen_of(first, second)
    assert not few.held_out
    assert "Nothing is held out" in few.remarks[-1]
    assert [item.name for item in few.trials] == ["r0", "r1"]


@pytest.mark.parametrize(
    ("levels", "names"),
    [
        ((1.0, 0.5, 0.2), ["r1"]),
        ((0.2, 1.0, 0.3, 0.6), ["r3"]),
        ((1.0, 0.9, 0.6, 0.5, 0.3, 0.2), ["r2", "r3"]),
        ((1.0, 1.0, 0.2), ["r1"]),
        ((1.0, 1.0, 1.0, 1.0, 1.0), ["r4"]),
    ],
)
def test_amplitudes_inside_come_first(levels, names):
    """The extremes stay: with three trials at two levels the one that repeats can go."""
    assert held(*releases(*levels)) == names


@pytest.mark.parametrize(("kind", "load"), [(TrialKind.STATIC, "force"), (TrialKind.FLIGHT, "load_factor")])
def test_inner_load_levels_of_a_single_trial_are_held_out(kind, load):
    chosen = chosen_of(trial("s", kind, 8.0, count=9))
    (fitted,), (proof,) = chosen.fitted, chosen.held_out
    assert getattr(proof, load).tolist() == [2.0, 5.0]
    assert getattr(fitted, load).tolist() == [0.0, 1.0, 3.0, 4.0, 6.0, 7.0, 8.0]
    assert (proof.name, proof.values.tolist()) == ("s, levels held out", [[2.0], [5.0]])


@pytest.mark.parametrize("kind", [TrialKind.STATIC, TrialKind.FLIGHT])
def test_a_trial_of_few_levels_or_with_a_path_that_turns_stays_whole(kind):
    path = np.concatenate([np.arange(5.0), np.arange(3.0, -1.0, -1.0)])
    turning = replace(trial("s", kind, 8.0, count=9), force=path, load_factor=0 * path)
    assert held(trial("s", kind, 8.0, count=5)) == []
    assert held(turning) == []
