"""What would show an effect that a campaign does not show: less noise, or closer stated values."""

from dataclasses import replace
from math import isinf, sqrt

import pytest

from discrepancy.judgement.noise_forecast import LARGEST_NOISE_REDUCTION
from discrepancy.judgement.separability import DETECTION_DISTANCE, compute_separability
from discrepancy.report.decidability_text import campaign_needs
from tests.discrepancy.rigs import chosen, setting_of, simulated

EFFECTS = chosen("region_stiffness_loss")


def with_noise_and_gains(campaign, noise_factor, gain_deviation):
    """Return a campaign with noise deviations times a factor, and gains stated to a deviation."""
    channels = {}
    for name, channel in campaign.channels.items():
        noise = replace(
            channel.noise, standard_deviation=noise_factor * channel.noise.standard_deviation, samples=None
        )
        channels[name] = replace(channel, noise=noise, gain_deviation=gain_deviation)
    return replace(campaign, channels=channels)


def detectability_of_loss(campaign, beam_model):
    separability = compute_separability(campaign, beam_model, setting_of(campaign, beam_model), EFFECTS)
    (row,) = separability.detectability
    told = [
        line
        for line in campaign_needs(separability, campaign, EFFECTS, beam_model.kinds)
        if "would not be detectable" in line
    ]
    return row, told


NOISE_AND_GAINS = pytest.mark.parametrize(("gain_deviation", "noise_factor"), [(0.005, 100.0), (0.02, 45.0)])
"""Also where stated gains hide a part of the effect: half the noise is not four times the distance."""


@pytest.fixture(scope="module")
def campaign(beam_model):
    return simulated(beam_model, "static", 3)


@NOISE_AND_GAINS
def test_the_noise_with_which_an_effect_would_be_seen_is_told(
    gain_deviation, noise_factor, campaign, beam_model
):
    noisy = with_noise_and_gains(campaign, noise_factor, gain_deviation)
    row, (told,) = detectability_of_loss(noisy, beam_model)
    assert row.distance < DETECTION_DISTANCE
    assert row.noise_factor >= sqrt(DETECTION_DISTANCE / row.distance)
    assert f"with noise {row.noise_factor:.2g} times smaller" in told


@NOISE_AND_GAINS
def test_with_the_forecast_noise_the_effect_is_just_seen(gain_deviation, noise_factor, campaign, beam_model):
    noisy = with_noise_and_gains(campaign, noise_factor, gain_deviation)
    row, _ = detectability_of_loss(noisy, beam_model)
    forecast = with_noise_and_gains(campaign, noise_factor / row.noise_factor, gain_deviation)
    row_of_forecast, _ = detectability_of_loss(forecast, beam_model)
    # with less noise the distance is that of a smaller change, and the loss is not quite linear
    assert row_of_forecast.distance == pytest.approx(DETECTION_DISTANCE, rel=0.1)


HIDING_GAIN = 0.12
"""A standard deviation of stated gains in which the loss hides."""


@pytest.fixture(scope="module")
def hidden_by_gains(campaign, beam_model):
    """The detectability of a loss that hides in stated gains, and the sentence about it."""
    row, (told,) = detectability_of_loss(with_noise_and_gains(campaign, 1.0, HIDING_GAIN), beam_model)
    return row, told


def test_where_stated_gains_hide_an_effect_less_noise_is_not_promised(hidden_by_gains):
    row, told = hidden_by_gains
    assert isinf(row.noise_factor)
    assert "less noise or more trials would not help" in told
    assert "times smaller" not in told


def test_the_gains_that_hide_an_effect_are_told(hidden_by_gains):
    row, told = hidden_by_gains
    assert any(name.startswith("the gain of g3 (stated to 12 %)") for name in row.imitated_by)
    assert all(name in told for name in row.imitated_by)


def test_an_effect_that_gains_hide_shows_with_closer_gains_and_not_with_less_noise(campaign, beam_model):
    quiet = with_noise_and_gains(campaign, 1.0 / LARGEST_NOISE_REDUCTION, HIDING_GAIN)
    calibrated = with_noise_and_gains(campaign, 1.0, 0.005)
    assert detectability_of_loss(quiet, beam_model)[0].distance < DETECTION_DISTANCE
    assert detectability_of_loss(calibrated, beam_model)[0].distance > DETECTION_DISTANCE


def test_an_effect_that_is_seen_needs_no_less_noise(beam_model):
    row, told = detectability_of_loss(
        with_noise_and_gains(simulated(beam_model, "static", 3), 1.0, 0.005), beam_model
    )
    assert row.noise_factor == 1.0
    assert told == []
