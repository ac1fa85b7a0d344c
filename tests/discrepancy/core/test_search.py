"""The search on what has many optima or places, and what a group needs."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import ndtr

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Start, Trial, TrialKind
from discrepancy.fits.candidate import Candidate, EffectTerm, Point
from discrepancy.fits.gates import whiteness_tests
from discrepancy.judgement import remainder_verdict
from discrepancy.search.other_optima import points_at_other_stretches
from discrepancy.search.strategy import Search
from discrepancy.system.response import Conditions
from discrepancy.system.sensing import observe
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from fe.runtime.patch import Clock, ModelPatch, PowerDamping, Window
from tests.discrepancy.rigs import one_mass

from . import kit

DAMPERS = kit.chosen("coulomb_friction", "quadratic_damping", "structural_damping")
NOISE = 2e-5
FRICTION = 0.216
MASS, STIFFNESS, RATIO = 2.0, 410.0, 0.006
UNCERTAIN = [
    {"name": "stiffness", "terms": "stiffness", "deviation": 0.02, "low": 0.5, "high": 2.0},
    {"name": "damping", "terms": "damping", "deviation": 0.15, "low": 0.1, "high": 5.0},
]


def ended_by_friction(time, displacement, stiffness, damping):
    """Return the motion of a mass that dry friction ends: half swings about centres off by F / k."""
    decay = damping / (2.0 * MASS)
    turning = np.sqrt(stiffness / MASS - decay**2)
    half = np.pi / turning
    motion, begin = np.full(len(time), displacement), 0.0
    while abs(stiffness * displacement) > FRICTION:
        centre = np.sign(displacement) * FRICTION / stiffness
        amplitude = displacement - centre
        since = time - begin
        wave = np.cos(turning * since) + decay / turning * np.sin(turning * since)
        moving = since >= 0.0
        motion[moving] = (centre + amplitude * np.exp(-decay * since) * wave)[moving]
        displacement = centre - amplitude * np.exp(-decay * half)
        begin += half
        motion[time >= begin] = displacement
    return motion


def releases(seed, first_stamp=0.0, at_rest=True):
    """Return two releases of the mass, one held out, and its model."""
    rng, time = np.random.default_rng(seed), 0.01 * np.arange(600)
    stiffness = STIFFNESS * (1.0 + 0.014 * rng.standard_normal())
    damping = 2.0 * RATIO * np.sqrt(STIFFNESS * MASS) * (1.0 + 0.1 * rng.standard_normal())
    trials = []
    for name, size in (("first", 0.012), ("second", 0.010)):
        motion = ended_by_friction(time, size * (1.0 + 0.02 * rng.standard_normal()), stiffness, damping)
        values = (motion + NOISE * rng.standard_normal(len(time)))[:, np.newaxis]
        given = {"values": values, "release": Release(size, 0.05, at_rest, 1), "held_out": name == "second"}
        trials.append(Trial.plain(name, TrialKind.RINGDOWN, ("x",), first_stamp + time, **given))
    channels = {"x": Channel("x", Quantity.DISPLACEMENT, "x", NoiseRecord(NOISE, 500.0))}
    model = one_mass(stiffness=STIFFNESS, damping={"ratios": [RATIO]}, parameter=UNCERTAIN)
    return Campaign("releases", channels, tuple(trials), None, {}, "0" * 64), model


@pytest.mark.parametrize(
    "seed", [1, pytest.param(2, marks=pytest.mark.long), pytest.param(3, marks=pytest.mark.long)]
)
def test_friction_that_ends_a_motion_is_named_in_its_size(seed):
    """Each number of half swings is an optimum of its own, in fitted trials and in those held out."""
    verdict = investigate(*releases(seed), DAMPERS, thorough=False).verdict
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    (effect,) = verdict.effects
    assert effect.identifier == "coulomb_friction"
    (law,) = effect.patch.primitives
    assert law.coefficient == pytest.approx(FRICTION, rel=0.01)


# ---------------------------------------------------------------- clocks far from zero


EPOCH = 1.7e9


def test_a_release_on_an_epoch_clock_is_named_as_on_its_own():
    """Stamps of another clock count from the first sample: models begin there."""
    verdict = investigate(*releases(1, EPOCH, at_rest=False), DAMPERS, thorough=False).verdict
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    (law,) = verdict.effects[0].patch.primitives
    assert law.coefficient == pytest.approx(FRICTION, rel=0.01)


@pytest.mark.parametrize(
    "items", [(), (Clock(1e-3, 0.0),), (PowerDamping("slide", 0.4, 0.0, 0.0, 1.0, 1.0),)]
)
def test_what_a_model_shows_does_not_depend_on_where_its_clock_begins(items):
    """Windows are in the clock of the trial; a rate of the clock is right at its first stamp."""
    time = 0.01 * np.arange(200)
    model = one_mass(stiffness=STIFFNESS, damping={"ratios": [RATIO]})
    channels = {"x": Channel("x", Quantity.DISPLACEMENT, "x", NoiseRecord(NOISE, 500.0))}
    given = {"load_place": "push", "begins": Start.STILL, "force": np.sin(5.0 * time)}
    shown = []
    for first in (0.0, 2.0**20):
        windows = (Window("pushed", first + 0.5, first + 1.2),)
        timed = [replace(item, windows=windows) if isinstance(item, PowerDamping) else item for item in items]
        trial = Trial.plain("pushed", TrialKind.FORCED, ("x",), first + time, **given)
        campaign = Campaign("clocks", channels, (trial,), None, {}, "0" * 64)
        patch = ModelPatch(tuple(timed))
        shown.append(observe(model, campaign, trial, patch, Conditions(np.array([]))).values)
    np.testing.assert_allclose(shown[1], shown[0], atol=1e-9 * np.ptp(shown[0]))


# ---------------------------------------------------------------- places


def test_an_effect_of_a_set_that_fails_is_tried_at_its_other_places():
    """Rough fits may have kept the wrong storey."""
    bench = kit.chain_bench(amplitudes=(0.004, 0.002), samples=150)
    hidden = bench.patch("coulomb_friction", {"friction_ratio": 0.02}, "joint")
    hidden = hidden + bench.patch("gauge_gain", {"gain_error": 0.05}, "g1")
    problem = bench.problem(11, hidden)
    friction, gain = kit.chosen("coulomb_friction", "gauge_gain")
    wrong = kit.fitted(problem, EffectTerm(friction, "end"), EffectTerm(gain, "g1"))
    search = Search(problem, (friction, gain), kit.fitted(problem))
    search.record_fit(wrong, exact=True)
    assert search.best() is wrong
    search.move_effects()
    assert set(search.best().candidate.key) == {("coulomb_friction", "joint"), ("gauge_gain", "g1")}


# ---------------------------------------------------------------- stretches of a structure


def fit_of(identifier, effect):
    """Return the part of a fit that other starting points need."""
    candidate = Candidate((EffectTerm(*kit.chosen(identifier), ""),))
    return SimpleNamespace(candidate=candidate, effect=effect, point=Point(np.zeros(0), (), effect))


def test_each_end_of_a_stretch_is_moved_by_half_a_level_of_its_prior():
    found = np.array([0.2, -0.5, -0.9])  # loss, begin and length
    points = points_at_other_stretches(fit_of("local_stiffness_loss", found))
    moves = np.array([ndtr(point.effect) - ndtr(found) for point in points])
    begin, length = 0.5 / 14, 0.5 / 3
    expected = [[0, -begin, 0], [0, begin, 0], [0, 0, 0.02 - ndtr(-0.9)], [0, 0, length]]
    np.testing.assert_allclose(moves, expected, atol=1e-12)


def test_an_effect_at_one_place_has_no_other_stretches():
    assert points_at_other_stretches(fit_of("point_mass", np.array([0.2, -0.5]))) == []


# ---------------------------------------------------------------- groups


class TwoRivals:
    """Two hypotheses that no data tell apart, as `remainder_verdict` asks for them."""

    def __init__(self, probability, gain, fits):
        self.problem, self.chance, self.fits = None, probability, fits
        self.nameable_hypotheses = [
            SimpleNamespace(log_evidence=gain, candidate=Candidate()) for _ in range(2)
        ]
        self.no_effect = SimpleNamespace(log_evidence=0.0)

    def simplest_equivalent_hypothesis(self, best):
        return best

    def enlarges_error(self, best):
        return False

    def competing_hypotheses(self, best):
        return self.nameable_hypotheses[1:]

    def probability(self, *items):
        return self.chance

    def absolute_fit(self, item):
        return SimpleNamespace(has_failed=not self.fits)

    def reason_of_remaining_error(self, item):
        return ""

    def is_proved_curve(self, item):
        return False


@pytest.mark.parametrize(
    ("probability", "gain", "fits", "kind"),
    [
        (0.97, 20.0, True, "group"), (2.3e-6, 20.0, True, "unexplained"),
        (0.97, -11.0, True, "unexplained"), (0.97, 20.0, False, "unexplained"),
    ],
)  # fmt: skip
def test_a_group_needs_probability_evidence_and_members_that_fit(monkeypatch, probability, gain, fits, kind):
    monkeypatch.setattr(remainder_verdict, "_group_outcome", lambda *given: "group")
    monkeypatch.setattr(remainder_verdict, "unexplained_outcome", lambda *given: "unexplained")
    monkeypatch.setattr(remainder_verdict, "named_effects", lambda *given: ())
    assert remainder_verdict.decide_on_remainder(TwoRivals(probability, gain, fits), None) == kind


@pytest.mark.parametrize(
    ("probability", "gain", "reason"),
    [(0.5, 20.0, ""), (0.99, 1.5, "explains the readings as well (ln Bayes factor 1.5; a name needs 3)")],
)
def test_what_speaks_against_a_name_is_the_probability_or_the_evidence(
    monkeypatch, probability, gain, reason
):
    monkeypatch.setattr(
        remainder_verdict, "unexplained_outcome", lambda comparison, first, nearest, reason="": reason
    )
    assert remainder_verdict.decide_on_remainder(TwoRivals(probability, gain, True), None).endswith(reason)


# ---------------------------------------------------------------- whiteness


def test_a_channel_whose_noise_record_is_not_white_has_no_test_of_whiteness():
    """A weak colour, which is not whitened, is not a gap where the record has it too."""
    bench = kit.chain_bench(amplitudes=(0.004, 0.002), samples=150)
    problem = bench.problem(3, ModelPatch())
    name, channel = next(iter(problem.campaign.channels.items()))
    samples = channel.noise.standard_deviation * kit.coloured(np.random.default_rng(5), (0.2,), 600)
    record = replace(channel.noise, samples=samples, interval=7.0)
    channels = {**problem.campaign.channels, name: replace(channel, noise=record)}
    coloured = kit.problem_of(replace(problem.campaign, channels=channels), problem.model)
    before, after = (
        {test.name for test in whiteness_tests(item, kit.fitted(item))} for item in (problem, coloured)
    )
    assert before - after == {f"whiteness of {name}"}
