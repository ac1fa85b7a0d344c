"""Tables whose channels have columns of times of their own: which is whose, and one clock for all.

A campaign's trial has one column of times. Its stamps are those of all clocks: each reading stays at its own
time, and where a channel has none its cell is empty. Only what must be known at each stamp, a load or a
temperature, is filled in, by what the campaign says it does between its samples.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from discrepancy.campaign.columns import INPUT, LEFT_OUT, NOISE, Column
from discrepancy.campaign.heads import shared_words, words
from discrepancy.campaign.records import FloatArray, Hold, TrialKind
from discrepancy.campaign.sampling import EVEN, as_meant
from discrepancy.errors import CampaignDataError, CampaignFileError, said
from reporting.words import counted, is_or_are, listing

TIME = "time"


class Clock(NamedTuple):
    """A column of times, and the columns whose readings it stamps."""

    times: Column
    columns: tuple[Column, ...]


class OneClock(NamedTuple):
    """Cells of a table on one clock, the line of the file for each row, and how it came about."""

    cells: dict[str, tuple[str, ...]]
    lines: tuple[int, ...]
    sentence: str


@dataclass(frozen=True)
class _Stamps:
    """The times of one clock.

    Attributes
    ----------
    seconds : (n,) ndarray
        Strictly increasing.
    rows : list of int
        Rows of the table in which they stand.
    """

    seconds: FloatArray
    rows: list[int]


def own_clocks(columns: Sequence[Column]) -> tuple[Clock, ...]:
    """Return the clocks of a table and the columns of each.

    A name says it, as `acc2` and `time2`, or else the place: a column of times stands before its columns, or
    behind them in all cases.

    Parameters
    ----------
    columns : sequence of Column
        Those of one table, in its order.

    Raises
    ------
    CampaignFileError
        If neither names nor places say which clock a column has, or they contradict each other.
    """
    times = [column.head for column in columns if column.role == TIME]
    others = [column.head for column in columns if column.role != TIME]
    by_name = _by_names(times, others)
    by_place = _by_places(times, [column.head for column in columns])
    found = by_name or by_place
    if found is None or (by_name and by_place and by_name != by_place):
        why = "names and places contradict each other" if found else "neither names nor places say it"
        raise CampaignFileError(
            f"{columns[0].sheet.name} has the times {listing(map(repr, times))}, and which column has which "
            f"is not clear ({why}): put each column of times before its columns, or leave all but one out "
            "with --column NAME=-."
        )
    used = {column.head: column for column in columns if column.role != LEFT_OUT}
    clocks = []
    for head in times:
        members = tuple(used[member] for member in found[head] if member in used)
        if members:
            clocks.append(Clock(used[head], members))
    return tuple(clocks)


def _by_names(times: Sequence[str], others: Sequence[str]) -> dict[str, list[str]] | None:
    """Return the columns of each clock as names say it; None where they do not for each."""
    shared = shared_words(times)
    labels = {head: words(head) - shared for head in times}
    found: dict[str, list[str]] = {head: [] for head in times}
    for column in others:
        matching = [head for head, label in labels.items() if label and label <= words(column)]
        if len(matching) != 1:
            return None
        found[matching[0]].append(column)
    return found if all(found.values()) else None


def _by_places(times: Sequence[str], heads: Sequence[str]) -> dict[str, list[str]] | None:
    """Return the columns of each clock as the order of heads says it; None where it does not."""
    in_order = heads if heads[0] in times else heads[::-1]
    if in_order[0] not in times:
        return None
    found: dict[str, list[str]] = {}
    clock = in_order[0]
    for head in in_order:
        if head in times:
            clock = head
            found[clock] = []
        else:
            found[clock].append(head)
    if not all(found.values()):
        return None
    return {head: [member for member in heads if member in members] for head, members in found.items()}


# ---------------------------------------------------------------- one clock


def on_one_clock(
    clocks: Sequence[Clock], kind: str, decimal: str, holds: Mapping[str, str | None]
) -> OneClock:
    """Return the columns of a table in SI on one clock.

    Parameters
    ----------
    clocks : sequence of Clock
        One or more, of one table.
    kind : str
        That of its trial, or `NOISE`.
    decimal : str
        Mark of its decimals.
    holds : mapping of str to str or None
        What a load does between its samples, by the head of its column; where nobody said it, straight lines.

    Raises
    ------
    CampaignFileError
        If a reading has no time, loads are not recorded at the same time as anything else, rows at rest have
        several times, or samples at rest several intervals.
    CampaignDataError
        If times do not increase.
    """
    stamps = [_stamps(clock, decimal) for clock in clocks]
    seconds, places = _merged(stamps)
    if all(len(place) == len(seconds) for place in places):
        sentence = f"{_whose(clocks)}: the clocks are equal and become one"
    elif kind == NOISE:
        return _in_order(clocks, stamps, decimal)
    elif kind in (TrialKind.STATIC, TrialKind.FLIGHT):
        heads = listing(repr(clock.times.head) for clock in clocks)
        raise CampaignFileError(
            f"{_file(clocks)}: the times {heads} differ, and a row of a {kind} trial is one state at rest: "
            "leave all but one out with --column NAME=-."
        )
    else:
        sentence = (
            f"{_whose(clocks)}: one clock has the {len(seconds)} stamps of all, and a channel has no reading "
            "where its own clock has no stamp"
        )
    cells: dict[str, list[str]] = {TIME: [f"{moment:.15g}" for moment in seconds.tolist()]}
    inside = np.ones(len(seconds), dtype=bool)
    filled = []
    for clock, own, place in zip(clocks, stamps, places, strict=True):
        for column in clock.columns:
            column_cells = _placed(column.in_si(decimal), own.rows, place, len(seconds))
            if _is_known_throughout(column, kind) and len(place) < len(seconds):
                inside &= (seconds >= own.seconds[0]) & (seconds <= own.seconds[-1])
                hold = _hold(column, holds)
                _fill(column_cells, seconds, place, hold)
                filled.append(f"{column.head!r} ({hold.value.replace('_', ' ')})")
            cells[column.title] = column_cells
    kept = np.flatnonzero(inside).tolist()
    kept_cells = {title: tuple(column[at] for at in kept) for title, column in cells.items()}
    if unread := [title for title, column in kept_cells.items() if not any(column)]:
        raise CampaignFileError(
            f"{_file(clocks)}: there is no time at which both {listing(filled)} and {unread[0]!r} are known, "
            "and a load must be known while a channel is read."
        )
    if filled:
        sentence += f"; loads are filled in there as they go between their samples: {listing(filled)}"
    if len(kept) < len(seconds):
        outside = len(seconds) - len(kept)
        sentence += (
            f"; {counted(outside, 'stamp')} before or after their records {is_or_are(outside)} left out"
        )
    lines = _lines(clocks, stamps, places, len(seconds))
    return OneClock(kept_cells, tuple(lines[at] for at in kept), sentence)


def _file(clocks: Sequence[Clock]) -> str:
    return clocks[0].times.sheet.name


def _is_known_throughout(column: Column, kind: str) -> bool:
    """Whether a trial needs a value of a column at each stamp: a load or a temperature."""
    is_force = column.role == "force" and kind == TrialKind.FORCED
    return is_force or INPUT in column.role or column.role == "temperature"


def _hold(column: Column, holds: Mapping[str, str | None]) -> Hold:
    """Return what a load does between its samples; motions are smooth."""
    if column.quantity is not None and column.quantity.moving:
        return Hold.SMOOTH
    return Hold(holds.get(column.head) or Hold.LINEAR)


def _placed(cells: Sequence[str], rows: Sequence[int], place: Sequence[int], count: int) -> list[str]:
    """Return cells of the rows of a table at their places among `count`; the others are empty."""
    placed = [""] * count
    for at, row in zip(place, rows, strict=True):
        placed[at] = cells[row]
    return placed


def _lines(
    clocks: Sequence[Clock], stamps: Sequence[_Stamps], places: Sequence[Sequence[int]], count: int
) -> list[int]:
    """Return a line of the file for each of `count` stamps: that of the first clock that has it."""
    lines = [0] * count
    for own, place in reversed([*zip(stamps, places, strict=True)]):
        for at, row in zip(place, own.rows, strict=True):
            lines[at] = clocks[0].times.sheet.lines[row]
    return lines


def _in_order(clocks: Sequence[Clock], stamps: Sequence[_Stamps], decimal: str) -> OneClock:
    """Return samples at rest beside each other: their times do not matter but for the interval."""
    intervals = [(own.seconds[-1] - own.seconds[0]) / max(len(own.seconds) - 1, 1) for own in stamps]
    if max(intervals) - min(intervals) > EVEN * min(intervals):
        each = listing(
            f"{interval:.6g} s by {clock.times.head!r}"
            for clock, interval in zip(clocks, intervals, strict=True)
        )
        raise CampaignFileError(
            f"{_file(clocks)}: samples at rest were taken every {each}, and a campaign has one interval for "
            "all: save those of one rate, or state `noise` of the other channels in campaign.toml."
        )
    longest = max(stamps, key=lambda own: len(own.seconds))
    count = len(longest.seconds)
    cells = {TIME: tuple(f"{moment:.15g}" for moment in longest.seconds.tolist())}
    for clock, own in zip(clocks, stamps, strict=True):
        for column in clock.columns:
            first = range(len(own.rows))
            cells[column.title] = tuple(_placed(column.in_si(decimal), own.rows, first, count))
    lines = tuple(clocks[0].times.sheet.lines[row] for row in longest.rows)
    return OneClock(cells, lines, f"{_whose(clocks)}: samples at rest stand in their order")


def _stamps(clock: Clock, decimal: str) -> _Stamps:
    """Return the times of a clock, even ones on their grid."""
    sheet, cells = clock.times.sheet, clock.times.in_si(decimal)
    rows = [row for row, cell in enumerate(cells) if cell]
    for column in clock.columns:
        for row, cell in enumerate(column.in_si(decimal)):
            if cell and not cells[row]:
                raise CampaignFileError(
                    f"{sheet.name}, line {sheet.lines[row]}: {column.head!r} has a reading and "
                    f"{clock.times.head!r} no time: give it, or leave the reading out."
                )
    printed = [cells[row] for row in rows]
    seconds = np.array([float(cell) for cell in printed])
    backwards = np.flatnonzero(np.diff(seconds) <= 0.0)
    if backwards.size:
        at = int(backwards[0])
        told = {"at": at + 1, "time": printed[at], "then": printed[at + 1]}
        user = f"the column {clock.times.head!r}"
        raise CampaignDataError(said("campaign.time_goes_back", file=sheet.name, user=user, **told))
    return _Stamps(as_meant(seconds, printed) if len(rows) > 1 else seconds, rows)


def _merged(stamps: Sequence[_Stamps]) -> tuple[FloatArray, list[list[int]]]:
    """Return the times of all clocks, and where those of each stand among them.

    Times of two clocks that differ by less than a thousandth of the shorter interval are one.
    """
    steps = [float(np.median(np.diff(own.seconds))) for own in stamps if len(own.seconds) > 1]
    tolerance = EVEN * min(steps, default=0.0)
    moments = np.concatenate([own.seconds for own in stamps])
    owners = np.repeat(np.arange(len(stamps)), [len(own.seconds) for own in stamps])
    order = np.lexsort((owners, moments))
    places: list[list[int]] = [[] for _ in stamps]
    seconds: list[float] = []
    present: set[int] = set()
    for moment, owner in zip(moments[order].tolist(), owners[order].tolist(), strict=True):
        if not seconds or owner in present or moment - seconds[-1] > tolerance:
            seconds.append(moment)
            present = set()
        present.add(owner)
        places[owner].append(len(seconds) - 1)
    return np.array(seconds), places


def _fill(cells: list[str], seconds: FloatArray, place: Sequence[int], hold: Hold) -> None:
    """Write values of a load between its samples, as its hold has them; an empty sample stays empty."""
    if len(place) < 2 or not all(cells[at] for at in place):
        return
    samples = np.array([float(cells[at]) for at in place])
    own = seconds[list(place)]
    if hold is Hold.ZERO_ORDER:
        values = samples[np.clip(np.searchsorted(own, seconds, side="right") - 1, 0, None)]
    elif hold is Hold.SMOOTH:
        values = CubicSpline(own, samples)(seconds)
    else:
        values = np.interp(seconds, own, samples)
    for at in sorted({*range(len(seconds))} - {*place}):
        cells[at] = f"{values[at]:.15g}"


def _whose(clocks: Sequence[Clock]) -> str:
    return listing(
        f"{listing(repr(column.head) for column in clock.columns)} by {clock.times.head!r}"
        for clock in clocks
    )
