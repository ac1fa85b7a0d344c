"""Tables of a campaign: comma-separated text with one header line; errors name file, line and column."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from discrepancy.errors import CampaignDataError, CampaignFileError
from reporting.words import counted

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Table:
    """A table of text.

    Attributes
    ----------
    name : str
        Name of the file in the campaign's folder, for error messages.
    columns : mapping of str to tuple of str
        Cells by column, stripped.
    lines : tuple of int
        Line of the file that each row stands in.
    """

    name: str
    columns: Mapping[str, tuple[str, ...]]
    lines: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.lines)

    def cells(self, column: str, needed_by: str) -> tuple[str, ...]:
        """Return the cells of a column.

        Raises
        ------
        CampaignFileError
            There is no such column; the sentence says what there is.
        """
        if column not in self.columns:
            raise CampaignFileError(
                f"{self.name} has no column {column!r}, which {needed_by} needs; its columns are "
                f"{', '.join(self.columns)}."
            )
        return self.columns[column]

    def numbers(
        self,
        column: str,
        needed_by: str,
        convert: Callable[[str], float] = float,
        *,
        empty_allowed: bool = False,
    ) -> FloatArray:
        """Return a column as numbers; NaN stands for an empty cell where it is allowed.

        Raises
        ------
        CampaignFileError
            There is no such column, or a cell is no number.
        CampaignDataError
            A cell is NaN or infinite.
        """
        values = np.empty(len(self))
        for index, cell in enumerate(self.cells(column, needed_by)):
            if not cell and empty_allowed:
                values[index] = np.nan
                continue
            where = f"{self.name}, line {self.lines[index]}: column {column!r}"
            try:
                plain = float(cell)
                value = convert(cell) if isfinite(plain) else plain
            except (ValueError, ArithmeticError):
                raise CampaignFileError(
                    f"{where} must hold a number, and {repr(cell) if cell else 'nothing'} came."
                ) from None
            if not isfinite(value):
                raise CampaignDataError(
                    f"{where} holds {cell}; leave the cell of a reading empty that is to be left out."
                )
            values[index] = value
        return values


def read_table(folder: Path, name: str) -> Table:
    """Read a table of a campaign's folder.

    Raises
    ------
    CampaignFileError
        The file is missing, is not UTF-8, has no header or rows, names a column twice, or a row has another
        number of cells than the header.
    """
    path = folder / name
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        there = sorted(item.name for item in folder.glob("*.csv"))
        raise CampaignFileError(
            f"There is no file {name} in {folder}; the tables there are {', '.join(there) or 'none'}."
        ) from None
    except UnicodeDecodeError as cause:
        raise CampaignFileError(f"{path} is not text in UTF-8 ({cause.reason}): save it as UTF-8.") from cause
    except OSError as cause:
        raise CampaignFileError(f"{path} cannot be read: {cause.strerror or cause}.") from cause
    if "\0" in text:
        raise CampaignFileError(f"{path} is not text: it holds a zero byte; save it as CSV in UTF-8.")
    return parse_table(text, name)


def parse_table(text: str, name: str) -> Table:
    """Return the table of a text; errors as `read_table`."""
    # Comment lines become empty ones, so that the reader's line numbers stay those of the file.
    kept = ["" if line.lstrip().startswith("#") else line for line in text.splitlines()]
    reader = csv.reader(io.StringIO("\n".join(kept)), skipinitialspace=True)
    rows: list[list[str]] = []
    lines: list[int] = []
    try:
        for row in reader:
            if row:
                rows.append([cell.strip() for cell in row])
                lines.append(reader.line_num)
    except csv.Error as cause:
        raise CampaignFileError(
            f"{name}, line {reader.line_num}: not comma-separated text ({cause})."
        ) from cause
    if not rows:
        raise CampaignFileError(f"{name} is empty: it needs a header line with the names of its columns.")
    header = rows[0]
    if len(header) == 1 and (";" in header[0] or "\t" in header[0]):
        raise CampaignFileError(
            f"{name} is not separated by commas: write it with commas between cells and points in numbers."
        )
    twice = sorted({column for column in header if header.count(column) > 1})
    if twice:
        raise CampaignFileError(f"{name} has more than one column {twice[0]!r}: rename or remove one.")
    if len(rows) == 1:
        raise CampaignFileError(f"{name} has a header line but no rows.")
    for row, line in zip(rows[1:], lines[1:], strict=True):
        if len(row) != len(header):
            raise CampaignFileError(
                f"{name}, line {line}: {counted(len(row), 'cell')} came, and the header has "
                f"{counted(len(header), 'column')}."
            )
    cells = tuple(zip(*rows[1:], strict=True))
    return Table(name, dict(zip(header, cells, strict=True)), tuple(lines[1:]))


def table_text(header: Sequence[str], columns: Sequence[Sequence[str]], comment: str = "") -> str:
    """Return the text of a table, which `parse_table` reads back."""
    stream = io.StringIO()
    if comment:
        stream.write(f"# {comment}\n")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(zip(*columns, strict=True))
    return stream.getvalue()
