"""The filter with a missing force against Gaussian conditioning on dense matrices."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from benchmarks.force_events import KINDS, counted, drawn, found_in, problem_of
from discrepancy.campaign.noise import NoiseModel
from discrepancy.estimation.estimate import estimate_of_processes
from discrepancy.estimation.filtered import FilteredTrial
from discrepancy.estimation.force_states import Process
from discrepancy.estimation.linearisation import plain_linearisation
from discrepancy.estimation.linearised import LinearisedTrial
from discrepancy.estimation.regression import Priors, Regression, Solution
from discrepancy.judgement.remarks import gap_times_sentence, has_gap_beginning_inside
from discrepancy.missing_force.events import EventSearch
from discrepancy.missing_force.shares import _simulated_noise
from discrepancy.missing_force.switched_record import SwitchedRecord
from discrepancy.missing_force.two_filters import FilterState, RecordFilter, join_filters
from discrepancy.missing_force.windows import _port_or_channel_error, add_window_sizes, windows_of_residuals
from discrepancy.report.load_and_time_figures import time_line_figure
from discrepancy.system.response import PortedSystem
from discrepancy.trials_in_motion.ported_trial import correlated_noise_part
from discrepancy.trials_in_motion.steps import discretise
from discrepancy.trials_in_motion.trajectory import NO_SENSOR_ERRORS, Trajectory
from discrepancy.trials_in_motion.trial import ColouredNoise, PortedTrial, SampleIntervals
from discrepancy.verdict import GapWindow, Moment
from discrepancy.workflow import investigate
from tests.discrepancy.bench import Bench
from tests.discrepancy.rigs import FEW

NO_PRIORS = Priors.without_ranges(np.zeros(0))
"""Of trials without shared unknowns."""


def gaussian(covariance, readings):
    """Return the log evidence of readings but for a constant."""
    quadratic = readings @ np.linalg.solve(covariance, readings)
    return -0.5 * (quadratic + np.linalg.slogdet(covariance)[1])


def alone(trial):
    """Return a trial without shared unknowns as one linear model."""
    return plain_linearisation([trial], NO_PRIORS)


def filtered(trial, process):
    """Return the filter of a trial with a missing force at its port."""
    return FilteredTrial(alone(trial).trials[0], {0: process})


def evidence(trial, process):
    """Return the log evidence of a trial's residuals with a missing force at its port."""
    return alone(trial).solve({0: process}).log_evidence


FREQUENCY, RATIO, PARTS = 9.0, 0.05, 8
PROCESS = Process(2.0, 0.15)


def oscillator():
    """One mass of 1 kg on a spring: its displacement and its accelerometer, a force at the mass."""
    generator = np.array([[0.0, 1.0], [-(FREQUENCY**2), -2.0 * RATIO * FREQUENCY]])
    return PortedSystem(
        generator, ("mass",), np.array([[0.0, 1.0]]), np.array([[1.0, 0.0]]), np.array([[0.0, 1.0]]),
        np.array([[1.0, 0.0], generator[1]]), np.array([[0.0, 1.0]]),
    )  # fmt: skip


def trial_of(time, residual, *, used=None, deviation=None, local=None, coloured=()):
    """Return a trial without shared unknowns; the residual is over the noise's deviation."""
    count = len(time)
    used = np.ones(residual.shape, dtype=bool) if used is None else used
    local = np.zeros((0, *residual.shape)) if local is None else local
    fine = (count - 1) * PARTS + 1
    return PortedTrial(
        "one", time, residual * used, used, np.array([0.02, 0.6]) if deviation is None else deviation,
        coloured, np.zeros((0, *residual.shape)), local, np.ones(len(local)), oscillator(), (), PARTS,
        np.zeros((fine, 1)), np.zeros((fine, 1)), False,
    )  # fmt: skip


def dense(trial, process, per_second=2000, window=(-np.inf, np.inf)):
    """Return the covariance (N C, N C) of the readings by the force, and of force and readings (M, N C).

    The force is that at the fine stamps (M,), of which every PARTS-th is a sample.

    By quadrature of what a kernel over all pairs of moments, those of a window, does to an impulse response;
    nothing is stepped.
    """
    step = 1.0 / per_second
    moments = np.arange(0.0, trial.time[-1] + 0.5 * step, step) + 0.5 * step
    apart = np.abs(moments[:, None] - moments)
    rate = np.sqrt(3.0) / process.correlation_time
    kernel = process.standard_deviation**2 * np.exp(-rate * apart)
    if not process.may_jump:
        kernel *= 1.0 + rate * apart
    else:
        kernel = process.standard_deviation**2 * np.exp(-apart / process.correlation_time)
    inside = (moments > window[0]) & (moments < window[1])
    kernel *= np.outer(inside, inside)
    answers = np.zeros((len(trial.time), 2, len(moments)))
    nearest = np.zeros((len(trial.fine_time), len(moments)))
    for k, now in enumerate(trial.fine_time):
        place = np.clip(now / step - 0.5, 0.0, len(moments) - 1.001)
        nearest[k, int(place)], nearest[k, int(place) + 1] = 1.0 - place % 1.0, place % 1.0
        if now in window:  # what begins or ends at a sample does so before it
            nearest[k] = 0.0
            nearest[k, round(now / step)] = 1.0
    generator = trial.system.generator
    turn = np.sqrt(1.0 - RATIO**2) * FREQUENCY
    for k, now in enumerate(trial.time):
        since = now - moments
        decay = np.where(since > 0.0, np.exp(-RATIO * FREQUENCY * np.maximum(since, 0.0)), 0.0)
        x = -decay * np.sin(turn * since) / turn * step
        v = -decay * (np.cos(turn * since) - RATIO * FREQUENCY / turn * np.sin(turn * since)) * step
        answers[k, 0] = x
        answers[k, 1] = generator[1, 0] * x + generator[1, 1] * v - nearest[PARTS * k]
    rows = (answers / trial.deviation[:, None]).reshape(-1, len(moments))
    by_force = kernel @ rows.T
    return rows @ by_force, nearest @ by_force


@pytest.mark.parametrize(
    ("rough", "uneven", "unknown"),
    [(False, False, 0), (False, True, 0), (True, False, 0), (True, True, 0), (False, False, 2)],
)
def test_evidence_and_force_are_those_of_dense_conditioning(rough, uneven, unknown):
    """And those beside unknowns of the trial and coloured noise of a channel."""
    random = np.random.default_rng(3)
    time = 0.02 * np.arange(40)
    if uneven:
        time = time + np.r_[0.0, random.uniform(-0.006, 0.006, 39)]
    residual = random.standard_normal((40, 2)) * [3.0, 1.0]
    used = random.uniform(size=(40, 2)) > 0.2
    local, share = random.standard_normal((unknown, 40, 2)) * used, 0.4 * unknown
    process = Process(2.0, 0.15, rough)
    trial = trial_of(
        time, residual, used=used, local=local, coloured=[ColouredNoise(0, share, 12.0)] if share else ()
    )
    covariance, cross = dense(trial, process)
    at = np.flatnonzero(used.ravel())
    noise = np.kron(share * np.exp(-12.0 * np.abs(time[:, None] - time)), np.diag([1.0, 0.0]))
    noise += np.kron(np.eye(40), np.diag([1.0 - share, 1.0]))
    flat = local.reshape(unknown, 80)
    covariance = (covariance + noise + flat.T @ flat)[np.ix_(at, at)]
    readings = residual.ravel()[at]
    assert evidence(trial, process) == pytest.approx(
        gaussian(covariance, readings), abs=0.05 if rough else 0.02
    )
    if unknown:
        return
    force = filtered(trial, process).forces_of_residual(trial.residual)[0]
    deviation = filtered(trial, process).missing_force_deviations[0]
    mean = cross[:, at] @ np.linalg.solve(covariance, readings)
    np.testing.assert_allclose(force, mean, atol=0.02 * process.standard_deviation)
    own = cross[::PARTS, at]
    variance = process.standard_deviation**2 - np.einsum("nk,kn->n", own, np.linalg.solve(covariance, own.T))
    np.testing.assert_allclose(deviation[::PARTS], np.sqrt(variance), atol=0.02 * process.standard_deviation)


def test_trials_tell_together_what_each_tells():
    random = np.random.default_rng(3)
    trials = [
        trial_of(
            0.02 * np.arange(40), random.standard_normal((40, 2)), local=random.standard_normal((2, 40, 2))
        )
        for _ in range(2)
    ]
    together = plain_linearisation(trials, NO_PRIORS).solve({0: PROCESS}).log_evidence
    assert together == pytest.approx(sum(evidence(trial, PROCESS) for trial in trials), rel=1e-9)


def test_steady_gains_are_those_of_every_step():
    random = np.random.default_rng(4)
    time = 0.02 * np.arange(900)
    trial = trial_of(time, random.standard_normal((900, 2)))
    jittered = trial_of(time * (1.0 + 1e-12 * np.arange(900)), trial.residual)
    object.__setattr__(
        jittered, "intervals", SampleIntervals(np.full(900, 0.02), np.arange(900))
    )  # as if each were its own
    assert evidence(trial, PROCESS) == pytest.approx(evidence(jittered, PROCESS), abs=1e-6)
    states, other_states = (filtered(of, PROCESS).smooth_residual(trial.residual) for of in (trial, jittered))
    np.testing.assert_allclose(states, other_states, atol=1e-7)
    variances, other_variances = (
        filtered(of, PROCESS).smoothed_state_variances() for of in (trial, jittered)
    )
    np.testing.assert_allclose(variances, other_variances, atol=1e-7)


def test_a_steady_covariance_is_not_computed_anew():
    """The state of every sample of a long record has the same covariance, to the bit."""
    random = np.random.default_rng(4)
    trial = trial_of(0.02 * np.arange(900), random.standard_normal((900, 2)))
    search = EventSearch(alone(trial), 0, PROCESS)
    record = SwitchedRecord(search, 0, (PROCESS, PROCESS)).record_filter
    kinds = np.zeros(900, dtype=np.int64)
    start = record.initial_state(np.eye(record.output_rows.shape[1]))
    states = record.filter_before(kinds, 0, start, np.array([200, 899]))
    np.testing.assert_array_equal(*states.covariance)


def test_filters_from_both_sides_meet_at_every_sample():
    """The readings before a sample and those since then tell what all of them tell."""
    random = np.random.default_rng(6)
    trial = trial_of(0.02 * np.arange(30), random.standard_normal((30, 2)))
    (linear_trial,) = alone(trial).trials
    space = FilteredTrial(linear_trial, {0: PROCESS}).force_states.state_space
    lengths, kinds = trial.intervals
    transitions, noises = discretise(space.generator, space.intensity, lengths)
    record = RecordFilter(transitions, noises, space.output_rows, trial.used, linear_trial.columns)
    samples = np.array([1, 7, 15, 29, 30])
    begin = record.initial_state(space.initial_covariance)
    before = record.filter_before(kinds, 0, begin, samples)
    inner = FilterState(*(array[1] for array in before))
    again = record.filter_before(kinds, 7, inner, samples[1:])
    for array, continued in zip(before, again, strict=True):
        np.testing.assert_allclose(continued, array[1:], rtol=1e-12, atol=1e-12)
    stepped = before._replace(
        covariance=transitions[0] @ before.covariance @ transitions[0].T + noises[0],
        mean=transitions[0] @ before.mean,
    )
    products, half_log_determinants = join_filters(stepped, record.information_after(kinds, samples))
    found = -0.5 * products[:, 0, 0] - half_log_determinants
    np.testing.assert_allclose(found, evidence(trial, PROCESS), rtol=1e-9)


def test_a_force_of_a_long_correlation_stays_finite():
    """Backwards it would grow by e^1000 within a step."""
    trial = trial_of(1.0 * np.arange(20), np.ones((20, 2)))
    short = Process(1.0, 1e-3)
    states = filtered(trial, short).smooth_residual(trial.residual)
    assert np.isfinite(evidence(trial, short))
    assert np.all(np.isfinite(states))


def test_a_pushed_state_follows_its_closed_form():
    """Also of a trial that begins at rest under the push, whose state stays where it is."""
    trial = trial_of(0.02 * np.arange(50), np.zeros((50, 2)))
    generator = trial.system.generator
    push = -trial.system.actions[0]
    exact = [np.linalg.solve(generator, (expm(generator * t) - np.eye(2)) @ push) for t in trial.fine_time]
    constant_force = np.ones(len(exact))
    from_zero = trial.state_under_force(0, constant_force)
    from_rest = replace(trial, begins_at_rest=True).state_under_force(0, constant_force)
    np.testing.assert_allclose(from_zero, exact, atol=1e-12)
    np.testing.assert_allclose(from_rest - np.linalg.solve(generator, -push), 0.0, atol=1e-12)


@pytest.mark.parametrize("settled", [False, True], ids=["still", "settled"])
def test_a_parameter_changes_state_and_readings_as_it_does_in_a_simulation(settled):
    """That of a stiffness, against the difference of two simulations under the same force."""
    base = trial_of(0.02 * np.arange(50), np.zeros((50, 2)))
    stiffer, nothing = np.array([[0.0, 0.0], [-8.0, 0.0]]), np.zeros((1, 2))
    by_stiffness = PortedSystem(
        stiffer, ("mass",), nothing, nothing, nothing, np.vstack((nothing, stiffer[1])), nothing
    )
    trial = replace(
        base,
        begins_at_rest=settled,
        shared_derivatives=np.zeros((1, 50, 2)),
        system_derivatives=(by_stiffness,),
        linearisation_point=np.array([0.3]),
    )
    force = 1.0 + np.sin(5.0 * trial.fine_time)
    states, readings = [], []
    for step in (-1e-4, 0.0, 1e-4):
        system = replace(
            trial.system,
            generator=trial.system.generator + step * stiffer,
            outputs=trial.system.outputs + step * by_stiffness.outputs,
        )
        changed = replace(trial, system=system)
        states.append(changed.state_under_force(0, force))
        readings.append(changed.readings_of_state(states[-1], {0: force}))
    trajectory = Trajectory(states[1], trial.port_positions, trial.port_speeds, {0: force})
    linear_trial = LinearisedTrial(trial, trajectory, {}, NO_SENSOR_ERRORS, np.zeros(0), np.zeros(1))
    constant, by_unknown = np.moveaxis(linear_trial.known_states, -1, 0)
    expected = (states[2] - states[0]) / 2e-4
    np.testing.assert_allclose(by_unknown, expected, atol=1e-3 * np.abs(expected).max())
    np.testing.assert_allclose(constant, -0.3 * by_unknown, rtol=1e-9, atol=1e-12)
    expected_readings = (readings[2] - readings[0]) / 2e-4
    np.testing.assert_allclose(
        -linear_trial.columns[:, :, 1], expected_readings, atol=1e-3 * np.abs(expected_readings).max()
    )


def test_simulated_noise_has_its_deviation_and_its_correlation():
    """A deviation of one, part of it coloured."""
    count = 5000
    colour = ColouredNoise(0, 0.4, 12.0)
    noise = _simulated_noise(trial_of(0.02 * np.arange(count), np.zeros((count, 2)), coloured=(colour,)))
    covariance_of_neighbours = noise[1:, 0] @ noise[:-1, 0] / count
    np.testing.assert_allclose(noise.std(axis=0), 1.0, rtol=0.1)
    assert covariance_of_neighbours == pytest.approx(0.4 * np.exp(-12.0 * 0.02), abs=0.1)


def test_noise_of_first_order_is_taken_apart():
    """At the sampling interval of its model, and at no other."""
    noise = NoiseModel(1.0, 1.0 / np.sqrt(1.0 - 0.81), np.inf, np.array([0.9]), 0.01, ())
    correlated = correlated_noise_part(1, noise, 0.01)
    assert (correlated.channel, correlated.share) == (1, pytest.approx(1.0 - 1e-3, abs=2e-3))
    assert correlated.decay_rate == pytest.approx(-np.log(0.9) / 0.01, rel=1e-6)
    assert correlated_noise_part(1, noise, 0.02) is None


def test_evidence_beside_unknowns_is_that_of_their_prior():
    random, precision = np.random.default_rng(2), np.array([4.0, 0.01])
    readings, columns = random.standard_normal(9), random.standard_normal((2, 9))
    rows = np.vstack((readings, columns))
    found = Regression(rows @ rows.T, 0.0).solve([0, 1], Priors.without_ranges(precision))
    covariance = np.eye(9) + columns.T @ np.diag(1.0 / precision) @ columns
    assert found.log_evidence == pytest.approx(gaussian(covariance, readings))


def test_an_unknown_beyond_its_range_is_at_the_end_and_the_others_are_conditioned_on_it():
    random = np.random.default_rng(3)
    root = random.standard_normal((3, 3))
    covariance, mean = root @ root.T, np.array([4.0, 0.3, -0.2])
    priors = Priors(np.ones(3), np.array([-1.0, -9.0, -9.0]), np.array([1.0, 9.0, 9.0]))
    found = Solution(-7.0, mean, covariance).within(priors)
    beyond = 1.0 - mean[0]
    conditional = mean + covariance[:, 0] / covariance[0, 0] * beyond
    assert found.mean == pytest.approx(conditional, rel=1e-9)
    assert found.log_evidence == pytest.approx(-7.0 - 0.5 * beyond**2 / covariance[0, 0], rel=1e-9)


def test_unknowns_within_their_ranges_stay_as_they_are():
    priors = Priors(np.ones(2), np.full(2, -1.0), np.full(2, 1.0))
    solution = Solution(-7.0, np.array([0.5, -1.0]), np.eye(2))
    assert solution.within(priors) is solution


@pytest.mark.parametrize("end", [0, 1, None], ids=["a sample", "the record", "inside"])
def test_the_most_probable_process_is_the_top_of_a_grid(end):
    """Also at the bounds of its time: what jumps from sample to sample, what stays as it is."""
    random, count = np.random.default_rng(11), 60
    residual = random.standard_normal((count, 2))
    residual[:, 1] += {0: 5.0 * random.standard_normal(count), 1: 0.0}.get(
        end, 5.0 * np.sin(8.0 * 0.02 * np.arange(count))
    )
    residual[:, 0] += 4.0 if end == 1 else 0.0
    view = alone(trial_of(0.02 * np.arange(count), residual))
    about = {0: Process(1.0, 0.2)}
    found, value = view.most_probable_processes(about, about)
    times = np.geomspace(*view.correlation_time_range, 16)
    grid = [
        view.log_evidence_with_prior(about, {0: Process(s, t)})
        for s in np.geomspace(1e-2, 1e2, 41)
        for t in times
    ]
    assert max(grid) - 1e-6 < value == pytest.approx(view.log_evidence_with_prior(about, found), abs=1e-9)
    near = view.most_probable_processes(about, found, skip_grid=True)
    assert near[1] == pytest.approx(value, abs=1e-6)
    if end is not None:
        assert found[0].correlation_time == pytest.approx(view.correlation_time_range[end], rel=1e-6)


# ---------------------------------------------------------------- forces that act at times


EVENT, REST = Process(2.0, 0.15, may_jump=True), Process(0.5, 0.4, may_jump=True)


@pytest.mark.parametrize("uneven", [False, True], ids=["even", "uneven"])
def test_the_evidence_of_an_event_is_that_of_dense_conditioning(uneven):
    random = np.random.default_rng(3)
    time = 0.02 * np.arange(40)
    if uneven:
        time = np.round(time + np.r_[0.0, random.uniform(-0.006, 0.006, 39)], 3)
    residual = random.standard_normal((40, 2)) * [3.0, 1.0]
    local = random.standard_normal((1, 40, 2))
    trial = trial_of(time, residual, local=local)
    search = EventSearch(alone(trial), 0, EVENT)
    switched = SwitchedRecord(search, 0, (EVENT, REST))
    starts, ends = np.array([0, 7, 20]), np.array([9, 26, 40])
    values = switched.evidence_of_stretches(np.zeros(40, dtype=bool), starts, ends)
    always = dense(trial, REST)[0] + np.eye(80) + np.outer(local.ravel(), local.ravel())
    for a, start in enumerate(starts):
        for b, end in enumerate(ends):
            if end <= start:
                assert values[a, b] == -np.inf
                continue
            edge = (-np.inf if start == 0 else time[start], np.inf if end == 40 else time[end])
            covariance = always + dense(trial, EVENT, window=edge)[0]
            assert values[a, b] == pytest.approx(gaussian(covariance, residual.ravel()), abs=0.05)
            on = np.zeros(40, dtype=bool)
            on[start:end] = True
            assert search.log_evidence([switched.products(on)]) == pytest.approx(values[a, b], abs=1e-7)


@pytest.mark.parametrize("settled", [False, True], ids=["still", "settled"])
def test_a_force_that_is_off_throughout_is_none_and_one_that_is_on_a_second_one(settled):
    """Of a settled trial, too, whose state before is what the forces that act make of it."""
    random = np.random.default_rng(3)
    trial = replace(trial_of(0.02 * np.arange(40), random.standard_normal((40, 2))), begins_at_rest=settled)
    search = EventSearch(alone(trial), 0, EVENT)
    # a port beside the other one, at the same place
    ports = {
        name: np.repeat(getattr(trial.system, name), 2, axis=0)
        for name in ("actions", "positions", "speeds", "through")
    }
    twofold = replace(trial, system=replace(trial.system, ports=("mass", "again"), **ports))
    for on, forces in ((False, {0: REST}), (True, {0: EVENT, 1: REST})):
        wanted = alone(twofold).solve(forces).log_evidence
        found = search.log_evidence(search.products((EVENT, REST), [np.full(40, on)]))
        assert found == pytest.approx(wanted, abs=1e-7)


def event_case(folder, kind, seed):
    """Return a drawn case in which something acts for a while."""
    return drawn(folder / kind, kind, (1, seed, KINDS.index(kind)))


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        ("power", 9),
        ("leak", 5),
        ("tank", 3),
        ("push", 9),
        ("push", 8),
        ("friction", 2),
        ("always", 0),
        ("nothing", 2),
    ],
)
def test_begin_and_end_of_what_acts_for_a_while_are_found(tmp_path, kind, seed):
    case = event_case(tmp_path, kind, seed)
    moments = found_in(case)
    counts = counted(case, moments)
    assert counts["close"] == counts["moments"] == 2 * len(case.windows) == len(moments)
    for true, (_, low, high) in zip(np.ravel(case.windows), moments, strict=True):
        width = high - low  # an interval of 90 % three times as wide fails in one of a million cases
        assert low - width < true < high + width


def test_a_verdict_has_the_windows_in_which_something_acts(tmp_path):
    case = event_case(tmp_path, "leak", 5)
    problem = problem_of(case)
    verdict = investigate(problem.campaign, problem.model, FEW).verdict
    windows = [window for window in verdict.windows if not window.with_effect]
    assert gap_times_sentence(windows) in verdict.text
    for window, moments in zip(windows, case.windows, strict=True):
        assert_window_is_at(window, moments, 0.01 * case.length)


def assert_window_is_at(window, moments, tolerance):
    """Check begin and end [s] of a window in which the block is off by more than three noises."""
    assert (window.begin.value, window.end.value) == pytest.approx(moments, abs=tolerance)
    assert window.channels == ("block",)
    assert window.size > 3.0


def test_a_window_whose_readings_are_all_missing_is_drawn():
    """Its residual has the size 0, which has no logarithm."""
    moments = (Moment(1.0, 0.9, 1.1), Moment(2.0, 1.9, 2.1))
    windows = [
        GapWindow("release 1", ("g1",), *moments, first=0.0, last=5.0, size=size) for size in (0.0, 8.0)
    ]
    figure = time_line_figure(windows)
    assert len(figure.axes[0].collections) >= len(windows)


def moment_at(value: float) -> Moment:
    return Moment(value, value, value)


def test_a_window_without_a_reading_is_none():
    fitted = Bench(count=300).fit(np.random.default_rng(4))
    trial = fitted.trials[0].trial
    first, second, third = (float(time) for time in trial.time[100:103])

    def window(begin: float, end: float) -> GapWindow:
        begin_and_end = moment_at(begin), moment_at(end)
        record = {"first": float(trial.time[0]), "last": float(trial.time[-1])}
        return GapWindow(trial.name, trial.channels, *begin_and_end, **record, size=1.0)

    between_readings = window(first + 0.1 * (second - first), second - 1e-9)
    around_a_reading = window(first, third)
    (weighed,) = add_window_sizes([between_readings, around_a_reading], fitted, fitted)
    assert weighed.begin.value == first
    assert weighed.size > 0.0


@pytest.fixture(scope="module")
def fitted_beside_event():
    """A fit of a campaign where g2 of the second release is off by eight noises from 1.2 s to 2 s."""
    event = np.zeros((300, 4))
    event[120:200, 1] = 16.0
    return Bench(count=300).fit(np.random.default_rng(4), extra={1: event})


@pytest.fixture(scope="module")
def event_window(fitted_beside_event):
    """The only window that is found beside it."""
    (window,) = windows_of_residuals(fitted_beside_event)
    return window


def test_a_window_of_a_campaign_has_trial_channel_and_size(event_window):
    assert (event_window.trial, event_window.channels) == ("release 2", ("g2",))
    assert event_window.size == pytest.approx(8.0, rel=0.1)


def test_a_window_of_a_campaign_has_its_moments_with_intervals(event_window):
    assert event_window.begin.low - 0.01 <= 1.2 <= event_window.begin.high + 0.01
    assert event_window.end.low - 0.01 <= 2.0 <= event_window.end.high + 0.01


def test_windows_repeat(fitted_beside_event, event_window):
    assert windows_of_residuals(fitted_beside_event) == (event_window,)


def test_a_window_of_a_campaign_is_told(event_window):
    assert has_gap_beginning_inside((event_window,))
    assert gap_times_sentence((event_window,)).startswith("The gap is there in 'release 2' since 1.")


def test_a_window_of_a_campaign_is_drawn(event_window):
    (axis, *_) = time_line_figure((event_window,)).axes
    assert [text.get_text() for text in axis.get_yticklabels()] == ["release 2"]
    assert time_line_figure(()) is None


def test_without_an_event_there_is_no_window():
    assert windows_of_residuals(Bench(count=300).fit(np.random.default_rng(4))) == ()


def test_trials_without_a_course_of_time_have_no_window(fitted_beside_event):
    at_one_time = [
        replace(item, trial=replace(item.trial, time=0.0 * item.trial.time))
        for item in fitted_beside_event.trials
    ]
    assert windows_of_residuals(replace(fitted_beside_event, trials=at_one_time)) == ()


def test_where_no_window_can_be_weighed_the_gap_is_told_as_a_whole(fitted_beside_event, monkeypatch):
    """The filter breaks down beside millions of noises."""

    def broken(*_):
        raise np.linalg.LinAlgError("Matrix is not positive definite")

    monkeypatch.setattr("discrepancy.missing_force.windows.find_events", broken)
    (window,) = windows_of_residuals(fitted_beside_event)
    assert (window.trial, window.channels, window.begin, window.end) == ("release 2", ("g2",), None, None)
    assert window.size > 1.0
    assert gap_times_sentence((window,)) == "The gap is there throughout the records."


def test_an_event_on_a_reading_is_looked_for_by_name_in_records_of_other_channels():
    """Both sensors jump; their only common record has it in another column."""
    random, jump = np.random.default_rng(4), np.where(np.arange(100) < 60, 0.0, 30.0)
    time, names = 0.02 * np.arange(100), [("x", "a"), ("a", "x")]
    residuals = [random.standard_normal((100, 2)) for _ in names]
    for residual, channels in zip(residuals, names, strict=True):
        residual[:, channels.index("a")] += jump
    trials = [trial_of(time, residual) for residual in residuals]
    system = trials[1].system
    trials[1] = replace(
        trials[1], deviation=trials[1].deviation[::-1],
        system=replace(system, outputs=system.outputs[::-1], through=system.through[:, ::-1]),
    )  # fmt: skip
    forced = estimate_of_processes(plain_linearisation(trials, NO_PRIORS), {0: PROCESS}, {0: PROCESS})
    number, found = _port_or_channel_error(0, forced, names)
    shown = [trial.system.through[0] != 0.0 for trial in (item.trial for item in found.trials)]
    assert number == 0
    np.testing.assert_array_equal(shown, [[False, True], [True, False]])


def test_words_of_windows():
    whole = GapWindow("a", ("x",), None, None, 0.0, 9.0, 4.0)
    part = GapWindow("b", ("x",), Moment(1.0, 0.98, 1.04), None, 0.0, 9.0, 3.0)
    left = GapWindow("b", ("x",), None, Moment(2.0, 1.5, 2.5), 0.0, 9.0, 2.0, with_effect=True)
    throughout = "in 'a' throughout the record, 4 times the noise."
    assert not has_gap_beginning_inside((whole,))
    for windows, sentence in (
        ((whole, part), "The gap is there in 'b' since 1.000 s (0.980 to 1.040), to the end of the record, "
         f"3 times the noise; {throughout}"),
        ((whole, part, part, part), f"The gap comes and goes, 4 times; the largest is {throughout}"),
        ((left,), ""),
    ):  # fmt: skip
        assert gap_times_sentence(windows) == sentence
