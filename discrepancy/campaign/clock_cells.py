"""Clock times in the cells of a laboratory's table: dates, times of day, and both."""

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from decimal import Decimal
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

from discrepancy.campaign.heads import load_or_time_role
from discrepancy.errors import CampaignFileError
from reporting.words import listing

_CLOCK = re.compile(
    r"(?:(?P<day>\S+?|\d{1,2}[ ][A-Za-z]+\.?[ ]\d{4}|[A-Za-z]+\.?[ ]\d{1,2},?[ ]\d{4})"
    r"(?:,?[ ]+|T))?"
    r"(?:(?P<hours>\d{1,5}):)?(?P<minutes>\d{1,2}):(?P<seconds>\d\d)(?P<fraction>[.,]\d+)?"
    r"(?:[ ]?(?P<half>[AaPp])\.?[Mm]\.?)?"
    r"(?:[ ]?(?P<offset>Z|UTC|GMT|[+-]\d\d(?::?\d\d)?))?",
    re.ASCII,
)
"""A clock time with or without a date, half of the day, and offset from UTC."""
_COMPACT = re.compile(r"(\d{4})(\d\d)(\d\d)[T ](\d\d)(\d\d)(\d\d)(\D.*)?", re.ASCII)
"""A date and a clock time in the basic format of ISO 8601."""
_DATE = re.compile(
    r"\d{4}([-/.])\d{1,2}\1\d{1,2}|\d{1,2}([-/.])\d{1,2}\2\d{4}"
    r"|\d{1,2}[- /.]?[A-Za-z]{3,9}\.?[- /,]{0,2}\d{4}|[A-Za-z]{3,9}\.?[- ]\d{1,2},?[- ]\d{4}",
    re.ASCII,
)
"""A date with numbers or the English name of a month."""
_LONGEST_TIME = 60
_CLEAR_LAYOUTS = ("%Y %m %d", "%d %b %Y", "%d %B %Y", "%b %d %Y", "%B %d %Y", "%Y %b %d")
"""Dates that can be read in one way; their separators are replaced by blanks."""
DAY_FIRST = "day"
MONTH_FIRST = "month"
_NUMBER_LAYOUTS = {DAY_FIRST: "%d %m %Y", MONTH_FIRST: "%m %d %Y"}
_HOUR = 3_600
_DAY = 86_400
_EXAMPLES = "10:15:02.5, 2026-03-31 10:15:02.5 or 31.3.2026 10:15:02.5"


class _ClockTime(NamedTuple):
    """The clock time in a cell.

    Attributes
    ----------
    day : str
        The date; empty if the cell has none.
    seconds : Decimal
        Time since the beginning of the day, or of the hour [s]; in UTC if the cell has an offset.
    period : int
        The time after which a clock without a date begins anew: a day, or an hour for a clock of
        minutes and seconds [s].
    """

    day: str
    seconds: Decimal
    period: int


def is_time(cell: str) -> bool:
    """Return whether a cell looks like a clock time, a date, or both."""
    if len(cell) > _LONGEST_TIME:
        return False
    return bool(_CLOCK.fullmatch(cell) or _COMPACT.fullmatch(cell) or _is_date(cell))


def _clock_time(cell: str) -> _ClockTime | None:
    """Return the clock time in a cell; None if it has none, or one that does not exist.

    Two numbers, such as `10:15`, are hours and minutes after a date, and minutes and seconds with a
    fraction. With neither or with both, they are not read.
    """
    if _is_date(cell):
        return _ClockTime(cell, Decimal(0), _DAY)
    match = _CLOCK.fullmatch(_COMPACT.sub(r"\1-\2-\3T\4:\5:\6\7", cell))
    if match is None:
        return None
    day, hours, minutes, seconds, fraction, am_or_pm, offset = match.groups(default="")
    period = _DAY
    if not hours and bool(day) == bool(fraction):
        return None
    if not hours and day:  # the two numbers are hours and minutes
        hours, minutes, seconds = minutes, seconds, "0"
    elif not hours:  # minutes and seconds, which start again at each full hour
        period = _HOUR
    hour_count = int(hours or 0)
    if am_or_pm:  # the A or P of AM or PM
        if not 1 <= hour_count <= 12:
            return None
        hour_count = hour_count % 12 + (12 if am_or_pm in "Pp" else 0)
    whole_seconds = _HOUR * hour_count + 60 * int(minutes) + int(seconds)
    time_of_day = whole_seconds + Decimal(f"0{fraction.replace(',', '.')}")
    is_past_midnight = bool(day) and time_of_day > _DAY  # 24:00:00 is allowed
    if is_past_midnight or int(minutes) > 59 or int(seconds) > 59:
        return None
    return _ClockTime(day, time_of_day - _offset_seconds(offset), period)


def _offset_seconds(offset: str) -> int:
    """Return an offset from UTC such as `Z`, `UTC`, `+01`, `+01:00` or `-0530` in seconds."""
    if offset in ("", "Z", "UTC", "GMT"):
        return 0
    digits = offset[1:].replace(":", "")
    seconds = _HOUR * int(digits[:2]) + 60 * int(digits[2:] or 0)
    return -seconds if offset[0] == "-" else seconds


# ---------------------------------------------------------------- dates


@lru_cache(4096)
def _day_numbers(date: str) -> dict[str, int]:
    """Return the days since the year 1 that a date can mean, by `DAY_FIRST` and `MONTH_FIRST`.

    Both orders give the same day if the date can be read in one way only: `2026-03-31`, for
    example, or any date with points, in which the day comes first. An order in which the day does
    not exist is missing; for a text that is not a date, both are.
    """
    text = re.sub(r"(?<=\d)(?=[A-Za-z])|(?<=[A-Za-z])(?=\d)|[-/ ,.]+", " ", date)
    for layout in _CLEAR_LAYOUTS:
        with suppress(ValueError):
            return dict.fromkeys(_NUMBER_LAYOUTS, datetime.strptime(text, layout).toordinal())
    days = {}
    for order, layout in _NUMBER_LAYOUTS.items():
        with suppress(ValueError):
            days[order] = datetime.strptime(text, layout).toordinal()
    if "." in date and DAY_FIRST in days:
        return dict.fromkeys(_NUMBER_LAYOUTS, days[DAY_FIRST])
    return days


def _is_date(cell: str) -> bool:
    """Return whether a cell holds a date without a time."""
    return bool(_DATE.fullmatch(cell)) and bool(_day_numbers(cell))


def possible_date_orders(columns: Iterable[Sequence[str]]) -> list[str]:
    """Return the orders, `DAY_FIRST` or `MONTH_FIRST`, in which all dates of a table can be read.

    The result is `DAY_FIRST` alone if each date can be read in one way only, or if no order fits
    all dates.
    """
    days = set()  # the dates as texts
    for cells in columns:
        if any(map(is_time, cells)):
            times = [_clock_time(cell) for cell in cells if cell]
            days |= {time.day for time in times if time is not None and time.day}
    numbers_of_days = [_day_numbers(day) for day in days]
    orders = [
        order
        for order in _NUMBER_LAYOUTS
        if all(order in numbers for numbers in numbers_of_days if numbers)
    ]
    if not orders:
        return [DAY_FIRST]
    is_clear = all(len({*numbers.values()}) == 1 for numbers in numbers_of_days if len(numbers) > 1)
    return orders[:1] if is_clear and DAY_FIRST in orders else orders


def is_unclear_date(cell: str) -> bool:
    """Return whether a cell has a date that means another day if the month comes first."""
    time = _clock_time(cell) if is_time(cell) else None
    return time is not None and len({*_day_numbers(time.day).values()}) == 2


def is_column_of_dates(cells: Sequence[str]) -> bool:
    """Return whether the filled cells of a column are dates, which may have the time 00:00:00."""
    filled = [cell for cell in cells if cell]
    for cell in filled:
        time = _clock_time(cell) if is_time(cell) else None
        if time is None or not time.day or time.seconds:
            return False
    return bool(filled)


def _is_column_of_times_of_day(cells: Sequence[str]) -> bool:
    """Return whether the filled cells of a column are clock times, none with a date."""
    filled = [cell for cell in cells if cell]
    for cell in filled:
        match = _CLOCK.fullmatch(cell) if len(cell) <= _LONGEST_TIME else None
        if match is None or match["day"]:
            return False
    return bool(filled)


def join_dates_with_times(
    columns: Sequence[tuple[str, ...]],
    titles: Sequence[str],
    units: Sequence[str],
    places: Sequence[str],
) -> tuple[list[tuple[str, ...]], dict[int, int]]:
    """Return the columns of a table with its dates in the cells of its columns of times of day.

    A single column of dates belongs to all columns of times. Of several, the first belongs to the
    first column of times, and so on. Without columns of dates, or of times of day, nothing changes.

    Parameters
    ----------
    columns : sequence of tuple of str
        Cells (N,) of each column.
    titles, units : sequence of str
        The heads of the columns, for messages, and their units, empty where not stated.
    places : sequence of str
        The file and line of each row, for messages.

    Returns
    -------
    columns : list of tuple of str
        The cells, with a date and a time in each filled cell of a column of times, and empty ones
        in the columns of dates.
    times_of_dates : dict of int to int
        The index of the column of times by that of its column of dates; of several columns of
        times, the last one.

    Raises
    ------
    CampaignFileError
        If the numbers of columns do not fit, or a time has no date in its row.
    """
    time_columns = [
        index for index, cells in enumerate(columns) if _is_column_of_times_of_day(cells)
    ]
    date_columns = []
    if time_columns:
        date_columns = [
            index
            for index, cells in enumerate(columns)
            if is_column_of_dates(cells) and not _is_unit_of_readings(units[index])
        ]
    joined_columns = [*columns]
    if not date_columns:
        return joined_columns, {}
    if len(date_columns) not in (1, len(time_columns)):
        titles_of_both = [titles[index] for index in sorted([*date_columns, *time_columns])]
        raise CampaignFileError(
            f"{places[0]}: which dates belong to which times is not clear among the columns "
            f"{listing(map(repr, titles_of_both))}: leave one column of dates for all, or one for "
            "each column of times."
        )
    dates_of_times = date_columns
    if len(date_columns) == 1:
        dates_of_times = date_columns * len(time_columns)
    times_of_dates = {}
    for time, date in zip(time_columns, dates_of_times, strict=True):
        cells = []
        for place, date_cell, time_cell in zip(places, columns[date], columns[time], strict=True):
            if time_cell and not date_cell:
                raise CampaignFileError(
                    f"{place}: {titles[time]!r} has the time {time_cell!r}, but {titles[date]!r} "
                    "has no date: write the date into each row, or remove the column of dates."
                )
            # the cell of a date may also hold the time 00:00:00, which is dropped
            day = _clock_time(date_cell) if date_cell else None
            cells.append(f"{day.day} {time_cell}" if time_cell and day else "")
        joined_columns[time] = tuple(cells)
        times_of_dates[date] = time
    for date in times_of_dates:
        joined_columns[date] = ("",) * len(places)
    return joined_columns, times_of_dates


def _is_unit_of_readings(unit: str) -> bool:
    """Return whether a column with a unit holds readings, which are neither dates nor times."""
    return unit not in ("", "1") and load_or_time_role(unit) != "time"


# ---------------------------------------------------------------- seconds


def seconds_of_clock_times(
    columns: Sequence[tuple[str, ...]],
    titles: Sequence[str],
    units: Sequence[str],
    places: Sequence[str],
    date_order: str = DAY_FIRST,
) -> dict[int, tuple[str, ...]]:
    """Return the columns of clock times, in seconds since the first time of their kind.

    Times with a date are one kind, and times of day another. Columns of dates alone do not set the
    first time if another column does, since their days begin at midnight. A column without a time
    is not among the result.

    Parameters
    ----------
    columns : sequence of tuple of str
        Cells (N,) of each column.
    titles, units : sequence of str
        The heads of the columns, for messages, and their units, empty where not stated.
    places : sequence of str
        The file and line of each row, for messages.
    date_order : str
        What comes first in dates such as 3/4/2026: `DAY_FIRST` or `MONTH_FIRST`.

    Returns
    -------
    dict of int to tuple of str
        The cells of the columns of clock times as decimal numbers, by the number of the column.

    Raises
    ------
    CampaignFileError
        If a cell of a column of clock times is no time, or if fewer than half of the filled cells
        of a column are times, or its unit is that of a reading. A spreadsheet may have turned
        numbers into dates.
    """
    seconds_of_columns: dict[int, dict[int, Decimal]] = {}  # by column, then by row
    starts: dict[bool, Decimal] = {}  # first time of columns with (True) and without a date
    are_dated: dict[int, bool] = {}  # by column
    for column, cells in enumerate(columns):
        filled_rows = {row: cell for row, cell in enumerate(cells) if cell}
        time_rows = [row for row, cell in filled_rows.items() if is_time(cell)]
        if not time_rows:
            continue
        are_few = 2 * len(time_rows) < len(filled_rows)
        if are_few or _is_unit_of_readings(units[column]):
            row = time_rows[0]
            raise CampaignFileError(
                f"{places[row]}: {cells[row]!r} is a date or a time among the numbers under "
                f"{titles[column]!r}: write the number; a spreadsheet may have made a date of it."
            )
        times = {row: _time_of_cell(cell, places[row]) for row, cell in filled_rows.items()}
        is_dated = any(time.day for time in times.values())
        if is_dated:
            seconds = _seconds_of_dated_times(times, cells, places, date_order)
        else:
            seconds = _seconds_of_times_of_day(times)
        are_dated[column] = is_dated
        seconds_of_columns[column] = seconds

    # the first time of either kind, among the columns that are more than dates if there are any
    columns_with_times = [
        column for column in seconds_of_columns if not is_column_of_dates(columns[column])
    ]
    for column in columns_with_times or seconds_of_columns:
        is_dated = are_dated[column]
        first_seconds = next(iter(seconds_of_columns[column].values()))
        starts[is_dated] = min(first_seconds, starts.get(is_dated, first_seconds))

    cells_of_times = {}
    for column, seconds in seconds_of_columns.items():
        start = starts.get(are_dated[column], Decimal(0))
        cells_of_times[column] = tuple(
            f"{seconds[row] - start:f}" if row in seconds else ""
            for row in range(len(columns[column]))
        )
    return cells_of_times


def _time_of_cell(cell: str, place: str) -> _ClockTime:
    """Return the clock time in a cell; raise an error if there is none or it does not exist."""
    time = _clock_time(cell) if len(cell) <= _LONGEST_TIME else None
    if time is None:
        raise CampaignFileError(
            f"{place}: {cell!r} is not a time, or has a date that can be read in two ways: write "
            f"it as {_EXAMPLES}."
        )
    return time


def _seconds_of_dated_times(
    times: Mapping[int, _ClockTime],
    cells: Sequence[str],
    places: Sequence[str],
    date_order: str,
) -> dict[int, Decimal]:
    """Return times with dates in seconds since the year 1, by their row.

    Raises `CampaignFileError` if a time has no date, or one that does not exist in `date_order`.
    """
    seconds = {}
    for row, time in times.items():
        day_number = _day_numbers(time.day).get(date_order)
        if day_number is None:
            fault = "has no date, but other times have one"
            if time.day:
                fault = "is not a time, or has a date that can be read in two ways"
            raise CampaignFileError(
                f"{places[row]}: {cells[row]!r} {fault}: write it as {_EXAMPLES}."
            )
        seconds[row] = day_number * _DAY + time.seconds
    return seconds


def _seconds_of_times_of_day(times: Mapping[int, _ClockTime]) -> dict[int, Decimal]:
    """Return times without dates [s] of a record that may go past midnight, by their row.

    If a time is earlier than the previous one by more than half of its period, one period is added
    to it and to all later times: a day, or an hour for minutes and seconds.
    """
    rows = [*times]
    elapsed = Decimal(0)
    seconds = {rows[0]: times[rows[0]].seconds}
    for previous_row, row in pairwise(rows):
        time = times[row]
        if time.seconds < times[previous_row].seconds - time.period // 2:
            elapsed += time.period
        seconds[row] = time.seconds + elapsed
    return seconds
