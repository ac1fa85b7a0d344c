"""The turns of a run or a watch, read from its journal while it grows.

This is the one place that knows how a journal tells its turns: see `twin_master.mission.journal`.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin_master.mission.journal import JOURNAL_NAME, array_of, damaged, whole_record
from twin_master.network.estimator import Learnt, Notice

Float = NDArray[np.float64]


@dataclass(frozen=True)
class SeenTurn:
    """What a line of the journal says.

    Attributes
    ----------
    turn : int
        The turn that the twin was at.
    observation_turn : int
        The turn that was observed; an earlier one where the observation came late.
    control_index : int
        Control in force in the turn that was observed.
    observed : (G,)
        What the sensors said, SI; NaN where lost.
    truth : (K,) or None
        True state, SI; None where nobody knows it.
    filtered : (S,)
        Belief about the turn that the twin was at.
    decision_probability : (U,)
        What its next control was decided by.
    learnt : dict of str to Learnt
        Posterior of what is learnt.
    notices : tuple of Notice
        What the operator was told.
    """

    turn: int
    observation_turn: int
    control_index: int
    observed: Float
    truth: Float | None
    filtered: Float
    decision_probability: Float
    learnt: Mapping[str, Learnt]
    notices: tuple[Notice, ...]


@dataclass(frozen=True)
class News:
    """A line that was added to a journal.

    Attributes
    ----------
    place : int
        Where it begins, in bytes, see `GrowingJournal.read`.
    seen : SeenTurn or None
        The turn that it tells; None where it is of the watch itself, such as a model that was adopted.
    notices : tuple of Notice
        What the operator was told where no turn came.
    verdict : str
        Folder of the verdict that came, or whose patch was adopted, in that of the watch; empty: none.
    """

    place: int
    seen: SeenTurn | None
    notices: tuple[Notice, ...] = ()
    verdict: str = ""


class GrowingJournal:
    """A journal that grows; each call of `news` gives the lines that were added since the last.

    Parameters
    ----------
    folder : Path
        The run folder; the journal need not be there yet.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / JOURNAL_NAME
        self._begin()

    def _begin(self) -> None:
        self._end, self._lines, self._file_number = 0, 0, 0

    def begun_anew(self) -> bool:
        """Return whether another file took the place of the one read, or lines were taken back.

        What was read is then forgotten, and `news` begins with the first line.
        """
        try:
            found = self._path.stat()
        except FileNotFoundError:
            return False
        if found.st_size >= self._end and self._file_number in (0, found.st_ino):
            return False
        self._begin()
        return True

    def news(self, most: int) -> list[News]:
        """Return what whole new lines tell, of at most so many.

        Raises
        ------
        NotResumableError
            A line was changed.
        """
        found: list[News] = []
        try:
            if self._path.stat().st_size == self._end:
                return []
            with self._path.open("rb") as file:
                self._file_number = os.fstat(file.fileno()).st_ino
                file.seek(self._end)
                for line in file:
                    if len(found) == most or not line.endswith(b"\n"):  # one that is being written
                        break
                    record = self._record(line, self._lines)
                    if self._end:  # not the heading
                        seen = _seen(record) if "filtered" in record else None
                        told = () if seen else _notices(record)
                        verdict = record.get("verdict", {}).get("folder", "")
                        verdict = record.get("model", {}).get("verdict", verdict)
                        found.append(News(self._end, seen, told, verdict))
                    self._end += len(line)
                    self._lines += 1
        except FileNotFoundError:
            pass
        return found

    def read(self, places: Sequence[int]) -> list[SeenTurn] | None:
        """Return the turns told by lines that were news; None where the journal was begun anew since.

        Raises
        ------
        NotResumableError
            A line was changed.
        """
        try:
            with self._path.open("rb") as file:
                if os.fstat(file.fileno()).st_ino != self._file_number:
                    return None
                found = []
                for place in places:
                    file.seek(place)
                    found.append(_seen(self._record(file.readline(), None)))
                return found
        except FileNotFoundError:
            return None

    def _record(self, line: bytes, number: int | None) -> dict[str, Any]:
        record = whole_record(line)
        if record is None:
            raise damaged(self._path, number or 0, "it does not have the hash that stands before it")
        return record


def _seen(record: Mapping[str, Any]) -> SeenTurn:
    return SeenTurn(
        turn=record["turn"],
        observation_turn=record.get("observation_turn", record["turn"]),
        control_index=record["control_index"],
        observed=array_of(record["observed"]),
        truth=array_of(record["state"]) if "state" in record else None,
        filtered=array_of(record["filtered"]),
        decision_probability=array_of(record["decision_probability"]),
        learnt={name: Learnt(**learnt) for name, learnt in record.get("learnt", {}).items()},
        notices=_notices(record),
    )


def _notices(record: Mapping[str, Any]) -> tuple[Notice, ...]:
    return tuple(Notice(**notice) for notice in record.get("notices", ()))
