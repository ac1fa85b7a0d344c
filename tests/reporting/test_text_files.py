"""The readers of JSON, TOML and tables guess nothing; what is wrong is one sentence."""

import re

import pytest

from reporting.formats.table_file import (
    TableErrors,
    parse_table,
    plain_number,
    read_table,
    table_text,
)
from reporting.formats.toml_file import parse_toml, read_toml
from reporting.json_file import parse_json, read_json
from reporting.text_file import DEEPEST_NESTING
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)
READERS = {"json": (read_json, parse_json), "toml": (read_toml, parse_toml)}


class WrongFileError(Exception):
    """What the caller raises, for the layout of a table, too."""


class ValueRefusedError(Exception):
    """A value of a table is none."""


ERRORS = TableErrors(layout=WrongFileError, value=ValueRefusedError)


TOML = "name = 'Flügel'\nspan = 1.50\n[mesh]\ncells = [1, 2]\n"
CONTENTS = {
    "json": ('{"a": [1, -9223372036854775808, 2.5, null]}', {"a": [1, -(2**63), 2.5, None]}),
    "toml": (TOML, {"name": "Flügel", "span": 1.5, "mesh": {"cells": [1, 2]}}),
}


@pytest.mark.parametrize("kind", READERS)
def test_a_file_is_read_with_and_without_a_byte_order_mark(tmp_path, kind):
    (read, parse), file, (text, content) = READERS[kind], tmp_path / "file", CONTENTS[kind]
    for encoding in ("utf-8", "utf-8-sig"):
        file.write_text(text, encoding=encoding)
        assert (
            read(file, WrongFileError) == parse(file.read_bytes(), "It", WrongFileError) == content
        )


@pytest.mark.parametrize(
    ("kind", "pieces", "sentence"),
    [(kind, *row) for kind in READERS for row in INPUTS.refused(kind)],
)
def test_what_is_wrong_is_one_sentence(tmp_path, kind, pieces, sentence):
    content = "".join(text * count for text, count in pieces).encode("latin-1")
    (read, parse), file = READERS[kind], tmp_path / "wing"
    file.write_bytes(content)
    sentence = f"^The wing {re.escape(str(file))}.*{sentence}"
    with refused(WrongFileError, sentence):
        read(file, WrongFileError, what="wing")
    with refused(WrongFileError, sentence):
        parse(content, f"The wing {file}", WrongFileError)


@pytest.mark.parametrize("kind", READERS)
def test_what_is_not_there_is_one_sentence(tmp_path, kind):
    for path in (tmp_path / "none.toml", tmp_path):
        with refused(WrongFileError, r"^The file .* cannot be read: (No such|Is a)"):
            READERS[kind][0](path, WrongFileError)
    with refused(WrongFileError, "is not a name of a file"):
        READERS[kind][0]("a\0b", WrongFileError)


def test_the_deepest_document_that_is_allowed_is_read():
    levels = DEEPEST_NESTING - 2  # the document itself and the value of x
    text = "x = " + "[" * levels + "7" + "]" * levels
    assert parse_toml(text, "the draft", WrongFileError)["x"]
    with refused(WrongFileError, r"^the draft is nested deeper"):
        parse_toml(text.replace("[", "[[").replace("]", "]]"), "the draft", WrongFileError)
    words = "one.two." * 20
    told = parse_toml(
        f'# {words}\ntext = "{words}"\nlines = """\n{words}"""', "the draft", WrongFileError
    )
    assert told == {"text": words, "lines": words}  # these are no keys


# ---------------------------------------------------------------- tables


def test_a_table_is_read_with_and_without_a_byte_order_mark(tmp_path):
    file = tmp_path / "loads.csv"
    text = "# two rows\n" + table_text({"load": ("1.5", "-2e3"), "remark": ("a, b", "")})
    for encoding in ("utf-8", "utf-8-sig"):
        file.write_text(text, encoding=encoding)
        table = read_table(file, ERRORS)
        assert table.numbers("load", "the test").tolist() == [1.5, -2000.0]
        assert table.cells("remark", "the test") == ("a, b", "")
        assert table.lines == (3, 4)


def test_blanks_separate_and_names_are_given():
    given = {"header": ("time", "signal"), "separator": None}
    table = parse_table("0.0\t 1\n\n0.1\t -2\n", "x.dat", ERRORS, **given)
    assert table.numbers("signal", "the test").tolist() == [1.0, -2.0]
    assert table.lines == (1, 3)
    with refused(
        WrongFileError, r"^x\.dat, line 2: the row has 1 cell, but 2 columns \(time, signal\) are"
    ):
        parse_table("0.0\t1\n0.1\n", "x.dat", ERRORS, **given)


@pytest.mark.parametrize(
    "text", ["٩٫٨١", "٩.٨١", "９.81", "1_000", "9,81", "", "0x10", "9.81 N", "−1"]
)
def test_what_is_no_number_in_plain_digits_is_refused(text):
    with refused(ValueError, r"digits|convert"):
        plain_number(text)
    table = parse_table(f'load,x\n"{text}",1\n', "loads.csv", ERRORS)
    with refused(WrongFileError, r"^loads\.csv, line 2: column 'load' must hold a number"):
        table.numbers("load", "the test")


@pytest.mark.parametrize(("text", "sentence"), INPUTS.refused("table"))
def test_what_is_no_table_is_refused(text, sentence):
    with refused(WrongFileError, sentence):
        parse_table(text, "loads.csv", ERRORS)


def test_values_that_none_can_have():
    table = parse_table("load,x\n1,1e999\n0,1\n-1,2\n", "loads.csv", ERRORS)
    with refused(ValueRefusedError, r"line 2: column 'x' holds 1e999, and a finite number is"):
        table.numbers("x", "the test")
    with refused(ValueRefusedError, r"line 3: column 'load' holds 0, and a positive number"):
        table.numbers("load", "the test", positive=True)


def test_a_key_comes_once():
    table = parse_table("name\na\nb\n\na\n", "names.csv", ERRORS)
    table.refuse_repeated((1, 2, 3), "name", "keep one")
    with refused(WrongFileError, r"^names\.csv: the lines 2 and 5 hold the same name; keep one\.$"):
        table.refuse_repeated(table.cells("name", "the test"), "name", "keep one")
