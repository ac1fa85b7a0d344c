"""Findings of checks."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

from fmu_asset.errors import FmuError

Verdict = Literal["ok", "warning", "problem", "skipped"]
"""Result of a check; a warning is allowed but makes an FMU harder to use."""


@dataclass(frozen=True)
class Finding:
    """The result of a named check.

    Attributes
    ----------
    check : str
        Name of the check, a few words.
    verdict : {"ok", "warning", "problem", "skipped"}
        A warning is allowed but makes an FMU harder to use.
    text : str
        The finding as one sentence.
    """

    check: str
    verdict: Verdict
    text: str


class CheckResult(NamedTuple):
    """The result of a check: its verdict, and one sentence."""

    verdict: Verdict
    text: str

    def named(self, check: str) -> Finding:
        """Return the finding of a check of this name."""
        return Finding(check, self.verdict, self.text)


def one_line(error: FmuError) -> str:
    """Return in one line the message of an error, and the last message that the FMU logged."""
    text = error.sentence
    if error.messages:
        text += f" The FMU says: {error.messages[-1]}"
    return " ".join(text.split())
