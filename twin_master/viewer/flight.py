"""What the page shows of a flight: beliefs, decisions and predictions, from the turns in its journal.

The flight itself computes nothing for its viewers. Beliefs and decisions stand in the journal; what follows
from them is computed here, as the run does it, so that every number is that of the run.
"""

import os
from array import array
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from reporting.arrays import Float
from reporting.errors import DamagedFileError
from reporting.json_file import read_json
from twin_master.errors import RunFolderError
from twin_master.learning.expectation import Expected, expected_of
from twin_master.mission.journal import JOURNAL_NAME, array_of, records_of
from twin_master.mission.preparation import KNOWLEDGE_NAME, Knowledge, kept_knowledge
from twin_master.network.estimator import Learnt
from twin_master.network.inference import known_control, predict
from twin_master.run_folder import PICTURE, VERDICT, read_config
from twin_master.scenario.reading import parse_scenario
from twin_master.scenario.schema import Scenario

TURNS_AT_ONCE = 200
"""Turns that are read before the viewers are answered again."""
TURNS_KEPT = 512
"""Turns in memory, those read last: more than two pages show at once."""


Record = dict[str, Any]
"""What a line of the journal says."""


class BegunAnewError(LookupError):
    """Another flight has taken the place of the one that is looked at."""


class Belief(NamedTuple):
    """What is believed of n turns.

    Attributes
    ----------
    probability : (n, S)
        Of each state.
    expected : Expected
        Of sensors and rewards, without quantiles; the reward of the error is NaN where nothing was observed.
    control_probability : (n, U)
        Of a turn that was flown: what its next control was decided by. Of a predicted one: p(U).
    """

    probability: Float
    expected: Expected
    control_probability: Float


class Picture(NamedTuple):
    """The missing force that a verdict shows: behind which turn it came, its drawing, what it says."""

    turn: int
    drawing: Path
    said: str


def _picture(turn: int, verdict: Path) -> Picture | None:
    """Return what the folder of a verdict shows of a missing force; None: nothing, or no whole verdict."""
    drawing = verdict / PICTURE
    if not drawing.is_file():
        return None
    try:
        return Picture(
            turn, drawing, str(read_json(verdict / VERDICT, DamagedFileError)["verdict"]["sentence"])
        )
    except (DamagedFileError, KeyError, TypeError):
        return None


class Flight:
    """A run or a watch that is looked at: its turns, and what the twin concluded in each when it was there.

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
        Grows when turns were taken back, as a resumed run may do, or changed, as by an observation that came
        late: what was told of the flight is then void.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        config = read_config(folder)
        self.scenario: Scenario = parse_scenario(config["scenario"], str(folder))
        self._knowledge_of = self._kept_at()
        self.knowledge: Knowledge = kept_knowledge(folder, self.scenario)
        self._path, self._end, self._file_number = folder / JOURNAL_NAME, 0, 0
        # Where in the journal stand belief and observation of each turn; in memory are those last read.
        self._believed, self._observed = array("q"), array("q")
        self._kept: OrderedDict[int, Record] = OrderedDict()
        self._told: dict[int, list[Record]] = {}  # notices behind a turn, where none came
        self.pictures: list[Picture] = []
        self.number = 0

    @property
    def turns(self) -> int:
        """Number of turns seen so far."""
        return len(self._believed)

    def update(self) -> bool:
        """Take in what is new in the journal, at most `TURNS_AT_ONCE`; return whether there was any.

        Raises
        ------
        RunFolderError
            The journal was changed.
        """
        changed = self._begun_anew()
        if changed:
            self._end = self._file_number = 0
            self._believed, self._observed = array("q"), array("q")
            self._kept.clear()
            self._told.clear()
            self.pictures.clear()
            self.number += 1
        if (kept := self._kept_at()) != self._knowledge_of:  # a patched model was adopted
            self._knowledge_of = kept
            self.knowledge = kept_knowledge(self.folder, self.scenario)
            self.number += 1
            changed = True
        news = self._news()
        for place, record in news:
            if "filtered" not in record:
                self._take_in(record)
            elif record["turn"] == self.turns:
                self._believed.append(place)
                self._observed.append(place)
                self._keep(record["turn"], record)
            else:
                self._revise(record, place)
        return changed or bool(news)

    def _begun_anew(self) -> bool:
        """Return whether another file took the place of the journal, or lines were taken back."""
        try:
            found = self._path.stat()
        except FileNotFoundError:
            return False
        return found.st_size < self._end or self._file_number not in (0, found.st_ino)

    def _news(self) -> list[tuple[int, Record]]:
        """Return whole new records, at most `TURNS_AT_ONCE`, and where each begins, in bytes."""
        found: list[tuple[int, Record]] = []
        if not self._path.is_file() or self._path.stat().st_size == self._end:
            return found
        with suppress(FileNotFoundError), self._path.open("rb") as file:
            self._file_number = os.fstat(file.fileno()).st_ino
            for record, begin, end in islice(records_of(file, self._path, self._end), TURNS_AT_ONCE):
                found.append((begin, record))
                self._end = end
        return found

    def _read(self, places: Sequence[int]) -> list[Record]:
        """Return records that were news; `BegunAnewError` where the journal was begun anew since."""
        with suppress(FileNotFoundError), self._path.open("rb") as file:
            if os.fstat(file.fileno()).st_ino == self._file_number:
                return [next(records_of(file, self._path, place))[0] for place in places]
        raise BegunAnewError

    def _take_in(self, record: Mapping[str, Any]) -> None:
        """Take in what a watch noted where no turn came: notices, a verdict, a model that was adopted."""
        turn = max(self.turns - 1, 0)
        if notices := record.get("notices"):
            self._told[turn] = self._told.get(turn, []) + notices
            self.number += 1
        verdict = record.get("model", {}).get("verdict", record.get("verdict", {}).get("folder", ""))
        if verdict and (found := _picture(turn, self.folder / verdict)):
            self.pictures.append(found)
            self.number += 1

    def _kept_at(self) -> tuple[int, int] | None:
        """Return what tells the file of what the twin knows from another that took its place."""
        try:
            found = (self.folder / KNOWLEDGE_NAME).stat()
        except FileNotFoundError:
            return None
        return found.st_ino, found.st_mtime_ns

    def _revise(self, record: Record, place: int) -> None:
        """Take in an observation that came late: it stands in its turn, and the last belief has changed."""
        turn = int(record["turn"])
        observed = int(record.get("observation_turn", turn))
        if not 0 <= observed <= turn == self.turns - 1:
            raise RunFolderError(
                f"the journal in {self.folder} tells {self.scenario.mission.step_name} {turn} where "
                f"{self.turns} was expected: it is of another version."
            )
        self._believed[-1] = self._observed[observed] = place
        self._kept.pop(turn, None)
        self._kept.pop(observed, None)
        self.number += 1

    def _keep(self, turn: int, record: Record) -> None:
        self._kept[turn] = record
        if len(self._kept) > TURNS_KEPT:
            self._kept.popitem(last=False)

    def seen(self, first: int, end: int) -> list[Record]:
        """Return what the journal says of the turns first..end - 1.

        An observation that came late stands, with its control, in the line of its own turn.

        Raises
        ------
        BegunAnewError
            Another flight has taken the place of this one; `update` tells it.
        """
        found = {turn: self._kept[turn] for turn in range(first, end) if turn in self._kept}
        missing = [turn for turn in range(first, end) if turn not in found]
        late = [turn for turn in missing if self._observed[turn] != self._believed[turn]]
        found |= zip(missing, self._read([self._believed[turn] for turn in missing]), strict=True)
        for turn, own in zip(late, self._read([self._observed[turn] for turn in late]), strict=True):
            found[turn] = found[turn] | {name: own[name] for name in ("observed", "control_index")}
        for turn in missing:
            self._keep(turn, found[turn])
        for turn in found.keys() & self._told.keys():
            found[turn] = found[turn] | {"notices": found[turn].get("notices", []) + self._told[turn]}
        return [found[turn] for turn in range(first, end)]

    def observed(self, first: int, end: int) -> Float:
        """Return what the sensors said in turns first..end - 1: (n, G), SI; NaN where lost."""
        sensors = self.scenario.observation.count
        return np.array([array_of(turn["observed"][:sensors]) for turn in self.seen(first, end)])

    def truth(self, first: int, end: int) -> Float:
        """Return the true state of turns first..end - 1: (n, K), SI; NaN where nobody knows it."""
        unknown = np.full(len(self.scenario.state), np.nan)
        return np.array(
            [array_of(turn["state"]) if "state" in turn else unknown for turn in self.seen(first, end)]
        )

    def believed(self, first: int, end: int) -> Belief:
        """Return what the twin believed of each of the turns first..end - 1 when it was flown."""
        turns = self.seen(first, end)
        joint = known_control(
            np.array([turn["filtered"] for turn in turns]),
            [turn["control_index"] for turn in turns],
            len(self.knowledge.model.controls),
        )
        decided = np.array([turn["decision_probability"] for turn in turns])
        observed = self.observed(first, end)
        if self.knowledge.expectation is None or not turns:
            return self._belief(joint, observed, decided)
        parts = []
        for turn, own, seen in zip(turns, joint, observed, strict=True):
            u = slice(turn["control_index"], turn["control_index"] + 1)
            parts.append(self.knowledge.expectation.of_marginals(_learnt(turn), own[None, :, u], u, seen))
        together = {name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])}
        return Belief(joint.sum(axis=-1), Expected(**together), decided)

    def predicted(self, turn: int) -> Belief:
        """Return what the twin expected after a turn of the H turns to come."""
        model, plan = self.knowledge.model, self.knowledge.plan
        seen = self.seen(turn, turn + 1)[0]
        horizon, filtered = self.scenario.mission.prediction_steps, array_of(seen["filtered"])
        coming = predict(model, filtered, seen["control_index"], plan.policy, horizon)
        if self.knowledge.expectation is None:
            return self._belief(coming.joint, None, coming.control_probability)
        expected = self.knowledge.expectation.of_marginals(_learnt(seen), coming.joint, slice(None), None)
        return Belief(coming.joint.sum(axis=-1), expected, coming.control_probability)

    def _belief(self, joint: Float, observed: Float | None, control_probability: Float) -> Belief:
        known = self.knowledge
        expected = expected_of(known.sensor_model, known.rewards, joint, observed, quantiles=False)
        return Belief(joint.sum(axis=-1), expected, control_probability)


def _learnt(record: Record) -> dict[str, Learnt]:
    return {name: Learnt(**learnt) for name, learnt in record.get("learnt", {}).items()}


def is_prepared(folder: Path) -> bool:
    """Return whether the flight of a run folder can be viewed: all that precedes its first turn is there."""
    return (folder / KNOWLEDGE_NAME).is_file()
