"""The journal of a run or a watch, `journal.jsonl`: one line for each step.

A line is the SHA-256 hash of a JSON text, a blank, and the text. The file only grows. If the
process was killed while it wrote, the last line has no line feed and is dropped. Any other line
that does not match its hash was changed or is damaged. The file is read line by line, so that its
length does not matter.
"""

import base64
import io
import json
import math
import os
import time
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import BinaryIO, NamedTuple, Self

import numpy as np

from reporting.arrays import Float
from reporting.files import explained_write_errors, synchronise, write_error
from reporting.former_names import with_present_names
from reporting.json_file import JsonObject, plain
from reporting.operating_system import open_descriptor
from twin_master.errors import NotResumableError
from twin_master.mission.steps import GroundTruth, MissionStep, Reading

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
"""The present name of each renamed key, by the path of its former name in a record."""
_HASH_LENGTH = 64
"""Characters of a SHA-256 hash in hexadecimal digits."""
_BLOCK_SIZE = 1_000_000
"""Bytes that are read at once from the end of a journal."""
_WRONG_HASH = "its hash does not fit its content"
_ENCODER = json.JSONEncoder(sort_keys=True, allow_nan=False, separators=(", ", ": "))


class JournalLine(NamedTuple):
    """A line of a journal that matches its hash.

    Attributes
    ----------
    record : dict
        The content of the line.
    begin, end : int
        The positions of the first byte of the line and of the byte after its last one.
    """

    record: JsonObject
    begin: int
    end: int


def encode_state(state: bytes) -> str:
    """Return the state of an asset or a twin as compressed text for a line of the journal."""
    return base64.b64encode(zlib.compress(state, 1)).decode("ascii")


def decode_state(text: str) -> bytes:
    """Return the state from its text in a line.

    Raises
    ------
    TypeError, ValueError, zlib.error
        If the text is not a state that `encode_state` wrote.
    """
    return zlib.decompress(base64.b64decode(text))


def array_from_json(values: Iterable[float | None]) -> Float:
    """Return the numbers of a JSON list as an array, with NaN for null."""
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)


def step_record(step: MissionStep) -> JsonObject:
    """Return the record of a step for the journal.

    The record also contains the belief, so that a viewer need not filter the observations again.
    """
    twin_step = step.twin_step
    record: JsonObject = {
        "step": twin_step.step,
        "observed": plain(step.reading.observed),
        "control_index": twin_step.control_index,
        "next_control": twin_step.next_control,
        "decision_probability": twin_step.decision_probability.tolist(),
        "filtered": twin_step.filtered.tolist(),
        "log_evidence": twin_step.log_evidence,
    }
    if step.reading.ground_truth is not None:
        record |= plain(step.reading.ground_truth._asdict())
    if twin_step.learnt:
        record["learnt"] = {name: vars(learnt) for name, learnt in twin_step.learnt.items()}
    if twin_step.notices:
        record["notices"] = [notice.as_record() for notice in twin_step.notices]
    if twin_step.suspicion is not None:
        record["suspicion"] = plain(vars(twin_step.suspicion))
    return record


def reading_from_line(record: JsonObject) -> Reading:
    """Return the reading in a record of the journal, with the ground truth of a simulated asset.

    Raises
    ------
    KeyError, TypeError, ValueError
        If the record has another layout.
    """
    ground_truth = None
    if "monitors" in record:
        values = array_from_json(record["monitors"].values()).tolist()
        ground_truth = GroundTruth(
            state=array_from_json(record["state"]),
            observation=array_from_json(record["observation"]),
            monitors=dict(zip(record["monitors"], values, strict=True)),
        )
    observed_values = array_from_json(record["observed"])
    return Reading(observed_values, int(record["control_index"]), ground_truth=ground_truth)


class JournalFile:
    """The journal of a run folder that this process holds, open for appending.

    Parameters
    ----------
    folder : Path
        The run folder; the journal in it need not exist yet.
    config_hash : str
        The SHA-256 hash of the configuration that the journal belongs to.
    flush_seconds : float
        The time after which appended lines are flushed to the disk, in seconds; 0 flushes after
        every line. If the process is killed, no line is lost in either case: the flush protects
        only against a loss of power.

    Attributes
    ----------
    path : Path
        The path of the file.
    size : int
        The size of all complete lines, in bytes.

    Raises
    ------
    NotResumableError
        If the journal was changed or is damaged, or belongs to another configuration.
    FileNotWrittenError
        If the disk is full or the folder cannot be written.
    """

    def __init__(self, folder: Path, config_hash: str, flush_seconds: float = 0.0) -> None:
        self.path = folder / JOURNAL_NAME
        self._flush_seconds = flush_seconds
        self._flushed_at = time.monotonic()
        with explained_write_errors(self.path):
            check_header(self.path, config_hash)
            last_line = next(records_backwards(self.path), None)
            self.size = 0 if last_line is None else last_line.end
            self._descriptor = open_descriptor(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.truncate(self._descriptor, self.size)
            if self.size == 0:
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
        """Drop all lines after the first `size` bytes, which must be the end of a line."""
        self.size = size
        os.truncate(self._descriptor, size)

    def append(self, record: Mapping[str, object]) -> None:
        """Append a line; once this returns, the line survives if the process is killed.

        Raises
        ------
        FileNotWrittenError
            If the disk is full or the folder cannot be written; the earlier lines are still there.
        """
        line = encode_line(record)
        written_bytes = 0
        try:
            # The operating system may write less than it is given.
            while written_bytes < len(line):
                written_bytes += os.write(self._descriptor, line[written_bytes:])
            if time.monotonic() - self._flushed_at >= self._flush_seconds:
                self.flush()
        except OSError as error:
            # Remove what was written of the line.
            with suppress(OSError):
                os.truncate(self._descriptor, self.size)
            raise write_error(error, self.path) from error
        self.size += len(line)

    def flush(self) -> None:
        """Flush the appended lines to the disk."""
        os.fsync(self._descriptor)
        self._flushed_at = time.monotonic()


def encode_line(record: Mapping[str, object]) -> bytes:
    """Return a record as a line of the journal: hash, blank, JSON, line feed."""
    text = _ENCODER.encode(record).encode("ascii")
    return sha256(text).hexdigest().encode("ascii") + b" " + text + b"\n"


def check_header(path: Path, config_hash: str) -> None:
    """Refuse a journal whose first line is damaged or names another configuration.

    A journal that does not exist, or whose first line was cut off by a kill, passes.

    Raises
    ------
    NotResumableError
        If the first line was changed or is damaged, or belongs to another configuration.
    """
    header = encode_line({"config_hash": config_hash})
    with suppress(FileNotFoundError), path.open("rb") as file:
        first_line = file.readline()
        if header.startswith(first_line):  # the header, or its beginning if a kill cut it off
            return
        if record_of_line(first_line, path) is None:
            raise damaged_line_error(path, 0, _WRONG_HASH)
        raise NotResumableError(
            f"the journal {path} belongs to another configuration than the config.json beside it: "
            "begin again with --replace."
        )


def records(path: Path, begin: int = 0) -> Iterator[JournalLine]:
    """Yield the lines of a journal in their order; the header is left out.

    A journal that does not exist, or whose header was cut off, has no lines.

    Parameters
    ----------
    path : Path
        The path of the journal.
    begin : int
        The position of the first line to read, in bytes.

    Raises
    ------
    NotResumableError
        If a line was changed or is damaged.
    """
    if path.exists():
        with path.open("rb") as file:
            yield from records_in_file(file, path, begin)


def records_in_file(file: BinaryIO, path: Path, begin: int = 0) -> Iterator[JournalLine]:
    """Yield the lines of an open journal in their order, as `records` does."""
    file.seek(begin)
    for line in file:
        if not line.endswith(b"\n"):
            return  # the last line, cut off by a kill
        record = record_of_line(line, path)
        if record is None:
            raise damaged_line_error(path, begin, _WRONG_HASH)
        end = begin + len(line)
        is_header = begin == 0
        if not is_header:
            yield JournalLine(record, begin, end)
        begin = end


def record_of_line(line: bytes, path: Path) -> JsonObject | None:
    """Return the record of a line, or None if the line does not match the hash that it begins with.

    If the line was written by an earlier version, its keys are replaced by their present names.
    """
    text = line[_HASH_LENGTH + 1 :].rstrip(b"\n")
    if sha256(text).hexdigest().encode("ascii") != line[:_HASH_LENGTH]:
        return None
    record = json.loads(text)
    if not isinstance(record, dict):
        return None
    # Only earlier versions wrote the key "turn".
    if "turn" in record:
        return with_present_names(record, PRESENT_NAMES, str(path), NotResumableError)
    return record


def records_backwards(path: Path, end: int | None = None) -> Iterator[JournalLine]:
    """Yield the lines of a journal from the last one back to the header.

    A journal that does not exist has no lines. The file is read and checked only as far back as the
    caller iterates.

    Parameters
    ----------
    path : Path
        The path of the journal.
    end : int, optional
        The end of the last line to read, in bytes; the end of the file if left out.

    Raises
    ------
    NotResumableError
        If a line was changed or is damaged.
    """
    if not path.exists():
        return
    with path.open("rb") as file:
        file_size = file.seek(0, os.SEEK_END)
        line_end = file_size if end is None else end
        for line in _lines_backwards(file, line_end):
            line_begin = line_end - len(line)
            is_complete = line.endswith(b"\n")
            record = record_of_line(line, path) if is_complete else None
            was_cut_off_by_kill = not is_complete and line_end >= file_size
            if record is not None:
                yield JournalLine(record, line_begin, line_end)
            elif not was_cut_off_by_kill:
                raise damaged_line_error(path, line_begin, _WRONG_HASH)
            line_end = line_begin


def _lines_backwards(file: BinaryIO, end: int) -> Iterator[bytes]:
    """Yield the lines of a file that end at or before `end`, the last one first."""
    block_begin = end
    end_of_split_line = b""  # end of a line that begins in the block before this one
    while block_begin > 0:
        block_size = min(block_begin, _BLOCK_SIZE)
        block_begin -= block_size
        file.seek(block_begin)
        lines = io.BytesIO(file.read(block_size) + end_of_split_line).readlines()
        # The first line of a block may begin in an earlier block; only the first block of the file
        # begins with a complete line.
        if block_begin > 0:
            end_of_split_line = lines.pop(0)
        yield from reversed(lines)


def last_step(path: Path, limit: float = math.inf) -> tuple[int, int]:
    """Return the last step of a journal that is at most a limit, and the end of its last line.

    Parameters
    ----------
    path : Path
        The path of the journal.
    limit : float
        The largest step that counts.

    Returns
    -------
    int
        The number of the step; -1 if there is none.
    int
        The end of the last line of that step, in bytes; 0 if there is none.

    Raises
    ------
    NotResumableError
        If one of the lines that are read was changed or is damaged.
    """
    for line in records_backwards(path):
        step = int(line.record.get("step", -1))  # the header has no step
        if step <= limit:
            return step, line.end
    return -1, 0


def damaged_line_error(path: Path, begin: int, reason: str) -> NotResumableError:
    """Return the error that names a damaged line and counts the undamaged lines around it.

    Parameters
    ----------
    path : Path
        The path of the journal.
    begin : int
        The position of the first byte of the damaged line in the file.
    reason : str
        The fault of the line, as a clause that the error message quotes.
    """
    line_number = 1
    undamaged_lines_before = 0
    undamaged_lines_after = 0
    # A line that matches its hash is undamaged.
    with path.open("rb") as file:
        for line in _lines_before(file, begin):
            line_number += 1
            if record_of_line(line, path) is not None:
                undamaged_lines_before += 1
        file.readline()  # the damaged line itself
        for line in file:
            if record_of_line(line, path) is not None:
                undamaged_lines_after += 1
    return NotResumableError(
        f"line {line_number} of the journal {path} was changed or is damaged ({reason}); "
        f"{undamaged_lines_before} before it and {undamaged_lines_after} after it are valid: begin "
        "again with --replace."
    )


def _lines_before(file: BinaryIO, end: int) -> Iterator[bytes]:
    """Yield the lines of a file that begin before a byte, and leave the file behind them."""
    position = 0
    while position < end:
        line = file.readline()
        if not line:
            return
        position += len(line)
        yield line
