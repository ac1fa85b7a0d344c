"""The table among the rows of a laboratory's file: its head, its units and its body."""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from discrepancy.campaign.cells import is_value
from discrepancy.campaign.clock_cells import is_time
from discrepancy.campaign.head_rows import Rows, find_head_rows
from discrepancy.campaign.heads import split_head, time_heads
from discrepancy.campaign.lost_readings import places_of_readings
from discrepancy.errors import CampaignFileError
from reporting.formats.toml_file import short_repr
from reporting.words import counted, listing

SEPARATORS = {"\t": "tabs", ";": "semicolons", ",": "commas"}
"""Characters that separate cells, and their names in messages."""


def _is_single_column(rows: Rows) -> bool:
    """Return whether rows with one cell each are a single column of numbers below a title.

    Most cells from the first number on must be numbers. The rows are not a column if their cells
    contain blanks or another separator, and thus probably several numbers.
    """
    has_further_cells = any(any(row[1:]) for _, row in rows)
    if has_further_cells:
        return False
    cells = [row[0] for _, row in rows]
    first_number = next((index for index, cell in enumerate(cells) if is_value(cell)), None)
    if first_number is None or first_number == 0:  # no numbers, or no title above them
        return False
    title = cells[first_number - 1]
    cells_below_title = cells[first_number:]
    numbers = [cell for cell in cells_below_title if is_value(cell)]
    most_are_numbers = 2 * len(numbers) > len(cells_below_title)
    return most_are_numbers and not _hold_several_numbers(title, numbers)


def _hold_several_numbers(title: str, cells: Sequence[str]) -> bool:
    """Return whether cells contain blanks, or a separator that is also in the title above them.

    The blank between the date and the time of a clock separates no numbers.
    """
    for cell in cells:
        if " " in cell and not is_time(cell):
            return True
    text = " ".join(cells)
    return any(separator in title and separator in text for separator in SEPARATORS)


def _rows_of_longer_clocks(
    rows: Rows,
    first_index: int,
    head: Sequence[str],
    units: Sequence[str],
    places_of_values: Sequence[set[int]],
) -> list[int]:
    """Return the indices of rows below a table's body that continue its longer columns of times.

    A table may have several columns of times, each with the columns that were sampled at them, and
    these groups may differ in length. The body of the table ends with its first core column (see
    `find_table`). If that column is one of the shorter ones, rows of the longer ones follow. These
    rows end at the first row that has no time, or that has a text that is not a number.

    Parameters
    ----------
    rows : list of (int, list of str)
        The rows of the file below the table: the number of the line, and its cells.
    first_index : int
        The index of the first of these rows among all rows of the file.
    head, units : sequence of str
        The heads and units of the table.
    places_of_values : sequence of set of int
        The indices of the cells with numbers or times in each row of the file.

    Returns
    -------
    list of int
        Indices among all rows of the file; empty if the table has fewer than two columns of times.
    """
    names = []
    units_of_names = []
    for title, unit in zip(head, units, strict=False):  # a row of units may be shorter
        name, unit_of_name = split_head(title, unit)
        names.append(name)
        units_of_names.append(unit_of_name)
    times = time_heads(names, units_of_names)
    time_columns = {column for column, name in enumerate(names) if name in times}
    if len(time_columns) < 2:
        return []
    further_rows: list[int] = []
    for index, (_, row) in enumerate(rows, start=first_index):
        filled_columns = {column for column, cell in enumerate(row) if cell}
        has_other_texts = bool(filled_columns - places_of_values[index])
        if not filled_columns & time_columns or has_other_texts:
            break
        further_rows.append(index)
    return further_rows


class TableLayout(NamedTuple):
    """The table among the rows of a file.

    Attributes
    ----------
    head : list of str
        Heads (C,) of its columns.
    units : list of str
        Units (C,) from a row of units; empty where there is none.
    body : list of (int, list of str)
        Rows of numbers, with their line.
    remark : str
        The remark on the rows below it that are left out.
    """

    head: list[str]
    units: list[str]
    body: Rows
    remark: str


def find_table(rows: Rows, name: str, place: str) -> TableLayout:
    """Return the table among the rows of a file: its head, perhaps a row of units, and its body.

    The columns that have a number in at least half of the rows with numbers are the core of the
    table. A row has readings if it has a number in the first core column and no text in any core
    column. The body goes from the first such row to the last one, and on for longer columns of
    times (see `_rows_of_longer_clocks`). Within it, rows without numbers or with a text in a core
    column are left out.

    Parameters
    ----------
    rows : list of (int, list of str)
        Rows of the file that are not empty.
    name : str
        The name of the file, for messages.
    place : str
        The start of the place of a row, for messages, before its number.

    Raises
    ------
    CampaignFileError
        If there is no table, its columns have no names, or there are numbers that do not fit into
        it.
    """
    places_of_values = places_of_readings(rows)  # for each row, the indices of its values
    core = _core_columns(rows, places_of_values)
    has_text = [  # in a core column, for each row
        any(index not in values and index < len(row) and row[index] for index in core)
        for (_, row), values in zip(rows, places_of_values, strict=True)
    ]
    body = []  # indices of rows
    if core:
        body = [
            index
            for index, values in enumerate(places_of_values)
            if not has_text[index] and core[0] in values
        ]
    if not body or body[0] == 0:
        raise CampaignFileError(
            f"{name} holds no table: a row with the names of the columns is needed, and rows of "
            "numbers under it, with commas, semicolons or tabs between cells."
        )
    # between these rows, those with numbers in other columns alone belong to the table as well
    first_row, last_row = body[0], body[-1]
    body = [
        index
        for index in range(first_row, last_row + 1)
        if not has_text[index] and places_of_values[index]
    ]
    head, units = find_head_rows(rows, first_row)
    body += _rows_of_longer_clocks(
        rows[last_row + 1 :], last_row + 1, head, units, places_of_values
    )
    last_row = body[-1]

    width = 0  # number of columns up to the last filled one
    for index in body:
        width = max(width, *(column + 1 for column, cell in enumerate(rows[index][1]) if cell))
    _check_head_is_no_reading(rows, first_row, core, places_of_values, place)
    named_width = len(head)  # the message names the first row that is wider than the head
    first_wide_row = next(
        (index for index in sorted(body) if any(rows[index][1][named_width:])), first_row
    )
    _check_names(head, width, f"{place} {rows[first_wide_row][0]}")
    _check_other_rows(rows, body, core, places_of_values, head[core[0]], place)
    if width == 1:
        _check_no_empty_lines(rows, body, place)
    lines_below = [line for line, _ in rows[last_row + 1 :]]
    remark = f"; everything from {lines_below[0]} on is left out" if lines_below else ""
    names = [cell.lstrip("# ") for cell in head[:width]]
    padded_units = [*units, *[""] * width][:width]
    return TableLayout(names, padded_units, [rows[index] for index in body], remark)


def _core_columns(rows: Rows, places_of_values: Sequence[set[int]]) -> list[int]:
    """Return the indices of the columns with a number in at least half of the rows of numbers.

    Rows with a single number are not counted, unless the file is a single column.
    """
    rows_of_values = [values for values in places_of_values if len(values) > 1]
    if not rows_of_values and _is_single_column(rows):
        rows_of_values = [values for values in places_of_values if values]
    row_counts = Counter(column for values in rows_of_values for column in values)
    core_columns = []
    for column, row_count in row_counts.items():
        is_in_half_of_rows = 2 * row_count >= len(rows_of_values)
        if is_in_half_of_rows:
            core_columns.append(column)
    return sorted(core_columns)


def _check_head_is_no_reading(
    rows: Rows,
    first_row: int,
    core: Sequence[int],
    places_of_values: Sequence[set[int]],
    place: str,
) -> None:
    """Raise an error if rows just above the table are readings, of which some cells are texts.

    Such a row would be taken for the row of names. A row counts as readings if it has a number in
    the first core column and in at least half of the core columns.
    """
    first_reading = first_row
    for index in range(first_row - 1, -1, -1):
        values = places_of_values[index]
        if core[0] not in values or 2 * len(values & {*core}) < len(core):
            break
        first_reading = index
    if first_reading < first_row:
        line, row = rows[first_reading]
        cells = short_repr(listing(filter(None, row)))
        raise CampaignFileError(
            f"{place} {line}: the names of columns or numbers alone are expected, but the line has "
            f"{cells}; leave the cell of a reading empty if it shall be left out."
        )


def _check_names(head: Sequence[str], width: int, place: str) -> None:
    """Raise an error if the head is shorter than the table, or names at most half of its columns.

    `width` is the number of columns of the table.
    """
    named_columns = sum(map(bool, head))
    if 2 * named_columns <= width or len(head) < width:
        raise CampaignFileError(
            f"{place}: the rows have {counted(width, 'cell')}, but the row above names "
            f"{counted(named_columns, 'column')}: each column needs a name, and a decimal comma "
            "splits a number between commas into two cells."
        )


def _check_other_rows(
    rows: Rows,
    body: Sequence[int],
    core: Sequence[int],
    places_of_values: Sequence[set[int]],
    name: str,
    place: str,
) -> None:
    """Raise an error for a row with texts within the table, and for a row of numbers below it.

    A row below the table is a row of numbers if it has one in the first core column, and numbers in
    two core columns or in half of them; other rows are a footer. Comments, which begin with `#`,
    and repeated heads are allowed everywhere.
    """
    first_row, last_row = body[0], body[-1]
    other_rows = {*range(first_row, last_row)} - {*body}
    for index in range(last_row + 1, len(rows)):
        values = places_of_values[index]
        core_values = len(values & {*core})
        has_several = core_values > 1 or 2 * core_values >= len(core)
        is_row_of_numbers = core[0] in values and has_several
        if is_row_of_numbers:
            other_rows.add(index)
    head_rows = [row for _, row in rows[:first_row]]
    for index in sorted(other_rows):
        line, row = rows[index]
        if row in head_rows or row[0].startswith("#"):
            continue
        cells = short_repr(listing(filter(None, row)))
        raise CampaignFileError(
            f"{place} {line}: numbers are expected under {name!r} and the other names, "
            f"but the line has {cells}; leave the cell of a reading empty if it shall be left out, "
            "and remove lines that do not belong to the table."
        )


def _check_no_empty_lines(rows: Rows, body: Sequence[int], place: str) -> None:
    """Raise an error if a single column has an empty line, where a reading may be missing."""
    for index in body[1:]:
        line, previous_line = rows[index][0], rows[index - 1][0]
        if line != previous_line + 1:
            raise CampaignFileError(
                f"{place} {line - 1} is empty, and the only column has numbers above and below: "
                "remove the line, or give the table a column of times."
            )
