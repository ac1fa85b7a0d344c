"""Screening and gates: fits, level and power; draws, held-out trials; what is left beside the noise."""

from dataclasses import replace
from math import inf, sin

import numpy as np
import pytest
from scipy.stats import binom, chi2, kstest

from discrepancy.campaign.noise_tests import variance_p_value
from discrepancy.campaign.records import NoiseRecord
from discrepancy.fits.candidate import Candidate, EffectTerm, Point, ResidualProcess
from discrepancy.fits.fitting import fit, objective
from discrepancy.fits.gates import (
    LEAST_SHAPE_GAIN,
    absolute_fit_tests,
    check_absolute_fit,
    check_shape,
    prior_tests,
)
from discrepancy.fits.predictive import importance_draws, residual_set, with_draws
from discrepancy.fits.screening import Screen
from discrepancy.judgement.hypotheses import named_effects
from discrepancy.location.locate import locate
from discrepancy.search.starts import best_pairs
from discrepancy.search.wide_noise import estimate_residual_process, refit_under_wide_noise, with_wide_noise
from discrepancy.workflow import patch_draws
from fe.runtime.patch import ModelPatch, RunOffset

from . import kit


class ScreenedPair:
    """A problem with two linear effects with wide priors, for which the screen is the fit."""

    def __init__(self):
        self.problem = kit.closed_problem(seed=12, effect=0.12, gain_deviation=0.2)
        self.none = kit.fitted(self.problem)
        self.screen = Screen(self.problem, self.none)
        self.terms = (
            EffectTerm(kit.offset_effect(deviation=10.0), "y1"),
            EffectTerm(kit.drift_effect(deviation=10.0), "y1"),
        )
        self.changes = [next(iter(self.screen.changes_on_grid(term))) for term in self.terms]

    def pairs(self, *changes):
        """Return the best pairs of changes."""
        return best_pairs([*changes], self.screen.inner_product_signs)


@pytest.fixture(scope="module")
def screened_pair():
    return ScreenedPair()


def test_the_gain_and_start_of_a_pair_are_those_of_its_fit(screened_pair):
    ((misfit, first, second),) = screened_pair.pairs(*screened_pair.changes)
    pair = kit.fitted(screened_pair.problem, *screened_pair.terms)
    gain = screened_pair.none.objective - pair.objective
    start = np.concatenate((first.best_values, second.best_values))
    assert gain == pytest.approx(-misfit, rel=0.02, abs=0.05)
    np.testing.assert_allclose(start, pair.point.effect, rtol=0.03, atol=1e-3)


def test_a_refit_with_an_effect_has_the_objective_of_its_point(screened_pair):
    """It is lower than without the refit, and that of a fit in which the effect is known."""
    term = screened_pair.terms[0]
    values = np.array([0.01])
    expected, point = screened_pair.screen.refit_with_effect(term, values)
    problem, candidate = screened_pair.problem, Candidate((term,))
    assert expected == pytest.approx(objective(problem, candidate, point), abs=0.01)
    unfitted = replace(screened_pair.none.point, effect=values)
    assert expected < objective(problem, candidate, unfitted) - 1.0
    np.testing.assert_array_equal(point.effect, values)


def test_one_change_alone_is_no_pair(screened_pair):
    change = screened_pair.changes[0]
    same_change_of_other_term = replace(change, term=screened_pair.terms[1])
    assert screened_pair.pairs(change, change) == []
    assert screened_pair.pairs(change, same_change_of_other_term) == []


@pytest.mark.parametrize("number", [0, 1])
def test_the_gain_and_value_of_a_change_are_those_of_its_fit(screened_pair, number):
    change = screened_pair.changes[number]
    single = kit.fitted(screened_pair.problem, screened_pair.terms[number])
    prior = 0.5 * float(single.point.effect @ single.point.effect)
    gain = screened_pair.none.objective - single.objective + prior
    assert gain == pytest.approx(change.gain, rel=0.02, abs=0.03)
    assert change.best_values[0] == pytest.approx(single.point.effect[0], rel=0.02, abs=1e-4)


def test_a_further_mode_is_tried_where_what_is_left_has_its_peak():
    """At 7 Hz in both ring-downs, where the first mode has 3 Hz."""
    line = 0.1 * np.cos(2.0 * np.pi * 7.0 * 0.01 * np.arange(200))
    problem = kit.closed_problem(kinds=("ringdown",), samples=200, extra=lambda rows: line)
    (mode,) = kit.chosen("unmodelled_mode")
    change = next(Screen(problem, kit.fitted(problem)).changes_on_grid(EffectTerm(mode, "y1")))
    assert mode.parameters[0].prior.value(change.effect_values[0]) == pytest.approx(7.0 / 3.0, rel=0.01)


class SimulatedGate:
    """The gate of the absolute fit in simulated outcomes of one problem."""

    def __init__(self, freedom, kinds, samples, gap):
        self.problem = kit.closed_problem(
            seed=1, noise=NoiseRecord(0.02, freedom), kinds=kinds, samples=samples
        )
        self.freedom, self.samples, self.gap = freedom, samples, gap
        self.fit = kit.fitted(self.problem)
        self.generator = np.random.default_rng(17)
        self.draw_count = 120 if gap else 300
        draws = [self.draw() for _ in range(self.draw_count)]
        self.rejected = sum(check_absolute_fit(self.problem, draw).passed is False for draw in draws)
        self.first_p_values = [absolute_fit_tests(self.problem, draw)[0].p_value for draw in draws]

    def draw(self):
        """Return a fit with other noise, and with a gap that is spread evenly."""
        scale = 1.0
        if self.freedom != inf:
            scale = self.generator.chisquare(self.freedom, 3) / self.freedom
        freedom_of_fit = self.problem.sample_counts - self.fit.absorbed_freedom
        squares = (1.0 + self.gap) * self.generator.chisquare(freedom_of_fit) / scale
        residuals = tuple(self.generator.standard_normal(part.shape) for part in self.fit.residuals)
        return replace(self.fit, squares_by_channel=squares, residuals=residuals)


@pytest.fixture(
    scope="module",
    params=[
        (inf, ("static",), 0, 0.0),
        (20.0, ("static", "ringdown"), 60, 0.0),
        (200.0, ("ringdown",), 120, 0.0),  # long enough for whiteness
        (inf, ("ringdown",), 80, 0.5),  # a third more variance, spread evenly
    ],
)
def simulated_gate(request):
    return SimulatedGate(*request.param)


def test_absolute_gate_has_its_level_and_its_power(simulated_gate):
    """Rejected at most 1e-3 of the time where nothing is missing, and nearly always beside a gap."""
    gate = simulated_gate
    if gate.gap:
        assert gate.rejected > 112
    else:
        assert gate.rejected <= binom.isf(1e-3, gate.draw_count, 1e-3)


def test_p_values_of_the_absolute_gate_are_uniform_where_nothing_is_missing(simulated_gate):
    p_value = kstest(simulated_gate.first_p_values, "uniform").pvalue
    assert simulated_gate.gap or p_value > 1e-3


def test_long_records_are_tested_for_whiteness(simulated_gate):
    names = [test.name for test in absolute_fit_tests(simulated_gate.problem, simulated_gate.fit)]
    assert any(name.startswith("whiteness") for name in names) or simulated_gate.samples < 120


def test_the_absolute_gate_tells_the_variance_against_the_recorded_noise(simulated_gate):
    """Also if the noise was widened for the fit."""
    problem, fit_of_none = simulated_gate.problem, simulated_gate.fit
    wide = ResidualProcess(np.zeros(3), np.full(3, 2.0), *np.zeros((2, 3)), np.ones(3, dtype=bool))
    tests = {
        test.name: test.p_value
        for test in absolute_fit_tests(problem, replace(fit_of_none, residual_process=wide))
    }
    count = problem.sample_counts[0] - fit_of_none.absorbed_freedom[0]
    square = fit_of_none.squares_by_channel[0] / count
    expected = variance_p_value(square, count / 4.0, simulated_gate.freedom / 4.0)
    assert tests["variance of y1"] == pytest.approx(expected)


SPREADS = pytest.mark.parametrize("spread", [0.01, 1.0])
"""Standard deviations in which draws are looked for at first: a hundred times too small, or right."""

COVARIANCE_ROOT = np.array([[1.0, 0.0, 0.0], [0.9, 0.2, 0.0], [0.0, 0.3, 2.0]])
COVARIANCE = COVARIANCE_ROOT @ COVARIANCE_ROOT.T


def draws_of_gaussian(spread):
    """Return draws about one, with the covariance above."""

    def potential(x):
        return 0.5 * float((x - 1.0) @ np.linalg.solve(COVARIANCE, x - 1.0))

    return importance_draws(potential, np.ones(3), spread * np.eye(3))


@SPREADS
def test_draws_have_the_moments_of_a_gaussian(spread):
    draws = draws_of_gaussian(spread)
    deviations = np.sqrt(np.diag(COVARIANCE))
    np.testing.assert_allclose((draws.mean(axis=0) - 1.0) / deviations, 0.0, atol=0.15)
    np.testing.assert_allclose(draws.std(axis=0), deviations, rtol=0.1)


@SPREADS
def test_draws_repeat(spread):
    assert draws_of_gaussian(spread).tobytes() == draws_of_gaussian(spread).tobytes()


@SPREADS
def test_draws_have_the_quantiles_of_a_box(spread):
    def potential(x):
        return np.inf if np.abs(x).max() > 1.0 else 0.0

    draws = importance_draws(potential, np.zeros(2), spread * np.eye(2))
    low, high = np.quantile(draws, (0.05, 0.95), axis=0)
    np.testing.assert_allclose(low, -0.9, atol=0.07)
    np.testing.assert_allclose(high, 0.9, atol=0.07)


@SPREADS
def test_draws_follow_a_bent_ridge(spread):
    """The second unknown is the square of the first, a standard normal one, to a deviation of 0.2."""

    def potential(x):
        along, across = x
        return 0.5 * along**2 + 0.5 * ((across - along**2) / 0.2) ** 2

    along, across = importance_draws(potential, np.zeros(2), spread * np.eye(2)).T
    np.testing.assert_allclose(np.quantile(along, (0.05, 0.95)), (-1.645, 1.645), atol=0.5)
    assert np.abs(across - along**2).mean() == pytest.approx(0.16, rel=0.2)


def test_without_a_record_nothing_absolute_is_said_but_of_colour():
    problem = kit.closed_problem(seed=1, noise=None, samples=150)
    found = kit.fitted(problem)
    gate = check_absolute_fit(problem, found)
    assert gate.passed is None
    assert "No noise record" in gate.reason
    wave = 30.0 * np.sin(0.3 * np.arange(150))[:, np.newaxis]
    swung = replace(found, residuals=tuple(r + wave if len(r) == 150 else r for r in found.residuals))
    assert check_absolute_fit(problem, swung).passed is False


def test_shape_gate_compares_evidence():
    problem = kit.closed_problem(seed=1)
    found = kit.fitted(problem, EffectTerm(kit.offset_effect(), "y1"))
    for gain, passes in ((-3.0, True), (LEAST_SHAPE_GAIN - 0.01, True), (LEAST_SHAPE_GAIN + 0.01, False)):
        gate = check_shape(found, replace(found, log_evidence=found.log_evidence + gain))
        assert gate.passed is passes
        assert gate.statistic == pytest.approx(gain)
    assert check_shape(found, None).passed is True


def test_unknowns_are_judged_beside_their_priors():
    effect = kit.offset_effect()
    shape = replace(effect, parameters=(replace(effect.parameters[0], magnitude=False),))
    problem = kit.closed_problem(seed=1, gain_deviation=0.1)
    found = kit.fitted(problem, EffectTerm(shape, "y1"))
    far = replace(found.point, shared=np.array([3.0, 1.0, 2.0, 0.0, 2.0]), effect=np.array([4.0]))
    told = {test.name: test.p_value for test in prior_tests(problem, replace(found, point=far))}
    wanted = {
        "calibrated parameters": chi2.sf(10.0, 2),
        "gains": chi2.sf(8.0, 3),
        "size of offset": chi2.sf(16.0, 1),
    }
    assert told == pytest.approx(wanted)


@pytest.mark.parametrize(("parameter_name", "is_tested"), [("gain_error", True), ("size", False)])
def test_the_size_of_a_gain_is_tested_and_no_other(parameter_name, is_tested):
    """A sensor that reads twice as much is no error of its gain."""
    effect = kit.offset_effect()
    renamed = replace(effect, parameters=(replace(effect.parameters[0], name=parameter_name),))
    problem = kit.closed_problem(seed=1)
    found = kit.fitted(problem, EffectTerm(effect, "y1"))
    large = replace(
        found,
        candidate=Candidate((EffectTerm(renamed, "y1"),)),
        point=replace(found.point, effect=np.array([5.0])),
    )
    p_values = {test.p_value for test in prior_tests(problem, large) if "of offset" in test.name}
    assert p_values == ({float(chi2.sf(25.0, 1))} if is_tested else set())


# ---------------------------------------------------------------- draws, and predictions of held-out trials


RIPPLES = 200.0
"""Waves of the ripple in a metre, over 2 pi."""


def rippled(steepest):
    """Return an offset with a ripple on it, whose slope is nearly twice that of its course at one value."""

    def build(setting, values, place):
        size = values["size"]
        offset = size + 0.9 / RIPPLES * sin(RIPPLES * (size - steepest))
        return ModelPatch((RunOffset("A", offset, channel=place, quantity=""),))

    return replace(kit.offset_effect(), identifier="rippled", build=build)


class RippledPosterior:
    """An offset behind ripples, fitted and drawn; and the interval of its course without ripples."""

    def __init__(self):
        self.problem = kit.closed_problem(seed=3, effect=0.2)
        smooth = kit.fitted(self.problem, kit.OFFSET)
        course = self.interval(smooth)
        self.course_width = course.high - course.low
        candidate = Candidate((EffectTerm(rippled(course.value), "y1"),))
        self.fit = fit(self.problem, candidate, smooth.point)
        self.drawn = with_draws(self.problem, self.fit)

    def interval(self, fit_of_effect):
        (interval,) = named_effects(self.problem, fit_of_effect)[0].parameters
        return interval

    def width(self, fit_of_effect):
        interval = self.interval(fit_of_effect)
        return interval.high - interval.low


@pytest.fixture(scope="module")
def rippled_posterior():
    return RippledPosterior()


def test_intervals_are_as_wide_as_the_posterior_behind_ripples(rippled_posterior):
    posterior = rippled_posterior
    assert posterior.width(posterior.fit) < 0.65 * posterior.course_width
    assert posterior.width(posterior.drawn) == pytest.approx(posterior.course_width, rel=0.3)


def test_draws_repeat_to_the_bit(rippled_posterior):
    again = with_draws(rippled_posterior.problem, rippled_posterior.fit)
    assert again.draws.tobytes() == rippled_posterior.drawn.draws.tobytes()


def test_patches_of_draws_scatter_as_the_posterior(rippled_posterior):
    (patches,) = patch_draws(rippled_posterior.problem, rippled_posterior.drawn, seed=1, count=300)
    offsets = np.array([primitive.offset for patch in patches for primitive in patch])
    width = np.ptp(np.quantile(offsets, (0.05, 0.95)))
    assert width == pytest.approx(rippled_posterior.course_width, rel=0.3)


# ---------------------------------------------------------------- predictions of held-out trials


def held_out_problem(seed, shift=0.0, **more):
    """Return a problem two trials of which are held out, their readings shifted."""
    problem = kit.closed_problem(seed=seed, samples=25, **more)
    trials = tuple(
        replace(trial, held_out=True, values=trial.values + shift) if trial.name in ("down", "two") else trial
        for trial in problem.campaign.trials
    )
    return kit.problem_of(replace(problem.campaign, trials=trials), problem.model)


def test_leverages_of_fitted_readings_are_the_dense_ones():
    problem = held_out_problem(3)
    _, a, hessian = kit.Linear(problem).dense()
    covariance = a @ np.linalg.solve(hessian, a.T)
    items = [item for item in residual_set(problem, kit.fitted(problem)).trials if not item.trial.held_out]
    leverage = np.concatenate([item.leverage.ravel() for item in items])
    np.testing.assert_allclose(leverage, np.diag(covariance), rtol=1e-6, atol=1e-9)
    rows = np.concatenate([item.sensitivity.reshape(-1, item.sensitivity.shape[2]) for item in items])
    np.testing.assert_allclose(rows @ rows.T, covariance, rtol=1e-5, atol=1e-8)


def test_rates_of_predictions_at_uneven_stamps():
    problem = kit.closed_problem(samples=400)
    rows = np.r_[0:200, 200:400:4]
    trials = (trial.rows(rows) if trial.is_dynamic else trial for trial in problem.campaign.trials)
    problem = kit.problem_of(replace(problem.campaign, trials=tuple(trials)), problem.model)
    found = kit.fitted(problem)
    for number, item in enumerate(residual_set(problem, found, sensitivities=False).trials):
        if item.rates is not None:
            _, rates = problem.response(number, found.point.shared, found.point.local[number], ModelPatch())
            np.testing.assert_allclose(item.rates[1:200], rates[1:200], atol=0.1 * np.abs(rates).max())


def test_noise_without_a_record_is_what_the_fit_leaves():
    """And nothing is found in it."""
    told = 0
    for seed in range(20):
        problem = kit.closed_problem(seed=seed, samples=150, gain_deviation=0.02)
        bare = {name: replace(item, noise=None) for name, item in problem.campaign.channels.items()}
        unknown = kit.problem_of(replace(problem.campaign, channels=bare), problem.model)
        found = residual_set(unknown, kit.fitted(unknown))
        for data, item in zip(problem.trials, found.trials, strict=True):
            np.testing.assert_allclose(item.noise_deviation, data.deviation, rtol=0.25)
        told += any(cell.significant for cell in locate(found).cells)
    assert told <= 2
    left = ResidualProcess(*(size * np.ones(3) for size in (500.0, 5.0, 1.0, 0.0)), np.zeros(3, dtype=bool))
    for item in residual_set(unknown, replace(kit.fitted(unknown), residual_process=left)).trials:
        assert np.all(item.predictive_deviation < 1.5 * item.noise_deviation)
    apart = held_out_problem(5, noise=None)
    for item in residual_set(apart, kit.fitted(apart)).trials:  # the same in trials that were held out
        own = dict(zip(item.trial.channels, item.noise_deviation / item.trial.noise_factor, strict=True))
        told = own if item.trial.name == "up" else told
        assert own == pytest.approx({name: told[name] for name in own})


def test_held_out_trials_move_nothing_that_is_shared():
    problem, wild = held_out_problem(5), held_out_problem(5, shift=7.0)
    found, other = kit.fitted(problem), kit.fitted(wild)
    np.testing.assert_array_equal(found.point.shared, other.point.shared)
    assert found.log_evidence == other.log_evidence
    there = problem.with_trials(problem.campaign.held_out)
    start = Point(
        found.point.shared, tuple(np.zeros(d.unknowns.unknown_count) for d in there.trials), np.empty(0)
    )
    adapted = fit(there, Candidate(), start, local_only=True)
    np.testing.assert_array_equal(adapted.point.shared, found.point.shared)
    assert any(np.any(u != 0.0) for u in adapted.point.local)
    # its own nuisances are at their optimum given the rest: the dense solution of one trial
    shown = {item.trial.name: item for item in residual_set(problem, found, sensitivities=False).trials}
    for number, data in enumerate(there.trials):
        parts = there.linearise(number, start, Candidate())
        columns, index = there.prediction_derivatives(number, start, parts, Candidate())
        local, shared = np.split(
            data.standardise(columns).reshape(len(columns), -1), [data.unknowns.unknown_count]
        )
        residual = there.standardised_residual(number, start, parts.response).ravel()
        taken = np.linalg.solve(local @ local.T + np.diag(data.unknowns.precision), local)
        np.testing.assert_allclose(adapted.point.local[number], taken @ residual, atol=0.02)
        # what is left varies by what is shared, less what they took
        along = shared - shared @ local.T @ taken
        more = np.sum(along * (found.covariance[np.ix_(index, index)] @ along), axis=0)
        wanted = 1.0 + more - np.sum(local * taken, axis=0)
        np.testing.assert_allclose(shown[data.trial.name].expected_variance.ravel(), wanted, atol=1e-9)


# ---------------------------------------------------------------- what is left beside the noise


def ringing(seed, samples, extra=None, **given):
    """Return ring-downs with something added to the first channel, and what their fit leaves."""
    problem = kit.closed_problem(seed=seed, kinds=("ringdown",), samples=samples, extra=extra, **given)
    none = kit.fitted(problem)
    return problem, none, estimate_residual_process(problem, none)


def covariance(time, size, tau, frequency):
    lag = np.abs(time[:, np.newaxis] - time)
    return np.asarray(size**2 * np.exp(-lag / tau) * np.cos(frequency * lag) + 1e-9 * np.eye(len(time)))


def coloured(size, tau, frequency, seed=8):
    """Return what adds an exact draw of a remainder to the first channel of every trial, noise 0.02."""
    generator = np.random.default_rng(seed)

    def extra(rows):
        root = np.linalg.cholesky(covariance(0.01 * rows, size, tau, frequency))
        return np.asarray(0.02 * root @ generator.standard_normal(len(rows)))

    return extra


@pytest.mark.parametrize("freedom", [inf, 400.0])
def test_white_noise_has_no_remainder(freedom):
    """Forty campaigns of three channels: none has one, and fits stay as they were."""
    wrong = 0
    for seed in range(40):
        problem, found, left = ringing(seed, 150, noise=NoiseRecord(0.02, freedom))
        wrong += left.is_present
        assert np.all(left.noise_factor >= 1.0)
        if seed == 0:
            assert refit_under_wide_noise(problem, with_wide_noise(problem, left), found) is found
    assert wrong <= 1


@pytest.fixture(scope="module", params=[(3.0, 0.15, 0.0), (2.0, 1.5, 9.0), (np.sqrt(0.2), 1e-6, 0.0)])
def coloured_remainder(request):
    """Amplitude, time and frequency of what is left in y1, the problem, and what is found of it."""
    problem, _, remainder = ringing(4, 900, coloured(*request.param))
    return request.param, problem, remainder


def test_size_time_and_frequency_are_found(coloured_remainder):
    """And of white noise a fifth above its record a size, and no time over which it forgets."""
    (amplitude, time, frequency), problem, remainder = coloured_remainder
    first = problem.channel_names.index("y1")
    over_noise = np.sqrt(np.mean([data.trial.noise_factor**-2 for data in problem.trials]))
    assert remainder.amplitude[first] == pytest.approx(amplitude * over_noise, rel=0.2)
    assert remainder.correlation_time[first] == pytest.approx(time, rel=0.6, abs=0.04)
    assert 2.0 * np.pi * remainder.frequency[first] == pytest.approx(frequency, abs=1.0)


def test_channels_without_a_remainder_have_none(coloured_remainder):
    _, problem, remainder = coloured_remainder
    others = np.delete(remainder.amplitude, problem.channel_names.index("y1"))
    assert np.all(others == 0.0)
    assert not remainder.is_all_recorded_colour


def test_evidence_under_a_wider_noise_is_that_of_a_campaign_with_such_noise():
    """Optimum, covariance and evidence are those of the same campaign whose records say so."""
    problem, none, left = ringing(4, 300, coloured(3.0, 0.15, 0.0))
    found = refit_under_wide_noise(problem, with_wide_noise(problem, left), none)
    names = problem.campaign.channels
    factors = zip(names, left.noise_factor.tolist(), strict=True)
    records = {key: NoiseRecord(0.02 * factor, inf) for key, factor in factors}
    said = kit.fitted(kit.with_noise(problem, **records))
    np.testing.assert_allclose(found.point.shared, said.point.shared, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(found.covariance, said.covariance, rtol=1e-3, atol=1e-9)
    assert found.log_evidence == pytest.approx(said.log_evidence, abs=0.05)
    assert found.chi_square > 3.0 * said.chi_square  # told against the recorded noise


def test_colour_of_the_noise_is_no_gap_where_stamps_are_uneven_and_it_stays():
    """The same process in the trials and in the noise record."""
    generator, wrong = np.random.default_rng(5), [0, 0]
    root = np.linalg.cholesky(covariance(0.01 * np.arange(500), 1.5, 0.03, 0.0) + np.eye(500))
    for seed in range(12):
        samples = 0.02 * root @ generator.standard_normal(500)
        record = NoiseRecord(float(samples.std()), 499.0, samples - samples.mean(), 0.01, "pre-trigger")
        problem, _, _ = ringing(seed, 400, coloured(1.5, 0.03, 0.0, seed))
        trials = (item.rows(np.sort(generator.permutation(400)[:320])) for item in problem.campaign.trials)
        problem = kit.problem_of(replace(problem.campaign, trials=tuple(trials)), problem.model)
        problem = kit.with_noise(problem, y1=record)
        found = kit.fitted(problem)
        wrong[0] += (
            check_absolute_fit(
                problem, replace(found, residual_process=estimate_residual_process(problem, found))
            ).passed
            is False
        )
        located = locate(residual_set(problem, found))
        assert all(cell.channel != "y1" for cell in located.cells)
        wrong[1] += located.disagrees
    assert max(wrong) <= 1
