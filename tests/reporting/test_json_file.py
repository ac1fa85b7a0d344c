"""Reading JSON: one sentence for whatever is wrong."""

from pathlib import Path

import pytest

from reporting.json_file import parse_json, read_json


class WrongFileError(Exception):
    """What the reader is asked to raise."""


@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_a_byte_order_mark_means_nothing(tmp_path: Path, mark: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(mark + '{"a": [1, -9223372036854775808, 2.5, null]}', encoding="utf-8")
    assert read_json(path, WrongFileError) == {"a": [1, -(2**63), 2.5, None]}
    assert parse_json(path.read_bytes(), "It", WrongFileError) == read_json(path, WrongFileError)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "is not valid JSON"),
        (b"{", "is not valid JSON"),
        (b'{"a": 1', "is not valid JSON"),
        (b'{"a": ' + b"1" * 41 + b"}", "an integer of 41 digits, and 64 bits"),
        (b'{"a": 9223372036854775808}', "an integer of 19 digits, and 64 bits"),
        (b'{"a": -' + b"1" * 5000 + b"}", "an integer of 5001 digits"),
        (b'[{"b": 1, "a": 1, "a": 1}]', "the key 'a' comes twice"),
        (b'{"a": NaN}', "NaN is no number in JSON"),
        (b'{"a": [-Infinity]}', "-Infinity is no number in JSON"),
        (b'{"a": 1e400}', "1e400 is no number in JSON"),
        (b"[" * 40 + b"]" * 40, "nested deeper than 32"),
        (b'{"a":' * 5000 + b"1" + b"}" * 5000, "nested deeper than 32"),
        (b'{"a": "\xff"}', "not text in UTF-8"),
        (b"\0\0", "zero byte"),
    ],
)
def test_what_is_wrong_is_one_sentence(tmp_path: Path, content: bytes, told: str) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(content)
    for read in (
        lambda: read_json(path, WrongFileError, what="record"),
        lambda: parse_json(content, f"The record {path}", WrongFileError),
    ):
        with pytest.raises(WrongFileError, match=told) as caught:
            read()
        assert str(caught.value).startswith(f"The record {path} ")
        assert "\n" not in str(caught.value)
