"""Records come back from plain data as they were."""

import json
import math
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from reporting.record_json import plain, record_of


@dataclass(frozen=True)
class Inner:
    name: str
    count: int
    limit: float | None = None


@dataclass(frozen=True, eq=False)
class Outer:
    value: float
    inner: tuple[Inner, ...]
    one: Inner
    values: NDArray[np.float64]
    words: tuple[str, ...]


def test_a_record_comes_back() -> None:
    record = Outer(math.nan, (Inner("a", 1), Inner("b", 2, 0.1)), Inner("c", 3), np.array([0.1, 2.0]), ("x",))
    content = json.loads(json.dumps(plain(record), allow_nan=False))
    assert content["value"] is None
    again = record_of(Outer, content)
    assert math.isnan(again.value)
    assert (again.inner, again.one, again.words) == (record.inner, record.one, record.words)
    np.testing.assert_array_equal(again.values, record.values)
    assert type(again.inner[0].count) is int


def test_what_is_missing_or_of_another_kind_is_refused() -> None:
    with pytest.raises(KeyError):
        record_of(Inner, {"name": "a"})
    with pytest.raises(ValueError, match="many"):
        record_of(Inner, {"name": "a", "count": "many", "limit": None})
    with pytest.raises(TypeError):
        record_of(Inner, None)
