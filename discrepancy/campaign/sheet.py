"""A laboratory's table as a programme saved it: head, units and rows are found without guessing.

The separator of cells is the one that makes the table with most numbers. This is right for all of
600 tables with titles, decimal commas and grouped digits; CleverCSV is right for 594 (and silently
wrong for the others), `csv.Sniffer` for 228.
"""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from discrepancy.campaign.cells import (
    LOGICAL,
    ExactNumber,
    decimal_mark,
    is_value,
    plain_number,
)
from discrepancy.campaign.clock_cells import (
    is_column_of_dates,
    is_unclear_date,
    join_dates_with_times,
    possible_date_orders,
    seconds_of_clock_times,
)
from discrepancy.campaign.head_rows import NO_READINGS, Rows
from discrepancy.campaign.heads import split_head
from discrepancy.campaign.lost_readings import leave_out_lost_readings
from discrepancy.campaign.matlab_file import read_matlab
from discrepancy.campaign.number_formats import unit_beside_number_formats
from discrepancy.campaign.table_layout import SEPARATORS, TableLayout, find_table
from discrepancy.campaign.wild_readings import LEAST_LOST_VALUE, without_fill_values
from discrepancy.campaign.workbook import (
    ALL_SHEETS,
    WorkbookSheet,
    read_workbook,
    refuse_formulas_among,
    title_of_sheet,
)
from discrepancy.errors import CampaignFileError
from reporting.files import hash_file
from reporting.text_file import read_bytes, read_text
from reporting.words import counted, one_line

MATLAB = ".mat"
EXCEL = (".xlsx", ".xlsm")
OTHER_FORMATS = {
    ".xls": ("an Excel file in the format before 2007", "save it as .xlsx or as CSV"),
    ".ods": ("an OpenDocument spreadsheet", "save it as .xlsx or as CSV"),
    ".tdms": (
        "a LabVIEW TDMS file",
        "export it as text, or with npTDMS: tdms_file.as_dataframe().to_csv('FILE.csv')",
    ),
    ".uff": (
        "a universal file",
        "export its records as text, or read them with pyuff and write a CSV file",
    ),
    ".unv": (
        "a universal file",
        "export its records as text, or read them with pyuff and write a CSV file",
    ),
}
"""Formats that are not read, by their ending: what they are, and how a table comes out of them."""
_ZIP = b"PK"
_COMPOUND_FILE = bytes.fromhex("d0cf11e0a1b11ae1")
"""First bytes of Excel files of before 2007, and of encrypted ones of any year."""
_LINES_FOR_SEPARATOR = 500
"""Number of first lines by which the separator is chosen."""


@dataclass(frozen=True)
class Sheet:
    """One table.

    Attributes
    ----------
    name, digest : str
        The name of the file (for an Excel workbook with that of the sheet, if it was stated), and
        its SHA-256.
    heads, units : tuple of str
        The heads and units of the columns with numbers; a unit is empty if the file does not state
        it.
    columns : tuple of tuple of str
        The cells of each column as in the file; clock times are converted to seconds since the
        first row.
    lines : tuple of int
        The number of the line or row of the file for each row of the table.
    decimal : str or None
        Decimal mark; None if numbers can be read in two ways.
    unclear : str
        A number that can be read in two ways, and its line; empty if there is none.
    remark : str
        How the table was found: its lines, the separator of cells, and what was left out.
    unclear_date : str
        A date that can be read in two ways, and its line; empty if that makes no difference.
    month_first : Sheet or None
        The same table if the month comes first in its dates; None unless there is an unclear date.
    """

    name: str
    digest: str
    heads: tuple[str, ...]
    units: tuple[str, ...]
    columns: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    decimal: str | None
    unclear: str
    remark: str
    unclear_date: str = ""
    month_first: "Sheet | None" = None

    def numbers(self, head: str, decimal: str) -> tuple[str, ...]:
        """Return the cells of a column with a decimal point and without grouped digits.

        A number of `LEAST_LOST_VALUE` or more stands for no reading and becomes an empty cell. A
        cell that is no number is returned as it is.

        Parameters
        ----------
        head : str
            The name of the column as printed at its head.
        decimal : str
            The decimal mark of its cells.
        """
        column = self.heads.index(head)
        numbers = []
        for cell in self.columns[column]:
            number = plain_number(cell, decimal) if cell else None
            if number is not None and abs(float(number)) >= LEAST_LOST_VALUE:
                numbers.append("")
                continue
            numbers.append(number or cell)
        return tuple(numbers)


def read_sheets(path: Path) -> list[Sheet]:
    """Read all tables of a file: one, or for `FILE.xlsx#all` one for each sheet of the workbook.

    Sheets without a number, such as notes, are left out. The remark of the first table names them.

    Raises
    ------
    CampaignFileError
        For the causes of `read_sheet`, or if `FILE.xlsx#all` has no sheet with a number.
    """
    file, sheet_name = _file_and_sheet(path)
    if sheet_name != ALL_SHEETS or _ending_by_content(file) not in EXCEL:
        return [read_sheet(path)]
    workbook = read_workbook(file)
    if ALL_SHEETS in workbook:  # a sheet that has the name `all`
        return [_table_of_workbook(path.name, file, ALL_SHEETS, workbook)]
    sheets = []
    left_out = ""
    for title, content in workbook.items():
        if any(any(map(is_value, cells)) for _, cells in content.rows):
            sheets.append(_table_of_workbook(f"{file.name}#{title}", file, title, workbook))
        elif content.rows:
            left_out += f"; the sheet {title!r} holds no numbers and is left out"
    if not sheets:
        raise CampaignFileError(f"{file.name} holds no table: no sheet has a number.")
    return [replace(sheets[0], remark=f"{sheets[0].remark}{left_out}"), *sheets[1:]]


def read_sheet(path: Path) -> Sheet:
    """Return the table in a text file, an Excel workbook or a MATLAB file.

    Parameters
    ----------
    path : path
        The file; `FILE.xlsx#SHEET` for a workbook with several sheets.

    Raises
    ------
    CampaignFileError
        If the file cannot be read or holds no table with a head; if a row has a text where a number
        is expected, if decimals are written in two ways, or if a time cannot be read or can be read
        in two ways.
    """
    file, sheet_name = _file_and_sheet(path)
    ending = _ending_by_content(file)
    if ending in OTHER_FORMATS:
        format_name, remedy = OTHER_FORMATS[ending]
        raise CampaignFileError(f"{file.name} is {format_name}, which is not read: {remedy}.")
    if ending == MATLAB:
        return _without_fill_values(_matlab_sheet(file), "row")
    if ending in EXCEL:
        workbook = read_workbook(file)
        title = title_of_sheet(file, sheet_name, workbook)
        return _table_of_workbook(path.name, file, title, workbook)
    rows, separator = _text_rows(file)
    sheet = _sheet_of_rows(path.name, file, rows, unit_of_place="line", separator=separator)
    return _without_fill_values(sheet, "line")


def _table_of_workbook(
    name: str, file: Path, title: str, workbook: Mapping[str, WorkbookSheet]
) -> Sheet:
    """Return the table in a sheet of a workbook.

    Raises `CampaignFileError` if the table has formulas without a stored value.
    """
    rows, blank_cells = workbook[title]
    if blank_cells:
        refuse_formulas_among(blank_cells, file, title)
    sheet = _sheet_of_rows(name, file, rows, unit_of_place="row", separator="")
    return _without_fill_values(sheet, "row")


def _without_fill_values(sheet: Sheet, unit_of_place: str) -> Sheet:
    """Replace the fill values of a table, such as -999, by empty cells.

    The remark of the returned table names them, and also other wild readings, which stay. A table
    whose numbers can be read in two ways is returned as it is. `unit_of_place` is the word for a
    row in the remark, "line" or "row".
    """
    if sheet.decimal is None:
        return sheet
    month_first = sheet.month_first
    if month_first is not None:
        month_first = _without_fill_values(month_first, unit_of_place)
    columns = []
    remark = sheet.remark
    for head, cells in zip(sheet.heads, sheet.columns, strict=True):
        numbers = sheet.numbers(head, sheet.decimal)
        column = without_fill_values(cells, numbers, sheet.lines, head, unit_of_place)
        columns.append(column.cells)
        remark += "".join(f"; {clause} and left out" for clause in column.fill_values)
        remark += "".join(f"; {clause}" for clause in column.unsupported)
    return replace(sheet, columns=tuple(columns), remark=remark, month_first=month_first)


def _file_and_sheet(path: Path) -> tuple[Path, str]:
    """Split `FILE#SHEET` at the last `#` that leaves the name of an existing file.

    Both names may hold a `#`; without a sheet its name is empty.
    """
    file, sheet_name = path, ""
    while not file.exists() and "#" in file.name:
        name, _, end = file.name.rpartition("#")
        sheet_name = f"{end}#{sheet_name}" if sheet_name else end
        file = path.with_name(name)
    return file, sheet_name


def _ending_by_content(file: Path) -> str:
    """Return the ending of a file's name, or for a workbook the ending that fits its content.

    Raises
    ------
    CampaignFileError
        If the workbook is encrypted.
    """
    ending = file.suffix.lower()
    if ending not in (".xls", *EXCEL) or not file.exists():
        return ending
    content = read_bytes(file, CampaignFileError)
    if content.startswith(_ZIP):
        return EXCEL[0]
    if not content.startswith(_COMPOUND_FILE):
        return ending
    if "EncryptedPackage".encode("utf-16-le") in content:
        raise CampaignFileError(
            f"{file.name} is encrypted: save it without a password, or save its table as CSV."
        )
    return ".xls"


def _sheet_of_rows(
    name: str, file: Path, rows: Rows, *, unit_of_place: str, separator: str
) -> Sheet:
    """Return the table among the rows of a file, with the days of its dates first if unclear.

    If some dates can be read with the month first as well, and its times then differ, the result
    holds that second reading as `month_first`, and the first such date as `unclear_date`.

    Parameters
    ----------
    name : str
        The name of the table, for messages.
    file : path
        The file that the rows are from.
    rows : list of (int, list of str)
        Rows that are not empty.
    unit_of_place : str
        What the rows are called in messages: "line" or "row".
    separator : str
        The character between cells; empty for a workbook.
    """
    place = f"{name}, {unit_of_place}"
    layout = find_table(rows, name, place)
    lines = [line for line, _ in layout.body]
    printed_columns = []
    for index in range(len(layout.head)):
        printed_columns.append(tuple(_cell(row, index) for _, row in layout.body))
    columns, remark = leave_out_lost_readings(
        printed_columns, layout.head, lines, name, unit_of_place
    )
    # columns such as the record number of a Campbell logger
    for index, (title, unit) in enumerate(zip(layout.head, layout.units, strict=True)):
        if unit in NO_READINGS:
            columns[index] = ("",) * len(lines)
            remark += f"; the column {title!r} {NO_READINGS[unit]} and is left out"
    layout_with_remark = layout._replace(remark=f"{remark}{layout.remark}")
    # one reading of the dates, or two: the day first, then the month first
    readings = []
    for order in possible_date_orders(columns):
        reading = _sheet_of_columns(
            name, file, layout_with_remark, columns, unit_of_place, separator, date_order=order
        )
        readings.append(reading)
    if all(reading.columns == readings[0].columns for reading in readings):
        return readings[0]  # times count from the first row, and are the same in both readings
    day_first, month_first = readings
    unclear_date = next(
        f"{cell!r} in {unit_of_place} {line}"
        for cells in columns
        for line, cell in zip(lines, cells, strict=True)
        if is_unclear_date(cell)
    )
    return replace(day_first, unclear_date=unclear_date, month_first=month_first)


def _sheet_of_columns(
    name: str,
    file: Path,
    layout: TableLayout,
    columns_of_file: Sequence[tuple[str, ...]],
    unit_of_place: str,
    separator: str,
    *,
    date_order: str,
) -> Sheet:
    """Return the table of a layout's columns, whose dates have the day or the month first.

    `columns_of_file` holds the cells (N,) of each column of the layout, without lost readings.
    """
    place = f"{name}, {unit_of_place}"
    lines = tuple(line for line, _ in layout.body)
    places = [f"{place} {line}" for line in lines]
    names_and_units = [
        split_head(title or f"column {number}", unit)
        for number, (title, unit) in enumerate(zip(layout.head, layout.units, strict=True), start=1)
    ]
    units_of_file = [unit for _, unit in names_and_units]
    table = _columns_with_seconds(layout, columns_of_file, units_of_file, places, date_order)

    # columns of numbers or times; columns with texts are left out with a remark, empty ones without
    heads: list[str] = []
    units: list[str] = []
    columns: list[tuple[str, ...]] = []
    left_out = table.remark
    for index, cells in table.columns.items():
        title = layout.head[index]
        head, unit = names_and_units[index]
        if index in table.clocks:
            unit = "s"
        filled = [cell for cell in cells if cell]
        texts = [cell for cell in filled if not is_value(cell)]
        if texts:
            left_out += _remark_on_texts(title, len(filled) - len(texts), len(texts))
        elif filled:
            unit = unit_beside_number_formats(name, head, unit, filled)
            if all(cell.lower() in LOGICAL for cell in filled):
                unit = unit or "1"
            heads.append(head)
            units.append(unit)
            columns.append(cells)
    decimal, unclear = decimal_mark(columns, lines, place, separator)
    return Sheet(
        name=name,
        digest=hash_file(file),
        heads=tuple(_number_repeated_heads(heads)),
        units=tuple(units),
        columns=tuple(columns),
        lines=lines,
        decimal=decimal,
        unclear=unclear,
        remark=f"{_remark_on_extent(layout, unit_of_place, separator)}{left_out}{layout.remark}",
    )


class _ColumnsWithSeconds(NamedTuple):
    """The columns of a table, with seconds in place of clock times.

    Attributes
    ----------
    columns : dict of int to tuple of str
        The cells (N,) by the number of the column in the file.
    clocks : set of int
        The numbers of the columns that had clock times.
    remark : str
        The remark on columns of dates, which are left out.
    """

    columns: dict[int, tuple[str, ...]]
    clocks: set[int]
    remark: str


def _columns_with_seconds(
    layout: TableLayout,
    columns_of_file: Sequence[tuple[str, ...]],
    units: Sequence[str],
    places: Sequence[str],
    date_order: str,
) -> _ColumnsWithSeconds:
    """Return the columns of a layout, with seconds in place of its clock times.

    A column of dates is joined to its column of times. Without such a column, the dates are kept if
    they are the only clock of the table and increase, and left out otherwise.
    """
    cells_of_columns, times_of_dates = join_dates_with_times(
        columns_of_file, layout.head, units, places
    )
    seconds_of_columns = seconds_of_clock_times(
        cells_of_columns, layout.head, units, places, date_order
    )
    columns = dict(enumerate(cells_of_columns))
    clocks: set[int] = set()
    remark = ""
    for index, title in enumerate(layout.head):
        seconds = seconds_of_columns.get(index, ())
        is_only_clock = len(seconds_of_columns) == 1 and _increases(seconds)
        if index in times_of_dates:
            remark += f"; {title!r} has the dates of {layout.head[times_of_dates[index]]!r}"
            del columns[index]
        elif seconds and is_column_of_dates(columns[index]) and not is_only_clock:
            remark += f"; the column {title!r} holds dates without times and is left out"
            del columns[index]
        elif seconds:
            columns[index] = tuple(ExactNumber(cell) if cell else "" for cell in seconds)
            clocks.add(index)
    return _ColumnsWithSeconds(columns, clocks, remark)


def _remark_on_extent(layout: TableLayout, unit_of_place: str, separator: str) -> str:
    """Return the phrase on the first and last line of the readings, and on their separator."""
    (first_line, _), (last_line, _) = layout.body[0], layout.body[-1]
    between_cells = ""
    if separator and len(layout.head) > 1:
        between_cells = f", {SEPARATORS[separator]} between cells"
    return f"{unit_of_place}s {first_line} to {last_line}{between_cells}"


def _increases(cells: Sequence[str]) -> bool:
    """Return whether the filled cells of a column are decimal numbers that increase strictly."""
    return all(
        before < after for before, after in pairwise(Decimal(cell) for cell in cells if cell)
    )


def _cell(row: Sequence[str], index: int) -> str:
    """Return a cell of a row; an empty text if the row has fewer cells."""
    return row[index] if index < len(row) else ""


def _remark_on_texts(title: str, number_count: int, text_count: int) -> str:
    """Return the remark that a column is left out because it holds texts, or no numbers."""
    content = "no numbers"
    if number_count:
        content = f"{counted(number_count, 'number')} and {counted(text_count, 'text')}"
    return f"; the column {title!r} holds {content} and is left out"


def _number_repeated_heads(heads: Sequence[str]) -> list[str]:
    """Make heads unique: the second one of a name gets the number 2, and so on."""
    numbered = []
    for index, head in enumerate(heads):
        number_of_same_name = heads[:index].count(head)
        numbered.append(f"{head} {number_of_same_name + 1}" if number_of_same_name else head)
    return numbered


def _matlab_sheet(path: Path) -> Sheet:
    """Return the table in a MATLAB file."""
    table = read_matlab(path)
    columns = []
    for cells in table.columns:
        columns.append(tuple(ExactNumber(cell) if cell else "" for cell in cells))
    return Sheet(
        name=path.name,
        digest=hash_file(path),
        heads=table.heads,
        units=("",) * len(columns),
        columns=tuple(columns),
        lines=tuple(range(1, len(columns[0]) + 1)),
        decimal=".",
        unclear="",
        remark=table.remark,
    )


# ---------------------------------------------------------------- rows


def _text_rows(path: Path) -> tuple[Rows, str]:
    """Return the rows of a text file, and the separator of its cells.

    Tabs, semicolons and commas are tried on the first `_LINES_FOR_SEPARATOR` lines; the separator
    that gives the best table is taken.
    """
    lines = read_text(path, CampaignFileError, otherwise="latin-1").splitlines()

    def table_quality(separator: str) -> tuple[bool, bool, int]:
        """Return how good a table a separator gives; a larger tuple is better.

        The entries are whether a table is found, whether no head is a number, and the number of
        cells with numbers minus that of cells with texts, over the rows with two numbers or more.
        """
        rows = _split_rows(lines[:_LINES_FOR_SEPARATOR], separator, path.name)
        numbers_minus_texts = 0
        for _, row in rows:
            number_count = sum(map(is_value, row))
            texts = sum(map(bool, row)) - number_count
            if number_count > 1:
                numbers_minus_texts += number_count - texts
        try:
            layout = find_table(rows, path.name, "")
        except CampaignFileError:
            return False, False, numbers_minus_texts
        return True, not any(map(is_value, layout.head)), numbers_minus_texts

    separator = max(SEPARATORS, key=table_quality)
    return _split_rows(lines, separator, path.name), separator


def _split_rows(lines: Sequence[str], separator: str, name: str) -> Rows:
    """Return the cells of lines of a text file; lines without any text are left out."""
    reader = csv.reader(io.StringIO("\n".join(lines)), delimiter=separator)
    rows = []
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if any(cells):
                rows.append((reader.line_num, cells))
    except csv.Error as cause:
        raise CampaignFileError(f"{name}, line {reader.line_num}: {one_line(cause)}.") from cause
    return rows
