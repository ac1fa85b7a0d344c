"""A file of lines that may grow and be rotated, read as one stream."""

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
from typing import IO, Any

from twin_master.watch.message import LARGEST_MESSAGE, Refused

Place = Mapping[str, Any]
"""Where a feed stands behind a message, as JSON: in a file the hash of its `beginning`, and bytes `read`."""

RECOGNISED_BY = 9
"""First lines of a file by which it is known again, also under another name."""
_LONGEST = 1_000_000
"""Bytes of these at most."""
_PIECE = 65_536
"""Bytes that are read at once."""
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


def found(path: Path, place: Place | None, *, follow: bool) -> Path | None:
    """Return the file that a place is in: that of the name, or where it is followed a rotated one."""
    for file in [path, *reversed(rotated(path))] if follow else [path]:
        with suppress(FileNotFoundError), file.open("rb", buffering=0) as opened:
            if _holds(opened, place, follow):
                return file
    return None


def _holds(opened: io.FileIO, place: Place | None, follow: bool) -> bool:
    if place is None or (follow and os.fstat(opened.fileno()).st_size < place["read"]):
        return False
    opened.seek(0)
    beginning = _beginning(opened.read(min(place["read"], _LONGEST)))
    return _hash(beginning) == str(place["beginning"])


def _beginning(content: bytes) -> bytes:
    behind = sum(map(len, content.split(b"\n", RECOGNISED_BY)[RECOGNISED_BY:]))
    return content[: min(len(content) - behind, _LONGEST)]


@lru_cache(1000)
def _hash(beginning: bytes) -> str:
    return sha256(beginning).hexdigest()


class Lines:
    """Whole lines of what comes in pieces; what is too long is refused, and the rest at the end is a line.

    Attributes
    ----------
    left : int
        Bytes of the last piece behind the last line.
    first : bool
        Whether the last line began with its piece.
    """

    longest: float = LARGEST_MESSAGE
    left, first = 0, False

    def pieces(self) -> Iterator[bytes | None]:
        """Return what comes: None where nothing has come yet; nothing, `b""`, where no line goes on."""
        raise NotImplementedError

    def __iter__(self) -> Iterator[bytes | Refused | None]:
        line: bytes | Refused = b""
        for came in self.pieces():
            if came is None:
                yield None
                continue
            if not came and line:
                self.first = False
                yield line
                line = b""
            self.left = len(came)
            for piece in io.BytesIO(came):
                self.first = self.left == len(came) and not line
                self.left -= len(piece)
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
    path : Path
    place : mapping, optional
        Where to begin; at the beginning of the file where it is not of this one.
    follow : bool
        Go on in the files that take the place of this one. A file that was renamed is read to its end, then
        those that came after it; a copy of one that was cut is read to its end, then the file again.

    Attributes
    ----------
    cut : int
        Bytes read of a file that was cut, and of which no copy was found; to be set to 0 by who tells it.
    """

    def __init__(self, path: Path, place: Place | None = None, *, follow: bool = False) -> None:
        self._path, self._follow = path, follow
        self.cut, self._copied = 0, False
        self._open((found(path, place, follow=follow) or path).open("rb", buffering=0), place)

    def _open(self, file: io.FileIO, place: Place | None) -> None:
        position = place["read"] if place is not None and _holds(file, place, self._follow) else 0
        file.seek(0)
        self._beginning = _beginning(file.read(min(position, _LONGEST)))
        file.seek(position)
        self._file, self._read, self.left = file, position, 0

    @property
    def place(self) -> Place:
        """Where the last line ends."""
        read = self._read - self.left
        return {"beginning": _hash(_beginning(self._beginning[:read])), "read": read}

    @property
    def begins(self) -> bool:
        """Whether the last line is the first of a file."""
        return self.first and self._begun

    def pieces(self) -> Iterator[bytes | None]:
        """Return what has come; a file that another one takes the place of is read to its end before."""
        try:
            while True:
                self.left, place = 0, self.place
                came = self._file.read(_PIECE)
                if self._follow and self._was_cut():
                    copy = found(self._path, place, follow=True)
                    self.cut = 0 if copy else place["read"]
                    file = (copy or self._path).open("rb", buffering=0)
                    yield from self._go_on(file, place, copied=copy is not None)
                    continue
                following = self._following() if self._follow and not came else None
                if following is not None:
                    came = self._file.read(_PIECE)  # the last that its writer has left
                    if not came:
                        yield from self._go_on(following, place)
                        continue
                    following.close()
                if came and self._beginning.count(b"\n") < RECOGNISED_BY and len(self._beginning) < _LONGEST:
                    self._beginning = _beginning(self._beginning + came)
                if not came and not self._follow:
                    return
                self._begun, self._read = place["read"] == 0, self._file.tell()
                yield came or None
        finally:
            self._file.close()

    def _go_on(self, file: io.FileIO, place: Place, *, copied: bool = False) -> Iterator[bytes]:
        """Read another file; a line goes on there only where it is, or follows, a copy of this one."""
        joined = self._copied or copied
        self._file.close()
        self._open(file, place)
        self._copied = copied
        if not joined:
            yield b""

    def _was_cut(self) -> bool:
        """Return whether the file is not any more what was read of it, also where it has grown again."""
        at, beginning = self._file.tell(), self._beginning
        self._file.seek(0)
        same = self._file.read(len(beginning)) == beginning
        self._file.seek(at)
        return not same or os.fstat(self._file.fileno()).st_size < at

    def _following(self) -> io.FileIO | None:
        """Return the file to go on with, once it holds something; None where this one still has its name."""
        with suppress(FileNotFoundError):  # in the middle of being renamed
            here = os.fstat(self._file.fileno())
            if os.path.samestat(here, self._path.stat()):
                return None
            listed, again = self._listed(), self._listed()
            own = [number for number, inode in enumerate(listed.values()) if inode == here.st_ino]
            behind = [*listed][own[0] + 1 :] if own else [self._path]
            coming = next((file for file in behind if file.stat().st_size), None)
            if coming is None:
                return None
            with ExitStack() as closing:
                opened = closing.enter_context(coming.open("rb", buffering=0))
                if listed == again == self._listed():  # it still had that name when it was opened
                    closing.pop_all()
                    return opened
        return None

    def _listed(self) -> dict[Path, int]:
        return {file: file.stat().st_ino for file in (*rotated(self._path), self._path)}
