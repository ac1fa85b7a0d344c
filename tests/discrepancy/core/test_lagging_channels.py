"""A channel that shows what it should have shown earlier: a late logger, or a slow sensor."""

import numpy as np
import pytest

from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.system.response import Conditions
from discrepancy.system.sensing import observe
from discrepancy.verdict import Verdict, VerdictKind
from discrepancy.workflow import investigate
from fe.runtime.patch import LowPass, ModelPatch, Sensor, SensorLag
from tests.costs import once
from tests.discrepancy.rigs import chosen, one_mass

LAG = 0.0137
NOISE = 2e-5
TIME = np.arange(300) * 0.01
MODEL = one_mass(
    stiffness=800.0,
    damping={"matrix": 3.2},
    parameter=[
        {"name": "stiffness", "terms": "stiffness", "deviation": 0.03, "low": 0.5, "high": 1.5},
        {"name": "damping", "terms": "damping", "deviation": 0.1, "low": 0.2, "high": 3.0},
    ],
)


def shaken(sensor: Sensor) -> Campaign:
    """Return two trials under forces of many frequencies, the second held out, read by a sensor of "x"."""
    generator = np.random.default_rng(4)
    trials = []
    for name in ("first", "second"):
        frequencies = 2.0 * np.pi * generator.uniform(1.5, 5.0, 6)
        phases = generator.uniform(0.0, 2.0 * np.pi, 6)
        force = 5.0 * np.sin(TIME[:, None] * frequencies + phases).sum(axis=1) * np.minimum(1.0, TIME / 0.5)
        trials.append(
            Trial.plain(
                name,
                TrialKind.FORCED,
                ("x",),
                TIME,
                values=np.zeros((len(TIME), 1)),
                force=force,
                load_place="push",
                held_out=name == "second",
            )
        )
    channel = Channel("x", Quantity.DISPLACEMENT, "x", NoiseRecord(NOISE, 500.0))
    empty = Campaign("one mass", {"x": channel}, tuple(trials), None, {}, "0" * 64)
    conditions = Conditions(np.ones(2))
    measured = []
    for trial in trials:
        values = observe(MODEL, empty, trial, ModelPatch((sensor,)), conditions).values
        noise = NOISE * generator.standard_normal(values.shape)
        measured.append(
            Trial.plain(
                trial.name,
                trial.kind,
                trial.channels,
                TIME,
                values=values + noise,
                force=trial.force,
                load_place="push",
                held_out=trial.held_out,
            )
        )
    return Campaign("one mass", {"x": channel}, tuple(measured), None, {}, "0" * 64)


@once
def verdict_with_lag(lag: float) -> Verdict:
    """Return the verdict on a lag [s], beside damping, which delays the displacement, too.

    It delays it not by the same time at every frequency.
    """
    effects = chosen("sensor_lag", "structural_damping")
    return investigate(shaken(SensorLag("x", lag)), MODEL, effects, thorough=False).verdict


@pytest.mark.slow
def test_a_channel_that_lags_is_named():
    verdict = verdict_with_lag(LAG)
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    assert [(effect.identifier, effect.place) for effect in verdict.effects] == [("sensor_lag", "x")]


@pytest.mark.slow
def test_the_lag_of_a_channel_is_estimated():
    """In sampling intervals."""
    (effect,) = verdict_with_lag(LAG).effects
    (lag,) = effect.parameters
    assert lag.low < LAG / 0.01 < lag.high
    assert lag.high - lag.low < 0.05


@pytest.mark.slow
def test_no_lag_is_named_where_there_is_none():
    verdict = verdict_with_lag(0.0)
    assert verdict.kind is VerdictKind.NOTHING_MISSING, verdict.sentence


@pytest.mark.slow
def test_a_slow_sensor_is_named_beside_a_lag_and_damping():
    """Its low-pass delays all frequencies nearly alike, and makes fast motion smaller."""
    effects = chosen("low_pass", "sensor_lag", "high_pass", "structural_damping")
    verdict = investigate(shaken(LowPass("x", LAG)), MODEL, effects, thorough=False).verdict
    assert verdict.kind is VerdictKind.NAMED, verdict.sentence
    (effect,) = verdict.effects
    assert (effect.identifier, effect.place) == ("low_pass", "x")
    (ratio,) = effect.parameters
    # time constant times the angular frequency of 800 N/m and 2 kg
    assert ratio.low < 20.0 * LAG < ratio.high
