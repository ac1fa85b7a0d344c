"""Why files of structures and wings are refused: one file of sentences, filled in here."""

import tomllib
from pathlib import Path

SENTENCES: dict[str, dict[str, str]] = tomllib.loads(
    Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
)
"""Sentences by table and name; braces stand for what the caller gives."""


def said(sentence: str, /, **values: object) -> str:
    """Return a sentence by table and name, such as "mesh.empty", with its values."""
    table, _, key = sentence.partition(".")
    return SENTENCES[table][key].format(**values)
