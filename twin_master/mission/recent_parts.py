"""The large parts of the last lines of a journal, in two files that are overwritten in turn.

What was learnt, the suspicion of each sensor and the states from which a run or watch resumes are
ten times as long as the rest of a line, and are soon not needed any more. So the journal contains
them only now and then (`is_whole_step`), and the files `recent_0.jsonl` and `recent_1.jsonl`
contain them for at least the last `BLOCK_STEPS` steps.

A line of these files is a hash, a blank and a JSON object, as in the journal. Its key `line` is the
hash of the journal's line that it belongs to. It is written before that line. So after a kill each
line of the journal has its parts, and parts without a line are ignored. The files are not flushed
to the disk: after a loss of power, or without them, a run is resumed from the last whole line of
its journal, with the same result.
"""

import json
import re
from collections.abc import Mapping
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

from reporting.files import write_at
from reporting.json_file import JsonObject

RECENT_NAMES = ("recent_0.jsonl", "recent_1.jsonl")
BLOCK_STEPS = 64
"""Number of successive steps whose parts are in one file."""
_EARLY_STEPS = (1, 4, 16)
HASH_LENGTH = 64
"""Characters of a SHA-256 hash in hexadecimal digits."""
_NAME_OF_LINE = re.compile(rb'"line":"([0-9a-f]{64})"')
_ENCODER = json.JSONEncoder(sort_keys=True, allow_nan=False, separators=(",", ":"))


def is_whole_step(step: int) -> bool:
    """Return whether the journal's line of a step contains the learnt quantities.

    That is every `BLOCK_STEPS`-th step, and the steps of `_EARLY_STEPS`, as much is learnt at
    first.
    """
    return step % BLOCK_STEPS == 0 or step in _EARLY_STEPS


def encode_line(record: Mapping[str, object]) -> bytes:
    """Return a record as a line of JSON after its hash and a blank, with a line feed."""
    text = _ENCODER.encode(record).encode("ascii")
    return sha256(text).hexdigest().encode("ascii") + b" " + text + b"\n"


def decode_line(line: bytes) -> JsonObject | None:
    """Return the record of a line, with or without its line feed; None if its hash is wrong."""
    text = line[HASH_LENGTH + 1 :].rstrip(b"\n")
    if sha256(text).hexdigest().encode("ascii") != line[:HASH_LENGTH]:
        return None
    record = json.loads(text)
    return record if isinstance(record, dict) else None


def _size_to_keep(path: Path, step: int, line_hash: bytes) -> int:
    """Return how many bytes of a file of parts belong to lines before the one to be written.

    The parts after them are cut off: they are left from a process that was killed before it wrote
    their lines, or their lines were dropped.
    """
    size = 0
    with suppress(FileNotFoundError), path.open("rb") as file:
        for line in file:
            parts = decode_line(line)
            is_complete = line.endswith(b"\n")
            if parts is None or not is_complete:
                break
            if parts["step"] // BLOCK_STEPS != step // BLOCK_STEPS:
                break
            if parts["step"] > step or parts["line"] == line_hash.decode("ascii"):
                break
            size += len(line)
    return size


class RecentParts:
    """The large parts of the last lines of a journal, for readers.

    Parameters
    ----------
    folder : Path
        The run folder. The files need not exist.
    """

    def __init__(self, folder: Path) -> None:
        self._paths = [folder / name for name in RECENT_NAMES]
        self._entries: list[dict[bytes, bytes]]  # of each file, by the lines of the journal
        self._versions: list[tuple[int, int, int] | None]  # inode, size and time of change
        self._forget_files()

    def parts_of(self, line_hash: bytes) -> JsonObject:
        """Return the parts that a line of the journal left out; empty if the files lack them.

        Parameters
        ----------
        line_hash : bytes
            The hash of the line, in hexadecimal digits.
        """
        for index, path in enumerate(self._paths):
            if line_hash not in self._entries[index]:
                self._read_if_changed(index, path)
            parts = decode_line(self._entries[index].get(line_hash, b""))
            if parts is not None:
                del parts["line"], parts["step"]
                return parts
        return {}

    def _forget_files(self) -> None:
        """Forget the files, so that they take no memory until they are read again."""
        self._entries = [{}, {}]
        self._versions = [None, None]

    def _read_if_changed(self, index: int, path: Path) -> None:
        """Read a file, if it has changed since it was read.

        Its lines are kept by the hashes of the lines of the journal that they name. They are
        checked when they are used.
        """
        status = None
        with suppress(FileNotFoundError):
            status = path.stat()
        version = None if status is None else (status.st_ino, status.st_size, status.st_mtime_ns)
        if version == self._versions[index]:
            return
        self._versions[index] = version
        self._entries[index] = {}
        with suppress(FileNotFoundError), path.open("rb") as file:
            for line in file:
                name = _NAME_OF_LINE.search(line)
                if name is not None:
                    self._entries[index][name.group(1)] = line


class RecentPartsFile(RecentParts):
    """The large parts of the last lines of a journal, for the process that writes the journal."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._newest: tuple[bytes, JsonObject] = (b"", {})
        self._block: int | None = None
        self._size = 0

    def append(self, step: int, line_hash: bytes, parts: JsonObject) -> None:
        """Write the parts of a line; once this returns, they survive if the process is killed.

        Parameters
        ----------
        line_hash : bytes
            The hash of the line, in hexadecimal digits.

        Raises
        ------
        OSError
            If the disk is full or the folder cannot be written; the earlier parts are still there.
        """
        block = step // BLOCK_STEPS
        path = self._paths[block % len(self._paths)]
        entry = encode_line({**parts, "line": line_hash.decode("ascii"), "step": step})
        if block != self._block:
            self._size = 0 if self._block is not None else _size_to_keep(path, step, line_hash)
            with path.open("ab") as file:
                file.truncate(self._size)
        write_at(path, entry, self._size)
        self._size += len(entry)
        self._block = block
        self._newest = (line_hash, parts)
        self._forget_files()

    def pass_over(self, line_hash: bytes) -> None:
        """Set the newest line of the journal to one that has no parts."""
        self._newest = (line_hash, {})

    def size_before(self, step: int) -> int:
        """Return the size, in bytes, of the file to which the parts of a step are appended."""
        return self._size if step // BLOCK_STEPS == self._block else 0

    def parts_of(self, line_hash: bytes) -> JsonObject:
        """Return the parts of a line, without reading the disk for the newest one."""
        newest_hash, parts = self._newest
        return dict(parts) if line_hash == newest_hash else super().parts_of(line_hash)
