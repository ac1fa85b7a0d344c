"""A tank that is filled and drains, as a setting for the pictures of flows."""

import tomllib

import numpy as np

from discrepancy.campaign.records import (
    Campaign,
    Channel,
    Hold,
    NoiseRecord,
    Quantity,
    RecordedInput,
    Start,
    Trial,
    TrialKind,
)
from discrepancy.catalogue.entry import Setting
from discrepancy.system.lumped_file import LumpedDescription
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.response import Conditions
from discrepancy.system.sensing import observe
from fe.runtime.patch import ModelPatch

MODEL = """
format = 1
name = "Tank"
capacity = 2.0
conductance = 0.05
[[input]]
name = "pump"
vector = 1.0
quantity = "flow"
[[output]]
name = "level"
vector = 1.0
quantity = "level"
[[port]]
name = "outlet"
vector = 1.0
[[parameter]]
name = "conductance_factor"
terms = "conductance"
deviation = 0.1
low = 0.1
high = 10.0
"""


def tank_setting() -> Setting:
    """Return a driven trial of a tank as it is, without noise."""
    model = LumpedModel(LumpedDescription.parse(tomllib.loads(MODEL)))
    time = np.arange(0.0, 300.0, 2.0, dtype=np.float64)
    pump = RecordedInput(
        "pump", Quantity.FLOW, np.where(np.sin(0.04 * time) > 0.0, 0.15, 0.0), Hold.ZERO_ORDER
    )
    trial = Trial.plain(
        "filled and drained", TrialKind.DRIVEN, ("level",), time, begins=Start.STILL, inputs=(pump,)
    )
    channel = Channel("level", Quantity.LEVEL, "level", NoiseRecord(0.01, np.inf))
    campaign = Campaign("Tank", {"level": channel}, (trial,), None, {}, "")
    trial.values[:] = observe(model, campaign, trial, ModelPatch(), Conditions(np.ones(1))).values
    return Setting(campaign, model, model.scales(campaign))
