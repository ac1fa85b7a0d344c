"""The shipped mission of the pump, cut down to what can be enumerated."""

from __future__ import annotations

import tomllib
from typing import Any

from scenarios import scenario_files
from twin_master.scenario.reading import LoadedScenario, parse_scenario

PATH = scenario_files()["pump_wear"]


def pump_table() -> dict[str, Any]:
    """Return the small mission: five shifts, 3 x 2 levels, four draws, and sensors that fail."""
    table = tomllib.loads(PATH.read_text(encoding="utf-8"))
    table["mission"] |= {"steps": 5, "prediction_steps": 3}
    table["state"][0] |= {"levels_percent": [0, 30, 60], "prior": [1, 0, 0]}
    table["state"][1] |= {"levels_percent": [0, 60], "prior": [1, 0]}
    table["calibration"] |= {"draws": 4}
    table["asset"] |= {"isolated": False}
    table["observation"] |= {"between_levels": False}  # what is enumerated in `test_pump_oracle`
    table["truth"]["gains"] = [
        {"state": "wear", "first_step": 1, "gain_percent": 20},
        {"state": "clogging", "first_step": 3, "gain_percent": 50},
    ]
    table["truth"]["sensor_faults"] = [
        {"kind": "dropout", "sensors": [1], "first_step": 1, "last_step": 1},
        {"kind": "dropout", "sensors": "all", "first_step": 2, "last_step": 2},
    ]
    return table


def small_pump(**asset: Any) -> LoadedScenario:
    """Return the small mission, with changes of its asset."""
    table = pump_table()
    table["asset"] |= asset
    return LoadedScenario(parse_scenario(table, "small_pump"), PATH, "0" * 64)
