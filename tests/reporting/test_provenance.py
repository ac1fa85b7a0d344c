"""Records as plain data; provenance names what made a result and nothing else; what is kept in memory."""

import json
import math
import pickle
import socket
from dataclasses import dataclass
from http import HTTPStatus

import numpy as np
import pytest
from numpy.typing import NDArray

from reporting import files as provenance
from reporting.json_file import plain
from reporting.memory import Memory


def test_a_record_names_versions_and_sources_and_no_machine():
    def collected(**hashes: str) -> provenance.Provenance:
        names = ["numpy", "no-such-distribution"]
        return provenance.collect_provenance(7, input_hashes=hashes, distributions=names)

    record = collected(z="1", a="2")
    assert record == collected(a="2", z="1")
    told = record.as_dict()
    python = told["versions"].pop("python")
    assert python.count(".") == 2
    assert told["versions"] == {"numpy": np.__version__, "no-such-distribution": "not installed"}
    assert (told["seed"], list(told["input_hashes"])) == (7, ["a", "z"])
    assert {len(value) for value in told["source_hashes"].values()} == {64}
    assert len({*told["source_hashes"].values()}) == len(provenance.SOURCE_PACKAGES)
    assert "/" not in json.dumps(told)
    assert socket.gethostname() not in json.dumps(told)
    with pytest.raises(ValueError, match="no package"):
        provenance.source_hash("no_such_package")


def test_hashes_see_names_and_contents_but_neither_line_ends_nor_order(tmp_path):
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
    one, other = {"a": 1, "b": [1.5, "µ"]}, {"b": [1.5, "µ"], "a": 1}
    assert provenance.hash_record(one) == provenance.hash_record(other)
    with pytest.raises(ValueError, match=r"[Oo]ut of range|not JSON"):
        provenance.hash_record({"a": float("nan")})


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
    assert plain({7: HTTPStatus.NOT_FOUND}) == {"7": 404}


def test_the_least_recently_used_are_forgotten_where_there_is_no_room():
    ended = list[str]()
    kept = Memory(6, weight=len, end=ended.append)
    for text in ("one", "two", "one", "four"):  # seven letters do not fit
        assert kept.get(text, lambda text=text: text) == text
    assert ended == ["two", "one"]
    kept.get("a", lambda: "a")
    assert kept.get("four", lambda: "made anew") == "four"
    assert (
        pickle.loads(pickle.dumps(kept)).get("a", lambda: "anew") == "anew"
    )  # another process is handed nothing
    kept.clear()
    assert ended == ["two", "one", "a", "four"]
