"""Cells of a laboratory's table: numbers with either decimal mark, and clock times."""

import re
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime, timedelta
from decimal import Decimal
from itertools import pairwise

from discrepancy.errors import CampaignFileError

_GROUPS = "'’ \u00a0\u202f"
_NUMBERS = {
    mark: re.compile(
        rf"[+-]?(?:[1-9]\d{{0,2}}([{other}{_GROUPS}])\d{{3}}(?:\1\d{{3}})*(?:[{mark}]\d*)?"
        rf"|(?:\d+[{mark}]?\d*|[{mark}]\d+)(?:[eE][+-]?\d+)?)",
        re.ASCII,
    )
    for mark, other in (".,", ",.")
}
"""Numbers with either decimal mark: those with groups of three digits have no exponent."""
_PLAIN = re.compile(r"[+-]?\d*[.,]?\d+(?:[eE][+-]?\d+)?", re.ASCII)
"""Simple numbers, which most cells contain; this pattern is faster."""
CLOCK = re.compile(
    r"(?:([^\sT]+)(?:[ ]+|T)|(?=\d))(\d{1,2}:\d\d:\d\d)([.,]\d+)?"
    r"(?: ?([AaPp])\.?[Mm]\.?)?(Z|[+-]\d\d:?\d\d)?",
    re.ASCII,
)
"""Date, clock, fraction of a second, A or P of "am" and "pm", and offset from UTC."""
_DAY_LAYOUTS = ("%Y-%m-%d", "%d.%m.%Y")
"""The dates that are read; other layouts, as 3/4/2026, leave open which number is the month."""
_DAY_OF_CLOCK_TIMES = "2000-01-01"
"""The day on which cells without a date are placed; only differences of such times are used."""
_HALF_DAY = 43_200
_DAY = 86_400
LOGICAL = {"true": "1", "false": "0"}


class ExactNumber(str):
    """A number of a file that stores numbers, as Excel and MATLAB do, with a decimal point.

    Attributes
    ----------
    shown_unit : str
        The unit that Excel shows beside the number, by its number format; empty if there is none.
    """

    shown_unit = ""


def plain_number(cell: str, mark: str) -> str | None:
    """Return the number in a cell as `float` reads it; None if the cell holds anything else.

    Parameters
    ----------
    cell : str
        The text of the cell.
    mark : str
        Decimal mark: a point or a comma.
    """
    if isinstance(cell, ExactNumber):
        return str(cell)
    if cell.lower() in LOGICAL:
        return LOGICAL[cell.lower()]
    text = cell.replace("−", "-")
    match = _NUMBERS[mark].fullmatch(text)
    if match is None:
        return None
    group_mark = match[1] or " "
    return text.replace(group_mark, "").replace(mark, ".")


def is_value(cell: str) -> bool:
    """Return whether a cell holds a number, with either decimal mark, or a time."""
    if _PLAIN.fullmatch(cell) or CLOCK.fullmatch(cell):
        return True
    return any(plain_number(cell, mark) for mark in _NUMBERS)


def _has_date(cell: str) -> bool:
    """Return whether a cell holds a time with a date."""
    match = CLOCK.fullmatch(cell)
    return match is not None and bool(match[1])


def _seconds_of_cell(cell: str, place: str) -> Decimal:
    """Return the time in a cell in seconds since 0001-01-01; in UTC if the cell has an offset.

    A cell without a date is placed on `_DAY_OF_CLOCK_TIMES`, so that its time can be compared with
    other cells without a date only.

    Parameters
    ----------
    cell : str
        The text of the cell.
    place : str
        File and line, for messages.

    Raises
    ------
    CampaignFileError
        If the cell holds no time, or its date can be read in two ways.
    """
    match = CLOCK.fullmatch(cell)
    if match is not None:
        day, clock, fraction, letter_of_am_or_pm, offset = match.groups(default="")
        moment = _moment(day or _DAY_OF_CLOCK_TIMES, clock, letter_of_am_or_pm)
        if moment is not None:
            whole_seconds = (moment - datetime.min) // timedelta(seconds=1)
            fraction_of_second = Decimal(f"0{fraction.replace(',', '.')}")
            return whole_seconds - _offset_seconds(offset) + fraction_of_second
    raise CampaignFileError(
        f"{place}: {cell!r} is not a time, or has a date that can be read in two ways: write it as "
        "10:15:02.5, 2026-03-31 10:15:02.5 or 31.3.2026 10:15:02.5."
    )


def _moment(day: str, clock: str, letter_of_am_or_pm: str) -> datetime | None:
    """Return the date and time of a cell; None if there is no such time or date.

    Parameters
    ----------
    day : str
        The date, in one of `_DAY_LAYOUTS`.
    clock : str
        Hours, minutes and seconds, as 10:15:02.
    letter_of_am_or_pm : str
        "A" or "P" on a clock of 12 hours; empty on a clock of 24 hours.
    """
    clock_layout = "%H:%M:%S"
    if letter_of_am_or_pm:
        clock = f"{clock} {letter_of_am_or_pm}M"
        clock_layout = "%I:%M:%S %p"
    for day_layout in _DAY_LAYOUTS:
        with suppress(ValueError):
            return datetime.strptime(f"{day} {clock}", f"{day_layout} {clock_layout}")
    return None


def seconds_of_clock_times(
    columns: Sequence[tuple[str, ...]], places: Sequence[str]
) -> dict[int, tuple[str, ...]]:
    """Return the columns of clock times, in seconds since the first time of their kind.

    Times with a date are one kind, and times of day another.

    Parameters
    ----------
    columns : sequence of tuple of str
        Cells (N,) of each column.
    places : sequence of str
        The file and line of each row, for messages.

    Returns
    -------
    dict of int to tuple of str
        The cells of the columns of clock times, by the number of the column.
    """
    seconds_of_columns: dict[int, dict[int, Decimal]] = {}
    starts: dict[bool, Decimal] = {}  # first time of columns with, and without, a date
    for column, cells in enumerate(columns):
        if not any(map(CLOCK.fullmatch, cells)):
            continue
        seconds = {
            row: _seconds_of_cell(cell, places[row]) for row, cell in enumerate(cells) if cell
        }
        is_dated = any(map(_has_date, cells))
        if not is_dated:
            seconds = dict(zip(seconds, _continue_past_midnight([*seconds.values()]), strict=True))
        seconds_of_columns[column] = seconds
        first_seconds = next(iter(seconds.values()))
        starts[is_dated] = min(first_seconds, starts.get(is_dated, first_seconds))

    cells_of_times = {}
    for column, seconds in seconds_of_columns.items():
        start = starts[any(map(_has_date, columns[column]))]
        cells_of_times[column] = tuple(
            ExactNumber(seconds[row] - start) if row in seconds else ""
            for row in range(len(columns[column]))
        )
    return cells_of_times


def _offset_seconds(offset: str) -> int:
    """Return an offset from UTC such as `Z`, `+01:00` or `-0530` in seconds."""
    if offset in ("", "Z"):
        return 0
    digits = offset[1:].replace(":", "")
    seconds = 3600 * int(digits[:2]) + 60 * int(digits[2:])
    return -seconds if offset[0] == "-" else seconds


def _continue_past_midnight(times: Sequence[Decimal]) -> list[Decimal]:
    """Return times of day [s] of a record that may go past midnight.

    If a time is earlier than the previous one by more than half a day, one day is added to it and
    to all later times.
    """
    days = 0
    continued = [times[0]]
    for previous_time, time_of_day in pairwise(times):
        if time_of_day < previous_time - _HALF_DAY:
            days += 1
        continued.append(time_of_day + days * _DAY)
    return continued


def decimal_mark(
    columns: Sequence[Sequence[str]], lines: Sequence[int], place: str, separator: str
) -> tuple[str | None, str]:
    """Return the decimal mark of a table.

    Parameters
    ----------
    columns : sequence of sequence of str
        Cells (N,) of each column.
    lines : sequence of int
        The line of the file for each row.
    place : str
        The name of the file and what its rows are called, for messages.
    separator : str
        The character between two cells.

    Returns
    -------
    mark : str or None
        The decimal mark; None if all numbers with a mark can be read in two ways, as 1,234 can.
    unclear : str
        The first number that can be read in two ways, and its line.

    Raises
    ------
    CampaignFileError
        If decimals are written in two ways.
    """
    examples: dict[str, str] = {}
    unclear = ""
    for cells in columns:
        for cell, line in zip(cells, lines, strict=True):
            with_point = plain_number(cell, ".")
            with_comma = plain_number(cell, ",")
            if with_point == with_comma:
                continue
            example = f"{cell!r} in line {line}"
            if with_point and with_comma:
                unclear = unclear or example
            else:
                examples.setdefault("." if with_point else ",", example)
    if len(examples) > 1:
        file = place.rpartition(",")[0]
        raise CampaignFileError(
            f"{file} writes decimals with a point ({examples['.']}) and with a comma "
            f"({examples[',']}): write all in one way."
        )
    if examples:
        return next(iter(examples)), unclear
    if not unclear:
        return ".", unclear
    # commas between cells, and none within a number: the mark in it is a decimal point
    has_comma = "," in unclear.rpartition(" in ")[0]
    return ("." if separator == "," and not has_comma else None), unclear
