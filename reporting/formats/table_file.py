"""The one reader of tables: text with one row of cells in a line.

Errors name the file, the line and the column.

A reader must not guess: a decimal comma makes two cells of a number, and a reader that takes the
first of them gives wrong numbers without a warning. So every row has as many cells as the header,
every column has its own name, and numbers are written with the digits 0 to 9 and a point.
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
from reporting.text_file import read_text
from reporting.words import comma_list, counted


class TableErrors(NamedTuple):
    """The exceptions of a reader: for the layout of a table, and for impossible values."""

    layout: type[Exception]
    value: type[Exception]


def plain_number(text: str) -> float:
    """Return the number in a text that is written with the digits 0 to 9, or is NaN or infinite.

    Raises
    ------
    ValueError
        If the text is not a number. That includes forms that `float` accepts but measuring software
        never writes: digits of another script, and underscores between digits.
    """
    if not text.isascii() or "_" in text:
        raise ValueError(f"{text!r} is not written with the digits 0 to 9")
    return float(text)


def is_number(cell: str) -> bool:
    """Return whether a text is a number, see `plain_number`."""
    try:
        plain_number(cell)
    except ValueError:
        return False
    return True


@dataclass(frozen=True)
class TextTable:
    """A table whose cells are texts, as read from a file.

    Attributes
    ----------
    name : str
        The name of the file, for messages.
    columns : mapping of str to tuple of str
        The cells of each column, without blanks around them.
    lines : tuple of int
        The number of the line in the file, for each row.
    """

    name: str
    columns: Mapping[str, tuple[str, ...]]
    lines: tuple[int, ...]
    errors: TableErrors

    def __len__(self) -> int:
        return len(self.lines)

    def cells(self, column: str, needed_by: str) -> tuple[str, ...]:
        """Return the cells of a column.

        Parameters
        ----------
        needed_by : str
            What needs the column, for the message.

        Raises
        ------
        errors.layout
            If the table lacks the column; the message lists its columns.
        """
        if column not in self.columns:
            raise self.errors.layout(
                f"{self.name} has no column {column!r}, which {needed_by} needs; "
                f"its columns are {comma_list(self.columns)}."
            )
        return self.columns[column]

    def numbers(
        self, column: str, needed_by: str, *, empty_allowed: bool = False, positive: bool = False
    ) -> Float:
        """Return a column as numbers.

        Parameters
        ----------
        needed_by : str
            What needs the column, for the message.
        empty_allowed : bool
            Whether cells may be empty; they become NaN.
        positive : bool
            Whether numbers must be positive.

        Raises
        ------
        errors.layout
            If the table lacks the column, or a cell is not a number.
        errors.value
            If a number is NaN or infinite, or must be positive and is not.
        """
        values = np.full(len(self), np.nan)
        for row, cell in enumerate(self.cells(column, needed_by)):
            if empty_allowed and not cell:
                continue
            try:
                value = plain_number(cell)
            except ValueError:
                content = repr(cell) if cell else "nothing"
                raise self.errors.layout(
                    f"{self._location(column, row)} must hold a number, but {content} was given."
                ) from None
            self._check_value(value, column, row, empty_allowed=empty_allowed, positive=positive)
            values[row] = value
        return values

    def _check_value(
        self, value: float, column: str, row: int, *, empty_allowed: bool, positive: bool
    ) -> None:
        """Refuse a number that is not finite, or not positive if it must be."""
        if not isfinite(value):
            if empty_allowed:
                advice = "; leave the cell of a reading empty that is to be left out"
            else:
                advice = ", and a finite number is needed"
            raise self.errors.value(
                f"{self._location(column, row)} holds {self.columns[column][row]}{advice}."
            )
        if positive and value <= 0.0:
            raise self.errors.value(
                f"{self._location(column, row)} holds {self.columns[column][row]}, "
                "and a positive number is needed; leave out readings of zero."
            )

    def _location(self, column: str, row: int) -> str:
        """Return the name of a cell for messages: file, line and column."""
        return f"{self.name}, line {self.lines[row]}: column {column!r}"

    def refuse_repeated(self, keys: Sequence[object], what: str, remedy: str) -> None:
        """Refuse a table in which two rows have the same key.

        Parameters
        ----------
        keys : sequence
            The key of each row.
        what, remedy : str
            What the key is, and how to mend the file, for the message.

        Raises
        ------
        errors.layout
            If two rows have the same key.
        """
        line_of_key: dict[object, int] = {}
        for key, line in zip(keys, self.lines, strict=True):
            first_line = line_of_key.setdefault(key, line)
            if first_line != line:
                raise self.errors.layout(
                    f"{self.name}: the lines {first_line} and {line} hold the same {what}; "
                    f"{remedy}."
                )


class _Row(NamedTuple):
    """The cells of a row, and its line in the file."""

    line: int
    cells: list[str]


def read_table(path: Path | str, errors: TableErrors, *, name: str | None = None) -> TextTable:
    """Return the table in a file of comma-separated text.

    Parameters
    ----------
    path : Path or str
        The file; UTF-8, with or without a byte order mark.
    name : str, optional
        The name of the table in messages; the path by default.

    Raises
    ------
    errors.layout
        If the file cannot be read, is not UTF-8, has no header or no rows, repeats the name of a
        column, or has a row whose number of cells is not that of the header.
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
    """Return the table in a text of lines and cells.

    Parameters
    ----------
    text : str
        The lines of the table; empty lines and lines that begin with # are skipped.
    name : str
        The name of the table in messages.
    errors : TableErrors
        The exceptions to raise, for the reasons of `read_table`.
    header : sequence of str, optional
        The names of the columns, if the text has no header line.
    separator : str or None
        The character between cells; None for blanks.
    """
    rows = _parse_rows(text, separator, name, errors)
    if header is not None:
        columns = list(header)
    elif rows:
        columns = rows.pop(0).cells
    else:
        raise errors.layout(
            f"{name} is empty: it needs a header line with the names of its columns."
        )
    _check_columns(columns, name, errors)
    if not rows:
        header_phrase = "a header line but " if header is None else ""
        raise errors.layout(f"{name} has {header_phrase}no rows.")
    for row in rows:
        if len(row.cells) != len(columns):
            has_commas = bool(separator)
            message = _width_message(row, columns, has_header=header is None, has_commas=has_commas)
            raise errors.layout(f"{name}, line {row.line}: {message}")
    cells_by_column = zip(*(row.cells for row in rows), strict=True)
    return TextTable(
        name=name,
        columns=dict(zip(columns, cells_by_column, strict=True)),
        lines=tuple(row.line for row in rows),
        errors=errors,
    )


def _parse_rows(text: str, separator: str | None, name: str, errors: TableErrors) -> list[_Row]:
    """Return the rows of a text, including its header line."""
    # Comments are replaced by empty lines, so that line numbers remain those of the file.
    lines = []
    for line in text.splitlines():
        is_comment = line.lstrip().startswith("#")
        lines.append("" if is_comment or not line.strip() else line)
    if separator is not None:
        return _parse_separated_rows(lines, separator, name, errors)
    return [_Row(number, line.split()) for number, line in enumerate(lines, start=1) if line]


def _parse_separated_rows(
    lines: Sequence[str], separator: str, name: str, errors: TableErrors
) -> list[_Row]:
    """Split lines at a separator outside quotes, and return the rows of cells."""
    stream = io.StringIO("\n".join(lines))
    reader = csv.reader(stream, delimiter=separator, skipinitialspace=True)
    rows = []
    try:
        for cells in reader:
            if cells:
                rows.append(_Row(reader.line_num, [cell.strip() for cell in cells]))
    except csv.Error as cause:
        raise errors.layout(
            f"{name}, line {reader.line_num}: not comma-separated text ({cause})."
        ) from cause
    return rows


def _check_columns(columns: Sequence[str], name: str, errors: TableErrors) -> None:
    """Refuse a table with another separator, or with two columns of the same name."""
    if len(columns) == 1 and (";" in columns[0] or "\t" in columns[0]):
        raise errors.layout(
            f"{name} is not separated by commas: "
            "write it with commas between cells and points in numbers."
        )
    repeated = sorted(column for column, count in Counter(columns).items() if count > 1)
    if repeated:
        raise errors.layout(
            f"{name} has more than one column {repeated[0]!r}: rename or remove one."
        )


def _width_message(row: _Row, columns: Sequence[str], *, has_header: bool, has_commas: bool) -> str:
    """Return the message about a row that has not one cell for each column."""
    cells = counted(len(row.cells), "cell")
    wanted_columns = counted(len(columns), "column")
    if has_header:
        message = f"the row has {cells}, but the header has {wanted_columns}."
    else:
        message = f"the row has {cells}, but {wanted_columns} ({', '.join(columns)}) are expected."
    has_more_cells = len(row.cells) > len(columns)
    if has_commas and has_more_cells and all(is_number(cell) for cell in row.cells):
        message += " A decimal comma makes two cells of a number: write it with a point."
    return message


def table_text(columns: Mapping[str, Sequence[str] | Float]) -> str:
    """Return a table as text, which `parse_table` reads back.

    Parameters
    ----------
    columns : mapping of str to sequence of str or array
        The cells or numbers of each column; NaN becomes an empty cell.
    """
    cells_by_column: list[Sequence[str]] = []
    for column in columns.values():
        if isinstance(column, np.ndarray):
            # NaN alone is not equal to itself.
            cells = ["" if value != value else repr(value) for value in column.tolist()]
            cells_by_column.append(cells)
        else:
            cells_by_column.append(column)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*cells_by_column, strict=True))
    return stream.getvalue()
