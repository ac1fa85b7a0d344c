"""What stays the same during a flight: names, printed units, limits of the axes, and the asset from above."""

from dataclasses import dataclass
from pathlib import Path

from twin_master.mission.preparation import Knowledge
from twin_master.report.structure import Planform, design_of, planform_of
from twin_master.report.view import NORMAL_95, PrintedFactor, printed_factors, printed_sensors
from twin_master.scenario.schema import REWARD_NAMES


@dataclass(frozen=True)
class Sensors:
    """The sensors, as printed.

    Attributes
    ----------
    word : str
        What one is called.
    titles : tuple of str
        Of each.
    quantity, unit : str
        What they show. Sensors of several units are shown as deviations from what is expected, in standard
        deviations of that.
    scale : float
        From the stored unit to the printed one.
    standardised : bool
        Whether they have several units.
    lowest, highest : float
        What they can show without noise, printed.
    """

    word: str
    titles: tuple[str, ...]
    quantity: str
    unit: str
    scale: float
    standardised: bool
    lowest: float
    highest: float


@dataclass(frozen=True)
class Scene:
    """What the page is made of.

    Attributes
    ----------
    title, step_name : str
        Of the mission, and what a step of it is called.
    steps : int
        Of the mission.
    horizon : int
        Steps that are predicted.
    factors : tuple of PrintedFactor
    controls, rewards : tuple of str
    sensors : Sensors
    planform : Planform or None
        None for an asset that is no wing of this project.
    """

    title: str
    step_name: str
    steps: int
    horizon: int
    factors: tuple[PrintedFactor, ...]
    controls: tuple[str, ...]
    rewards: tuple[str, ...]
    sensors: Sensors
    planform: Planform | None


def scene_of(folder: Path, knowledge: Knowledge) -> Scene:
    """Return what stays the same during the flight in a run folder."""
    scenario = knowledge.scenario
    mission = scenario.mission
    return Scene(
        title=mission.title or mission.name,
        step_name=mission.step_name,
        steps=mission.steps,
        horizon=mission.prediction_steps,
        factors=printed_factors(scenario),
        controls=tuple(scenario.control_names),
        rewards=REWARD_NAMES,
        sensors=_sensors(knowledge),
        planform=planform_of(design_of(folder), scenario),
    )


def _sensors(knowledge: Knowledge) -> Sensors:
    printed = printed_sensors(knowledge.scenario)
    told = (printed.word, printed.titles)
    if not printed.unit:
        return Sensors(*told, "deviation", "standard deviations", 1.0, True, -NORMAL_95, NORMAL_95)
    shown = printed.scale * knowledge.sensor_model.mean
    ends = float(shown.min()), float(shown.max())
    return Sensors(*told, printed.quantity, printed.unit, printed.scale, False, *ends)
