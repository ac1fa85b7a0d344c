"""Results of an interrupted search: `verdict_so_far.json` in the folder of the verdict."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from discrepancy.document import Origin, document_schema, write_document
from discrepancy.judgement.decide import comparison_of
from discrepancy.judgement.hypotheses import hypothesis_record
from discrepancy.search.strategy import Search
from discrepancy.verdict import Hypothesis
from reporting.formats.schema import JsonSchema

SO_FAR_SCHEMA = "uav-twin verdict so far 1"
"""Value of the key `schema`."""
SO_FAR_NAME = "verdict_so_far.json"
MOST_HYPOTHESES = 20
"""Hypotheses that are written, the most probable first."""


@dataclass(frozen=True)
class VerdictSoFar:
    """Content of verdict_so_far.json."""

    remark: str
    """Limits of these figures, which are not those of a finished search."""
    hypotheses: tuple[Hypothesis, ...]
    """Hypotheses as in verdict.json, the most probable first; a hypothesis without effects is the
    unchanged model."""
    origin: Origin
    """Campaign, model and command."""


REMARK = (
    "The search was interrupted: probabilities are relative to the hypotheses that were fitted "
    "until then, no gate was applied, and nothing was proved on held-out trials."
)


@dataclass
class SearchInProgress:
    """Remembers the latest search of an investigation while it goes on.

    Attributes
    ----------
    search : Search or None
        The search that began last; None before the first one has begun.
    """

    search: Search | None = None

    def remember_search(self, search: Search) -> None:
        """Remember a search that begins."""
        self.search = search

    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """Return the hypotheses that the latest search has fitted, the most probable first.

        At most `MOST_HYPOTHESES` are returned, and none before a search has begun.
        """
        if self.search is None:
            return ()
        comparison = comparison_of(self.search)
        probabilities = list(comparison.set_probabilities().items())[:MOST_HYPOTHESES]
        return tuple(
            hypothesis_record(self.search.problem, comparison.best_of_set(names), probability)
            for names, probability in probabilities
        )


def so_far_schema() -> JsonSchema:
    """Return the JSON Schema of `verdict_so_far.json`; a null number is not known."""
    return document_schema(VerdictSoFar, SO_FAR_SCHEMA)


def write_so_far(folder: Path, hypotheses: Sequence[Hypothesis], origin: Origin) -> Path | None:
    """Write the hypotheses of an interrupted search to `verdict_so_far.json`.

    The folder is created if necessary. Without hypotheses nothing is written and None is returned.

    Raises
    ------
    VerdictFileError
        If a record does not fit the schema.
    FileNotWrittenError
        If the file cannot be written.
    """
    if not hypotheses:
        return None
    content = VerdictSoFar(REMARK, tuple(hypotheses), origin)
    return write_document(folder / SO_FAR_NAME, SO_FAR_SCHEMA, content)
