"""Rows of names and units above a laboratory's table, as loggers and spreadsheets write them."""

import pytest
from openpyxl import Workbook

from discrepancy.campaign.sheet import read_sheet

CAMPBELL = (
    '"TOA5","Bridge7","CR1000X","12345","CR1000X.Std.03.02","CPU:strain.CR1X","1234","Table100Hz"\n'
    '"TIMESTAMP","RECORD","Strain(1)","Tip_mm","Temp_C","State"\n'
    '"TS","RN","microstrain","mm","Deg C","unitless"\n'
    '"","","Smp","Avg","Avg","Smp"\n'
    '"2026-03-31 10:00:00",1000,100.5,5.0,21.5,0\n'
    '"2026-03-31 10:00:00.01",1001,"NAN",4.5,21.5,1\n'
    '"2026-03-31 10:00:00.02",1002,92.5,4.0,21.5,1\n'
)


def table_of(folder, text):
    """Return the table in a text file."""
    (folder / "lab.csv").write_text(text, "utf-8")
    return read_sheet(folder / "lab.csv")


def table_of_workbook(folder, rows, merged):
    """Return the table in a workbook with merged cells."""
    book = Workbook()
    for row in rows:
        book.active.append(row)
    for cells in merged:
        book.active.merge_cells(cells)
    book.save(folder / "lab.xlsx")
    return read_sheet(folder / "lab.xlsx")


def test_a_campbell_logger_has_names_and_units_in_lines_of_their_own(tmp_path):
    sheet = table_of(tmp_path, CAMPBELL)

    assert sheet.heads == ("TIMESTAMP", "Strain(1)", "Tip_mm", "Temp_C", "State")
    assert sheet.units == ("s", "microstrain", "mm", "Deg C", "")


def test_a_campbell_logger_has_its_times_in_the_column_timestamp(tmp_path):
    sheet = table_of(tmp_path, CAMPBELL)

    assert [float(cell) for cell in sheet.numbers("TIMESTAMP", ".")] == [0.0, 0.01, 0.02]


def test_the_record_numbers_of_a_campbell_logger_are_left_out_with_a_remark(tmp_path):
    sheet = table_of(tmp_path, CAMPBELL)

    assert "; the column 'RECORD' counts the records and is left out" in sheet.remark


def test_the_times_of_extremes_of_a_campbell_logger_are_no_second_clock(tmp_path):
    sheet = table_of(
        tmp_path,
        '"TOA5","Bridge7","CR6"\n"TIMESTAMP","RECORD","w_Max","w_TMx"\n"TS","RN","mm","TS"\n'
        '"","","Max","TMx"\n"2026-03-31 10:00:00",0,5,"2026-03-31 09:59:10"\n'
        '"2026-03-31 10:01:00",1,6,"2026-03-31 10:00:20"\n',
    )

    assert (sheet.heads, sheet.units) == (("TIMESTAMP", "w_Max"), ("s", "mm"))
    assert sheet.numbers("TIMESTAMP", ".") == ("0", "60")


def test_a_lost_reading_of_a_campbell_logger_is_an_empty_cell(tmp_path):
    sheet = table_of(tmp_path, CAMPBELL)

    assert sheet.numbers("Strain(1)", ".") == ("100.5", "", "92.5")
    assert "'Strain(1)' has NAN in line 6" in sheet.remark


def test_files_of_a_campbell_logger_that_were_joined_are_one_table(tmp_path):
    later = CAMPBELL.replace("10:00:00", "10:00:01")

    sheet = table_of(tmp_path, CAMPBELL + later)

    assert float(sheet.numbers("TIMESTAMP", ".")[3]) == 1.0


@pytest.mark.parametrize(
    "clock", ["(hh:mm:ss.ffffff)", "[HH:MM:SS]", "hh:mm:ss.000", "(hh:mm:ss am/pm)", "dd.mm.yyyy hh:mm:ss"]
)
def test_the_format_of_a_clock_stands_among_units(tmp_path, clock):
    sheet = table_of(
        tmp_path,
        f"Channel 1;Channel 2;Channel 3\nTime;Strain;Disp\n{clock};(um/m);(mm)\n"
        "10:00:00.000000;1;2\n10:00:00.010000;3;4\n",
    )

    assert (sheet.heads, sheet.units) == (("Time", "Strain", "Disp"), ("s", "um/m", "mm"))
    assert [float(cell) for cell in sheet.numbers("Time", ".")] == [0.0, 0.01]


def test_the_format_of_a_clock_in_a_head_is_no_part_of_the_name(tmp_path):
    sheet = table_of(tmp_path, "Time (hh:mm:ss.ffffff);w (mm)\n10:00:00.5;1\n10:00:01.5;2\n")

    assert (sheet.heads, sheet.units) == (("Time", "w"), ("s", "mm"))


def test_a_row_of_brackets_is_one_of_units_of_which_some_are_unknown(tmp_path):
    sheet = table_of(tmp_path, "t;w;Zustand\n(s);(mm);(Code)\n0;1;7\n1;2;8\n")

    assert (sheet.heads, sheet.units) == (("t", "w", "Zustand"), ("s", "mm", ""))


@pytest.mark.parametrize(
    ("rows", "merged", "heads"),
    [
        ([["Zeit", "Dehnung", None, "Weg"]], ["B1:C1"], ("Zeit", "Dehnung", "Dehnung 2", "Weg")),
        ([["Stand 3"], ["Zeit", "Weg", "Dehnung"]], ["A1:D1", "C2:D2"],
         ("Zeit", "Weg", "Dehnung", "Dehnung 2")),
        ([[None, "Dehnung", None, "Weg"], ["Zeit", "A", "B", None]], ["B1:C1", "D1:D2"],
         ("Zeit", "A", "B", "Weg")),
    ],
)  # fmt: skip
def test_a_merged_cell_names_all_columns_that_it_spans(tmp_path, rows, merged, heads):
    units = ["s", "mm", "mm", "mm"]

    sheet = table_of_workbook(tmp_path, [*rows, units, [0, 1, 2, 3], [1, 2, 3, 4]], merged)

    assert (sheet.heads, sheet.units) == (heads, tuple(units))


def test_a_merged_cell_that_was_saved_as_text_names_all_columns_that_it_spans(tmp_path):
    sheet = table_of(tmp_path, "Zeit;Dehnung;;;Weg\ns;µm/m;µm/m;µm/m;mm\n0;1;2;3;4\n1;2;3;4;5\n")

    assert sheet.heads == ("Zeit", "Dehnung", "Dehnung 2", "Dehnung 3", "Weg")


def test_a_title_above_heads_that_are_units_is_no_merged_name(tmp_path):
    sheet = table_of_workbook(tmp_path, [["Prüfstand 3"], ["s", "mm"], [0, 1], [1, 2]], ["A1:B1"])

    assert sheet.heads == ("s", "mm")
