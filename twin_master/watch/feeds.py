"""Messages from files, recorded or growing, from standard input, from a program; addresses of brokers."""

import csv
import io
import json
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from ssl import create_default_context
from typing import IO, Any, BinaryIO
from urllib.parse import unquote, urlsplit

import numpy as np
import xarray as xr

from reporting.errors import DamagedFileError
from reporting.former_names import warn_of_former_names
from reporting.netcdf import read_groups
from twin_master.errors import MissionInputError, said
from twin_master.mission.journal import JOURNAL_NAME, array_from_json, record_of_line
from twin_master.scenario.schema import Scenario
from twin_master.watch.intake import GIVEN, MISSING, Feed
from twin_master.watch.lines import GrowingFile, Pipe, Place, first_line, found, holds, rotated
from twin_master.watch.message import LARGEST_MESSAGE, PRESENT_NAMES, Fed, Message, MessageReader, Refused

Observations = Iterable[Mapping[str, Any]] | str | Path
STANDARD_INPUT = "-"
Content = bytes | Mapping[str, object] | Message | Refused


def fed(scenario: Scenario, contents: Iterable[bytes | Refused | None]) -> Iterator[Fed]:
    """Return JSON objects about the asset of a scenario as messages."""
    reader = MessageReader(scenario)
    for content in contents:
        yield (None, "") if content is None else (reader.message(content), shown(content))


def json_lines(scenario: Scenario, stream: IO[bytes]) -> Feed:
    """Return the feed of a stream of JSON objects, one a line; it is looked at where silence is noticed."""
    return Feed(fed(scenario, Pipe(stream, looks=scenario.watch.quiet_after_seconds is not None)))


def mappings(scenario: Scenario, messages: Iterable[Mapping[str, Any]]) -> Feed:
    """Return the feed of messages of a program; arrays of numbers may stand where JSON has lists."""

    def plain(value: Any) -> Any:
        return np.asarray(value).tolist()

    return Feed(fed(scenario, (json.dumps(message, default=plain).encode() for message in messages)))


def shown(line: bytes | Refused) -> str:
    """Return the begin of a message, for people."""
    return "" if isinstance(line, Refused) else line[:300].decode("utf-8", "replace").rstrip(os.linesep)


class RecordedFeed(Feed):
    """What a file of lines holds, and may be read again.

    Parameters
    ----------
    path : Path
    scenario : Scenario
        Of the asset.
    follow : bool
        Its end is not the last: more may come, also in a file that takes its place.
    """

    replayable = True
    longest: float = LARGEST_MESSAGE

    def __init__(self, path: Path, scenario: Scenario, *, follow: bool = False) -> None:
        super().__init__()
        self.path, self.follow = path, follow
        self.scenario, self.reader = scenario, MessageReader(scenario)

    def holds(self, place: Place) -> bool:
        """Return whether a place is in the file; where it is followed, also under its name of today."""
        with self.opened(place) as file:
            return holds(file, place)

    def opened(self, place: Place | None) -> BinaryIO:
        """Return the file that a place is in, or that of the name."""
        return (found(self.path, place, follow=self.follow) or self.path).open("rb", buffering=0)

    def messages(self, place: Place | None) -> Iterator[Fed]:
        """Return the messages behind a place."""
        lines = GrowingFile(self.opened(place), place, self.path if self.follow else None)
        lines.longest = self.longest
        for line in lines:
            content = self.content(line, lines.begin) if isinstance(line, bytes) else line
            self.place = lines.place
            if content is not None:
                yield self.reader.message(content), shown(line or b"")
            elif line is None:
                yield None, ""

    def content(self, line: bytes, begin: int) -> Content | None:
        """Return what a line says that begins at so many bytes of a file; None where it is no message."""
        return line


def _whole(cell: str) -> int:
    """Return a whole number, also one that a table of floating-point numbers has written as `12.0`."""
    number, point, zeros = cell.partition(".")
    return int(number if point and not zeros.strip("0") else cell)


_OTHERS: dict[str, Callable[[str], object]] = {"step": _whole, "time": float, "control": str}
"""Columns that are no sensor."""
_LOST = ("nan", "null", "none")


class CsvFeed(RecordedFeed):
    """A CSV file with a header: `step` or `time`, `control`, and sensors by their names.

    A file that takes the place of one that is followed has a header of its own, or the same columns.

    Raises
    ------
    MissionInputError
        It cannot be read, or a column is neither of these.
    """

    def __init__(self, path: Path, scenario: Scenario, *, follow: bool = False) -> None:
        super().__init__(path, scenario, follow=follow)
        self._take_columns(self._header(follow=follow))

    def _header(self, *, follow: bool) -> list[str]:
        """Return the names of the columns.

        A file that was begun a moment ago has no header yet, and one that was copied and cut has lost it:
        where the file is followed, the header of the newest rotated file that has one holds for it.
        """
        files = [self.path, *(reversed(rotated(self.path)) if follow else ())]
        try:
            lines = [first_line(file) for file in files]
            whole_lines = [line for line in lines if line.endswith(b"\n")] or lines[:1]
            rows = [_cells(line) for line in whole_lines]
        except (OSError, ValueError) as error:
            reason = str(error).rstrip(".")
            raise MissionInputError(f"{self.path} cannot be read as CSV: {reason}.") from None
        for names in rows:
            if not self._is_reading(names):
                return names
        where = (
            "and no rotated file beside it has that line"
            if follow
            else ("which a rotated file beside it may have: that one is found with --follow")
        )
        raise MissionInputError(
            f"{self.path} begins with `{','.join(rows[0])[:60]}`, which is a row of readings: a CSV file "
            f"begins with a line of its columns, {where}."
        )

    def _is_reading(self, cells: list[str]) -> bool:
        """Return whether the cells of a line are readings, and no names of columns."""
        if not any(map(_is_number, cells)):
            return False
        try:  # sensors may be called by numbers
            columns = [PRESENT_NAMES.get(cell, cell) for cell in cells]
            return not all(name in _OTHERS or self.reader.column(name) is not None for name in columns)
        except Refused:  # a known name with a wrong unit
            return False

    def _take_columns(self, names: list[str]) -> None:
        """Take the names of columns for those of the rows that follow.

        Raises
        ------
        MissionInputError
            There are none, or one is no column, or two say the same.
        """
        path = self.path
        if not any(names):
            raise MissionInputError(f"{path} is empty: a CSV file begins with a line of its columns.")
        if names[0].startswith("{"):
            raise MissionInputError(said("watch.json_lines", path=path))
        columns = [PRESENT_NAMES.get(name, name) for name in names]
        former = {name: PRESENT_NAMES[name] for name in names if name in PRESENT_NAMES}
        if former:
            warn_of_former_names(str(path), former)
        candidates = [name for name in columns if name not in _OTHERS and name[:1] != "_"]
        try:
            sensors = [found[0] for found in map(self.reader.column, candidates) if found is not None]
            unknown = [name for name in candidates if self.reader.column(name) is None]
            is_any_known = len(unknown) < len(columns)
            if unknown and not (self.reader.allows_unknown and is_any_known):
                raise Refused(self.reader.unknown(unknown, is_any_known=bool(sensors)))
        except Refused as refusal:
            raise MissionInputError(
                f"{path}: the columns cannot be read, {refusal}; others are `step`, `time` and `control`."
            ) from None
        if len({*sensors}) < len(sensors) or any(columns.count(name) > 1 for name in _OTHERS):
            raise MissionInputError(f"{path}: two columns say the same; {', '.join(names)[:300]} came.")
        self._names = columns

    def opened(self, place: Place | None) -> BinaryIO:
        """Return the file that a place is in, after its columns were taken."""
        file = super().opened(place)
        self.content(first_line(Path(file.name)), 0)
        return file

    def content(self, line: bytes, begin: int) -> Content | None:
        """Return the record of a row; None for a header."""
        try:
            cells = _cells(line)
        except ValueError as error:
            return Refused(f"it is no line of CSV: {str(error)[:80]}")
        if not begin and not self._is_reading(cells):
            with suppress(MissionInputError):
                self._take_columns(cells)
                return None
        if len(cells) != len(self._names):
            return Refused(f"{len(self._names)} cells are expected, and {len(cells)} came")
        try:
            return {
                name: _OTHERS.get(name, str)(cell)
                for name, cell in zip(self._names, cells, strict=True)
                if cell and not (name in _OTHERS and cell.lower() in _LOST)
            }
        except (ValueError, OverflowError) as error:
            return Refused(f"a cell is no number: {str(error)[:80]}")


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _cells(line: bytes) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line.decode("utf-8-sig").rstrip("\r\n")]), [])]
    except csv.Error as error:
        raise ValueError(str(error)) from None


class RunFeed(RecordedFeed):
    """A NetCDF file with the group `observed` of a run: observations and the controls that were in force.

    Raises
    ------
    MissionInputError
        It cannot be read, or holds other sensors or controls.
    """

    def __init__(self, path: Path, scenario: Scenario) -> None:
        super().__init__(path, scenario)
        role, names = scenario.observation.role, dict(enumerate(scenario.control_names))
        try:
            group: xr.Dataset = read_groups(path)["observed"].to_dataset()
            rows, steps = group[role].values.tolist(), group["step"].values.tolist()
            controls = group["control_index"].values.tolist() if "control_index" in group else []
            if {*map(len, rows)} - {scenario.observation.count} or {*controls} - {*names}:
                raise ValueError(
                    said("watch.shape", count=scenario.observation.count, came=group[role].shape)
                )
            records = [{role: row, "step": int(step)} for row, step in zip(rows, steps, strict=True)]
            for name in (name for *_, name, _ in scenario.readings if name in group):
                for record, value in zip(records, group[name].values.tolist(), strict=True):
                    record |= {name: value} if math.isfinite(value) else {}
            known = group.get(f"{role}_covariance")  # of modes
            for record, triangle in zip(records, () if known is None else known.values, strict=False):
                matrix = np.zeros((scenario.observation.count,) * 2)
                matrix[np.tril_indices(len(matrix))] = np.nan_to_num(triangle)
                record["covariance"] = (matrix + np.tril(matrix, -1).T).tolist()
        except (DamagedFileError, KeyError, ValueError, TypeError, OSError) as error:
            reason = str(error).rstrip(".")
            raise MissionInputError(said("watch.netcdf", path=path, role=role, reason=reason)) from None
        for record, control in zip(records, controls, strict=False):
            record["control"] = names[control]
        self._lines = "".join(f"{json.dumps(record)}\n" for record in records).encode()

    def opened(self, place: Place | None) -> BinaryIO:
        """Return its steps as lines of JSON."""
        return io.BytesIO(self._lines)


class FolderFeed(RecordedFeed):
    """The journal of another run or watch, of whatever version: its observations as they came.

    A line that was damaged is refused, and those behind it are read on.

    Raises
    ------
    MissionInputError
        The folder holds no journal.
    """

    longest = math.inf

    def __init__(self, folder: Path, scenario: Scenario) -> None:
        super().__init__(folder / JOURNAL_NAME, scenario)
        if not self.path.is_file():
            raise MissionInputError(f"{folder} holds no journal of a run or a watch ({JOURNAL_NAME}).")

    def content(self, line: bytes, begin: int) -> Content | None:
        """Return the observation of a line; None where it is of none, or was cut off by a kill."""
        record = record_of_line(line, self.path)
        if record is None and line.endswith(b"\n"):
            number = self.path.read_bytes()[:begin].count(b"\n") + 1
            return Refused(f"line {number} of {self.path.name} was changed or is damaged")
        if record is None or "observed" not in record:
            return None
        try:
            observed, control = array_from_json(record["observed"]), int(record["control_index"])
            step, told = int(record.get("observation_step", record["step"])), GIVEN
            if "intake" in record:
                told = int(record["intake"]["given"][step - int(record["step"]) - 1])
        except (KeyError, TypeError, ValueError, IndexError):
            return Refused("the line has another layout")
        if told == MISSING:  # a step for which nothing came
            return None
        count, width = self.scenario.observation.count, self.scenario.row_width
        if len(observed) not in (count, width) or control >= len(self.scenario.control):
            return Refused("it is of an asset with other sensors or controls")
        row = np.full(width, np.nan)  # it may have been recorded without covariances
        row[: len(observed)] = observed
        return Message(row, control, step=step, assumed=told != GIVEN)


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
        with MissionInputError.instead_of(OSError, before=f"{authority} holds no certificate: ", after="."):
            create_default_context(cafile=authority)
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
            return mappings(scenario, observations)
        if is_broker(str(observations)):
            return broker_of(str(observations), authority)
        if str(observations) != STANDARD_INPUT:
            return file_feed(Path(observations), scenario, follow=follow)
        if follow:
            raise MissionInputError(said("watch.follow"))
        return json_lines(scenario, sys.stdin.buffer)
    raise MissionInputError(said("watch.recording", name=scenario.mission.name))
