"""Cells of a laboratory's table: numbers with either decimal mark, and what is a value."""

import re
from collections.abc import Sequence

from discrepancy.campaign.clock_cells import is_time
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
"""Patterns of numbers by decimal mark: with groups of three digits, or with an exponent."""
_PLAIN = re.compile(r"[+-]?\d*[.,]?\d+(?:[eE][+-]?\d+)?", re.ASCII)
"""Simple numbers, which most cells contain; this pattern is faster."""
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
    """Return the number in a cell as a text for `float`; None if the cell holds anything else.

    True and false are the numbers 1 and 0. Marks between groups of three digits are removed. An
    `ExactNumber` has a decimal point whatever the mark.

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
    """Return whether a cell holds a number, with either decimal mark, a date or a time."""
    if _PLAIN.fullmatch(cell) or any(plain_number(cell, mark) for mark in _NUMBERS):
        return True
    return is_time(cell)


def decimal_mark(
    columns: Sequence[Sequence[str]], lines: Sequence[int], place: str, separator: str
) -> tuple[str | None, str]:
    """Return the decimal mark of a table.

    A number such as 1.5 or 1.234.567 can be read with one mark only, and decides. If no number
    does, the mark is a point: if no number has a mark, or if cells are separated by commas and the
    first unclear number has none.

    Parameters
    ----------
    columns : sequence of sequence of str
        Cells (N,) of each column.
    lines : sequence of int
        The line of the file for each row (N,).
    place : str
        The name of the file and what its rows are called, for messages.
    separator : str
        The character between two cells.

    Returns
    -------
    mark : str or None
        The decimal mark; None if all numbers with a mark can be read in two ways, as 1,234 can.
    unclear : str
        The first number that can be read in two ways, and its line; empty if there is none.

    Raises
    ------
    CampaignFileError
        If decimals are written with a point in one cell, and with a comma in another.
    """
    examples: dict[str, str] = {}  # the first number of each mark, for the message
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
