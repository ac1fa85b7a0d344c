"""Names on simulated campaigns of the chain: half the time steps, nuisances and parameters drawn."""

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from discrepancy.campaign.records import NoiseRecord
from discrepancy.errors import SENTENCES
from discrepancy.fits.candidate import Candidate, EffectTerm
from discrepancy.fits.fitting import fit_free_shape
from discrepancy.judgement.decide import comparison_of, reach_verdict
from discrepancy.judgement.noise_case import NoiseCase
from discrepancy.judgement.noise_verdict import (
    common_effects_verdict,
    common_family_verdict,
    undecided_verdict,
)
from discrepancy.judgement.remainder_verdict import not_named_sentence
from discrepancy.judgement.remarks import look_alike_remark, verdict_with_untested_effects
from discrepancy.judgement.simulation_comparison import SimulationComparison
from discrepancy.missing_force.gap_share import OF_READINGS, GapShare
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import NamedEffect, Verdict, VerdictKind
from fe.runtime.patch import ModelPatch, SensorSaturation
from tests.costs import once
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


@dataclass(frozen=True)
class HiddenEffect:
    """An effect of the catalogue that a case hides: identifier, values by name, place."""

    identifier: str
    values: dict[str, float]
    place: str


@dataclass(frozen=True)
class NamedCase:
    """A case of `verdicts.toml`, and what the search concludes of the campaign that it simulates."""

    bench: kit.Bench
    hidden: tuple[HiddenEffect, ...]
    laws: ModelPatch
    words: frozenset[str]
    """Names of the group, or words of the conclusion and its reasons, that the case asks for."""
    verdict: Verdict
    set_probabilities: dict[tuple[str, ...], float]
    fitted_effects: tuple[str, ...]

    @property
    def hidden_identifiers(self):
        """Identifiers of what is hidden, sorted."""
        return sorted(effect.identifier for effect in self.hidden)

    @property
    def named_identifiers(self):
        """Identifiers of what the verdict names, sorted."""
        return sorted(effect.identifier for effect in self.verdict.effects)


def right_kinds(label):
    """Return the kinds of verdict that are right for a case."""
    return tuple(VerdictKind(kind) for kind in CASES["case"][label].get("kinds", VerdictKind))


def hidden_effect(label):
    values = dict(CASES["hidden"][label])
    identifier = values.pop("effect")
    place = values.pop("place", "")
    return HiddenEffect(identifier, values, place)


@once
def concluded(label, seed):
    """Return a case with its verdict; a search takes seconds, and each case is tested for several things."""
    case = CASES["case"][label]
    bench = BENCHES[case.get("bench", "small")]
    rivals = RIVALS[case.get("rivals", "most")]
    hidden = tuple(hidden_effect(name) for name in case.get("hidden", ()))
    laws = ModelPatch.from_list(case.get("laws", []), "a case")  # that no effect of the catalogue is
    patch = laws
    for effect in hidden:
        patch = patch + bench.patch(effect.identifier, effect.values, effect.place)
    problem = bench.problem(
        seed, patch, noise=NOISES.get(case.get("noise")), noise_scale=case.get("noise_scale", 1.0)
    )
    verdict, search, fit = reach_verdict(problem, rivals)
    return NamedCase(
        bench=bench,
        hidden=hidden,
        laws=laws,
        words=frozenset(case.get("names", ())),
        verdict=verdict,
        set_probabilities=comparison_of(search).set_probabilities(),
        fitted_effects=fit.candidate.identifiers,
    )


def each_case(applies):
    """Return a mark that runs a test for the label and seed of each case to which it applies."""
    rows = []
    for label, case in CASES["case"].items():
        if not applies(label):
            continue
        rows += [pytest.param(label, seed, id=f"{label} {seed}") for seed in case.get("seeds", ())]
        rows += [
            pytest.param(label, seed, id=f"{label} {seed}", marks=pytest.mark.long)
            for seed in case.get("long", ())
        ]
    return pytest.mark.parametrize(("label", "seed"), rows)


def may_be(kind):
    """Return whether a verdict of a kind is among the right ones, as a function of a case."""
    return lambda label: kind in right_kinds(label)


def must_be(*kinds):
    """Return whether a verdict of one of these kinds alone is right, as a function of a case."""
    return lambda label: len(right_kinds(label)) == 1 and right_kinds(label)[0] in kinds


@each_case(lambda label: True)
def test_the_verdict_is_of_a_kind_that_the_data_support(label, seed):
    verdict = concluded(label, seed).verdict
    assert verdict.kind in right_kinds(label), verdict.sentence


@each_case(lambda label: may_be(VerdictKind.NAMED)(label) or must_be(VerdictKind.NAMED_IN_PART)(label))
def test_no_other_name_is_given_than_that_of_what_is_hidden(label, seed):
    case = concluded(label, seed)
    is_named = case.verdict.kind in (VerdictKind.NAMED, VerdictKind.NAMED_IN_PART)
    assert case.named_identifiers == case.hidden_identifiers or not is_named


@each_case(lambda label: "laws" in CASES["case"][label] and may_be(VerdictKind.FAMILY)(label))
def test_the_interval_of_a_shape_holds_the_exponent_of_the_hidden_law(label, seed):
    case = concluded(label, seed)
    shape = {estimate.name: estimate for effect in case.verdict.effects for estimate in effect.shape}
    exponent = shape["velocity_exponent"]
    assert exponent.low < case.laws.primitives[0].velocity_exponent < exponent.high


@each_case(must_be(VerdictKind.GROUP))
def test_a_group_has_the_effects_that_the_data_cannot_distinguish(label, seed):
    """Beside the tip's deflection alone, further effects are in the group."""
    case = concluded(label, seed)
    group = set(case.verdict.group)
    assert case.words <= group
    assert case.bench is TIP or case.words == group


@each_case(must_be(VerdictKind.UNEXPLAINED))
def test_an_unexplained_gap_has_its_reason(label, seed):
    case = concluded(label, seed)
    assert all(words in case.verdict.text for words in case.words)


@each_case(must_be(VerdictKind.NOTHING_MISSING))
def test_where_nothing_is_missing_no_effect_is_more_probable(label, seed):
    verdict = concluded(label, seed).verdict
    assert verdict.log_bayes_factor < 3.0
    assert verdict.effects == ()


@each_case(must_be(VerdictKind.NAMED))
def test_a_name_is_probable_and_passes_all_gates(label, seed):
    case = concluded(label, seed)
    assert case.verdict.probability >= 0.95
    assert all(gate.passed is not False for gate in case.verdict.gates)
    assert sum(case.set_probabilities.values()) == pytest.approx(1.0)


@each_case(must_be(VerdictKind.NAMED))
def test_what_is_named_is_what_was_fitted(label, seed):
    case = concluded(label, seed)
    assert sorted(case.fitted_effects) == case.hidden_identifiers


@each_case(must_be(VerdictKind.NAMED))
def test_each_named_effect_was_tried_alone_as_well(label, seed):
    """So that the deletion of each from the set has its comparison."""
    case = concluded(label, seed)
    assert {(identifier,) for identifier in case.hidden_identifiers} <= case.set_probabilities.keys()


@each_case(must_be(VerdictKind.NAMED))
def test_a_named_effect_has_its_place_and_its_values_within_the_intervals(label, seed):
    case = concluded(label, seed)
    hidden = {effect.identifier: effect for effect in case.hidden}
    for effect in case.verdict.effects:
        assert effect.place == hidden[effect.identifier].place
        assert_intervals_hold(effect, hidden[effect.identifier].values)


SATURATION_LIMIT = 2e-4
SATURATED = {"g1": ("g1", ""), "all strain": ("*", "strain")}
"""Channel and quantity of the hidden limit, by the place that is to be named."""


@once
def verdict_on_saturation(place):
    """Return the verdict beside a softening spring, a gain and a mass."""
    channel, quantity = SATURATED[place]
    hidden = ModelPatch((SensorSaturation(channel, SATURATION_LIMIT, quantity),))
    verdict, _, _ = reach_verdict(SMALL.problem(11, hidden), RIVALS["soft or saturated"])
    return verdict


@pytest.mark.parametrize("place", SATURATED)
def test_a_sensor_that_saturates_is_named(place):
    verdict = verdict_on_saturation(place)
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    assert [(effect.identifier, effect.place) for effect in verdict.effects] == [("sensor_saturation", place)]
    assert all(gate.passed is not False for gate in verdict.gates)


@pytest.mark.parametrize("place", SATURATED)
def test_the_limit_of_a_sensor_that_saturates_is_estimated(place):
    """One limit for all strain is not a sum of gauges."""
    (effect,) = verdict_on_saturation(place).effects
    (primitive,) = effect.patch
    (share,) = effect.parameters
    # the limit goes with one over the root of the share; the interval is widened to 99.9 %
    largest_error = 0.5 * np.log(share.high / share.low)
    assert (primitive.channel, primitive.quantity) == SATURATED[place]
    assert abs(np.log(primitive.limit / SATURATION_LIMIT)) <= largest_error


def assert_intervals_hold(effect, values):
    """Intervals of 90 %, widened to 99.9 %: twice as wide."""
    for estimate in effect.parameters:
        truth = values[estimate.name]
        middle = 0.5 * (estimate.low + estimate.high)
        half_width = 0.5 * (estimate.high - estimate.low)
        assert abs(truth - middle) <= 2.0 * half_width + 0.005 * abs(truth), estimate


@pytest.mark.parametrize("slip_ratio", [0.3, pytest.param(1.5, marks=pytest.mark.long)])
def test_a_joint_that_slips_is_named_though_it_has_more_elements(slip_ratio):
    """A joint of 400 elements; with too few of its own the model would take their dents for knowledge."""
    values = {"stiffness_share": 0.3, "slip_ratio": slip_ratio}
    (joint,) = SMALL.patch("joint_micro_slip", values, "joint")
    problem = SMALL.problem(5, ModelPatch((replace(joint, element_count=400),)))
    few_trials = problem.campaign.trials[1:4]  # loads to both sides, a release
    few = replace(problem.campaign, trials=few_trials)
    verdict, _, _ = reach_verdict(kit.problem_of(few, problem.model), HYSTERESIS)
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    (effect,) = verdict.effects
    assert effect.identifier == "joint_micro_slip"
    assert_intervals_hold(effect, values)


@once
def finely_read():
    """Return static trials read so finely that every gain is certain, with parameters that are known."""
    bench = static({})
    draw = np.random.default_rng(np.random.SeedSequence(2))  # as `measured` draws the parameters
    known = {}
    for parameter in bench.model.parameters:
        value = parameter.mean + parameter.deviation * float(draw.standard_normal())
        known[parameter.name] = (value, 1e-7)
    channels = {}
    for name, channel in bench.campaign.channels.items():
        noise = NoiseRecord(0.002 * channel.noise.standard_deviation, 200.0)
        channels[name] = replace(channel, noise=noise, offset_deviation=0.0)
    return replace(bench, campaign=replace(bench.campaign, channels=channels, parameters=known))


@once
def conclusion_on_a_gain(gain_error):
    """Return verdict, search and fit of a load cell with a gain error."""
    bench = finely_read()
    patch = bench.patch("load_cell", {"gain_error": gain_error, "tare_ratio": 0.0})
    return reach_verdict(bench.problem(2, patch), kit.chosen("load_cell"))


SMALL_GAIN, LARGE_GAIN = 4e-4, 4e-2


def test_a_gain_of_four_per_cent_is_a_name():
    verdict, _, _ = conclusion_on_a_gain(LARGE_GAIN)
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence


def test_a_gain_of_half_a_thousandth_is_no_name():
    """It is as certain as one of four per cent."""
    verdict, _, _ = conclusion_on_a_gain(SMALL_GAIN)
    assert verdict.kind is VerdictKind.NOTHING_MISSING, verdict.sentence
    assert "below 0.1 % of the quantity" in verdict.sentence
    assert verdict.effects == ()


def test_where_a_gain_is_no_name_the_model_stays_though_the_gain_fits_best():
    _, search, fit = conclusion_on_a_gain(SMALL_GAIN)
    assert fit is search.no_effect
    assert search.best().candidate.identifiers == ("load_cell",)


CLOSED_FORM_CASES = [
    pytest.param(0.0, None, VerdictKind.NOTHING_MISSING, id="nothing hidden, no noise record"),
    pytest.param(0.4, None, VerdictKind.NAMED, id="offset, no noise record"),
    pytest.param(0.4, kit.NOISE, VerdictKind.NAMED, id="offset, noise record"),
]


@once
def conclusion_on_an_offset(offset, noise):
    """Return verdict, search and fit of the closed form with an offset."""
    problem = kit.closed_problem(seed=3, effect=offset, noise=noise, offset_deviation=0.0)
    return reach_verdict(problem, (kit.offset_effect(),))


@pytest.mark.parametrize(("offset", "noise", "kind"), CLOSED_FORM_CASES)
def test_without_a_noise_record_the_sentence_says_so(offset, noise, kind):
    """Neither that nothing is missing nor that the name is all can be said of an absolute fit."""
    verdict, _, _ = conclusion_on_an_offset(offset, noise)
    assert verdict.kind is kind, verdict.sentence
    assert ("No noise record" in verdict.text) is (noise is None)
    assert ("record" in verdict.text) is (noise is None)


@pytest.mark.parametrize(("offset", "noise", "kind"), CLOSED_FORM_CASES)
def test_an_offset_is_all_of_the_gap_with_and_without_a_noise_record(offset, noise, kind):
    _, search, fit = conclusion_on_an_offset(offset, noise)
    share = SimulationComparison(search).gap_share(fit, held_out=False)
    assert share.value == pytest.approx(float(offset > 0.0), abs=0.01)


# ---------------------------------------------------------------- sets that data cannot tell apart

FRICTION_ALONE = ("coulomb_friction",)


@pytest.fixture(scope="module")
def terms():
    """Friction, which is hidden, and two effects of sensors."""
    places = {"coulomb_friction": "joint", "load_cell": "", "gauge_gain": "g1"}
    return {key: EffectTerm(kit.chosen(key)[0], place) for key, place in places.items()}


@pytest.fixture(scope="module")
def friction_search(terms):
    """A search for hidden friction, in which sets with the two other effects were fitted as well."""
    problem = SMALL.problem(11, SMALL.patch(*FRICTION))
    _, search, _ = reach_verdict(problem, kit.chosen("coulomb_friction"))
    for names in (("load_cell",), ("coulomb_friction", "gauge_gain"), ("load_cell", "gauge_gain")):
        search.record_fit(kit.fitted(problem, *(terms[name] for name in names)), exact=True)
    return search


def case_of(search, probabilities):
    """Return the fits of a search with given probabilities of their sets."""
    return NoiseCase(SimulationComparison(search), probabilities)


def identifiers(terms, *names):
    """Return the identifiers of a set of terms, in the order of a candidate."""
    return Candidate(tuple(terms[name] for name in names)).identifiers


def test_what_all_probable_sets_hold_is_named(friction_search, terms):
    """Which further effect stands beside it stays open."""
    with_a_gain = identifiers(terms, "coulomb_friction", "gauge_gain")
    outcome = common_effects_verdict(case_of(friction_search, {with_a_gain: 0.7, FRICTION_ALONE: 0.3}))
    verdict = outcome[0]
    assert verdict.kind is VerdictKind.NAMED
    assert [effect.identifier for effect in verdict.effects] == list(FRICTION_ALONE)
    assert verdict.probability == pytest.approx(1.0)


def test_what_does_not_fit_alone_is_not_named_though_all_probable_sets_hold_it(friction_search, terms):
    cell_and_gain = identifiers(terms, "load_cell", "gauge_gain")
    probabilities = {cell_and_gain: 0.6, ("load_cell",): 0.4}
    assert common_effects_verdict(case_of(friction_search, probabilities)) is None


def test_a_law_of_free_shape_beside_another_effect_is_no_rival_of_a_name(friction_search, terms):
    """Together they can imitate nearly anything."""
    free = replace(terms["coulomb_friction"], free_shape=True)
    fit = friction_search.record_fit(
        kit.fitted(friction_search.problem, free, terms["gauge_gain"]), exact=True
    )
    probabilities = SimulationComparison(friction_search).set_probabilities()
    del friction_search.exact_fits[fit.candidate.key]
    assert fit.candidate.identifiers not in probabilities
    assert FRICTION_ALONE in probabilities


def test_a_law_and_a_free_shape_of_its_family_are_the_family(friction_search):
    """Damping by a free power of the speed contains quadratic damping: they are no two explanations."""
    problem = friction_search.problem
    damping = EffectTerm(kit.chosen("quadratic_damping")[0], "joint")
    friction_fit = SimulationComparison(friction_search).best_of_set(FRICTION_ALONE)
    free_fit = fit_free_shape(problem, friction_fit, 0)
    fits = [friction_search.record_fit(fit, exact=True) for fit in (kit.fitted(problem, damping), free_fit)]
    damping_alone, family = (fit.candidate.identifiers for fit in fits)
    named = common_family_verdict(case_of(friction_search, {damping_alone: 0.5, family: 0.5}))
    beside_a_cell = common_family_verdict(case_of(friction_search, {("load_cell",): 0.5, family: 0.5}))
    for fit in fits:
        del friction_search.exact_fits[fit.candidate.key]
    assert named.verdict.kind is VerdictKind.FAMILY
    assert named.verdict.family == damping.effect.family
    assert "at joint needs no fitted exponent" in named.verdict.reasons
    assert beside_a_cell is None


def test_nothing_is_named_where_the_model_without_effects_is_probable(friction_search):
    assert common_effects_verdict(case_of(friction_search, {FRICTION_ALONE: 0.8, (): 0.2})) is None


@pytest.fixture(scope="module")
def undecided(friction_search):
    """Verdict, search and nearest fit where most of the probability is that of a set that does not fit."""
    probabilities = {("load_cell",): 0.6, FRICTION_ALONE: 0.38, (): 0.02}
    return undecided_verdict(case_of(friction_search, probabilities))


def test_what_does_not_fit_is_no_part_of_a_group(undecided):
    verdict, _, nearest = undecided
    assert verdict.kind is VerdictKind.GROUP
    assert verdict.group == nearest.candidate.identifiers == FRICTION_ALONE
    assert "cannot tell which" not in verdict.sentence


def test_patch_and_proof_of_a_group_are_those_of_a_member_that_fits(undecided):
    """The probability is that of all members together."""
    verdict, _, _ = undecided
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


NOISE_SUMS = np.full(40, 10.0)
"""Sums of squares of the noise, by block."""


@pytest.fixture
def gap_sums():
    """Sums of squares of a gap, by block, and the share of it that closes half of it, which is not exact."""
    generator = np.random.default_rng(1)
    gap = generator.uniform(50.0, 150.0, 40)
    remaining = 0.5 * gap * generator.uniform(0.8, 1.2, 40)
    return gap, share_of(NOISE_SUMS + remaining, gap, NOISE_SUMS)


def test_half_of_a_gap_is_a_share_of_a_half_within_its_interval(gap_sums):
    _, half = gap_sums
    low, high = half.interval
    assert half.value == pytest.approx(0.5, abs=0.05)
    assert low < 0.5 < high


def test_a_share_is_larger_where_more_of_the_same_gap_is_closed(gap_sums):
    gap, half = gap_sums
    better = share_of(NOISE_SUMS + 0.3 * gap, gap, NOISE_SUMS)
    assert better.is_larger_than(half)
    assert not half.is_larger_than(better)


def test_the_share_of_a_law_that_leaves_less_than_the_noise_is_one(gap_sums):
    gap, _ = gap_sums
    assert share_of(0.9 * NOISE_SUMS, gap, NOISE_SUMS).value == 1.0


def law(identifier, port, *, free_shape=False):
    return EffectTerm(kit.chosen(identifier)[0], port, free_shape=free_shape)


BEST_LAW, DRAG, CUBIC = (
    law("coulomb_friction", "a"),
    law("quadratic_damping", "a"),
    law("cubic_stiffness", "b"),
)


def hypothesis(score, share, *terms):
    """Return a hypothesis that closes a share of a gap of 100."""
    remaining = 10.0 + (1.0 - share) * np.linspace(90.0, 110.0, 40)
    return SimpleNamespace(
        candidate=Candidate(terms), score=score, share=share_of(remaining, 100.0, NOISE_SUMS)
    )


def competing(*hypotheses):
    """Return which of several hypotheses compete with the first one."""
    comparison = object.__new__(SimulationComparison)
    comparison.score = lambda item: item.score
    comparison.held_out_or_fitted_share = lambda item: item.share
    comparison.nameable_hypotheses = list(hypotheses)
    return comparison.competing_hypotheses(hypotheses[0])


def test_rivals_are_other_names_each_once_that_are_close_no_longer_and_as_much_of_the_gap():
    """The best name, a law with a shape of its own and a longer set are no rivals, nor what is far off."""
    best = hypothesis(0.0, 0.9, BEST_LAW)
    second = hypothesis(-1.0, 0.9, CUBIC)
    second_with_a_shape = hypothesis(-2.0, 0.9, law("cubic_stiffness", "b", free_shape=True))
    no_rivals = (
        hypothesis(-1.0, 0.9, law("coulomb_friction", "a", free_shape=True)),
        hypothesis(-1.0, 0.9, law("quadratic_damping", "a", free_shape=True)),
        hypothesis(-1.0, 0.9, DRAG, CUBIC),
        hypothesis(-1.0 - SEARCH.force_rival_range, 0.9, DRAG),
        hypothesis(-1.0, 0.5, DRAG),
    )
    assert competing(best, second, second_with_a_shape, *no_rivals) == [second]


def test_all_names_that_are_as_close_are_rivals():
    rivals = competing(
        hypothesis(0.0, 0.9, BEST_LAW), hypothesis(-1.0, 0.9, DRAG), hypothesis(-1.0, 0.9, CUBIC)
    )
    assert [rival.candidate.terms for rival in rivals] == [(DRAG,), (CUBIC,)]


# ---------------------------------------------------------------- what a name does not exclude


def verdict_on(*identifiers, kind=VerdictKind.NAMED):
    effects = tuple(
        NamedEffect(item.identifier, item.name, "", item.family, (), (), ModelPatch())
        for item in kit.chosen(*identifiers)
    )
    return Verdict(kind, "-", 0.99, 20.0, effects=effects)


def look_alikes_of(*identifiers, compared=kit.CATALOGUE):
    """Return the remark on what looks like the named effects."""
    return look_alike_remark(verdict_on(*identifiers), compared)


@pytest.mark.parametrize("kind", VerdictKind)
def test_only_names_are_remarked_on(kind):
    remark = look_alike_remark(verdict_on("load_cell", kind=kind), kit.CATALOGUE)
    assert bool(remark) is (kind is VerdictKind.NAMED)


def test_likeness_counts_both_ways():
    for effect in kit.CATALOGUE:
        for other in effect.confusable:
            assert effect.name in look_alikes_of(other)


def test_members_of_a_set_are_no_look_alikes_of_each_other():
    remark = look_alikes_of("inertia_relief", "washout")
    look_alikes = remark.split("look similar,")[1]
    assert " do together, within the noise" in remark
    assert not any(effect.name in look_alikes for effect in kit.chosen("washout", "inertia_relief"))


STATIC_SETTING = kit.chain_bench(amplitudes=()).setting
"""Static trials alone, which cannot test most effects."""


@pytest.mark.parametrize("kind", [VerdictKind.NAMED, VerdictKind.GROUP])
def test_a_verdict_says_last_which_look_alikes_cannot_be_tested(kind):
    verdict = replace(verdict_on("gauge_gain", kind=kind), sentence="A gain is wrong.")
    untested = kit.chosen(
        "local_stiffness_loss", "region_stiffness_loss", "gauge_misalignment", "gauge_offset"
    )
    *others, last = [effect.name for effect in untested]
    told = f"Not excluded, because they cannot be tested here: {', '.join(others)} and {last}."
    sentence = verdict_with_untested_effects(verdict, STATIC_SETTING, kit.CATALOGUE).text
    assert sentence == f"A gain is wrong. {told}"


def test_what_can_be_tested_was_compared():
    named = verdict_on("sensor_saturation")
    (cubic,) = kit.chosen("cubic_stiffness")
    assert "cubic_stiffness" in kit.chosen("sensor_saturation")[0].confusable
    assert cubic.unavailable(STATIC_SETTING) is None
    sentence = verdict_with_untested_effects(named, STATIC_SETTING, kit.CATALOGUE).text
    assert cubic.name not in sentence


def test_an_effect_that_does_not_act_on_these_trials_is_not_mentioned():
    """`Washout` looks like a saturated sensor, but acts in flight alone."""
    named = verdict_on("sensor_saturation")
    sentence = verdict_with_untested_effects(named, STATIC_SETTING, kit.CATALOGUE).text
    assert "washout" in kit.chosen("sensor_saturation")[0].confusable
    assert "washout" not in sentence


def test_an_unexplained_gap_mentions_no_look_alike():
    open_verdict = verdict_on("gauge_gain", kind=VerdictKind.UNEXPLAINED)
    assert verdict_with_untested_effects(open_verdict, STATIC_SETTING, kit.CATALOGUE) is open_verdict
