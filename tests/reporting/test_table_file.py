"""The one reader of tables guesses nothing."""

from pathlib import Path

import pytest

from reporting.table_file import TableErrors, parse_table, plain_number, read_table, table_text


class LayoutError(Exception):
    """A table is laid out otherwise."""


class ValueRefusedError(Exception):
    """A value is none."""


ERRORS = TableErrors(layout=LayoutError, value=ValueRefusedError)


def test_a_table_is_read_with_and_without_a_byte_order_mark(tmp_path: Path) -> None:
    file = tmp_path / "loads.csv"
    text = "# two rows\n" + table_text({"load": ("1.5", "-2e3"), "remark": ("a, b", "")})
    for encoding in ("utf-8", "utf-8-sig"):
        file.write_text(text, encoding=encoding)
        table = read_table(file, ERRORS)
        assert table.numbers("load", "the test").tolist() == [1.5, -2000.0]
        assert table.cells("remark", "the test") == ("a, b", "")
        assert table.lines == (3, 4)


def test_blanks_separate_and_names_are_given() -> None:
    table = parse_table("0.0\t 1\n\n0.1\t -2\n", "x.dat", ERRORS, header=("time", "signal"), separator=None)
    assert table.numbers("signal", "the test").tolist() == [1.0, -2.0]
    assert table.lines == (1, 3)
    with pytest.raises(
        LayoutError, match=r"^x\.dat, line 2: 1 cell came, and 2 columns \(time, signal\) are"
    ):
        parse_table("0.0\t1\n0.1\n", "x.dat", ERRORS, header=("time", "signal"), separator=None)


@pytest.mark.parametrize("text", ["٩٫٨١", "٩.٨١", "９.81", "1_000", "9,81", "", "0x10", "9.81 N", "−1"])
def test_what_is_no_number_in_plain_digits_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"digits|convert"):
        plain_number(text)
    table = parse_table(f'load,x\n"{text}",1\n', "loads.csv", ERRORS)
    with pytest.raises(LayoutError, match=r"^loads\.csv, line 2: column 'load' must hold a number"):
        table.numbers("load", "the test")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is empty"),
        ("load,x\n", "has a header line but no rows"),
        ("load;x\n1;2\n", "is not separated by commas"),
        ("load,load\n1,2\n", "more than one column 'load'"),
        ("load,x\n1,2\n1,2,3\n", "line 3: 3 cells came, and the header has 2 columns"),
    ],
)
def test_what_is_no_table_is_refused(text: str, sentence: str) -> None:
    with pytest.raises(LayoutError, match=sentence):
        parse_table(text, "loads.csv", ERRORS)


def test_values_that_none_can_have() -> None:
    table = parse_table("load,x\n1,inf\n0,1e999\n-1,2\n", "loads.csv", ERRORS)
    with pytest.raises(ValueRefusedError, match=r"line 2: column 'x' holds inf, and a finite number is"):
        table.numbers("x", "the test")
    with pytest.raises(ValueRefusedError, match=r"line 3: column 'x' holds 1e999"):
        table.number("x", 1)
    with pytest.raises(ValueRefusedError, match=r"line 3: column 'load' holds 0, and a positive number"):
        table.positive_numbers("load", "the test")


def test_a_key_comes_once() -> None:
    table = parse_table("name\na\nb\n\na\n", "names.csv", ERRORS)
    table.refuse_repeated((1, 2, 3), "name", "keep one")
    with pytest.raises(LayoutError, match=r"^names\.csv: the lines 2 and 5 hold the same name; keep one\.$"):
        table.refuse_repeated(table.cells("name", "the test"), "name", "keep one")
