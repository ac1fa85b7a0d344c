"""A turn of a watch as a line of its journal."""

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin_master.mission.journal import JournalFile, belief_record, plain
from twin_master.mission.loop import Reading
from twin_master.network.twin import Twin, TwinTurn
from twin_master.watch.intake import Intake
from twin_master.watch.replay import SNAPSHOT_TURNS
from twin_master.watch.teaching import Tutor


class Keeper:
    """Writes a turn down, with what the operator is to be told beside its own notices.

    Parameters
    ----------
    journal : JournalFile
    intake : Intake
        Of the readings.
    twin : Twin
        That is watched with; another one where it was taught.

    Attributes
    ----------
    tutor : Tutor or None
        What teaches the twin.
    told : list
        Notices that the last line has beside those of its turn.
    filtered : (S,) or None
        What was believed after the last turn; None before the first one of this process.
    """

    def __init__(self, journal: JournalFile, intake: Intake, twin: Twin) -> None:
        self._journal, self.intake, self.twin = journal, intake, twin
        self.tutor: Tutor | None = None
        self.told: list[dict[str, Any]] = []
        self.filtered: NDArray[np.float64] | None = None

    def __call__(self, reading: Reading, turn: TwinTurn) -> None:
        """Write down a reading and what became of it."""
        at, self.filtered = self.intake.observation_turn, turn.filtered
        record: dict[str, Any] = {
            "turn": turn.turn,
            "observation_turn": at,
            "observed": plain(reading.observed),
            "control_index": self.twin.control_of(at),
            "next_control": turn.next_control,
            "intake": self.intake.state(),
        }
        if turn.turn % SNAPSHOT_TURNS == SNAPSHOT_TURNS - 1 and reading.revises is None:
            record["twin_state"] = base64.b64encode(self.twin.save_state()).decode("ascii")
        record |= belief_record(turn)
        known = {(notice.kind, notice.sensors) for notice in turn.notices}
        self.told = [vars(n) for n in self.intake.notices if (n.kind, n.sensors) not in known]
        if self.tutor is not None:
            self.told += self.tutor.teaching.untold
        if self.told:
            record["notices"] = record.get("notices", []) + self.told
        self._journal.append(record)
        if self.tutor is not None:
            self.tutor.teaching.take(record)
