"""Messages from files, recorded or growing, from standard input, and from a program."""

import csv
import json
import math
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from hashlib import sha256
from itertools import islice
from pathlib import Path
from select import select
from typing import IO, Any

import numpy as np
import xarray as xr

from reporting.errors import DamagedFileError
from reporting.netcdf import read_groups
from twin_master.errors import MissionInputError
from twin_master.mission.journal import JOURNAL_NAME, array_of, whole_records
from twin_master.scenario.schema import Scenario
from twin_master.watch.intake import MISSING
from twin_master.watch.message import LARGEST_MESSAGE, Message, MessageReader, Refused

Fed = tuple[Message | Refused | None, str]
"""A message with the begin of its text; None where nothing more has come yet."""

_LOST = ("", "nan", "null", "none")
_TURN_COLUMNS = ("turn", "step")
_OTHERS = ("turn", "time", "control")


class CsvFeed:
    """A CSV file with a header: `turn` (or `step`) or `time`, `control`, and sensors by their names.

    Parameters
    ----------
    path : Path
    scenario : Scenario
        What its columns may be called.
    follow : bool
        Its end is not the last: more may come.

    Raises
    ------
    MissionInputError
        It cannot be read, or a column is neither of these.
    """

    replayable = True

    def __init__(self, path: Path, scenario: Scenario, *, follow: bool = False) -> None:
        self._path = path
        self._follow = follow
        self._reader = MessageReader(scenario)
        try:
            with path.open("rb") as file:
                names = _cells(file.readline(LARGEST_MESSAGE))
        except (OSError, ValueError) as error:
            raise MissionInputError(f"{path} cannot be read as CSV: {error}.") from None
        if not any(names):
            raise MissionInputError(f"{path} is empty: a CSV file begins with a line of its columns.")
        if names[0].startswith("{"):
            raise MissionInputError(
                f"{path} holds JSON lines, and a file of observations is CSV or NetCDF: hand them over by "
                f"standard input, `--observations - < {path}`."
            )
        self._names = ["turn" if name in _TURN_COLUMNS else name for name in names]
        sensors = [place for place, name in enumerate(self._names) if name not in _OTHERS and name[:1] != "_"]
        try:
            columns = [self._reader.column(self._names[place]) for place in sensors]
        except Refused as refusal:
            raise MissionInputError(
                f"{path}: the column {refusal}; others are `turn`, `time` and `control`."
            ) from None
        self._sensors = sensors
        self._index = np.array([sensor for sensor, _ in columns], dtype=np.int64)
        self._factor = np.array([factor for _, factor in columns], dtype=np.float64)
        twice = len({*self._index.tolist()}) < len(columns) or any(
            self._names.count(name) > 1 for name in _OTHERS
        )
        if twice:
            raise MissionInputError(f"{path}: two columns say the same; {', '.join(names)[:300]} came.")

    def beginning(self, count: int) -> str:
        """Return the hash of the header and the first `count` rows."""
        return _hash_of_lines(self._path, 1 + count)

    def messages(self, after: int) -> Iterator[Fed]:
        """Return the rows behind the first `after` of them."""
        with self._path.open("rb") as file:
            number = 0
            for line in _lines(file, follow=self._follow):
                if line is None:
                    yield None, ""
                    continue
                if number > after:
                    yield self._message(line), shown(line)
                number += 1

    def _message(self, line: bytes | Refused) -> Message | Refused:
        if isinstance(line, Refused):
            return line
        try:
            cells = _cells(line)
        except ValueError as error:
            return Refused(f"it is no line of CSV: {str(error)[:80]}")
        try:
            if len(cells) != len(self._names):
                return Refused(f"{len(self._names)} cells are expected, and {len(cells)} came")
            return self._row(cells)
        except Refused as refusal:
            return refusal
        except (ValueError, OverflowError) as error:
            return Refused(f"a cell is no number: {str(error)[:80]}")

    def _row(self, cells: list[str]) -> Message:
        values = [
            math.nan if (cell := cells[place]).lower() in _LOST else float(cell) for place in self._sensors
        ]
        record: dict[str, object] = {
            name: cells[place]
            if name == "control"
            else _whole(cells[place])
            if name == "turn"
            else float(cells[place])
            for place, name in enumerate(self._names)
            if name in _OTHERS and cells[place].lower() not in _LOST
        }
        message = self._reader.read(record)
        observed = np.array(values) * self._factor
        wrong = np.abs(observed) > self._reader.largest[self._index]
        if wrong.any():  # say which, and why
            first = int(np.argmax(wrong))
            return self._reader.read({self._names[self._sensors[first]]: values[first]})
        message.observed[self._index] = observed
        return message


class RunFeed:
    """A NetCDF file with the group `observed` of a run: observations and the controls that were in force.

    Raises
    ------
    MissionInputError
        It cannot be read, or holds other sensors or controls.
    """

    replayable = True

    def __init__(self, path: Path, scenario: Scenario) -> None:
        role = scenario.observation.role
        try:
            group: xr.Dataset = read_groups(path)["observed"].to_dataset()
            self._values = np.asarray(group[role].values, dtype=np.float64)
            self._control = (
                np.asarray(group["control_index"].values, dtype=np.int64)
                if "control_index" in group
                else None
            )
            self._turn = np.asarray(group["step"].values, dtype=np.int64)
        except (DamagedFileError, KeyError, ValueError, TypeError, OSError) as error:
            raise MissionInputError(
                f"{path} is no NetCDF file with `observed/{role}` (step, sensor): {str(error).rstrip('.')}."
            ) from None
        if self._values.shape != (len(self._turn), scenario.observation.count) or (
            self._control is not None and not np.all(np.isin(self._control, range(len(scenario.control))))
        ):
            raise MissionInputError(
                f"{path}: {scenario.observation.count} sensors and the controls of the scenario are "
                f"expected, and `observed/{role}` has the shape {self._values.shape}."
            )

    def beginning(self, count: int) -> str:
        """Return the hash of the first `count` steps."""
        return sha256(self._turn[:count].tobytes() + self._values[:count].tobytes()).hexdigest()

    def messages(self, after: int) -> Iterator[Fed]:
        """Return the steps behind the first `after` of them."""
        for row in range(after, len(self._values)):
            control = None if self._control is None else int(self._control[row])
            yield Message(self._values[row].copy(), int(self._turn[row]), None, control), f"row {row}"


class FolderFeed:
    """The journal of another run or watch, of whatever version: its observations as they came.

    A line that was damaged is refused, and those behind it are read on.

    Raises
    ------
    MissionInputError
        The folder holds no journal.
    """

    replayable = True

    def __init__(self, folder: Path, scenario: Scenario) -> None:
        self._path = folder / JOURNAL_NAME
        self._scenario = scenario
        if not self._path.is_file():
            raise MissionInputError(f"{folder} holds no journal of a run or a watch ({JOURNAL_NAME}).")

    def beginning(self, count: int) -> str:
        """Return the hash of the first lines, which have `count` observations or a few less."""
        return _hash_of_lines(self._path, 1 + count)

    def messages(self, after: int) -> Iterator[Fed]:
        """Return the observations behind the first `after` of them."""
        lines = (line for line in whole_records(self._path) if line[1] is None or _came(line[1]))
        for count, (number, record) in enumerate(lines, start=1):
            if count <= after:
                continue
            if record is None:
                yield Refused(f"line {number} of {self._path.name} was changed or is damaged"), ""
            else:
                yield self._message(record), f"line {number}"

    def _message(self, record: Mapping[str, Any]) -> Message | Refused:
        try:
            observed, control = array_of(record["observed"]), int(record["control_index"])
            turn = int(record.get("observation_turn", record["turn"]))
        except (KeyError, TypeError, ValueError):
            return Refused("the line has another layout")
        sensors = self._scenario.observation
        if len(observed) not in (sensors.count, sensors.width) or control >= len(self._scenario.control):
            return Refused("it is of an asset with other sensors or controls")
        return Message(observed, turn, None, control)


class JsonLinesFeed:
    """JSON objects, one a line, from a stream such as standard input."""

    replayable = False

    def __init__(self, scenario: Scenario, stream: IO[bytes] | None = None) -> None:
        self._reader = MessageReader(scenario)
        self._stream = stream
        self._looks = scenario.watch.quiet_after_seconds is not None

    def beginning(self, count: int) -> str:
        """Return nothing: a stream goes on where it is."""
        return ""

    def messages(self, after: int) -> Iterator[Fed]:
        """Return what comes; where silence is to be noticed, None while nothing does."""
        stream = self._stream or sys.stdin.buffer
        for line in _lines(_Pipe(stream) if self._looks else stream):
            yield (None, "") if line is None else (parsed(self._reader, line), shown(line))


class _Pipe:
    """A stream that is not waited for: its lines are None while nothing has come."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._descriptor, self._came, self._ended = stream.fileno(), b"", False

    def readline(self, most: int) -> bytes | None:
        """Return a line, or a piece of so many bytes; nothing at the end."""
        if b"\n" not in self._came and len(self._came) < most and not self._ended:
            if not select([self._descriptor], [], [], 0.0)[0]:
                return None
            self._came += (piece := os.read(self._descriptor, 65_536))
            self._ended = not piece
        end = self._came.find(b"\n", 0, most) + 1
        if not end and not self._ended and len(self._came) < most:
            return None
        line, self._came = self._came[: end or most], self._came[end or most :]
        return line


class MappingFeed:
    """Messages of a program, as mappings; arrays of numbers may stand where JSON has lists."""

    replayable = False

    def __init__(self, messages: Iterable[Mapping[str, Any]], scenario: Scenario) -> None:
        self._reader = MessageReader(scenario)
        self._messages = messages

    def beginning(self, count: int) -> str:
        """Return nothing: what comes goes on where it is."""
        return ""

    def messages(self, after: int) -> Iterator[Fed]:
        """Return what comes."""
        for message in self._messages:
            line = json.dumps(message, default=_plain).encode()
            yield parsed(self._reader, line), shown(line)


def _plain(value: Any) -> Any:
    return np.asarray(value).tolist()


def parsed(reader: MessageReader, content: bytes | Refused) -> Message | Refused:
    """Return the observation in a JSON object, or why there is none."""
    if isinstance(content, Refused):
        return content
    try:
        return reader.parse(content)
    except Refused as refusal:
        return refusal


def file_feed(path: Path, scenario: Scenario, *, follow: bool = False) -> CsvFeed | RunFeed | FolderFeed:
    """Return the feed of a run folder, or of a file: NetCDF by its ending `.nc`, else CSV.

    Raises
    ------
    MissionInputError
        It cannot be read, or a recorded one is to be followed.
    """
    check_file(path, follow=follow)
    if path.is_dir():
        return FolderFeed(path, scenario)
    if _is_netcdf(path):
        return RunFeed(path, scenario)
    return CsvFeed(path, scenario, follow=follow)


def check_file(path: Path, *, follow: bool = False) -> None:
    """Check what can be known of a source before a watch is prepared.

    Raises
    ------
    MissionInputError
        It is not there, or a recorded one is to be followed.
    """
    if not path.exists():
        raise MissionInputError(f"there is no file {path} to read observations from.")
    if follow and (path.is_dir() or _is_netcdf(path)):
        raise MissionInputError(f"{path} is recorded: only a CSV file can be followed.")


def _is_netcdf(path: Path) -> bool:
    return path.suffix.lower() == ".nc"


def _lines(file: "IO[bytes] | _Pipe", *, follow: bool = False) -> Iterator[bytes | Refused | None]:
    """Return whole lines; one that is too long is skipped in pieces, and the rest of a file is a line.

    A file that is followed has no last line: None stands for nothing new, each time that it is asked.
    """
    part = b""
    too_long = False
    while True:
        piece = file.readline(LARGEST_MESSAGE + 1)
        if not piece:
            if follow or piece is None:
                yield None
                continue
            if part and not too_long:
                yield part
            return
        ended = piece.endswith(b"\n")
        part = b"" if too_long else part + piece
        if len(part) > LARGEST_MESSAGE:
            too_long, part = True, b""
        if ended:
            yield Refused(f"a message has at most {LARGEST_MESSAGE} bytes") if too_long else part
            part, too_long = b"", False


def _whole(cell: str) -> int:
    """Return a whole number, also one that a table of floating-point numbers has written as `12.0`."""
    number, point, zeros = cell.partition(".")
    return int(number if point and not zeros.strip("0") else cell)


def _came(record: Mapping[str, Any]) -> bool:
    """Return whether a line of a journal is of something observed, not of a turn for which nothing came."""
    given = record.get("intake", {}).get("given", "")
    predicted = given.endswith(str(MISSING)) and record.get("observation_turn") == record.get("turn")
    return "observed" in record and not predicted


def _hash_of_lines(path: Path, count: int) -> str:
    found = sha256()
    with path.open("rb") as file:
        for line in islice(_lines(file), count):
            found.update(line if isinstance(line, bytes) else b"")
    return found.hexdigest()


def _cells(line: bytes) -> list[str]:
    text = line.decode("utf-8-sig").rstrip("\r\n")
    if '"' in text:
        try:
            return [cell.strip() for cell in next(csv.reader([text]), [])]
        except csv.Error as error:
            raise ValueError(str(error)) from None
    return [cell.strip() for cell in text.split(",")]


def shown(line: bytes | Refused) -> str:
    """Return the begin of a message, for people."""
    return "" if isinstance(line, Refused) else line[:300].decode("utf-8", "replace").rstrip(os.linesep)
