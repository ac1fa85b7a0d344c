"""Names on simulated campaigns of the chain: half the time steps, nuisances and parameters drawn."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from discrepancy.campaign.records import NoiseRecord
from discrepancy.errors import SENTENCES
from discrepancy.fits.candidate import Candidate, EffectTerm
from discrepancy.judgement.in_part import not_named_sentence
from discrepancy.judgement.naming import reach_verdict
from discrepancy.judgement.remarks import look_alike_remark, verdict_with_untested_effects
from discrepancy.judgement.rules import VerdictCase
from discrepancy.judgement.simulation_comparison import SimulationComparison
from discrepancy.missing_force.gap_share import OF_READINGS, GapShare
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import NamedEffect, Verdict, VerdictKind
from fe.runtime.patch import ModelPatch, SensorSaturation
from tests.refusals import Inputs

from . import kit

CASES = Inputs(__file__).table("verdicts.toml")
RIVALS = {name: kit.chosen(*effects) for name, effects in CASES["rivals"].items()} | {"all": kit.CATALOGUE}
SLOW = RIVALS["slow"]
"""Where more rivals would only take time."""
HYSTERESIS = tuple(item for item in kit.CATALOGUE if item.family == "rate-independent hysteresis")

SMALL = kit.chain_bench(amplitudes=(0.004, 0.002), samples=150)
"""A short test: three static trials, two releases of small amplitude."""
RIG = kit.chain_bench(samples=300, dynamic_channels=("x3", "g1"), held_out=True)
"""Three releases, one of them held out, and static trials."""


def static(known, **given):
    """Return static trials alone, whose parameters are known."""
    bench = kit.chain_bench(amplitudes=(), gain_deviation=0.0, **given)
    return replace(bench, campaign=replace(bench.campaign, parameters=known))


TIP = static(
    {"stiffness_factor": (1.0, 1e-3), "joint_factor": (1.0, 1e-3), "damping_factor": (1.0, 0.1)},
    static_channels=("x3",),
)
FRICTION = ("coulomb_friction", {"friction_ratio": 0.02}, "joint")
BENCHES = {"small": SMALL, "rig": RIG, "tip": TIP, "laboratory": kit.BENCH}


def coloured(generator, shape, share=0.7, before=200):
    """Return noise of deviation one and a correlation from sample to sample."""
    return np.sqrt(1.0 - share**2) * kit.coloured(generator, (share,), *shape, before=before)


def outliers(generator, shape):
    noise = generator.standard_normal(shape)
    return np.where(generator.random(shape) < 0.01, 15.0 * noise, noise)


def remainder(size, share):
    """Return what draws white noise with a first order process of so many noises in what moves."""

    def draw(generator, shape):
        white = generator.standard_normal(shape)
        return white if shape[0] < 50 else white + size * coloured(generator, shape, share)

    return draw


NOISES = {"coloured": coloured, "outliers": outliers}
NOISES |= {"remainder": remainder(5.0, 0.95), "small remainder": remainder(4.0, 0.9)}


@pytest.mark.parametrize(
    ("case", "seed"),
    [
        pytest.param(case, seed, id=f"{label} {seed}", marks=[pytest.mark.long] * (where == "long"))
        for label, case in CASES["case"].items()
        for where in ("seeds", "long")
        for seed in case.get(where, ())
    ],
)
def test_the_verdict_on_what_is_hidden(case, seed):
    """Right names with intervals that hold the truth, groups where data cannot tell, no wrong name."""
    kinds = tuple(VerdictKind(kind) for kind in case.get("kinds", VerdictKind))
    hidden, names = [], set(case.get("names", ()))
    for values in (dict(CASES["hidden"][label]) for label in case.get("hidden", ())):
        hidden.append((values.pop("effect"), values, values.pop("place", "")))
    bench, rivals = BENCHES[case.get("bench", "small")], RIVALS[case.get("rivals", "most")]
    how = {"noise": NOISES.get(case.get("noise")), "noise_scale": case.get("noise_scale", 1.0)}
    laws = ModelPatch.from_list(case.get("laws", []), "a case")  # that no effect of the catalogue is
    patch = sum((bench.patch(*item) for item in hidden), laws)
    verdict, found, fit = reach_verdict(bench.problem(seed, patch, **how), rivals)
    assert verdict.kind in kinds, verdict.sentence
    wanted = sorted(item[0] for item in hidden)
    if verdict.kind is VerdictKind.NAMED or kinds == (VerdictKind.NAMED_IN_PART,):
        assert sorted(effect.identifier for effect in verdict.effects) == wanted
    if len(laws) and verdict.kind is VerdictKind.FAMILY:
        shape = {item.name: item for effect in verdict.effects for item in effect.shape}["velocity_exponent"]
        assert shape.low < laws.primitives[0].velocity_exponent < shape.high
    if verdict.kind is VerdictKind.GROUP and names:
        assert names <= set(verdict.group)
        assert bench is TIP or names == set(verdict.group)
    if verdict.kind is VerdictKind.UNEXPLAINED:
        assert all(words in verdict.sentence for words in names)
    if kinds == (VerdictKind.NOTHING_MISSING,):
        assert verdict.log_bayes_factor < 3.0
        assert verdict.effects == ()
    if kinds != (VerdictKind.NAMED,):
        return
    assert verdict.probability >= 0.95
    assert all(gate.passed is not False for gate in verdict.gates)
    assert sum(found.set_probabilities().values()) == pytest.approx(1.0)
    assert sorted(fit.candidate.identifiers) == wanted
    # each was tried alone as well: deletion has its comparison
    tried = {item.candidate.identifiers for item in found.compared_fits().values()}
    assert {(identifier,) for identifier in wanted} <= tried
    for effect in verdict.effects:
        ((_, values, place),) = (item for item in hidden if item[0] == effect.identifier)
        assert effect.place == place
        assert_held(effect, values)


@pytest.mark.parametrize("place", ["g1", "all strain"])
def test_a_sensor_that_saturates_is_named_with_its_limit(place):
    """A softening spring, a gain and a mass are beside it; one limit for all strain is not a sum of
    gauges.
    """
    limit, rivals = 2e-4, RIVALS["soft or saturated"]
    channel, quantity = ("*", "strain") if place == "all strain" else (place, "")
    hidden = SensorSaturation(channel, limit, quantity)
    verdict, _, _ = reach_verdict(SMALL.problem(11, ModelPatch((hidden,))), rivals)
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    assert all(gate.passed is not False for gate in verdict.gates)
    (effect,) = verdict.effects
    assert (effect.identifier, effect.place) == ("sensor_saturation", place)
    (primitive,) = effect.patch
    assert (primitive.channel, primitive.quantity) == (channel, quantity)
    (share,) = effect.parameters
    # the limit goes with one over the root of the share; the interval is widened to 99.9 %
    assert abs(np.log(primitive.limit / limit)) <= 0.5 * np.log(share.high / share.low)


def assert_held(effect, values):
    """Intervals of 90 %, widened to 99.9 %: twice as wide."""
    for estimate in effect.parameters:
        truth = values[estimate.name]
        middle, half = 0.5 * (estimate.low + estimate.high), 0.5 * (estimate.high - estimate.low)
        assert abs(truth - middle) <= 2.0 * half + 0.005 * abs(truth), estimate


@pytest.mark.parametrize("slip_ratio", [0.3, 1.5])
def test_a_joint_that_slips_is_named_though_it_has_more_elements(slip_ratio):
    """A joint of 400 elements; with too few of its own the model would take their dents for knowledge."""
    values = {"stiffness_share": 0.3, "slip_ratio": slip_ratio}
    (joint,) = SMALL.patch("joint_micro_slip", values, "joint")
    problem = SMALL.problem(5, ModelPatch((replace(joint, element_count=400),)))
    few = replace(problem.campaign, trials=problem.campaign.trials[1:4])  # loads to both sides, a release
    verdict, _, _ = reach_verdict(kit.problem_of(few, problem.model), HYSTERESIS)
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    (effect,) = verdict.effects
    assert effect.identifier == "joint_micro_slip"
    assert_held(effect, values)


@pytest.mark.parametrize(("gain", "kind"), [(4e-4, VerdictKind.NOTHING_MISSING), (4e-2, VerdictKind.NAMED)])
def test_a_gain_of_half_a_thousandth_is_no_name(gain, kind):
    """Read so finely that it is certain; a gain of four per cent, as certain, is one."""
    bench = static({})
    draw = np.random.default_rng(np.random.SeedSequence(2))  # as `measured` draws the parameters
    known = {
        item.name: (item.mean + item.deviation * float(draw.standard_normal()), 1e-7)
        for item in bench.model.parameters
    }
    channels = {
        key: replace(
            item, noise=NoiseRecord(0.002 * item.noise.standard_deviation, 200.0), offset_deviation=0.0
        )
        for key, item in bench.campaign.channels.items()
    }
    fine = replace(bench, campaign=replace(bench.campaign, channels=channels, parameters=known))
    patch = fine.patch("load_cell", {"gain_error": gain, "tare_ratio": 0.0})
    verdict, found, fit = reach_verdict(fine.problem(2, patch), kit.chosen("load_cell"))
    assert verdict.kind is kind, verdict.sentence
    if kind is VerdictKind.NOTHING_MISSING:
        assert "below 0.1 % of the quantity" in verdict.sentence
        assert verdict.effects == ()
        assert fit is found.no_effect
        assert found.best().candidate.identifiers == ("load_cell",)


def test_without_a_noise_record_the_sentence_says_so():
    """Neither that nothing is missing nor that the name is all can be said of an absolute fit."""
    for effect, noise, kind in (
        (0.0, None, VerdictKind.NOTHING_MISSING),
        (0.4, None, VerdictKind.NAMED),
        (0.4, kit.NOISE, VerdictKind.NAMED),
    ):
        problem = kit.closed_problem(seed=3, effect=effect, noise=noise, offset_deviation=0.0)
        verdict, found, fit = reach_verdict(problem, (kit.offset_effect(),))
        assert verdict.kind is kind, verdict.sentence
        share = SimulationComparison(found).gap_share(fit, held_out=False)
        assert share.value == pytest.approx(float(effect > 0.0), abs=0.01)
        assert ("No noise record" in verdict.sentence) is (noise is None)
    assert "record" not in verdict.sentence


def test_what_all_probable_sets_hold_is_named_and_what_does_not_fit_is_no_part_of_a_group():
    """Which further effect stands beside it stays open; what does not fit alone is not a name so."""
    problem = SMALL.problem(11, SMALL.patch(*FRICTION))
    found = reach_verdict(problem, kit.chosen(FRICTION[0]))[1]
    places = {"coulomb_friction": "joint", "load_cell": "", "gauge_gain": "g1"}
    friction, cell, gain = (EffectTerm(kit.chosen(key)[0], place) for key, place in places.items())
    for terms in ((cell,), (friction, gain), (cell, gain)):
        found.record_fit(kit.fitted(problem, *terms), exact=True)
    right, more = ("coulomb_friction",), Candidate((friction, gain)).identifiers
    outcome = VerdictCase(found, {more: 0.7, right: 0.3}).common_effects_verdict()
    assert outcome[0].kind is VerdictKind.NAMED
    assert [item.identifier for item in outcome[0].effects] == list(right)
    assert outcome[0].probability == pytest.approx(1.0)
    for shares in ({Candidate((cell, gain)).identifiers: 0.6, ("load_cell",): 0.4}, {right: 0.8, (): 0.2}):
        assert VerdictCase(found, shares).common_effects_verdict() is None
    # patch and proof are those of a member that fits, the probability is that of those together
    verdict, _, nearest = VerdictCase(found, {("load_cell",): 0.6, right: 0.38, (): 0.02}).undecided_verdict()
    assert verdict.kind is VerdictKind.GROUP
    assert verdict.group == nearest.candidate.identifiers == right
    assert "cannot tell which" not in verdict.sentence
    assert verdict.probability == pytest.approx(0.38)
    assert verdict.gates[0].passed


def test_the_rules_stand_in_the_page_in_their_order():
    page = (Path(__file__).parents[3] / "docs" / "how_to" / "discrepancy.md").read_text(encoding="utf-8")
    rules = SENTENCES.tables["rule"]
    table = "".join(f"| {rule['verdict']} | {rule['when']} |\n" for rule in rules)
    assert f"| verdict | where |\n| --- | --- |\n{table}\n" in page


# ---------------------------------------------------------------- names in part


@pytest.mark.parametrize(
    ("reason", "sentence"),
    [
        (
            "The residuals follow the loads.",
            "It is not named, because the residuals follow the loads.",
        ),
        (
            "its probability is 0.4: a name needs 0.95",
            "It is not named, because its probability is 0.4: a name needs 0.95.",
        ),
    ],
)
def test_the_reason_why_a_hypothesis_is_not_named_is_one_sentence(reason, sentence):
    assert not_named_sentence(reason) == sentence


@pytest.mark.parametrize("seed", [5, pytest.param(6, marks=pytest.mark.long)])
def test_coloured_noise_with_a_short_record_is_no_gap(seed):
    """Correlation 0.5 from sample to sample, in the trials and in a record of 100 samples."""

    def draw(generator, shape):
        return generator.standard_normal(shape) if shape[0] < 50 else coloured(generator, shape, 0.5, 50)

    problem, records = RIG.problem(seed, noise=draw), {}
    generator = np.random.default_rng(seed)
    for key, channel in problem.campaign.channels.items():
        samples = channel.noise.standard_deviation * draw(generator, (100, 1))[:, 0]
        samples -= samples.mean()
        records[key] = NoiseRecord(float(samples.std()), 99.0, samples, 0.012, "pre-trigger")
    verdict, _, _ = reach_verdict(kit.with_noise(problem, **records), SLOW)
    assert verdict.kind is VerdictKind.NOTHING_MISSING, verdict.sentence


def share_of(after, gap, noise):
    """Return the share that a law is of a gap, by what is left of it, in trials that were held out."""
    return GapShare(noise + gap, after, noise, True, 4, 1.0, 2.0, OF_READINGS, is_tested=True)


def test_shares_and_their_interval():
    """Sums that are known: half of the gap is closed, and the interval holds it; the same blocks always."""
    generator = np.random.default_rng(1)
    noise = np.full(40, 10.0)
    gap = generator.uniform(50.0, 150.0, 40)
    half = share_of(noise + 0.5 * gap * generator.uniform(0.8, 1.2, 40), gap, noise)
    low, high = half.interval
    assert half.value == pytest.approx(0.5, abs=0.05)
    assert low < 0.5 < high
    better = share_of(noise + 0.3 * gap, gap, noise)
    assert better.is_larger_than(half)
    assert not half.is_larger_than(better)
    assert share_of(0.9 * noise, gap, noise).value == 1.0


def test_rivals_are_other_names_each_once_that_are_close_no_longer_and_as_much_of_the_gap():
    """The best name, a law with a shape of its own and a longer set are no rivals, nor what is far off."""
    friction, drag, cubic = (
        EffectTerm(*one)
        for one in zip(kit.chosen(FRICTION[0], "quadratic_damping", "cubic_stiffness"), "aab", strict=True)
    )

    def held(score, share, *terms):
        closed = 10.0 + (1.0 - share) * np.linspace(90.0, 110.0, 40)
        told = share_of(closed, 100.0, np.full(40, 10.0))
        return SimpleNamespace(candidate=Candidate(terms), score=score, told=told)

    best = held(0.0, 0.9, friction)
    second, freed = held(-1.0, 0.9, cubic), held(-2.0, 0.9, replace(cubic, free_shape=True))
    others = (
        held(-1.0, 0.9, replace(friction, free_shape=True)), held(-1.0, 0.9, replace(drag, free_shape=True)),
        held(-1.0, 0.9, drag, cubic), held(-1.0 - SEARCH.force_rival_range, 0.9, drag), held(-1.0, 0.5, drag),
    )  # fmt: skip
    comparison = object.__new__(SimulationComparison)
    comparison.score, comparison.held_out_or_fitted_share = (
        (lambda item: item.score),
        (lambda item: item.told),
    )
    comparison.nameable_hypotheses = [best, second, freed, *others]
    assert comparison.competing_hypotheses(best) == [second]
    comparison.nameable_hypotheses = [best, held(-1.0, 0.9, drag), second]
    assert [item.candidate.terms for item in comparison.competing_hypotheses(best)] == [(drag,), (cubic,)]


# ---------------------------------------------------------------- what a name does not exclude


def verdict_on(*identifiers, kind=VerdictKind.NAMED):
    effects = tuple(
        NamedEffect(item.identifier, item.name, "", item.family, (), (), ModelPatch())
        for item in kit.chosen(*identifiers)
    )
    return Verdict(kind, "-", 0.99, 20.0, effects=effects)


def test_only_names_are_remarked_on_and_likeness_counts_both_ways():
    for kind in VerdictKind:
        assert bool(look_alike_remark(verdict_on("load_cell", kind=kind), kit.CATALOGUE)) is (
            kind is VerdictKind.NAMED
        )
    for effect in kit.CATALOGUE:
        for other in effect.confusable:
            assert effect.identifier in look_alike_remark(verdict_on(other), kit.CATALOGUE)
    whole = look_alike_remark(verdict_on("inertia_relief"), kit.CATALOGUE)
    assert "washout" in whole
    assert "not compared" not in whole
    rest = [effect for effect in kit.CATALOGUE if effect.identifier != "washout"]
    assert "washout was not compared" in look_alike_remark(verdict_on("inertia_relief"), rest)
    # members of a set are no likenesses of each other
    both = look_alike_remark(verdict_on("inertia_relief", "washout"), kit.CATALOGUE)
    assert " do together, within the noise" in both
    assert not {"washout", "inertia_relief"} & set(both.split("look similar,")[1].replace(",", " ").split())


def test_a_group_says_last_what_these_trials_cannot_test():
    setting = kit.chain_bench(amplitudes=()).setting
    group = replace(verdict_on("gauge_gain", kind=VerdictKind.GROUP), sentence="Either is missing.")
    sentence = verdict_with_untested_effects(group, setting, kit.CATALOGUE).sentence
    assert sentence.startswith("Either is missing. ")
    told = {effect.name for effect in kit.CATALOGUE if effect.name in sentence}
    # what is easily taken for it comes first
    alike = (
        "stiffness loss outside the modelled regions",
        "stiffness loss of a damage region",
        "misalignment of a gauge",
    )
    places = [sentence.index(name) for name in (*alike, "17 more")]
    assert places == sorted(places)
    assert not {effect.name for effect in kit.CATALOGUE if effect.unavailable(setting) is None} & told
    single = verdict_on("load_cell")
    assert verdict_with_untested_effects(single, setting, kit.CATALOGUE) is single
