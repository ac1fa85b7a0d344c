"""A scenario before it is flown: what it flies, what its twin believes, and what that takes.

Only the scenario and the small files beside it are read, so that the answer comes at once. What needs the
FMU or the model of the wing is checked when the run begins.
"""

from math import prod
from typing import Any

from twin_master.assets.resolution import Overrides, asset_source, believed_source, resolve_scenario
from twin_master.network.memory import scenario_bytes
from twin_master.scenario.reading import LoadedScenario
from twin_master.scenario.schema import WATCHED_KIND


def check_scenario(loaded: LoadedScenario, overrides: Overrides | None = None) -> dict[str, Any]:
    """Return what a scenario is with the overrides, once everything that it names was looked at.

    Beside what it flies and believes, in words, these are the sizes of the twin: `levels` of each factor,
    joint `states`, `controls`, `sensors`, and the `memory` of all its arrays [bytes].

    Raises
    ------
    MissionInputError
        A file is missing, or a name of the scenario is none of its binding's.
    InvalidModelError
        The twin does not fit in memory.
    BindingError, InvalidDesignError, DesignFileError
        The binding or the design is wrong.
    """
    scenario = resolve_scenario(loaded, overrides or Overrides())
    watched = scenario.asset.kind == WATCHED_KIND
    source = believed_source(scenario) if watched else asset_source(scenario)
    source.check()
    origin, mission, calibration = source.origin, scenario.mission, scenario.calibration
    levels = {factor.name: len(factor.levels) for factor in scenario.state}
    return {
        "name": mission.name,
        "title": mission.title,
        "flown": "nothing, a real asset is watched" if watched else origin.asset,
        "believed": origin.model,
        "uncertain": f"{calibration.parameter}, from {calibration.source.replace('_', ' ')}",
        "draws": 1 if calibration.source == "fixed" else calibration.draws,
        "levels": levels,
        "states": prod(levels.values()),
        "controls": scenario.control_names,
        "sensors": scenario.observation.count,
        "turns": mission.steps,
        "prediction_steps": mission.prediction_steps,
        "step_name": mission.step_name,
        "memory": sum(scenario_bytes(scenario).values()),
    }
