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
from discrepancy.judgement.separability import campaign_as_predicted
from discrepancy.sources.examples import example_campaign, plan_from_scales
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.response import Conditions
from discrepancy.system.sensing import observe
from discrepancy.verdict import VerdictKind
from discrepancy.verdict_remarks import missing_port_remark
from discrepancy.workflow import investigate, open_hypotheses, patch_draws, time_step_error
from fe.runtime.patch import ModelPatch, PowerDamping, Window
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


def test_an_effect_is_named_and_proved_on_trials_not_used():
    """Draws of its patch have the posterior's spread, and the same seed gives the same verdict."""
    found = drag_found()
    assert found.verdict.kind is VerdictKind.NAMED, found.verdict.sentence
    assert found.proof.closed.value >= 0.9
    assert 0.8 <= found.proof.held_out_after.chi_square_per_sample <= 1.2
    assert found.proof.log_score_gain > 0.0
    assert found.location is not None
    assert not any("time steps cost" in remark for remark in found.verdict.remarks)
    assert time_step_error(found.problem, found.fit) < 0.1
    sets, shares = zip(
        *((f.candidate.identifiers, p) for f, p in open_hypotheses(found.search, count=4)), strict=True
    )
    assert len(set(sets)) == len(sets)
    assert list(shares) == sorted(shares, reverse=True)

    (draws,), again = (patch_draws(found.problem, found.fit, seed=1, count=300) for _ in range(2))
    assert again[0] == draws
    values = np.array([draw.primitives[0].coefficient for draw in draws])
    effect, spread = found.fit.point.effect, float(np.sqrt(found.fit.effect_covariance[0, 0]))
    low, high = (
        found.fit.candidate.patch(found.problem.setting, effect + side * spread).primitives[0].coefficient
        for side in (-1.0, 1.0)
    )
    assert values.std() == pytest.approx(0.5 * (high - low), rel=0.2)

    other = investigate(*measured(0.01), FEW, seed=3, thorough=False)
    assert other.verdict.sentence == found.verdict.sentence
    assert other.verdict.probability == found.verdict.probability
    assert other.proof.closed == found.proof.closed
    assert other.fit.point.effect.tobytes() == found.fit.point.effect.tobytes()


def test_wrong_readings_at_the_ends_of_records_are_left_out():
    """A heavily damped line would explain the first one; held-out records are judged as well."""

    def change(trial):
        if trial.is_dynamic:
            noise = LABORATORY.campaign.channels[trial.channels[0]].noise.standard_deviation
            trial.values[0 if trial.held_out else -1, 0] += 30.0 * noise

    found = judged(spoilt(21, change), thorough=False)
    assert found.verdict.kind is VerdictKind.NOTHING_MISSING, found.verdict.sentence
    for trial in found.campaign.trials:
        if trial.is_dynamic:
            assert not trial.used[0 if trial.held_out else -1, 0]
            assert trial.used.sum() >= trial.used.size - 2
            assert any(repr(trial.name) in text and "left out" in text for text in found.campaign.remarks)


def test_verdicts_that_name_nothing():
    """Nothing missing has no proof; microstrain for strain is not an effect; an open verdict has
    experiments.
    """
    result = judged(LABORATORY.measured(22))
    assert result.verdict.kind is VerdictKind.NOTHING_MISSING, result.verdict.sentence
    assert result.proof is None
    assert result.verdict.next_experiments == ()

    def change(trial):
        trial.values[:, trial.channels.index("g1")] *= 1e6

    result = judged(spoilt(23, change))
    assert result.verdict.kind is VerdictKind.DATA_ERROR, result.verdict.sentence
    assert result.search is None

    patch = kit.BENCH.patch("clock_error", {"rate_error": 0.005, "phase_zero": 0.0})
    result = judged(kit.BENCH.measured(1, patch), kit.chosen("clock_error", "load_cell"))
    assert result.verdict.kind is VerdictKind.GROUP, result.verdict.sentence
    for item in result.verdict.next_experiments:
        assert 0.0 < item.information <= np.log(3.0) + 1e-9

    misspelt = replace(LABORATORY.measured(1), parameters={"stifness_factor": (1.0, 0.01)})
    with pytest.raises(CampaignDataError, match=r"'stifness_factor'.*stiffness_factor"):
        judged(misspelt)

    # what the model says, to the last bit, and no noise record: nothing to weigh the rest by
    exact = campaign_as_predicted(LABORATORY.campaign, LABORATORY.model, LABORATORY.setting)
    channels = {name: replace(item, noise=None) for name, item in exact.channels.items()}
    result = judged(replace(exact, trials=exact.fitted, channels=channels), thorough=False)
    assert result.verdict.kind is VerdictKind.NOTHING_MISSING
    assert "No noise record" in result.verdict.sentence


def test_a_gain_far_from_its_prior_is_remarked_on():
    """A displacement sensor with a wrong gain beside gauges has no entry: the nuisance takes it, far out."""

    def change(trial):
        if "x2" in trial.channels:
            trial.values[:, trial.channels.index("x2")] *= 1.05

    for campaign, far in ((spoilt(1, change), True), (LABORATORY.measured(1), False)):
        remarks = " ".join(judged(campaign, EFFECTS[:1], thorough=False).verdict.remarks)
        assert ("The gain of the channel 'x2'" in remarks) is far
        assert ("differs from its stated value" in remarks) is far


def test_effects_that_lack_a_port_are_remarked_on_with_the_port_to_declare():
    chain = LumpedModel.load("three_mass_chain")
    plan = plan_from_scales(chain, ("x3", "x1"), "end")
    campaign = example_campaign(chain, "ringdown", 1, plan)
    assert missing_port_remark(setting_of(campaign, chain), library()) == []
    bare = LumpedModel(chain.description.model_copy(update={"port": ()}))
    (remark,) = missing_port_remark(setting_of(campaign, bare), library())
    assert remark.startswith("Not tested for lack of a port: Coulomb friction, ")
    assert "joint micro-slip (Iwan) and Bouc-Wen hysteresis; declare a [[port]]" in remark
    assert "vector = [0, 0, 1] between the ground and 'end'" in remark
    assert "drift" not in remark
    static = example_campaign(chain, "static", 1, plan)
    (remark,) = missing_port_remark(setting_of(static, bare), library())
    assert "Coulomb" not in remark  # a port would not help: there is no motion


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


def pushed(model, factors, *items, slow=0.0):
    """Two records of the mass under a force, one held out, its parameters at factors; noise that is slow."""
    rng, time = np.random.default_rng(7), np.linspace(0.0, 8.0, 201)
    trials = []
    for name in BEGIN:
        parts = [
            rng.normal() * np.sin(2.0 * np.pi * f * time + rng.uniform(0, 6)) for f in (0.4, 0.9, 1.3, 1.7)
        ]
        given = {"load_place": "push", "begins": Start.STILL, "held_out": name == "second"}
        force = 3.0 * np.sum(parts, axis=0)
        trials.append(Trial.plain(name, TrialKind.FORCED, ("x",), time, force=force, **given))
    channels = {"x": Channel("x", Quantity.DISPLACEMENT, "x", NoiseRecord(NOISE, 500.0))}
    events = tuple(Event("bolt_loose", (name,), time=begin) for name, begin in BEGIN.items())
    base = Campaign("a bolt", channels, tuple(trials), None, {}, "0" * 64, events=events)
    for trial in base.trials:
        conditions = Conditions(np.array(factors), refinement=4)
        shown = observe(model, base, trial, ModelPatch(items), conditions).values
        trial.values[:] = shown + NOISE * rng.standard_normal(shown.shape)
        if slow:
            trial.values[:] += slow * NOISE * kit.coloured(rng, (0.9,), *shown.shape)
    return base


@pytest.fixture(scope="module")
def campaign():
    windows = tuple(Window(name, begin) for name, begin in BEGIN.items())
    return pushed(MODEL, (1.01, 0.9), PowerDamping("slide", 0.4, 0.0, 0.0, 1.0, 1.0, windows=windows))


def test_a_gain_that_only_keeps_parameters_near_their_priors_is_no_name():
    """One channel under a recorded force shows the same of a load cell as of all parameters together."""
    model = held_by_a_spring(mass=0.004, stiffness=0.004, damping=0.004)
    found = investigate(pushed(model, (1.05, 1.05, 1.0)), model, kit.chosen("load_cell"), thorough=False)
    assert found.verdict.kind is VerdictKind.UNEXPLAINED, found.verdict.sentence
    assert found.verdict.effects == ()
    assert "('mass' 11.0, 'stiffness' 1" in found.verdict.sentence
    assert "with one channel, these data cannot distinguish the two" in found.verdict.sentence


def test_a_law_beside_which_something_slow_is_left_is_named_in_part():
    friction = PowerDamping("slide", 0.4, 0.0, 0.0, 1.0, 1.0)
    campaign = replace(pushed(MODEL, (1.01, 0.9), friction, slow=1.0), events=())
    rivals = kit.chosen("coulomb_friction", "quadratic_damping")
    result = investigate(campaign, MODEL, rivals, thorough=False)
    found, closed = result.verdict, result.proof.closed
    assert found.kind is VerdictKind.NAMED_IN_PART, found.sentence
    (effect,) = found.effects
    assert effect.identifier == "coulomb_friction"
    (law,) = effect.patch.primitives
    assert law.coefficient == pytest.approx(0.4, rel=0.1)
    assert 0.8 < closed.low < closed.value < 1.0


def test_friction_that_begins_with_an_event_is_named_with_it(campaign):
    """What cannot be switched, and campaigns without an event to fit, give no such effect."""
    found = investigate(campaign, MODEL, [COULOMB], thorough=False).verdict
    assert found.kind is VerdictKind.NAMED
    (effect,) = found.effects
    assert effect.identifier == "coulomb_friction_during_bolt_loose"
    (law,) = effect.patch.primitives
    assert law.coefficient == pytest.approx(0.4, rel=0.03)
    assert law.windows == (Window("first", 4.137), Window("second", 2.221))
    assert found.sentence.endswith("acts from 4.137 s on in 'first'; from 2.221 s on in 'second'.")
    setting = kit.problem_of(campaign, MODEL).setting
    for events in ((), campaign.events[1:]):
        assert (
            variants_in_events(library(), replace(setting, campaign=replace(campaign, events=events))) == ()
        )
    names = {effect.identifier for effect in variants_in_events(library(), setting)}
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
