"""A file of a fleet's store: chunks in the sharding codec of zarr 3, appended while twins fly."""

import os
from pathlib import Path

import numpy as np

from reporting.arrays import Unsigned
from reporting.files import atomic_file, atomic_write_bytes, remove_leftovers
from reporting.system.operating_system import open_descriptor
from twin_master.errors import FleetError

CHUNKS_PER_FILE = 128
"""Largest number of chunks of a file.

The index of a file then has 2 kB: it lies in one page of memory, so that a kill cannot leave a half
of it.
"""
_NO_CHUNK = np.iinfo(np.uint64).max
"""Position and length of a chunk that the file does not have."""
_CHECKSUM_BYTES = 4
"""Length of the CRC32C checksum behind the index."""


class ChunkFile:
    """A file with up to N chunks.

    Parameters
    ----------
    path : Path
        The path of the file, which need not exist.
    """

    def __init__(self, path: Path, chunk_count: int) -> None:
        self.path = path
        self._chunk_count = chunk_count

    def read(self, number: int) -> bytes | None:
        """Return the content of a chunk; None if the file does not have it.

        Raises
        ------
        FleetError
            If the index of the file is damaged.
        """
        position, length = self._index()[number].tolist()
        if position == _NO_CHUNK:
            return None
        with self.path.open("rb") as file:
            file.seek(position)
            return file.read(length)

    def write(self, number: int, content: bytes | None) -> None:
        """Append the content of a chunk, which replaces its former content.

        Parameters
        ----------
        content : bytes or None
            The encoded content; None if no twin of the chunk has flown, which the file leaves out.

        Raises
        ------
        FleetError
            If the index of the file is damaged.
        OSError
            If the file cannot be written.
        """
        index = self._index()
        if not self.path.is_file():
            if content is None:
                return
            atomic_write_bytes(self.path, _encoded_index(index))
        descriptor = open_descriptor(self.path, os.O_RDWR)
        try:
            if content is None:
                index[number] = _NO_CHUNK
            else:
                position = os.lseek(descriptor, 0, os.SEEK_END)
                index[number] = position, len(content)
                _write_all(descriptor, content)
            # Readers find the new chunk from here on; until now they found its former content.
            os.lseek(descriptor, 0, os.SEEK_SET)
            _write_all(descriptor, _encoded_index(index))
        finally:
            os.close(descriptor)

    def finish(self) -> None:
        """Reorder the chunks without gaps; remove the file if it has none.

        A file that is finished already, or that does not exist, stays as it is.

        Raises
        ------
        FleetError
            If the index of the file is damaged.
        FileNotWrittenError
            If the disk is full or the folder cannot be written.
        """
        if not self.path.is_file():
            return
        remove_leftovers(self.path.parent)  # of a process that was killed here
        index = self._index()
        has_chunk = index[:, 0] != _NO_CHUNK
        if not has_chunk.any():
            self.path.unlink()
            return
        lengths = index[has_chunk, 1]
        ordered_index = index.copy()  # of a file with the same chunks in order and without gaps
        ordered_index[has_chunk, 0] = self._index_size + np.cumsum(lengths) - lengths
        size = self._index_size + int(lengths.sum())
        if np.array_equal(index, ordered_index) and self.path.stat().st_size == size:
            return
        with atomic_file(self.path) as temporary, temporary.open("wb") as target:
            target.write(_encoded_index(ordered_index))
            with self.path.open("rb") as source:
                for position, length in index[has_chunk].tolist():
                    source.seek(position)
                    target.write(source.read(length))

    @property
    def _index_size(self) -> int:
        """The size of the index with its checksum, in bytes."""
        return self._empty_index().nbytes + _CHECKSUM_BYTES

    def _empty_index(self) -> Unsigned:
        """Return the index of a file without chunks, an (N, 2) array."""
        return np.full((self._chunk_count, 2), _NO_CHUNK, dtype="<u8")

    def _index(self) -> Unsigned:
        """Return positions and lengths of all chunks in bytes, an (N, 2) array."""
        if not self.path.is_file():
            return self._empty_index()
        with self.path.open("rb") as file:
            encoded_index = file.read(self._index_size)
        numbers = encoded_index[:-_CHECKSUM_BYTES]
        if len(encoded_index) != self._index_size or encoded_index != numbers + _checksum(numbers):
            raise FleetError(
                f"the index of {self.path} is damaged: fly the fleet again with --replace."
            )
        return np.frombuffer(numbers, dtype="<u8").reshape(-1, 2).copy()


def _encoded_index(index: Unsigned) -> bytes:
    """Return an index with its checksum as the bytes at the beginning of a file."""
    numbers = index.tobytes()
    return numbers + _checksum(numbers)


def _checksum(content: bytes) -> bytes:
    """Return the CRC32C checksum of some bytes, little-endian."""
    import google_crc32c

    return int(google_crc32c.value(content)).to_bytes(_CHECKSUM_BYTES, "little")


def _write_all(descriptor: int, content: bytes) -> None:
    """Write bytes to an open file; the operating system may take less than all at once."""
    remaining = memoryview(content)
    while remaining:
        remaining = remaining[os.write(descriptor, remaining) :]
