"""A mass at a place, and a patch of a mesh that loses stiffness, are causes that are tried."""

import pytest

from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from tests.discrepancy.rigs import chosen, setting_of, simulated

RIVALS = chosen("added_mass", "support_compliance", "region_stiffness_loss", "gauge_gain", "clock_error")
HIDDEN = {
    "added_mass": ({"mass_ratio": 0.1}, "end"),
    "region_stiffness_loss": ({"loss": 0.3}, "around (37.5, 10, 5) mm"),
}


@pytest.mark.parametrize("identifier", HIDDEN)
def test_it_is_named_at_its_place_with_its_size(beam_model, identifier: str) -> None:
    values, place = HIDDEN[identifier]
    campaign = simulated(beam_model, "laboratory", 3, (identifier, values, place))
    verdict = investigate(campaign, beam_model, RIVALS, seed=3, thorough=False).verdict
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    assert [(effect.identifier, effect.place) for effect in verdict.effects] == [(identifier, place)]
    (parameter,) = verdict.effects[0].parameters
    (value,) = values.values()
    assert parameter.low < value < parameter.high


def test_places_of_masses_are_sets_and_points(beam_model) -> None:
    (effect,) = chosen("added_mass")
    campaign = simulated(beam_model, "ringdown", 3)
    places = effect.places(setting_of(campaign, beam_model))
    assert "end" in places
    assert any(place.startswith("the point (") for place in places)
    assert "root" not in places  # held, so that a mass there does not move
