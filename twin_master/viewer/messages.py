"""What the page is made of, and what it is told: turns that it has not got, and what was expected behind one.

A viewer asks with the turns that it holds and the turn that it shows; the answer follows from these alone.
One that was away, or is slow, asks for more at once, and nothing is kept for it.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Template
from markupsafe import Markup
from pydantic import BaseModel

from reporting.arrays import Float
from reporting.errors import ReportingError
from twin_master.errors import TwinMasterError
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
from twin_master.viewer.flight import Belief, Flight, Record

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


class Request(BaseModel, frozen=True, extra="forbid", strict=True):
    """What a page asks for.

    Attributes
    ----------
    number : int
        Of the request; the answer has it again.
    flight : int
        Of which flight the turns are that it holds.
    first, end : int
        It holds the turns first..end - 1.
    turn : int
        To be shown; `LATEST` for the last.
    shown, count : int
        The turn that it shows, and how many it knows of; -1 before the first answer.
    """

    number: int
    flight: int
    first: int
    end: int
    turn: int
    shown: int
    count: int


Tell = Callable[[str], None]
"""Tells a viewer an answer."""


class Teller:
    """Answers of one flight, for any number of viewers.

    Parameters
    ----------
    flight : Flight
        What is watched.
    scene : Scene
        Printed units.
    """

    def __init__(self, flight: Flight, scene: Scene) -> None:
        self._flight, self._scene = flight, scene
        self._waiting: dict[Tell, Request] = {}
        self._fault = ""

    def ask(self, tell: Tell, request: Request) -> None:
        """Answer a viewer now or as soon as there is something new; a newer request replaces an older one."""
        self._waiting[tell] = request
        self._tell(tell)

    def leave(self, tell: Tell) -> None:
        """Forget a viewer."""
        self._waiting.pop(tell, None)

    def look(self) -> None:
        """Take in what was flown, and answer those who wait for it."""
        try:
            if self._fault or not self._flight.update():
                return
        except (TwinMasterError, ReportingError) as error:
            self._fault = str(error)
        for tell in list(self._waiting):
            self._tell(tell)

    def _tell(self, tell: Tell) -> None:
        if self._fault:
            tell(json.dumps({"error": self._fault}))
        request = self._waiting.get(tell)  # one that cannot be told any more has left
        answer = None if request is None else self.answer(request)
        if answer is not None:
            del self._waiting[tell]
            tell(answer)

    def answer(self, request: Request) -> str | None:
        """Return the answer to a request; None while there is nothing new to say."""
        count = self._flight.turns
        if not count:
            return None
        turn = count - 1 if request.turn == LATEST else min(max(request.turn, 0), count - 1)
        same = request.flight == self._flight.number
        if same and request.shown == turn and request.count == count:
            return None
        first, end = max(0, turn + 1 - WINDOW), turn + 1
        if same and request.first <= first <= request.end:  # what is missing follows what it holds
            first = min(request.end, end)
        try:
            seen = self._flight.seen(min(first, turn), end)
        except FileNotFoundError:
            return None
        answer: dict[str, Any] = {
            "number": request.number,
            "flight": self._flight.number,
            "count": count,
            "turn": turn,
            "first": first,
            "picture": self._picture(turn),
            "past": self._past(seen) if first < end else None,
            "ahead": None,
        }
        if not (same and request.shown == turn):
            answer["ahead"] = self._printed(self._flight.predicted(seen[-1]), None)
        return json.dumps(answer, allow_nan=False)

    def _picture(self, turn: int) -> dict[str, str] | None:
        """Return the missing force that was known at a turn: where it is drawn, and what the verdict says."""
        known = [number for number, item in enumerate(self._flight.pictures) if item.turn <= turn]
        if not known:
            return None
        address = f"missing_force_{known[-1]}.svg?flight={self._flight.number}"
        return {"address": address, "said": self._flight.pictures[known[-1]].said}

    def _past(self, seen: Sequence[Record]) -> dict[str, Any]:
        flight, folder = self._flight, f" {self._flight.folder}"
        scales = np.array([factor.scale for factor in self._scene.factors])
        return self._printed(flight.believed(seen), flight.observed(seen)) | {
            "control": [turn["control_index"] for turn in seen],
            "notices": [
                [notice["sentence"].replace(" DIR", folder) for notice in turn["notices"]] for turn in seen
            ],
            "learnt": [turn.get("learnt", {}) for turn in seen],
            "truth": _plain(scales * flight.truth(seen)),
        }

    def _printed(self, belief: Belief, observed: Float | None) -> dict[str, Any]:
        """Return lists, a row for each turn, in printed units; None stands for what there is not."""
        scene = self._scene
        scales = np.array([factor.scale for factor in scene.factors])
        levels = np.array([(factor.levels[0], factor.levels[-1]) for factor in scene.factors]).T
        states, expected = self._flight.knowledge.model.states, belief.expected
        mean = scales * states.mean(belief.probability)
        reach = 2.0 * scales * states.standard_deviation(belief.probability)
        reward, reward_reach = expected.reward_mean, NORMAL_95 * expected.reward_standard_deviation
        center, spread = expected.mean, np.hypot(expected.standard_deviation, expected.noise)
        if scene.standardised:
            observed = None if observed is None else (observed - center) / spread
            center, spread = np.zeros_like(center), np.ones_like(spread)
        scale, sensor_reach = scene.sensors.scale, NORMAL_95 * spread
        record = {
            "state": mean,
            "state_lower": np.clip(mean - reach, *levels),
            "state_upper": np.clip(mean + reach, *levels),
            "state_deviation": 0.5 * reach,
            "reward": reward,
            "reward_lower": reward - reward_reach,
            "reward_upper": reward + reward_reach,
            "sensor": scale * center,
            "sensor_lower": scale * (center - sensor_reach),
            "sensor_upper": scale * (center + sensor_reach),
            "probability": belief.control_probability,
        }
        if observed is not None:
            record["observed"] = scale * observed
        return {name: _plain(values) for name, values in record.items()}


def _plain(values: Float) -> list[Any]:
    plain = values.astype(object)
    plain[~np.isfinite(values)] = None
    return list(plain.tolist())
