"""Readings that no other reading of their column supports, and the fill values among them."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray
from reporting.words import is_or_are, listing

LEAST_LOST_VALUE = 1e30
"""Numbers from here on stand for no reading, as 9.9E+37 of instruments does."""
SUPPORTED_DISTANCE = 10.0
"""Largest distance from the median of a supported reading, over that of all other readings."""
_MOST_WILD_VALUES = 2
"""Most wild values of a column; more are an event, such as an impact."""
_LEAST_SUPPORTED_VALUES = 3
"""Fewest different values that show the range of a column."""
_FILL_VALUE = re.compile(r"-?(?:9{3,6}|[678]999|3276[78])(?:\.0*)?", re.ASCII)
"""What loggers write for no reading: -9999, 99999, 7999 and the ends of 16 bits."""
_MOST_LISTED_LINES = 5
"""Most lines of wild readings that a remark lists."""


class CleanedColumn(NamedTuple):
    """A column without its fill values.

    Attributes
    ----------
    cells : tuple of str
        The cells (N,), empty where they held a fill value.
    fill_values : list of str
        A clause on each of these, such as "-9999 in line 4 of 'w' is a fill value".
    unsupported : list of str
        A clause on each reading that no other supports, and that is kept.
    """

    cells: tuple[str, ...]
    fill_values: list[str]
    unsupported: list[str]


def without_fill_values(
    cells: Sequence[str],
    numbers: Sequence[str],
    lines: Sequence[int],
    column: str,
    unit_of_place: str,
) -> CleanedColumn:
    """Return a column with empty cells for its fill values, and clauses on its wild readings.

    Fill values are numbers beyond `LEAST_LOST_VALUE`, and wild readings with a number that loggers
    write for no reading, such as -9999. Other wild readings stay.

    Parameters
    ----------
    cells, numbers : sequence of str
        The cells (N,) as in the file, and with decimal points; a number may be empty for a cell
        that is beyond `LEAST_LOST_VALUE`.
    lines : sequence of int
        The line of the file for each row.
    column, unit_of_place : str
        The name of the column, and "line" or "row", for the clauses.
    """
    cleaned_cells = list(cells)
    fill_values = []
    unsupported = []
    values = numbers_or_nan(numbers)  # (N,)
    is_beyond = np.isfinite(values) & (np.abs(values) >= LEAST_LOST_VALUE)
    # `numbers` may have these left out already
    is_beyond |= [bool(cell) and not number for cell, number in zip(cells, numbers, strict=True)]
    if is_beyond.any():
        rows = is_beyond.nonzero()[0].tolist()
        for row in rows:
            cleaned_cells[row] = ""
        places = places_text(unit_of_place, [lines[row] for row in rows])
        verb = is_or_are(len(rows))
        fill_values.append(f"{places} of {column!r} {verb} beyond {LEAST_LOST_VALUE:g}")
    values[is_beyond] = np.nan
    rows_of_cells: dict[str, list[int]] = {}
    for row in wild_readings(values).nonzero()[0].tolist():
        rows_of_cells.setdefault(cells[row], []).append(row)
    for cell, rows in rows_of_cells.items():
        places = places_text(unit_of_place, [lines[row] for row in rows])
        place = f"{cell} in {places} of {column!r}"
        if is_fill_value(numbers[rows[0]]):
            for row in rows:
                cleaned_cells[row] = ""
            fill_values.append(f"{place} is a fill value")
        else:
            unsupported.append(
                f"no other reading supports {place}: if it is wrong, leave its cell empty"
            )
    return CleanedColumn(tuple(cleaned_cells), fill_values, unsupported)


def places_text(unit_of_place: str, lines: Sequence[int]) -> str:
    """Return lines or rows for a sentence; a long list is cut."""
    if len(lines) == 1:
        return f"{unit_of_place} {lines[0]}"
    if len(lines) > _MOST_LISTED_LINES:
        return f"{len(lines)} {unit_of_place}s from {lines[0]} on"
    return f"{unit_of_place}s {listing(map(str, lines))}"


def wild_readings(values: FloatArray) -> BoolArray:
    """Return which readings (N,) of a column no other reading supports; none that is NaN.

    One or two values, however often they come, are wild if they lie more than ten times as far
    from the median of the different values as all the others do. There must be at least three
    others.
    """
    distinct_values = np.unique(values[np.isfinite(values)])
    if not distinct_values.size:
        return np.zeros(len(values), dtype=bool)
    centre = np.median(distinct_values)
    distances = np.sort(np.abs(distinct_values - centre))[::-1]  # the largest first
    limit = np.inf
    for count in range(1, _MOST_WILD_VALUES + 1):
        if len(distances) < count + _LEAST_SUPPORTED_VALUES:
            break
        largest_of_others = distances[count]
        if distances[count - 1] > SUPPORTED_DISTANCE * largest_of_others:
            limit = largest_of_others
    return np.abs(values - centre) > limit


def is_fill_value(cell: str) -> bool:
    """Return whether a number is one that loggers write where they have no reading."""
    return _FILL_VALUE.fullmatch(cell) is not None


def numbers_or_nan(cells: Sequence[str]) -> FloatArray:
    """Return the numbers (N,) in cells with decimal points; NaN for an empty cell."""
    return np.array([float(cell or "nan") for cell in cells])
