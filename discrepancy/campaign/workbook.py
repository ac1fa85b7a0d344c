"""Workbooks of Excel: the cells of their sheets as text, with stamps to the microsecond."""

import io
import warnings
from collections.abc import Mapping, Set
from datetime import date, datetime, time, timedelta
from decimal import Decimal
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from discrepancy.campaign.cells import ExactNumber
from discrepancy.campaign.head_rows import Rows
from discrepancy.campaign.number_formats import shown_number
from discrepancy.errors import CampaignFileError
from reporting.words import counted, is_or_are, one_line

ALL_SHEETS = "all"
"""What stands for all sheets of a workbook in `FILE.xlsx#all`, unless a sheet is called so."""
_MICROSECONDS_OF_DAY = 86_400_000_000
_DAYS_OF_YEAR = 366


class WorkbookSheet(NamedTuple):
    """The filled rows of a sheet, and the names of cells such as `B7` stored without a value."""

    rows: Rows
    blank_cells: Set[str]


def read_workbook(path: Path) -> dict[str, WorkbookSheet]:
    """Return the sheets of a workbook by title.

    Rows whose cells are all empty are left out. `blank_cells` are cells that the file stores
    without any value, which may be formulas that were never computed.

    Raises
    ------
    CampaignFileError
        If the workbook cannot be read.
    """
    try:
        from openpyxl import load_workbook
    except ImportError:
        raise CampaignFileError(
            "Excel files need openpyxl: pip install 'uav-twin[xlsx]'."
        ) from None
    sheets: dict[str, WorkbookSheet] = {}
    try:
        with warnings.catch_warnings(action="ignore"):
            book = load_workbook(io.BytesIO(path.read_bytes()), read_only=True, data_only=True)
            # Without formats of dates, openpyxl returns times as serial day numbers. Its own
            # conversion rounds them to milliseconds.
            book._date_formats = frozenset()
            for sheet in book.worksheets:
                sheet.reset_dimensions()  # those in the file may be wrong
                rows = []
                blank_cells: set[str] = set()
                for line, row in enumerate(sheet.iter_rows(), start=1):
                    cells = [_excel_text(cell, book.epoch) for cell in row]
                    if any(cells):
                        rows.append((line, cells))
                    blank_cells.update(cell.coordinate for cell in row if _has_no_value(cell))
                sheets[sheet.title] = WorkbookSheet(rows, blank_cells)
            book.close()
    except Exception as cause:  # openpyxl raises almost any error for damaged files
        raise CampaignFileError(
            f"{path} cannot be read as an Excel workbook ({one_line(cause)}): save it again, or "
            "save it as CSV."
        ) from cause
    return sheets


def title_of_sheet(file: Path, stated_title: str, workbook: Mapping[str, WorkbookSheet]) -> str:
    """Return the title of the sheet to read: that which the user names, or the only filled one.

    Parameters
    ----------
    file : Path
        The workbook, for messages.
    stated_title : str
        The title that the user names, or an empty text.
    workbook : mapping of str to WorkbookSheet
        The sheets by title.

    Raises
    ------
    CampaignFileError
        If all sheets are empty, the workbook does not have that sheet, or the user names none and
        several are filled.
    """
    filled = [title for title, sheet in workbook.items() if sheet.rows]
    if not filled:
        raise CampaignFileError(f"{file.name} is an empty workbook: no sheet has a filled cell.")
    is_clear = stated_title in workbook if stated_title else len(filled) == 1
    if not is_clear:
        raise CampaignFileError(
            f"{file.name} has the sheets {', '.join(filled)}: say which as "
            f"{file.name}#SHEET, or import all as {file.name}#{ALL_SHEETS}."
        )
    return stated_title or filled[0]


def _has_no_value(cell: Any) -> bool:
    """Return whether a cell that the workbook stores has no value, not even an empty text."""
    return cell.value is None and cell.data_type != "str" and hasattr(cell, "coordinate")


def refuse_formulas_among(blank_cells: Set[str], path: Path, title: str) -> None:
    """Raise an error if one of the cells without a value holds a formula.

    Programs that write formulas without computing them store no values.

    Parameters
    ----------
    blank_cells : set of str
        The names of the cells without a value, such as `B7`.
    path : Path
        The workbook.
    title : str
        The title of the sheet.

    Raises
    ------
    CampaignFileError
        If one of the cells holds a formula.
    """
    from openpyxl import load_workbook

    formulas = []  # the file is read again: `data_only` returned values instead of formulas
    with warnings.catch_warnings(action="ignore"):
        book = load_workbook(io.BytesIO(path.read_bytes()), read_only=True)
        book[title].reset_dimensions()
        for row in book[title].iter_rows():
            formulas += [cell.coordinate for cell in row if cell.data_type == "f"]
        book.close()
    without_value = [cell for cell in formulas if cell in blank_cells]
    if without_value:
        raise CampaignFileError(
            f"{path.name}, sheet {title}: {len(without_value)} of "
            f"{counted(len(formulas), 'formula')} {is_or_are(len(without_value))} without a value, "
            f"first in {without_value[0]}: open the workbook in Excel or LibreOffice and save it."
        )


def _excel_text(cell: Any, epoch: datetime) -> str:
    """Return the text of a cell of a workbook; times are written in ISO format."""
    value = cell.value
    if value is None:
        return ""
    if isinstance(value, datetime | date | time):
        return value.isoformat()
    if isinstance(value, int | float) and not isinstance(value, bool):
        if _is_format_of_times(cell.number_format):
            return _time_of_serial_number(value, cell.number_format, epoch)
        return shown_number(value, cell.number_format)
    return str(value).strip()


@cache
def _is_format_of_times(number_format: str) -> bool:
    """Return whether Excel shows a number in this format as a date or a time."""
    from openpyxl.styles.numbers import is_date_format

    return bool(is_date_format(number_format))


def _time_of_serial_number(days: float, number_format: str, epoch: datetime) -> str:
    """Return the text of a time that Excel stores as a number of days, to the microsecond.

    A number below 366, or with a format of elapsed time, becomes hours, minutes and seconds, with
    hours that may exceed 24. Any other number becomes a date with a time, even if its format shows
    only one of them. A negative number, or one beyond the calendar, stays a number.

    A floating-point number of days since 1900 has an error of up to a microsecond. At usual
    sampling rates, times are multiples of 25 microseconds; a date within a microsecond of such a
    multiple is set to it.
    """
    from openpyxl.styles.numbers import is_timedelta_format

    if days < 0:
        return ExactNumber(repr(days))
    microseconds = round(Decimal(days) * _MICROSECONDS_OF_DAY)
    is_elapsed_time = days < _DAYS_OF_YEAR or is_timedelta_format(number_format)
    if not is_elapsed_time:
        even_microseconds = 25 * round(microseconds / 25)
        if abs(microseconds - even_microseconds) <= 1:
            microseconds = even_microseconds
        try:
            return (epoch + timedelta(microseconds=microseconds)).isoformat()
        except OverflowError:
            return ExactNumber(repr(days))
    seconds, microsecond = divmod(microseconds, 1_000_000)
    fraction = f".{microsecond:06}" if microsecond else ""
    return f"{seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02}{fraction}"
