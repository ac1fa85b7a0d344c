"""A file of lines that may grow and be rotated, read as one stream."""

import io
import os
import re
from collections import deque
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import lru_cache
from glob import escape
from hashlib import sha256
from pathlib import Path
from typing import Any

Place = Mapping[str, Any]
"""Where a feed stands behind a message, as JSON: in a file the hash of its `beginning`, and bytes `read`."""

RECOGNISED_BY = 9
"""First lines of a file by which it is known again, also under another name."""
_LONGEST = 1_000_000
"""Bytes of these at most."""
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


@dataclass
class _Piece:
    """A file within the stream: at which byte of the stream, and of its own, it was begun; how it begins."""

    start: int
    position: int
    beginning: bytes


class GrowingFile(io.RawIOBase):
    """A file; where it is followed, with those that take its name, as one stream without end.

    A file that was renamed is read to its end once there is something in the next one: its writer has left it
    then. What was not read of a file that was copied and cut is read from the copy.

    Parameters
    ----------
    path : Path
    place : mapping or None
        Behind which it begins; at the begin of the file where that is not found.
    follow : bool

    Attributes
    ----------
    cut : int
        Where a file was cut of which there is no copy, in bytes; 0 where none was.
    """

    def __init__(self, path: Path, place: Place | None = None, *, follow: bool = False) -> None:
        super().__init__()
        self._path, self._follow = path, follow
        self._length, self.cut = 0, 0
        self._whole, self._torn, self._copied = True, False, False
        self._pieces: deque[_Piece] = deque()
        self._open((found(path, place, follow=follow) or path).open("rb", buffering=0), place)

    def _open(self, file: io.FileIO, place: Place | None) -> None:
        """Go on with a file: behind a place, if it is in there."""
        position = place["read"] if place is not None and _holds(file, place, self._follow) else 0
        self._file = file
        self._file.seek(0)
        beginning = self._file.read(min(position, _LONGEST))
        self._file.seek(position)
        self._pieces.append(_Piece(self._length, position - self._torn, _beginning(beginning)))

    def readable(self) -> bool:
        """Return that it can be read."""
        return True

    def tell(self) -> int:
        """Return the bytes of the stream so far."""
        return self._length

    def readinto(self, buffer: Any) -> int:
        """Read what there is; 0 where there is nothing yet."""
        if self._torn:  # no line goes on in the next file
            buffer[:1], self._torn = b"\n", False
            self._length += 1
            return 1
        count = self._file.readinto(buffer) or 0
        if self._follow and self._was_cut():
            place = self._place(self._pieces[-1], self._length)
            copy = found(self._path, place, follow=True)
            self.cut = 0 if copy else place["read"]
            file = (copy or self._path).open("rb", buffering=0)
            return self._go_on(file, buffer, copied=copy is not None)
        following = self._following() if self._follow and not count else None
        if following is not None:
            count = self._file.readinto(buffer) or 0  # the last that its writer has left
            if not count:
                return self._go_on(following, buffer)
            following.close()
        if count:
            self._whole = buffer[count - 1] == ord("\n")
            self._length += count
            piece = self._pieces[-1]
            if piece.beginning.count(b"\n") < RECOGNISED_BY and len(piece.beginning) < _LONGEST:
                piece.beginning = _beginning(piece.beginning + bytes(buffer[:count]))
        return count

    def _was_cut(self) -> bool:
        """Return whether the file is not any more what was read of it, also where it has grown again."""
        at, beginning = self._file.tell(), self._pieces[-1].beginning
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

    def _go_on(self, file: io.FileIO, buffer: Any, *, copied: bool = False) -> int:
        """Read on in another file; a line goes on only into a copy, and from there into what was cut."""
        self._torn = not (self._whole or self._copied or copied)
        self._file.close()
        self._open(file, self._place(self._pieces[-1], self._length))
        self._copied = copied
        return self.readinto(buffer)

    def begins(self, offset: int) -> bool:
        """Return whether a file begins at a byte of the stream."""
        return any(piece.position + offset == piece.start for piece in self._pieces)

    def place(self, offset: int) -> Place:
        """Return the place behind a byte of the stream; those before it are not asked for any more."""
        while len(self._pieces) > 1 and self._pieces[1].start < offset:
            self._pieces.popleft()
        return self._place(self._pieces[0], offset)

    def _place(self, piece: _Piece, offset: int) -> Place:
        read = piece.position + offset - piece.start
        return {"beginning": _hash(_beginning(piece.beginning[:read])), "read": read}

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()
        super().close()
