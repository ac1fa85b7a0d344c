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
    verdict : {"ok", "warning", "problem", "skipped"}
        A warning is allowed but makes an FMU harder to use.
    text : str
        One sentence.
    """

    check: str
    verdict: Verdict
    text: str


class CheckResult(NamedTuple):
    """The result of a check: its verdict, and one sentence."""

    verdict: Verdict
    text: str

    def named(self, check: str) -> Finding:
        """Return the finding of the check with this name."""
        return Finding(check, self.verdict, self.text)


def one_line(error: FmuError) -> str:
    """Return the message of an error, and the last message of the FMU, in one line."""
    text = error.sentence
    if error.messages:
        text += f" The FMU says: {error.messages[-1]}"
    return " ".join(text.split())
