"""What the workflow says of faults, verdicts and experiments: one file of sentences, filled in here."""

import tomllib
from pathlib import Path
from typing import Any

SENTENCES: dict[str, Any] = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
"""Sentences by table and name; braces stand for what the caller gives."""


def said(sentence: str, /, **values: object) -> str:
    """Return a sentence by table and name, such as "faults.clipped", with its values."""
    table, _, key = sentence.partition(".")
    text: str = SENTENCES[table][key]
    return text.format(**values)
