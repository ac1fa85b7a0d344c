"""The whole way on simulated campaigns: of the chain, and of what begins with an event."""

import gc
from dataclasses import replace

import numpy as np
import pytest

from discrepancy.campaign.protocol import Event
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Start, Trial, TrialKind
from discrepancy.catalogue.effect_file import effects_of_file
from discrepancy.catalogue.library import library, variants_in_events
from discrepancy.errors import CampaignDataError
from discrepancy.fits.candidate import Candidate, EffectTerm
from discrepancy.fits.fitting import fit
from discrepancy.judgement.decide import comparison_of
from discrepancy.judgement.separability import campaign_as_predicted
from discrepancy.sources.examples import example_campaign, plan_from_scales
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.response import Conditions
from discrepancy.system.sensing import observe
from discrepancy.verdict import VerdictKind
from discrepancy.verdict_remarks import missing_port_remark
from discrepancy.workflow import investigate, patch_draws, time_step_error
from fe.runtime.patch import ModelPatch, PowerDamping, Window
from tests.costs import once
from tests.discrepancy.rigs import FEW, drag_found, measured, one_mass, setting_of
from tests.refusals import Inputs

from . import kit

pytestmark = pytest.mark.xdist_group("verdict")  # one worker finds it
LABORATORY = kit.chain_bench(amplitudes=(0.004, 0.003, 0.002), samples=200, held_out=True)

"""Static trials and releases; one of each held out."""

EFFECTS = kit.chosen("quadratic_damping", "gauge_gain", "load_cell", "stiffness_drift", "coulomb_friction")


def judged(campaign, effects=EFFECTS, **how):
    return investigate(campaign, LABORATORY.model, effects, **how)


def spoilt(seed, change):
    """Return a campaign with the readings of each trial changed in place."""
    campaign = LABORATORY.measured(seed)
    for trial in campaign.trials:
        change(trial)
    return campaign


def test_an_effect_is_named():
    found = drag_found()
    assert found.verdict.kind is VerdictKind.NAMED, found.verdict.sentence
    assert found.location is not None


def test_a_named_effect_is_proved_on_trials_not_used():
    proof = drag_found().proof
    assert proof.closed.value >= 0.9
    assert 0.8 <= proof.held_out_after.chi_square_per_sample <= 1.2
    assert proof.log_score_gain > 0.0


def test_the_time_steps_of_a_search_are_short_enough():
    found = drag_found()
    assert not any("time steps cost" in remark for remark in found.verdict.remarks)
    assert time_step_error(found.problem, found.fit) < 0.1


def test_open_hypotheses_are_sets_each_once_with_the_most_probable_first():
    hypotheses = comparison_of(drag_found().search).open_hypotheses(count=4)
    sets = [fit_of_set.candidate.identifiers for fit_of_set, _ in hypotheses]
    probabilities = [probability for _, probability in hypotheses]
    assert len(set(sets)) == len(sets) > 0
    assert probabilities == sorted(probabilities, reverse=True)


def test_draws_of_a_patch_have_the_standard_deviation_of_the_posterior():
    found = drag_found()
    deviation = float(np.sqrt(found.fit.effect_covariance[0, 0]))

    def coefficient(effect):
        return found.fit.candidate.patch(found.problem.setting, effect).primitives[0].coefficient

    low = coefficient(found.fit.point.effect - deviation)
    high = coefficient(found.fit.point.effect + deviation)
    (draws,) = patch_draws(found.problem, found.fit, seed=1, count=300)
    drawn = np.array([draw.primitives[0].coefficient for draw in draws])
    assert drawn.std() == pytest.approx(0.5 * (high - low), rel=0.2)


def test_draws_of_a_patch_repeat_with_their_seed():
    found = drag_found()
    draws = patch_draws(found.problem, found.fit, seed=1, count=300)
    assert patch_draws(found.problem, found.fit, seed=1, count=300) == draws


@pytest.fixture(scope="module")
def drag_found_again():
    """The same search once more, with the same seed."""
    return investigate(*measured(0.01), FEW, seed=3, thorough=False)


def test_the_same_seed_gives_the_same_verdict(drag_found_again):
    found = drag_found()
    assert drag_found_again.verdict.sentence == found.verdict.sentence
    assert drag_found_again.verdict.probability == found.verdict.probability


def test_the_same_seed_gives_the_same_proof_and_the_same_fit_to_the_bit(drag_found_again):
    found = drag_found()
    assert drag_found_again.proof.closed == found.proof.closed
    assert drag_found_again.fit.point.effect.tobytes() == found.fit.point.effect.tobytes()


def wrong_row(trial):
    """Return the row of the wrong reading: a heavily damped line would explain one at the beginning."""
    return 0 if trial.held_out else -1


@pytest.fixture(scope="module")
def found_beside_wrong_readings():
    """What is found where one end of each ring-down, those held out as well, has a wrong reading."""

    def change(trial):
        if trial.is_dynamic:
            noise = LABORATORY.campaign.channels[trial.channels[0]].noise.standard_deviation
            trial.values[wrong_row(trial), 0] += 30.0 * noise

    return judged(spoilt(21, change), thorough=False)


def test_wrong_readings_at_the_ends_of_records_explain_no_effect(found_beside_wrong_readings):
    verdict = found_beside_wrong_readings.verdict
    assert verdict.kind is VerdictKind.NOTHING_MISSING, verdict.sentence


def test_wrong_readings_at_the_ends_of_records_are_left_out(found_beside_wrong_readings):
    for trial in found_beside_wrong_readings.campaign.trials:
        if trial.is_dynamic:
            assert not trial.used[wrong_row(trial), 0]
            assert trial.used.sum() >= trial.used.size - 2


def test_readings_that_are_left_out_are_remarked_on(found_beside_wrong_readings):
    campaign = found_beside_wrong_readings.campaign
    remarks = [remark for remark in campaign.remarks if "left out" in remark]
    for trial in campaign.trials:
        if trial.is_dynamic:
            assert any(repr(trial.name) in remark for remark in remarks)


def test_where_nothing_is_missing_there_is_neither_a_proof_nor_an_experiment():
    found = judged(LABORATORY.measured(22))
    assert found.verdict.kind is VerdictKind.NOTHING_MISSING, found.verdict.sentence
    assert found.proof is None
    assert found.verdict.next_experiments == ()


def test_microstrain_for_strain_is_an_error_of_the_data_and_no_effect():
    def change(trial):
        trial.values[:, trial.channels.index("g1")] *= 1e6

    found = judged(spoilt(23, change))
    assert found.verdict.kind is VerdictKind.DATA_ERROR, found.verdict.sentence
    assert found.search is None


def test_the_experiments_that_an_open_verdict_asks_for_tell_no_more_than_there_is_to_know():
    """Three hypotheses are open: at most log 3."""
    patch = kit.BENCH.patch("clock_error", {"rate_error": 0.005, "phase_zero": 0.0})
    verdict = judged(kit.BENCH.measured(1, patch), kit.chosen("clock_error", "load_cell")).verdict
    assert verdict.kind is VerdictKind.GROUP, verdict.sentence
    for experiment in verdict.next_experiments:
        assert 0.0 < experiment.information <= np.log(3.0) + 1e-9


def test_a_misspelt_parameter_is_refused_with_the_nearest_one():
    misspelt = replace(LABORATORY.measured(1), parameters={"stifness_factor": (1.0, 0.01)})
    with pytest.raises(CampaignDataError, match=r"'stifness_factor'.*stiffness_factor"):
        judged(misspelt)


def test_exact_readings_without_a_noise_record_have_nothing_missing_and_the_sentence_says_why():
    """They are what the model says, to the last bit: there is nothing by which to weigh the residuals."""
    exact = campaign_as_predicted(LABORATORY.campaign, LABORATORY.model, LABORATORY.setting)
    channels = {name: replace(channel, noise=None) for name, channel in exact.channels.items()}
    found = judged(replace(exact, trials=exact.fitted, channels=channels), thorough=False)
    assert found.verdict.kind is VerdictKind.NOTHING_MISSING
    assert "No noise record" in found.verdict.text


def test_a_gain_far_from_its_prior_is_remarked_on():
    """A displacement sensor with a wrong gain beside gauges has no entry: the nuisance takes it, far out."""

    def change(trial):
        if "x2" in trial.channels:
            trial.values[:, trial.channels.index("x2")] *= 1.05

    for campaign, far in ((spoilt(1, change), True), (LABORATORY.measured(1), False)):
        remarks = " ".join(judged(campaign, EFFECTS[:1], thorough=False).verdict.remarks)
        assert ("The gain of the channel 'x2'" in remarks) is far
        assert ("differs from its stated value" in remarks) is far


CHAIN = LumpedModel.load("three_mass_chain")
CHAIN_PLAN = plan_from_scales(CHAIN, ("x3", "x1"), "end")


def remarks_on_ports(kind, *, without_ports):
    """Return the remarks on ports of an example campaign of the chain."""
    campaign = example_campaign(CHAIN, kind, 1, CHAIN_PLAN)
    bare = LumpedModel(CHAIN.description.model_copy(update={"port": ()}))
    return missing_port_remark(setting_of(campaign, bare if without_ports else CHAIN), library())


def test_where_the_model_has_ports_none_is_asked_for():
    assert remarks_on_ports("ringdown", without_ports=False) == []


def test_effects_that_lack_a_port_are_remarked_on():
    (remark,) = remarks_on_ports("ringdown", without_ports=True)
    assert remark.startswith("Not tested for lack of a port: Coulomb friction, ")
    assert "drift" not in remark


def test_a_remark_on_a_missing_port_says_which_port_to_declare():
    (remark,) = remarks_on_ports("ringdown", without_ports=True)
    assert "joint micro-slip (Iwan) and Bouc-Wen hysteresis; declare a [[port]]" in remark
    assert "vector = [0, 0, 1] between the ground and 'end'" in remark


def test_no_port_is_asked_for_where_it_would_not_help():
    """In static trials there is no motion that friction could resist."""
    (remark,) = remarks_on_ports("static", without_ports=True)
    assert "Coulomb" not in remark


# ---------------------------------------------------------------- remembered responses


def test_trials_that_came_and_went_are_not_mistaken_for_each_other():
    """Trials of proposals live briefly; their addresses are used again."""
    problem = kit.closed_problem()
    template = problem.campaign.trials[0]
    channels = problem.campaign.channels
    outputs = tuple((channels[name].output, channels[name].quantity) for name in template.channels)
    memo = problem.model
    plain = memo.with_patch(ModelPatch())
    conditions = Conditions(np.array([1.0, 0.5]), health=np.zeros((9, 2)))
    for number in range(200):
        trial = replace(template, force=float(number) * template.force)
        got, wanted = (item.respond(trial, outputs, ModelPatch(), conditions) for item in (memo, plain))
        np.testing.assert_array_equal(got.values, wanted.values)
        del trial
        gc.collect(0)


# ---------------------------------------------------------------- what begins with an event


NOISE = 2e-4
(COULOMB,) = kit.chosen("coulomb_friction")


def held_by_a_spring(**deviations):
    """A mass on a spring, with parameters that are known to a deviation."""
    rows = [
        {"name": name, "terms": name, "deviation": size, "low": 0.1, "high": 4.0}
        for name, size in deviations.items()
    ]
    return one_mass(stiffness=200.0, damping={"ratios": [0.02]}, parameter=rows)


MODEL = held_by_a_spring(stiffness=0.02, damping=0.2)
BEGIN = {"first": 4.137, "second": 2.221}


def pushed(model, factors, *laws, slow=0.0):
    """Two records of the mass under a force, one held out, its parameters at factors; noise that is slow."""
    generator = np.random.default_rng(7)
    time = np.linspace(0.0, 8.0, 201)
    trials = []
    for name in BEGIN:
        tones = []
        for frequency in (0.4, 0.9, 1.3, 1.7):
            amplitude = generator.normal()
            phase = generator.uniform(0, 6)
            tones.append(amplitude * np.sin(2.0 * np.pi * frequency * time + phase))
        trial = Trial.plain(
            name,
            TrialKind.FORCED,
            ("x",),
            time,
            force=3.0 * np.sum(tones, axis=0),
            load_place="push",
            begins=Start.STILL,
            held_out=name == "second",
        )
        trials.append(trial)
    channels = {"x": Channel("x", Quantity.DISPLACEMENT, "x", NoiseRecord(NOISE, 500.0))}
    events = tuple(Event("bolt_loose", (name,), time=begin) for name, begin in BEGIN.items())
    campaign = Campaign("a bolt", channels, tuple(trials), None, {}, "0" * 64, events=events)
    for trial in campaign.trials:
        conditions = Conditions(np.array(factors), refinement=4)
        response = observe(model, campaign, trial, ModelPatch(laws), conditions).values
        trial.values[:] = response + NOISE * generator.standard_normal(response.shape)
        if slow:
            trial.values[:] += slow * NOISE * kit.coloured(generator, (0.9,), *response.shape)
    return campaign


@pytest.fixture(scope="module")
def campaign():
    windows = tuple(Window(name, begin) for name, begin in BEGIN.items())
    return pushed(MODEL, (1.01, 0.9), PowerDamping("slide", 0.4, 0.0, 0.0, 1.0, 1.0, windows=windows))


@pytest.fixture(scope="module")
def gain_or_parameters():
    """The verdict on one channel under a recorded force, where a load cell may be wrong or all parameters."""
    model = held_by_a_spring(mass=0.004, stiffness=0.004, damping=0.004)
    campaign = pushed(model, (1.05, 1.05, 1.0))
    return investigate(campaign, model, kit.chosen("load_cell"), thorough=False).verdict


def test_a_gain_that_only_keeps_parameters_near_their_priors_is_no_name(gain_or_parameters):
    assert gain_or_parameters.kind is VerdictKind.UNEXPLAINED, gain_or_parameters.sentence
    assert gain_or_parameters.effects == ()


def test_parameters_far_from_their_priors_are_told_with_what_data_cannot_distinguish(gain_or_parameters):
    assert "('mass' 11.0, 'stiffness' 1" in gain_or_parameters.text
    assert "with one channel, these data cannot distinguish the two" in gain_or_parameters.text


@once
def friction_in_part():
    """What is found where friction acts and something slow remains."""
    friction = PowerDamping("slide", 0.4, 0.0, 0.0, 1.0, 1.0)
    campaign = replace(pushed(MODEL, (1.01, 0.9), friction, slow=1.0), events=())
    competing = kit.chosen("coulomb_friction", "quadratic_damping")
    return investigate(campaign, MODEL, competing, thorough=False)


def test_a_law_beside_which_something_slow_is_left_is_named_in_part():
    verdict = friction_in_part().verdict
    assert verdict.kind is VerdictKind.NAMED_IN_PART, verdict.sentence
    assert [effect.identifier for effect in verdict.effects] == ["coulomb_friction"]


def test_a_law_that_is_named_in_part_has_its_coefficient_and_less_than_the_whole_gap():
    (effect,) = friction_in_part().verdict.effects
    (law,) = effect.patch.primitives
    closed = friction_in_part().proof.closed
    assert law.coefficient == pytest.approx(0.4, rel=0.1)
    assert 0.8 < closed.low < closed.value < 1.0


@pytest.fixture(scope="module")
def verdict_with_event(campaign):
    return investigate(campaign, MODEL, [COULOMB], thorough=False).verdict


def test_friction_that_begins_with_an_event_is_named_with_it(verdict_with_event):
    assert verdict_with_event.kind is VerdictKind.NAMED
    identifiers = [effect.identifier for effect in verdict_with_event.effects]
    assert identifiers == ["coulomb_friction_during_bolt_loose"]


def test_the_law_of_an_event_has_its_coefficient_and_its_beginnings(verdict_with_event):
    (effect,) = verdict_with_event.effects
    (law,) = effect.patch.primitives
    told = "acts from 4.137 s on in 'first'; from 2.221 s on in 'second'."
    assert law.coefficient == pytest.approx(0.4, rel=0.03)
    assert law.windows == (Window("first", 4.137), Window("second", 2.221))
    assert verdict_with_event.text.endswith(told)


@pytest.mark.parametrize("first_event", [1, 2], ids=["an event of a held-out trial alone", "no event"])
def test_without_an_event_to_fit_no_effect_begins_with_one(campaign, first_event):
    setting = kit.problem_of(campaign, MODEL).setting
    fewer = replace(setting, campaign=replace(campaign, events=campaign.events[first_event:]))
    assert variants_in_events(library(), fewer) == ()


def test_what_can_be_switched_may_begin_with_an_event_and_nothing_else(campaign):
    variants = variants_in_events(library(), kit.problem_of(campaign, MODEL).setting)
    names = {effect.identifier for effect in variants}
    assert {"coulomb_friction_during_bolt_loose", "mains_hum_during_bolt_loose"} <= names
    assert not any(name.startswith(("clock_error", "point_mass", "high_pass")) for name in names)


def test_a_moment_that_is_a_parameter_is_found_within_one_percent(campaign):
    (effect,) = effects_of_file(Inputs(__file__).folder / "late_friction.toml")
    problem = kit.problem_of(replace(campaign, trials=campaign.trials[:1], events=()), MODEL)
    term = EffectTerm(effect, "slide")
    candidate = Candidate((term,))
    start = replace(problem.prior_mean_point(candidate), effect=np.array([0.0, 0.8]))
    found = fit(problem, candidate, start)
    values = term.physical_values(found.point.effect)
    assert found.chi_square < 1.3 * float(problem.sample_counts.sum())
    assert abs(values["moment"] - 4.137) < 0.01 * 8.0
    assert values["size"] == pytest.approx(0.4, rel=0.03)
