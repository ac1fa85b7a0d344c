"""Provenance names what made a result and nothing else; plain data; what is kept in memory."""

import json
import math
import pickle
import socket
from dataclasses import dataclass
from http import HTTPStatus

import numpy as np
import pytest
from numpy.typing import NDArray

from reporting import provenance
from reporting.json_file import plain
from reporting.system.memory import ResultCache

# ---------------------------------------------------------------- provenance


def collect(**hashes: str) -> provenance.Provenance:
    """Return a provenance with a distribution that is installed and one that is not."""
    names = ["numpy", "no-such-distribution"]
    return provenance.collect_provenance(7, input_hashes=hashes, distributions=names)


@pytest.fixture
def record():
    return collect(z="1", a="2").as_dict()


def test_a_provenance_does_not_depend_on_the_order_of_inputs():
    assert collect(z="1", a="2") == collect(a="2", z="1")


def test_a_provenance_names_versions(record):
    python = record["versions"].pop("python")

    assert python.count(".") == 2
    assert record["versions"] == {
        "numpy": np.__version__,
        "no-such-distribution": "not installed",
    }


def test_a_provenance_names_seed_and_inputs(record):
    assert record["seed"] == 7
    assert list(record["input_hashes"]) == ["a", "z"]


def test_a_provenance_has_a_hash_of_each_package(record):
    hashes = record["source_hashes"].values()

    assert {len(value) for value in hashes} == {64}
    assert len(set(hashes)) == len(provenance.SOURCE_PACKAGES)


def test_a_provenance_names_no_folder_and_no_machine(record):
    text = json.dumps(record)

    assert "/" not in text
    assert socket.gethostname() not in text


def test_an_unknown_package_has_no_hash():
    with pytest.raises(ValueError, match="no package"):
        provenance.source_hash("no_such_package")


# ---------------------------------------------------------------- plain data


@dataclass(frozen=True, eq=False)
class Record:
    value: float
    inner: "tuple[Record, ...]" = ()
    words: tuple[str, ...] = ("x",)
    values: NDArray[np.float64] | None = None


def test_a_record_is_plain_data_of_json():
    record = Record(math.nan, (Record(0.1), Record(2)), values=np.array([0.1, 2.0]))

    text = json.dumps(plain(record), allow_nan=False)

    defaults = {"inner": [], "words": ["x"], "values": None}
    assert json.loads(text) == {
        "value": None,
        "inner": [{"value": 0.1} | defaults, {"value": 2} | defaults],
        "words": ["x"],
        "values": [0.1, 2.0],
    }


def test_keys_and_members_of_enumerations_are_plain():
    assert plain({7: HTTPStatus.NOT_FOUND}) == {"7": 404}


# ---------------------------------------------------------------- results in memory


@dataclass
class FilledCache:
    """A cache with room for six letters, and the texts that it has forgotten."""

    cache: ResultCache
    forgotten: list[str]


@pytest.fixture
def filled():
    """Seven letters were put in, and "one" was used before the last of them."""
    forgotten = list[str]()
    cache = ResultCache(6, weight=len, end=forgotten.append)
    for text in ("one", "two", "one", "four"):
        assert cache.get(text, lambda text=text: text) == text
    return FilledCache(cache, forgotten)


def test_the_least_recently_used_are_forgotten_if_there_is_no_room(filled):
    assert filled.forgotten == ["two", "one"]


def test_a_result_that_is_kept_is_not_made_again(filled):
    filled.cache.get("a", lambda: "a")

    assert filled.cache.get("four", lambda: "made anew") == "four"


def test_another_process_is_handed_no_results(filled):
    filled.cache.get("a", lambda: "a")

    copy = pickle.loads(pickle.dumps(filled.cache))

    assert copy.get("a", lambda: "anew") == "anew"


def test_results_are_ended_when_the_cache_is_cleared(filled):
    filled.cache.get("a", lambda: "a")
    filled.cache.get("four", lambda: "made anew")

    filled.cache.clear()

    assert filled.forgotten == ["two", "one", "a", "four"]
