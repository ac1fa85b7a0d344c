"""Messages of a package that stand in a TOML file and are filled in where they are raised."""

import tomllib
from collections.abc import Mapping, Set
from functools import cached_property
from pathlib import Path
from string import Formatter
from typing import Any

from reporting.words import comma_list


class _ListingFormatter(Formatter):
    """A formatter like `str.format` that writes collections as "a, b, c", and "none" if empty.

    With `!s` a collection is written as Python writes it: an index into an array, or a shape.
    """

    def convert_field(self, value: object, conversion: str | None) -> object:
        is_record = hasattr(value, "_fields")
        as_one_value = is_record or conversion == "s"
        if as_one_value or not isinstance(value, tuple | list | Set | Mapping):
            return super().convert_field(value, conversion)
        texts = []
        for entry in value:
            texts.append(str(super().convert_field(entry, conversion)))
        return comma_list(texts)


class Sentences:
    """The messages of a package.

    Parameters
    ----------
    module : str
        A file of the package; the messages stand beside it, in ``sentences.toml``.
    """

    def __init__(self, module: str) -> None:
        self._file = Path(module).with_name("sentences.toml")

    @cached_property
    def tables(self) -> dict[str, Any]:
        """The messages by table and name, with fields in braces; read when the first is needed."""
        return tomllib.loads(self._file.read_text(encoding="utf-8"))

    def said(self, sentence: str, /, **values: object) -> str:
        """Return a message with its fields filled in.

        Parameters
        ----------
        sentence : str
            Table and name of the message, such as "mesh.empty".
        **values : object
            The values of its fields; the entries of a collection are listed.
        """
        table, _, key = sentence.partition(".")
        template: str = self.tables[table][key]
        return _ListingFormatter().vformat(template, (), values)
