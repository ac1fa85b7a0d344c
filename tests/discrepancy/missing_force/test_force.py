"""The missing force of simulated rigs: where it is, how large, and what a law is of it."""

import shutil
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from benchmarks.blind_naming import at_unit
from benchmarks.open_rigs.campaigns import drawn, write
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import Campaign, Channel, Hold, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import library
from discrepancy.estimation.estimate import Estimate
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.estimation.linearisation import plain_linearisation
from discrepancy.estimation.log_prior import log_prior
from discrepancy.estimation.ranking import rank_hypotheses
from discrepancy.estimation.regression import Priors
from discrepancy.estimation.screen import screen_effects
from discrepancy.files.verdict import primitive_intervals
from discrepancy.fits.candidate import Candidate, EffectTerm, Point
from discrepancy.fits.fitting import fit
from discrepancy.fits.problem import Problem
from discrepancy.fmu_models.model import FmuModel
from discrepancy.judgement.hypotheses import named_effects
from discrepancy.missing_force.port_force import (
    TrialForce,
    explained_variance,
    missing_force,
    relaxed_displacement,
    variance_explained_by_state,
)
from discrepancy.missing_force.shares import ForceShares
from discrepancy.model_choice import load_model
from discrepancy.report.force_figure import missing_force_figure
from discrepancy.report.sizes import size_sentence
from discrepancy.report.verdict_sentences import force_sentence, left_sentence
from discrepancy.search.strategy import Search
from discrepancy.search.whole_search import search
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.response import Conditions
from discrepancy.trials_in_motion.ported_trial import ported_trial
from discrepancy.trials_in_motion.trajectory import LawArguments, Trajectory
from discrepancy.verdict import STATE, Verdict, VerdictKind
from discrepancy.workflow import Investigation, check_and_prepare, investigate
from fe.runtime.patch import ModelPatch, PowerDamping, PowerStiffness
from tests.costs import once
from tests.discrepancy.core.kit import fitted, problem_of
from tests.discrepancy.rigs import (
    FEW,
    asked,
    chosen,
    fmu_rig,
    hiding,
    integrated,
    measured,
    one_mass,
    simulated,
)
from tests.refusals import Inputs

CART, CART_IN_AIR, SHAKEN, SERVO, STORES, PLAY = 0, 5, 8, 12, 14, 16
"""Campaigns: friction on a rail, drag, one on a support, a cubic spring in a loop, an outflow, free play."""


def share_of(missing):
    """Return the share that the law is of the force's mean square."""
    force = np.concatenate([item.force for item in missing.courses])
    law = np.concatenate([item.law for item in missing.courses if item.law is not None])
    return 1.0 - float(np.mean((force - law) ** 2) / np.mean(force**2))


def write_drive(folder):
    """Write four seconds of a carriage of 95.1 kg with friction of 20.4 N under a loop of 1 kHz."""
    time, parts = 1e-3 * np.arange(4000.0), 8
    turn = time % 5.0
    s = np.clip(np.where(turn < 2.5, (turn - 0.3) / 1.2, 1.0 - (turn - 2.8) / 1.2), 0.0, 1.0)
    wanted = 0.22 * (10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5)
    x = v = 0.0
    rows = []
    for aim in wanted:
        push = 35.15 * float(np.clip(243.0 * (160.0 * (aim - x) - v), -10.0, 10.0))
        rows.append((push, x))
        for _ in range(parts):
            rubs = 203.5 * v + 20.4 * np.tanh(v / 2e-4) + 1.2 * np.sin(2.0 * np.pi * x / 0.05) - 3.2
            v += (push - rubs) / 95.1 * 1e-3 / parts
            x += v * 1e-3 / parts
    values = np.array(rows) + np.random.default_rng(3).standard_normal((len(time), 2)) * (0.05, 2e-6)
    table = np.column_stack((time, values))
    np.savetxt(folder / "run.csv", table, "%.9g", ",", header="time,force,position", comments="")
    for name, file in (("drive", "model"), ("driven", "campaign")):
        shutil.copy(Inputs(__file__).folder / f"{name}.toml", folder / f"{file}.toml")


def read(folder):
    """Read a folder with a campaign and its model."""
    model = load_model(folder / "model.toml")
    campaign, faults = check_and_prepare(read_campaign(folder), model)
    assert not faults
    return problem_of(campaign, model)


def available(problem):
    return [item for item in library() if item.unavailable(problem.setting) is None]


def blind(folder, number, seed=1, samples=64):
    """Write a campaign of the blind rigs, shorter than theirs, and return it with its model."""
    folder = folder / "campaign"
    bench, truth, _ = drawn(number, seed, samples)
    write(folder, bench, truth, "plain", (seed, number))
    return read(folder)


LAWS_OF_RIGS = pytest.mark.parametrize(
    ("number", "effect", "port"),
    [
        (CART_IN_AIR, "quadratic_damping", "rail"),
        (SERVO, "cubic_stiffness", "bearing"),
        (STORES, "outflow", "lower outlet"),
    ],
)


@dataclass(frozen=True)
class RankedLaws:
    """The search for the missing force of a rig, and the laws that may explain it, the best one first."""

    search: ForceSearch
    laws: list[Estimate]


@once
def ranked_laws(number):
    """Return the ranking of a rig, each law alone, made once for all tests that ask about it."""
    with TemporaryDirectory() as folder:
        problem = blind(Path(folder), number)
        search = ForceSearch(problem)
        hypotheses = rank_hypotheses(search, available(problem), largest_set=1)
    return RankedLaws(search, [item for item in hypotheses if item.candidate.terms])


@LAWS_OF_RIGS
def test_a_force_is_most_probable_at_the_port_where_it_acts(number, effect, port):
    by_port = ranked_laws(number).search.estimate_by_port
    assert max(by_port, key=lambda name: by_port[name].log_evidence) == port


@LAWS_OF_RIGS
def test_the_law_of_the_missing_force_is_ahead_of_all_others(number, effect, port):
    """Of those of other families, and of a force that follows no law."""
    ranked = ranked_laws(number)
    best = ranked.laws[0]
    (term,) = best.candidate.terms
    others = [item for item in ranked.laws if item.candidate.terms[0].effect.family != term.effect.family]
    assert (term.effect.identifier, term.place) == (effect, port)
    assert best.log_evidence > others[0].log_evidence + 10.0
    assert best.log_evidence > ranked.search.estimate_without_effects.log_evidence + 10.0


@LAWS_OF_RIGS
def test_a_fit_that_begins_at_the_values_of_the_best_law_stays_there(number, effect, port):
    ranked = ranked_laws(number)
    best = ranked.laws[0]
    again = ranked.search.polish_effects(best, best.candidate, best.effect)
    deviations = np.sqrt(np.diag(best.effect_covariance))
    np.testing.assert_allclose((again.effect - best.effect) / deviations, 0.0, atol=0.4)


@LAWS_OF_RIGS
def test_the_best_law_is_most_of_the_gap(number, effect, port):
    ranked = ranked_laws(number)
    share = ForceShares(ranked.search).gap_share(ranked.laws[0], held_out=False)
    low, high = share.interval
    assert share.value > 0.85
    assert low <= share.value <= high


@pytest.mark.parametrize(("number", "effect"), [(PLAY, "free_play"), (SHAKEN, "quadratic_damping")])
def test_a_law_is_followed_to_where_it_is_however_far(tmp_path, number, effect):
    """A dead zone, whose stiffness first sight does not tell; a drag seven deviations above the median."""
    problem = blind(tmp_path, number, 37)
    best = rank_hypotheses(ForceSearch(problem), chosen(effect))[0]
    (law,) = at_unit(best.candidate.patch(problem.setting, best.effect))
    for key, value in drawn(number, 37, 64)[2]["values"].items():
        assert getattr(law, key.removeprefix(f"{effect}.")) == pytest.approx(value, rel=0.05)


def test_one_effect_at_two_places_has_a_prior():
    """Where it is the only one that is looked for."""
    setting = chain("ringdown", 0.004).setting
    both = Candidate(tuple(EffectTerm(FRICTION, place) for place in FRICTION.places(setting)[:2]))
    assert log_prior(both, 1, setting) == log_prior(both, 2, setting) > -20.0


def test_a_law_with_a_free_shape_has_the_name_of_its_family(tmp_path):
    """Its effect is one member: a force that goes with the square of the speed is not a dry friction."""
    problem = blind(tmp_path, CART_IN_AIR, samples=96)
    (friction,) = chosen("coulomb_friction")
    port, *_ = problem.model.ports
    free = Candidate((EffectTerm(friction, port, free_shape=True),))
    force = ForceSearch(problem)
    law = force.estimate_effects(force.estimate_without_effects, free, free.terms[0].start_values())
    family = f"a law of the family {friction.family}"
    missing = missing_force(force, law)
    assert missing.law == missing.at_port.law == family
    effects = named_effects(problem, law)
    verdict = Verdict(VerdictKind.FAMILY, "", 1.0, 9.0, effects=effects, family=friction.family)
    investigation = Investigation(problem.campaign, problem.model, (), verdict)
    intervals = [primitive_intervals(effect.patch) for effect in effects]
    sentence = size_sentence(investigation, effects, intervals)
    assert sentence.startswith("Size: ")
    twice = size_sentence(investigation, effects * 2, intervals * 2)
    assert twice.startswith(f"Size: {family}, ")


@pytest.fixture(scope="module")
def friction_on_rail(tmp_path_factory):
    """What is found of a cart on a rail with dry friction."""
    folder = tmp_path_factory.mktemp("cart")
    blind(folder, CART)
    return investigate(folder / "campaign", folder / "campaign" / "model.toml", FEW[:3])


def test_the_missing_force_is_found_at_its_port_with_its_law(friction_on_rail):
    missing = friction_on_rail.missing
    assert missing.at_port.port == "rail"
    assert missing.law == "Coulomb friction"
    assert share_of(missing) > 0.9


def test_the_course_of_dry_friction_is_a_step(friction_on_rail):
    """Its size hardly varies where the cart moves, and its sign is that of the speed."""
    for course in friction_on_rail.missing.courses:
        moving = np.abs(course.speed) > 0.2
        force = course.force[moving]
        assert np.std(np.abs(force)) < 0.2 * np.mean(np.abs(force))
        assert np.all(np.sign(force) == np.sign(course.speed[moving]))
        assert np.all(course.deviation > 0.0)


def test_a_verdict_has_port_unit_and_law_of_the_missing_force(friction_on_rail):
    told = friction_on_rail.verdict.force
    law = friction_on_rail.missing.law
    assert (told.port, told.unit, told.law, told.ordered_by) == ("rail", "N", law, ("velocity",))


def test_a_verdict_has_the_size_of_the_missing_force_and_of_the_speed(friction_on_rail):
    told = friction_on_rail.verdict.force
    courses = friction_on_rail.missing.courses
    force = np.concatenate([course.force for course in courses])
    speed = np.concatenate([course.speed for course in courses])
    assert told.rms == pytest.approx(np.sqrt(np.mean(force**2)))
    assert told.speed == pytest.approx(np.sqrt(np.mean(speed**2)))
    assert abs(told.largest.force) == np.abs(force).max()


def course_of_largest_force(found):
    """Return the course of the trial in which the missing force is largest."""
    name = found.verdict.force.largest.trial
    (course,) = (item for item in found.missing.courses if item.trial == name)
    return course


def test_a_verdict_has_the_speed_at_the_largest_missing_force(friction_on_rail):
    largest = friction_on_rail.verdict.force.largest
    course = course_of_largest_force(friction_on_rail)
    assert largest.speed == course.speed[course.time == largest.time]


@pytest.mark.parametrize(("trials", "count"), [("fitted", 2), ("held_out", 1)])
def test_the_law_leaves_little_of_the_force_in_fitted_and_in_held_out_trials(friction_on_rail, trials, count):
    share = getattr(friction_on_rail.verdict.force, trials)
    assert share.trials == count
    assert share.left < 0.3 * share.whole


def test_a_report_opens_with_the_missing_force(friction_on_rail):
    told = friction_on_rail.verdict.force
    sentence = force_sentence(told)
    assert sentence.startswith(f"A force of {told.rms:.3g} N (rms) is missing at rail, at most ")
    assert left_sentence(told).startswith("Left beside Coulomb friction: ")


def test_a_speed_that_is_a_rounding_error_is_told_as_zero(friction_on_rail):
    told = friction_on_rail.verdict.force
    at_release = replace(told, largest=replace(told.largest, speed=-1e-16))
    assert " m and 0 m/s" in force_sentence(at_release)


def test_the_missing_force_is_drawn_with_two_deviations_about_it(friction_on_rail):
    axes = missing_force_figure(friction_on_rail.missing).axes
    course = course_of_largest_force(friction_on_rail)
    largest = int(np.argmax(np.abs(course.force)))
    edge = course.time[largest], course.force[largest] + 2.0 * course.deviation[largest]
    band = axes[3].collections[0].get_paths()[0].vertices
    assert len(axes) == 4
    assert np.isclose(band, edge).all(axis=1).any()


def problem_without_gap(folder, gain):
    """Return the cart whose readings are its model's own response, times a gain, and noise alone."""
    problem, random = blind(folder, CART), np.random.default_rng(8)
    every = problem.with_trials(problem.campaign.trials)
    start = every.prior_mean_point(Candidate())
    for number, data in enumerate(every.trials):
        bare, _ = every.response(number, start.shared, start.local[number], ModelPatch())
        response = gain * every.prediction(number, start, bare)
        data.trial.values[:] = response + random.standard_normal(response.shape) * data.deviation
    return problem


RIVALS_OF_A_GAIN = chosen("quadratic_damping", "coulomb_friction", "gauge_gain")


def test_a_rig_without_a_gap_misses_no_force(tmp_path):
    problem = problem_without_gap(tmp_path, 1.0)
    search = ForceSearch(problem)
    assert missing_force(search, search.estimate_without_effects) is None
    verdict = investigate(problem.campaign, problem.model, RIVALS_OF_A_GAIN, thorough=False).verdict
    assert verdict.kind is VerdictKind.NOTHING_MISSING


def test_a_gain_is_not_a_law(tmp_path):
    problem = problem_without_gap(tmp_path, 1.05)
    found = investigate(problem.campaign, problem.model, RIVALS_OF_A_GAIN)
    assert found.missing is None or not found.verdict.effects


STIFF = PowerStiffness("slide", 2.0, 3.0, 0, 0.02)
DAMPED = PowerDamping("slide", 0.5, 2.0, 0.0, 0.6, 1.0)


def test_an_fmu_misses_the_force_that_the_same_lumped_model_does(foreign_fmu, tmp_path):
    lumped = LumpedModel.load("single_mass_rig")
    campaign = simulated(lumped, "ringdown", 3, ModelPatch((STIFF,)))
    with closing(FmuModel.load(fmu_rig(tmp_path, foreign_fmu("rig2")))) as fmu:
        scales = lumped.scales(campaign)
        first, second = (
            next(
                iter(
                    ForceSearch(
                        Problem(campaign, item, Setting(campaign, item, scales))
                    ).estimate_by_port.values()
                )
            )
            for item in (lumped, fmu)
        )
        assert second.log_evidence == pytest.approx(first.log_evidence, abs=0.5)
        for one, other in zip(first.trials, second.trials, strict=True):
            force = one.lacking_forces[0]
            np.testing.assert_allclose(other.lacking_forces[0], force, atol=2e-3 * np.ptp(force))
    # of one whose system is not known no force is seen
    unknown = ("isolated = false", "isolated = false\nsuperposition = false")
    with closing(FmuModel.load(fmu_rig(tmp_path, foreign_fmu("rig2"), unknown))) as fmu:
        problem = problem_of(campaign, fmu)
        assert Search(problem, (), fitted(problem)).force_search is None


def drawn_through(search, effect, place):
    """Return the estimate of an effect, from where it is first seen."""
    term = EffectTerm(effect, place)
    base = search.estimate_without_effects
    start = next(item for item in screen_effects(search, base, [effect]) if item[1] == term)[2][0].effect
    return search.estimate_effects(base, Candidate((term,)), start)


@pytest.mark.parametrize("high", [3.0, 1.05])
def test_a_parameter_that_the_force_pushes_to_the_end_of_its_range_comes_back(high):
    """Beside no law a damper takes up what the drag does: the drag is the same wherever its range ends."""
    rig, (drag,) = LumpedModel.load("single_mass_rig"), chosen("quadratic_damping")
    campaign = simulated(rig, "ringdown", 3, ModelPatch((DAMPED,)))
    first, damper = rig.description.parameter
    rows = [first, damper.model_copy(update={"high": high})]
    rig = LumpedModel(rig.description.model_copy(update={"parameter": rows}))
    problem = problem_of(campaign, rig)
    found = drawn_through(ForceSearch(problem), drag, "slide")
    (law,) = found.candidate.patch(problem.setting, found.effect)
    at_one = law.coefficient / law.reference_velocity**2
    assert at_one == pytest.approx(DAMPED.coefficient / DAMPED.reference_velocity**2, rel=0.06)


def test_trials_about_other_values_have_the_same_stamps():
    """A stiffer spring would need five substeps for four: 0.6 rad of its mode pass in an interval."""
    angular_frequency = np.sqrt(1000.0 / 2.0)
    parameter = [{"name": "k", "terms": "stiffness", "deviation": 0.1, "low": 0.5, "high": 1.5}]
    model = one_mass(stiffness=1000.0, damping={"ratios": [0.02]}, parameter=parameter)
    time = 0.59 / angular_frequency * np.arange(200)
    trial = Trial.plain(
        "pushed",
        TrialKind.FORCED,
        ("x",),
        time,
        values=np.zeros((200, 1)),
        force=np.sin(time),
        load_place="push",
    )
    channel = Channel("x", Quantity.DISPLACEMENT, "x", NoiseRecord(1e-5, 100.0))
    problem = problem_of(Campaign("one mass", {"x": channel}, (trial,), None, {}, "0" * 64), model)
    means = problem.prior_mean_point(Candidate())
    stiffer = replace(means, shared=means.shared + 2.0)
    stamps = [ported_trial(problem, 0, point).fine_time for point in (means, stiffer)]
    np.testing.assert_array_equal(*stamps)


@pytest.mark.parametrize("number", [SERVO, STORES])
def test_a_parameter_turns_what_a_force_does_as_the_system_itself(tmp_path, number):
    """To first order: a heavier body moves less under the same force, and a reaction shows another part."""
    problem = blind(tmp_path, number)
    point = problem.prior_mean_point(Candidate())
    here = ported_trial(problem, 0, point)
    forces = {0: np.sin(0.7 * np.arange(len(here.fine_time)) / here.substeps)}

    def shown(k, step):
        shared = point.shared.copy()
        shared[k] += step
        trial = ported_trial(problem, 0, Point(shared, point.local, point.effect))
        return trial.readings_of_state(trial.state_under_force(0, forces[0]), forces)

    # the readings of the linear trial by a unit of each shared unknown, along the forced motion
    added = here.state_under_force(0, forces[0])
    bare = plain_linearisation([here], Priors.without_ranges(problem.shared.precision)).trials[0]
    trajectory = Trajectory(added, here.port_positions, here.port_speeds, forces)
    forced = replace(bare, trajectory=trajectory)
    changed = [k for k, item in enumerate(here.system_derivatives) if item is not None]
    assert changed
    for k in changed:
        expected = (shown(k, 1e-3) - shown(k, -1e-3)) / 2e-3
        found = bare.columns[:, :, 1 + k] - forced.columns[:, :, 1 + k]
        np.testing.assert_allclose(found, expected, atol=3e-3 * np.abs(expected).max())


(FRICTION,) = chosen("coulomb_friction")


def test_friction_of_a_positioning_drive_is_found_at_its_own_sampling(tmp_path):
    """A thousand samples a second by an encoder, at rest half of the time, creeping before it slides."""
    write_drive(tmp_path)
    problem = read(tmp_path)
    search = ForceSearch(problem)
    rivals = chosen("coulomb_friction", "bouc_wen_hysteresis", "load_cell")
    best, *_ = rank_hypotheses(search, rivals, largest_set=1)
    (term,) = best.candidate.terms
    assert term.effect.identifier == "coulomb_friction"
    (friction,) = best.candidate.patch(problem.setting, best.effect)
    assert friction.coefficient == pytest.approx(20.4, rel=0.1)
    assert np.abs(best.shared).max() < 1.5


def chain(kind, ratio):
    """Return the problem of an example of the three-mass chain that hides friction of its joint."""
    model = LumpedModel.load("three_mass_chain")
    hidden = "coulomb_friction", {"friction_ratio": ratio}, "joint"
    campaign = simulated(model, kind, 3, hidden)
    static = [trial for trial in campaign.trials if not trial.is_dynamic]
    released = [trial for trial in campaign.trials if trial.is_dynamic]
    return problem_of(replace(campaign, trials=(*static, *released[:2])), model)


def test_friction_that_holds_is_the_law_of_the_missing_force():
    """The joint sticks half of the time; what is told of it is of the trials in motion."""
    search = ForceSearch(chain("laboratory", 0.004))
    missing = missing_force(search, drawn_through(search, FRICTION, "joint"))
    assert (missing.at_port.port, missing.law) == ("joint", "Coulomb friction")
    assert share_of(missing) > 0.95
    for item in missing.courses:
        slips = np.abs(item.speed) > 0.02
        np.testing.assert_allclose(np.abs(item.law[slips]), 0.528, rtol=0.06)
        assert np.abs(item.law).max() < 0.56  # where it sticks no more than that holds it


def test_one_law_stands_where_several_follow_the_jumps_that_an_accelerometer_shows():
    random, time = np.random.default_rng(5), 0.01 * np.arange(150)
    rig = one_mass(stiffness=200.0, damping={"matrix": 1.0}, output=[{"name": "x", "vector": 1.0}])
    known = (("x", Quantity.DISPLACEMENT, 2e-4), ("a", Quantity.ACCELERATION, 2e-2))
    channels = {name: Channel(name, what, "x", NoiseRecord(size, 200.0)) for name, what, size in known}
    rubs, trials = ModelPatch((PowerDamping("slide", 0.4, 0.0, 0.0, 1.0, 1.0),)), []
    for name in "bc":
        force = np.r_[0.0, 0.3 * np.cumsum(random.standard_normal(149))]
        bare = Trial.plain(name, TrialKind.FORCED, ("x", "a"), time, force=force, hold=Hold.LINEAR)
        shown = rig.respond(bare, tuple(("x", what) for _, what, _ in known), rubs, Conditions(np.zeros(0)))
        noise = random.standard_normal((150, 2)) * [size for *_, size in known]
        trials.append(replace(bare, values=shown.values + noise))
    drag, friction = effects = chosen("quadratic_damping", "coulomb_friction")
    found = search(problem_of(Campaign("rubs", channels, tuple(trials), None, {}, ""), rig), effects)
    alone = found.best()
    assert alone.candidate.identifiers == (friction.identifier,)
    both = alone.candidate.with_term(EffectTerm(drag, "slide"))
    again = Search(found.problem, effects, found.no_effect)
    begun = replace(alone.point, effect=np.append(alone.effect, 0.0))
    again.record_fit(fit(found.problem, both, begun), exact=True)  # the other one was found first
    again.search_sets()
    assert again.best().candidate.identifiers == (friction.identifier,)


def test_a_model_with_the_right_law_of_its_own_has_no_gap_at_any_time():
    model = LumpedModel.load("single_mass_rig")
    values = {"friction_ratio": 0.02}
    rubs = hiding(simulated(model, "ringdown", 4), model, "coulomb_friction", values, "slide")
    campaign = simulated(model, "ringdown", 4, rubs)
    two_releases = replace(campaign, trials=campaign.trials[:2])
    found = investigate(two_releases, model.with_patch(rubs), FEW[:1]).verdict
    assert (found.kind, found.windows) == (VerdictKind.NOTHING_MISSING, ())


def test_a_force_is_ordered_by_the_variable_that_it_is_a_function_of():
    random = np.random.default_rng(4)
    x, v = random.uniform(-1.0, 1.0, (2, 400))
    assert explained_variance(x, x**3) > 0.9
    assert explained_variance(v, x**3) < 0.2
    assert explained_variance(np.zeros(400), x) == 0.0


def missing_beside_spring(rate, first, force):
    """Return the force that is missing on a mass of 2 kg on 800 N/m, whose true motion has a rate.

    The rate is a function of time and state; the state begins with the displacement.
    """
    time = 0.005 * np.arange(len(force))
    noise = 1e-5
    x = integrated(rate, time, first, max_step=0.005)[:, :1]
    x = x + noise * np.random.default_rng(5).standard_normal(x.shape)
    trial = asked(TrialKind.FORCED, time, channels=("x",), values=x, force=force, load_place="push")
    channel = Channel("x", Quantity.DISPLACEMENT, "x", NoiseRecord(noise, 400.0))
    model = one_mass(stiffness=800.0, damping={"matrix": 1.6})
    problem = problem_of(Campaign("driven", {"x": channel}, (trial,), None, {}, ""), model)
    search = ForceSearch(problem)
    return missing_force(search, search.best_port_estimate)


TIME_OF_DRIVE = 0.005 * np.arange(600)
RECORDED = 5.0 * np.sin(12.0 * TIME_OF_DRIVE) + 3.0 * np.sin(27.0 * TIME_OF_DRIVE)


def clipped(force):
    """Return what a saturating actuator makes of a recorded force."""
    return np.clip(force, -4.0, 4.0)


def late(force):
    """Return a force that acts two samples later than it was recorded."""
    return np.concatenate((np.zeros(2), force[:-2]))


@pytest.mark.parametrize(
    ("acting", "variable"),
    [(clipped, "the applied force"), (late, "the rate of the applied force")],
    ids=["saturates", "is late"],
)
def test_a_force_that_acts_otherwise_than_recorded_follows_the_input(acting, variable):
    acts = acting(RECORDED)

    def rate(now, state):
        x, v = state
        return [v, (np.interp(now, TIME_OF_DRIVE, acts) - 1.6 * v - 800.0 * x) / 2.0]

    missing = missing_beside_spring(rate, [0.0, 0.0], RECORDED)
    assert missing.at_port.ordered_by == (variable,)
    assert missing.at_port.orders[variable] > 0.6
    labels = [axes.get_xlabel() for axes in missing_force_figure(missing).axes]
    assert labels[0] == variable.removeprefix("the ")


def test_a_spring_behind_a_damper_follows_the_relaxed_displacement():
    """A Maxwell branch of 60 N/m that relaxes within 0.05 s."""

    def rate(now, state):
        x, v, z = state
        force = np.interp(now, TIME_OF_DRIVE, RECORDED)
        return [v, (force - 1.6 * v - 800.0 * x - 60.0 * z) / 2.0, v - z / 0.05]

    told = missing_beside_spring(rate, [0.0, 0.0, 0.0], RECORDED).at_port
    (variable,) = told.ordered_by
    assert variable.startswith("the displacement relaxed within 0.0")
    assert told.orders[variable] > 0.9


@pytest.mark.parametrize(
    ("contact", "variable"),
    [
        (lambda x, v: max(1500.0 * (x - 0.006) + 40.0 * v, 0.0), STATE),
        (lambda x, v: 1500.0 * (x - 0.006), "displacement"),
    ],
    ids=["with loss", "without loss"],
)
def test_an_impact_with_loss_follows_displacement_and_velocity_together(contact, variable):
    def rate(now, state):
        x, v = state
        force = np.interp(now, TIME_OF_DRIVE, RECORDED)
        stop = contact(x, v) if x > 0.006 else 0.0
        return [v, (force - 1.6 * v - 800.0 * x - stop) / 2.0]

    told = missing_beside_spring(rate, [0.0, 0.0], RECORDED).at_port
    assert told.ordered_by == (variable,)


def test_the_state_of_a_port_explains_a_function_of_it_and_no_function_of_the_time():
    time = 0.01 * np.arange(3000)
    x = np.sin(6.0 * time) + 0.7 * np.sin(9.1 * time)
    v = np.gradient(x, time)

    def explained(force):
        return variance_explained_by_state(
            [TrialForce("record", time, x, v, {}, force, np.zeros(3000), None)]
        )

    assert explained(np.where(x > 0.5, x - 0.5 + 0.1 * v, 0.0)) > 0.9
    assert explained(np.sin(0.37 * time)) < 0.2


def test_a_relaxed_displacement_is_that_of_the_closed_form():
    time = np.linspace(0.0, 2.0, 20001)
    relaxed = relaxed_displacement(time, np.ones_like(time), 0.3)
    assert relaxed[1:] == pytest.approx(0.3 * (1.0 - np.exp(-time[1:] / 0.3)), rel=2e-3, abs=2e-4)


def test_a_gain_error_acts_on_the_motion_of_the_model_and_not_on_that_by_a_missing_force():
    """The motion that the readings show would otherwise be explained by the readings themselves."""
    problem = problem_of(*measured(0.01, "ringdown"))
    search = ForceSearch(problem)
    estimate = search.estimate_without_effects
    (gain,) = chosen("gauge_gain")
    candidate = Candidate((EffectTerm(gain, "leaf_strain"),))
    laws = search.ported.laws(candidate, estimate.ported_trials)
    moved = estimate.trials[0].trajectory
    still = replace(moved, added_state=np.zeros_like(moved.added_state))
    changes = []
    for trajectory in (moved, still):
        arguments = LawArguments(0, trajectory, np.array([0.7]), estimate.shared, 0.005)
        _, errors = laws.linearise_along_trajectory(arguments)
        changes.append(errors.change)
    assert np.abs(moved.added_state).max() > 0.0
    assert np.abs(changes[0]).max() > 0.0
    np.testing.assert_array_equal(changes[0], changes[1])


def test_a_crack_acts_at_the_port_of_its_place():
    (crack,) = chosen("breathing_crack")
    assert EffectTerm(crack, "mass, open at positive x").port == "mass"
    assert EffectTerm(crack, "root, lower skin").port == "root, lower skin"
