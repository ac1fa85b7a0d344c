"""A force that leans, and a gauge that is turned, are causes that are tried on a structure."""

import pytest

from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from tests.discrepancy.rigs import chosen, setting_of, simulated

RIVALS = chosen("load_direction", "load_cell", "gauge_gain", "gauge_misalignment")


def test_a_gauge_that_is_turned_is_named(beam_model) -> None:
    """Beside a gain error, which a campaign with one load cannot tell apart from it."""
    hidden = ("gauge_misalignment", {"angle": 0.25}, "g1")
    campaign = simulated(beam_model, "static", 3, hidden)
    verdict = investigate(campaign, beam_model, RIVALS, seed=3, thorough=False).verdict
    assert verdict.kind in (VerdictKind.NAMED, VerdictKind.GROUP), verdict.sentence
    named = {(effect.identifier, effect.place) for effect in verdict.effects}
    assert ("gauge_misalignment", "g1") in named


def test_a_gauge_beside_its_place_is_named_with_its_distance(beam_model) -> None:
    """A load along the beam and one across tell it from a wrong gain: their strains fall otherwise."""
    values, place = {"offset_ratio": 0.04}, "g1, shifted along"
    campaign = simulated(beam_model, "laboratory", 3, ("gauge_offset", values, place))
    rivals = chosen("gauge_offset", "gauge_gain", "load_cell")
    verdict = investigate(campaign, beam_model, rivals, seed=3, thorough=False).verdict
    assert verdict.kind in (VerdictKind.NAMED, VerdictKind.GROUP), verdict.sentence
    offsets = [effect for effect in verdict.effects if effect.identifier == "gauge_offset"]
    assert place in [effect.place for effect in offsets]


def test_a_force_may_lean_towards_the_axes_across_it(beam_model) -> None:
    (effect,) = chosen("load_direction")
    campaign = simulated(beam_model, "static", 3)
    places = effect.places(setting_of(campaign, beam_model))
    assert places == ("push, towards x", "push, towards y")


def test_a_force_on_a_set_has_no_point_to_be_beside(beam_model) -> None:
    (effect,) = chosen("load_offset")
    campaign = simulated(beam_model, "static", 3)
    assert effect.places(setting_of(campaign, beam_model)) == ()
    reason = effect.unavailable(setting_of(campaign, beam_model))
    assert reason == "The model says no place of a load that could be wrong."


@pytest.mark.parametrize("identifier", ["load_place", "point_mass", "local_stiffness_loss"])
def test_effects_of_wings_have_counterparts(identifier: str) -> None:
    (effect,) = chosen(identifier)
    (counterpart,) = chosen(effect.counterpart)
    assert counterpart.counterpart == identifier
