"""The checkpoint of a mission: what cannot be computed again, in the journal of its run folder.

That is what was observed, what was commanded, what really happened, and the state of the asset. The twin's
beliefs follow from the observations; they are computed again on resuming, and the decisions must come out as
they were taken. Beside it a line has the belief of the turn, for those who read along.
"""

import base64
import binascii
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from twin_master.mission.journal import (
    JOURNAL_NAME,
    JournalFile,
    array_of,
    belief_record,
    damaged,
    line_of,
    open_journal,
    plain,
    read_records,
)
from twin_master.mission.loop import Checkpoint
from twin_master.mission.turns import Happened, Reading, Turn

STATE_ALLOWANCE = 64_000_000
STATE_SHARE = 4_000
"""Bytes of asset states that a checkpoint may hold, and how many more for each turn.

States that need more are kept less often, so that the file grows with the turns and not with their square
(an asset that is replayed keeps the inputs of all its steps); the turns after the last one are flown again.
"""


class CheckpointFile:
    """The checkpoint of a run folder, open to be continued.

    Attributes
    ----------
    checkpoint : Checkpoint or None
        Where an earlier process stopped; None if no turn was finished.
    turns : int
        Turns in the file.
    """

    def __init__(self, path: Path, config_hash: str, journal: JournalFile) -> None:
        self._journal = journal
        readings: list[Reading] = []
        decided: list[int] = []
        whole, state, size, end = 0, "", 0, len(line_of({"config_hash": config_hash}))
        self._state_bytes = 0
        for record, behind in read_records(path, config_hash):
            if record.get("turn") != len(readings):
                raise damaged(path, len(readings) + 1, f"turn {len(readings)} was expected")
            try:
                readings.append(_reading(record))
                decided.append(int(record["next_control"]))
                size += len(record["asset_state"] or "")
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                raise damaged(path, len(readings), f"it has another layout, {error}") from error
            if record["asset_state"] is not None:
                whole, state, self._state_bytes, end = len(readings), record["asset_state"], size, behind
        try:
            content = zlib.decompress(base64.b64decode(state)) if whole else b""
        except (TypeError, ValueError, zlib.error, binascii.Error) as error:
            raise damaged(path, whole, f"it has another layout, {error}") from error
        self.turns = whole
        self.checkpoint = Checkpoint(readings[:whole], decided[:whole], content) if whole else None
        if whole < len(readings):  # without the state of the asset they are flown again
            journal.truncate(end)

    def keep(self, turn: Turn, asset_state: bytes) -> None:
        """Add a turn; it is on the disk when this returns.

        Raises
        ------
        FileNotWrittenError
            The disk is full or the folder cannot be written; the turns before are still there.
        """
        happened = turn.reading.happened
        assert happened is not None  # of a simulated asset
        self.turns += 1
        state: str | None = base64.b64encode(zlib.compress(asset_state, 1)).decode("ascii")
        if self._state_bytes + len(state or "") > STATE_ALLOWANCE + STATE_SHARE * self.turns:
            state = None
        self._state_bytes += len(state or "")
        self._journal.append(
            {
                "turn": self.turns - 1,
                "control_index": turn.concluded.control_index,
                "next_control": turn.concluded.next_control,
                "observed": plain(turn.reading.observed),
                "state": plain(happened.state),
                "observation": plain(happened.observation),
                "monitors": dict(zip(happened.monitors, plain([*happened.monitors.values()]), strict=True)),
                "asset_state": state,
                **belief_record(turn.concluded),
            }
        )


@contextmanager
def open_checkpoint(folder: Path, config_hash: str) -> Iterator[CheckpointFile]:
    """Open the checkpoint of a run folder, to be read and continued.

    Parameters
    ----------
    folder
        The run folder, held by this process.
    config_hash
        SHA-256 of the configuration that the mission belongs to.

    Raises
    ------
    NotResumableError
        The journal was changed or is damaged, or belongs to another configuration.
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """
    with open_journal(folder, config_hash) as journal:
        yield CheckpointFile(folder / JOURNAL_NAME, config_hash, journal)


def _reading(record: dict[str, Any]) -> Reading:
    monitors = record["monitors"]
    told = dict(zip(monitors, array_of(list(monitors.values())).tolist(), strict=True))
    happened = Happened(array_of(record["state"]), array_of(record["observation"]), told)
    return Reading(array_of(record["observed"]), int(record["control_index"]), happened=happened)
