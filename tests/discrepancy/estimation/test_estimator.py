"""Hypotheses estimated with their laws inside the smoother, on simulated rigs."""

import numpy as np
import pytest

from discrepancy.estimation import ranking
from discrepancy.estimation.estimate import NO_EFFECTS
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.estimation.gauss_newton import start_from_estimate
from discrepancy.estimation.ranking import _simpler_forms, rank_by_missing_force, rank_hypotheses
from discrepancy.fits.candidate import Candidate, EffectTerm
from tests.discrepancy.missing_force.test_force import CART, CART_IN_AIR, PLAY, blind
from tests.discrepancy.rigs import chosen


@pytest.fixture(scope="module")
def friction(tmp_path_factory):
    """Return the search for the force of a cart that dry friction brings to rest, and its effects."""
    problem = blind(tmp_path_factory.mktemp("friction"), CART)
    return ForceSearch(problem), chosen("coulomb_friction", "quadratic_damping", "cubic_stiffness")


def test_without_a_law_it_is_the_missing_force_as_it_was_seen(tmp_path):
    search = ForceSearch(blind(tmp_path, CART_IN_AIR))
    first = search.estimate_without_effects
    trials = [trial.trial for trial in first.trials]
    again = search.estimator(trials).estimate_nearby(
        search.ported.laws(NO_EFFECTS, trials), start_from_estimate(first), 0.005
    )
    assert again.log_evidence == pytest.approx(first.log_evidence, abs=0.05)
    for trial, first_trial in zip(again.trials, first.trials, strict=True):
        force = first_trial.lacking_forces[0]
        np.testing.assert_allclose(trial.missing_forces[0], force, atol=0.02 * np.abs(force).max())


def test_friction_that_ends_a_motion_leads_over_a_free_exponent(friction):
    search, effects = friction
    best, *_ = rank_by_missing_force(search, effects)
    assert best.candidate.identifiers == ("coulomb_friction",)


def test_a_named_law_is_estimated_if_a_free_shape_of_its_family_leads(friction, monkeypatch):
    monkeypatch.setattr(ranking, "BEAM_WIDTHS", (1, 1, 1))
    search, effects = friction
    best, *_ = rank_hypotheses(search, effects, largest_set=1)
    assert best.candidate.identifiers == ("coulomb_friction",)
    assert not best.candidate.has_free_shape


@pytest.fixture(scope="module")
def play(tmp_path_factory):
    """The best estimate of free play among three effects, and its law."""
    problem = blind(tmp_path_factory.mktemp("play"), PLAY, seed=82)
    effects = chosen("free_play", "cubic_stiffness", "logger_clock")
    best, *_ = rank_by_missing_force(ForceSearch(problem), effects)
    return best, best.candidate.patch(problem.setting, best.effect)


def test_free_play_is_named_alone(play):
    best, _ = play
    assert best.candidate.identifiers == ("free_play",)


def test_free_play_has_its_values(play):
    _, (law,) = play
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
