"""Observation of a trial: what a model answers, seen through the sensors of a patch."""

import numpy as np
import pytest

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Campaign, Channel, Quantity, Trial, TrialKind
from discrepancy.errors import CatalogueError
from discrepancy.models.interface import ACROSS, Conditions
from discrepancy.models.sensing import observe
from fe.runtime.patch import Clock, DecayingLine, ModelPatch, SensorGain, SensorRotation

TIME = 0.005 * np.arange(200)
TRIALS = tuple(
    Trial.plain(name, kind, names, TIME, load_place="x", start=60.0, run="A", **more)
    for name, kind, names, more in (
        ("ring", TrialKind.RINGDOWN, ("g1", "tip"), {"release": Release(0.05)}),
        ("pull", TrialKind.STATIC, ("g0",), {"force": np.linspace(0, 10, 200)}),
    )
)
RING, PULL = TRIALS
CHANNELS = {
    "tip": Channel("tip", Quantity.DISPLACEMENT, "tip_displacement", None),
    "g0": Channel("g0", Quantity.STRAIN, "strain[0]", None),
    "g1": Channel("g1", Quantity.STRAIN, "strain[1]", None),
}
CAMPAIGN = Campaign("mass", CHANNELS, TRIALS, 20.0, {}, "")


def test_observations_are_responses_through_the_sensors_of_a_patch(cantilever):
    def seen(trial, *items, **conditions):
        given = Conditions(np.ones(1), **conditions)
        return observe(cantilever, CAMPAIGN, trial, ModelPatch(items), given)

    for trial in TRIALS:
        outputs = tuple((CHANNELS[name].output, CHANNELS[name].quantity) for name in trial.channels)
        response = cantilever.respond(trial, outputs, ModelPatch(), Conditions(np.ones(1)))
        assert np.array_equal(seen(trial).values, response.values)
        assert (seen(trial).rates is None) == (not trial.is_dynamic)
    plain = seen(RING).values
    # clocks of patch and conditions add up
    one = seen(RING, Clock(0.004, 0.001), clock=(0.001, 0.002)).values
    assert one == pytest.approx(seen(RING, clock=(0.005, 0.003)).values, rel=1e-12)
    assert np.abs(one - plain).max() > 1e-5
    # a turned gauge asks for components
    c, s = np.cos(0.2), np.sin(0.2)
    parts = tuple((f"strain[0]{part}", Quantity.STRAIN) for part in ("", *ACROSS))
    strains = cantilever.respond(PULL, parts, ModelPatch(), Conditions(np.ones(1))).values
    assert np.abs(strains[-1]).min() > 1e-6
    expected = strains @ [c**2, s**2, s * c]
    assert seen(PULL, SensorRotation("g0", 0.2)).values[:, 0] == pytest.approx(expected)
    # a decaying line scales with the release
    for initial in (np.zeros((0, 2)), np.array([[0.1, 0.0]])):
        values = [seen(RING, *items, initial=initial).values for items in ((), (LINE,))]
        assert (values[1] - values[0])[0, 1] == pytest.approx(0.2 * 0.05 * (1.0 + initial[:, 0].sum()))
    # a channel of another trial changes nothing, one of none is refused
    assert np.array_equal(plain, seen(RING, SensorGain("g0", 0.2)).values)
    with pytest.raises(CatalogueError, match="'g7', which does not exist; there are tip, g0, g1"):
        seen(RING, SensorGain("g7", 0.2))


LINE = DecayingLine("tip", 7.0, 0.01, 0.2, 0.0)
