"""Clocks of loggers: what a wrong rate is the same as, who is on which, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.writing import write_campaign
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import effect_by_identifier, library
from discrepancy.errors import CampaignFileError, CatalogueError
from discrepancy.models.interface import Conditions
from discrepancy.models.sensing import observe
from fe.runtime.patch import Clock, LoadGain, LoggerClock, ModelPatch
from tests.discrepancy.rigs import model_of
from tests.refusals import Inputs

INPUTS = Inputs(__file__)
MODEL = model_of(INPUTS.text("shaken_mass.toml"))
BOTH = 'rack = ["shaker", "laser"], film = ["camera"]'
RATE = 4e-3


@pytest.fixture
def make(tmp_path: Path):
    """A maker of the campaign of a swept force, seen by a laser and a camera, with loggers."""

    def read(loggers: str = ""):
        time = np.arange(0.0, 4.0, 0.01)
        rows = np.stack((time, np.sin(9 * time**1.3), time, time), axis=1).tolist()
        lines = ["time,shaker,laser,camera", *(",".join(map(repr, row)) for row in rows)]
        (tmp_path / "swept.csv").write_text("\n".join(lines) + "\n")
        said = f"loggers = {{ {loggers} }}" if loggers else ""
        (tmp_path / "campaign.toml").write_text(INPUTS.text("campaign.toml", ("@", said)))
        return read_campaign(tmp_path)

    return read


def shown(campaign, *changes, at=(1.0, 1.0), trial=None):
    conditions = Conditions(np.array(at))
    return observe(MODEL, campaign, trial or campaign.trials[0], ModelPatch(changes), conditions).values


def test_one_clock_is_a_stiffer_rig_under_a_larger_load(make) -> None:
    campaign, square = make(), (1.0 + RATE) ** 2
    found = shown(campaign, LoggerClock("*", RATE))
    alias = shown(campaign, LoadGain(square - 1.0, 0.0), at=(square, 1.0 + RATE))
    np.testing.assert_allclose(found, alias, atol=1e-9 * np.abs(alias).max())
    motion = shown(campaign, Clock(RATE, 0.0))
    assert np.abs(found - motion).max() > 0.05 * np.abs(alias).max()


def test_each_logger_has_its_own(make, tmp_path: Path) -> None:
    campaign = make(BOTH)
    film, rack, one = (shown(campaign, LoggerClock(name, RATE)) for name in ("film", "rack", "*"))
    np.testing.assert_array_equal(film[:, 0], shown(campaign)[:, 0])
    np.testing.assert_array_equal(film[:, 1], shown(campaign, Clock(RATE, 0.0))[:, 1])
    np.testing.assert_allclose(rack[:, 0], one[:, 0], atol=1e-12)
    # the camera sees the stretched motion at its own, right times
    stretched = replace(campaign.trials[0], time=(1.0 + RATE) * campaign.trials[0].time)
    true = shown(campaign, Clock(1.0 / (1.0 + RATE) - 1.0, 0.0), trial=stretched)
    np.testing.assert_allclose(rack[:, 1], true[:, 1], atol=1e-12)
    with pytest.raises(CatalogueError, match="no logger 'tape'; it has 'rack', 'film'"):
        shown(campaign, LoggerClock("tape", RATE))
    (tmp_path / "again").mkdir()
    assert read_campaign(write_campaign(campaign, tmp_path / "again")).loggers == campaign.loggers


@pytest.mark.parametrize(
    ("loggers", "places", "motion"),
    [
        ("", ("",), True),
        ('all = ["shaker", "laser", "camera"]', ("",), False),
        (BOTH, ("rack", "film"), True),
    ],
)
def test_what_is_offered(make, loggers: str, places: tuple[str, ...], motion: bool) -> None:
    shared, own = (effect_by_identifier(name, library()) for name in ("logger_clock", "clock_error"))
    campaign = make(loggers)
    setting = Setting(campaign, MODEL, MODEL.scales(campaign))
    assert shared.unavailable(setting) is None
    assert shared.places(setting) == places
    assert (own.unavailable(setting) is None) is motion
    patch = shared.patch(setting, {"rate_error": RATE}, places[0])
    assert patch == ModelPatch((LoggerClock(places[0] or "*", RATE),))


@pytest.mark.parametrize(
    ("loggers", "sentence"),
    [
        ('a = ["laser", "camera"]', "'shaker' must be on one of the `loggers`, and it is on none"),
        (
            'a = ["laser", "shaker"], b = ["laser", "camera"]',
            "'laser' must be on one .* it is on more than one",
        ),
        ('a = ["laser", "wire"]', "`loggers` names 'wire', but the channels and inputs are laser, camera"),
    ],
)
def test_wrong_loggers_are_named(make, loggers: str, sentence: str) -> None:
    with pytest.raises(CampaignFileError, match=sentence):
        make(loggers)
