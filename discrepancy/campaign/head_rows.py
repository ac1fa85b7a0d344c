"""The rows of names and of units above a laboratory's table."""

import re
from collections.abc import Sequence
from itertools import zip_longest
from typing import NamedTuple

from discrepancy.campaign.cells import is_value
from discrepancy.campaign.heads import is_clock_format, unit_beside

Rows = list[tuple[int, list[str]]]
"""Rows of a file that are not empty: the number of the line or row, and the cells."""
NO_READINGS = {"RN": "counts the records", "TS": "holds times beside TIMESTAMP"}
"""What a column contains instead of readings, by the unit that Campbell's loggers state for it."""
_CAMPBELL = "TOA5"
"""First cell of a file of Campbell's loggers.

Its four head rows are the logger, the names, the units, and what is stored (`Smp`, `Avg`).
"""
_CAMPBELL_NAMES_LINE = 2
_CAMPBELL_UNITS_LINE = 3
_IN_BRACKETS = re.compile(r"\[.*\]|\(.*\)", re.DOTALL)


class HeadRows(NamedTuple):
    """The names (C,) and units (C,) of the columns of a table; a unit is empty if not known."""

    names: list[str]
    units: list[str]


def find_head_rows(rows: Rows, first_row: int) -> HeadRows:
    """Return the names and units of the columns, from the rows above the first numbers.

    The row just above the numbers holds the units if each of its filled cells is a unit, a clock
    format or a text in brackets, and if the row above it has at least as many filled cells, which
    are then the names. Otherwise it holds the names, and there are no units. In files of Campbell's
    loggers, names and units have fixed lines.

    Parameters
    ----------
    rows : list of (int, list of str)
        The rows of the file: the number of the line, and its cells.
    first_row : int
        The index of the first row of numbers.
    """
    cells_of_lines = dict(rows[:first_row])
    if rows[0][1][0] == _CAMPBELL and _CAMPBELL_NAMES_LINE in cells_of_lines:
        names = cells_of_lines[_CAMPBELL_NAMES_LINE]
        return _campbell_names_with_units(names, cells_of_lines.get(_CAMPBELL_UNITS_LINE, []))
    row_above = rows[first_row - 1][1]
    if first_row > 1:
        row_above_names = rows[first_row - 3][1] if first_row > 2 else []
        names = _fill_names_of_merged_cells(rows[first_row - 2][1], row_above_names, row_above)
        has_names = sum(map(bool, names)) >= sum(map(bool, row_above))
        if has_names and _are_units(names, row_above):
            return _names_with_units(names, row_above)
    return _names_with_units(row_above, [])


def _fill_names_of_merged_cells(
    names: Sequence[str], row_above_names: Sequence[str], units: Sequence[str]
) -> list[str]:
    """Return a row of names in which each column with a unit but no name gets a name.

    Such a column is part of a merged cell, whose text is stored in the cell above if it was merged
    downwards, or else in the column to the left. A row is not filled, because it is no row of names
    but a title, if its first cell is empty, or if it has a number or fewer than two texts.
    """
    texts = [cell for cell in names if cell]
    if len(texts) < 2 or not names[0] or any(map(is_value, texts)):
        return [*names]
    filled_names: list[str] = []
    for name, name_above, unit in zip_longest(names, row_above_names, units, fillvalue=""):
        if unit and not name:
            filled_names.append(name_above or filled_names[-1])
        else:
            filled_names.append(name)
    return filled_names


def _are_units(names: Sequence[str], cells: Sequence[str]) -> bool:
    """Return whether each filled cell below names is a unit, a clock format or in brackets."""
    for name, cell in zip_longest(names, cells, fillvalue=""):
        is_unit = bool(unit_beside(name, cell)) or is_clock_format(cell)
        if cell and not is_unit and not _IN_BRACKETS.fullmatch(cell):
            return False
    return True


def _names_with_units(names: list[str], cells: Sequence[str]) -> HeadRows:
    """Return names with the units in the cells below them; a cell that is no unit is ignored."""
    units = []
    for name, cell in zip_longest(names, cells, fillvalue=""):
        units.append(unit_beside(name, cell))
    return HeadRows(names, units[: len(names)])


def _campbell_names_with_units(names: list[str], cells: Sequence[str]) -> HeadRows:
    """Return the names and units of a file of Campbell's loggers.

    The unit of a column without readings stays as the key of `NO_READINGS` that the file states,
    except that `TIMESTAMP` gets none, since it is the clock of the table.
    """
    units = _names_with_units(names, cells).units
    for index, (name, cell) in enumerate(zip(names, cells, strict=False)):
        if cell in NO_READINGS:
            units[index] = "" if name == "TIMESTAMP" else cell
    return HeadRows(names, units)
