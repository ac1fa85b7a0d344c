"""What checks of an FMU found."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from fmu_asset.errors import visible

Verdict = Literal["ok", "warning", "problem", "skipped"]


@dataclass(frozen=True)
class Finding:
    """One check.

    Attributes
    ----------
    check : str
        What was checked, in a few words.
    verdict : {"ok", "warning", "problem", "skipped"}
        A warning is allowed but makes an FMU harder to use.
    text : str
        What was found, one sentence.
    """

    check: str
    verdict: Verdict
    text: str

    def __post_init__(self) -> None:
        """Make control characters, which names of an FMU may hold, visible."""
        object.__setattr__(self, "text", visible(self.text))


@dataclass(frozen=True)
class FmuCheck:
    """All checks of one FMU.

    Attributes
    ----------
    path : Path
        The FMU.
    findings : tuple of Finding
        In the order in which they were made.
    """

    path: Path
    findings: tuple[Finding, ...]

    def _texts(self, verdict: Verdict) -> tuple[str, ...]:
        return tuple(finding.text for finding in self.findings if finding.verdict == verdict)

    @property
    def problems(self) -> tuple[str, ...]:
        """One sentence each; empty if nothing is wrong."""
        return self._texts("problem")

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is allowed but makes the FMU harder to use."""
        return self._texts("warning")

    @property
    def passed(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems
