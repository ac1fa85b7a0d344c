"""Prior weights of effects by how often their kind occurs."""

from dataclasses import replace

import pytest

from discrepancy.catalogue.entry import Effect
from discrepancy.catalogue.library import check_effects, library, with_prior_weights
from discrepancy.errors import CatalogueError
from tests.discrepancy.rigs import chosen

GAUGE_FAULTS = ("gauge_gain", "gauge_misalignment", "sensor_saturation")


def weights(*effects: Effect) -> dict[str, float]:
    return {effect.identifier: effect.prior_weight for effect in with_prior_weights(effects)}


def variant(effect: Effect, event: str) -> Effect:
    return replace(effect, identifier=f"{effect.identifier}_during_{event}", variant_of=effect.identifier)


def test_kinds_have_the_ratios_of_their_frequencies():
    weight = weights(*chosen(*GAUGE_FAULTS))

    assert weight["gauge_gain"] / weight["sensor_saturation"] == pytest.approx(4.0)
    assert weight["gauge_misalignment"] == weight["sensor_saturation"]


def test_weights_of_all_effects_have_the_mean_one():
    weighted = weights(*library())

    assert sum(weighted.values()) == pytest.approx(len(library()))


def test_an_effect_without_a_stated_frequency_keeps_its_prior():
    unstated = [effect for effect in library() if effect.relative_frequency is None]

    weight = weights(*library())

    assert len(unstated) > 20
    assert all(weight[effect.identifier] == 1.0 for effect in unstated)


def test_variants_of_a_kind_share_its_prior():
    gain, saturation = chosen("gauge_gain", "sensor_saturation")
    variants = [variant(saturation, event) for event in ("gust", "landing", "turn")]

    weight = weights(gain, saturation, *variants)

    of_saturation = [weight[effect.identifier] for effect in (saturation, *variants)]
    assert of_saturation == [of_saturation[0]] * 4
    assert weight["gauge_gain"] == pytest.approx(4.0 * sum(of_saturation))


@pytest.mark.parametrize("frequency", [0.0, -1.0])
def test_a_frequency_that_is_not_positive_is_refused(frequency):
    (gain,) = chosen("gauge_gain")

    with pytest.raises(CatalogueError, match="must have a positive relative_frequency"):
        check_effects([replace(gain, relative_frequency=frequency, confusable=())])
