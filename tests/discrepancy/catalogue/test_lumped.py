"""The catalogue on lumped models: what shows, and which effects are offered where."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.tank import tank_setting
from discrepancy.campaign.records import Channel, Quantity, Start, TrialKind
from discrepancy.catalogue.library import library
from discrepancy.models.lumped import LumpedModel
from discrepancy.sources.examples import example_campaign, plan_for
from fe.runtime.patch import LoggerClock, ModelPatch
from tests.discrepancy.asking import campaign, seen, trial
from tests.discrepancy.rigs import INPUTS, chosen, model_of, setting_of

pytestmark = pytest.mark.xdist_group("compiling")

WITHOUT_STATION = {"local_stiffness_loss", "gauge_misalignment", "washout", "inertia_relief"}
OF_STORES = {"outflow", "overflow"}
WARM = {"thermal_strain", "temperature_dependent_modulus"}


def test_a_chain_is_offered_what_it_can_carry_and_its_records_can_show() -> None:
    model = LumpedModel.load("three_mass_chain")
    plan = plan_for(model, ("x3", "base_strain"), "end")
    setting = setting_of(example_campaign(model, "laboratory", 1, plan), model)
    reasons = {effect.identifier: effect.unavailable(setting) for effect in library()}
    absent = {name for name, reason in reasons.items() if reason is not None}
    assert absent == WITHOUT_STATION | OF_STORES | WARM | {"logger_clock"}
    assert all(reasons[name].endswith(".") for name in absent)


def test_flows_are_offered_at_states_and_forces_are_not() -> None:
    setting = tank_setting()
    what = setting.campaign.trials[0]
    for effect in chosen("outflow", "overflow"):
        assert effect.unavailable(setting) is None
        assert effect.places(setting) == ("outlet",)
        middle = {item.name: item.prior.value(0.0) for item in effect.parameters}
        shown = seen(setting.model, what, {"level": Quantity.LEVEL}, *effect.patch(setting, middle, "outlet"))
        assert 0.02 < np.abs(shown - what.values).max() / what.values.max() < 0.9
    (friction,) = chosen("coulomb_friction")
    assert "are of states, where flows act and no forces" in str(friction.unavailable(setting))


def test_a_port_whose_motion_goes_one_way_shows_no_memory() -> None:
    """A body that falls shows drag and no hysteresis; one that is pushed to and fro may show both."""
    model = model_of(INPUTS.text("falling_body.toml"))
    falls = trial(TrialKind.DRIVEN, np.linspace(0.0, 1.0, 101), begins=Start.STILL)
    given = campaign(falls, height=Channel("height", Quantity.DISPLACEMENT, "height", None))
    setting = setting_of(given, model)
    assert not setting.scales.ports["air"].turns
    remember = "joint_micro_slip", "bouc_wen_hysteresis", "cubic_stiffness", "free_play", "breathing_crack"
    for effect in chosen(*remember):
        assert "motion that turns" in (effect.unavailable(setting) or "")
    assert chosen("quadratic_damping")[0].unavailable(setting) is None
    still = replace(given, trials=(falls, replace(falls, name="load", kind=TrialKind.STATIC)))
    assert model.scales(still).ports["air"].turns


ALL, BOTH = {"all": ("shaker", "laser", "camera")}, {"rack": ("shaker", "laser"), "film": ("camera",)}


@pytest.mark.parametrize(
    ("loggers", "places", "motion"), [({}, ("",), True), (ALL, ("",), False), (BOTH, ("rack", "film"), True)]
)
def test_each_logger_may_have_a_wrong_clock(loggers: dict[str, Any], places: Any, motion: bool) -> None:
    model = model_of(INPUTS.text("shaken_mass.toml"))
    read = {name: Channel(name, Quantity.DISPLACEMENT, "x", None) for name in ("laser", "camera")}
    what = trial(TrialKind.FORCED, 400, channels=tuple(read), force=np.ones(400), load_place="shaker")
    shared, own = chosen("logger_clock", "clock_error")
    given = replace(campaign(what, **read), loggers=loggers)
    setting = setting_of(given, model)
    assert shared.unavailable(setting) is None
    assert shared.places(setting) == places
    assert (own.unavailable(setting) is None) is motion
    patch = shared.patch(setting, {"rate_error": 4e-3}, places[0])
    assert patch == ModelPatch((LoggerClock(places[0] or "*", 4e-3),))
