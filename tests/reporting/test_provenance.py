"""Records as plain data; provenance names what made a result and nothing else; what is kept in memory."""

import hashlib
import json
import math
import pickle
import socket
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from reporting import provenance
from reporting.memory import Memory
from reporting.record_json import plain


def test_versions_of_the_stack():
    versions = provenance.stack_versions(["numpy", "no-such-distribution"])
    assert versions["numpy"] == np.__version__
    assert versions["no-such-distribution"] == "not installed"
    assert versions["python"].count(".") == 2


def test_a_record_is_plain_and_names_no_machine():
    record = provenance.collect_provenance(7, input_hashes={"z": "1", "a": "2"})
    assert record == provenance.collect_provenance(7, input_hashes={"a": "2", "z": "1"})
    text = json.dumps(record.as_dict())
    assert json.loads(text)["seed"] == 7
    assert list(record.as_dict()["input_hashes"]) == ["a", "z"]
    assert "/" not in text
    assert socket.gethostname() not in text


def test_hash_of_a_tree_sees_names_and_contents_but_not_line_ends(tmp_path):
    def hashed(**files: bytes) -> str:
        for path in tmp_path.iterdir():
            path.unlink()
        for name, content in files.items():
            (tmp_path / f"{name}.py").write_bytes(content)
        (tmp_path / "ignored.pyc").write_bytes(b"cache")
        return provenance.hash_tree(tmp_path, suffixes=[".py"])

    reference = hashed(a=b"x\n", b=b"y\n")
    assert reference == hashed(b=b"y\n", a=b"x\r\n")
    assert reference != hashed(a=b"x\n", c=b"y\n")
    assert reference != hashed(a=b"x\ny\n", b=b"")
    assert hashed(a=b"x", b=b"y") != hashed(a=b"xy", b=b"")


def test_hash_of_a_package():
    assert len(provenance.source_hash("reporting")) == 64
    assert provenance.source_hash("reporting") != provenance.source_hash("scenarios")
    with pytest.raises(ValueError, match="no package"):
        provenance.source_hash("no_such_package")


def test_hash_of_a_record_and_a_file(tmp_path):
    assert provenance.hash_record({"a": 1, "b": [1.5, "µ"]}) == provenance.hash_record(
        {"b": [1.5, "µ"], "a": 1}
    )
    with pytest.raises(ValueError, match=r"[Oo]ut of range|not JSON"):
        provenance.hash_record({"a": float("nan")})
    (tmp_path / "f").write_bytes(b"abc")
    assert provenance.hash_file(tmp_path / "f") == hashlib.sha256(b"abc").hexdigest()
    assert provenance.hash_bytes(b"abc") == hashlib.sha256(b"abc").hexdigest()


@dataclass(frozen=True, eq=False)
class Record:
    value: float
    inner: "tuple[Record, ...]" = ()
    words: tuple[str, ...] = ("x",)
    values: NDArray[np.float64] | None = None


def test_a_record_is_plain_data_of_json():
    record = Record(math.nan, (Record(0.1), Record(2)), values=np.array([0.1, 2.0]))
    own = {"inner": [], "words": ["x"], "values": None}
    expected = {"value": None, "inner": [{"value": 0.1} | own, {"value": 2} | own], "words": ["x"]}
    assert json.loads(json.dumps(plain(record), allow_nan=False)) == expected | {"values": [0.1, 2.0]}


def test_the_least_recently_used_are_forgotten_where_there_is_no_room():
    ended = list[str]()
    kept = Memory(6, weight=len, end=ended.append)
    for text in ("one", "two", "one", "four"):  # seven letters do not fit
        assert kept.get(text, lambda text=text: text) == text
    assert ended == ["two", "one"]
    kept.get("a", lambda: "a")
    assert kept.get("four", lambda: "made anew") == "four"
    kept.clear()
    assert ended == ["two", "one", "a", "four"]


def test_another_process_is_handed_nothing():
    kept = Memory(2)
    kept.get("x", lambda: 1)
    assert pickle.loads(pickle.dumps(kept)).get("x", lambda: 2) == 2
