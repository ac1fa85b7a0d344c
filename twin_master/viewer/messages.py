"""What the page is made of, and what it is told: turns that it has not got, and what was expected behind one.

A viewer asks with the turns that it holds and the turn that it shows; the answer follows from these alone.
One that was away, or is slow, asks for more at once, and nothing is kept for it.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from importlib import resources
from typing import Any

import numpy as np
from jinja2 import Template
from markupsafe import Markup
from pydantic import BaseModel

from reporting.arrays import Float
from reporting.errors import ReportingError
from reporting.record_json import plain
from twin_master.errors import TwinMasterError
from twin_master.report.reading import NORMAL_95, printed_factors, printed_sensors
from twin_master.report.structure import design_of, planform_of
from twin_master.scenario.schema import REWARD_NAMES
from twin_master.viewer.flight import Belief, Flight, Record

WINDOW = 240
"""Turns that a page shows at once."""
LATEST = -1
"""Asked for in the place of a turn: the last one, whichever it is."""
TALLEST_BAR = 0.82
"""Height of a probability of one, where a control has a row of height one."""


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

    Sensors of several units are shown as deviations from what is expected, in standard deviations of that.

    Parameters
    ----------
    flight : Flight
        What is watched.
    """

    def __init__(self, flight: Flight) -> None:
        self._flight, self._factors = flight, printed_factors(flight.scenario)
        self._scales = np.array([factor.scale for factor in self._factors])
        sensors = printed_sensors(flight.scenario)
        self._standardised = not sensors.unit
        if self._standardised:
            units = ("standard deviations",) * len(sensors.titles)
            sensors = replace(sensors, quantity="deviation", units=units, scale=1.0)
        self._sensors = sensors
        self._waiting: dict[Tell, Request] = {}
        self._fault = ""

    def page(self) -> str:
        """Return the page; its script draws the figures from what it is told."""
        flight, sensors, mission = self._flight, self._sensors, self._flight.scenario.mission
        wing = planform_of(design_of(flight.folder), flight.scenario)
        shown = sensors.scale * flight.knowledge.sensor_model.mean  # without noise
        lowest, highest = (-NORMAL_95, NORMAL_95) if self._standardised else (shown.min(), shown.max())
        record = plain({
            "title": mission.title or mission.name, "step_name": mission.step_name,
            "horizon": mission.prediction_steps, "factors": self._factors,
            "controls": flight.scenario.control_names, "rewards": REWARD_NAMES,
            "sensors": asdict(sensors) | {"unit": sensors.unit, "lowest": lowest, "highest": highest},
            "planform": None if wing is None else wing._asdict(), "window": WINDOW, "latest": LATEST,
            "tallest_bar": TALLEST_BAR,
        })  # fmt: skip
        # Inside a script element only the beginning of a tag could end it.
        content = json.dumps(record, allow_nan=False).replace("<", "\\u003c")
        template = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
        page: str = Template(template, autoescape=True).render(scene=record, content=Markup(content))
        return page

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
        return json.dumps(plain(answer), allow_nan=False)  # what there is not is null

    def _picture(self, turn: int) -> dict[str, str] | None:
        """Return the missing force that was known at a turn: where it is drawn, and what the verdict says."""
        known = [number for number, item in enumerate(self._flight.pictures) if item.turn <= turn]
        if not known:
            return None
        address = f"missing_force_{known[-1]}.svg?flight={self._flight.number}"
        return {"address": address, "said": self._flight.pictures[known[-1]].said}

    def _past(self, seen: Sequence[Record]) -> dict[str, Any]:
        flight, folder = self._flight, f" {self._flight.folder}"
        return self._printed(flight.believed(seen), flight.observed(seen)) | {
            "control": [turn["control_index"] for turn in seen],
            "notices": [
                [notice["sentence"].replace(" DIR", folder) for notice in turn["notices"]] for turn in seen
            ],
            "learnt": [turn.get("learnt", {}) for turn in seen],
            "truth": self._scales * flight.truth(seen),
        }

    def _printed(self, belief: Belief, observed: Float | None) -> dict[str, Any]:
        """Return arrays, a row for each turn, in printed units; NaN stands for what there is not."""
        scales = self._scales
        levels = np.array([(factor.levels[0], factor.levels[-1]) for factor in self._factors]).T
        states, expected = self._flight.knowledge.model.states, belief.expected
        mean = scales * states.mean(belief.probability)
        reach = 2.0 * scales * states.standard_deviation(belief.probability)
        reward, reward_reach = expected.reward_mean, NORMAL_95 * expected.reward_standard_deviation
        center, spread = expected.mean, np.hypot(expected.standard_deviation, expected.noise)
        if self._standardised:
            observed = None if observed is None else (observed - center) / spread
            center, spread = np.zeros_like(center), np.ones_like(spread)
        scale, sensor_reach = self._sensors.scale, NORMAL_95 * spread
        return {
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
            **({} if observed is None else {"observed": scale * observed}),
        }
