"""What the page shows of a flight, and what it is told: beliefs, decisions, predictions, from its journal.

The flight itself computes nothing for its viewers. Beliefs and decisions stand in the journal; what follows
from them is computed here, as the run does it, so that every number is that of the run.

A viewer asks with the steps that it holds and the step that it shows; the answer follows from these alone.
One that was away, or is slow, asks for more at once, and nothing is kept for it.
"""

import json
import os
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from importlib import resources
from itertools import groupby, islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from jinja2 import Template
from markupsafe import Markup
from numpy.typing import NDArray
from pydantic import BaseModel

from reporting.arrays import Float
from reporting.errors import ReportingError
from reporting.json_file import plain
from twin_master.errors import RunFolderError, TwinMasterError, said
from twin_master.learning.expectation import Expected, expected_of, joined
from twin_master.mission.journal import JOURNAL_NAME, array_from_json, records_in_file
from twin_master.mission.preparation import KNOWLEDGE_NAME, Knowledge, load_knowledge
from twin_master.network.estimator import Learnt, is_state_believed
from twin_master.network.inference import known_control, predict
from twin_master.report.reading import NORMAL_95, printed_factors, printed_sensors
from twin_master.report.structure import design_of, planform_of
from twin_master.run_folder import read_scenario
from twin_master.scenario.schema import REWARD_NAMES
from twin_master.viewer.picture import Picture, picture_of

STEPS_AT_ONCE = 200
"""Steps that are read before the viewers are answered again."""


Record = dict[str, Any]
"""What a line of the journal says."""


class Belief(NamedTuple):
    """What is believed of n steps.

    Attributes
    ----------
    probability : (n, S)
        Of each state.
    believed : (n,)
        Whether a state is believed; else none explains the sensors.
    expected : Expected
        Of sensors and rewards, without quantiles; the reward of the error is NaN where nothing was observed.
    control_probability : (n, U)
        Of a step that was flown: what its next control was decided by. Of a predicted one: p(U).
    """

    probability: Float
    believed: NDArray[np.bool_]
    expected: Expected
    control_probability: Float


class Flight:
    """A run or a watch that is looked at: its steps, and what the twin concluded in each when it was there.

    Parameters
    ----------
    folder : Path
        The run folder, with a flight that is finished, goes on, or was interrupted.

    Raises
    ------
    NotResumableError, RunFolderError
        It is no run folder, or damaged, or its flight was not prepared yet (see `is_prepared`).

    Attributes
    ----------
    pictures : list of Picture
        Of the missing forces that verdicts show, in the order in which they came.
    number : int
        Grows when steps were taken back, as a resumed run may do, or changed, as by an observation that came
        late: what was told of the flight is then void.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self._path = folder, folder / JOURNAL_NAME
        self.scenario = read_scenario(folder)
        self.number = 0
        self._forget(0)

    def _forget(self, file: int) -> None:
        """Begin with a file, by its number."""
        self._file, self._end = file, 0
        self._models: list[tuple[int, Knowledge]] = []
        self._believe(0)
        self._places: list[list[int]] = []  # of belief and observation of each step, in bytes
        self._told: defaultdict[int, list[Record]] = defaultdict(list)  # notices behind it, where none came
        self.pictures: list[Picture] = []
        self.number += 1

    def _believe(self, place: int) -> None:
        """Take in the next model that is believed, from so many bytes on."""
        self._models.append((place, load_knowledge(self.folder, self.scenario, len(self._models))))

    @property
    def knowledge(self) -> Knowledge:
        """What the twin knows now."""
        return self._models[-1][1]

    def _known_in(self, step: Record) -> Knowledge:
        """Return what the twin knew when it told of a step."""
        told = self._places[step["step"]][0]
        return next(knowledge for place, knowledge in reversed(self._models) if place <= told)

    def _begun_anew(self, found: os.stat_result) -> bool:
        """Return whether another file took the place of the journal, or lines were taken back."""
        return found.st_ino != self._file or found.st_size < self._end

    @property
    def steps(self) -> int:
        """Number of steps seen so far."""
        return len(self._places)

    def update(self) -> bool:
        """Take in what is new in the journal, at most `STEPS_AT_ONCE`; return whether there was any.

        Raises
        ------
        RunFolderError
            The journal was changed.
        """
        number, end = self.number, self._end
        with suppress(FileNotFoundError), self._path.open("rb") as file:
            if self._begun_anew(found := os.fstat(file.fileno())):
                self._forget(found.st_ino)
            for record, begin, behind in islice(records_in_file(file, self._path, self._end), STEPS_AT_ONCE):
                self._take_in(record, begin)
                self._end = behind
        return (self.number, self._end) != (number, end)

    def _take_in(self, record: Record, place: int) -> None:
        """Take in a step, an observation that came late, or what a watch noted where none came."""
        if "filtered" in record and record["step"] == self.steps:
            self._places.append([place, place])
            return
        step = max(self.steps - 1, 0)
        if "filtered" in record:
            late = int(record.get("observation_step", int(record["step"])))
            if not 0 <= late <= record["step"] == self.steps - 1:
                told = f"{self.scenario.mission.step_name} {record['step']}"
                raise RunFolderError(said("watch.step", folder=self.folder, told=told, steps=self.steps))
            self._places[-1][0] = self._places[late][1] = place
        self._told[step] += [] if "filtered" in record else record.get("notices", [])
        if "model" in record:  # another one was adopted
            self._believe(place)
        verdict = record.get("model", {}).get("verdict", record.get("verdict", {}).get("folder", ""))
        picture = picture_of(step, self.folder / verdict) if verdict else None
        self.pictures += [picture] if picture else []
        self.number += 1

    def seen(self, first: int, end: int) -> list[Record]:
        """Return what the journal says of the steps first..end - 1.

        An observation that came late stands, with its control, in the line of its own step.

        Raises
        ------
        FileNotFoundError
            Another flight has taken the place of this one; `update` tells it.
        """
        with self._path.open("rb") as file:
            if self._begun_anew(os.fstat(file.fileno())):
                raise FileNotFoundError(self._path)
            return [self._step(file, step) for step in range(first, end)]

    def _step(self, file: BinaryIO, step: int) -> Record:
        believed, observed = self._places[step]
        record = next(records_in_file(file, self._path, believed))[0]
        if observed != believed:
            own = next(records_in_file(file, self._path, observed))[0]
            record |= {name: own[name] for name in ("observed", "control_index")}
        return record | {"notices": record.get("notices", []) + self._told.get(step, [])}

    def observed(self, steps: Sequence[Record]) -> Float:
        """Return what the sensors said in n steps: (n, G), SI; NaN where lost."""
        sensors = self.scenario.observation.count
        return np.array([array_from_json(step["observed"][:sensors]) for step in steps])

    def truth(self, steps: Sequence[Record]) -> Float:
        """Return the true state of n steps: (n, K), SI; NaN where nobody knows it."""
        unknown = [None] * len(self.scenario.state)
        return np.array([array_from_json(step.get("state", unknown)) for step in steps])

    def believed(self, steps: Sequence[Record]) -> Belief:
        """Return what the twin believed of each of n steps when it was flown."""
        models = groupby(steps, lambda step: id(self._known_in(step)))
        parts = [self._believed([*own]) for _, own in models]
        return Belief(
            probability=np.concatenate([part.probability for part in parts]),
            believed=np.concatenate([part.believed for part in parts]),
            expected=joined(part.expected for part in parts),
            control_probability=np.concatenate([part.control_probability for part in parts]),
        )

    def _believed(self, steps: Sequence[Record]) -> Belief:
        """Return what the twin believed of steps in which it knew the same."""
        known = self._known_in(steps[0])
        filtered = np.array([step["filtered"] for step in steps])
        controls = [step["control_index"] for step in steps]
        joint = known_control(filtered, controls, len(known.model.controls))
        if (learns := known.expectation) is None:
            expected = _expected(
                known, joint, np.array([array_from_json(step["observed"]) for step in steps])
            )
        else:
            parts = []
            for step, own, seen in zip(steps, joint, self.observed(steps), strict=True):
                u = slice(step["control_index"], step["control_index"] + 1)
                parts.append(learns.of_marginals(_learnt(step), own[None, :, u], u, seen))
            expected = joined(parts)
        believed = np.array([is_state_believed(_unexplained(step)) for step in steps])
        decided = np.array([step["decision_probability"] for step in steps])
        return Belief(filtered, believed, expected, decided)

    def predicted(self, step: Record) -> Belief:
        """Return what the twin expected after a step of the H steps to come."""
        known, horizon = self._known_in(step), self.scenario.mission.prediction_steps
        flown, learns = (array_from_json(step["filtered"]), step["control_index"]), known.expectation
        coming = predict(known.model, *flown, known.plan.policy, horizon).predicted
        none = _unexplained(step)
        joint = coming[..., None] * known.policy_with_doubt(none)
        if learns is None:
            expected = _expected(known, joint, None)
        else:
            expected = learns.of_marginals(_learnt(step), joint, slice(None), None)
        believed = np.full(len(coming), is_state_believed(none))
        return Belief(coming, believed, expected, joint.sum(axis=-2))


def _unexplained(step: Record) -> float:
    """Return the probability in a step that no state of the model explains the sensors."""
    return float(step.get("suspicion", {}).get("hypotheses", {}).get("none of these", 0.0))


def _expected(known: Knowledge, joint: Float, rows: Float | None) -> Expected:
    return expected_of(known.sensor_model, known.rewards, joint, rows, quantiles=False)


def _learnt(record: Record) -> dict[str, Learnt]:
    return {name: Learnt(**learnt) for name, learnt in record.get("learnt", {}).items()}


def is_prepared(folder: Path) -> bool:
    """Return whether the flight of a run folder can be viewed: all that precedes its first step is there."""
    return (folder / KNOWLEDGE_NAME).is_file()


WINDOW = 240
"""Steps that a page shows at once."""
LATEST = -1
"""Asked for in the place of a step: the last one, whichever it is."""
TALLEST_BAR = 0.82
"""Height of a probability of one, where a control has a row of height one."""


class Request(BaseModel, frozen=True, extra="forbid", strict=True):
    """What a page asks for.

    Attributes
    ----------
    number : int
        Of the request; the answer has it again.
    flight : int
        Of which flight the steps are that it holds.
    first, end : int
        It holds the steps first..end - 1.
    step : int
        To be shown; `LATEST` for the last.
    shown, count : int
        The step that it shows, and how many it knows of; -1 before the first answer.
    """

    number: int
    flight: int
    first: int
    end: int
    step: int
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
        count = self._flight.steps
        if not count:
            return None
        step = count - 1 if request.step == LATEST else min(max(request.step, 0), count - 1)
        same = request.flight == self._flight.number
        if same and request.shown == step and request.count == count:
            return None
        first, end = max(0, step + 1 - WINDOW), step + 1
        if same and request.first <= first <= request.end:  # what is missing follows what it holds
            first = min(request.end, end)
        try:
            seen = self._flight.seen(min(first, step), end)
        except FileNotFoundError:
            return None
        answer: dict[str, Any] = {
            "number": request.number,
            "flight": self._flight.number,
            "count": count,
            "step": step,
            "first": first,
            "picture": self._picture(step),
            "past": self._past(seen) if first < end else None,
            "ahead": None,
        }
        if not (same and request.shown == step):
            answer["ahead"] = self._printed(self._flight.predicted(seen[-1]), None)
        return json.dumps(plain(answer), allow_nan=False)  # what there is not is null

    def _picture(self, step: int) -> dict[str, str] | None:
        """Return the missing force that was known at a step: where it is drawn, and what the verdict says."""
        known = [number for number, item in enumerate(self._flight.pictures) if item.step <= step]
        if not known:
            return None
        address = f"missing_force_{known[-1]}.svg?flight={self._flight.number}"
        return {"address": address, "said": self._flight.pictures[known[-1]].said}

    def _past(self, seen: Sequence[Record]) -> dict[str, Any]:
        flight, folder = self._flight, f" {self._flight.folder}"
        return self._printed(flight.believed(seen), flight.observed(seen)) | {
            "control": [step["control_index"] for step in seen],
            "notices": [
                [notice["sentence"].replace(" DIR", folder) for notice in step["notices"]] for step in seen
            ],
            "learnt": [step.get("learnt", {}) for step in seen],
            "truth": self._scales * flight.truth(seen),
        }

    def _printed(self, belief: Belief, observed: Float | None) -> dict[str, Any]:
        """Return arrays, a row for each step, in printed units; NaN: there is none, or it is not believed."""
        scales = self._scales
        levels = np.array([(factor.levels[0], factor.levels[-1]) for factor in self._factors]).T
        states, expected = self._flight.knowledge.model.states, belief.expected
        mean = np.where(belief.believed[:, None], scales * states.mean(belief.probability), np.nan)
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
            "state_deviation": np.where(np.isnan(mean), np.nan, 0.5 * reach),
            "reward": reward,
            "reward_lower": reward - reward_reach,
            "reward_upper": reward + reward_reach,
            "sensor": scale * center,
            "sensor_lower": scale * (center - sensor_reach),
            "sensor_upper": scale * (center + sensor_reach),
            "probability": belief.control_probability,
            **({} if observed is None else {"observed": scale * observed}),
        }
