"""What the page shows of a flight: beliefs, decisions and predictions, from the turns in its journal.

The flight itself computes nothing for its viewers. Beliefs and decisions stand in the journal; what follows
from them is computed here, as the run does it, so that every number is that of the run.
"""

import os
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from reporting.arrays import Float
from reporting.errors import DamagedFileError
from reporting.json_file import read_json
from twin_master.errors import RunFolderError
from twin_master.learning.expectation import Expected, expected_of
from twin_master.mission.journal import JOURNAL_NAME, array_of, records_of
from twin_master.mission.preparation import KNOWLEDGE_NAME, kept_knowledge
from twin_master.network.estimator import Learnt
from twin_master.network.inference import known_control, predict
from twin_master.run_folder import PICTURE, VERDICT, kept_scenario
from twin_master.sentences import said

TURNS_AT_ONCE = 200
"""Turns that are read before the viewers are answered again."""


Record = dict[str, Any]
"""What a line of the journal says."""


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
    with suppress(DamagedFileError, KeyError, TypeError):
        if (verdict / PICTURE).is_file():
            record = read_json(verdict / VERDICT, DamagedFileError)["verdict"]
            return Picture(turn, verdict / PICTURE, str(record["sentence"]))
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
        self.folder, self._path = folder, folder / JOURNAL_NAME
        self.scenario = kept_scenario(folder)
        self.number = 0
        self._forget(0)

    def _forget(self, file: int) -> None:
        """Begin with a file, by its number."""
        self._file, self._end = file, 0
        self.knowledge = kept_knowledge(self.folder, self.scenario)
        self._places: list[list[int]] = []  # of belief and observation of each turn, in bytes
        self._told: defaultdict[int, list[Record]] = defaultdict(list)  # notices behind it, where none came
        self.pictures: list[Picture] = []
        self.number += 1

    def _begun_anew(self, found: os.stat_result) -> bool:
        """Return whether another file took the place of the journal, or lines were taken back."""
        return found.st_ino != self._file or found.st_size < self._end

    @property
    def turns(self) -> int:
        """Number of turns seen so far."""
        return len(self._places)

    def update(self) -> bool:
        """Take in what is new in the journal, at most `TURNS_AT_ONCE`; return whether there was any.

        Raises
        ------
        RunFolderError
            The journal was changed.
        """
        number, end = self.number, self._end
        with suppress(FileNotFoundError), self._path.open("rb") as file:
            if self._begun_anew(found := os.fstat(file.fileno())):
                self._forget(found.st_ino)
            for record, begin, behind in islice(records_of(file, self._path, self._end), TURNS_AT_ONCE):
                self._take_in(record, begin)
                self._end = behind
        return (self.number, self._end) != (number, end)

    def _take_in(self, record: Record, place: int) -> None:
        """Take in a turn, an observation that came late, or what a watch noted where none came."""
        if "filtered" in record and record["turn"] == self.turns:
            self._places.append([place, place])
            return
        turn = max(self.turns - 1, 0)
        if "filtered" in record:
            late = int(record.get("observation_turn", int(record["turn"])))
            if not 0 <= late <= record["turn"] == self.turns - 1:
                told = f"{self.scenario.mission.step_name} {record['turn']}"
                raise RunFolderError(said("watch.turn", folder=self.folder, told=told, turns=self.turns))
            self._places[-1][0] = self._places[late][1] = place
        self._told[turn] += [] if "filtered" in record else record.get("notices", [])
        if "model" in record:  # another one was adopted
            self.knowledge = kept_knowledge(self.folder, self.scenario)
        verdict = record.get("model", {}).get("verdict", record.get("verdict", {}).get("folder", ""))
        picture = _picture(turn, self.folder / verdict) if verdict else None
        self.pictures += [picture] if picture else []
        self.number += 1

    def seen(self, first: int, end: int) -> list[Record]:
        """Return what the journal says of the turns first..end - 1.

        An observation that came late stands, with its control, in the line of its own turn.

        Raises
        ------
        FileNotFoundError
            Another flight has taken the place of this one; `update` tells it.
        """
        with self._path.open("rb") as file:
            if self._begun_anew(os.fstat(file.fileno())):
                raise FileNotFoundError(self._path)
            return [self._turn(file, turn) for turn in range(first, end)]

    def _turn(self, file: BinaryIO, turn: int) -> Record:
        believed, observed = self._places[turn]
        record = next(records_of(file, self._path, believed))[0]
        if observed != believed:
            own = next(records_of(file, self._path, observed))[0]
            record |= {name: own[name] for name in ("observed", "control_index")}
        return record | {"notices": record.get("notices", []) + self._told.get(turn, [])}

    def observed(self, turns: Sequence[Record]) -> Float:
        """Return what the sensors said in n turns: (n, G), SI; NaN where lost."""
        sensors = self.scenario.observation.count
        return np.array([array_of(turn["observed"][:sensors]) for turn in turns])

    def truth(self, turns: Sequence[Record]) -> Float:
        """Return the true state of n turns: (n, K), SI; NaN where nobody knows it."""
        unknown = [None] * len(self.scenario.state)
        return np.array([array_of(turn.get("state", unknown)) for turn in turns])

    def believed(self, turns: Sequence[Record]) -> Belief:
        """Return what the twin believed of each of n turns when it was flown."""
        joint = known_control(
            np.array([turn["filtered"] for turn in turns]),
            [turn["control_index"] for turn in turns],
            len(self.knowledge.model.controls),
        )
        decided, observed = np.array([turn["decision_probability"] for turn in turns]), self.observed(turns)
        if self.knowledge.expectation is None:
            return self._belief(joint, observed, decided)
        parts = []
        for turn, own, seen in zip(turns, joint, observed, strict=True):
            u = slice(turn["control_index"], turn["control_index"] + 1)
            parts.append(self.knowledge.expectation.of_marginals(_learnt(turn), own[None, :, u], u, seen))
        together = {name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])}
        return Belief(joint.sum(axis=-1), Expected(**together), decided)

    def predicted(self, turn: Record) -> Belief:
        """Return what the twin expected after a turn of the H turns to come."""
        model, plan = self.knowledge.model, self.knowledge.plan
        horizon, filtered = self.scenario.mission.prediction_steps, array_of(turn["filtered"])
        coming = predict(model, filtered, turn["control_index"], plan.policy, horizon)
        if self.knowledge.expectation is None:
            return self._belief(coming.joint, None, coming.control_probability)
        expected = self.knowledge.expectation.of_marginals(_learnt(turn), coming.joint, slice(None), None)
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
