"""Tables with several columns of times: which other columns were read at which of these times."""

from collections.abc import Sequence
from typing import NamedTuple

from discrepancy.campaign.columns import LEFT_OUT, LaboratoryColumn
from discrepancy.campaign.heads import shared_words, words_of_head
from discrepancy.errors import CampaignFileError
from reporting.words import listing

TIME = "time"


class TableClock(NamedTuple):
    """A column of times, and the columns whose readings were taken at these times."""

    times: LaboratoryColumn
    columns: tuple[LaboratoryColumn, ...]


def find_clocks(columns: Sequence[LaboratoryColumn]) -> tuple[TableClock, ...]:
    """Return each time column of a table with the reading columns that were read at its times.

    The names of the columns show it, as in `acc2` and `time2`, or their order: every time column
    stands before its reading columns, or every one stands after them. If names and order both show
    it, they must agree. Reading columns that are left out count for the order, but are not
    returned, and neither is a time column to which no reading column belongs.

    Parameters
    ----------
    columns : sequence of LaboratoryColumn
        Columns of one table, in its order.

    Raises
    ------
    CampaignFileError
        If neither names nor order show it, or if they contradict each other.
    """
    times = [column.head for column in columns if column.role == TIME]
    readings = [column.head for column in columns if column.role != TIME]
    by_name = _columns_by_name(times, readings)
    by_position = _columns_by_position(times, [column.head for column in columns])
    contradict = by_name is not None and by_position is not None and by_name != by_position
    stamped_heads = by_position if by_name is None else by_name
    if stamped_heads is None or contradict:
        reason = "neither the names nor the places of the columns show it"
        if contradict:
            reason = "names and places contradict each other"
        raise CampaignFileError(
            f"{columns[0].sheet.name} has the times {listing(map(repr, times))}, and which column "
            f"has which is not clear ({reason}): put each column of times before its columns, or "
            "leave all but one out with --column NAME=-."
        )
    used_columns = {column.head: column for column in columns if column.role != LEFT_OUT}
    clocks = []
    for time in times:
        stamped = tuple(used_columns[head] for head in stamped_heads[time] if head in used_columns)
        if stamped:
            clocks.append(TableClock(used_columns[time], stamped))
    return tuple(clocks)


def _columns_by_name(times: Sequence[str], readings: Sequence[str]) -> dict[str, list[str]] | None:
    """Assign columns of readings to columns of times, by the words that their names share.

    Words that all columns of times have in common, such as "time", do not count.

    Returns
    -------
    dict of str to list of str, or None
        For each column of times the names of the columns that were read at these times. None if a
        column of readings fits no column of times or several, or if a column of times gets none.
    """
    common_words = shared_words(times)
    labels = {time: words_of_head(time) - common_words for time in times}
    stamped: dict[str, list[str]] = {time: [] for time in times}
    for head in readings:
        matching_times = [
            time for time, label in labels.items() if label and label <= words_of_head(head)
        ]
        if len(matching_times) != 1:
            return None
        stamped[matching_times[0]].append(head)
    return stamped if all(stamped.values()) else None


def _columns_by_position(
    time_columns: Sequence[str], all_columns: Sequence[str]
) -> dict[str, list[str]] | None:
    """Assign columns of readings to columns of times, by the order of the columns in a table.

    Either each column of times stands before the columns of its readings, or each stands after
    them.

    Parameters
    ----------
    time_columns : sequence of str
        The names of the columns of times.
    all_columns : sequence of str
        The names of all columns, in the order of the table.

    Returns
    -------
    dict of str to list of str, or None
        For each column of times the names of the columns that were read at these times. None if
        neither the first nor the last column of the table has times, or if a column of times has
        no columns of readings.
    """
    # If times stand after their readings, the table is read backwards.
    in_reading_order = all_columns if all_columns[0] in time_columns else all_columns[::-1]
    if in_reading_order[0] not in time_columns:
        return None
    stamped: dict[str, list[str]] = {}
    current_time_column = in_reading_order[0]
    for column in in_reading_order:
        if column in time_columns:
            current_time_column = column
            stamped[current_time_column] = []
        else:
            stamped[current_time_column].append(column)
    if not all(stamped.values()):
        return None
    # The columns of readings are returned in the order of the table, even if it was read backwards.
    in_table_order: dict[str, list[str]] = {}
    for time_column, stamped_columns in stamped.items():
        in_table_order[time_column] = [
            column for column in all_columns if column in stamped_columns
        ]
    return in_table_order
