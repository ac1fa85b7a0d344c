"""What campaigns cannot decide, before any data; the workflow tried on simulated ones of a rig."""

import json
from dataclasses import dataclass, replace
from math import inf, log

import jsonschema
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from benchmarks.cantilever import Cantilever, campaign
from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Start, TrialKind
from discrepancy.fits.candidate import Candidate, EffectTerm
from discrepancy.fits.fitting import CandidateFit, fit
from discrepancy.fits.problem import Problem
from discrepancy.judgement.next_experiment import feasible_proposals, next_experiments, oscillates
from discrepancy.judgement.separability import (
    CONFUSION_DISTANCE,
    DETECTION_DISTANCE,
    campaign_as_predicted,
    compute_separability,
)
from discrepancy.judgement.trial_worth import Alternatives, Proposal, worth_of_trial
from discrepancy.report.decidability_text import group_lines
from discrepancy.self_calibration import SelfCalibration, outcome_of, self_calibrate, wilson_interval
from discrepancy.self_calibration_file import self_calibration_schema, write_self_calibration
from discrepancy.simulation import Simulator
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from tests.discrepancy.rigs import FEW, ORIGIN, measured, model_of
from tests.refusals import Inputs

from . import kit


def group_of(found, identifier):
    """Return the confusion group of an effect, itself alone if it has none."""
    return next((group for group in found.groups if identifier in group), (identifier,))


def decided(model, given, *effects):
    return compute_separability(given, model, kit.problem_of(given, model).setting, kit.chosen(*effects))


def test_ringdown_of_one_mode_cannot_tell_mass_root_and_clock():
    """And none of them from the stiffness, where that is not known from calibration."""
    model = model_of(Inputs(__file__).text("one_mode.toml"))
    channel = Channel("x", Quantity.DISPLACEMENT, "displacement", NoiseRecord(2e-5, inf))
    trial = kit.blank_trial(
        "release", TrialKind.RINGDOWN, ("x",), 0.02 * np.arange(200), load_place="tip",
        release=Release(0.01, 0.02, mode_count=1),
    )  # fmt: skip
    effects = ("point_mass", "support_compliance", "clock_error")
    exact = Campaign("", {"x": channel}, (trial,), None, {"stiffness_factor": (1.0, 1e-4)}, "")
    found = decided(model, exact, *effects)
    assert set(group_of(found, "point_mass")) == set(effects)
    assert all(item.distance > 100.0 for item in found.detectability)  # seen they are
    hidden = decided(model, replace(exact, parameters={"stiffness_factor": (1.0, 0.1)}), *effects)
    for seen, item in zip(found.detectability, hidden.detectability, strict=True):
        if item.effect.identifier != "clock_error":  # its time zero shows
            assert item.distance < 1e-3 * seen.distance


def test_a_release_of_unknown_state_shows_effects_as_one_from_rest_does():
    """Its data say how it begins; from rest nothing would move, and every effect would be seen "never"."""
    bench = kit.chain_bench(static=False, amplitudes=(0.02, 0.012))
    measured = bench.measured(3)
    free = tuple(replace(trial, release=replace(trial.release, at_rest=False)) for trial in measured.trials)
    known, found = (
        decided(bench.model, replace(measured, trials=trials), "quadratic_damping", "coulomb_friction")
        for trials in (measured.trials, free)
    )
    for one, other in zip(known.detectability, found.detectability, strict=True):
        assert 0.5 < other.detectable / one.detectable < 5.0
    nothing = replace(found, identifiers=(), distance=np.zeros((0, 0)), groups=())
    assert "none of the effects" in group_lines(nothing)[0]


def one_gauge_at_one_load_factor(kind: TrialKind) -> Campaign:
    """Return the trials of a kind on the cantilever: one gauge, at rest or at 2 g, with a known modulus."""
    measured_campaign = campaign()
    gauge = next(
        name for name, item in measured_campaign.channels.items() if item.quantity is Quantity.STRAIN
    )
    trials = []
    for trial in measured_campaign.trials:
        if trial.kind is kind:
            column = [trial.channels.index(gauge)]
            load_factor = np.full_like(trial.load_factor, 2.0 if kind is TrialKind.FLIGHT else 0.0)
            of_gauge = replace(
                trial,
                channels=(gauge,),
                values=trial.values[:, column],
                used=trial.used[:, column],
                load_factor=load_factor,
            )
            trials.append(of_gauge)
    channels = {gauge: replace(measured_campaign.channels[gauge], gain_deviation=0.0)}
    known = {item.name: (item.mean, 1e-4 * item.mean) for item in Cantilever().parameters}
    return replace(measured_campaign, channels=channels, trials=tuple(trials), parameters=known)


@pytest.mark.parametrize(
    ("kind", "group"),
    [
        (TrialKind.STATIC, {"gauge_gain", "gauge_misalignment", "local_stiffness_loss"}),
        (TrialKind.FLIGHT, {"washout", "inertia_relief"}),
    ],
)
def test_one_gauge_at_one_load_factor_cannot_tell(kind, group):
    """Damage beside it, or relief beside lift."""
    separability = decided(Cantilever(), one_gauge_at_one_load_factor(kind), *group)
    assert set(group_of(separability, min(group))) == group


SEPARATED = (
    "point_mass",
    "support_compliance",
    "quadratic_damping",
    "coulomb_friction",
    "load_cell",
    "gauge_gain",
)
"""Effects that a whole laboratory test tells apart."""


@pytest.fixture(scope="module")
def laboratory():
    """What a whole laboratory test can tell apart, before any data."""
    return decided(kit.BENCH.model, kit.BENCH.campaign, *SEPARATED, "washout")


def test_a_whole_laboratory_test_separates(laboratory):
    assert laboratory.groups == ()
    assert set(laboratory.identifiers) == set(SEPARATED)
    np.testing.assert_array_equal(np.diag(laboratory.distance), 0.0)


def test_measured_values_do_not_count_for_what_is_separated():
    once, again = (
        decided(kit.BENCH.model, kit.BENCH.measured(seed), *SEPARATED, "washout") for seed in (1, 2)
    )
    np.testing.assert_allclose(once.distance, again.distance, rtol=1e-6)


def test_effects_of_usual_size_are_detectable_and_what_cannot_be_tested_says_why(laboratory):
    for item in laboratory.detectability:
        assert bool(item.reason) is (item.effect.identifier == "washout")
        assert item.reason or item.detectable < item.typical


def refitted_chi_square(measured: Campaign, model: LumpedModel, term: EffectTerm, size: float) -> float:
    """Return χ² of the fit without effect, in data without noise in which an effect of a size hides."""
    problem = kit.problem_of(measured, model)
    point = problem.prior_mean_point(Candidate())
    scaled = term.start_values()
    (magnitude,) = (number for number, parameter in enumerate(term.parameters) if parameter.magnitude)
    scaled[magnitude] = term.parameters[magnitude].prior.standard_normal(size)
    patch = Candidate((term,)).patch(problem.setting, scaled)
    trials = []
    for index, data in enumerate(problem.trials):
        response, _ = problem.response(index, point.shared, point.local[index], patch)
        trials.append(replace(data.trial, values=problem.prediction(index, point, response)))
    changed = kit.problem_of(replace(measured, trials=tuple(trials)), model)
    return fit(changed, Candidate(), changed.prior_mean_point(Candidate())).chi_square


@pytest.mark.parametrize("identifier", ["support_compliance", "stiffness_drift"])
def test_the_least_detectable_size_of_an_effect_leaves_its_squared_distance_after_a_refit(identifier):
    """Also where other parameters imitate it so well that this size is far below the prior's median."""
    bench = kit.chain_bench(static=False)
    measured = bench.measured(3)
    (row,) = decided(bench.model, measured, identifier).detectability
    term = EffectTerm(row.effect, row.place)
    chi_square = refitted_chi_square(measured, bench.model, term, row.detectable)
    assert chi_square == pytest.approx(DETECTION_DISTANCE, rel=0.1)


def test_a_change_is_shrunk_by_the_factor_that_is_told():
    """However small it becomes: the stated distances are scaled back by this factor."""
    (effect,) = kit.chosen("support_compliance")
    term = EffectTerm(effect, "")
    (prior,) = (parameter.prior for parameter in term.parameters if parameter.magnitude)
    shrunk = term.multiply_magnitudes(np.zeros(len(term.parameters)), 1e-9)
    assert prior.value(float(shrunk[0])) == pytest.approx(1e-9 * prior.value(0.0), rel=1e-9)


def test_an_effect_within_the_noise_of_anything_is_not_confused_with_all_others():
    """A gain of a millionth."""
    *others, gauge = kit.chosen("support_compliance", "quadratic_damping", "gauge_gain")
    (gain,) = gauge.parameters
    tiny = replace(gain.prior, low=1e-4 * gain.prior.low, high=1e-4 * gain.prior.high)
    tiny_gain = replace(gauge, parameters=(replace(gain, prior=tiny),))
    found = compute_separability(kit.BENCH.campaign, kit.BENCH.model, kit.BENCH.setting, [*others, tiny_gain])
    assert 1e-6 < found.detectability[-1].distance < 0.1 * CONFUSION_DISTANCE
    assert "gauge_gain" in found.identifiers
    assert found.groups == ()


def test_an_unknown_noise_is_taken_as_a_thousandth_of_the_range():
    """Detectable sizes are finite, and those of a stated deviation of that size."""
    given, model = kit.BENCH.measured(1), kit.BENCH.model
    blank = kit.with_noise(kit.problem_of(given, model), **dict.fromkeys(given.channels))
    ideal = campaign_as_predicted(blank.campaign, model, blank.setting)
    found, again = (
        decided(model, replace(blank.campaign, channels=channels), "gauge_gain", "quadratic_damping")
        for channels in (blank.campaign.channels, ideal.channels)
    )
    for one, other in zip(found.detectability, again.detectability, strict=True):
        assert 0.0 < one.detectable < inf
        assert one.detectable == pytest.approx(other.detectable, rel=0.05)


# ---------------------------------------------------------------- which experiment decides


HALF = np.array([0.5, 0.5])


def known_closed_form(trial, offset_deviation=0.0):
    """Return the problem of one trial of y1 on the closed form, whose parameters are known."""
    channel = Channel("y1", Quantity.DISPLACEMENT, "y1", kit.NOISE, offset_deviation=offset_deviation)
    parameters = {"slope": (1.0, 1e-9), "curvature": (0.5, 1e-9)}
    return kit.problem_of(Campaign("", {"y1": channel}, (trial,), None, parameters, ""), kit.ClosedForm())


def information_in_closed_form(shift, weights):
    """Return the information of a reading of unit noise on whether it is shifted, by quadrature."""

    def density(y):
        joint = weights * norm.pdf(y, [0.0, shift])
        posterior = joint / joint.sum()
        return float(np.sum(joint * (np.log(posterior) - np.log(weights))))

    information, _ = quad(density, -8.0, 8.0 + shift)
    return information


@pytest.mark.parametrize("shift", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("weight", [0.5, 0.2])
def test_information_of_one_reading_against_quadrature(shift, weight):
    """Of unit noise; two hypotheses: nothing, or an offset of `shift` noise deviations."""
    trial = kit.blank_trial("one", TrialKind.STATIC, ("y1",), np.array([1.0]))
    trial = replace(trial, values=np.full((1, 1), 1.5))
    problem = known_closed_form(trial)
    nothing = kit.fitted(problem)
    offset = kit.fitted(problem, EffectTerm(kit.offset_effect(deviation=0.02), "y1"))
    shifted = replace(nothing.point, effect=np.array([shift]))
    fits = [nothing, replace(offset, point=shifted, covariance=np.diag([1.0, 1.0, 1e-12]))]
    weights = np.array([weight, 1.0 - weight])
    proposal = Proposal(trial, "", "", 1.0)
    alternatives = Alternatives.single(fits, weights)
    information = worth_of_trial(problem, proposal, alternatives).information
    under_a_free_zero = worth_of_trial(known_closed_form(trial, inf), proposal, alternatives)
    entropy = -float(weights @ np.log(weights))
    assert 0.0 <= information <= entropy
    # 300 outcomes each: standard error about 0.02
    assert information == pytest.approx(information_in_closed_form(shift, weights), abs=0.06)
    assert under_a_free_zero.information < 0.02


@dataclass(frozen=True)
class TwoHypotheses:
    """Stiffening with amplitude and drift with time, which look alike in releases from one amplitude."""

    problem: Problem
    fits: list[CandidateFit]

    def information(self, proposal):
        return worth_of_trial(self.problem, proposal, Alternatives.single(self.fits, HALF)).information

    def best_experiments(self):
        return next_experiments(self.problem, [(item, 0.5) for item in self.fits])


@pytest.fixture(scope="module")
def amplitude_or_time():
    bench = kit.chain_bench(static=False, amplitudes=(0.01, 0.01), samples=160)
    problem = bench.problem(3, bench.patch("cubic_stiffness", {"stiffening": 0.01}, "end"))
    stiffening, drift = kit.chosen("cubic_stiffness", "stiffness_drift")
    fits = [kit.fitted(problem, term) for term in (EffectTerm(stiffening, "end"), EffectTerm(drift))]
    return TwoHypotheses(problem, fits)


def test_another_amplitude_decides_between_amplitude_and_time(amplitude_or_time):
    proposals = list(feasible_proposals(amplitude_or_time.problem))
    information = {item.trial.name: amplitude_or_time.information(item) for item in proposals}
    repetition = Proposal(amplitude_or_time.problem.campaign.trials[0], "", "", 1.0)
    twice = information["release at twice the largest amplitude so far"]
    assert all(0.0 <= value <= log(2.0) + 1e-9 for value in information.values())
    assert twice > amplitude_or_time.information(repetition)
    assert twice > 0.95 * log(2.0)


def test_the_experiments_that_tell_most_for_their_cost_come_first(amplitude_or_time):
    best = list(amplitude_or_time.best_experiments())
    assert best
    assert best == sorted(best, key=lambda item: -item.information / item.cost)
    # a longer record may do as well, for less; of all repetitions another amplitude comes first
    assert "amplitude" in next(item.description for item in best if item.cost >= 1.0)


def test_the_next_experiments_are_seeded(amplitude_or_time):
    assert amplitude_or_time.best_experiments() == amplitude_or_time.best_experiments()


@pytest.fixture(scope="module")
def laboratory_problem():
    return kit.BENCH.problem(1)


def test_proposals_are_trials_of_the_kinds_that_were_done(laboratory_problem):
    proposals = list(feasible_proposals(laboratory_problem))
    assert {item.trial.kind for item in proposals} == {TrialKind.STATIC, TrialKind.RINGDOWN}
    assert len({item.description for item in proposals}) == len(proposals)


def test_proposals_have_a_cost_and_a_reading_at_each_time(laboratory_problem):
    for proposal in feasible_proposals(laboratory_problem):
        assert proposal.cost > 0.0
        assert len(proposal.trial.time) == len(proposal.trial.values)


def test_a_longer_record_is_three_times_the_largest_release(laboratory_problem):
    proposals = feasible_proposals(laboratory_problem)
    longer = next(item for item in proposals if item.trial.name == "longer record")
    releases = [trial for trial in laboratory_problem.campaign.trials if trial.release]
    largest = max(releases, key=lambda trial: trial.release.displacement)
    count = 3 * len(largest.time)
    assert longer.trial.interval == pytest.approx(largest.interval)
    assert len(longer.trial.time) == count
    assert f"({count * largest.interval:.3g} s)" in longer.description


def test_what_only_decays_does_not_oscillate(laboratory_problem):
    fitted = kit.fitted(laboratory_problem)
    decaying = []
    for data, derivatives in zip(laboratory_problem.trials, fitted.trial_derivatives, strict=True):
        decay = np.exp(-data.trial.time)[:, np.newaxis] * np.ones(derivatives.response.shape[1])
        decaying.append(replace(derivatives, response=decay))
    assert oscillates(laboratory_problem, fitted)
    assert not oscillates(laboratory_problem, replace(fitted, trial_derivatives=tuple(decaying)))


def test_a_longer_record_is_proposed_of_what_oscillates_only(laboratory_problem):
    proposals = feasible_proposals(laboratory_problem, is_oscillating=False)
    names = [item.trial.name for item in proposals]
    assert names
    assert "longer record" not in names


# ---------------------------------------------------------------- self-calibration


@pytest.mark.parametrize(
    ("hidden", "kind", "named", "group", "outcome"),
    [
        ("nothing", VerdictKind.NOTHING_MISSING, (), (), "right"),
        ("nothing", VerdictKind.NAMED, ("a",), (), "wrong"),
        ("a", VerdictKind.NAMED, ("a",), (), "right"),
        ("a", VerdictKind.NAMED, ("b",), (), "wrong"),
        ("a", VerdictKind.NAMED, ("a", "b"), (), "wrong"),
        ("a", VerdictKind.GROUP, ("b", "a"), ("b", "a"), "group"),
        ("a", VerdictKind.GROUP, ("b", "c"), ("b", "c"), "wrong"),
        ("a", VerdictKind.GROUP, ("a", "b"), ("a + b",), "group"),
        ("a", VerdictKind.FAMILY, ("a",), (), "family"),
        ("a", VerdictKind.FAMILY, ("b",), (), "wrong"),
        ("a", VerdictKind.NOTHING_MISSING, (), (), "missed"),
        ("a", VerdictKind.UNEXPLAINED, (), (), "unexplained"),
    ],
)
def test_how_verdicts_count(hidden, kind, named, group, outcome):
    assert outcome_of(hidden, kind, named, group) == outcome


SEEDS = range(12)


@pytest.fixture(scope="module")
def simulator():
    """What simulates campaigns like one of the single-mass rig."""
    return Simulator(*measured())


@pytest.fixture(scope="module")
def simulated_campaigns(simulator):
    """A campaign without any effect for each seed."""
    return [simulator.simulate(None, np.random.default_rng(seed)) for seed in SEEDS]


def test_simulated_campaigns_have_the_trials_of_the_real_one(simulated_campaigns):
    names = [trial.name for trial in measured()[0].trials]
    for simulated in simulated_campaigns:
        assert [trial.name for trial in simulated.trials] == names


def test_simulated_campaigns_repeat_with_their_seed(simulator, simulated_campaigns):
    for seed, simulated in zip(SEEDS, simulated_campaigns, strict=True):
        again = simulator.simulate(None, np.random.default_rng(seed))
        assert np.array_equal(again.trials[-1].values, simulated.trials[-1].values)


def test_nothing_is_missing_in_simulated_campaigns_without_an_effect(simulated_campaigns):
    _, model = measured()
    for simulated in simulated_campaigns[:2]:
        found = investigate(simulated, model, (), thorough=False)
        assert found.verdict.kind is VerdictKind.NOTHING_MISSING


def test_simulated_campaigns_have_the_noise_of_the_real_one(simulator, simulated_campaigns):
    """Sixth differences of a slow motion hold noise alone, times the sum of squared binomials."""
    sum_of_squared_binomials = 924.0
    variance_ratios = []
    for simulated in simulated_campaigns:
        trial = simulated.trials[-1]
        sixth_differences = np.diff(trial.values[:, 0], 6)
        stated = simulator.problem.noise_models[trial.channels[0]].standard_deviation
        variance = float(np.mean(sixth_differences**2)) / sum_of_squared_binomials
        variance_ratios.append(variance / stated**2)
    assert np.mean(variance_ratios) == pytest.approx(1.0, abs=0.12)


def test_a_motion_that_began_before_its_record_goes_on_in_simulated_campaigns():
    """As in the real record, and not from a state of any size."""
    campaign, model = measured(kind="ringdown")
    unknown = {"kind": TrialKind.FORCED, "release": None, "begins": Start.UNKNOWN}
    trials = tuple(replace(trial, **unknown) for trial in campaign.trials)
    simulator = Simulator(replace(campaign, trials=trials), model)
    for seed in range(5):
        drawn = simulator.simulate(None, np.random.default_rng(seed))
        for trial, own in zip(trials, drawn.trials, strict=True):
            np.testing.assert_allclose(own.values[0], trial.values[0], atol=0.1 * np.ptp(trial.values))


@dataclass(frozen=True)
class TriedWorkflow:
    """The workflow tried on six simulated campaigns of static trials, and how often it reported progress."""

    campaign: Campaign
    model: LumpedModel
    result: SelfCalibration
    step_count: int


@pytest.fixture(scope="module")
def tried():
    campaign, model = measured(kind="static")
    steps = []
    result = self_calibrate(campaign, model, FEW, 6, seed=2, workers=1, advance=lambda: steps.append(1))
    return TriedWorkflow(campaign, model, result, len(steps))


def test_the_workflow_tried_on_its_own_geometry_has_a_case_for_each_campaign(tried):
    cases = tried.result.cases
    assert tried.step_count == len(cases) == 6
    assert [case.hidden == "nothing" for case in cases] == [True, False, False] * 2


def test_effects_are_hidden_with_a_size_that_can_be_seen(tried):
    assert all(case.distance >= 25.0 for case in tried.result.cases if case.hidden != "nothing")


def test_shares_and_confusions_count_each_case(tried):
    _, _, counts = tried.result.confusion()
    assert sum(counts.ravel()) == 6
    assert tried.result.share("right", null=True).total == 2


def test_the_interval_of_a_share_is_that_of_wilson():
    """In closed form (Wilson 1927)."""
    none = wilson_interval(0, 9)
    square = norm.ppf(0.95) ** 2
    assert (none.value, none.low, none.high) == pytest.approx((0.0, 0.0, square / (9.0 + square)))
    assert wilson_interval(0, 0).total == 0


def test_two_workers_come_to_the_same_self_calibration_as_one(tried):
    again = self_calibrate(tried.campaign, tried.model, FEW, 6, seed=2, workers=2)
    assert again == tried.result


def test_a_self_calibration_is_written_with_its_cases(tried, tmp_path):
    path = write_self_calibration(tmp_path / "self_calibration.json", tried.result, ORIGIN)
    stored = json.loads(path.read_text(encoding="utf-8"))
    assert stored["schema"] == "uav-twin self calibration 1"
    jsonschema.validate(stored, self_calibration_schema())
    assert len(stored["cases"]) == 6
