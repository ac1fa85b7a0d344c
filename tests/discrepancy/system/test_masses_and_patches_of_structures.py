"""A mass at a place, and a patch of a mesh that loses stiffness, are causes that are tried."""

from dataclasses import replace

import numpy as np

from discrepancy.campaign.records import TrialKind
from discrepancy.estimation.estimate import NO_EFFECTS
from discrepancy.fits.candidate import Candidate, EffectTerm
from discrepancy.fits.fitting import fit, try_fit
from discrepancy.model_choice import choose_model
from discrepancy.search.fitted_candidates import FittedCandidates
from discrepancy.search.other_optima import refit_masses_from_nearest_points
from discrepancy.search.strategy import Search
from discrepancy.system.interface import NO_PATCH
from discrepancy.system.system_state import SystemState
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from fe.runtime.patch import ModelPatch, PlaceMass
from tests.discrepancy.core.kit import problem_of
from tests.discrepancy.rigs import chosen, setting_of, simulated

RIVALS = chosen("added_mass", "support_compliance", "region_stiffness_loss", "gauge_gain", "clock_error")


def test_a_patch_that_lost_stiffness_is_named_at_its_place_with_its_size(beam_model) -> None:
    hidden = ("region_stiffness_loss", {"loss": 0.3}, "around (37.5, 10, 5) mm")
    campaign = simulated(beam_model, "laboratory", 3, hidden)
    verdict = investigate(campaign, beam_model, RIVALS, seed=3, thorough=False).verdict
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    assert [(effect.identifier, effect.place) for effect in verdict.effects] == [hidden[::2]]
    (loss,) = verdict.effects[0].parameters
    assert loss.low < 0.3 < loss.high


def test_a_mass_beside_a_point_is_named_with_its_size_and_distance(beam_model) -> None:
    place = "the point (100, 20, 10) mm"
    hidden = ("added_mass", {"mass_ratio": 0.2, "along_ratio": -0.6}, place)
    campaign = simulated(beam_model, "laboratory", 3, hidden)
    verdict = investigate(campaign, beam_model, RIVALS, seed=3, thorough=False).verdict
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    (effect,) = verdict.effects
    assert effect.identifier == "added_mass"
    (ratio,) = (row for row in effect.parameters if row.name == "mass_ratio")
    assert ratio.low < 0.2 < ratio.high
    (mass,) = effect.patch
    assert isinstance(mass, PlaceMass)
    reach = beam_model.mass_reaches[place]
    true_point = beam_model.point_of_mass(PlaceMass(place, 0.1, along=-0.6 * reach)).point
    point = beam_model.point_of_mass(mass).point
    assert np.linalg.norm(point - true_point) < 0.5 * reach


def test_a_fit_beside_a_wrong_point_moves_to_the_point_next_to_the_mass(beam_model) -> None:
    true_place, wrong_place = "the point (100, 20, 10) mm", "the point (75, 20, 10) mm"
    campaign = simulated(beam_model, "laboratory", 3, ("added_mass", {"mass_ratio": 0.2}, true_place))
    problem = problem_of(campaign, beam_model)
    (effect,) = chosen("added_mass")
    term = EffectTerm(effect, wrong_place)
    start = replace(problem.prior_mean_point(NO_EFFECTS), effect=term.start_values())
    no_effect = try_fit(problem, NO_EFFECTS, problem.prior_mean_point(NO_EFFECTS))
    candidates = FittedCandidates(problem, (effect,), no_effect)
    beside_wrong_point = candidates.record_fit(fit(problem, Candidate((term,)), start), exact=True)
    refit_masses_from_nearest_points(candidates, lambda message: None)
    best = candidates.best()
    assert [moved.place for moved in best.candidate.terms] == [true_place]
    assert best.log_evidence > beside_wrong_point.log_evidence + 10.0


def test_different_changes_of_a_mesh_are_tried_together(beam_model, monkeypatch) -> None:
    campaign = simulated(beam_model, "laboratory", 3, ("added_mass", {"mass_ratio": 0.1}, "end"))
    problem = problem_of(campaign, beam_model)
    no_effect = try_fit(problem, NO_EFFECTS, problem.prior_mean_point(NO_EFFECTS), iterations=0)
    search = Search(problem, chosen("added_mass", "region_stiffness_loss", "gauge_gain"), no_effect)
    tried = []
    monkeypatch.setattr(search, "fit_one_more_effect", lambda fit, added: tried.append((fit, added)) or [])
    for effect in search.effects:
        candidate = Candidate((EffectTerm(effect, effect.places(problem.setting)[0]),))
        start = replace(no_effect.point, effect=candidate.start_values())
        search.record_fit(fit(problem, candidate, start, iterations=4), exact=False)
    search.fit_effects_at_several_places()
    added = {base.candidate.identifiers: {effect.identifier for effect in added} for base, added in tried}
    assert added[("added_mass",)] == {"added_mass", "region_stiffness_loss"}
    assert added.get(("gauge_gain",), {"gauge_gain"}) == {"gauge_gain"}


def test_a_mass_shows_by_its_weight_at_rest(beam_model) -> None:
    """Under the load factor one, a mass of 0.1 kg at the end moves the tip as a force of 0.981 N."""
    lifts = []
    for mass in (0.0, 0.1):
        patch = ModelPatch((PlaceMass("end", mass),))
        state = SystemState(tuple(beam_model.prior_mean().tolist()), (0.0, 0.0), patch)
        lifts.append(beam_model.lift_loads(state, NO_PATCH)[0])
    added = lifts[1] - lifts[0]
    push = beam_model.force_row("push", state)
    np.testing.assert_allclose(added, -0.981 * push, atol=1e-6 * np.abs(push).max())


def test_a_load_factor_gives_masses_weight_in_flights_alone(beam_model) -> None:
    assert beam_model.kinds_with_weight == {TrialKind.FLIGHT}


def test_a_constant_acceleration_gives_masses_weight_in_load_steps(write_beam, tmp_path) -> None:
    always = {
        '    { name = "load_factor", minimum = -4, maximum = 6 },\n': "",
        'name = "weight", control = "load_factor"': 'name = "weight"',
    }
    model = choose_model(write_beam(tmp_path, always, cells=4)).model
    assert TrialKind.STATIC in model.kinds_with_weight


def test_places_of_masses_are_sets_and_points(beam_model) -> None:
    (effect,) = chosen("added_mass")
    campaign = simulated(beam_model, "ringdown", 3)
    places = effect.places(setting_of(campaign, beam_model))
    assert "end" in places
    assert any(place.startswith("the point (") for place in places)
    assert "root" not in places  # held, so that a mass there does not move
