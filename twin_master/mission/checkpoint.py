"""The checkpoint of a mission: what cannot be computed again, in the journal of its run folder.

That is what was observed, what was commanded, what really happened, and the state of the asset. The twin's
beliefs follow from the observations; they are computed again on resuming, and the decisions must come out as
they were taken. Beside it a line has the belief of the turn, for those who read along.
"""

import base64
import binascii
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
from twin_master.mission.plant import PlantRecord
from twin_master.network.twin import TwinTurn

Float = NDArray[np.float64]
Index = NDArray[np.int64]

STATE_ALLOWANCE = 64_000_000
STATE_SHARE = 4_000
"""Bytes of asset states that a checkpoint may hold, and how many more for each turn.

States that need more are kept less often, so that the file grows with the turns and not with their square
(an asset that is replayed keeps the inputs of all its steps); the turns after the last one are flown again.
"""


@dataclass(frozen=True)
class FlownTurn:
    """What cannot be computed again of one turn.

    Attributes
    ----------
    control_index, next_control : int
        Control in force, and the one decided for the next turn.
    observed : (G,)
        What the sensors said, SI; NaN where lost.
    state : (F,)
        True state, SI.
    observation : (G,)
        Noise-free observation, SI.
    monitors : dict of str to float
        Figures that the asset reported of itself.
    asset_state : bytes or None
        State of the asset after the turn; None where it was not kept.
    concluded : TwinTurn or None
        What the twin concluded, for those who read along; None once read back.
    """

    control_index: int
    next_control: int
    observed: Float
    state: Float
    observation: Float
    monitors: dict[str, float]
    asset_state: bytes | None
    concluded: TwinTurn | None = None


@dataclass(frozen=True)
class Checkpoint:
    """A mission after t turns.

    Attributes
    ----------
    observed : (t, G)
        What the sensors said, SI.
    control_index : (t + 1,)
        Controls flown, and the one decided for the next turn.
    plant : PlantRecord
        What really happened.
    asset_state : bytes
        State of the asset after the last turn.
    """

    observed: Float
    control_index: Index
    plant: PlantRecord
    asset_state: bytes

    @property
    def turns(self) -> int:
        """Number of turns flown."""
        return len(self.observed)


def checkpoint_of(turns: Sequence[FlownTurn]) -> Checkpoint | None:
    """Return where a mission stopped after these turns; None without a turn whose asset state was kept."""
    count = next((n for n in range(len(turns), 0, -1) if turns[n - 1].asset_state is not None), 0)
    if not count:
        return None
    flown, state = turns[:count], turns[count - 1].asset_state
    assert state is not None
    return Checkpoint(
        observed=np.array([turn.observed for turn in flown]),
        control_index=np.array([*(turn.control_index for turn in flown), flown[-1].next_control]),
        plant=PlantRecord(
            state=np.array([turn.state for turn in flown]),
            observation=np.array([turn.observation for turn in flown]),
            monitors={name: np.array([turn.monitors[name] for turn in flown]) for name in flown[-1].monitors},
        ),
        asset_state=state,
    )


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
        turns, ends, kept = _read(path, config_hash)
        self.checkpoint = checkpoint_of(turns)
        count = self.checkpoint.turns if self.checkpoint else 0
        self.turns, self._state_bytes = count, kept[count]
        if count < len(turns):  # without the state of the asset they are flown again
            journal.truncate(ends[count])

    def keep(self, turn: FlownTurn) -> None:
        """Add a turn; it is on the disk when this returns.

        Raises
        ------
        FileNotWrittenError
            The disk is full or the folder cannot be written; the turns before are still there.
        """
        self.turns += 1
        state = None
        if turn.asset_state is not None:
            packed = base64.b64encode(zlib.compress(turn.asset_state, 1)).decode("ascii")
            if self._state_bytes + len(packed) <= STATE_ALLOWANCE + STATE_SHARE * self.turns:
                state = packed
                self._state_bytes += len(packed)
        self._journal.append(
            {
                "turn": self.turns - 1,
                "control_index": turn.control_index,
                "next_control": turn.next_control,
                "observed": plain(turn.observed),
                "state": plain(turn.state),
                "observation": plain(turn.observation),
                "monitors": dict(zip(turn.monitors, plain(list(turn.monitors.values())), strict=True)),
                "asset_state": state,
            }
            | ({} if turn.concluded is None else belief_record(turn.concluded))
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


def _read(path: Path, config_hash: str) -> tuple[list[FlownTurn], list[int], list[int]]:
    """Return the turns, where the lines before and after them end, and the bytes of asset states so far."""
    turns: list[FlownTurn] = []
    ends, kept = [len(line_of({"config_hash": config_hash}))], [0]
    for record, end in read_records(path, config_hash):
        number = len(turns) + 1
        if record.get("turn") != len(turns):
            raise damaged(path, number, f"turn {len(turns)} was expected")
        try:
            state = record["asset_state"]
            turns.append(_turn(record, state))
        except (KeyError, TypeError, ValueError, AttributeError, zlib.error, binascii.Error) as error:
            raise damaged(path, number, f"it has another layout, {error}") from error
        ends.append(end)
        kept.append(kept[-1] + len(state or ""))
    return turns, ends, kept


def _turn(record: dict[str, Any], state: str | None) -> FlownTurn:
    monitors = record["monitors"]
    return FlownTurn(
        control_index=int(record["control_index"]),
        next_control=int(record["next_control"]),
        observed=array_of(record["observed"]),
        state=array_of(record["state"]),
        observation=array_of(record["observation"]),
        monitors=dict(zip(monitors, array_of(list(monitors.values())).tolist(), strict=True)),
        asset_state=None if state is None else zlib.decompress(base64.b64decode(state)),
    )
