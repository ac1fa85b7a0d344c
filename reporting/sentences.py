"""Sentences in a TOML file of a package, filled in where they are said."""

import tomllib
from collections.abc import Mapping, Set
from functools import cached_property
from pathlib import Path
from string import Formatter
from typing import Any

MOST_LISTED = 30
"""Of several things, those that are written out."""


class _Written(Formatter):
    """Braces as in `str.format`; several things are written one after the other, "none" if there is none.

    As Python writes them with `!s`: a place in an array, a shape.
    """

    def convert_field(self, value: Any, conversion: str | None) -> Any:
        several = isinstance(value, tuple | list | Set | Mapping) and not hasattr(value, "_fields")
        if not several or conversion == "s":
            return super().convert_field(value, conversion)
        texts = [str(super(_Written, self).convert_field(item, conversion)) for item in value]
        more = f" and {len(texts) - MOST_LISTED} more" if len(texts) > MOST_LISTED else ""
        return (", ".join(texts[:MOST_LISTED]) or "none") + more


class Sentences:
    """The sentences of a package.

    Parameters
    ----------
    module : str
        A file of the package; the sentences stand beside it, in ``sentences.toml``.
    """

    def __init__(self, module: str) -> None:
        self._file = Path(module).with_name("sentences.toml")

    @cached_property
    def tables(self) -> dict[str, Any]:
        """Sentences by table and name; braces stand for what the caller gives. Read when one is said."""
        return tomllib.loads(self._file.read_text(encoding="utf-8"))

    def said(self, sentence: str, /, **values: object) -> str:
        """Return a sentence by table and name, such as "mesh.empty", with its values.

        Several values in one are written one after the other.
        """
        table, _, key = sentence.partition(".")
        text: str = self.tables[table][key]
        return _Written().vformat(text, (), values)


said = Sentences(__file__).said
"""A sentence of this package by "table.name", with its values."""
