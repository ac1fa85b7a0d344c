"""A scenario before it is flown: what it flies, what its twin believes, and what that takes.

Only the scenario and the small files beside it are read, so that the answer comes at once. What needs the
FMU or the model of the wing is checked when the run begins.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod

from twin_master.assets.resolution import Overrides, asset_source, believed_source, resolve_scenario
from twin_master.network.memory import scenario_bytes
from twin_master.scenario.reading import LoadedScenario
from twin_master.scenario.schema import WATCHED_KIND


@dataclass(frozen=True)
class ScenarioCheck:
    """What a scenario is.

    Attributes
    ----------
    name, title : str
        Of the mission.
    flown, believed : str
        What flies, and what predicts its observations, in words.
    uncertain : str
        The parameter of which the twin has draws, and where they come from.
    draws : int
        How many.
    levels : dict of str to int
        Factors of the state and their numbers of levels.
    states : int
        Number of joint states S.
    controls : tuple of str
        Names of the U controls.
    sensors : int
        Number of observed values G.
    turns, prediction_steps : int
        Steps of the mission, and how far each looks ahead.
    step_name : str
        What a step is called.
    memory : float
        Of the twin's arrays: transitions, predictions (E, S, U, G), beliefs [bytes].
    """

    name: str
    title: str
    flown: str
    believed: str
    uncertain: str
    draws: int
    levels: Mapping[str, int]
    states: int
    controls: tuple[str, ...]
    sensors: int
    turns: int
    prediction_steps: int
    step_name: str
    memory: float


def check_scenario(loaded: LoadedScenario, overrides: Overrides | None = None) -> ScenarioCheck:
    """Return what a scenario is with the overrides, once everything that it names was looked at.

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
    return ScenarioCheck(
        name=mission.name,
        title=mission.title,
        flown="nothing, a real asset is watched" if watched else origin.asset,
        believed=origin.model,
        uncertain=f"{calibration.parameter}, from {calibration.source.replace('_', ' ')}",
        draws=1 if calibration.source == "fixed" else calibration.draws,
        levels=levels,
        states=prod(levels.values()),
        controls=tuple(scenario.control_names),
        sensors=scenario.observation.count,
        turns=mission.steps,
        prediction_steps=mission.prediction_steps,
        step_name=mission.step_name,
        memory=sum(scenario_bytes(scenario).values()),
    )
