"""Sentences in a TOML file beside a module, filled in where they are said."""

import tomllib
from pathlib import Path
from typing import Any


class Sentences:
    """The sentences of a package.

    Parameters
    ----------
    module : str
        File of the module; the sentences stand beside it, ``sentences.py`` -> ``sentences.toml``.

    Attributes
    ----------
    tables : dict
        Sentences by table and name; braces stand for what the caller gives.
    """

    def __init__(self, module: str) -> None:
        text = Path(module).with_suffix(".toml").read_text(encoding="utf-8")
        self.tables: dict[str, Any] = tomllib.loads(text)

    def said(self, sentence: str, /, **values: object) -> str:
        """Return a sentence by table and name, such as "mesh.empty", with its values."""
        table, _, key = sentence.partition(".")
        text: str = self.tables[table][key]
        return text.format(**values)
