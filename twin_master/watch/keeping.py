"""A turn of a watch as a line of its journal."""

import base64
import time
from collections.abc import Mapping
from typing import Any

from twin_master.mission.journal import JournalFile, belief_record, plain
from twin_master.mission.loop import Reading
from twin_master.network.twin import Twin, TwinTurn
from twin_master.watch.intake import Intake
from twin_master.watch.replay import SNAPSHOT_TURNS
from twin_master.watch.teaching import Tutor, notice_of


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
    quiet : bool
        Whether the operator was told that no turn comes any more.
    """

    def __init__(self, journal: JournalFile, intake: Intake, twin: Twin) -> None:
        self._journal, self.intake, self.twin = journal, intake, twin
        self.tutor: Tutor | None = None
        self.told: list[dict[str, Any]] = []
        self.quiet, self._heard = False, time.monotonic()

    @property
    def silence(self) -> float:
        """How long no turn has come [s]."""
        return time.monotonic() - self._heard

    def __call__(self, reading: Reading, turn: TwinTurn) -> None:
        """Write down a reading and what became of it."""
        at = self.intake.observation_turn
        record: dict[str, Any] = {
            "turn": turn.turn,
            "observation_turn": at,
            "observed": plain(reading.observed),
            "control_index": self.twin.control_of(at),
            "next_control": turn.next_control,
            "intake": self.intake.state(),
        }
        if reading.revises is not None:
            record["control_in_force"] = turn.control_index
        if turn.turn % SNAPSHOT_TURNS == SNAPSHOT_TURNS - 1 and reading.revises is None:
            record["twin_state"] = base64.b64encode(self.twin.save_state()).decode("ascii")
        record |= belief_record(turn)
        self.told = [] if self.tutor is None else list(self.tutor.teaching.untold)
        if self.quiet:
            sentence = f"Turn {turn.turn}: observations come again, after {self.silence:.0f} s."
            self.told.append(notice_of("heard", sentence))
        if self.told:
            record["notices"] = record.get("notices", []) + self.told
        self._journal.append(record)
        self.quiet, self._heard = False, time.monotonic()
        if self.tutor is not None:
            self.tutor.teaching.take(record)

    def write(self, record: Mapping[str, Any]) -> dict[str, Any]:
        """Write down something else than a turn; return its line."""
        state = {"next_control": self.twin.proposed_control, "intake": self.intake.state()}
        line = {"turn": self.twin.turns - 1, **state, **record}
        self._journal.append(line)
        return line
