"""A turn of a watch as a line of its journal, and what follows from all of its lines."""

import base64
import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin_master.mission.journal import JournalFile, damaged, records_backwards, turn_record
from twin_master.mission.turns import Turn
from twin_master.network.estimator import Notice
from twin_master.network.twin import Twin
from twin_master.watch.intake import Intake
from twin_master.watch.teaching import Teaching

SNAPSHOT_TURNS = 32
"""Turns between two lines that also hold the state of the twin."""

CHECKED = 250_000
"""Bytes at the end of a journal that are read at least, so that damage there is found."""


@dataclass
class Standing:
    """What follows from all lines of a journal so far.

    Each line holds what followed from those before it, so that the last one alone is read, however long the
    journal is.

    Attributes
    ----------
    teaching : Teaching
    adopted : list of dict
        The models that were adopted, as the journal has them.
    """

    teaching: Teaching
    adopted: list[dict[str, Any]] = field(default_factory=list)

    def take(self, record: Mapping[str, Any]) -> None:
        """Take in a line."""
        self.adopted += [record["model"]] if "model" in record else []
        self.teaching.take(record)

    def before(self, begin: int) -> dict[str, Any]:
        """Return what a line holds that begins at so many bytes."""
        return {"begin": begin, "adopted": self.adopted, "teaching": self.teaching.state()}

    def read(self, path: Path) -> None:
        """Take in a journal; raises `NotResumableError` where its end was changed or is damaged."""
        last, length = dict[str, Any](), 0
        for record, begin, end in records_backwards(path):
            length, last = length or end, last or record
            if begin and record["standing"]["begin"] != begin:
                raise damaged(path, begin, "lines before it are missing, or not its own")
            if length - begin > CHECKED:
                break
        if "standing" in last:
            self.adopted = last["standing"]["adopted"]
            self.teaching.restore(last["standing"]["teaching"])
            self.take(last)


class Keeper:
    """Writes a turn down, with what the operator is to be told beside its own notices.

    Parameters
    ----------
    journal : JournalFile
    intake : Intake
        Of the readings.
    twin : Twin
        That is watched with; another one where it was taught.
    standing : Standing
        After all lines of the journal.

    Attributes
    ----------
    journal, intake, twin
    taught : bool
        Whether the twin is taught.
    line : dict
        The last line of a turn that was written down.
    filtered : (S,) or None
        What was believed after the last turn; None before the first one of this process.
    quiet : bool
        Whether the operator was told that no turn comes any more.
    """

    def __init__(self, journal: JournalFile, intake: Intake, twin: Twin, standing: Standing) -> None:
        self.journal, self.intake, self.twin, self._standing = journal, intake, twin, standing
        self.taught = False
        self.line: dict[str, Any] = {}
        self.filtered: NDArray[np.float64] | None = None
        self.quiet, self._heard = False, time.monotonic()

    @property
    def silence(self) -> float:
        """How long no turn has come [s]."""
        return time.monotonic() - self._heard

    def __call__(self, turn: Turn) -> None:
        """Write down a reading and what became of it."""
        reading, concluded, at = turn.reading, turn.concluded, self.intake.observation_turn
        number, self.filtered = concluded.turn, concluded.filtered
        record = turn_record(turn) | {
            "observation_turn": at,
            "control_index": self.twin.control_of(at),
            "intake": self.intake.state(),
        }
        if reading.revises is not None:
            record["control_in_force"] = concluded.control_index
        elif number % SNAPSHOT_TURNS == SNAPSHOT_TURNS - 1 and (settled := self.twin.settled()):
            state = base64.b64encode(zlib.compress(settled[1], 1)).decode("ascii")
            record["settled"] = {"turn": settled[0], "state": state}
        known = {(notice.kind, notice.sensors) for notice in concluded.notices}
        told = [n.as_record() for n in self.intake.notices if (n.kind, n.sensors) not in known]
        told += self._standing.teaching.untold if self.taught else []
        if self.quiet:
            sentence = f"Turn {number}: observations come again, after {self.silence:.0f} s."
            told.append(Notice("heard", sentence).as_record())
        if told:
            record["notices"] = record.get("notices", []) + told
        self._append(record)
        self.line = record
        self.quiet, self._heard = False, time.monotonic()

    def write(self, record: Mapping[str, Any]) -> None:
        """Write down something else than a turn."""
        state = {"next_control": self.twin.proposed_control, "intake": self.intake.state()}
        self._append({"turn": self.twin.turns - 1, **state, **record})

    def _append(self, record: Mapping[str, Any]) -> None:
        """Add a line to the journal, and take it in."""
        self.journal.append({**record, "standing": self._standing.before(self.journal.size)})
        self._standing.take(record)
