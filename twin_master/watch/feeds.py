"""Messages from files, recorded or growing, from standard input, from a program; addresses of brokers."""

import csv
import json
import math
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from ssl import create_default_context
from typing import IO, Any
from urllib.parse import unquote, urlsplit

import numpy as np
import xarray as xr

from reporting.errors import DamagedFileError
from reporting.netcdf import read_groups
from twin_master.errors import MissionInputError
from twin_master.mission.journal import JOURNAL_NAME, array_of, whole_record
from twin_master.scenario.schema import Scenario
from twin_master.sentences import said
from twin_master.watch.growing import GrowingFile, Pipe, Place, found, rotated
from twin_master.watch.intake import MISSING, Feed
from twin_master.watch.message import LARGEST_MESSAGE, Fed, Message, MessageReader, Refused

_LOST = ("", "nan", "null", "none")
_TURN_COLUMNS = ("turn", "step")
_OTHERS = ("turn", "time", "control")
_FIRST = 8
"""First steps by which a file of steps is known again."""


Observations = Iterable[Mapping[str, Any]] | str | Path
STANDARD_INPUT = "-"


class RecordedFeed(Feed):
    """What a file holds, and may be read again."""

    replayable = True
    path: Path
    _follow = False

    def holds(self, place: Place) -> bool:
        """Return whether a place is in the file; where it is followed, also under its name of today."""
        return found(self.path, place, follow=self._follow) is not None


class CsvFeed(RecordedFeed):
    """A CSV file with a header: `turn` (or `step`) or `time`, `control`, and sensors by their names.

    Parameters
    ----------
    path : Path
    scenario : Scenario
        What its columns may be called.
    follow : bool
        Its end is not the last: more may come, also in a file that takes its place. That one has a header of
        its own, or the same columns.

    Raises
    ------
    MissionInputError
        It cannot be read, or a column is neither of these.
    """

    def __init__(self, path: Path, scenario: Scenario, *, follow: bool = False) -> None:
        self.path = path
        self._follow = follow
        self._reader = MessageReader(scenario)
        # A file that was begun a moment ago may have no header yet.
        self._read_header(path, *(reversed(rotated(path)) if follow else ()))

    def _read_header(self, *files: Path) -> None:
        """Take the columns of the first of these files that has a header; the error is that of the first."""
        errors = []
        for path in files:
            try:
                with path.open("rb") as file:
                    return self._take_columns(_cells(file.readline(LARGEST_MESSAGE)))
            except MissionInputError as error:
                errors.append(error)
            except (OSError, ValueError) as error:
                errors.append(MissionInputError(f"{path} cannot be read as CSV: {str(error).rstrip('.')}."))
        raise errors[0] from None

    def _take_columns(self, names: list[str]) -> None:
        path = self.path
        if not any(names):
            raise MissionInputError(f"{path} is empty: a CSV file begins with a line of its columns.")
        if names[0].startswith("{"):
            raise MissionInputError(said("watch.json_lines", path=path))
        called = ["turn" if name in _TURN_COLUMNS else name for name in names]
        sensors = [name for name in called if name not in _OTHERS and name[:1] != "_"]
        try:
            columns = [column for column in map(self._reader.column, sensors) if column is not None]
        except Refused as refusal:
            raise MissionInputError(said("watch.column", path=path, refusal=refusal)) from None
        once = {sensor for sensor, _ in columns}
        if len(once) < len(columns) or any(called.count(name) > 1 for name in _OTHERS):
            raise MissionInputError(f"{path}: two columns say the same; {', '.join(names)[:300]} came.")
        self._names = called

    def messages(self, place: Place | None) -> Iterator[Fed]:
        """Return the rows behind a place."""
        with suppress(MissionInputError):
            self._read_header(found(self.path, place, follow=self._follow) or self.path)
        stream = GrowingFile(self.path, place, follow=self._follow)
        for line in stream:
            if line is None:
                yield None, ""
                continue
            if stream.cut:
                yield Refused(said("watch.cut", name=self.path.name, byte=stream.cut)), ""
                stream.cut = 0
            self.place = stream.place
            if not (stream.begins and self._is_header(line)):
                yield self._message(line), shown(line)

    def _is_header(self, line: bytes | Refused) -> bool:
        with suppress(MissionInputError, ValueError):
            self._take_columns(_cells(line) if isinstance(line, bytes) else [])
            return True
        return False

    def _message(self, line: bytes | Refused) -> Message | Refused:
        if isinstance(line, Refused):
            return line
        try:
            cells = _cells(line)
        except ValueError as error:
            return Refused(f"it is no line of CSV: {str(error)[:80]}")
        if len(cells) != len(self._names):
            return Refused(f"{len(self._names)} cells are expected, and {len(cells)} came")
        record: dict[str, object] = {
            name: cell for name, cell in zip(self._names, cells, strict=True) if cell
        }
        try:
            for name, reader in (("control", str), ("turn", _whole), ("time", float)):
                if name in record:
                    cell = str(record[name])
                    record[name] = None if cell.lower() in _LOST else reader(cell)
        except (ValueError, OverflowError) as error:
            return Refused(f"a cell is no number: {str(error)[:80]}")
        return parsed(self._reader, record)


class RunFeed(RecordedFeed):
    """A NetCDF file with the group `observed` of a run: observations and the controls that were in force.

    Raises
    ------
    MissionInputError
        It cannot be read, or holds other sensors or controls.
    """

    def __init__(self, path: Path, scenario: Scenario) -> None:
        self.path, self._reader = path, MessageReader(scenario)
        role, names = scenario.observation.role, dict(enumerate(scenario.control_names))
        try:
            group: xr.Dataset = read_groups(path)["observed"].to_dataset()
            rows, turns = group[role].values.tolist(), group["step"].values.tolist()
            controls = group["control_index"].values.tolist() if "control_index" in group else []
            if {*map(len, rows)} - {scenario.observation.count} or {*controls} - {*names}:
                raise ValueError(
                    said("watch.shape", count=scenario.observation.count, came=group[role].shape)
                )
            self._records = [{role: row, "turn": int(turn)} for row, turn in zip(rows, turns, strict=True)]
            for record, control in zip(self._records, controls, strict=False):
                record["control"] = names[control]
        except (DamagedFileError, KeyError, ValueError, TypeError, OSError) as error:
            reason = str(error).rstrip(".")
            raise MissionInputError(said("watch.netcdf", path=path, role=role, reason=reason)) from None

    def _place(self, read: int) -> Place:
        first = json.dumps(self._records[: min(read, _FIRST)]).encode()
        return {"beginning": sha256(first).hexdigest(), "read": read}

    def holds(self, place: Place) -> bool:
        """Return whether its first steps are those of a place."""
        return self._place(place["read"]) == place

    def messages(self, place: Place | None) -> Iterator[Fed]:
        """Return the steps behind a place."""
        for row in range(place["read"] if place else 0, len(self._records)):
            self.place = self._place(row + 1)
            yield parsed(self._reader, self._records[row]), f"row {row}"


class FolderFeed(RecordedFeed):
    """The journal of another run or watch, of whatever version: its observations as they came.

    A line that was damaged is refused, and those behind it are read on.

    Raises
    ------
    MissionInputError
        The folder holds no journal.
    """

    def __init__(self, folder: Path, scenario: Scenario) -> None:
        self.path = folder / JOURNAL_NAME
        self._scenario = scenario
        if not self.path.is_file():
            raise MissionInputError(f"{folder} holds no journal of a run or a watch ({JOURNAL_NAME}).")

    def messages(self, place: Place | None) -> Iterator[Fed]:
        """Return the observations behind a place."""
        stream = GrowingFile(self.path, place)
        stream.longest = math.inf
        for line in stream:
            if not isinstance(line, bytes) or not line.endswith(b"\n"):
                return  # cut off by a kill
            record, self.place = whole_record(line), stream.place
            if record is None:
                with self.path.open("rb") as journal:
                    number = journal.read(self.place["read"]).count(b"\n")
                yield Refused(f"line {number} of {self.path.name} was changed or is damaged"), ""
            elif _came(record):
                yield self._message(record), f"turn {record.get('turn')}"

    def _message(self, record: Mapping[str, Any]) -> Message | Refused:
        try:
            observed, control = array_of(record["observed"]), int(record["control_index"])
            turn = int(record.get("observation_turn", record["turn"]))
        except (KeyError, TypeError, ValueError):
            return Refused("the line has another layout")
        sensors = self._scenario.observation
        if len(observed) not in (sensors.count, self._scenario.row_width) or control >= len(
            self._scenario.control
        ):
            return Refused("it is of an asset with other sensors or controls")
        return Message(observed, turn, None, control)


class JsonLinesFeed(Feed):
    """JSON objects, one a line, from a stream such as standard input."""

    def __init__(self, scenario: Scenario, stream: IO[bytes] | None = None) -> None:
        self._reader = MessageReader(scenario)
        self._stream = stream
        self._looks = scenario.watch.quiet_after_seconds is not None

    def messages(self, place: Place | None) -> Iterator[Fed]:
        """Return what comes; where silence is to be noticed, None while nothing does."""
        stream = self._stream or sys.stdin.buffer
        for line in Pipe(stream, looks=self._looks):
            yield (None, "") if line is None else (parsed(self._reader, line), shown(line))


class MappingFeed(Feed):
    """Messages of a program, as mappings; arrays of numbers may stand where JSON has lists."""

    def __init__(self, messages: Iterable[Mapping[str, Any]], scenario: Scenario) -> None:
        self._reader = MessageReader(scenario)
        self._messages = messages

    def messages(self, place: Place | None) -> Iterator[Fed]:
        """Return what comes."""
        for message in self._messages:
            line = json.dumps(message, default=_plain).encode()
            yield parsed(self._reader, line), shown(line)


def _plain(value: Any) -> Any:
    return np.asarray(value).tolist()


def parsed(reader: MessageReader, content: bytes | dict[str, object] | Refused) -> Message | Refused:
    """Return the observation in a JSON object, or a record, or why there is none."""
    if isinstance(content, Refused):
        return content
    try:
        return reader.read(content) if isinstance(content, dict) else reader.parse(content)
    except Refused as refusal:
        return refusal


def file_feed(path: Path, scenario: Scenario, *, follow: bool = False) -> CsvFeed | RunFeed | FolderFeed:
    """Return the feed of a run folder, or of a file: NetCDF by its ending `.nc`, else CSV.

    Raises
    ------
    MissionInputError
        It cannot be read, or a recorded one is to be followed.
    """
    if not path.exists():
        raise MissionInputError(f"there is no file {path} to read observations from.")
    is_netcdf = path.suffix.lower() == ".nc"
    if follow and (path.is_dir() or is_netcdf):
        raise MissionInputError(f"{path} is recorded: only a CSV file can be followed.")
    if path.is_dir():
        return FolderFeed(path, scenario)
    if is_netcdf:
        return RunFeed(path, scenario)
    return CsvFeed(path, scenario, follow=follow)


def _whole(cell: str) -> int:
    """Return a whole number, also one that a table of floating-point numbers has written as `12.0`."""
    number, point, zeros = cell.partition(".")
    return int(number if point and not zeros.strip("0") else cell)


def _came(record: Mapping[str, Any]) -> bool:
    """Return whether a line of a journal is of something observed, not of a turn for which nothing came."""
    given = record.get("intake", {}).get("given", "")
    predicted = given.endswith(str(MISSING)) and record.get("observation_turn") == record.get("turn")
    return "observed" in record and not predicted


def _cells(line: bytes) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line.decode("utf-8-sig").rstrip("\r\n")]), [])]
    except csv.Error as error:
        raise ValueError(str(error)) from None


def shown(line: bytes | Refused) -> str:
    """Return the begin of a message, for people."""
    return "" if isinstance(line, Refused) else line[:300].decode("utf-8", "replace").rstrip(os.linesep)


PASSWORD_VARIABLE = "UAV_TWIN_MQTT_PASSWORD"


@dataclass(frozen=True)
class Broker:
    """Where observations come from.

    Attributes
    ----------
    host, port, topic : str, int, str
        Of the broker, and of the observations; decisions go to `TOPIC/decision`, how the twin is to
        `TOPIC/heartbeat`.
    user : str or None
        Who the twin is; the password is in the environment, `UAV_TWIN_MQTT_PASSWORD`.
    tls : bool
        `mqtts://`: encrypted, the broker known by its certificate.
    authority : Path or None
        Certificate of the authority, where the system does not know it.
    """

    host: str
    port: int
    topic: str
    user: str | None = None
    tls: bool = False
    authority: Path | None = None


def is_broker(observations: str) -> bool:
    """Return whether observations come from a broker, and not from a file."""
    return observations.startswith(("mqtt://", "mqtts://"))


def broker_of(address: str, authority: Path | None = None, *, many: bool = False) -> Broker:
    """Return the broker of `mqtt://[USER@]HOST[:PORT]/TOPIC`, or `mqtts://` with TLS.

    Of many assets the topic ends with `/+`, which stands for the name of each.

    Raises
    ------
    MissionInputError
        paho-mqtt is not installed, or it is no such address, has a password in it, or a topic of many assets;
        the authority's file holds no certificate.
    """
    if find_spec("paho") is None:
        raise MissionInputError("observations over MQTT need paho-mqtt: pip install 'uav-twin[mqtt]'.")
    try:
        parts = urlsplit(address)
        port, topic = parts.port, unquote(parts.path.lstrip("/"))
    except ValueError:
        parts, port, topic = urlsplit("mqtt:"), None, ""
    if not parts.hostname or not topic:
        raise MissionInputError(f"{address}: `mqtt://[USER@]HOST[:PORT]/TOPIC` is expected, or `mqtts://`.")
    if parts.password is not None:
        raise MissionInputError(said("watch.password", variable=PASSWORD_VARIABLE))
    if many and (not topic.endswith("/+") or "+" in topic[:-1] or "#" in address):
        raise MissionInputError(f"{address}: a topic of many assets is expected, such as wings/+.")
    if not many and ("#" in address or "+" in topic):
        raise MissionInputError(f"{address}: a topic of one asset is expected, without `#` and `+`.")
    tls, user = parts.scheme == "mqtts", None if parts.username is None else unquote(parts.username)
    if authority is not None:
        if not (tls and authority.is_file()):
            raise MissionInputError(f"the certificate {authority} is a file, and belongs to mqtts://.")
        try:
            create_default_context(cafile=authority)
        except OSError as error:
            raise MissionInputError(f"{authority} holds no certificate: {error}.") from None
    return Broker(parts.hostname, port or (8883 if tls else 1883), topic, user, tls, authority)


def feed_of(
    given: Observations | None,
    scenario: Scenario,
    follow: bool,
    authority: Path | None,
    otherwise: str | None,
) -> Feed | Broker:
    """Return what gives the observations, by default those of the scenario, or the broker that does."""
    for observations in (given, scenario.watch.recording, otherwise):
        if observations is None:
            continue
        if not isinstance(observations, str | Path):
            return MappingFeed(observations, scenario)
        if is_broker(str(observations)):
            return broker_of(str(observations), authority)
        if str(observations) != STANDARD_INPUT:
            return file_feed(Path(observations), scenario, follow=follow)
        if follow:
            raise MissionInputError(said("watch.follow"))
        return JsonLinesFeed(scenario)
    raise MissionInputError(said("watch.recording", name=scenario.mission.name))
