"""A laboratory's table as a programme saved it: head, units and rows are found, and no number is guessed.

What stands between cells is what makes a table with the most numbers. Of 600 tables with titles, decimal
commas and groups of digits that is right in all, CleverCSV in 594 (and wrong without a word in the others),
`csv.Sniffer` in 228.
"""

import csv
import io
import re
import warnings
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, time, timedelta
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

from discrepancy.campaign.heads import is_unit, named, plain_unit, times_among
from discrepancy.campaign.matlab_file import read_matlab
from discrepancy.errors import CampaignFileError, said
from reporting.files import hash_file
from reporting.text_file import read_text
from reporting.toml_file import short_repr
from reporting.words import counted, listing, one_line

SEPARATORS = {"\t": "tabs", ";": "semicolons", ",": "commas"}
MATLAB = ".mat"
EXCEL = (".xlsx", ".xlsm")
OTHER_FORMATS = {
    ".xls": ("an Excel file of before 2007", "save it as .xlsx or as CSV"),
    ".ods": ("an OpenDocument spreadsheet", "save it as .xlsx or as CSV"),
    ".tdms": (
        "a LabVIEW TDMS file",
        "export it as text, or with npTDMS: tdms_file.as_dataframe().to_csv('FILE.csv')",
    ),
    ".uff": ("a universal file", "export its records as text, or read them with pyuff and write a CSV file"),
    ".unv": ("a universal file", "export its records as text, or read them with pyuff and write a CSV file"),
}
"""Formats that are not read, by their ending: what they are, and how a table comes out of them."""
_LOOKED_AT = 500
"""Lines by which the separator is chosen."""
_GROUPS = "'’ \u00a0\u202f"
_NUMBERS = {
    mark: re.compile(
        rf"[+-]?(?:[1-9]\d{{0,2}}([{other}{_GROUPS}])\d{{3}}(?:\1\d{{3}})*(?:[{mark}]\d*)?"
        rf"|(?:\d+[{mark}]?\d*|[{mark}]\d+)(?:[eE][+-]?\d+)?)",
        re.ASCII,
    )
    for mark, other in (".,", ",.")
}
"""Numbers with either decimal mark: those with groups of three digits have no exponent."""
_PLAIN = re.compile(r"[+-]?\d*[.,]?\d+(?:[eE][+-]?\d+)?", re.ASCII)
"""What most of them are, found sooner."""
_CLOCK = re.compile(
    r"(?:([^\sT]+)(?:[ ]+|T)|(?=\d))(\d{1,2}:\d\d:\d\d)([.,]\d+)?"
    r"(?: ?([AaPp])\.?[Mm]\.?)?(Z|[+-]\d\d:?\d\d)?",
    re.ASCII,
)
"""Date, clock, fraction of a second, half of the day, and offset from UTC."""
_HALF_DAY, _DAY = 43_200, 86_400
_LOGICAL = {"true": "1", "false": "0"}
Rows = list[tuple[int, list[str]]]


class _Typed(str):
    """A number that an Excel cell holds as such."""


@dataclass(frozen=True)
class Sheet:
    """One table.

    Attributes
    ----------
    name, digest : str
        Name of the file (an Excel workbook's with that of its sheet, if it was said), and its SHA-256.
    heads, units : tuple of str
        Of the columns that hold numbers; an empty text where no unit is said.
    columns : tuple of tuple of str
        Cells as they came; clock times are seconds since the first row.
    lines : tuple of int
        Line or row of the file that each row stands in.
    decimal : str or None
        Mark of decimals; None where numbers can be read in two ways.
    unclear : str
        Such a number and its line.
    remark : str
        How the table was found: lines, what stands between cells, what was passed over.
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

    def numbers(self, head: str, decimal: str) -> tuple[str, ...]:
        """Return the cells of a column with points and without groups of digits; empty ones stay empty."""
        cells = self.columns[self.heads.index(head)]
        return tuple(cell and (_number(cell, decimal) or cell) for cell in cells)


def read_sheet(path: Path) -> Sheet:
    """Return the table of a file, an Excel workbook's as `FILE.xlsx#SHEET` where it has several.

    Raises
    ------
    CampaignFileError
        The file cannot be read, holds no table with a head, a row of it holds a text for a number, decimals
        are written in two ways, or a time cannot be read or can be in two.
    """
    file = path if path.exists() else path.with_name(path.name.partition("#")[0])
    ending = file.suffix.lower()
    if ending in OTHER_FORMATS:
        what, remedy = OTHER_FORMATS[ending]
        raise CampaignFileError(f"{file.name} is {what}, which is not read: {remedy}.")
    if ending == MATLAB:
        return _matlab_sheet(file)
    excel = ending in EXCEL
    rows, separator = (_excel_rows(file, path.name.partition("#")[2]), "") if excel else _text_rows(file)
    where = f"{path.name}, {'row' if excel else 'line'}"
    head, units, body, below = _laid_out(rows, path.name, where)
    lines = tuple(line for line, _ in body)
    names, columns, left = [], [], ""
    texts_of_rows = [tuple(row[at] if at < len(row) else "" for _, row in body) for at in range(len(head))]
    seconds = _clock_times(texts_of_rows, [f"{where} {line}" for line in lines])
    for at, title in enumerate(head):
        cells = texts_of_rows[at]
        name, unit = named(title or f"column {at + 1}", units[at])
        if at in seconds:
            unit, cells = "s", seconds[at]
        if texts := [cell for cell in cells if cell and not _is_value(cell)]:
            count = sum(map(bool, cells)) - len(texts)
            held = f"{counted(count, 'number')} and {counted(len(texts), 'text')}" if count else "no numbers"
            left += f"; the column {title!r} holds {held} and is left out"
        elif any(cells):
            if all(cell.lower() in _LOGICAL for cell in cells if cell):
                unit = unit or "1"
            names.append((name, unit))
            columns.append(cells)
    heads = [name for name, _ in names]
    earlier = [heads[:at].count(name) for at, name in enumerate(heads)]
    heads = [f"{name} {count + 1}" if count else name for name, count in zip(heads, earlier, strict=True)]
    between = f", {SEPARATORS[separator]} between cells" if separator and len(head) > 1 else ""
    remark = f"{where.rpartition(' ')[2]}s {lines[0]} to {lines[-1]}{between}{left}{below}"
    return Sheet(
        path.name, hash_file(file), tuple(heads), tuple(unit for _, unit in names), tuple(columns), lines,
        *_decimal(columns, lines, where, separator), remark,
    )  # fmt: skip


def _matlab_sheet(path: Path) -> Sheet:
    table = read_matlab(path)
    columns = tuple(tuple(cell and _Typed(cell) for cell in cells) for cells in table.columns)
    units = ("",) * len(columns)
    lines = tuple(range(1, len(columns[0]) + 1))
    return Sheet(path.name, hash_file(path), table.heads, units, columns, lines, ".", "", table.remark)


# ---------------------------------------------------------------- cells


def _number(cell: str, mark: str) -> str | None:
    """Return a number as `float` reads it, None for anything else; `mark` is that of its decimals."""
    if isinstance(cell, _Typed):
        return str(cell)
    if cell.lower() in _LOGICAL:
        return _LOGICAL[cell.lower()]
    text = cell.replace("−", "-")
    found = _NUMBERS[mark].fullmatch(text)
    return None if found is None else text.replace(found[1] or " ", "").replace(mark, ".")


def _is_value(cell: str) -> bool:
    plain = _PLAIN.fullmatch(cell)
    return bool(plain or any(_number(cell, mark) for mark in _NUMBERS) or _CLOCK.fullmatch(cell))


def _has_date(cell: str) -> bool:
    found = _CLOCK.fullmatch(cell)
    return found is not None and bool(found[1])


def _time(cell: str, where: str) -> Decimal:
    """Return a time of day, with a date or without, in seconds; with an offset from UTC in UTC."""
    found = _CLOCK.fullmatch(cell)
    day, clock, fraction, half, offset = [""] * 5 if found is None else found.groups(default="")
    for layout in ("%Y-%m-%d", "%d.%m.%Y"):
        text, full_layout = f"{day or '1.1.2000'} {clock}", f"{layout} %H:%M:%S"
        if half:
            text, full_layout = f"{text} {half}M", f"{layout} %I:%M:%S %p"
        with suppress(ValueError):
            moment = datetime.strptime(text, full_layout)
            whole = (moment - datetime.min) // timedelta(seconds=1)
            return whole - _offset_seconds(offset) + Decimal(f"0{fraction.replace(',', '.')}")
    raise CampaignFileError(said("sheets.no_time", where=where, cell=cell))


def _clock_times(columns: Sequence[tuple[str, ...]], places: Sequence[str]) -> dict[int, tuple[str, ...]]:
    """Return the clock times of columns by their number, in seconds since the first of all.

    Times with a date and times of day count from the first of their own kind.
    """
    moments: dict[int, dict[int, Decimal]] = {}
    starts: dict[bool, Decimal] = {}
    for number, cells in enumerate(columns):
        if not any(map(_CLOCK.fullmatch, cells)):
            continue
        filled = {row: _time(cell, places[row]) for row, cell in enumerate(cells) if cell}
        is_dated = any(map(_has_date, cells))
        if not is_dated:
            filled = dict(zip(filled, _past_midnight([*filled.values()]), strict=True))
        moments[number] = filled
        first = next(iter(filled.values()))
        starts[is_dated] = min(first, starts.get(is_dated, first))
    found = {}
    for number, filled in moments.items():
        start = starts[any(map(_has_date, columns[number]))]
        rows = range(len(columns[number]))
        found[number] = tuple(_Typed(filled[row] - start) if row in filled else "" for row in rows)
    return found


def _offset_seconds(offset: str) -> int:
    """Return an offset from UTC such as `Z`, `+01:00` or `-0530` in seconds."""
    if offset in ("", "Z"):
        return 0
    digits = offset[1:].replace(":", "")
    seconds = 3600 * int(digits[:2]) + 60 * int(digits[2:])
    return -seconds if offset[0] == "-" else seconds


def _past_midnight(times: Sequence[Decimal]) -> list[Decimal]:
    """Return times of day, in seconds, a day later from where they fall by more than half a day."""
    days, found = 0, [times[0]]
    for previous, time_of_day in pairwise(times):
        if time_of_day < previous - _HALF_DAY:
            days += 1
        found.append(time_of_day + days * _DAY)
    return found


def _decimal(
    columns: Sequence[Sequence[str]], lines: Sequence[int], where: str, separator: str
) -> tuple[str | None, str]:
    """Return the decimal mark, None and a number where all that have one can be read in two ways."""
    sure: dict[str, str] = {}
    unclear = ""
    for cells in columns:
        for cell, line in zip(cells, lines, strict=True):
            point, comma = (_number(cell, mark) for mark in _NUMBERS)
            if point != comma and point and comma:
                unclear = unclear or f"{cell!r} in line {line}"
            elif point != comma:
                sure.setdefault("." if point else ",", f"{cell!r} in line {line}")
    if len(sure) > 1:
        file = where.rpartition(",")[0]
        raise CampaignFileError(said("sheets.decimals", file=file, point=sure["."], comma=sure[","]))
    if unclear and not sure:
        # What commas stand between, and in none of, has points for decimals.
        return ("." if separator == "," and "," not in unclear.rpartition(" in ")[0] else None), unclear
    return next(iter(sure), "."), unclear


# ---------------------------------------------------------------- rows


def _text_rows(path: Path) -> tuple[Rows, str]:
    lines = read_text(path, CampaignFileError, otherwise="latin-1").splitlines()

    def rows(separator: str, until: int | None = None) -> Rows:
        reader = csv.reader(io.StringIO("\n".join(lines[:until])), delimiter=separator)
        try:
            found = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
        except csv.Error as cause:
            raise CampaignFileError(f"{path.name}, line {reader.line_num}: {one_line(cause)}.") from cause
        return [(line, row) for line, row in found if any(row)]

    def numbers(separator: str) -> tuple[bool, bool, int]:
        """Return whether a separator makes a table, whether its head is of words, and numbers less texts."""
        found, is_table, has_words = rows(separator, _LOOKED_AT), False, False
        values = [(sum(map(_is_value, row)), sum(map(bool, row))) for _, row in found]
        with suppress(CampaignFileError):
            head, *_ = _laid_out(found, path.name, "")
            is_table, has_words = True, not any(map(_is_value, head))
        return is_table, has_words, sum(2 * count - of for count, of in values if count > 1)

    separator = max(SEPARATORS, key=numbers)
    return rows(separator), separator


def _excel_rows(path: Path, tab: str) -> Rows:
    try:
        from openpyxl import load_workbook
    except ImportError:
        raise CampaignFileError("Excel files need openpyxl: pip install 'uav-twin[xlsx]'.") from None
    sheets: dict[str, Rows] = {}
    try:
        with warnings.catch_warnings(action="ignore"):
            book = load_workbook(path, read_only=True, data_only=True)
            for sheet in book.worksheets:
                sheet.reset_dimensions()  # the file may say any
                found = enumerate(sheet.iter_rows(values_only=True), start=1)
                filled = ((line, [_excel_text(cell) for cell in row]) for line, row in found if row)
                sheets[sheet.title] = [(line, row) for line, row in filled if any(row)]
            book.close()
    except Exception as cause:  # openpyxl answers damage with nearly any
        raise CampaignFileError(said("sheets.no_workbook", path=path, reason=one_line(cause))) from cause
    full = [title for title, rows in sheets.items() if rows]
    if (tab and tab not in sheets) or (not tab and len(full) != 1):
        raise CampaignFileError(said("sheets.which", file=path.name, has=", ".join(full) or "none"))
    return sheets[tab or full[0]]


def _excel_text(cell: object) -> str:
    if isinstance(cell, timedelta):
        cell = datetime.min + cell
    if isinstance(cell, datetime | time):
        return cell.isoformat()
    if isinstance(cell, int | float) and not isinstance(cell, bool):
        return _Typed(repr(cell))
    return "" if cell is None else str(cell).strip()


def _is_one_column(rows: Rows) -> bool:
    """Whether rows of one cell each are titles, and numbers under the last of them.

    What looks like several cells with another mark between them is no single column.
    """
    cells = [row[0] for _, row in rows]
    is_number = [_is_value(cell) for cell in cells]
    first = is_number.index(True) if True in is_number else 0
    if first == 0 or any(any(row[1:]) for _, row in rows):
        return False
    numbers = [cell for cell, is_one in zip(cells, is_number, strict=True) if is_one]
    has_blanks = any(" " in cell and not _CLOCK.fullmatch(cell) for cell in numbers)
    is_separated = any(mark in cells[first - 1] and mark in " ".join(numbers) for mark in SEPARATORS)
    return 2 * len(numbers) > len(cells) - first and not has_blanks and not is_separated


def _rows_of_longer_clocks(
    rows: Rows, first: int, head: Sequence[str], units: Sequence[str], values: Sequence[set[int]]
) -> list[int]:
    """Return the rows right below a table in which only a later one of its columns of times goes on.

    Parameters
    ----------
    rows : list
        Those below.
    first : int
        Number of the first of them.
    head, units : sequence of str
        Of the table.
    values : sequence of set of int
        Places of the values of all rows.
    """
    heads, units_of_heads = zip(*map(named, head, units), strict=True)
    times = times_among(heads, units_of_heads)
    places = {at for at, title in enumerate(heads) if title in times}
    found: list[int] = []
    for number, (_, row) in enumerate(rows, start=first):
        filled = {at for at, cell in enumerate(row) if cell}
        if len(places) < 2 or not filled & places or filled - values[number]:
            break
        found.append(number)
    return found


def _laid_out(rows: Rows, name: str, where: str) -> tuple[list[str], list[str], Rows, str]:
    """Return head, units and rows of the table, and what was passed over."""
    values = [{at for at, cell in enumerate(row) if _is_value(cell)} for _, row in rows]
    dense = [found for found in values if len(found) > 1]
    if not dense and _is_one_column(rows):
        dense = [found for found in values if found]
    often = Counter(at for found in dense for at in found)
    core = sorted(at for at, count in often.items() if 2 * count >= len(dense))
    texts = [
        next((at for at in core if at < len(row) and row[at] and at not in found), None)
        for (_, row), found in zip(rows, values, strict=True)
    ]
    body = [at for at, found in enumerate(values) if core and texts[at] is None and core[0] in found]
    if not body or body[0] == 0:
        raise CampaignFileError(said("sheets.no_table", name=name))
    first, last = body[0], body[-1]
    body = [at for at in range(first, last + 1) if texts[at] is None and values[at]]
    head, units = rows[first - 1][1], [""] * len(rows[first - 1][1])
    above = rows[first - 2][1] if first > 1 else []
    if sum(map(bool, above)) >= sum(map(bool, head)) and all(is_unit(cell) for cell in head if cell):
        head, units = above, [plain_unit(cell) for cell in head]
    body += _rows_of_longer_clocks(rows[last + 1 :], last + 1, head, units, values)
    last = body[-1]
    filled = max(at for row in body for at, cell in enumerate(rows[row][1]) if cell) + 1
    named = sum(map(bool, head))
    if 2 * named <= filled or len(head) < filled:
        came, has, place = counted(filled, "cell"), counted(named, "column"), f"{where} {rows[first][0]}"
        raise CampaignFileError(said("sheets.unnamed", place=place, came=came, named=has))
    torn = (at for at in range(last + 1, len(rows)) if core[0] in values[at])  # no footer begins so
    left = {*range(first, last), *(at for at in torn if 2 * len(values[at] & {*core}) >= len(core))} - {*body}
    for line, row in (rows[at] for at in sorted(left) if rows[at][1] not in (head, rows[first - 1][1])):
        if not row[0].startswith("#"):
            came = short_repr(listing(filter(None, row)))
            raise CampaignFileError(
                said("sheets.no_row", place=f"{where} {line}", name=head[core[0]], came=came)
            )
    if filled == 1 and (gap := next((at for at in body[1:] if rows[at][0] != rows[at - 1][0] + 1), None)):
        raise CampaignFileError(
            f"{where} {rows[gap][0] - 1} is empty, and the only column has numbers above and below: "
            "remove the line, or give the table a column of times."
        )
    below = [line for line, _ in rows[last + 1 :]]
    remark = f"; what stands from {below[0]} on is left out" if below else ""
    names = [cell.lstrip("# ") for cell in head[:filled]]
    return names, (units + [""] * filled)[:filled], [rows[at] for at in body], remark
