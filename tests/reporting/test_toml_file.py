"""Whatever is wrong with a TOML file becomes one sentence of the caller's exception."""

from pathlib import Path

import pytest

from reporting.text_file import DEEPEST_NESTING
from reporting.toml_file import parse_toml, read_toml


class WrongFileError(Exception):
    """What the caller raises."""


def test_a_file_is_read_with_and_without_a_byte_order_mark(tmp_path: Path) -> None:
    file = tmp_path / "wing.toml"
    content = "name = 'Flügel'\nspan = 1.50\n[mesh]\ncells = [1, 2]\n"
    read = {"name": "Flügel", "span": 1.5, "mesh": {"cells": [1, 2]}}
    for encoding in ("utf-8", "utf-8-sig"):
        file.write_text(content, encoding=encoding)
        assert read_toml(file, WrongFileError) == read
        assert parse_toml(file.read_bytes(), "the draft", WrongFileError) == read


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"x = ", r"^The wing .*wing\.toml is not valid TOML: Invalid value"),
        (b"x = 1\nx = 2", r"is not valid TOML"),
        (b"x = \xff", r"is not text in UTF-8 \(invalid start byte at byte 5\): save it as UTF-8"),
        ("x = 1".encode("utf-16"), r"is not text in UTF-8"),
        (b"x = 1\0", r"holds a zero byte"),
        (b"x = " + b"[" * 50_000 + b"]" * 50_000, r"nested deeper than 32 tables or lists"),
        (b"x = " + b"{a = " * 40 + b"1" + b"}" * 40, r"nested deeper than 32 tables or lists"),
        (b"a" + b".a" * 50_000 + b" = 1", r"nested deeper than 32 tables or lists"),
        (b"x = " + b"9" * 5000, r"holds an integer of thousands of digits"),
        (
            b"[run]\nseeds = [1, 10000000000000000000000]",
            r"`run\.seeds\[2\]` is an integer of 74 bits, and 63",
        ),
    ],
)
def test_what_is_wrong_is_one_sentence(tmp_path: Path, content: bytes, sentence: str) -> None:
    file = tmp_path / "wing.toml"
    file.write_bytes(content)
    with pytest.raises(WrongFileError, match=sentence) as caught:
        read_toml(file, WrongFileError, what="wing")
    assert "\n" not in str(caught.value)


def test_what_is_not_there_is_one_sentence(tmp_path: Path) -> None:
    for path in (tmp_path / "none.toml", tmp_path):
        with pytest.raises(WrongFileError, match=r"^The file .* cannot be read: (No such|Is a)"):
            read_toml(path, WrongFileError)
    with pytest.raises(WrongFileError, match="is no name of a file"):
        read_toml("a\0b", WrongFileError)


def test_the_deepest_document_that_is_allowed_is_read() -> None:
    levels = DEEPEST_NESTING - 2  # the document itself and the value of x
    text = "x = " + "[" * levels + "7" + "]" * levels
    assert parse_toml(text, "the draft", WrongFileError)["x"]
    with pytest.raises(WrongFileError, match=r"^the draft is nested deeper"):
        parse_toml(text.replace("[", "[[").replace("]", "]]"), "the draft", WrongFileError)
