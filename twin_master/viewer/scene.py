"""What stays the same during a flight: names, printed units, limits of the axes, and the asset from above."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fe.wing.design import WingDesign, load_design
from twin_master.assets.design_source import DESIGN_COPY, FLOWN_DESIGN_COPY
from twin_master.mission.preparation import Knowledge
from twin_master.report.view import capital, printed_observation, printed_state, symbol
from twin_master.scenario.schema import CALIBRATION_COPY, REWARD_NAMES, Scenario

Float = NDArray[np.float64]

NORMAL_95 = 1.959963984540054
"""Half-width of a 95 % interval of the normal distribution, in standard deviations."""


@dataclass(frozen=True)
class Factor:
    """A factor of the state, as printed.

    Attributes
    ----------
    symbol, title, unit : str
    scale : float
        From the stored unit to the printed one.
    lowest, highest : float
        Its first and last level, printed.
    """

    symbol: str
    title: str
    unit: str
    scale: float
    lowest: float
    highest: float


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
class Planform:
    """A wing from above [m]: x along the span from the root, y along the chord, positive to the front.

    Attributes
    ----------
    outline : (N, 2)
    regions : tuple of (N, 2)
        The damage regions, in the order of the state's factors.
    gauges : (G, 2)
    """

    outline: Float
    regions: tuple[Float, ...]
    gauges: Float


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
    factors : tuple of Factor
    controls, rewards : tuple of str
    sensors : Sensors
    planform : Planform or None
        None for an asset that is no wing of this project.
    """

    title: str
    step_name: str
    steps: int
    horizon: int
    factors: tuple[Factor, ...]
    controls: tuple[str, ...]
    rewards: tuple[str, ...]
    sensors: Sensors
    planform: Planform | None


def scene_of(folder: Path, knowledge: Knowledge) -> Scene:
    """Return what stays the same during the flight in a run folder."""
    scenario = knowledge.scenario
    factors = []
    for factor in scenario.state:
        scale, unit = printed_state(factor.unit)
        lowest, highest = scale * factor.levels[0], scale * factor.levels[-1]
        title = capital(factor.title or factor.name)
        factors.append(Factor(symbol(factor.name), title, unit, scale, lowest, highest))
    mission = scenario.mission
    return Scene(
        title=mission.title or mission.name,
        step_name=mission.step_name,
        steps=mission.steps,
        horizon=mission.prediction_steps,
        factors=tuple(factors),
        controls=tuple(scenario.control_names),
        rewards=REWARD_NAMES,
        sensors=_sensors(knowledge),
        planform=planform_of(_design(folder), scenario),
    )


def _sensors(knowledge: Knowledge) -> Sensors:
    section = knowledge.scenario.observation
    units = set(section.sensor_units)
    word = "gauge" if section.role == "strain" else "sensor"
    titles = tuple(section.titles) or tuple(f"{word} {number}" for number in range(1, section.count + 1))
    if len(units) > 1:
        return Sensors(word, titles, "deviation", "standard deviations", 1.0, True, -NORMAL_95, NORMAL_95)
    scale, unit = printed_observation(section.role, units.pop())
    shown = scale * knowledge.sensor_model.mean
    return Sensors(word, titles, section.role, unit, scale, False, float(shown.min()), float(shown.max()))


def planform_of(design: WingDesign | None, scenario: Scenario) -> Planform | None:
    """Return a wing from above; None without one that has the sensors of a scenario."""
    if design is None or len(design.gauges.positions) != scenario.observation.count:
        return None
    plan = design.planform

    def place(span: float, chord: float) -> tuple[float, float]:
        return span, (plan.straight_chord_line - chord) * plan.chord(span / plan.semi_span)

    def panel(start: float, end: float, front: float, rear: float) -> Float:
        corners = ((start, front), (end, front), (end, rear), (start, rear))
        return np.array([place(span, chord) for span, chord in corners])

    places = {
        f"z{number}": panel(d.span_start, d.span_end, d.chord_start, d.chord_end)
        for number, d in enumerate(design.defects, start=1)
    }
    names = scenario.state_names
    return Planform(
        outline=panel(0.0, plan.semi_span, 0.0, 1.0),
        regions=tuple(places[name] for name in names) if {*names} <= {*places} else (),
        gauges=np.array([place(span, chord) for span, chord in design.gauges.positions]),
    )


def _design(folder: Path) -> WingDesign | None:
    """Return the design that the twin believes, or else that of what is flown."""
    for copy in (DESIGN_COPY, FLOWN_DESIGN_COPY):
        if (folder / copy).is_file():
            return load_design(folder / copy)
    if (folder / CALIBRATION_COPY).is_file():
        from calibration.result.file import load_calibration

        return load_calibration(folder / CALIBRATION_COPY).design
    return None
