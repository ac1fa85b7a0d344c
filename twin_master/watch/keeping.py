"""A turn of a watch as a line of its journal, and what follows from all of its lines."""

import base64
import time
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin_master.mission.journal import JournalFile, turn_record
from twin_master.mission.turns import Turn
from twin_master.network.estimator import Notice
from twin_master.network.twin import Twin
from twin_master.watch.intake import Intake
from twin_master.watch.teaching import Teaching

SNAPSHOT_TURNS = 32
"""Turns between two lines that also hold the state of the twin."""


class Keeper:
    """Writes a turn down, with what the operator is to be told beside its own notices.

    Parameters
    ----------
    journal : JournalFile
    intake : Intake
        Of the readings.
    twin : Twin
        That is watched with; another one where it was taught.
    teaching : Teaching
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

    def __init__(self, journal: JournalFile, intake: Intake, twin: Twin, teaching: Teaching) -> None:
        self.journal, self.intake, self.twin, self._teaching = journal, intake, twin, teaching
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
        told += self._teaching.untold if self.taught else []
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
        standing = {"begin": self.journal.size, "teaching": vars(self._teaching)}
        self.journal.append({**record, "standing": standing})
        self._teaching.take(record)
