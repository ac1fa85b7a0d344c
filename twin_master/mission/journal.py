"""The journal of a run or a watch, `journal.jsonl`: one line for each step.

A line is the SHA-256 hash of a JSON text, a blank, and the text. The file only grows. If the
process was killed while it wrote, the last line has no line feed and is dropped. Any other line
that does not match its hash was changed or is damaged. The file is read line by line, so that its
length does not matter.

Lines are short (`journal_packing`). Most of them leave out the large parts of their record: two
files beside the journal contain these for the last steps (`recent_parts`). Readers get full
records, with the large parts if the line or these files contain them.
"""

import base64
import io
import math
import os
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, NamedTuple, Self

import numpy as np

from reporting.arrays import Float
from reporting.files import explained_write_errors, synchronise, write_at, write_error
from reporting.formats.former_names import with_present_names
from reporting.json_file import JsonObject, JsonRecord, plain
from twin_master.errors import NotResumableError
from twin_master.mission import recent_parts
from twin_master.mission.journal_packing import (
    array_from_json,
    full_record,
    json_from_array,
    packed_record,
    rounded,
    rounded_probabilities,
)
from twin_master.mission.recent_parts import HASH_LENGTH, RecentParts, RecentPartsFile
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
_BLOCK_SIZE = 1_000_000
"""Bytes that are read at once from the end of a journal."""
_WRONG_HASH = "its hash does not fit its content"
JOURNAL_FORMAT = 2
"""Version of the format, in the first line; the first version did not write it."""


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


NoiseFree = Callable[[int, Float], Float]
"""Returns the readings of a step (G,) without their noise and drift, up to rounding [SI]."""
LARGE_PARTS = ("asset_state", "learnt", "settled", "suspicion")
"""The entries of a record that most lines leave out, or contain only in part."""
_LONGEST_DIFFERENCE = 9
"""Mean number of digits up to which differences are shorter than the values in base 64."""
KEPT_OF_SUSPICION = ("none_of_these", "hypotheses", "decided_by")
"""The entries of a suspicion that every line contains; a decision has a copy of them."""


def step_record(step: MissionStep) -> JsonObject:
    """Return the record of a step for the journal.

    It contains the belief, so that a viewer need not filter the observations again. The state, the
    noise-free observation and the monitors are added if the asset is simulated. Beliefs and
    evidence are rounded, see `rounded_probabilities` and `rounded`.
    """
    twin_step = step.twin_step
    record: JsonObject = {
        "step": twin_step.step,
        "observed": json_from_array(step.reading.observed),
        "control_index": twin_step.control_index,
        "next_control": twin_step.next_control,
        "decision_probability": rounded_probabilities(twin_step.decision_probability.tolist()),
        "filtered": rounded_probabilities(twin_step.filtered.tolist()),
        "log_evidence": rounded(twin_step.log_evidence),
    }
    ground_truth = step.reading.ground_truth
    if ground_truth is not None:
        record["state"] = json_from_array(ground_truth.state)
        record["observation"] = json_from_array(ground_truth.observation)
        record["monitors"] = plain(ground_truth.monitors)
    if twin_step.learnt:
        record["learnt"] = {name: vars(learnt) for name, learnt in twin_step.learnt.items()}
    if twin_step.notices:
        record["notices"] = [notice.as_record() for notice in twin_step.notices]
    suspicion = twin_step.suspicion
    if suspicion is not None:
        none_of_these, gauge_off = rounded_probabilities(
            [suspicion.none_of_these, suspicion.gauge_off]
        )
        probabilities = rounded_probabilities(suspicion.hypotheses.values())
        record["suspicion"] = {
            "none_of_these": none_of_these,
            "gauge_off": gauge_off,
            "log_evidence_none": rounded(suspicion.log_evidence_none),
            "log_evidence_any_gauge": rounded(suspicion.log_evidence_any_gauge),
            "log_evidence_gauge": json_from_array(suspicion.log_evidence_gauge),
            "left_out": suspicion.left_out.tolist(),
            "hypotheses": dict(zip(suspicion.hypotheses, probabilities, strict=True)),
            "decided_by": suspicion.decided_by,
        }
    return record


def large_parts(record: JsonRecord) -> JsonObject:
    """Return the entries of a record that most lines of the journal leave out."""
    return {name: record[name] for name in LARGE_PARTS if name in record}


def short_record(
    record: JsonRecord,
    *,
    is_whole: bool,
    kept_of_suspicion: Sequence[str] = KEPT_OF_SUSPICION,
) -> JsonObject:
    """Return a record without its large parts, which is what most lines of the journal contain.

    Parameters
    ----------
    record : dict
        The record with its large parts.
    is_whole : bool
        Whether the line keeps what was learnt, see `is_whole_step`.
    kept_of_suspicion : sequence of str
        The entries of the suspicion that the line keeps.
    """
    short_record_of_step = {
        name: value for name, value in record.items() if name not in LARGE_PARTS
    }
    if is_whole and "learnt" in record:
        short_record_of_step["learnt"] = record["learnt"]
    if "suspicion" in record:
        suspicion = record["suspicion"]
        short_record_of_step["suspicion"] = {name: suspicion[name] for name in kept_of_suspicion}
    return short_record_of_step


def with_short_truth(record: JsonObject, noise_free: NoiseFree) -> JsonObject:
    """Shorten the record of a simulated step: store only a difference for its true observation.

    The observation without noise and drift can be computed from the observed values, up to
    rounding. The record keeps only the rounding error, in units in the last place: a small number
    for each sensor. If the differences are long, because the asset has noise of its own or a sensor
    is lost, the record is returned as it is.

    Parameters
    ----------
    noise_free : callable
        Removes noise and drift from readings, see `NoiseFree`.
    """
    observation = array_from_json(record["observation"])
    observed = array_from_json(record["observed"][: len(observation)])
    estimate = noise_free(record["step"], observed)
    difference = (observation.view(np.int64) - estimate.view(np.int64)).tolist()
    digits = sum(len(str(number)) for number in difference)
    if digits > _LONGEST_DIFFERENCE * len(difference):
        return record
    remaining_record = {name: value for name, value in record.items() if name != "observation"}
    return remaining_record | {"observation_difference": difference}


def reading_from_line(record: JsonObject, noise_free: NoiseFree | None = None) -> Reading:
    """Return the reading in a record of the journal, with the ground truth of a simulated asset.

    Parameters
    ----------
    noise_free : callable, optional
        Removes noise and drift from readings; needed for the steps of a simulated asset.

    Raises
    ------
    KeyError, TypeError, ValueError
        If the record has another layout.
    """
    observed_values = array_from_json(record["observed"])
    ground_truth = None
    if "monitors" in record:
        values = array_from_json(record["monitors"].values()).tolist()
        if "observation" in record or noise_free is None:
            true_observation = array_from_json(record["observation"])
        else:
            difference = np.array(record["observation_difference"], dtype=np.int64)
            estimate = noise_free(record["step"], observed_values[: len(difference)])
            true_observation = (estimate.view(np.int64) + difference).view(np.float64)
        ground_truth = GroundTruth(
            state=array_from_json(record["state"]),
            observation=true_observation,
            monitors=dict(zip(record["monitors"], values, strict=True)),
        )
    return Reading(observed_values, int(record["control_index"]), ground_truth=ground_truth)


class JournalFile:
    """The journal of a run folder, for the one process that appends to it.

    The file is opened for each line and closed again, so that a process can write any number of
    journals.

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
    recent : RecentPartsFile
        The large parts of the last lines.

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
        self.recent = RecentPartsFile(folder)
        with explained_write_errors(self.path):
            check_header(self.path, config_hash)
            last_line = next(records_backwards(self.path), None)
            self.size = 0 if last_line is None else last_line.end
            if self.size == 0:
                self.path.touch()
            os.truncate(self.path, self.size)
            if self.size == 0:
                self.append(_header(config_hash))
                self.flush()
                synchronise(folder)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        with suppress(OSError):
            self.flush()

    def truncate(self, size: int) -> None:
        """Drop all lines after the first `size` bytes, which must be the end of a line."""
        self.size = size
        os.truncate(self.path, size)

    def append(self, record: Mapping[str, object], parts: JsonObject | None = None) -> None:
        """Append a line; once this returns, the line survives if the process is killed.

        Parameters
        ----------
        record : mapping of str to object
            The content of the line.
        parts : dict, optional
            The large parts of the line, which are kept for the last steps alone. They are written
            first: a kill between them and the line leaves parts that belong to no line.

        Raises
        ------
        FileNotWrittenError
            If the disk is full or the folder cannot be written; the earlier lines are still there.
        """
        line = encode_line(record)
        try:
            if parts:
                self.recent.append(int(str(record["step"])), line[:HASH_LENGTH], parts)
            else:
                self.recent.pass_over(line[:HASH_LENGTH])
            write_at(self.path, line, self.size)
            if time.monotonic() - self._flushed_at >= self._flush_seconds:
                self.flush()
        except OSError as error:
            # Remove what was written of the line.
            with suppress(OSError):
                os.truncate(self.path, self.size)
            raise write_error(error, self.path) from error
        self.size += len(line)

    def flush(self) -> None:
        """Flush the appended lines to the disk."""
        synchronise(self.path)
        self._flushed_at = time.monotonic()


def encode_line(record: Mapping[str, object]) -> bytes:
    """Return a record as a line of the journal: hash, blank, JSON, line feed."""
    return recent_parts.encode_line(packed_record(record))


def _header(config_hash: str) -> JsonObject:
    """Return the record of the first line."""
    return {"config_hash": config_hash, "format": JOURNAL_FORMAT}


def check_header(path: Path, config_hash: str) -> None:
    """Refuse a journal whose first line is damaged or names another configuration.

    A journal that does not exist, or whose first line was cut off by a kill, passes.

    Raises
    ------
    NotResumableError
        If the first line was changed or is damaged, or belongs to another configuration.
    """
    header = encode_line(_header(config_hash))
    with suppress(FileNotFoundError), path.open("rb") as file:
        first_line = file.readline()
        if header.startswith(first_line):  # the header, or its beginning if a kill cut it off
            return
        record = record_of_line(first_line, path)
        if record is None:
            raise damaged_line_error(path, 0, _WRONG_HASH)
        if record == {"config_hash": config_hash}:  # of the first version of the format
            return
        raise NotResumableError(
            f"the journal {path} belongs to another configuration than the config.json beside it: "
            "begin again with --replace."
        )


def records(path: Path, begin: int = 0, recent: RecentParts | None = None) -> Iterator[JournalLine]:
    """Yield the lines of a journal in order, without the header.

    A journal that does not exist, or whose header was cut off, has no lines.

    Parameters
    ----------
    begin : int
        The position of the first line to read, in bytes.
    recent : RecentParts, optional
        The large parts of the last lines, which are added to the records.

    Raises
    ------
    NotResumableError
        If a line was changed or is damaged.
    """
    if path.exists():
        with path.open("rb") as file:
            yield from records_in_file(file, path, begin, recent)


def records_in_file(
    file: BinaryIO, path: Path, begin: int = 0, recent: RecentParts | None = None
) -> Iterator[JournalLine]:
    """Yield the lines of an open journal in order, as `records` does."""
    file.seek(begin)
    for line in file:
        if not line.endswith(b"\n"):
            return  # the last line, cut off by a kill
        record = record_of_line(line, path, recent)
        if record is None:
            raise damaged_line_error(path, begin, _WRONG_HASH)
        end = begin + len(line)
        is_header = begin == 0
        if not is_header:
            yield JournalLine(record, begin, end)
        begin = end


def record_of_line(line: bytes, path: Path, recent: RecentParts | None = None) -> JsonObject | None:
    """Return the record of a line, or None if the line does not match its hash.

    Keys of earlier versions are replaced by their present names.

    Parameters
    ----------
    recent : RecentParts, optional
        The large parts of the last lines, which are added to the record.

    Raises
    ------
    NotResumableError
        If the line is the first one of a journal that a later version wrote.
    """
    record = recent_parts.decode_line(line)
    if record is None:
        return None
    if record.get("format", JOURNAL_FORMAT) != JOURNAL_FORMAT:
        raise NotResumableError(
            f"the journal {path} has the format {record['format']}, but this version reads up to "
            f"{JOURNAL_FORMAT}: read it with the version that wrote it."
        )
    # Only earlier versions wrote the key "turn".
    if "turn" in record:
        return with_present_names(record, PRESENT_NAMES, str(path), NotResumableError)
    record = full_record(record)
    return record if recent is None else record | recent.parts_of(line[:HASH_LENGTH])


def records_backwards(
    path: Path, end: int | None = None, recent: RecentParts | None = None
) -> Iterator[JournalLine]:
    """Yield the lines of a journal from the last one back to the first; the header is left out.

    A journal that does not exist has no lines. The file is read and checked only as far back as the
    caller iterates.

    Parameters
    ----------
    end : int, optional
        The end of the last line to read, in bytes; the end of the file if left out.
    recent : RecentParts, optional
        The large parts of the last lines, which are added to the records.

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
            record = record_of_line(line, path, recent) if is_complete else None
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
    """Return the last step of a journal that is at most `limit`, and the end of its last line.

    Parameters
    ----------
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
    """Return the error that names a damaged line and counts the valid lines before and after it.

    Parameters
    ----------
    begin : int
        The position of the first byte of the damaged line in the file.
    reason : str
        The fault of the line, as a clause that the error message quotes.
    """
    line_number = 1
    undamaged_lines_before = 0
    undamaged_lines_after = 0
    position = 0
    with path.open("rb") as file:
        for line in file:
            is_undamaged = record_of_line(line, path) is not None  # it matches its hash
            if position < begin:
                line_number += 1
            if is_undamaged and position < begin:
                undamaged_lines_before += 1
            elif is_undamaged and position > begin:
                undamaged_lines_after += 1
            position += len(line)
    return NotResumableError(
        f"line {line_number} of the journal {path} was changed or is damaged ({reason}); "
        f"{undamaged_lines_before} before it and {undamaged_lines_after} after it are valid: begin "
        "again with --replace."
    )
