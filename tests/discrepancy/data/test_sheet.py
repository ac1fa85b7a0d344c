"""Tables as laboratories save them, and units: read as meant, asked or refused."""

import csv
import io
import random
import re
import time
import zipfile
from dataclasses import dataclass
from datetime import datetime, timedelta
from datetime import time as clock
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from openpyxl import Workbook, load_workbook

from discrepancy.campaign.columns import release_in_si
from discrepancy.campaign.importing import LaboratoryImport
from discrepancy.campaign.records import Quantity
from discrepancy.campaign.sheet import read_sheet, read_sheets
from discrepancy.campaign.units import UNITS, conversion_factor, factor_to_si, quantities_of
from discrepancy.campaign.wild_readings import is_fill_value
from discrepancy.errors import CampaignFileError, DiscrepancyError
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)

ODD = INPUTS.table("sheets.toml")


def bytes_of(odd):
    return odd["text"].encode(odd.get("encoding", "utf-8"))


def text_of(sheet):
    assert sheet.decimal is not None
    columns = [sheet.numbers(head, sheet.decimal) for head in sheet.heads]
    return [" ".join(row) for row in zip(*columns, strict=True)]


def sheet_of(folder, content):
    (folder / "odd.csv").write_bytes(content)
    return read_sheet(folder / "odd.csv")


@pytest.mark.parametrize("name", ODD)
def test_odd_files_are_read_as_they_are_meant(tmp_path, name):
    sheet = sheet_of(tmp_path, bytes_of(ODD[name]))
    assert [[*sheet.heads], [*sheet.units]] == [ODD[name]["heads"], ODD[name]["units"]]
    assert text_of(sheet) == ODD[name]["rows"]


@pytest.mark.parametrize(
    ("stamps", "seconds"),
    [
        (["2026-02-01T10:00:00.500Z", "2026-02-01T10:01:00.500Z"], ["0.000", "60.000"]),
        (["2026-02-01T10:00:00+01:00", "2026-02-01T09:00:30Z"], ["0", "30"]),
        (["2026-02-01 23:30:00-0530", "2026-02-02 05:00:10+0000"], ["0", "10"]),
        (["11:59:58 PM", "12:00:01 AM"], ["0", "3"]),
        (["23:59:58", "00:00:01"], ["0", "3"]),
        (["10:00:05", "10:00:01"], ["0", "-4"]),  # out of order, and no midnight
        (["2026-02-01 10:00:00 UTC", "2026-02-01 10:00:01 UTC"], ["0", "1"]),
        (["2026-02-01 10:00:00+01", "2026-02-01 09:00:01 GMT"], ["0", "1"]),
        (["20260331T100000Z", "20260331T100001.5Z"], ["0", "1.5"]),
        (["31-MAR-2026 10:00:00", "1-Apr-2026 10:00:00"], ["0", "86400"]),
        (["31-OCT-2026 10:00", "1-NOV-2026 10:00"], ["0", "86400"]),
        (["31 March 2026 10:00:00", "1 April 2026 10:00:00"], ["0", "86400"]),
        (["3/31/2026 10:00:00", "4/1/2026 10:00:00"], ["0", "86400"]),  # the first tells the month
        (["3/4/2026 10:00:00", "3/4/2026 10:00:01"], ["0", "1"]),  # no matter which is the month
        (["2026/3/31 23:59:59", "2026/3/31 24:00:00"], ["0", "1"]),
        (["23:59:58", "24:00:00", "00:00:01"], ["0", "2", "3"]),
        (["99:59:59", "100:00:00"], ["0", "1"]),
        (["59:58.5", "00:00.0", "00:01.5"], ["0.0", "1.5", "3.0"]),
        (["2026-03-31", "2026-04-01"], ["0", "86400"]),
    ],
)
def test_stamps_with_zones_halves_of_the_day_and_midnight_are_times(tmp_path, stamps, seconds):
    rows = "".join(f"{stamp},{row}.5\n" for row, stamp in enumerate(stamps))
    sheet = sheet_of(tmp_path, f"stamp,w [mm]\n{rows}".encode())
    assert (sheet.heads, sheet.units) == (("stamp", "w"), ("s", "mm"))
    assert [*sheet.numbers("stamp", ".")] == seconds


@pytest.mark.parametrize("layout", ["%Y-%m-%d", "%d.%m.%Y", "%d-%b-%Y", "%Y/%m/%d"])
def test_dates_and_times_in_two_columns_are_one_time(tmp_path, layout):
    stamps = [datetime(2026, 3, 30, 22) + timedelta(hours=24, minutes=7) * row for row in range(12)]
    rows = "".join(f"{stamp:{layout},%H:%M:%S},{row}.5\n" for row, stamp in enumerate(stamps))
    sheet = sheet_of(tmp_path, f"Date,Time,w [mm]\n{rows}".encode())
    assert sheet.heads == ("Time", "w")
    seconds = np.array([float(cell) for cell in sheet.numbers("Time", ".")])
    np.testing.assert_array_equal(seconds, 86_820.0 * np.arange(12))


def test_two_columns_of_dates_belong_to_the_times_in_their_order(tmp_path):
    rows = b"2026-03-31,10:00:00,1,2026-04-01,10:00:00,2\n2026-03-31,10:00:01,1,2026-04-01,10:00:03,2\n"
    sheet = sheet_of(tmp_path, b"d1,t1,w1 [mm],d2,t2,w2 [mm]\n" + rows)
    assert [sheet.numbers(head, ".") for head in ("t1", "t2")] == [("0", "1"), ("86400", "86403")]


def test_dates_of_one_day_without_times_are_left_out(tmp_path):
    sheet = sheet_of(tmp_path, b"d,t [s],w [mm]\n2026-03-31,0.5,1\n2026-03-31,1.5,2\n")
    assert sheet.heads == ("t", "w")
    assert sheet.remark.endswith("; the column 'd' holds dates without times and is left out")


@pytest.mark.parametrize(("answer", "seconds"), [("day", 2_592_000), ("month", 86_400)])
def test_a_date_of_two_readings_is_asked(tmp_path, answer, seconds):
    sheet = sheet_of(tmp_path, b"Time,w [mm]\n3/4/2026 10:00:00,1\n3/5/2026 10:00:00,2\n")
    stated = {"kind": {"": "static"}, "column": {"w": "force"}, "unit": {"w": "N"}}
    asked = LaboratoryImport([sheet], stated)
    expected = "day or month, whichever comes first in '3/4/2026 10:00:00' in line 2"
    assert asked.questions["date-order", expected] == ["odd.csv"]
    understood = asked.with_answer("date-order", "odd.csv", answer)
    assert not understood.questions
    assert understood.sheets[0].numbers("Time", ".")[1] == str(seconds)


def test_true_and_false_are_values(tmp_path):
    sheet = sheet_of(tmp_path, b"t [s],contact\n0.5,True\n1.5,FALSE\n2.5,\n")
    assert (sheet.units, sheet.numbers("contact", ".")) == (("s", "1"), ("1", "0", ""))


def test_an_output_of_a_driven_trial_may_be_called_force(tmp_path):
    sheet = sheet_of(tmp_path, b"t [s],force [N]\n" + b"".join(b"%d.5,%d\n" % (k, k) for k in range(9)))
    outputs = {"force": Quantity.FORCE}
    campaign = LaboratoryImport([sheet], {"kind": {"": "driven"}}, outputs.get).campaign("cell")
    assert (campaign.channels["force"].output, campaign.trials[0].inputs) == ("force", ())


def test_what_is_passed_over_is_told(tmp_path):
    sheet = sheet_of(tmp_path, bytes_of(ODD["title rows, units row, footer with statistics"]))
    assert sheet.remark == "lines 7 to 9, semicolons between cells; everything from 10 on is left out"
    sheet = sheet_of(tmp_path, b"t;w;e\n0;1;OL\n1;2;OL\n2;3;OL\n3;4;4\n4;5;5\n")
    assert sheet.remark.endswith("; the column 'e' holds 2 numbers and 3 texts and is left out")
    sheet = sheet_of(tmp_path, b"t;w;e\n0;1;2\n1;2;3\n2;rows;in all\n;1,5;2,5\nMean;1,5;2,5\n")
    assert sheet.remark.endswith("; everything from 4 on is left out")


@pytest.mark.parametrize(("content", "sentence"), INPUTS.refused("sheets"))
def test_what_cannot_be_read_is_one_sentence(tmp_path, content, sentence):
    with refused(CampaignFileError, re.escape(sentence)) as caught:
        sheet_of(tmp_path, content.encode())
    assert "odd.csv" in str(caught.value)


@pytest.mark.parametrize(("content", "decimal"), INPUTS.refused("decimals"))
def test_a_number_of_two_readings_is_not_guessed(tmp_path, content, decimal):
    sheet = sheet_of(tmp_path, content.encode())
    assert (sheet.decimal or "") == decimal
    if not decimal:
        assert sheet.unclear in ("'1,234' in line 2", "'1.234' in line 2")
        assert sheet.numbers("F", ",")[0] != sheet.numbers("F", ".")[0]


# ---------------------------------------------------------------- any dialect, any damage

_NUMBERS = st.floats(min_value=-1e12, max_value=1e12, allow_nan=False).map(lambda value: round(value, 6))
_TABLES = st.integers(2, 4).flatmap(
    lambda width: st.lists(st.lists(_NUMBERS, min_size=width, max_size=width), min_size=1, max_size=12)
)


@dataclass(frozen=True)
class Dialect:
    """How a program writes tables: separator of cells, decimal mark, mark between thousands, quotes, ends."""

    separator: str
    decimal: str
    thousands: str
    quoting: int
    line_end: str
    encoding: str

    def cell(self, value: float) -> str:
        """Return a number as such a program writes it."""
        text = repr(value)
        if "e" in text:
            return text.replace(".", self.decimal)
        whole, point, fraction = f"{value:,}".partition(".")
        decimal = self.decimal if point else ""
        return whole.replace(",", self.thousands) + decimal + fraction

    def content(self, heads: list[str], rows: list[list[float]], preamble: list[str]) -> bytes:
        """Return the bytes of a table, with lines before its heads."""
        stream = io.StringIO()
        writer = csv.writer(
            stream, delimiter=self.separator, quoting=self.quoting, lineterminator=self.line_end
        )
        writer.writerows([line] for line in preamble)
        writer.writerow([f"{head} [mm]" for head in heads])
        writer.writerows([self.cell(value) for value in row] for row in rows)
        return stream.getvalue().encode(self.encoding)


@st.composite
def dialects(draw):
    decimal = draw(st.sampled_from(".,"))
    thousands = draw(st.sampled_from({".": ["", ",", "'", "\u202f"], ",": ["", ".", "'", "\u202f"]}[decimal]))
    encodings = ["utf-8", "utf-8-sig"]
    if thousands != "\u202f":
        encodings.append("latin-1")
    return Dialect(
        separator=draw(st.sampled_from([";", ",", "\t"])),
        decimal=decimal,
        thousands=thousands,
        quoting=draw(st.sampled_from([csv.QUOTE_MINIMAL, csv.QUOTE_ALL])),
        line_end=draw(st.sampled_from(["\n", "\r\n"])),
        encoding=draw(st.sampled_from(encodings)),
    )


_PREAMBLES = st.lists(st.sampled_from(["Versuch", "a; b, c", "", "Prüfer: Müller"]), max_size=3)


@given(table=_TABLES, dialect=dialects(), preamble=_PREAMBLES)
@settings(deadline=None, suppress_health_check=list(HealthCheck))
def test_a_table_comes_back_from_any_dialect(tmp_path_factory, table, dialect, preamble):
    assume(not any(is_fill_value(repr(value)) for row in table for value in row))
    heads = [f"c{column}" for column in range(len(table[0]))]
    sheet = sheet_of(tmp_path_factory.mktemp("sheet"), dialect.content(heads, table, preamble))
    numbers = [[float(cell) for cell in sheet.numbers(head, dialect.decimal)] for head in sheet.heads]
    # no cell may have a decimal mark, as of 6e-06
    has_decimal_mark = any(dialect.decimal in dialect.cell(value) for row in table for value in row)
    assert sheet.decimal in (dialect.decimal, None) or not has_decimal_mark
    assert sheet.heads == tuple(heads)
    assert numbers == [list(column) for column in zip(*table, strict=True)]


def test_a_temperature_in_kelvin_is_not_called_celsius(tmp_path):
    """And minutes of few digits are even."""
    rows = (b"%.3f;29%d\n" % (k / 12.0, k) for k in range(9))
    sheet = sheet_of(tmp_path, b"t [min];plate [K]\n" + b"".join(rows))
    understood = LaboratoryImport(
        [sheet], {"kind": {"": "driven"}, "column": {"t": "time", "plate": "plate"}}
    )
    campaign = understood.campaign("plate")
    assert campaign.channels["plate"].unit == "K"
    assert campaign.trials[0].values[0, 0] == 290.0
    np.testing.assert_allclose(campaign.trials[0].time, 5.0 * np.arange(9), rtol=1e-4)


def refusal(path):
    """Return what is said of a file that becomes no campaign of a force and outputs."""
    try:
        sheet = read_sheet(path)
        first, *others = dict.fromkeys(sheet.heads)
        columns = {first: "force", **{head: f"output {head}" for head in others}}
        units = {first: "N", **dict.fromkeys(others, "mm")}
        said = {"column": columns, "unit": units, "kind": {"": "static"}, "decimal": {"": ","}}
        LaboratoryImport([sheet], said).campaign("fuzz")
    except DiscrepancyError as error:
        return str(error)
    return ""


PIECES = [
    b"", b";", b",", b"\t", b'"', b"\n", b"\r", b"nan", b"1e999", b"\xff", b"[", b"(" * 50, b"9" * 400,
    b"=", b"#", b":", b"31.2.26 1:2:3",
]  # fmt: skip


def damaged_copy(content, rng):
    """Return a file of which up to six pieces are exchanged by others."""
    damaged = bytearray(content)
    for _ in range(rng.randint(1, 6)):
        begin, end = sorted(rng.randrange(len(damaged) + 1) for _ in range(2))
        damaged[begin : min(end, begin + 9)] = rng.choice(PIECES)
    return bytes(damaged)


def test_damaged_files_are_read_or_refused_in_one_sentence(tmp_path):
    """Three hundred."""
    rng, outcomes = random.Random(7), set()
    for odd in [*ODD.values()] * 22:
        (tmp_path / "odd.csv").write_bytes(damaged_copy(bytes_of(odd), rng))
        sentence = refusal(tmp_path / "odd.csv")
        outcomes.add("refused" if sentence else "read")
        assert "\n" not in sentence
        assert sentence.endswith(".") or not sentence
    assert outcomes == {"read", "refused"}


def test_lines_that_are_long_or_ambiguous_take_no_long_time(tmp_path):
    """In seconds of this process, whatever else the machine does."""
    started = time.process_time()
    for content in (
        b"(" * 200_000, b"a" * 200_000, b"1" * 200_000, b"a [" + b"m " * 90_000 + b"];b\n1;2\n",
        b"1," * 100_000, b'"' * 99_999,
    ):  # fmt: skip
        with pytest.raises(CampaignFileError):
            sheet_of(tmp_path, content + b"\n" + content)
    assert time.process_time() - started < 60.0


# ---------------------------------------------------------------- fill values


@pytest.mark.parametrize("fill", ["-9999", "-99999", "99999.0", "7999", "-32768"])
def test_a_fill_value_is_left_out_and_named_with_its_row(tmp_path, fill):
    sheet = sheet_of(tmp_path, f"F [N];w [mm]\n0;0\n1;1.1\n2;{fill}\n3;3.2\n4;4.1\n".encode())

    assert sheet.numbers("w", ".") == ("0", "1.1", "", "3.2", "4.1")
    assert f"{fill} in line 4 of 'w' is a fill value and left out" in sheet.remark


def test_a_fill_value_is_left_out_in_both_orders_of_a_date(tmp_path):
    readings = [0.1, 0.2, -9999, 0.3, 0.4, 0.5, 0.6]
    rows = "".join(f"{month}/1/2026,{w}\n" for month, w in enumerate(readings, start=1))
    sheet = sheet_of(tmp_path, f"date,w [mm]\n{rows}".encode())
    cleaned = ("0.1", "0.2", "", "0.3", "0.4", "0.5", "0.6")
    assert (sheet.numbers("w", "."), sheet.month_first.numbers("w", ".")) == (cleaned, cleaned)


@pytest.mark.parametrize("fill", ["1e30", "9.9E+37", "-1e38"])
def test_a_number_from_1e30_on_is_lost(tmp_path, fill):
    sheet = sheet_of(tmp_path, f"F [N];w [mm]\n0;0\n1;{fill}\n".encode())

    assert sheet.numbers("w", ".") == ("0", "")
    assert "line 3 of 'w' is beyond 1e+30 and left out" in sheet.remark


def test_a_wild_reading_that_is_no_fill_value_is_named_and_kept(tmp_path):
    sheet = sheet_of(tmp_path, b"F [N];w [mm]\n0;0\n1;1.1\n2;2.2\n3;3.2\n4;4123\n")

    assert sheet.numbers("w", ".")[-1] == "4123"
    assert "no other reading supports 4123 in line 6 of 'w'" in sheet.remark


def test_two_different_fill_values_are_both_found(tmp_path):
    sheet = sheet_of(tmp_path, b"F [N];w [mm]\n0;0\n1;-9999\n2;2.2\n3;3.2\n4;7999\n5;-9999\n")

    assert sheet.numbers("w", ".") == ("0", "", "2.2", "3.2", "", "")


@pytest.mark.parametrize(
    "cells",
    [
        ("0", "9999", "5000", "2500"),  # a range that reaches the number
        ("0", "0", "9999", "0"),  # nothing shows the range of the others
        ("0", "0.1", "-0.1", "400", "9999", "3000", "30"),  # an impact
    ],
)
def test_a_number_of_nines_that_others_support_is_a_reading(tmp_path, cells):
    rows = "".join(f"{row};{cell}\n" for row, cell in enumerate(cells))

    sheet = sheet_of(tmp_path, f"F [N];w [mm]\n{rows}".encode())

    assert sheet.numbers("w", ".") == cells


# ---------------------------------------------------------------- Excel


def book_of(folder, rows, **more):
    book = Workbook()
    for title, found in {"Messung": rows, **more}.items():
        sheet = book.active if title == "Messung" else book.create_sheet(title)
        sheet.title = title
        for row in found:
            sheet.append(row)
    book.save(folder / "lab.xlsx")
    return folder / "lab.xlsx"


ROWS = [
    ["Prüfstand 3"],
    [],
    ["Zeit", "Weg [mm]", "Notiz"],
    [datetime(2026, 3, 12, 10, 0, 0), 1.234, "ok"],
    [datetime(2026, 3, 12, 10, 0, 0, 500_000), 5, None],
    ["Mittel", 3.1, None],
]


@pytest.mark.parametrize(
    ("rows", "text"),
    [
        (ROWS, ["0 1.234", "0.500000 5"]),  # typed numbers are in no doubt
        ([["t", "w [mm]"], [clock(10, 0, 0), 1], [clock(10, 0, 2), 2]], ["0 1", "2 2"]),
        ([["t", "w [mm]"], [timedelta(seconds=1.5), 1], [timedelta(hours=30, seconds=2), 2]],
         ["0.000000 1", "108000.500000 2"]),
        # texts are read like those of a file; true and false are 1 and 0
        ([["t [s]", "w [mm]"], [0.125, "1,5"], [1.125, "2,5"]], ["0.125 1.5", "1.125 2.5"]),
        ([["t [s]", "w [mm]", "ok"], [0.125, 1.5, True], [1.125, 2.5, False]],
         ["0.125 1.5 1", "1.125 2.5 0"]),
    ],
)  # fmt: skip
def test_excel_workbooks(tmp_path, rows, text):
    sheet = read_sheet(book_of(tmp_path, rows))
    assert text_of(sheet) == text
    assert len(sheet.heads) == len(text[0].split())


@pytest.mark.parametrize("rate", [400, 5_000, 8_000])
@pytest.mark.parametrize("number_format", ["yyyy-mm-dd hh:mm:ss.000", "mm:ss.0"])
def test_stamps_of_excel_are_exact_at_high_rates(tmp_path, rate, number_format):
    book = Workbook()
    book.active.append(["t", "w [mm]"])
    start = (datetime(2026, 3, 31, 10) - datetime(1899, 12, 30)) / timedelta(days=1)
    for row in range(200):
        book.active.append([start + row / rate / 86_400, row])
        book.active.cell(row + 2, 1).number_format = number_format
    book.save(tmp_path / "lab.xlsx")
    sheet = read_sheet(tmp_path / "lab.xlsx")
    seconds = np.array([float(cell) for cell in sheet.numbers("t", ".")])
    np.testing.assert_allclose(seconds, np.arange(200) / rate, rtol=0.0, atol=1e-12)


def test_a_clock_of_excel_goes_on_after_24_hours_without_brackets(tmp_path):
    book = Workbook()
    for row in (["t", "w [mm]"], [23.5 / 24, 1], [24.5 / 24, 2], [49.0 / 24, 3]):
        book.active.append(row)
    for row in range(2, 5):
        book.active.cell(row, 1).number_format = "hh:mm:ss"
    book.save(tmp_path / "lab.xlsx")
    assert read_sheet(tmp_path / "lab.xlsx").numbers("t", ".") == ("0", "3600", "91800")


def test_dates_and_times_in_two_columns_of_excel_are_one_time(tmp_path):
    days = [["Datum", "Zeit", "w [mm]"]]
    days += [[datetime(2026, 3, 30 + row), clock(22, 7 * row), row] for row in range(2)]
    sheet = read_sheet(book_of(tmp_path, days))
    assert (sheet.heads, sheet.numbers("Zeit", ".")) == (("Zeit", "w"), ("0", "86820"))


def test_the_row_of_a_number_that_became_a_date_is_named(tmp_path):
    rows = [["t [s]", "w [mm]"], [0, 0.5], [1, 0.5], [2, datetime(2026, 2, 1)], [3, 0.5]]
    with refused(CampaignFileError, "row 4: '2026-02-01T00:00:00' is a date or a time among the numbers"):
        read_sheet(book_of(tmp_path, rows))


def test_a_workbook_has_its_name_heads_units_and_rows(tmp_path):
    sheet = read_sheet(book_of(tmp_path, ROWS))
    assert (sheet.name, sheet.heads, sheet.units) == ("lab.xlsx", ("Zeit", "Weg"), ("s", "mm"))
    assert "rows 4 to 5" in sheet.remark


def test_one_of_several_sheets(tmp_path):
    path = book_of(tmp_path, ROWS, Ruhe=[["Zeit [s]", "Weg [mm]"], [0, 0.5], [1, 0.25]])
    assert text_of(read_sheet(Path(f"{path}#Ruhe"))) == ["0 0.5", "1 0.25"]
    with refused(CampaignFileError, r"has the sheets Messung, Ruhe: say which as lab.xlsx#SHEET"):
        read_sheet(path)
    with refused(CampaignFileError, "say which as"):
        read_sheet(Path(f"{path}#Ruh"))


def book_of_formats(folder, head, cells):
    """Write a workbook with times and a column, of which each cell has a value and a number format."""
    path = book_of(folder, [["t [s]", head], *([row, value] for row, (value, _) in enumerate(cells))])
    book = load_workbook(path)
    for row, (_, number_format) in enumerate(cells, start=2):
        book.active.cell(row, 2).number_format = number_format
    book.save(path)
    return path


@pytest.mark.parametrize(
    ("head", "number_format", "unit", "numbers"),
    [
        ("w", '0.00" mm"', "mm", ["0.85", "-0.07"]),
        ("w", r"#,##0.0\ \m\m", "mm", ["0.85", "-0.07"]),
        ("w", '[Red]0.0" mm";-0.0" mm"', "mm", ["0.85", "-0.07"]),
        ("w [mm]", '0.00" mm"', "mm", ["0.85", "-0.07"]),
        ("w [um]", '0.00" µm"', "µm", ["0.85", "-0.07"]),
        ("w", '0.0,,"MN"', "MN", ["0.00000085", "-0.00000007"]),
        ("w", "0%", "%", ["85", "-7"]),
        ("w [%]", "0.00%", "%", ["85", "-7"]),
        ("w [%]", "0.00", "%", ["0.85", "-0.07"]),
        ("w [%]", '0.00"%"', "%", ["0.85", "-0.07"]),  # a quoted sign does not multiply
        ("w [-]", "0.00%", "%", ["85", "-7"]),
        ("w [mm]", '0.00" rot"', "mm", ["0.85", "-0.07"]),
        ("w [mm]", "0.00E+00", "mm", ["0.85", "-0.07"]),
    ],
)
def test_a_number_is_taken_as_its_format_shows_it(tmp_path, head, number_format, unit, numbers):
    sheet = read_sheet(book_of_formats(tmp_path, head, [(0.85, number_format), (-0.07, number_format)]))
    assert sheet.units[1] == unit
    assert [float(number) for number in sheet.numbers("w", ".")] == [float(number) for number in numbers]


@pytest.mark.parametrize(
    ("head", "number_format", "numbers"),
    [("w [mm]", '0.0" mm"', ("0.85", "0.5")), ("w [%]", "0%", ("85", "0.5"))],
)
def test_a_number_without_a_format_has_the_unit_of_the_head(tmp_path, head, number_format, numbers):
    path = book_of_formats(tmp_path, head, [(0.85, number_format), (0.5, "General")])
    assert read_sheet(path).numbers("w", ".") == numbers


@pytest.mark.parametrize(
    ("head", "formats", "sentence"),
    [
        ("w [cm]", ['0.0" mm"', '0.0" mm"'], "the column 'w' has the unit cm, but its cells are shown in mm"),
        ("w [mm]", ["0%", "0%"], "the column 'w' has the unit mm, but its cells are shown in %"),
        ("w", ["0%", "0.0"], "the cells of the column 'w' are shown in % and no unit"),
        ("w", ['0.0" mm"', '0.0" cm"'], "the cells of the column 'w' are shown in cm and mm"),
    ],
)
def test_number_formats_that_contradict_are_refused(tmp_path, head, formats, sentence):
    path = book_of_formats(tmp_path, head, [(0.85, shown) for shown in formats])
    with refused(CampaignFileError, f"lab.xlsx: {sentence}"):
        read_sheet(path)


def test_all_sheets_of_a_workbook_are_tables_except_those_without_numbers(tmp_path):
    path = book_of(
        tmp_path, ROWS, Notizen=[["heute"]], Ruhe=[["Zeit [s]", "Weg [mm]"], [0, 0.5], [1, 0.25]], leer=[]
    )
    sheets = read_sheets(Path(f"{path}#all"))
    assert [sheet.name for sheet in sheets] == ["lab.xlsx#Messung", "lab.xlsx#Ruhe"]
    assert [text_of(sheet) for sheet in sheets] == [["0 1.234", "0.500000 5"], ["0 0.5", "1 0.25"]]
    assert sheets[0].remark.endswith("; the sheet 'Notizen' holds no numbers and is left out")


def test_a_sheet_may_be_called_all(tmp_path):
    path = book_of(tmp_path, ROWS, all=[["Zeit [s]", "Weg [mm]"], [0, 0.5], [1, 0.25]])
    assert [sheet.name for sheet in read_sheets(Path(f"{path}#all"))] == ["lab.xlsx#all"]


def test_a_workbook_without_numbers_is_refused_as_one_without_tables(tmp_path):
    path = book_of(tmp_path, [["heute"]], Notizen=[["morgen"]])
    with refused(CampaignFileError, "lab.xlsx holds no table: no sheet has a number"):
        read_sheets(Path(f"{path}#all"))


def with_stored_values(path, *values):
    """Store values of the formulas in C2, C3 and so on, with their types, as Excel does."""
    with zipfile.ZipFile(path) as book:
        parts = {name: book.read(name) for name in book.namelist()}
    sheet = parts["xl/worksheets/sheet1.xml"].decode()
    for row, (kind, value) in enumerate(values, start=2):
        sheet = re.sub(
            rf'<c r="C{row}"><f>(.*?)</f><v\s*/?>(</v>)?',
            rf'<c r="C{row}" t="{kind}"><f>\1</f><v>{value}</v>',
            sheet,
        )
    parts["xl/worksheets/sheet1.xml"] = sheet.encode()
    with zipfile.ZipFile(path, "w") as book:
        for name, part in parts.items():
            book.writestr(name, part)


FORMULAS = [["t [s]", "w [mm]", "v [mm]"], *([row, row + 1, f"=B{row + 2}/20"] for row in range(4))]


def test_formulas_without_values_are_refused(tmp_path):
    with refused(
        CampaignFileError,
        "lab.xlsx, sheet Messung: 4 of 4 formulas are without a value, first in C2: open the workbook in "
        "Excel or LibreOffice and save it.",
    ):
        read_sheet(book_of(tmp_path, FORMULAS))


@pytest.mark.parametrize("unstored", [("n", ""), ("b", "")])
def test_formulas_of_which_half_have_no_value_are_refused(tmp_path, unstored):
    path = book_of(tmp_path, FORMULAS)
    with_stored_values(path, ("n", "0.05"), ("n", "0.1"), unstored)
    with refused(CampaignFileError, "2 of 4 formulas are without a value, first in C4"):
        read_sheet(path)


def test_a_formula_whose_value_is_an_empty_text_is_an_empty_cell(tmp_path):
    path = book_of(tmp_path, FORMULAS)
    with_stored_values(path, ("n", "0.05"), ("str", ""), ("n", "0.15"), ("n", "0.2"))
    assert read_sheet(path).numbers("v", ".") == ("0.05", "", "0.15", "0.2")


def test_formulas_without_values_on_another_sheet_are_of_no_concern(tmp_path):
    path = book_of(tmp_path, ROWS, Rechnung=FORMULAS)
    assert text_of(read_sheet(Path(f"{path}#Messung"))) == ["0 1.234", "0.500000 5"]


@pytest.mark.parametrize("name", ["lab#3.xlsx", "lab.xls", "lab#3.xlsx#Messung", "lab.xls#Messung"])
def test_a_workbook_is_read_whatever_its_name(tmp_path, name):
    file = tmp_path / name.removesuffix("#Messung")
    book_of(tmp_path, ROWS).rename(file)
    assert text_of(read_sheet(tmp_path / name)) == ["0 1.234", "0.500000 5"]


def test_an_empty_workbook_is_refused_as_empty(tmp_path):
    with refused(CampaignFileError, "lab.xlsx is an empty workbook"):
        read_sheet(book_of(tmp_path, []))


def test_an_encrypted_workbook_is_refused_as_encrypted(tmp_path):
    content = bytes.fromhex("d0cf11e0a1b11ae1") + bytes(504) + "EncryptedPackage".encode("utf-16-le")
    (tmp_path / "lab.xlsx").write_bytes(content)
    with refused(CampaignFileError, "lab.xlsx is encrypted: save it without a password"):
        read_sheet(tmp_path / "lab.xlsx")


def test_damaged_workbooks_are_refused_in_one_sentence(tmp_path):
    path = book_of(tmp_path, ROWS)
    whole = path.read_bytes()
    rng = random.Random(3)
    for number in range(40):
        content = bytearray(whole[: rng.randrange(len(whole))] if number % 4 == 0 else whole)
        for _ in range(rng.randint(1, 20)):
            if content:
                content[rng.randrange(len(content))] = rng.randrange(256)
        path.write_bytes(content)
        said = refusal(path)
        assert "\n" not in said
        assert "lab" in said or not said
    path.write_text("no workbook", "utf-8")
    with pytest.raises(CampaignFileError, match="cannot be read as an Excel workbook"):
        read_sheet(path)


# ---------------------------------------------------------------- units


def rows(*tables):
    """Return quantity, unit and its power or factor, of parts of `units.toml`."""
    known = [Inputs(__file__).table("units.toml")[table] for table in tables]
    return [(Quantity(name), *one) for part in known for name, row in part.items() for one in row.items()]


def test_units_mean_what_they_always_did_and_what_laboratories_write():
    """What they were before pint is written down, for their meaning must not change."""
    powers = [(quantity, unit, float(f"1e{power}")) for quantity, unit, power in rows("powers")]
    for quantity, unit, factor in powers + rows("factors", "others"):
        assert quantity in quantities_of(unit), unit
        assert factor_to_si(quantity, unit) == pytest.approx(factor, rel=1e-15), unit


def test_usual_units_are_those_that_are_written_down():
    usual = {(quantity, unit) for quantity, row in UNITS.items() for unit in row.usual}
    assert usual == {row[:2] for row in rows("powers", "factors")}


def test_a_unit_is_converted_into_one_of_its_quantity_alone():
    assert conversion_factor("ms", "s") == pytest.approx(1e-3, rel=1e-15)
    with pytest.raises(ValueError, match="cannot become s"):
        conversion_factor("mm", "s")


@pytest.mark.parametrize(
    ("unit", "quantity", "in_si"),
    [
        ("uE", Quantity.STRAIN, 1e-6),
        ("1e-6", Quantity.STRAIN, 1e-6),
        ("G", Quantity.ACCELERATION, 9.80665),
        ("lbs", Quantity.FORCE, 4.4482216152605),
        ("RPM", Quantity.ANGULAR_VELOCITY, np.pi / 30.0),
        ("deg C", Quantity.TEMPERATURE, 1.0),
        ("kelvin", Quantity.TEMPERATURE, 1.0),
        ("°F", Quantity.TEMPERATURE, 5.0 / 9.0),
    ],
)
def test_loggers_names_of_units_are_known(unit, quantity, in_si):
    assert quantity in quantities_of(unit)
    assert factor_to_si(quantity, unit) == pytest.approx(in_si, rel=1e-12)
    assert conversion_factor("Sec", "s") == 1.0


@pytest.mark.parametrize("unit", ["µm", "μm", "um", " um"])  # the micro sign, and the Greek letter
@pytest.mark.parametrize("amount", range(1, 400, 7))
def test_a_release_in_micrometres_is_the_number_that_one_would_write(amount, unit):
    assert release_in_si(f"{amount}{unit}") == {"displacement": float(f"{amount}e-6"), "unit": "m"}


@pytest.mark.parametrize(
    "unit",
    ["", "kg", "t", "1/min", "Hz", "links", "dB", "2 mm", "9**9**9", "kN/m", "i.O.", "F", "x", "m" * 9999,
     "mV/V", "V/V", "µV/V", "mV/volt"],
)  # fmt: skip
def test_what_is_no_unit_of_ours_is_of_no_quantity_and_a_ratio_of_volts_a_signal(unit):
    assert quantities_of(unit) == (Quantity.SIGNAL,) * ("V/" in unit or "V/v" in unit)
    with pytest.raises(ValueError, match=r"strain must have a unit such as .*, but '.*' was given"):
        factor_to_si(Quantity.STRAIN, unit)


@pytest.mark.parametrize(
    ("name", "what"),
    [("a.XLS", "before 2007"), ("a.tdms", "TDMS"), ("a.uff", "universal file")],
)
def test_a_format_that_is_not_read_is_named_with_the_way_round(tmp_path, name, what):
    file = tmp_path / name
    file.write_bytes(b"\x00\x01")
    with pytest.raises(CampaignFileError, match=f"{what}.*which is not read: .*(CSV|csv|text)"):
        read_sheet(file)
