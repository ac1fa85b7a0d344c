"""The page of a flight: its HTML, and the answers to the requests of its viewers.

A request says which steps the viewer has and which step it shows, and the answer depends on the
request alone. So a slow viewer, or one that was away, gets everything that it lacks at once, and
the server keeps no state for it.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from importlib import resources
from typing import Any

import numpy as np
from jinja2 import Template
from markupsafe import Markup
from pydantic import BaseModel

from reporting.arrays import Float
from reporting.errors import ReportingError
from reporting.json_file import plain
from reporting.pages.page import Page, Section, render_page
from twin_master.errors import TwinMasterError
from twin_master.mission.decision_record import with_folder
from twin_master.report.reading import (
    NORMAL_95,
    printed_factors,
    printed_sensors,
)
from twin_master.report.structure import design_of, planform_of
from twin_master.scenario.schema import REWARD_NAMES
from twin_master.viewer.flight import Flight, StepBeliefs, StepRecord
from twin_master.viewer.part_picture import part_picture

WINDOW_STEPS = 240
"""Number of steps that a page shows at once."""
LATEST = -1
"""The number in a request that stands for the last step."""
TALLEST_BAR = 0.82
"""Height of the bar of a probability of 1, if the row of a control has the height 1."""


class Request(BaseModel, frozen=True, extra="forbid", strict=True):
    """The request of a viewer.

    Attributes
    ----------
    number : int
        The number of the request, which the answer repeats.
    flight : int
        The number of the flight whose steps the viewer has, see `Flight.number`.
    first, end : int
        The viewer has the steps first..end - 1.
    step : int
        The step to be shown; `LATEST` for the last one.
    shown : int
        The step that the viewer shows; -1 before the first answer.
    count : int
        The number of steps that the viewer knows of; -1 before the first answer.
    """

    number: int
    flight: int
    first: int
    end: int
    step: int
    shown: int
    count: int


SendText = Callable[[str], None]
"""A function that sends an answer to one viewer; it also identifies this viewer."""


class FlightPage:
    """The page of one flight, for any number of viewers.

    If the sensors have several units, each is shown as its deviation from the expected reading, in
    standard deviations of that reading.
    """

    def __init__(self, flight: Flight) -> None:
        self._flight = flight
        self._factors = printed_factors(flight.scenario)
        self._factor_scales = np.array([factor.scale for factor in self._factors])
        sensors = printed_sensors(flight.scenario)
        self._shows_deviations = not sensors.unit
        if self._shows_deviations:
            units = ("standard deviations",) * len(sensors.titles)
            sensors = replace(sensors, quantity="deviation", units=units, scale=1.0)
        self._sensors = sensors
        self._open_requests: dict[SendText, Request] = {}
        self._error = ""

    def render_html(self) -> str:
        """Return the HTML of the page.

        It contains all that does not change during a flight: names, units, axes, and the planform
        of a wing or the faces of another structure. The script of the page draws the figures from
        this and from the answers.
        """
        flight = self._flight
        mission = flight.scenario.mission
        wing = planform_of(design_of(flight.folder), flight.scenario)
        part = None if wing is not None else part_picture(flight.folder, flight.scenario)
        lowest, highest = self._sensor_range()
        sensors = asdict(self._sensors)
        sensors |= {"unit": self._sensors.unit, "lowest": lowest, "highest": highest}
        scene = plain(
            {
                "title": mission.title or mission.name,
                "step_name": mission.step_name,
                "horizon": mission.prediction_steps,
                "factors": self._factors,
                "controls": flight.scenario.control_names,
                "rewards": REWARD_NAMES,
                "sensors": sensors,
                "planform": None if wing is None else wing._asdict(),
                "part": None if part is None else part._asdict(),
                "window": WINDOW_STEPS,
                "latest": LATEST,
                "tallest_bar": TALLEST_BAR,
            }
        )
        return render_page(_page_of_scene(scene))

    def _sensor_range(self) -> tuple[float, float]:
        """Return the lowest and the highest reading on the axis of the sensors, as printed.

        They bound the mean readings of all states and controls. Readings that are shown as
        standard deviations get an axis with 95 % of a normal distribution.
        """
        if self._shows_deviations:
            return -NORMAL_95, NORMAL_95
        readings = self._sensors.scale * self._flight.knowledge.sensor_model.mean
        return readings.min(), readings.max()

    def add_request(self, send: SendText, request: Request) -> None:
        """Answer the request of a viewer now, or as soon as there is something new.

        A request replaces an earlier one of the same viewer that was not answered yet.
        """
        self._open_requests[send] = request
        self._answer_viewer(send)

    def remove_viewer(self, send: SendText) -> None:
        """Drop the open request of a viewer that has gone."""
        self._open_requests.pop(send, None)

    def update(self) -> None:
        """Read new lines of the journal, and answer the viewers that wait for them.

        If the journal cannot be read, all viewers get the error, now and later.
        """
        try:
            if self._error or not self._flight.update():
                return
        except (TwinMasterError, ReportingError) as error:
            self._error = str(error)
        for send in list(self._open_requests):
            self._answer_viewer(send)

    def _answer_viewer(self, send: SendText) -> None:
        """Answer the open request of a viewer, if there is something new for it.

        An answered request is closed. After an error of the journal the viewer also gets the error.
        """
        if self._error:
            send(json.dumps({"error": self._error}))
        # A viewer that could not be reached is forgotten meanwhile
        request = self._open_requests.get(send)
        if request is None:
            return
        answer = self.answer(request)
        if answer is not None:
            del self._open_requests[send]
            send(answer)

    def answer(self, request: Request) -> str | None:
        """Return the answer to a request as JSON; None if there is nothing new for the viewer.

        The answer contains the past steps that the viewer lacks (`past`) and, if another step is
        shown than before, the prediction after it (`ahead`).
        """
        flight = self._flight
        # The step to be shown
        count = flight.steps
        if not count:
            return None
        last_step = count - 1
        step = last_step
        if request.step != LATEST:
            step = min(max(request.step, 0), last_step)
        # What the viewer has already
        has_same_flight = request.flight == flight.number
        shows_step = has_same_flight and request.shown == step
        if shows_step and request.count == count:
            return None
        first = _first_missing_step(request, step, has_same_flight=has_same_flight)
        end = step + 1
        try:
            records = flight.records_of_steps(min(first, step), end)
        except FileNotFoundError:  # another flight has taken its place
            return None
        answer = {
            "number": request.number,
            "flight": flight.number,
            "count": count,
            "step": step,
            "first": first,
            "picture": self._drawing_at(step),
            "past": self._past_values(records) if first < end else None,
            "ahead": None,
        }
        if not shows_step:
            answer["ahead"] = self._plotted_values(flight.prediction_after(records[-1]), None)
        return json.dumps(plain(answer), allow_nan=False)  # NaN becomes null

    def _drawing_at(self, step: int) -> dict[str, str] | None:
        """Return address and verdict of the last drawing of a missing force up to a step.

        The result is None if no verdict up to this step has a drawing.
        """
        numbers = []
        for number, drawing in enumerate(self._flight.drawings):
            if drawing.step <= step:
                numbers.append(number)
        if not numbers:
            return None
        last_number = numbers[-1]
        return {
            "address": f"missing_force_{last_number}.svg?flight={self._flight.number}",
            "said": self._flight.drawings[last_number].sentence,
        }

    def _past_values(self, records: Sequence[StepRecord]) -> dict[str, object]:
        """Return the values of past steps that the page plots, each with a row for each step."""
        flight = self._flight
        beliefs = flight.beliefs_in(records)
        values = self._plotted_values(beliefs, flight.observations_in(records))
        values["control"] = [record["control_index"] for record in records]
        sentences_of_steps = []
        for record in records:
            sentences = [
                with_folder(notice["sentence"], flight.folder) for notice in record["notices"]
            ]
            sentences_of_steps.append(sentences)
        values["notices"] = sentences_of_steps
        values["learnt"] = [record.get("learnt", {}) for record in records]
        values["truth"] = self._factor_scales * flight.true_states_in(records)
        return values

    def _plotted_values(
        self, beliefs: StepBeliefs, observations: Float | None
    ) -> dict[str, object]:
        """Return the values that the figures plot, in printed units, with a row for each step.

        Rewards and sensors have a central 95 % interval; that of a sensor includes its noise.

        Parameters
        ----------
        beliefs : StepBeliefs
            The beliefs of n steps.
        observations : (n, G) array or None
            The readings of G sensors in n steps, SI; None for predicted steps.

        Returns
        -------
        dict
            Arrays by name; NaN if there is no value, or if no state is believed.
        """
        expectation = beliefs.expected
        reward_margin = NORMAL_95 * expectation.reward_standard_deviation
        sensor_mean = expectation.mean
        # The uncertain state and the noise are independent: their variances add up
        deviation = np.hypot(expectation.standard_deviation, expectation.noise_standard_deviation)
        if self._shows_deviations:
            if observations is not None:
                observations = (observations - sensor_mean) / deviation
            sensor_mean = np.zeros_like(sensor_mean)
            deviation = np.ones_like(deviation)
        scale = self._sensors.scale
        sensor_margin = NORMAL_95 * deviation
        values: dict[str, object] = {
            **self._state_values(beliefs),
            "reward": expectation.reward_mean,
            "reward_lower": expectation.reward_mean - reward_margin,
            "reward_upper": expectation.reward_mean + reward_margin,
            "sensor": scale * sensor_mean,
            "sensor_lower": scale * (sensor_mean - sensor_margin),
            "sensor_upper": scale * (sensor_mean + sensor_margin),
            "probability": beliefs.control_probability,
        }
        if observations is not None:
            values["observed"] = scale * observations
        return values

    def _state_values(self, beliefs: StepBeliefs) -> dict[str, Float]:
        """Return mean, interval and standard deviation of each state factor in printed units.

        The interval is the mean plus and minus two standard deviations, clipped to the range of the
        levels of the factor. All arrays have a row for each step and a column for each factor; they
        are NaN in steps in which no state is believed.
        """
        scales = self._factor_scales
        lowest = np.array([factor.levels[0] for factor in self._factors])
        highest = np.array([factor.levels[-1] for factor in self._factors])
        states = self._flight.knowledge.model.states
        is_believed = beliefs.is_believed[:, None]
        mean = np.where(is_believed, scales * states.mean(beliefs.probability), np.nan)
        margin = 2.0 * scales * states.standard_deviation(beliefs.probability)
        return {
            "state": mean,
            "state_lower": np.clip(mean - margin, lowest, highest),
            "state_upper": np.clip(mean + margin, lowest, highest),
            # The margin is two standard deviations
            "state_deviation": np.where(np.isnan(mean), np.nan, 0.5 * margin),
        }


def _page_of_scene(scene: Mapping[str, Any]) -> Page:
    """Return the page of a flight with empty elements, which the script of the page fills.

    `scene` has all that does not change during a flight, as plain JSON.
    """
    controls = resources.files(__package__).joinpath("controls.html").read_text(encoding="utf-8")
    sensors = scene["sensors"]
    step = scene["step_name"]
    options = Markup("").join(
        Markup('<option value="{}">{}</option>').format(index, title)
        for index, title in enumerate(sensors["titles"])
    )
    choice = Markup(
        '<label class="choice">{} shown over the {}s <select id="chosen">{}</select></label>'
    ).format(sensors["word"], step, options)
    # Inside a script element only the beginning of a tag could end it
    content = Markup(json.dumps(scene, allow_nan=False).replace("<", "\\u003c"))
    return Page(
        scene["title"],
        sentence=Markup(Template(controls, autoescape=True).render(scene=scene)),
        outcome=[
            Markup('<script id="content" type="application/json">{}</script>').format(content),
            Markup('<div id="structure"></div>'),
        ],
        sections=[
            Section("Notices", [Markup('<ul id="notices" class="notice"></ul>')], "told"),
            Section("The missing force", [_FORCE_PICTURE], "force"),
            Section("Health", [Markup('<div id="states"></div>')], "health"),
            Section("Sensors", [Markup('<div id="plots"></div>'), choice], "gauges"),
            Section("Rewards", [Markup('<div id="rows"></div>')], "rewards"),
            Section("Learnt, with 90 % interval", [Markup('<dl id="learnt"></dl>')], "learning"),
        ],
        footer=[
            _LEGEND,
            f"Keys: left and right for one {step}, Page up and Page down for ten, Home and End, "
            "Space to play, L for the latest.",
        ],
        scripts=["plots.js", "view.js"],
        style="view.css",
    )


_FORCE_PICTURE = Markup(
    '<figure><img id="picture" alt="The missing force over displacement, speed and time">'
    '<figcaption id="verdict"></figcaption></figure>'
)
_LEGEND = Markup(
    '<span class="key present"></span>as believed at the time, <span class="key prediction"></span>'
    "predicted, both with their 95 % interval (health: two standard deviations); "
    '<span class="key truth"></span>truth, which the twin does not know. Grey dots are '
    "observations; the interval of a sensor includes its noise."
)


def _first_missing_step(request: Request, step: int, *, has_same_flight: bool) -> int:
    """Return the first step that must be sent to a viewer.

    The page shows a window of `WINDOW_STEPS` steps. A viewer that has the first part of the window
    gets the rest, and any other viewer the whole window.

    Parameters
    ----------
    has_same_flight : bool
        Whether the steps of the viewer are of this flight; if not, they are void.
    """
    end = step + 1
    first_of_window = max(0, end - WINDOW_STEPS)
    is_continued = request.first <= first_of_window <= request.end
    if has_same_flight and is_continued:
        return min(request.end, end)
    return first_of_window
