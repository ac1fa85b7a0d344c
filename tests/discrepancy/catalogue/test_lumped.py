"""The catalogue on the lumped models that come with the package."""

from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest

from benchmarks.cantilever import campaign
from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Channel, NoiseRecord, Quantity
from discrepancy.catalogue.library import library
from discrepancy.models.interface import Conditions
from discrepancy.models.lumped import LumpedModel
from discrepancy.models.sensing import observe
from fe.runtime.patch import ModelPatch
from tests.discrepancy.rigs import setting_of

pytestmark = pytest.mark.xdist_group("compiling")

OUTPUTS = {"tip": ("x3", Quantity.DISPLACEMENT), "g0": ("base_strain", Quantity.STRAIN)}


@pytest.fixture(scope="module")
def setting():
    model = LumpedModel.load(str(files("discrepancy.lumped_models") / "three_mass_chain.toml"))
    given = campaign()
    noise = NoiseRecord(1e-6, 200.0)
    channels = {
        name: Channel(name, quantity, output, noise, 0.005, 1e-5)
        for name, (output, quantity) in OUTPUTS.items()
    }
    trials = tuple(
        replace(
            trial,
            channels=tuple(OUTPUTS),
            values=np.zeros((len(trial.time), 2)),
            load_place="end",
            used=np.ones((len(trial.time), 2), dtype=bool),
            release=Release(0.01) if trial.release else None,
        )
        for trial in given.trials
        if trial.name != "flight"
    )
    chain = replace(given, channels=channels, trials=trials)
    means = np.array([item.mean for item in model.parameters])
    for trial in trials:
        trial.values[:] = observe(model, chain, trial, ModelPatch(), Conditions(means)).values
    return setting_of(chain, model)


ABSENT = ("local_stiffness_loss", "gauge_misalignment", "washout", "inertia_relief", "outflow", "overflow")


@pytest.mark.parametrize("effect", library(), ids=lambda effect: effect.identifier)
def test_an_effect_that_is_available_shows_and_another_says_why(effect, setting):
    reason = effect.unavailable(setting)
    model = setting.model
    if effect.identifier in ABSENT:
        assert reason.endswith(".")
        return
    assert reason is None
    means = np.array([item.mean for item in model.parameters])
    values = {item.name: item.prior.value(0.0) or item.prior.value(1.0) for item in effect.parameters}
    for place in effect.places(setting):
        patch = effect.patch(setting, values, place)
        changes = []
        for trial in setting.campaign.trials:
            moved = observe(model, setting.campaign, trial, patch, Conditions(means)).values - trial.values
            changes.append(np.max(np.abs(moved) / np.max(np.abs(trial.values), axis=0)))
        assert max(changes) > 1e-3, place
