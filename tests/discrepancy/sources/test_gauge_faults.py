"""Faults of gauges in a flight: the group of hypotheses keeps the true one, however long the flight."""

from pathlib import Path

import pytest

from benchmarks.studies.hidden_effects import fly_mission
from discrepancy.sources.from_run import run_campaign, run_model
from discrepancy.verdict import Verdict
from discrepancy.workflow import investigate
from fe.runtime.patch import Primitive, SensorDrift, SensorGain, SensorSaturation
from tests.discrepancy.rigs import chosen

pytestmark = [pytest.mark.xdist_group("wing"), pytest.mark.long]

STEPS = 28
SEEDS = [2021, 2022, 2023]
GAUGE_FAULTS = ("gauge_gain", "gauge_misalignment", "gauge_zero_drift", "sensor_saturation")


def verdict_on_flight(folder: Path, seed: int, fault: Primitive) -> Verdict:
    fly_mission(folder, seed, (fault,), scenario="level_turns", steps=STEPS)
    effects = chosen(*GAUGE_FAULTS)
    return investigate(run_campaign(folder), run_model(folder)[0], effects, thorough=False).verdict


@pytest.mark.parametrize("seed", SEEDS)
def test_a_gauge_that_shows_too_little_has_a_wrong_gain_first_of_all(tmp_path, seed):
    verdict = verdict_on_flight(tmp_path / "run", seed, SensorGain("strain[17]", -0.12))

    first = verdict.effects[0]
    assert (first.identifier, first.place) == ("gauge_gain", "g17")


@pytest.mark.parametrize("seed", SEEDS)
def test_a_gauge_with_an_offset_that_grows_has_a_drifting_zero_first_of_all(tmp_path, seed):
    """By 600 microstrain over the flight, where single readings scatter by 150."""
    drift = SensorDrift("strain[17]", 6e-4, time=float(STEPS))
    verdict = verdict_on_flight(tmp_path / "run", seed, drift)

    first = verdict.effects[0]
    assert (first.identifier, first.place) == ("gauge_zero_drift", "g17")


@pytest.mark.parametrize("seed", SEEDS)
def test_gauges_that_all_saturate_are_found_to_saturate(tmp_path, seed):
    verdict = verdict_on_flight(tmp_path / "run", seed, SensorSaturation("*", 4e-3, "strain"))

    first = verdict.effects[0]
    assert (first.identifier, first.place) == ("sensor_saturation", "all strain")
