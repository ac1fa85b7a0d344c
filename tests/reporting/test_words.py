"""Words of sentences."""

import numpy as np
import pytest

from reporting.words import be, counted


@pytest.mark.parametrize(
    ("count", "text"), [(0, "0 trials"), (1, "1 trial"), (2, "2 trials"), (np.int64(1), "1 trial")]
)
def test_one_is_singular(count: int, text: str) -> None:
    assert counted(count, "trial") == text


def test_an_irregular_plural_is_given() -> None:
    assert counted(1, "entry", "entries") == "1 entry"
    assert counted(3, "entry", "entries") == "3 entries"


def test_the_verb_agrees() -> None:
    assert [be(count) for count in (0, 1, 2)] == ["are", "is", "are"]
