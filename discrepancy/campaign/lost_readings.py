"""Texts that programs and loggers write in the place of a reading: NaN, and overloads."""

import re
from collections.abc import Sequence

from discrepancy.campaign.cells import is_value
from discrepancy.campaign.head_rows import Rows
from discrepancy.campaign.wild_readings import places_text
from discrepancy.errors import CampaignFileError

_NOT_A_NUMBER = re.compile(
    r"[+-]?(?:nan(?:\(\w*\))?|1[.,]#(?:QNAN|SNAN|IND|INF)\d*|inf(?:inity)?|#(?:N/A|NV|DIV/0!))",
    re.IGNORECASE | re.ASCII,
)
"""What programs write for no number, Excel among them."""
_OVERLOAD = re.compile(
    r"[<>+-]{0,2} ?(?:[O0]\.?L\.?|OVLD?|OVR|OV(?:ER)?[ _-]?(?:LOAD|FLOW|RANGE|RNG)?)"
    r"|[<>+-]{0,2} ?OVR?FL(?:OW|W)?|OVER ?[+-]|\+{2,}|-{2,}|BURN[ -]?OUT"
    r"|(?:UEBER|ÜBER)(?:LAUF|LAST)",
    re.IGNORECASE,
)
"""What loggers and multimeters show for more than they can measure."""


def _is_not_a_number(cell: str) -> bool:
    """Return whether a cell says that there is no number, such as NaN."""
    return _NOT_A_NUMBER.fullmatch(cell) is not None


def _is_overload(cell: str) -> bool:
    """Return whether a cell says that a sensor or logger was beyond its range, such as OVL."""
    return _OVERLOAD.fullmatch(cell) is not None


def places_of_readings(rows: Rows) -> list[set[int]]:
    """Return the indices of the cells of each row that hold a reading or say that it is lost.

    A reading is a number or a time. An overload counts beside and below numbers only: elsewhere it
    is the text of a head, or a line of dashes.
    """
    places = []
    columns_with_numbers: set[int] = set()
    for _, row in rows:
        numbers = {index for index, cell in enumerate(row) if is_value(cell)}
        columns_with_numbers |= numbers
        lost = set()
        for index, cell in enumerate(row):
            is_below_number = index in columns_with_numbers and index not in numbers
            if _is_not_a_number(cell) or (numbers and is_below_number and _is_overload(cell)):
                lost.add(index)
        places.append(numbers | lost)
    return places


def leave_out_lost_readings(
    columns: Sequence[tuple[str, ...]],
    titles: Sequence[str],
    lines: Sequence[int],
    name: str,
    unit_of_place: str,
) -> tuple[list[tuple[str, ...]], str]:
    """Return the columns of a table with empty cells for NaN and for overloads at their ends.

    Other texts stay. The remark names both.

    Parameters
    ----------
    columns : sequence of tuple of str
        Cells (N,) of each column.
    titles : sequence of str
        The heads of the columns, for messages.
    lines : sequence of int
        The line of the file for each row.
    name : str
        The name of the file, for messages.
    unit_of_place : str
        What the rows are called in messages: "line" or "row".

    Returns
    -------
    columns : list of tuple of str
        The cells (N,). A column without a number, or with an overload above its first number, keeps
        its overloads.
    remark : str
        The remark on what was left out; empty if nothing was.

    Raises
    ------
    CampaignFileError
        If a number follows an overload in a column.
    """
    remark = ""
    cleaned_columns = []
    for cells, title in zip(columns, titles, strict=True):
        are_values = [is_value(cell) for cell in cells]
        number_rows = [row for row, holds_value in enumerate(are_values) if holds_value]
        text_rows = [row for row, cell in enumerate(cells) if cell and not are_values[row]]
        lost_rows = [row for row in text_rows if _is_not_a_number(cells[row])]
        overload_rows = [row for row in text_rows if _is_overload(cells[row])]
        cleaned_cells = list(cells)
        # "NaN" and the like, anywhere in the column
        if lost_rows:
            for row in lost_rows:
                cleaned_cells[row] = ""
            places = places_text(unit_of_place, [lines[row] for row in lost_rows])
            remark += f"; {title!r} has {cells[lost_rows[0]]} in {places}"
        # overloads below the first number: from there on the column has no readings
        if number_rows and overload_rows and overload_rows[0] > number_rows[0]:
            first_row = overload_rows[0]
            cell, line = cells[first_row], lines[first_row]
            if first_row < number_rows[-1]:
                raise CampaignFileError(
                    f"{name}, {unit_of_place} {line}: numbers are expected under {title!r}, but "
                    f"{cell!r} is an overload, after which a sensor may have another zero: leave "
                    "its cell empty if the readings below it shall be used."
                )
            for row in overload_rows:
                cleaned_cells[row] = ""
            remark += f"; {title!r} has {cell} from {unit_of_place} {line} on and ends there"
        cleaned_columns.append(tuple(cleaned_cells))
    return cleaned_columns, remark
