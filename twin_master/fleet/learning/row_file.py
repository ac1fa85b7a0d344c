"""Rows of numbers in a temporary file, which is read block by block as often as needed."""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryFile
from types import TracebackType
from typing import Self

import numpy as np

from reporting.arrays import Float
from reporting.files import explained_write_errors


class RowFile:
    """A temporary file of rows, which exists as long as its context is open.

    To iterate over it yields blocks of rows, (B, E) arrays, from the first row on.

    Parameters
    ----------
    folder : Path
        The folder of the file, which also vanishes if the process is killed.
    width : int
        The number E of values of a row.
    rows_together : int
        The largest number B of rows of a block.
    """

    def __init__(self, folder: Path, width: int, rows_together: int) -> None:
        self._folder = folder
        self._width = width
        self._rows_together = rows_together

    def __enter__(self) -> Self:
        """Open the file; raise `FileNotWrittenError` if the folder cannot be written."""
        with explained_write_errors(self._folder):
            self._file = TemporaryFile(dir=self._folder)
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        """Close the file, which removes it."""
        self._file.close()

    def append(self, rows: Float) -> None:
        """Append rows (B, E).

        Raises
        ------
        FileNotWrittenError
            If the disk is full.
        """
        with explained_write_errors(self._folder):
            self._file.seek(0, 2)  # the end of the file
            self._file.write(np.ascontiguousarray(rows, dtype=np.float64).tobytes())

    def __iter__(self) -> Iterator[Float]:
        """Yield all rows, block by block."""
        block_bytes = self._rows_together * self._width * np.dtype(np.float64).itemsize
        position = 0
        while True:
            self._file.seek(position)
            content = self._file.read(block_bytes)
            if not content:
                return
            position += len(content)
            yield np.frombuffer(content).reshape(-1, self._width)
