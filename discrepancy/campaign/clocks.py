"""Tables with several columns of times, put on one clock.

A laboratory's table may have several clocks: columns of times, each for some of the other columns.
A trial of a campaign has only one clock: its times are those of all clocks of the table together.
Each reading stays at its own time, and a channel's cell is empty at the times of other clocks. Only
a load or a temperature must be known at all times, and is interpolated as the campaign states for
the course between its samples (`hold`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from discrepancy.campaign.clock_columns import TIME, TableClock
from discrepancy.campaign.columns import INPUT, NOISE, LaboratoryColumn
from discrepancy.campaign.records import FloatArray, Hold, TrialKind
from discrepancy.campaign.sampling import (
    EVENNESS_TOLERANCE,
    decreasing_times_message,
    undo_rounding,
)
from discrepancy.errors import CampaignDataError, CampaignFileError
from reporting.words import counted, is_or_are, listing


class MergedTable(NamedTuple):
    """A table whose N rows have one clock.

    Attributes
    ----------
    cells : dict of str to tuple of str
        Cells (N,) of each column by its title.
    lines : tuple of int
        The line of the file for each row.
    sentence : str
        The remark on how the clocks were merged.
    """

    cells: dict[str, tuple[str, ...]]
    lines: tuple[int, ...]
    sentence: str


@dataclass(frozen=True)
class _ClockTimes:
    """The times of one clock.

    Attributes
    ----------
    seconds : (n,) ndarray
        The times [s], which increase strictly.
    rows : list of int
        Rows of the table in which they stand.
    """

    seconds: FloatArray
    rows: list[int]


def merge_clocks(
    clocks: Sequence[TableClock], kind: str, decimal: str, holds: Mapping[str, str | None]
) -> MergedTable:
    """Merge the clocks of a table into one, and return its columns in SI.

    A clock is a column of times with the columns that were sampled at these times. The merged
    table has a row for each time of any clock. A channel has empty cells at the times of the other
    clocks; a load or a temperature is interpolated there, and rows outside of its record are left
    out. Samples at rest of different clocks are put in the same rows instead.

    Parameters
    ----------
    clocks : sequence of TableClock
        One clock or more, of one table.
    kind : str
        The kind of its trial, or `NOISE`.
    decimal : str
        The decimal mark of its numbers.
    holds : mapping of str to str or None
        The course of a load between its samples, by the head of its column; None means linear.

    Raises
    ------
    CampaignFileError
        If a reading has no time, the loads are not known at any time at which a channel is read,
        rows at rest have several times, or samples at rest have several intervals.
    CampaignDataError
        If times do not increase.
    """
    times = [_clock_times(clock, decimal) for clock in clocks]
    seconds, positions = _merged_times(times)
    count = len(seconds)
    clocks_are_equal = all(len(clock_positions) == count for clock_positions in positions)
    if kind == NOISE and not clocks_are_equal:
        return _rest_samples_in_order(clocks, times, decimal)
    if kind in (TrialKind.STATIC, TrialKind.FLIGHT) and not clocks_are_equal:
        heads = listing(repr(clock.times.head) for clock in clocks)
        raise CampaignFileError(
            f"{_file_name(clocks)}: the times {heads} differ, and a row of a {kind} trial is one "
            "state at rest: leave all but one out with --column NAME=-."
        )
    cells: dict[str, list[str]] = {TIME: _time_cells(seconds)}
    loads_are_known = np.ones(count, dtype=bool)
    filled_loads = []
    # cells of each column at the merged times
    for clock, clock_times, clock_positions in zip(clocks, times, positions, strict=True):
        has_all_times = len(clock_positions) == count
        for column in clock.columns:
            column_cells = _place_cells(
                column.cells_in_si(decimal), clock_times.rows, clock_positions, count
            )
            if _must_be_known_throughout(column, kind) and not has_all_times:
                hold = _hold_of_load(column, holds)
                _fill_between_samples(column_cells, seconds, clock_positions, hold)
                filled_loads.append(f"{column.head!r} ({hold.value.replace('_', ' ')})")
                is_after_first_sample = seconds >= clock_times.seconds[0]
                is_before_last_sample = seconds <= clock_times.seconds[-1]
                loads_are_known &= is_after_first_sample & is_before_last_sample
            cells[column.title] = column_cells

    # rows in which all loads are known
    rows = np.flatnonzero(loads_are_known).tolist()
    cells_of_rows = {title: tuple(column[row] for row in rows) for title, column in cells.items()}
    unread_titles = [title for title, column in cells_of_rows.items() if not any(column)]
    if unread_titles:
        raise CampaignFileError(
            f"{_file_name(clocks)}: there is no time at which both {listing(filled_loads)} and "
            f"{unread_titles[0]!r} are known, but a load must be known whenever a channel is read."
        )
    remark = f"{_stamped_columns_text(clocks)}: the clocks are equal and are merged into one"
    if not clocks_are_equal:
        remark = (
            f"{_stamped_columns_text(clocks)}: one clock has the {count} stamps of all, and a "
            "channel has no reading where its own clock has no stamp"
        )
    remark += _remark_on_loads(filled_loads, outside=count - len(rows))
    lines = _line_numbers(clocks, times, positions, count)
    return MergedTable(cells_of_rows, tuple(lines[row] for row in rows), remark)


def _remark_on_loads(filled_loads: Sequence[str], outside: int) -> str:
    """Say at the end of a remark which loads were interpolated and how many times are left out.

    Parameters
    ----------
    filled_loads : sequence of str
        Loads that were filled in between their samples, and how.
    outside : int
        The number of times before or after the records of these loads.
    """
    remark = ""
    if filled_loads:
        remark += f"; loads are interpolated there: {listing(filled_loads)}"
    if outside:
        stamps = counted(outside, "stamp")
        remark += f"; {stamps} before or after their records {is_or_are(outside)} left out"
    return remark


def _time_cells(seconds: FloatArray) -> list[str]:
    """Return times (N,) [s] as cells of a table, with 15 significant digits."""
    return [f"{time:.15g}" for time in seconds.tolist()]


def _file_name(clocks: Sequence[TableClock]) -> str:
    """Return the name of the file that the clocks are from."""
    return clocks[0].times.sheet.name


def _must_be_known_throughout(column: LaboratoryColumn, kind: str) -> bool:
    """Return whether a trial needs a column's value at each time: a load or a temperature."""
    is_force = column.role == "force" and kind == TrialKind.FORCED
    return is_force or INPUT in column.role or column.role == "temperature"


def _hold_of_load(column: LaboratoryColumn, holds: Mapping[str, str | None]) -> Hold:
    """Return the course of a load between its samples: smooth for a motion, else as stated.

    A course that is not stated is linear.
    """
    if column.quantity is not None and column.quantity.motion_chain:
        return Hold.SMOOTH
    return Hold(holds.get(column.head) or Hold.LINEAR)


def _place_cells(
    cells: Sequence[str], rows: Sequence[int], positions: Sequence[int], count: int
) -> list[str]:
    """Copy cells of a column to given positions of a longer column, which is empty elsewhere.

    Parameters
    ----------
    cells : sequence of str
        The cells of the column.
    rows : sequence of int
        The rows whose cells are copied.
    positions : sequence of int
        The new position of each of these rows.
    count : int
        The number of cells of the longer column.
    """
    result = [""] * count
    for position, row in zip(positions, rows, strict=True):
        result[position] = cells[row]
    return result


def _line_numbers(
    clocks: Sequence[TableClock],
    times: Sequence[_ClockTimes],
    positions: Sequence[Sequence[int]],
    count: int,
) -> list[int]:
    """Return the line in the file of each merged time.

    A time that several clocks have in common has the line of the first of these clocks.

    Parameters
    ----------
    clocks : sequence of TableClock
        The clocks of one table.
    times : sequence of _ClockTimes
        The times of each clock of the file.
    positions : sequence of sequence of int
        For each clock, the indices of its times among the merged times.
    count : int
        The number of times that were merged.
    """
    lines_of_rows = clocks[0].times.sheet.lines
    lines = [0] * count
    # from the last clock to the first, so that the first overwrites the others
    for clock_times, clock_positions in reversed([*zip(times, positions, strict=True)]):
        for position, row in zip(clock_positions, clock_times.rows, strict=True):
            lines[position] = lines_of_rows[row]
    return lines


def _rest_samples_in_order(
    clocks: Sequence[TableClock], times: Sequence[_ClockTimes], decimal: str
) -> MergedTable:
    """Merge a noise record whose columns were sampled by several clocks, sample by sample.

    Row k of the merged table holds the k-th sample of each clock, although the clocks took it at
    different times: for a noise record only the sampling interval matters. Shorter columns end with
    empty cells.

    Raises
    ------
    CampaignFileError
        If the clocks have several sampling intervals.
    """
    intervals = []
    for clock_times in times:
        duration = clock_times.seconds[-1] - clock_times.seconds[0]
        intervals.append(duration / max(len(clock_times.seconds) - 1, 1))
    if max(intervals) - min(intervals) > EVENNESS_TOLERANCE * min(intervals):
        periods = listing(
            f"{interval:.6g} s by {clock.times.head!r}"
            for clock, interval in zip(clocks, intervals, strict=True)
        )
        raise CampaignFileError(
            f"{_file_name(clocks)}: samples at rest were taken every {periods}, and a campaign has "
            "one interval for all: save those of one rate, or state `noise` of the other channels "
            "in campaign.toml."
        )
    # the clock with most samples gives the times and the lines of the rows
    longest = max(times, key=lambda clock_times: len(clock_times.seconds))
    count = len(longest.seconds)
    cells = {TIME: tuple(_time_cells(longest.seconds))}
    for clock, clock_times in zip(clocks, times, strict=True):
        first_rows = range(len(clock_times.rows))
        for column in clock.columns:
            column_cells = _place_cells(
                column.cells_in_si(decimal), clock_times.rows, first_rows, count
            )
            cells[column.title] = tuple(column_cells)
    lines = tuple(clocks[0].times.sheet.lines[row] for row in longest.rows)
    remark = f"{_stamped_columns_text(clocks)}: samples at rest are kept in their order"
    return MergedTable(cells, lines, remark)


def _clock_times(clock: TableClock, decimal: str) -> _ClockTimes:
    """Return the times of a clock, made evenly spaced if only rounding in print hides that.

    Raises
    ------
    CampaignFileError
        If a reading has no time.
    CampaignDataError
        If times do not increase.
    """
    sheet = clock.times.sheet
    cells = clock.times.cells_in_si(decimal)
    rows = [row for row, cell in enumerate(cells) if cell]
    for column in clock.columns:
        for row, cell in enumerate(column.cells_in_si(decimal)):
            if cell and not cells[row]:
                raise CampaignFileError(
                    f"{sheet.name}, line {sheet.lines[row]}: {column.head!r} has a reading, but "
                    f"{clock.times.head!r} has no time: give the time, or leave the reading out."
                )
    printed_times = [cells[row] for row in rows]
    seconds = np.array([float(cell) for cell in printed_times])
    backwards = np.flatnonzero(np.diff(seconds) <= 0.0)
    if backwards.size:
        user = f"the column {clock.times.head!r}"
        raise CampaignDataError(
            decreasing_times_message(sheet.name, user, printed_times, int(backwards[0]))
        )
    if len(rows) > 1:
        seconds = undo_rounding(seconds, printed_times)
    return _ClockTimes(seconds, rows)


def _merged_times(times: Sequence[_ClockTimes]) -> tuple[FloatArray, list[list[int]]]:
    """Merge the times of all clocks into one increasing sequence.

    Times of two clocks that differ by at most a thousandth of the shortest median interval are
    taken as equal: the earlier one stands for both. Times of one clock are never taken as equal.

    Parameters
    ----------
    times : sequence of _ClockTimes
        The times of each clock of the file.

    Returns
    -------
    seconds : (N,) ndarray
        Times of all clocks [s], increasing.
    positions : list of list of int
        For each clock, the indices of its times in `seconds`.
    """
    steps = [
        float(np.median(np.diff(clock_times.seconds)))
        for clock_times in times
        if len(clock_times.seconds) > 1
    ]
    tolerance = EVENNESS_TOLERANCE * min(steps, default=0.0)
    # all times in a row, with the number of the clock of each; sorted by time, then by clock
    all_times = np.concatenate([clock_times.seconds for clock_times in times])
    counts = [len(clock_times.seconds) for clock_times in times]
    clock_numbers = np.repeat(np.arange(len(times)), counts)
    order = np.lexsort((clock_numbers, all_times))

    positions: list[list[int]] = [[] for _ in times]
    seconds: list[float] = []
    clocks_at_last_time: set[int] = set()  # numbers of the clocks that have the time seconds[-1]
    for time, clock_number in zip(
        all_times[order].tolist(), clock_numbers[order].tolist(), strict=True
    ):
        is_new = not seconds or time - seconds[-1] > tolerance
        if is_new or clock_number in clocks_at_last_time:
            seconds.append(time)
            clocks_at_last_time = set()
        clocks_at_last_time.add(clock_number)
        positions[clock_number].append(len(seconds) - 1)
    return np.array(seconds), positions


def _fill_between_samples(
    cells: list[str], seconds: FloatArray, positions: Sequence[int], hold: Hold
) -> None:
    """Fill the cells of a load at the times of other clocks by interpolation, in place.

    A load with an empty cell at one of its own samples, or with a single sample, is not changed.

    Parameters
    ----------
    cells : list of str
        Cells (N,) of the load.
    seconds : (N,) ndarray
        Times of all cells [s].
    positions : sequence of int
        The indices of the load's own samples among the cells.
    hold : Hold
        The course of the load between its samples, which decides how it is interpolated.
    """
    if len(positions) < 2 or not all(cells[position] for position in positions):
        return
    samples = np.array([float(cells[position]) for position in positions])
    sample_times = seconds[list(positions)]
    if hold is Hold.ZERO_ORDER:
        last_sample = np.searchsorted(sample_times, seconds, side="right") - 1
        values = samples[np.clip(last_sample, 0, None)]
    elif hold is Hold.SMOOTH:
        values = CubicSpline(sample_times, samples)(seconds)
    else:
        values = np.interp(seconds, sample_times, samples)
    is_sampled = set(positions)
    for index in range(len(seconds)):
        if index not in is_sampled:
            cells[index] = f"{values[index]:.15g}"


def _stamped_columns_text(clocks: Sequence[TableClock]) -> str:
    """Return the beginning of a remark, which lists the columns that belong to each clock."""
    phrases = []
    for clock in clocks:
        heads = listing(repr(column.head) for column in clock.columns)
        phrases.append(f"{heads} by {clock.times.head!r}")
    return listing(phrases)
