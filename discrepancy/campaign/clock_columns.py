"""Tables with several columns of times: which columns each of them stamps."""

from collections.abc import Sequence
from typing import NamedTuple

from discrepancy.campaign.columns import LEFT_OUT, LaboratoryColumn
from discrepancy.campaign.heads import shared_words, words_of_head
from discrepancy.errors import CampaignFileError
from reporting.words import listing

TIME = "time"


class TableClock(NamedTuple):
    """A column of times, and the columns whose readings it stamps."""

    times: LaboratoryColumn
    columns: tuple[LaboratoryColumn, ...]


def find_clocks(columns: Sequence[LaboratoryColumn]) -> tuple[TableClock, ...]:
    """Return the clocks of a table with several columns of times, and the columns that each stamps.

    Either the names show it, as in `acc2` and `time2`, or the positions: every column of times
    comes before the columns that it stamps, or every one comes after them.

    Parameters
    ----------
    columns : sequence of LaboratoryColumn
        Columns of one table, in its order.

    Raises
    ------
    CampaignFileError
        If neither names nor positions say which clock a column has, or they contradict each other.
    """
    times = [column.head for column in columns if column.role == TIME]
    readings = [column.head for column in columns if column.role != TIME]
    by_name = _columns_by_name(times, readings)
    by_position = _columns_by_position(times, [column.head for column in columns])
    contradict = by_name is not None and by_position is not None and by_name != by_position
    stamped_heads = by_position if by_name is None else by_name
    if stamped_heads is None or contradict:
        reason = "neither names nor places say it"
        if contradict:
            reason = "names and places contradict each other"
        raise CampaignFileError(
            f"{columns[0].sheet.name} has the times {listing(map(repr, times))}, and which column "
            f"has which is not clear ({reason}): put each column of times before its columns, or "
            "leave all but one out with --column NAME=-."
        )
    used = {column.head: column for column in columns if column.role != LEFT_OUT}
    clocks = []
    for time in times:
        stamped = tuple(used[head] for head in stamped_heads[time] if head in used)
        if stamped:
            clocks.append(TableClock(used[time], stamped))
    return tuple(clocks)


def _columns_by_name(times: Sequence[str], readings: Sequence[str]) -> dict[str, list[str]] | None:
    """Return the heads that each column of times stamps, by the words in their names.

    Returns
    -------
    dict of str to list of str, or None
        None if a column fits no clock or several, or a clock has no column.
    """
    common = shared_words(times)
    labels = {time: words_of_head(time) - common for time in times}
    stamped: dict[str, list[str]] = {time: [] for time in times}
    for head in readings:
        matching = [
            time for time, label in labels.items() if label and label <= words_of_head(head)
        ]
        if len(matching) != 1:
            return None
        stamped[matching[0]].append(head)
    return stamped if all(stamped.values()) else None


def _columns_by_position(times: Sequence[str], heads: Sequence[str]) -> dict[str, list[str]] | None:
    """Return the heads that each column of times stamps, by the order of the columns.

    Returns
    -------
    dict of str to list of str, or None
        None if no column of times comes first or last, or a clock has no column.
    """
    in_order = heads if heads[0] in times else heads[::-1]
    if in_order[0] not in times:
        return None
    stamped: dict[str, list[str]] = {}
    current = in_order[0]
    for head in in_order:
        if head in times:
            current = head
            stamped[current] = []
        else:
            stamped[current].append(head)
    if not all(stamped.values()):
        return None
    # each list in the order of the table, although the columns may have been read backwards
    in_table_order: dict[str, list[str]] = {}
    for time, members in stamped.items():
        in_table_order[time] = [head for head in heads if head in members]
    return in_table_order
