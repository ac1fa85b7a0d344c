"""Errors of the discrepancy workflow, named by cause, and its tables of sentences."""

import tomllib
from collections.abc import Mapping, Set
from functools import cached_property
from pathlib import Path
from string import Formatter
from typing import Any

from reporting.errors import StandsForOthersError
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


SENTENCES = Sentences(__file__)
"""Proposals of experiments and rules of a verdict, by table."""


class DiscrepancyError(StandsForOthersError):
    """Any error that the discrepancy workflow raises on purpose."""


class CampaignFileError(DiscrepancyError, ValueError):
    """A campaign cannot be read: something is missing or is not of its kind."""


class CampaignDataError(DiscrepancyError, ValueError):
    """Measured data are not fit for use: gaps, a clipped channel, a unit slip, swapped channels."""


class ModelError(DiscrepancyError, ValueError):
    """The model lacks an input, an output or a parameter that the campaign needs."""


class CatalogueError(DiscrepancyError, ValueError):
    """An effect of the catalogue, or a user's own entry, cannot be built."""


class FitError(DiscrepancyError, RuntimeError):
    """A fit did not reach what was asked for."""


class VerdictFileError(DiscrepancyError, ValueError):
    """A stored verdict or patch is damaged, incomplete or of another format."""
