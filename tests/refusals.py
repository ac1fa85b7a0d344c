"""Good inputs as files beside the tests, tables of what is refused in them, and refusals in one sentence."""

import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest


@contextmanager
def refused(
    error: type[Exception] | tuple[type[Exception], ...], sentence: str
) -> Iterator[pytest.ExceptionInfo[Exception]]:
    """Expect an error of which the message holds a regular expression, on one line."""
    with pytest.raises(error, match=sentence) as caught:
        yield caught
    assert "\n" not in str(caught.value)


class Inputs:
    """The files in the folder `inputs` of a folder of tests, or of a test file's.

    Each row of a table of `refused.toml` is a piece of a good input, what stands there instead, and the
    sentence, as a regular expression, that refuses it.
    """

    def __init__(self, place: str | Path) -> None:
        place = Path(place)
        self.folder = (place if place.is_dir() else place.parent) / "inputs"

    def text(self, name: str, *changes: tuple[str, str]) -> str:
        """Return a good input in which pieces are exchanged."""
        text = (self.folder / name).read_text(encoding="utf-8")
        for old, new in changes:
            assert old in text
            text = text.replace(old, new, 1)
        return text

    def table(self, name: str) -> dict[str, Any]:
        """Return the content of a TOML file."""
        return tomllib.loads(self.text(name))

    def refused(self, table: str) -> list[tuple[Any, ...]]:
        """Return the rows of a table."""
        return [tuple(row) for row in self.table("refused.toml")[table]]
