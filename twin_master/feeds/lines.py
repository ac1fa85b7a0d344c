"""Lines of a stream, or of a file that may grow and be rotated."""

import io
import os
import re
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from functools import lru_cache, partial
from glob import escape
from hashlib import sha256
from pathlib import Path
from typing import IO, BinaryIO, TypedDict, cast

from reporting.system.operating_system import ReadableStream, is_same_beginning, polled_pieces
from twin_master.feeds.message import LARGEST_MESSAGE, Refused


class Position(TypedDict):
    """How far a feed has read a file, as a journal stores it.

    Attributes
    ----------
    beginning : str
        The first digits of the SHA-256 of the file's first bytes, which identify it under any name.
        Earlier versions stored all digits.
    read : int
        The number of bytes read.
    """

    beginning: str
    read: int


_PIECE_BYTES = 65_536
"""Number of bytes that are read at once, and of those at the beginning that identify a file."""
_STORED_DIGITS = 16
"""Number of hexadecimal digits of a hash that are stored."""
_NUMBER_SUFFIX = re.compile(r"\.\d{1,6}")
_DATE_AND_SECONDS = re.compile(r"\.\d{4}-\d\d-\d\d-\d{9,12}")
_DATE_SUFFIX = re.compile(r"[.-]\d{4}-?\d\d-?\d\d[\d_-]*")


def rotated_files(path: Path) -> list[Path]:
    """Return the rotated files of a log, oldest first.

    They are former files or copies of the log. Their names consist of the log's name and a number
    or a date, as logrotate and `logging.handlers` make them: `log.csv.1`, `log.csv-20260501`,
    `log.csv.2026-05-01_12`. Telegraf writes date and seconds since 1970 before the extension:
    `log.2026-05-01-1777629600.csv`.
    """
    dates = []
    numbers = []
    for file in path.parent.glob(f"{escape(path.name)}[.-]*"):
        suffix = file.name.removeprefix(path.name)
        if _DATE_SUFFIX.fullmatch(suffix):
            dates.append(suffix)
        elif _NUMBER_SUFFIX.fullmatch(suffix):
            numbers.append(suffix)
    dates.sort()
    # the largest number is the oldest
    numbers.sort(key=lambda suffix: int(suffix.removeprefix(".")), reverse=True)
    stamped = []
    for file in path.parent.glob(f"{escape(path.stem)}.*{escape(path.suffix)}"):
        stamp = file.name.removeprefix(path.stem).removesuffix(path.suffix)
        if path.suffix and _DATE_AND_SECONDS.fullmatch(stamp):
            stamped.append(file)
    stamped.sort()
    return stamped + [path.with_name(path.name + suffix) for suffix in dates + numbers]


def first_line(path: Path) -> bytes:
    """Return the first line of a file, perhaps still incomplete; empty if there is no file."""
    with suppress(FileNotFoundError), path.open("rb") as file:
        return file.readline(LARGEST_MESSAGE)
    return b""


def find_file(path: Path, position: Position | None, *, follow: bool) -> Path | None:
    """Return the file that contains a position, among a log and its rotated files, or None.

    Parameters
    ----------
    follow : bool
        Whether to search the rotated files, too, newest first.
    """
    files = [path]
    if follow:
        files += reversed(rotated_files(path))
    for file in files:
        with suppress(FileNotFoundError), file.open("rb", buffering=0) as opened:
            if contains(opened, position):
                return file
    return None


def contains(file: BinaryIO, position: Position | None) -> bool:
    """Return whether an open file contains a position.

    It must be long enough, and its first bytes must have the hash of the position. The file is read
    from its beginning, so that its own position changes.
    """
    if position is None or file.seek(0, os.SEEK_END) < position["read"]:
        return False
    file.seek(0)
    beginning = file.read(min(position["read"], _PIECE_BYTES))
    return _hash_of_beginning(beginning).startswith(str(position["beginning"]))


@lru_cache(1000)
def _hash_of_beginning(beginning: bytes) -> str:
    """Return the SHA-256 of the beginning of a file, which identifies it after renaming."""
    return sha256(beginning).hexdigest()


class Lines:
    """Splits a source of bytes into lines; a line that is too long is refused.

    The bytes after the last line feed are a line, too, once the source has ended.

    Attributes
    ----------
    longest : float
        The greatest length of a line [bytes].
    begin, end : int
        The beginning and the end of the last line [bytes].
    """

    longest: float = LARGEST_MESSAGE
    begin = 0
    end = 0

    def pieces(self) -> Iterator[bytes | Refused | None]:
        """Yield the bytes as they come.

        None is yielded while nothing comes, and a refusal if bytes were lost. An empty piece ends a
        line without a line feed.
        """
        raise NotImplementedError

    def __iter__(self) -> Iterator[bytes | Refused | None]:
        """Yield the lines with their line feeds, and None while no further line has come.

        A line that is too long is yielded as a refusal, once it is complete.
        """
        line: bytes | Refused = b""
        for piece in self.pieces():
            if not isinstance(piece, bytes):
                yield piece
                continue
            if not piece and line:
                yield line
                line = b""
            for part in io.BytesIO(piece):
                if not line:
                    self.begin = self.end
                self.end += len(part)
                if isinstance(line, bytes):
                    line += part
                    if len(line) > self.longest:
                        line = Refused(f"a message has at most {self.longest} bytes")
                if part.endswith(b"\n"):
                    yield line
                    line = b""
        if isinstance(line, bytes) and line:
            yield line


class Pipe(Lines):
    """The lines of a stream.

    Parameters
    ----------
    polls : bool
        Whether to yield None while nothing has come, instead of waiting.
    """

    def __init__(self, stream: IO[bytes], *, polls: bool) -> None:
        self._stream = stream
        self._polls = polls

    def pieces(self) -> Iterator[bytes | None]:
        """Yield the pieces until the stream ends."""
        if self._polls:
            yield from polled_pieces(cast(ReadableStream, self._stream), _PIECE_BYTES)
            return
        while True:
            piece: bytes | None = self._stream.read1(_PIECE_BYTES)  # type: ignore[attr-defined]
            if piece == b"":
                return
            yield piece


class GrowingFile(Lines):
    """The lines of a file from a position on; a followed file has no end.

    Parameters
    ----------
    file : file
        The file, open to be read.
    position : Position, optional
        The position to begin at; the beginning of the file if the position is not in it.
    followed_path : Path, optional
        The name to follow: reading continues in the files that get this name later. A renamed file
        is read to its end, then those that came after it. A truncated file is read on in its copy,
        to the end of the copy, and then again from its own beginning.
    """

    def __init__(
        self, file: BinaryIO, position: Position | None = None, followed_path: Path | None = None
    ) -> None:
        self._followed_path = followed_path
        self._is_copy = False
        # While the file is released: its inode, and up to where it was read [bytes]
        self._released_inode = 0
        self._released_at = 0
        self._was_missed = False
        self._start_reading(file, position)

    def _start_reading(self, file: BinaryIO, position: Position | None) -> None:
        """Read a file from a position on, or from its beginning if the position is not in it."""
        self.end = 0
        if position is not None and contains(file, position):
            self.end = position["read"]
        file.seek(0)
        self._file = file
        self._beginning = file.read(min(self.end, _PIECE_BYTES))
        file.seek(self.end)

    @property
    def position(self) -> Position:
        """The end of the last line."""
        beginning = _hash_of_beginning(self._beginning[: self.end])[:_STORED_DIGITS]
        return {"beginning": beginning, "read": self.end}

    def pieces(self) -> Iterator[bytes | Refused | None]:
        """Yield the pieces of the file and, if its name is followed, of files that replace it."""
        try:
            if self._followed_path is None:
                for piece in iter(partial(self._file.read, _PIECE_BYTES), b""):
                    self._note_beginning(piece)
                    yield piece
            else:
                yield from self._followed_pieces(self._followed_path)
        finally:
            self._file.close()

    def _followed_pieces(self, path: Path) -> Iterator[bytes | Refused | None]:
        """Yield the pieces of the file and of files that get its name later, without end.

        None is yielded while nothing comes.
        """
        while True:
            if self._file.closed and not self._reopen(path):
                yield from self._switch_after_loss(path)
                continue
            piece = self._file.read(_PIECE_BYTES)
            # The file may have been truncated after it was read, even if it has grown again.
            is_same = is_same_beginning(self._file, self._beginning)
            if not is_same or os.fstat(self._file.fileno()).st_size < self._file.tell():
                yield from self._switch_to_copy(
                    path,
                    f"{path.name} was cut at byte {self.end}, and no copy is beside it: what "
                    "followed and was not read yet is lost",
                )
                continue
            if not piece:
                next_file = self._open_next(path)
                if next_file is not None:
                    # The writer may have added to the old file before it opened the new one
                    piece = self._file.read(_PIECE_BYTES)
                    if not piece:
                        yield from self._switch_to(next_file)
                        continue
                    next_file.close()
            self._note_beginning(piece)
            yield piece or None

    def close(self) -> None:
        """Close the file; no further line is read."""
        self._file.close()

    def release(self) -> None:
        """Close a followed file until its next piece is requested.

        So a process can follow more files than it may have open. A file that is renamed meanwhile
        is found again; one that is removed is not read any further.
        """
        if not self._file.closed:
            self._released_inode = os.fstat(self._file.fileno()).st_ino
            self._released_at = self._file.tell()
            self._file.close()

    def _reopen(self, path: Path) -> bool:
        """Open the released file again, even if it was renamed; return whether it still exists."""
        for name in (path, *reversed(rotated_files(path))):
            with suppress(FileNotFoundError), ExitStack() as closing:
                file = closing.enter_context(name.open("rb", buffering=0))
                if os.fstat(file.fileno()).st_ino == self._released_inode:
                    closing.pop_all()
                    file.seek(self._released_at)
                    self._file = file
                    self._was_missed = False
                    return True
        return False

    def _switch_after_loss(self, path: Path) -> Iterator[bytes | Refused | None]:
        """Continue in a copy of a released file that was removed, or in the file that replaced it.

        None is yielded while there is neither, and after the first attempt, in which the file may
        have been missed because it was just being renamed. If there is no copy, a refusal is
        yielded, and reading continues at the beginning of the new file.
        """
        was_missed_before = self._was_missed
        self._was_missed = True
        if not was_missed_before or not path.exists():
            yield None
            return
        self._was_missed = False
        yield from self._switch_to_copy(
            path,
            f"the file that was {path.name} before was removed when it was read to byte "
            f"{self.end}: what followed and was not read yet is lost",
        )

    def _note_beginning(self, piece: bytes) -> None:
        """Add a piece to the beginning that identifies the file, until it is long enough."""
        if len(self._beginning) < _PIECE_BYTES:
            self._beginning = (self._beginning + piece)[:_PIECE_BYTES]

    def _switch_to_copy(self, path: Path, reason_without_copy: str) -> Iterator[bytes | Refused]:
        """Continue in the copy of a file, as logrotate makes it with `copytruncate`.

        If there is no copy, the reason is yielded as a refusal, and reading continues at the
        beginning of the file that has the name now.
        """
        copy = find_file(path, self.position, follow=True)
        if copy is None:
            yield Refused(reason_without_copy)
        file = (copy or path).open("rb", buffering=0)
        yield from self._switch_to(file, is_copy=copy is not None)

    def _switch_to(self, file: BinaryIO, *, is_copy: bool = False) -> Iterator[bytes]:
        """Continue with another file.

        An incomplete line at the end of the former file continues in this one only if one is a copy
        of the other. Otherwise an empty piece ends the line.
        """
        line_goes_on = self._is_copy or is_copy
        position = self.position
        self._file.close()
        self._start_reading(file, position)
        self._is_copy = is_copy
        if not line_goes_on:
            yield b""

    def _open_next(self, path: Path) -> BinaryIO | None:
        """Return the next file under the name `path`, open for reading.

        None if this file still has the name, or if the next one is still empty.
        """
        with suppress(FileNotFoundError):  # in the middle of being renamed
            status = os.fstat(self._file.fileno())
            if os.path.samestat(status, path.stat()):
                return None
            inodes = _inodes_of_log(path)
            inodes_again = _inodes_of_log(path)
            next_path = _first_written_after(inodes, status.st_ino, path)
            if next_path is None:
                return None
            with ExitStack() as closing:
                file = closing.enter_context(next_path.open("rb", buffering=0))
                # A file renamed meanwhile would let another file be opened than the chosen one
                if inodes == inodes_again == _inodes_of_log(path):
                    closing.pop_all()
                    return file
        return None


def _inodes_of_log(path: Path) -> dict[Path, int]:
    """Return the inode of each rotated file of a log, oldest first, and of the log itself."""
    return {file: file.stat().st_ino for file in (*rotated_files(path), path)}


def _first_written_after(inodes: dict[Path, int], inode: int, path: Path) -> Path | None:
    """Return the first file of a log that is not empty and newer than the one with an inode.

    If no file has the inode, only the log itself is considered. `inodes` lists the files, oldest
    first.
    """
    later_files = [path]
    inodes_in_order = list(inodes.values())
    if inode in inodes_in_order:
        index = inodes_in_order.index(inode)
        later_files = list(inodes)[index + 1 :]
    for file in later_files:
        if file.stat().st_size > 0:
            return file
    return None
