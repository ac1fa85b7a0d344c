"""What a publisher sends: one observation, checked, in SI; and a file of lines that may grow and be rotated.

A publisher is not trusted. Whatever it sends is an observation or a `Refused` with one sentence.
"""

import io
import json
import math
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from difflib import get_close_matches
from functools import lru_cache
from glob import escape
from hashlib import sha256
from pathlib import Path
from select import select
from typing import IO, Any, BinaryIO
from unicodedata import normalize

import numpy as np

from reporting.arrays import Float
from reporting.json_file import parse_json
from reporting.words import listing
from twin_master.errors import said
from twin_master.mission.turns import Reading
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import LARGEST_SEED

LARGEST_MESSAGE = 1_000_000
"""Bytes of a message; a larger one is refused unread."""
LARGEST_STRAIN = 0.5
"""A strain beyond this is one whose unit was forgotten."""
LARGEST = 1e30
"""The same of any other sensor, SI: far beyond what exists, and its powers are still numbers."""
_PREFIXES = {"": 1.0, "n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6, "G": 1e9}
_POWER = re.compile(r"[^\W\d_]+(?:\^|\*\*)?([+-]?\d)")
"""A unit whose first name has a power, which its prefix has, too: a mm2 is 1e-6 m2."""
_WITHOUT_UNIT = {"1": 1.0, "percent": 1e-2, "microstrain": 1e-6}
_NAMED = re.compile(r"^(.*?)\s*[\[(]([^\])]*)[\])]$")


class Refused(Exception):  # noqa: N818 - what it is, not what went wrong
    """A message that is no observation; the sentence says why."""


@dataclass(frozen=True)
class Message(Reading):
    """An observation as it was sent, SI; where modes are observed, a row with their covariance.

    Attributes
    ----------
    turn : int or None
        Its turn, if it says so.
    time : float or None
        Its time [s], if it says so.
    assumed : bool
        Whether its control was not told where it was recorded.
    """

    turn: int | None = None
    time: float | None = None
    assumed: bool = False


Fed = tuple[Message | Refused | None, str]
"""A message with the begin of its text; None where nothing more has come yet."""


class MessageReader:
    """Reads the messages about the asset of a scenario.

    A sensor goes by `ROLE_NUMBER` (`strain_7`) or its title, its unit behind it: `strain_7_microstrain`,
    `strain_7 [microstrain]`; without a unit it is in that of the scenario. The reading of an inspection goes
    by `ACTION_STATE` (`inspect_z1_percent`). All sensors together go by their role, as a list, with `unit`
    beside it. A sensor of which no number comes, or an absurd one, is lost alone.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._observation, self._allows_unknown = scenario.observation, scenario.watch.allow_unknown
        self._controls = scenario.control_names
        role, count = scenario.observation.role, scenario.observation.count
        self._index = {f"{role}_{number + 1}": number for number in range(count)}
        self._index |= {title: number for number, title in enumerate(scenario.observation.titles)}
        units, self._width = scenario.observation.sensor_units, scenario.row_width
        self._largest = [LARGEST_STRAIN if role == "strain" and unit == "1" else LARGEST for unit in units]
        self._index |= {name: count + place for place, (*_, name, _) in enumerate(scenario.readings)}
        self._units = [*units, *(scenario.state[place].unit for _, place, *_ in scenario.readings)]
        self._largest += [LARGEST] * len(scenario.readings)
        # Names that mean the same come without end.
        self.column = lru_cache(maxsize=2 * len(self._index))(self._column)

    def _column(self, name: str) -> tuple[int, float] | None:
        """Return the index of the sensor that a name stands for, and what its values are multiplied by.

        None for a name that is no sensor, where the scenario allows them.

        Raises
        ------
        Refused
            It is no sensor, or not in a unit of this sensor.
        """
        base, unit = name, ""
        if name not in self._index:
            named = _NAMED.match(name)
            base, unit = named.groups() if named else name.rpartition("_")[::2]
        if base not in self._index and self._allows_unknown:
            return None
        if base not in self._index:
            near = _near(name[:60], *self._index)
            raise Refused(said("watch.no_sensor", name=name[:60], near=near, count=len(self._units)))
        sensor = self._index[base]
        own = self._units[sensor]
        squared = _POWER.match(normalize("NFKC", own))
        power = int(squared[1]) if squared else 1
        known = {prefix + own: factor**power for prefix, factor in _PREFIXES.items()}
        known = _WITHOUT_UNIT if own == "1" else known
        if unit and unit not in known:
            what = f"`{unit[:30]}` is no unit of sensor {sensor + 1}"
            raise Refused(f"{what}: it is read in {listing(known, 'or')}")
        return sensor, known[unit or own]

    def message(self, content: bytes | Mapping[str, object] | Message | Refused) -> Message | Refused:
        """Return the observation in a JSON object, or in a record of one, or why there is none."""
        try:
            content = self._parsed(content) if isinstance(content, bytes) else content
            return content if isinstance(content, Message | Refused) else self._read(content)
        except Refused as refusal:
            return refusal

    def _parsed(self, content: bytes) -> dict[str, object]:
        if len(content) > LARGEST_MESSAGE:
            raise Refused(f"a message has at most {LARGEST_MESSAGE} bytes, and {len(content)} came")
        try:
            record = parse_json(content, "the message", Refused, any_number=True)
        except RecursionError:
            raise Refused("it is nested too deeply") from None
        if not isinstance(record, dict):
            raise Refused("it is no JSON object")
        return record

    def _read(self, record: Mapping[str, object]) -> Message:
        observed = np.full(self._width, np.nan)
        given: set[int] = set()
        unreadable: dict[int, str] = {}
        for name, value in self._readings(record):
            if name == "covariance" and self._observation.modes is not None:
                observed[self._observation.count :] = self._covariance(value)
                continue
            if (found := self.column(name)) is None:
                continue
            sensor, factor = found
            if sensor in given:
                raise Refused(f"sensor {sensor + 1} is given twice")
            given.add(sensor)
            shown = self._value(sensor, factor, value)
            if isinstance(shown, str):
                unreadable[sensor] = shown
            else:
                observed[sensor] = shown
        turn, time, control = (record.get(name) for name in ("turn", "time", "control"))
        if turn is not None and (type(turn) is not int or not 0 <= turn <= LARGEST_SEED):
            raise Refused(f"`turn` is a whole number from 0, and {turn!r:.40} came")
        time = float(time) if type(time) is int else time
        if time is not None and not (isinstance(time, float) and math.isfinite(time)):
            raise Refused("`time` is a number of seconds")
        if control not in (None, *self._controls):
            raise Refused(f"`control` is one of {', '.join(self._controls)}, or absent")
        number = None if control is None else self._controls.index(str(control))
        return Message(observed, number, unreadable=unreadable, turn=turn, time=time)

    def _readings(self, record: Mapping[str, object]) -> Iterator[tuple[str, object]]:
        """Return names and values of a record; each of a list has the name of its sensor."""
        unit, role = record.get("unit", ""), self._observation.role
        if not isinstance(unit, str):
            raise Refused("`unit` is the name of a unit")
        for name, value in record.items():
            if name == role and isinstance(value, list):
                if len(value) != self._observation.count:
                    raise Refused(f"{self._observation.count} values are expected, and {len(value)} came")
                yield from ((f"{role}_{n}_{unit}".removesuffix("_"), one) for n, one in enumerate(value, 1))
            elif name not in ("turn", "time", "control", "unit") and not name.startswith("_"):
                yield name, value

    def _covariance(self, value: object) -> Float:
        """Return the lower triangle of the covariance of all values, SI."""
        count = self._observation.count
        try:
            matrix = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            matrix = np.empty(0)
        if matrix.shape != (count, count) or not np.all(np.abs(matrix) <= LARGEST):
            raise Refused(f"`covariance` is {count} rows of {count} numbers, in SI units; null is none")
        size = np.sqrt(np.abs(np.diag(matrix)))
        size[size == 0.0] = 1.0
        with np.errstate(over="ignore"):
            scaled = matrix / size / size[:, None]
        wrong = np.abs(scaled).max() > 1.0 + 1e-6 or np.abs(scaled - scaled.T).max() > 1e-6
        if wrong or np.linalg.eigvalsh(scaled)[0] < -1e-6:
            raise Refused("`covariance` is not symmetric with eigenvalues of zero or more")
        return matrix[np.tril_indices(count)]

    def _value(self, sensor: int, factor: float, value: object) -> float | str:
        """Return what a sensor shows, SI, or what came in the place of that; the one reader of readings."""
        try:
            number = math.nan if isinstance(value, bool) else float(value) * factor  # type: ignore[arg-type]
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if abs(number) <= self._largest[sensor]:
            return number
        if not math.isfinite(number):
            return json.dumps(value)[:30]
        forgotten = factor == 1.0 and self._largest[sensor] == LARGEST_STRAIN
        unit = f"; give its unit, such as `strain_{sensor + 1}_microstrain`" if forgotten else ""
        return f"{number:g}{unit}"


@lru_cache(maxsize=1000)
def _near(name: str, *known: str) -> str:
    """Return the names next to one, in words: kept, because finding them takes longer than a message."""
    return listing(f"`{near}`" for near in get_close_matches(name, known, 3) or known[:1])


Place = Mapping[str, Any]
"""Where a feed stands behind a message, as JSON: in a file the hash of its `beginning`, and bytes `read`."""

_PIECE = 65_536
"""Bytes that are read at once; so many at its beginning tell a file from others, also under another name."""
_NUMBER, _DATE = re.compile(r"\.\d{1,6}"), re.compile(r"[.-]\d{4}-?\d\d-?\d\d[\d_-]*")


def rotated(path: Path) -> list[Path]:
    """Return the files beside one that had its name before, and copies of them, the oldest first.

    They have a number or a date behind the name, as logrotate and `logging.handlers` make them:
    `log.csv.1`, `log.csv-20260501`, `log.csv.2026-05-01_12`.
    """
    beside = path.parent.glob(f"{escape(path.name)}[.-]*")
    endings = [file.name.removeprefix(path.name) for file in beside]
    numbers = [ending for ending in endings if _NUMBER.fullmatch(ending)]
    dates = [ending for ending in endings if _DATE.fullmatch(ending)]
    ordered = sorted(dates) + sorted(numbers, key=lambda ending: -int(ending[1:]))
    return [path.with_name(path.name + ending) for ending in ordered]


def first_line(path: Path) -> bytes:
    """Return the first line of a file, as far as it is there."""
    with suppress(FileNotFoundError), path.open("rb") as file:
        return file.readline(LARGEST_MESSAGE)
    return b""


def found(path: Path, place: Place | None, *, follow: bool) -> Path | None:
    """Return the file that a place is in: that of the name, or where it is followed a rotated one."""
    for file in [path, *reversed(rotated(path))] if follow else [path]:
        with suppress(FileNotFoundError), file.open("rb", buffering=0) as opened:
            if holds(opened, place):
                return file
    return None


def holds(opened: BinaryIO, place: Place | None) -> bool:
    """Return whether a place is in an open file."""
    if place is None or opened.seek(0, os.SEEK_END) < place["read"]:
        return False
    opened.seek(0)
    return _hash(opened.read(min(place["read"], _PIECE))) == str(place["beginning"])


@lru_cache(1000)
def _hash(beginning: bytes) -> str:
    return sha256(beginning).hexdigest()


class Lines:
    """Whole lines of what comes in pieces; what is too long is refused, and the rest at the end is a line.

    Attributes
    ----------
    begin, end : int
        Where the last line begins and ends, in bytes.
    """

    longest: float = LARGEST_MESSAGE
    begin = end = 0

    def pieces(self) -> Iterator[bytes | Refused | None]:
        """Return what comes: None where nothing has come yet; nothing, `b""`, where no line goes on."""
        raise NotImplementedError

    def __iter__(self) -> Iterator[bytes | Refused | None]:
        line: bytes | Refused = b""
        for came in self.pieces():
            if not isinstance(came, bytes):
                yield came
                continue
            if not came and line:
                yield line
                line = b""
            for piece in io.BytesIO(came):
                self.begin = self.begin if line else self.end
                self.end += len(piece)
                if isinstance(line, bytes) and len(line := line + piece) > self.longest:
                    line = Refused(f"a message has at most {self.longest} bytes")
                if piece.endswith(b"\n"):
                    yield line
                    line = b""
        if isinstance(line, bytes) and line:
            yield line


class Pipe(Lines):
    """Lines of a stream; one that `looks` is not waited for while nothing has come."""

    def __init__(self, stream: IO[bytes], *, looks: bool) -> None:
        self._stream, self._looks = stream, looks

    def pieces(self) -> Iterator[bytes | None]:
        """Return what comes until the stream ends."""
        came: bytes | None = None
        while came != b"":
            silent = self._looks and not select([self._stream], [], [], 0.0)[0]
            came = None if silent else self._stream.read1(_PIECE)  # type: ignore[attr-defined]
            if came != b"":
                yield came


class GrowingFile(Lines):
    """A file of lines, from a place in it on; one that is followed has no end.

    Parameters
    ----------
    file : file
        Open to be read.
    place : mapping, optional
        Where to begin; at the beginning of the file where it is not of this one.
    path : Path, optional
        Go on in the files that take the place of this one. A file that was renamed is read to its end, then
        those that came after it; a copy of one that was cut is read to its end, then the file again.
    """

    def __init__(self, file: BinaryIO, place: Place | None = None, path: Path | None = None) -> None:
        self._path, self._copied = path, False
        self._open(file, place)

    def _open(self, file: BinaryIO, place: Place | None) -> None:
        self.end = place["read"] if place and holds(file, place) else 0
        file.seek(0)
        self._file, self._beginning = file, file.read(min(self.end, _PIECE))
        file.seek(self.end)

    @property
    def place(self) -> Place:
        """Where the last line ends."""
        return {"beginning": _hash(self._beginning[: self.end]), "read": self.end}

    def pieces(self) -> Iterator[bytes | Refused | None]:
        """Return what has come; a file that another one takes the place of is read to its end before."""
        try:
            while (came := self._file.read(_PIECE)) or self._path:
                if self._path and self._was_cut():
                    copy = found(self._path, self.place, follow=True)
                    if copy is None:
                        yield Refused(said("watch.cut", name=self._path.name, byte=self.end))
                    yield from self._go_on((copy or self._path).open("rb", buffering=0), copied=bool(copy))
                    continue
                if not came and self._path and (following := self._following(self._path)):
                    came = self._file.read(_PIECE)  # the last that its writer has left
                    if not came:
                        yield from self._go_on(following)
                        continue
                    following.close()
                if len(self._beginning) < _PIECE:
                    self._beginning = (self._beginning + came)[:_PIECE]
                yield came or None
        finally:
            self._file.close()

    def _go_on(self, file: BinaryIO, *, copied: bool = False) -> Iterator[bytes]:
        """Read another file; a line goes on there only where it is, or follows, a copy of this one."""
        joined, place = self._copied or copied, self.place
        self._file.close()
        self._open(file, place)
        self._copied = copied
        if not joined:
            yield b""

    def _was_cut(self) -> bool:
        """Return whether the file is not any more what was read of it, also where it has grown again."""
        same = os.pread(self._file.fileno(), len(self._beginning), 0) == self._beginning
        return not same or os.fstat(self._file.fileno()).st_size < self._file.tell()

    def _following(self, path: Path) -> BinaryIO | None:
        """Return the file to go on with, once it holds something; None where this one still has its name."""
        with suppress(FileNotFoundError):  # in the middle of being renamed
            here = os.fstat(self._file.fileno())
            if os.path.samestat(here, path.stat()):
                return None
            listed, again = _listed(path), _listed(path)
            own = [number for number, inode in enumerate(listed.values()) if inode == here.st_ino]
            behind = [*listed][own[0] + 1 :] if own else [path]
            coming = next((file for file in behind if file.stat().st_size), None)
            if coming is None:
                return None
            with ExitStack() as closing:
                opened = closing.enter_context(coming.open("rb", buffering=0))
                if listed == again == _listed(path):  # it still had that name when it was opened
                    closing.pop_all()
                    return opened
        return None


def _listed(path: Path) -> dict[Path, int]:
    return {file: file.stat().st_ino for file in (*rotated(path), path)}
