"""A CSV file as a feed: its header, its rows, and what happens to both when it is rotated."""

import csv
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from reporting.formats.former_names import warn_of_former_names
from twin_master.errors import MissionInputError
from twin_master.feeds.feed import RecordedFeed
from twin_master.feeds.lines import Position, first_line, rotated_files
from twin_master.feeds.message import OTHER_KEYS, PRESENT_NAMES, MessageContent, Refused
from twin_master.scenario.schema import Scenario

_MISSING_VALUES = ("nan", "null", "none")
"""Cells of the columns that are not sensors which mean that there is no value."""


class CsvFeed(RecordedFeed):
    """A CSV file with a header: `step` or `time`, `control`, and sensors by their names.

    A file that takes the place of one that is followed has a header of its own, or the same
    columns.

    Parameters
    ----------
    path, scenario, follow
        As of `RecordedFeed`.

    Raises
    ------
    MissionInputError
        If the file cannot be read, or if a column is neither of these.
    """

    def __init__(self, path: Path, scenario: Scenario, *, follow: bool = False) -> None:
        super().__init__(path, scenario, follow=follow)
        self._set_columns(self._read_header())

    def _read_header(self) -> list[str]:
        """Return the names of the columns from the first line of the file.

        A file that was just created, or was rotated by copying and truncating, may begin with a row
        of readings. If the file is followed, the header is then taken from the newest rotated file
        that has one. A `MissionInputError` is raised if no file has a header.
        """
        files = [self.path]
        if self.follow:
            files += reversed(rotated_files(self.path))
        try:
            lines = [first_line(file) for file in files]
            whole_lines = [line for line in lines if line.endswith(b"\n")]
            # If no line is complete, the incomplete first line of the file itself is used
            rows = [_split_cells(line) for line in whole_lines or lines[:1]]
        except (OSError, ValueError) as error:
            reason = str(error).rstrip(".")
            raise MissionInputError(f"{self.path} cannot be read as CSV: {reason}.") from None
        for cells in rows:
            if not self._has_readings(cells):
                return cells
        hint = "which a rotated file beside it may have: that one is found with --follow"
        if self.follow:
            hint = "and no rotated file beside it has that line"
        raise MissionInputError(
            f"{self.path} begins with `{','.join(rows[0])[:60]}`, which is a row of readings: a "
            f"CSV file begins with a line of its columns, {hint}."
        )

    def _has_readings(self, cells: Sequence[str]) -> bool:
        """Return whether the cells of a row are readings, and not names of columns.

        They are if a cell is a number and not every cell is the name of a column.
        """
        if not any(map(_is_number, cells)):
            return False
        # Sensors may have numbers as names, so that numbers alone do not show readings
        try:
            names = [PRESENT_NAMES.get(cell, cell) for cell in cells]
            return not all(name in OTHER_KEYS or self.reader.find_column(name) for name in names)
        except Refused:  # a known name with a wrong unit
            return False

    def _set_columns(self, names: Sequence[str]) -> None:
        """Check the names of columns, and use them for the rows that follow.

        An error is raised if there are none, if one is not a column, or if two mean the same
        column.
        """
        if not any(names):
            raise MissionInputError(
                f"{self.path} is empty: a CSV file begins with a line of its columns."
            )
        former_names = {name: PRESENT_NAMES[name] for name in names if name in PRESENT_NAMES}
        if former_names:
            warn_of_former_names(str(self.path), former_names)
        columns = [PRESENT_NAMES.get(name, name) for name in names]
        try:
            sensors = self._sensors_of(columns)
        except Refused as refusal:
            raise MissionInputError(
                f"{self.path}: the columns cannot be read, {refusal}; others are `step`, `time` "
                "and `control`."
            ) from None
        occurrences = Counter(columns)
        has_double_column = any(occurrences[name] > 1 for name in OTHER_KEYS)
        if len(set(sensors)) < len(sensors) or has_double_column:
            raise MissionInputError(
                f"{self.path}: two columns stand for the same value, and only one of them is "
                f"allowed: {', '.join(names)[:300]}."
            )
        self._columns = columns

    def _sensors_of(self, columns: Sequence[str]) -> list[int]:
        """Return the indices of the sensors among columns.

        Raises
        ------
        Refused
            If a column is not a sensor, and such columns are not ignored.
        """
        sensors = []
        unknown_names = []
        for name in columns:
            if name in OTHER_KEYS or name.startswith("_"):
                continue
            column = self.reader.find_column(name)
            if column is None:
                unknown_names.append(name)
            else:
                sensors.append(column.sensor)
        has_known_column = len(unknown_names) < len(columns)
        is_allowed = self.reader.allows_unknown and has_known_column
        if unknown_names and not is_allowed:
            raise Refused(self.reader.describe_unknown(unknown_names, has_sensors=bool(sensors)))
        return sensors

    def open_file(self, position: Position | None) -> BinaryIO:
        """Open the file that contains a position, set the columns by its header, and return it."""
        file = super().open_file(position)
        self.content_of(first_line(Path(file.name)), 0)
        return file

    def content_of(self, line: bytes, begin: int) -> MessageContent | None:
        """Return the message in a row, or the reason why the row is refused.

        A header, which only the first line of a file can be, sets the columns; the result is then
        None.
        """
        try:
            cells = _split_cells(line)
        except ValueError as error:
            return Refused(f"it is not a line of CSV: {str(error)[:80]}")
        is_first_line = begin == 0
        if is_first_line and not self._has_readings(cells):
            with suppress(MissionInputError):
                self._set_columns(cells)
                return None
        if len(cells) != len(self._columns):
            return Refused(f"{len(self._columns)} cells are expected, but {len(cells)} were given")
        record: dict[str, object] = {}
        for name, cell in zip(self._columns, cells, strict=True):
            is_missing = name in OTHER_KEYS and cell.lower() in _MISSING_VALUES
            if cell and not is_missing:
                record[name] = cell
        return record


def _is_number(cell: str) -> bool:
    """Return whether a cell is a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _split_cells(line: bytes) -> list[str]:
    """Return the cells of a row, stripped of blanks.

    A `ValueError` is raised if the line is not a row of CSV, or not UTF-8.
    """
    text = line.decode("utf-8-sig").rstrip("\r\n")
    try:
        cells = next(csv.reader([text]), [])
    except csv.Error as error:
        raise ValueError(str(error)) from None
    return [cell.strip() for cell in cells]
