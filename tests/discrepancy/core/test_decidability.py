"""What campaigns cannot decide, before any data; the workflow tried on simulated ones of a rig."""

import json
from dataclasses import replace
from math import inf, log

import jsonschema
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from benchmarks.cantilever import Cantilever, campaign
from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Start, TrialKind
from discrepancy.fits.candidate import EffectTerm
from discrepancy.judgement.next_experiment import (
    Proposal,
    feasible_proposals,
    mutual_information,
    next_experiments,
    oscillates,
)
from discrepancy.judgement.separability import CONFUSION_DISTANCE, campaign_as_predicted, compute_separability
from discrepancy.report.decidability_text import group_lines
from discrepancy.self_calibration import outcome_of, self_calibrate, wilson_interval
from discrepancy.self_calibration_file import self_calibration_schema, write_self_calibration
from discrepancy.simulation import Simulator
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
        "release", TrialKind.RINGDOWN, ("x",), 0.02 * np.arange(200), load_place="mass",
        release=Release(0.01, 0.02, mode_count=1),
    )  # fmt: skip
    effects = ("point_mass", "root_compliance", "clock_error")
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


@pytest.mark.parametrize(
    ("kind", "group"),
    [
        (TrialKind.STATIC, {"gauge_gain", "gauge_misalignment", "local_stiffness_loss"}),
        (TrialKind.FLIGHT, {"washout", "inertia_relief"}),
    ],
)
def test_one_gauge_at_one_load_factor_cannot_tell(kind, group):
    """One gauge of the cantilever, whose modulus is known: damage beside it, or relief beside lift."""
    given, model = campaign(), Cantilever()
    name = next(key for key, item in given.channels.items() if item.quantity is Quantity.STRAIN)
    trials = []
    for trial in (item for item in given.trials if item.kind is kind):
        column = [trial.channels.index(name)]
        level = np.full_like(trial.load_factor, 2.0 if kind is TrialKind.FLIGHT else 0.0)
        part = {"channels": (name,), "values": trial.values[:, column], "used": trial.used[:, column]}
        trials.append(replace(trial, **part, load_factor=level))
    channels = {name: replace(given.channels[name], gain_deviation=0.0)}
    known = {item.name: (item.mean, 1e-4 * item.mean) for item in model.parameters}
    one = replace(given, channels=channels, trials=tuple(trials), parameters=known)
    assert set(group_of(decided(model, one, *group), min(group))) == group


def test_a_whole_laboratory_test_separates():
    """And measured values do not count; what cannot be tested says why.

    A gain of a millionth is within the noise of anything, and is not confused with all others.
    """
    identifiers = (
        "point_mass", "root_compliance", "quadratic_damping", "coulomb_friction", "load_cell", "gauge_gain",
    )  # fmt: skip
    found, other, again = (
        decided(kit.BENCH.model, given, *identifiers, "washout")
        for given in (kit.BENCH.campaign, kit.BENCH.measured(1), kit.BENCH.measured(2))
    )
    np.testing.assert_allclose(other.distance, again.distance, rtol=1e-6)
    assert found.groups == ()
    assert set(found.identifiers) == set(identifiers)
    np.testing.assert_array_equal(np.diag(found.distance), 0.0)
    for item in found.detectability:
        assert bool(item.reason) is (item.effect.identifier == "washout")
        assert item.reason or item.detectable < item.typical
    *others, gauge = kit.chosen("root_compliance", "quadratic_damping", "gauge_gain")
    (gain,) = gauge.parameters
    small = replace(gain.prior, low=1e-4 * gain.prior.low, high=1e-4 * gain.prior.high)
    effects = [*others, replace(gauge, parameters=(replace(gain, prior=small),))]
    unseen = compute_separability(kit.BENCH.campaign, kit.BENCH.model, kit.BENCH.setting, effects)
    assert 1e-6 < unseen.detectability[-1].distance < 0.1 * CONFUSION_DISTANCE
    assert "gauge_gain" in unseen.identifiers
    assert unseen.groups == ()


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


@pytest.mark.parametrize("shift", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("weight", [0.5, 0.2])
def test_information_of_one_reading_against_quadrature(shift, weight):
    """Of unit noise; two hypotheses: nothing, or an offset of `shift` noise deviations."""
    channel = Channel("y1", Quantity.DISPLACEMENT, "y1", kit.NOISE)
    trial = kit.blank_trial("one", TrialKind.STATIC, ("y1",), np.array([1.0]))
    trial = replace(trial, values=np.full((1, 1), 1.5))
    tight = {"slope": (1.0, 1e-9), "curvature": (0.5, 1e-9)}
    problem = kit.problem_of(Campaign("", {"y1": channel}, (trial,), None, tight, ""), kit.ClosedForm())
    none, other = (
        kit.fitted(problem),
        kit.fitted(problem, EffectTerm(kit.offset_effect(deviation=0.02), "y1")),
    )
    point = replace(none.point, effect=np.array([shift]))
    fits = [none, replace(other, point=point, covariance=np.diag([1.0, 1.0, 1e-12]))]
    proposal, weights = Proposal(trial, "", "", 1.0), np.array([weight, 1.0 - weight])
    got = mutual_information(problem, proposal, fits, weights)

    def density(y):
        parts = weights * norm.pdf(y, [0.0, shift])
        share = parts / parts.sum()
        return float(np.sum(parts * (np.log(share) - np.log(weights))))

    exact, _ = quad(density, -8.0, 8.0 + shift)
    entropy = -float(weights @ np.log(weights))
    assert 0.0 <= got <= entropy
    # 300 outcomes each: standard error about 0.02
    assert got == pytest.approx(exact, abs=0.06)
    # under a free zero it tells nothing
    channels = {"y1": replace(problem.campaign.channels["y1"], offset_deviation=inf)}
    free = kit.problem_of(replace(problem.campaign, channels=channels), problem.model)
    assert mutual_information(free, proposal, fits, weights) < 0.02


def test_another_amplitude_decides_between_amplitude_and_time():
    """Stiffening with amplitude and drift with time look alike in releases from one amplitude."""
    test = kit.chain_bench(static=False, amplitudes=(0.01, 0.01), samples=160)
    problem = test.problem(3, test.patch("cubic_stiffness", {"stiffening": 0.01}, "end"))
    stiffening, drift = kit.chosen("cubic_stiffness", "stiffness_drift")
    fits = [kit.fitted(problem, term) for term in (EffectTerm(stiffening, "end"), EffectTerm(drift))]
    information = {
        item.trial.name: mutual_information(problem, item, fits, HALF) for item in feasible_proposals(problem)
    }
    assert all(0.0 <= value <= log(2.0) + 1e-9 for value in information.values())
    same = Proposal(problem.campaign.trials[0], "", "", 1.0)
    twice = information["release at twice the largest amplitude so far"]
    assert twice > mutual_information(problem, same, fits, HALF)
    assert twice > 0.95 * log(2.0)
    best, again = (next_experiments(problem, [(item, 0.5) for item in fits]) for _ in range(2))
    assert best
    # a longer record may do as well, for less; of all repetitions another amplitude comes first
    assert "amplitude" in next(item.description for item in best if item.cost >= 1.0)
    assert list(best) == sorted(best, key=lambda item: -item.information / item.cost)
    assert again == best  # seeded


def test_proposals_are_trials_of_the_kinds_that_were_done():
    """A longer record is one of what swings."""
    problem = kit.BENCH.problem(1)
    found = list(feasible_proposals(problem))
    assert {item.trial.kind for item in found} == {TrialKind.STATIC, TrialKind.RINGDOWN}
    assert len({item.description for item in found}) == len(found)
    for item in found:
        assert item.cost > 0.0
        assert len(item.trial.time) == len(item.trial.values)
    longer = next(item for item in found if item.trial.name == "longer record")
    before = max((t for t in problem.campaign.trials if t.release), key=lambda t: t.release.displacement)
    assert longer.trial.interval == pytest.approx(before.interval)
    assert len(longer.trial.time) == 3 * len(before.time)
    assert f"({3.0 * len(before.time) * before.interval:.3g} s)" in longer.description
    none = kit.fitted(problem)
    assert oscillates(problem, none)
    decay = tuple(
        replace(part, response=np.exp(-data.trial.time)[:, np.newaxis] * np.ones(part.response.shape[1]))
        for data, part in zip(problem.trials, none.trial_derivatives, strict=True)
    )
    assert not oscillates(problem, replace(none, trial_derivatives=decay))
    names = [item.trial.name for item in feasible_proposals(problem, is_oscillating=False)]
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


def test_simulated_campaigns_have_the_noise_and_the_nuisances_of_the_real_one():
    campaign, model = measured()
    simulator = Simulator(campaign, model)
    squares = []
    for seed in range(12):
        drawn = simulator.simulate(None, np.random.default_rng(seed))
        assert [trial.name for trial in drawn.trials] == [trial.name for trial in campaign.trials]
        found = investigate(drawn, model, (), thorough=False) if seed < 2 else None
        assert found is None or found.verdict.kind is VerdictKind.NOTHING_MISSING
        again = simulator.simulate(None, np.random.default_rng(seed)).trials[-1].values
        assert np.array_equal(again, drawn.trials[-1].values)
        # sixth differences of a slow motion hold noise alone: variance times the sum of squared binomials
        sixth = np.diff(drawn.trials[-1].values[:, 0], 6)
        noise = simulator.problem.noise_models[drawn.trials[-1].channels[0]].standard_deviation
        squares.append(float(np.mean(sixth**2)) / 924.0 / noise**2)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.12)


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


def test_the_workflow_tried_on_its_own_geometry(tmp_path):
    campaign, model = measured(kind="static")
    steps = []
    found = self_calibrate(campaign, model, FEW, 6, seed=2, workers=1, advance=lambda: steps.append(1))
    assert len(steps) == len(found.cases) == 6
    assert [case.hidden == "nothing" for case in found.cases] == [True, False, False] * 2
    assert all(case.distance >= 25.0 for case in found.cases if case.hidden != "nothing")
    assert sum(found.confusion()[2].ravel()) == 6
    assert found.share("right", null=True).total == 2
    none, square = wilson_interval(0, 9), norm.ppf(0.95) ** 2  # in closed form (Wilson 1927)
    assert (none.value, none.low, none.high) == pytest.approx((0.0, 0.0, square / (9.0 + square)))
    assert wilson_interval(0, 0).total == 0
    again = self_calibrate(campaign, model, FEW, 6, seed=2, workers=2)
    assert again == found
    path = write_self_calibration(tmp_path / "self_calibration.json", found, ORIGIN)
    stored = json.loads(path.read_text(encoding="utf-8"))
    assert stored["schema"] == "uav-twin self calibration 1"
    jsonschema.validate(stored, self_calibration_schema())
    assert len(stored["cases"]) == 6
