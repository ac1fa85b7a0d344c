"""Records as plain data."""

import json
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reporting.record_json import plain


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


def test_a_record_is_plain_data_of_json():
    record = Outer(math.nan, (Inner("a", 1), Inner("b", 2, 0.1)), Inner("c", 3), np.array([0.1, 2.0]), ("x",))
    first, second, third = ({"name": name, "count": n} for n, name in enumerate("abc", start=1))
    assert json.loads(json.dumps(plain(record), allow_nan=False)) == {
        "value": None,
        "inner": [{**first, "limit": None}, {**second, "limit": 0.1}],
        "one": {**third, "limit": None},
        "values": [0.1, 2.0],
        "words": ["x"],
    }
