"""The one reader of tables: text with one row of cells in a line; errors name file, line and column.

A reader that guesses is worse than none: a decimal comma makes two cells of a number, and whoever takes the
first of them is wrong without a word. So every row has as many cells as the header, no column comes twice,
and a number is written with the digits 0 to 9 and a point.
"""

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import NamedTuple

import numpy as np

from reporting.arrays import Float
from reporting.sentences import said
from reporting.text_file import read_text
from reporting.words import counted


class TableErrors(NamedTuple):
    """What a reader raises: for a table that is laid out otherwise, and for values that none can have."""

    layout: type[Exception]
    value: type[Exception]


def plain_number(text: str) -> float:
    """Return the number of a text in the digits 0 to 9, or NaN or an infinity where it says so.

    Raises
    ------
    ValueError
        The text is no number, or one that `float` takes and no measuring programme writes: digits of another
        script, or underscores between them.
    """
    if not text.isascii() or "_" in text:
        raise ValueError(f"{text!r} is not written with the digits 0 to 9")
    return float(text)


@dataclass(frozen=True)
class TextTable:
    """A table of text.

    Attributes
    ----------
    name : str
        Name of the file, for error messages.
    columns : mapping of str to tuple of str
        Cells by column, stripped.
    lines : tuple of int
        Line of the file that each row stands in.
    errors : TableErrors
        What is raised.
    """

    name: str
    columns: Mapping[str, tuple[str, ...]]
    lines: tuple[int, ...]
    errors: TableErrors

    def __len__(self) -> int:
        return len(self.lines)

    def cells(self, column: str, needed_by: str) -> tuple[str, ...]:
        """Return the cells of a column.

        Raises
        ------
        errors.layout
            There is no such column; the sentence says what there is.
        """
        if column not in self.columns:
            lacks = said("table.no_column", table=self, column=column, needed_by=needed_by)
            raise self.errors.layout(lacks)
        return self.columns[column]

    def numbers(
        self, column: str, needed_by: str, *, empty_allowed: bool = False, positive: bool = False
    ) -> Float:
        """Return a column as numbers; NaN stands for an empty cell where it is allowed.

        Raises
        ------
        errors.layout
            There is no such column, or a cell is no number.
        errors.value
            A cell is NaN or infinite, or where they must be `positive` zero or less.
        """
        found = np.full(len(self), np.nan)
        remedy = "; leave the cell of a reading empty that is to be left out"
        for row, cell in enumerate(self.cells(column, needed_by)):
            if empty_allowed and not cell:
                continue
            try:
                found[row] = value = plain_number(cell)
            except ValueError:
                place, came = self._place(column, row), repr(cell) if cell else "nothing"
                raise self.errors.layout(said("table.no_number", place=place, came=came)) from None
            if not isfinite(value):
                advice = remedy if empty_allowed else ", and a finite number is needed"
                raise self.errors.value(f"{self._place(column, row)} holds {cell}{advice}.")
            if positive and value <= 0.0:
                place = self._place(column, row)
                raise self.errors.value(said("table.not_positive", place=place, cell=cell))
        return found

    def _place(self, column: str, row: int) -> str:
        return f"{self.name}, line {self.lines[row]}: column {column!r}"

    def refuse_repeated(self, keys: Sequence[object], what: str, remedy: str) -> None:
        """Refuse equal keys of two rows.

        Parameters
        ----------
        keys : sequence
            One for each row.
        what, remedy : str
            What the two rows share, and what to do, for the sentence of `errors.layout`.
        """
        first: dict[object, int] = {}
        for key, line in zip(keys, self.lines, strict=True):
            if first.setdefault(key, line) != line:
                of = {"name": self.name, "lines": (first[key], line)}
                raise self.errors.layout(said("table.repeated", **of, what=what, remedy=remedy))


def read_table(path: Path | str, errors: TableErrors, *, name: str | None = None) -> TextTable:
    """Read a table of comma-separated text.

    Parameters
    ----------
    path : Path or str
        The file; UTF-8, with or without a byte order mark.
    errors : TableErrors
        What is raised.
    name : str, optional
        What sentences about its content call it; the path if left out.

    Raises
    ------
    errors.layout
        The file cannot be read, is not UTF-8, has no header or rows, names a column twice, or a row has
        another number of cells than the header.
    """
    text = read_text(path, errors.layout)
    return parse_table(text, str(path) if name is None else name, errors)


def parse_table(
    text: str,
    name: str,
    errors: TableErrors,
    *,
    header: Sequence[str] | None = None,
    separator: str | None = ",",
) -> TextTable:
    """Return the table of a text, separated by commas or (None) by blanks; errors as `read_table`.

    `header` names the columns where the text has no line for them.
    """
    # Comments and blanks become empty lines, so that the reader's line numbers stay those of the file.
    kept = ["" if not line.strip() or line.lstrip().startswith("#") else line for line in text.splitlines()]
    if separator is None:
        found = [(number, line.split()) for number, line in enumerate(kept, start=1) if line.strip()]
    else:
        found = _separated(kept, separator, name, errors)
    if not found and header is None:
        raise errors.layout(f"{name} is empty: it needs a header line with the names of its columns.")
    columns = found.pop(0)[1] if header is None else [*header]
    if len(columns) == 1 and (";" in columns[0] or "\t" in columns[0]):
        raise errors.layout(said("table.separated", name=name))
    twice = sorted(column for column, count in Counter(columns).items() if count > 1)
    if twice:
        raise errors.layout(f"{name} has more than one column {twice[0]!r}: rename or remove one.")
    if not found:
        raise errors.layout(f"{name} has {'a header line but ' if header is None else ''}no rows.")
    for line, row in found:
        if len(row) != len(columns):
            comma = separator and len(row) > len(columns) and all(map(is_number, row))
            came, wanted = counted(len(row), "cell"), counted(len(columns), "column")
            listed = f"{wanted} ({', '.join(columns)}) are expected"
            of = {"came": came, "expected": f"the header has {wanted}" if header is None else listed}
            of |= {"name": name, "line": str(line)}
            raise errors.layout(said("table.decimal_comma" if comma else "table.width", **of))
    cells = tuple(zip(*(row for _, row in found), strict=True))
    return TextTable(name, dict(zip(columns, cells, strict=True)), tuple(line for line, _ in found), errors)


def is_number(cell: str) -> bool:
    """Return whether a text is a number, see `plain_number`."""
    try:
        plain_number(cell)
    except ValueError:
        return False
    return True


def _separated(
    kept: Sequence[str], separator: str, name: str, errors: TableErrors
) -> list[tuple[int, list[str]]]:
    reader = csv.reader(io.StringIO("\n".join(kept)), delimiter=separator, skipinitialspace=True)
    found = []
    try:
        for row in reader:
            if row:
                found.append((reader.line_num, [cell.strip() for cell in row]))
    except csv.Error as cause:
        raise errors.layout(f"{name}, line {reader.line_num}: not comma-separated text ({cause}).") from cause
    return found


def table_text(columns: Mapping[str, Sequence[str] | Float]) -> str:
    """Return the text of a table, which `parse_table` reads back; a number that is none is an empty cell."""
    cells = (
        ["" if value != value else repr(value) for value in column.tolist()]
        if isinstance(column, np.ndarray)
        else column
        for column in columns.values()
    )
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*cells, strict=True))
    return stream.getvalue()
