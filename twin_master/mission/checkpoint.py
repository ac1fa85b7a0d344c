"""The checkpoint of a mission: what cannot be computed again, a line for each turn.

That is what was observed, what was commanded, what really happened, and the state of the asset. The twin's
beliefs follow from the observations; they are computed again on resuming, and the decisions must come out as
they were taken.

The file only grows: a turn is one line, its JSON behind the SHA-256 of it. A line that was cut off by a kill
ends without a line feed, and is flown again; any other line that does not have its hash was changed.
"""

import base64
import binascii
import io
import json
import os
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reporting.files import write_error
from twin_master.errors import NotResumableError
from twin_master.mission.plant import PlantRecord

Float = NDArray[np.float64]
Index = NDArray[np.int64]

CHECKPOINT_NAME = "checkpoint.jsonl"
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
    """

    control_index: int
    next_control: int
    observed: Float
    state: Float
    observation: Float
    monitors: dict[str, float]
    asset_state: bytes | None


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

    def __init__(self, path: Path, config_hash: str) -> None:
        self._path = path
        header = _line({"config_hash": config_hash})
        content = path.read_bytes() if path.exists() else b""
        turns: list[FlownTurn] = []
        ends: list[int] = []
        kept = [0]
        if not header.startswith(content):  # one that was cut off is no damage
            turns, ends, kept = _read(path, content, config_hash)
        self.checkpoint = checkpoint_of(turns)
        count = self.checkpoint.turns if self.checkpoint else 0
        self.turns, self._state_bytes = count, kept[count]
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
        if content.startswith(header):
            self._size = ends[count - 1] if count else len(header)
            os.truncate(self._descriptor, self._size)
        else:
            self._size = 0
            os.truncate(self._descriptor, 0)
            self._append(header)
            _synchronise_folder(path.parent)

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
        self._append(
            _line(
                {
                    "turn": self.turns - 1,
                    "control_index": turn.control_index,
                    "next_control": turn.next_control,
                    "observed": turn.observed.tolist(),
                    "state": turn.state.tolist(),
                    "observation": turn.observation.tolist(),
                    "monitors": turn.monitors,
                    "asset_state": state,
                }
            )
        )

    def _append(self, line: bytes) -> None:
        try:
            written = 0
            while written < len(line):
                written += os.write(self._descriptor, line[written:])
            os.fsync(self._descriptor)
        except OSError as error:
            with suppress(OSError):
                os.truncate(self._descriptor, self._size)
            raise write_error(error, self._path) from error
        self._size += len(line)

    def close(self) -> None:
        """Let go of the file."""
        os.close(self._descriptor)


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
        The checkpoint was changed or is damaged, or belongs to another configuration.
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """
    path = folder / CHECKPOINT_NAME
    try:
        file = CheckpointFile(path, config_hash)
    except OSError as error:
        raise write_error(error, path) from error
    try:
        yield file
    finally:
        file.close()


def _line(record: dict[str, Any]) -> bytes:
    text = json.dumps(record, sort_keys=True).encode("ascii")
    return sha256(text).hexdigest().encode("ascii") + b" " + text + b"\n"


def _read(path: Path, content: bytes, config_hash: str) -> tuple[list[FlownTurn], list[int], list[int]]:
    """Return the turns, where their lines end, and the bytes of asset states up to each number of turns."""
    turns: list[FlownTurn] = []
    ends: list[int] = []
    kept = [0]
    end = 0
    for number, line in enumerate(io.BytesIO(content)):
        if number and not line.endswith(b"\n"):
            break  # cut off by a kill
        end += len(line)
        record = _record(path, line, number)
        if not number:
            if record.get("config_hash") != config_hash:
                raise NotResumableError(
                    f"the checkpoint {path} belongs to another configuration than the config.json beside it: "
                    "fly the mission again with --replace."
                )
            continue
        if record.get("turn") != len(turns):
            raise _damaged(path, number, f"turn {len(turns)} was expected")
        try:
            state = record["asset_state"]
            turns.append(
                FlownTurn(
                    control_index=int(record["control_index"]),
                    next_control=int(record["next_control"]),
                    observed=np.array(record["observed"], dtype=np.float64),
                    state=np.array(record["state"], dtype=np.float64),
                    observation=np.array(record["observation"], dtype=np.float64),
                    monitors=dict(record["monitors"]),
                    asset_state=None if state is None else zlib.decompress(base64.b64decode(state)),
                )
            )
        except (KeyError, TypeError, ValueError, zlib.error, binascii.Error) as error:
            raise _damaged(path, number, f"it has another layout, {error}") from error
        ends.append(end)
        kept.append(kept[-1] + len(state or ""))
    return turns, ends, kept


def _record(path: Path, line: bytes, number: int) -> dict[str, Any]:
    digest, _, text = line.rstrip(b"\n").partition(b" ")
    if sha256(text).hexdigest().encode("ascii") != digest:
        raise _damaged(path, number, "it does not have the hash that stands before it")
    record = json.loads(text)
    if not isinstance(record, dict):
        raise _damaged(path, number, "it is no record")
    return record


def _damaged(path: Path, number: int, why: str) -> NotResumableError:
    return NotResumableError(
        f"line {number + 1} of the checkpoint {path} was changed or is damaged ({why}): "
        "fly the mission again with --replace."
    )


def _synchronise_folder(folder: Path) -> None:
    """Flush a folder to the disk, so that a file that is new in it is found again."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # some file systems cannot
            os.fsync(descriptor)
    finally:
        os.close(descriptor)
