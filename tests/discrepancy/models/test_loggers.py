"""Clocks of loggers: what a wrong rate is the same as."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from discrepancy.campaign.records import Campaign, Channel, Quantity, RecordedInput, Start, Trial, TrialKind
from discrepancy.errors import CatalogueError
from discrepancy.models.interface import Conditions
from discrepancy.models.sensing import observe
from fe.runtime.patch import Clock, LoadGain, LoggerClock, ModelPatch, Primitive
from tests.discrepancy.asking import FloatArray, campaign, trial
from tests.discrepancy.rigs import INPUTS, model_of

MODEL = model_of(INPUTS.text("shaken_mass.toml"))
TIME = np.arange(0.0, 4.0, 0.01)
SWEEP = RecordedInput("shaker", Quantity.FORCE, np.sin(9 * TIME**1.3))
SEEN = {name: Channel(name, Quantity.DISPLACEMENT, "x", None) for name in ("laser", "camera")}
SWEPT = trial(TrialKind.DRIVEN, TIME, channels=tuple(SEEN), inputs=(SWEEP,), begins=Start.STILL)
BOTH = {"rack": ("shaker", "laser"), "film": ("camera",)}
RATE = 4e-3


def with_loggers(loggers: dict[str, tuple[str, ...]]) -> Campaign:
    return replace(campaign(SWEPT, **SEEN), loggers=loggers)


def shown(given: Campaign, *changes: Primitive, at: Any = (1.0, 1.0), what: Trial = SWEPT) -> FloatArray:
    return observe(MODEL, given, what, ModelPatch(changes), Conditions(np.array(at))).values


def test_one_clock_is_a_stiffer_rig_under_a_larger_load() -> None:
    given, square = with_loggers({}), (1.0 + RATE) ** 2
    found = shown(given, LoggerClock("*", RATE))
    alias = shown(given, LoadGain(square - 1.0, 0.0), at=(square, 1.0 + RATE))
    np.testing.assert_allclose(found, alias, atol=1e-9 * np.abs(alias).max())
    motion = shown(given, Clock(RATE, 0.0))
    assert np.abs(found - motion).max() > 0.05 * np.abs(alias).max()


def test_each_logger_has_its_own() -> None:
    given = with_loggers(BOTH)
    film, rack, one = (shown(given, LoggerClock(name, RATE)) for name in ("film", "rack", "*"))
    np.testing.assert_array_equal(film[:, 0], shown(given)[:, 0])
    np.testing.assert_array_equal(film[:, 1], shown(given, Clock(RATE, 0.0))[:, 1])
    np.testing.assert_allclose(rack[:, 0], one[:, 0], atol=1e-12)
    # the camera sees the stretched motion at its own, right times
    stretched = replace(SWEPT, time=(1.0 + RATE) * TIME)
    true = shown(given, Clock(1.0 / (1.0 + RATE) - 1.0, 0.0), what=stretched)
    np.testing.assert_allclose(rack[:, 1], true[:, 1], atol=1e-12)
    with pytest.raises(CatalogueError, match="no logger 'tape'; it has 'rack', 'film'"):
        shown(given, LoggerClock("tape", RATE))
