"""What stays the same during a flight: names, printed units, limits of the axes, and the asset from above."""

import json
from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path

from jinja2 import Template
from markupsafe import Markup

from twin_master.mission.preparation import Knowledge
from twin_master.report.structure import Planform, design_of, planform_of
from twin_master.report.view import (
    NORMAL_95,
    PrintedFactor,
    PrintedSensors,
    printed_factors,
    printed_sensors,
)
from twin_master.scenario.schema import REWARD_NAMES, Scenario

WINDOW = 240
"""Turns that a page shows at once."""
LATEST = -1
"""Asked for in the place of a turn: the last one, whichever it is."""
TALLEST_BAR = 0.82
"""Height of a probability of one, where a control has a row of height one."""


@dataclass(frozen=True)
class Scene:
    """What the page is made of.

    Attributes
    ----------
    scenario : Scenario
        What is flown.
    factors : tuple of PrintedFactor
        Of the state.
    sensors : PrintedSensors
        Where they have several units, as deviations from what is expected, in standard deviations of that.
    standardised : bool
        Whether they are.
    ends : (lowest, highest)
        What they can show without noise, printed.
    planform : Planform or None
        None for an asset that is no wing of this project.
    """

    scenario: Scenario
    factors: tuple[PrintedFactor, ...]
    sensors: PrintedSensors
    standardised: bool
    ends: tuple[float, float]
    planform: Planform | None


def scene_of(folder: Path, knowledge: Knowledge) -> Scene:
    """Return what stays the same during the flight in a run folder."""
    scenario, sensors = knowledge.scenario, printed_sensors(knowledge.scenario)
    shown, several = sensors.scale * knowledge.sensor_model.mean, not sensors.unit
    ends = (-NORMAL_95, NORMAL_95) if several else (float(shown.min()), float(shown.max()))
    if several:
        units = ("standard deviations",) * len(sensors.titles)
        sensors = replace(sensors, quantity="deviation", units=units, scale=1.0)
    planform = planform_of(design_of(folder), scenario)
    return Scene(scenario, printed_factors(scenario), sensors, several, ends, planform)


def page_html(scene: Scene) -> str:
    """Return the page; its script draws the figures from what it is told."""
    mission, planform = scene.scenario.mission, None
    if scene.planform is not None:
        outline, regions, gauges = scene.planform
        planform = {"outline": outline.tolist(), "gauges": gauges.tolist()}
        planform["regions"] = [region.tolist() for region in regions]
    lowest, highest = scene.ends
    sensors = {"unit": scene.sensors.unit, "lowest": lowest, "highest": highest}
    record = {
        "title": mission.title or mission.name, "step_name": mission.step_name,
        "horizon": mission.prediction_steps, "factors": [asdict(factor) for factor in scene.factors],
        "controls": scene.scenario.control_names, "rewards": REWARD_NAMES,
        "sensors": asdict(scene.sensors) | sensors, "planform": planform,
        "window": WINDOW, "latest": LATEST, "tallest_bar": TALLEST_BAR,
    }  # fmt: skip
    # Inside a script element only the beginning of a tag could end it.
    content = json.dumps(record, allow_nan=False).replace("<", "\\u003c")
    template = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    page: str = Template(template, autoescape=True).render(scene=record, content=Markup(content))
    return page
