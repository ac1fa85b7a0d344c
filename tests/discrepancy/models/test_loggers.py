"""Clocks of loggers: what a wrong rate is the same as, who is on which, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import Campaign, Trial
from discrepancy.campaign.writing import write_campaign
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import effect_by_identifier, library
from discrepancy.errors import CampaignFileError, CatalogueError
from discrepancy.models.interface import Conditions
from discrepancy.models.lumped import LumpedModel
from discrepancy.models.sensing import observe
from fe.runtime.patch import Clock, LoadGain, LoggerClock, ModelPatch
from tests.discrepancy.rigs import model_of

MODEL = """
format = 1
name = "Mass on a spring"
mass = 2.0
stiffness = 800.0
damping = { matrix = 3.0 }
input = [{ name = "shaker", vector = 1.0 }]
output = [{ name = "x", vector = 1.0 }]
parameter = [
  { name = "stiffness", terms = "stiffness", deviation = 0.1, low = 0.5, high = 2.0 },
  { name = "damping", terms = "damping", deviation = 0.1, low = 0.5, high = 2.0 },
]
"""
TOML = """
format = 1
name = "On a shaker"
@
input = [{ name = "shaker", quantity = "force", unit = "N" }]
trial = [{ name = "swept", kind = "driven", file = "swept.csv", begins = "still" }]
[[channel]]
name = "laser"
quantity = "displacement"
unit = "mm"
output = "x"
noise = { standard_deviation = 0.01 }
[[channel]]
name = "camera"
quantity = "displacement"
unit = "mm"
output = "x"
noise = { standard_deviation = 0.02 }
"""
BOTH = 'loggers = { rack = ["shaker", "laser"], film = ["camera"] }'
RATE = 4e-3


def campaign_of(folder: Path, loggers: str = "") -> Campaign:
    time = np.arange(0.0, 4.0, 0.01)
    rows = [
        f"{t!r},{f!r},{t!r},{t!r}" for t, f in zip(time.tolist(), np.sin(9 * time**1.3).tolist(), strict=True)
    ]
    (folder / "swept.csv").write_text("time,shaker,laser,camera\n" + "\n".join(rows) + "\n")
    (folder / "campaign.toml").write_text(TOML.replace("@", loggers))
    return read_campaign(folder)


@pytest.fixture(scope="module")
def model() -> LumpedModel:
    return model_of(MODEL)


def shown(model: LumpedModel, campaign: Campaign, *changes, at=(1.0, 1.0), trial: Trial | None = None):  # type: ignore[no-untyped-def]
    conditions = Conditions(np.array(at))
    return observe(model, campaign, trial or campaign.trials[0], ModelPatch(changes), conditions).values


def test_one_clock_is_a_stiffer_rig_under_a_larger_load(model: LumpedModel, tmp_path: Path) -> None:
    campaign = campaign_of(tmp_path)
    square = (1.0 + RATE) ** 2
    found = shown(model, campaign, LoggerClock("*", RATE))
    alias = shown(model, campaign, LoadGain(square - 1.0, 0.0), at=(square, 1.0 + RATE))
    np.testing.assert_allclose(found, alias, atol=1e-9 * np.abs(alias).max())
    motion = shown(model, campaign, Clock(RATE, 0.0))
    assert np.abs(found - motion).max() > 0.05 * np.abs(alias).max()


def test_each_logger_has_its_own(model: LumpedModel, tmp_path: Path) -> None:
    campaign = campaign_of(tmp_path, BOTH)
    right = shown(model, campaign)
    film = shown(model, campaign, LoggerClock("film", RATE))
    np.testing.assert_array_equal(film[:, 0], right[:, 0])
    late = shown(model, campaign, Clock(RATE, 0.0))
    np.testing.assert_array_equal(film[:, 1], late[:, 1])
    rack = shown(model, campaign, LoggerClock("rack", RATE))
    one = shown(model, campaign, LoggerClock("*", RATE))
    np.testing.assert_allclose(rack[:, 0], one[:, 0], atol=1e-12)
    # the camera sees the stretched motion at its own, right times
    stretched = replace(campaign.trials[0], time=(1.0 + RATE) * campaign.trials[0].time)
    true = shown(model, campaign, Clock(1.0 / (1.0 + RATE) - 1.0, 0.0), trial=stretched)
    np.testing.assert_allclose(rack[:, 1], true[:, 1], atol=1e-12)
    with pytest.raises(CatalogueError, match="no logger 'tape'; it has 'rack', 'film'"):
        shown(model, campaign, LoggerClock("tape", RATE))
    (tmp_path / "again").mkdir()
    assert read_campaign(write_campaign(campaign, tmp_path / "again")).loggers == campaign.loggers


def test_what_is_offered(model: LumpedModel, tmp_path: Path) -> None:
    shared, own = (effect_by_identifier(name, library()) for name in ("logger_clock", "clock_error"))
    one = 'loggers = { all = ["shaker", "laser", "camera"] }'
    for loggers, places, motion in (("", ("",), True), (one, ("",), False), (BOTH, ("rack", "film"), True)):
        campaign = campaign_of(tmp_path, loggers)
        setting = Setting(campaign, model, model.scales(campaign))
        assert shared.unavailable(setting) is None
        assert shared.places(setting) == places
        assert (own.unavailable(setting) is None) is motion
        name = places[0] or "*"
        assert shared.patch(setting, {"rate_error": RATE}, places[0]) == ModelPatch(
            (LoggerClock(name, RATE),)
        )


@pytest.mark.parametrize(
    ("loggers", "sentence"),
    [
        ('a = ["laser", "camera"]', "'shaker' must be on one of the `loggers`, and it is on none"),
        ('a = ["laser", "shaker"], b = ["laser", "camera"]',
         "'laser' must be on one .* it is on more than one"),
        ('a = ["laser", "wire"]', "`loggers` names 'wire', but the channels and inputs are laser, camera"),
    ],
)  # fmt: skip
def test_wrong_loggers_are_named(tmp_path: Path, loggers: str, sentence: str) -> None:
    with pytest.raises(CampaignFileError, match=sentence):
        campaign_of(tmp_path, f"loggers = {{ {loggers} }}")
