"""Lines of a stream, or of a file that may grow and be rotated."""

import io
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, suppress
from functools import lru_cache
from glob import escape
from hashlib import sha256
from pathlib import Path
from select import select
from typing import IO, Any, BinaryIO

from twin_master.errors import said
from twin_master.watch.message import LARGEST_MESSAGE, Refused

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
