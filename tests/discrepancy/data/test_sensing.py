"""Observation of a trial: response of a model seen through the sensors of a patch."""

import numpy as np
import pytest

from discrepancy.campaign.records import Campaign, Channel, Quantity, Release, Trial, TrialKind
from discrepancy.errors import CatalogueError
from discrepancy.models.interface import Conditions
from discrepancy.models.sensing import observe
from fe.runtime.patch import (
    Clock,
    DecayingLine,
    HighPass,
    ModelPatch,
    SensorDrift,
    SensorGain,
    SensorRotation,
)

CONDITIONS = Conditions(np.array([1.0]))


@pytest.fixture(scope="module")
def campaign():
    channels = {
        "tip": Channel("tip", Quantity.DISPLACEMENT, "x", None),
        "g0": Channel("g0", Quantity.STRAIN, "strain[0]", None),
        "g1": Channel("g1", Quantity.STRAIN, "strain[1]", None),
    }
    time = np.arange(200) * 0.005

    def trial(name, kind, names, **more):
        usual = {"load_place": "x", "start": 60.0, "run": "A"}
        return Trial.plain(name, kind, names, more.pop("time", time), **(usual | more))

    trials = (
        trial("ring", TrialKind.RINGDOWN, ("g1", "tip"), release=Release(0.05)),
        trial("push", TrialKind.FORCED, ("tip", "g0"), force=np.sin(20 * time)),
        trial("pull", TrialKind.STATIC, ("g0",), force=np.linspace(0, 10, 200)),
    )
    return Campaign("mass", channels, trials, 20.0, {}, "")


def test_without_sensors_it_is_the_response_to_the_last_bit(oscillator, campaign):
    for trial in campaign.trials:
        outputs = tuple((campaign.channels[c].output, campaign.channels[c].quantity) for c in trial.channels)
        response = oscillator.respond(trial, outputs, ModelPatch(), CONDITIONS)
        observed = observe(oscillator, campaign, trial, ModelPatch(), CONDITIONS)
        assert np.array_equal(observed.values, response.values)
        assert (observed.rates is None) == (not trial.is_dynamic)


def test_clock_of_patch_and_conditions_add_up(oscillator, campaign):
    ring = campaign.trials[0]
    one, other, plain = (
        observe(oscillator, campaign, ring, ModelPatch(patch), Conditions(np.ones(1), clock=clock)).values
        for patch, clock in (
            ((Clock(0.004, 0.001),), (0.001, 0.002)), ((), (0.005, 0.003)), ((), (0.0, 0.0)),
        )
    )  # fmt: skip
    assert one == pytest.approx(other, rel=1e-12)
    assert np.abs(one - plain).max() > 1e-5


def test_rates_are_derivatives(oscillator, campaign):
    patch = ModelPatch((SensorGain("*", 0.1), SensorDrift("tip", 0.01, 60.0, 1.5), HighPass("*", 0.2)))
    for trial in campaign.trials[:2]:
        observed = observe(oscillator, campaign, trial, patch, CONDITIONS)
        difference = (observed.values[2:] - observed.values[:-2]) / 0.01
        scale = np.abs(difference).max(axis=0)
        assert np.abs(observed.rates[1:-1] - difference).max(axis=0) / scale == pytest.approx(0.0, abs=0.02)


def test_turned_gauge_asks_for_components(oscillator, campaign):
    pull = campaign.trials[2]
    angle = 0.2
    observed = observe(oscillator, campaign, pull, ModelPatch((SensorRotation("g0", angle),)), CONDITIONS)
    c, s = np.cos(angle), np.sin(angle)
    expected = pull.force / 400.0 * (1e-2 * c**2 - 0.3e-2 * s**2 + 0.2e-2 * s * c)
    assert observed.values[:, 0] == pytest.approx(expected)


def test_decaying_line_scales_with_the_release(oscillator, campaign):
    ring = campaign.trials[0]
    patch = ModelPatch((DecayingLine("tip", 7.0, 0.01, 0.2, 0.0),))

    def added(conditions):
        seen = observe(oscillator, campaign, ring, patch, conditions).values
        return float((seen - observe(oscillator, campaign, ring, ModelPatch(), conditions).values)[0, 1])

    assert added(CONDITIONS) == pytest.approx(0.2 * 0.05)
    assert added(Conditions(np.ones(1), np.array([[0.1, 0.0]]))) == pytest.approx(0.2 * 0.05 * 1.1)


def test_channel_of_another_trial_changes_nothing_and_one_of_none_is_refused(oscillator, campaign):
    ring = campaign.trials[0]
    plain = observe(oscillator, campaign, ring, ModelPatch(), CONDITIONS).values
    other = observe(oscillator, campaign, ring, ModelPatch((SensorGain("g0", 0.2),)), CONDITIONS).values
    assert np.array_equal(plain, other)
    with pytest.raises(
        CatalogueError, match="names the channel 'g7', which does not exist; there are tip, g0, g1"
    ):
        observe(oscillator, campaign, ring, ModelPatch((SensorGain("g7", 0.2),)), CONDITIONS)
