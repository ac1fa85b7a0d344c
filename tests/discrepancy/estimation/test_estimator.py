"""Hypotheses estimated with their laws inside the smoother, on simulated rigs."""

import numpy as np
import pytest

from discrepancy.estimation import refinement
from discrepancy.estimation.effects import EffectLaws
from discrepancy.estimation.estimator import MotionEstimator
from discrepancy.estimation.gauss_newton import EstimatorStart
from discrepancy.estimation.refinement import (
    _simpler_forms,
    refine_hypotheses,
    unknowns_of_model_laws,
)
from discrepancy.estimation.trajectory import Trajectory
from discrepancy.fits.candidate import Candidate, EffectTerm
from discrepancy.missing_force.naming import ForceSearch
from tests.discrepancy.missing_force.test_force import CART, CART_IN_AIR, PLAY, blind
from tests.discrepancy.rigs import chosen


@pytest.fixture(scope="module")
def friction(tmp_path_factory):
    """Return the search for the force of a cart that dry friction brings to rest, and its effects."""
    problem = blind(tmp_path_factory.mktemp("friction"), CART)
    return ForceSearch(problem), chosen("coulomb_friction", "quadratic_damping", "cubic_stiffness")


def test_without_a_law_it_is_the_missing_force_as_it_was_seen(tmp_path):
    search = ForceSearch(blind(tmp_path, CART_IN_AIR))
    seen = search.hypothesis_of_all_ports
    trials = tuple(seen.linear_trials.trials)
    nothing = EffectLaws(
        search.column_builder, trials, Candidate(), search.evaluate_model_laws, unknowns_of_model_laws(search)
    )
    trajectories = tuple(
        Trajectory(motion.added_state, motion.positions, motion.speeds, motion.forces)
        for motion in seen.motions
    )
    estimator = MotionEstimator(
        trials, search.problem.shared.precision, search.prior_processes(seen.processes)
    )
    start = EstimatorStart(np.zeros(0), seen.shared, trajectories, seen.processes)
    found = estimator.estimate(nothing, start)
    assert found.log_evidence == pytest.approx(seen.log_evidence, abs=0.05)
    for one, motion in zip(found.trials, seen.motions, strict=True):
        scale = np.abs(motion.forces[0]).max()
        np.testing.assert_allclose(one.missing_forces[0], motion.forces[0], atol=0.02 * scale)


def test_friction_that_ends_a_motion_leads_over_a_free_exponent(friction):
    search, effects = friction
    followed = search.rank_hypotheses(effects)
    assert followed[0].candidate.identifiers != ("coulomb_friction",)  # along a motion taken as known
    ranked = refine_hypotheses(search, followed, len(effects))
    assert ranked[0].candidate.identifiers == ("coulomb_friction",)


def test_a_named_law_is_estimated_if_a_free_shape_of_its_family_leads(friction, monkeypatch):
    monkeypatch.setattr(refinement, "MOST_REFINED", 1)
    search, effects = friction
    followed = search.rank_hypotheses(effects, largest_set=1)
    assert followed[0].candidate.has_free_shape
    best, *_ = refine_hypotheses(search, followed, len(effects))
    assert best.candidate.identifiers == ("coulomb_friction",)
    assert best.speed_window is not None


@pytest.fixture(scope="module")
def play(tmp_path_factory):
    """A search for free play, and its hypotheses along a motion that is taken as known."""
    problem = blind(tmp_path_factory.mktemp("play"), PLAY, seed=82)
    effects = chosen("free_play", "cubic_stiffness", "logger_clock")
    search = ForceSearch(problem)
    followed = search.rank_hypotheses(effects)
    best, *_ = refine_hypotheses(search, followed, len(effects))
    return followed, best, best.candidate.terms[0].patch(problem.setting, best.effect)


def test_an_effect_that_only_a_set_found_is_estimated_alone(play):
    followed, best, _ = play
    assert len(followed[0].candidate.terms) > 1
    assert best.candidate.identifiers == ("free_play",)


def test_an_effect_that_only_a_set_found_has_its_values(play):
    _, _, (law,) = play
    assert law.half_width == pytest.approx(6.708e-3, rel=0.01)
    assert law.stiffness == pytest.approx(644.6, rel=0.02)


@pytest.mark.parametrize("number", [0, 1])
def test_the_simpler_forms_of_a_pair_keep_its_values(friction, number):
    _, effects = friction
    terms = [
        EffectTerm(effect, "rail", free_shape=True)
        for effect in effects
        if effect.identifier in ("coulomb_friction", "cubic_stiffness")
    ]
    counts = [len(term.parameters) for term in terms]
    values = [0.1 + np.arange(counts[0]), 10.1 + np.arange(counts[1])]
    forms = _simpler_forms(Candidate(tuple(terms)), np.concatenate(values))
    other = 1 - number
    alone, canonical = forms[number], forms[2 + number]
    assert alone.candidate.terms == (terms[other],)
    np.testing.assert_array_equal(alone.parameters, values[other])
    assert [term.free_shape for term in canonical.candidate.terms] == [number == 1, number == 0]
    kept = list(values)
    kept[number] = values[number][: len(terms[number].effect.parameters)]
    np.testing.assert_array_equal(canonical.parameters, np.concatenate(kept))
