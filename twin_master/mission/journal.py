"""The journal of a run or a watch, `journal.jsonl`: a line for each step, behind the SHA-256 of it.

The file only grows. A line that was cut off by a kill ends without a line feed and is dropped; any other line
that does not have its hash was changed. It is read line by line, however long it is.
"""

import base64
import io
import json
import math
import os
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np

from reporting.arrays import Float
from reporting.files import explained_write_errors, synchronise, write_error
from reporting.former_names import with_present_names
from reporting.json_file import plain
from twin_master.errors import NotResumableError, said
from twin_master.mission.steps import Happened, MissionStep, Reading

JOURNAL_NAME = "journal.jsonl"
PRESENT_NAMES = {
    "turn": "step",
    "observation_turn": "observation_step",
    "settled.turn": "step",
    "model.from_turn": "from_step",
    "verdict.turn": "step",
    "verdict.from_turn": "from_step",
    "verdict.to_turn": "to_step",
    "intake.stream.turns": "steps",
    "quiet.turn": "step",
    "quiet.revised_by_turn": "revised_by_step",
    "refused.turn": "step",
    "refused.revised_by_turn": "revised_by_step",
    "standing.teaching.turn": "step",
    "standing.teaching.trial.turn": "step",
    "standing.teaching.trial.from_turn": "from_step",
    "standing.teaching.trial.to_turn": "to_step",
    "standing.teaching.adopted.from_turn": "from_step",
}
"""The present name of each key of a journal, by the location that it had before."""
_DIGEST = 64
_PIECE = 1_000_000
_ENCODER = json.JSONEncoder(sort_keys=True, allow_nan=False, separators=(", ", ": "))


def state_text(state: bytes) -> str:
    """Return the state of an asset or a twin as lines hold it."""
    return base64.b64encode(zlib.compress(state, 1)).decode("ascii")


def state_of(text: Any) -> bytes:
    """Return a state from its text; raises `TypeError`, `ValueError` or `zlib.error`."""
    return zlib.decompress(base64.b64decode(text))


def array_of(values: Any) -> Float:
    """Return numbers of JSON as an array, null as NaN."""
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)


def step_record(step: MissionStep) -> dict[str, Any]:
    """Return what a line says of a step: what came, and the belief for viewers, who need not filter again."""
    concluded = step.concluded
    record: dict[str, Any] = {
        "step": concluded.step,
        "observed": plain(step.reading.observed),
        "control_index": concluded.control_index,
        "next_control": concluded.next_control,
        "decision_probability": concluded.decision_probability.tolist(),
        "filtered": concluded.filtered.tolist(),
        "log_evidence": concluded.log_evidence,
    }
    if step.reading.happened is not None:
        record |= plain(step.reading.happened._asdict())
    if concluded.learnt:
        record["learnt"] = {name: vars(learnt) for name, learnt in concluded.learnt.items()}
    if concluded.notices:
        record["notices"] = [notice.as_record() for notice in concluded.notices]
    if concluded.suspicion is not None:
        record["suspicion"] = plain(vars(concluded.suspicion))
    return record


def reading_of(record: Mapping[str, Any]) -> Reading:
    """Return what came in a step, from its line; raises `KeyError`, `TypeError` or `ValueError`."""
    happened = None
    if "monitors" in record:
        told = dict(zip(record["monitors"], array_of(record["monitors"].values()).tolist(), strict=True))
        happened = Happened(array_of(record["state"]), array_of(record["observation"]), told)
    return Reading(array_of(record["observed"]), int(record["control_index"]), happened=happened)


class JournalFile:
    """The journal of a run folder that this process holds, open to be continued.

    Parameters
    ----------
    folder : Path
        The run folder; the file need not exist.
    config_hash : str
        SHA-256 of the configuration that it belongs to.
    flush_seconds : float
        Seconds after which what was appended is flushed to the disk; 0 flushes after every line. A kill of
        the process loses nothing either way: only a machine that loses its power needs the flush.

    Attributes
    ----------
    path : Path
    size : int
        Bytes of its whole lines.

    Raises
    ------
    NotResumableError
        It was changed or is damaged, or belongs to another configuration.
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """

    def __init__(self, folder: Path, config_hash: str, flush_seconds: float = 0.0) -> None:
        self.path, self._flush_seconds = folder / JOURNAL_NAME, flush_seconds
        self._flushed = time.monotonic()
        with explained_write_errors(self.path):
            check_header(self.path, config_hash)
            self.size = next((end for _, _, end in records_backwards(self.path)), 0)
            self._descriptor = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
            os.truncate(self._descriptor, self.size)
            if not self.size:
                self.append({"config_hash": config_hash})
                self.flush()
                synchronise(folder)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        with suppress(OSError):
            os.fsync(self._descriptor)
        os.close(self._descriptor)

    def truncate(self, size: int) -> None:
        """Drop what lies beyond a size in bytes, the end of some line."""
        self.size = size
        os.truncate(self._descriptor, size)

    def append(self, record: Mapping[str, Any]) -> None:
        """Add a line; it survives a kill of this process when this returns.

        Raises
        ------
        FileNotWrittenError
            The disk is full or the folder cannot be written; the lines before are still there.
        """
        line, written = line_of(record), 0
        try:
            while written < len(line):
                written += os.write(self._descriptor, line[written:])
            if time.monotonic() - self._flushed >= self._flush_seconds:
                self.flush()
        except OSError as error:
            with suppress(OSError):
                os.truncate(self._descriptor, self.size)
            raise write_error(error, self.path) from error
        self.size += len(line)

    def flush(self) -> None:
        """Flush what was appended to the disk."""
        os.fsync(self._descriptor)
        self._flushed = time.monotonic()


def line_of(record: Mapping[str, Any]) -> bytes:
    """Return a record as a line with its hash."""
    text = _ENCODER.encode(record).encode("ascii")
    return sha256(text).hexdigest().encode("ascii") + b" " + text + b"\n"


def check_header(path: Path, config_hash: str) -> None:
    """Refuse a journal whose first line was changed or is damaged, or of another configuration."""
    header = line_of({"config_hash": config_hash})
    with suppress(FileNotFoundError), path.open("rb") as file:
        found = file.readline()
        if whole_record(found, path) is None and not header.startswith(found):  # nor cut off by a kill
            raise damaged(path, 0, "it does not have the hash that stands before it")
        if not header.startswith(found):
            raise NotResumableError(said("mission.journal", path=path))


def records(path: Path, begin: int = 0) -> Iterator[tuple[dict[str, Any], int, int]]:
    """Return the record of each whole line with where it begins and ends in bytes; the header is left out.

    A journal that does not exist, or whose header was cut off, has no lines.

    Parameters
    ----------
    path : Path
    begin : int
        Of the first line, in bytes.

    Raises
    ------
    NotResumableError
        A line was changed or is damaged.
    """
    if path.exists():
        with path.open("rb") as file:
            yield from records_of(file, path, begin)


def records_of(file: BinaryIO, path: Path, begin: int = 0) -> Iterator[tuple[dict[str, Any], int, int]]:
    """Return the records of an open journal, see `records`."""
    file.seek(begin)
    for line in file:
        if not line.endswith(b"\n"):
            return  # cut off by a kill
        record = whole_record(line, path)
        if record is None:
            raise damaged(path, begin, "it does not have the hash that stands before it")
        if begin:
            yield record, begin, begin + len(line)
        begin += len(line)


def whole_record(line: bytes, path: Path) -> dict[str, Any] | None:
    """Return the record of a line of the journal at `path`, or None where the line was changed.

    Each line has a hash of its own. A line of an earlier version is returned with the present names.
    """
    text = line[_DIGEST + 1 :].rstrip(b"\n")
    whole = sha256(text).hexdigest().encode("ascii") == line[:_DIGEST]
    record = json.loads(text) if whole else None
    if not isinstance(record, dict):
        return None
    if "turn" in record:
        return with_present_names(record, PRESENT_NAMES, str(path), NotResumableError)
    return record


def records_backwards(path: Path, end: int | None = None) -> Iterator[tuple[dict[str, Any], int, int]]:
    """Return the record of each line with where it begins and ends in bytes, the last one first.

    The header is the last of them. A journal that does not exist has no lines. It is read, and checked, no
    further than it is asked.

    Parameters
    ----------
    path : Path
    end : int, optional
        Of a line, in bytes: those behind it are left out.

    Raises
    ------
    NotResumableError
        A line was changed or is damaged.
    """
    if not path.exists():
        return
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        begin = after = size if end is None else end
        rest = b""
        while begin:
            piece = min(begin, _PIECE)
            begin -= piece
            file.seek(begin)
            first, *lines = io.BytesIO(file.read(piece) + rest).readlines()
            rest, lines = (first, lines) if begin else (b"", [first, *lines])
            for line in reversed(lines):
                after -= len(line)
                record = whole_record(line, path) if line.endswith(b"\n") else None
                if record is not None:
                    yield record, after, after + len(line)
                elif line.endswith(b"\n") or after + len(line) < size:  # else cut off by a kill
                    raise damaged(path, after, "it does not have the hash that stands before it")


def last_step(path: Path, limit: float = math.inf) -> tuple[int, int]:
    """Return the last step of a journal up to a limit, -1 for none, and where its lines end in bytes.

    Raises
    ------
    NotResumableError
        A line at the end was changed or is damaged.
    """
    lines = ((int(record.get("step", -1)), end) for record, _, end in records_backwards(path))
    return next(((step, end) for step, end in lines if step <= limit), (-1, 0))


def damaged(path: Path, begin: int, why: str) -> NotResumableError:
    """Return the exception for the line that begins at so many bytes, which cannot be believed."""
    number, whole, end = 1, {True: 0, False: 0}, 0
    with path.open("rb") as file:
        for line in file:
            number += end < begin
            whole[end < begin] += end != begin and whole_record(line, path) is not None
            end += len(line)
    found = {"line": number, "before": whole[True], "behind": whole[False]}
    return NotResumableError(said("mission.damaged", path=path, why=why, **found))
