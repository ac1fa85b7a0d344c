"""Readings that a file says are lost: overloads, NaN, and fill values of a campaign's own tables."""

import pytest
from openpyxl import Workbook

from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.sheet import read_sheet
from discrepancy.errors import CampaignDataError, CampaignFileError
from tests.refusals import refused


def table_of(folder, text):
    """Return the table in a text file."""
    (folder / "lab.csv").write_text(text, "utf-8")
    return read_sheet(folder / "lab.csv")


# ---------------------------------------------------------------- overloads


@pytest.mark.parametrize(
    "overload",
    ["OVL", "OL", "O.L", "OVLD", "OVER", "+OVER", "-OVER", "OVERLOAD", "Overflow", ">OL", "OVRFLW", "+++++"],
)
def test_a_channel_ends_where_its_overload_begins_and_the_others_go_on(tmp_path, overload):
    sheet = table_of(tmp_path, f"t,w,e\n0,0.5,1\n1,0.6,2\n2,0.7,{overload}\n3,0.8,{overload}\n")

    assert sheet.numbers("e", ".") == ("1", "2", "", "")
    assert sheet.numbers("w", ".") == ("0.5", "0.6", "0.7", "0.8")
    assert f"; 'e' has {overload} from line 4 on and ends there" in sheet.remark


@pytest.mark.parametrize(
    ("text", "head", "numbers"),
    [
        ("e,t,w\n1,0,5\n2,1,6\nOVL,2,7\nOVL,3,8\n", "w", ("5", "6", "7", "8")),
        ("t,a,b,w\n0,1,2,5\n1,1,2,6\n2,OVL,OVL,7\n3,OVL,OVL,8\n", "w", ("5", "6", "7", "8")),
        ("t,e,w\n0,1,5\n1,OVL,6\n2,OVL,7\n3,OVL,8\n", "e", ("1", "", "", "")),
        ("t,w\n0,0.5\n1,0.6\n2,OVL\n", "w", ("0.5", "0.6", "")),
        ("t,e,w\n0,1,5\n1,OVL,6\n2,OVL,7\nMean,3,6\n", "w", ("5", "6", "7")),
        ("t,e,w\n0,1,5\n1,2,6\n---,---,---\n", "t", ("0", "1")),
        ("w\n0.5\n0.6\n0.7\nOVL\nOVL\n", "w", ("0.5", "0.6", "0.7")),
    ],
    ids=[
        "first column",
        "most columns",
        "most rows",
        "only channel",
        "footer below",
        "line of dashes below",
        "single column",
    ],
)
def test_no_reading_is_lost_with_an_overload_beside_it(tmp_path, text, head, numbers):
    assert table_of(tmp_path, text).numbers(head, ".") == numbers


def test_a_channel_of_a_workbook_ends_where_its_overload_begins(tmp_path):
    book = Workbook()
    for row in (["t [s]", "e", "w"], [0, 1, 5], [1, 2, 6], [2, "OVL", 7], [3, "OVL", 8]):
        book.active.append(row)
    book.save(tmp_path / "lab.xlsx")

    sheet = read_sheet(tmp_path / "lab.xlsx")

    assert (sheet.numbers("e", "."), sheet.numbers("w", ".")) == (("1", "2", "", ""), ("5", "6", "7", "8"))
    assert "; 'e' has OVL from row 4 on and ends there" in sheet.remark


def test_a_channel_that_begins_with_an_overload_is_refused_with_its_line(tmp_path):
    with refused(CampaignFileError, "lab.csv, line 2: the names of columns or numbers alone are expected"):
        table_of(tmp_path, "t,e,w\n0,OVL,5\n1,OVL,6\n2,3,7\n3,4,8\n4,5,9\n")


def test_an_overload_between_readings_is_refused_with_its_line(tmp_path):
    with refused(CampaignFileError, "lab.csv, line 3: numbers are expected under 'e', but 'OVL' is an over"):
        table_of(tmp_path, "t,e,w\n0,1,5\n1,OVL,6\n2,3,7\n3,4,8\n")


# ---------------------------------------------------------------- NaN


@pytest.mark.parametrize("lost", ["NaN", "nan", '"NAN"', "-nan(ind)", "1.#QNAN", "Inf", "#N/A", "#DIV/0!"])
@pytest.mark.parametrize("line", [2, 3, 5])
def test_what_is_not_a_number_is_an_empty_cell_in_any_row(tmp_path, lost, line):
    lines = ["t,w,e", "0,0.5,1", "1,0.6,2", "2,0.7,3", "3,0.8,4"]
    lines[line - 1] = f"{lines[line - 1].rpartition(',')[0]},{lost}"

    sheet = table_of(tmp_path, "\n".join(lines))

    expected = ["1", "2", "3", "4"]
    expected[line - 2] = ""
    assert [*sheet.numbers("e", ".")] == expected
    assert f"; 'e' has {lost.strip(chr(34))} in line {line}" in sheet.remark


def test_nan_in_a_single_column_keeps_its_row(tmp_path):
    assert table_of(tmp_path, "w\nNaN\n0.5\nNaN\n0.7\n").numbers("w", ".") == ("", "0.5", "", "0.7")


# ---------------------------------------------------------------- fill values of a written campaign

CAMPAIGN = """
format = 1
name = "pulled"
[[channel]]
name = "tip"
column = "w"
quantity = "displacement"
unit = "mm"
output = "displacement"
[[trial]]
name = "pull"
kind = "static"
file = "pull.csv"
"""


def campaign_of(folder, table):
    """Return a campaign that was written by hand, with one table."""
    (folder / "campaign.toml").write_text(CAMPAIGN, "utf-8")
    (folder / "pull.csv").write_text(table, "utf-8")
    return read_campaign(folder)


@pytest.mark.parametrize(
    ("fill", "clause"),
    [
        ("-9999", "-9999 in line 5 of 'w' is a fill value"),
        ("7999.0", "7999.0 in line 5 of 'w' is a fill value"),
        ("9.9E+37", r"line 5 of 'w' is beyond 1e+30"),
    ],
)
def test_a_fill_value_in_a_campaign_written_by_hand_is_left_out_and_named(tmp_path, fill, clause):
    campaign = campaign_of(tmp_path, f"force,w\n0,0\n1,1.1\n2,2.1\n3,{fill}\n4,4.2\n5,5.2\n")

    assert campaign.trials[0].used[:, 0].tolist() == [True, True, True, False, True, True]
    assert f"In pull.csv, {clause} and left out." in campaign.remarks


def test_a_reading_that_only_looks_like_a_fill_value_is_kept(tmp_path):
    campaign = campaign_of(tmp_path, "force,w\n0,0\n1,3000\n2,6000\n3,9999\n4,12000\n")

    assert campaign.trials[0].used.all()


def test_a_fill_value_of_a_load_is_refused_with_its_line(tmp_path):
    with refused(CampaignDataError, "pull.csv: -9999 in line 4 of 'force' is a fill value, but the trial"):
        campaign_of(tmp_path, "force,w\n0,0\n1,1.1\n-9999,2.1\n3,3.2\n4,4.2\n5,5.2\n")
