"""`verdict.json`: what was concluded, what it rests on, and the proof."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from discrepancy.document_file import (
    Origin,
    effects_of,
    number,
    origin_of,
    origin_rows,
    plain,
    read_document,
    write_document,
)
from discrepancy.file_models import VERDICT_SCHEMA, VerdictDocument
from discrepancy.verdict import (
    Experiment,
    Gate,
    Hypothesis,
    Proof,
    Scores,
    Verdict,
    VerdictKind,
)

VERDICT_NAME = "verdict.json"


@dataclass(frozen=True)
class StoredVerdict:
    """Content of verdict.json."""

    verdict: Verdict
    proof: Proof | None
    origin: Origin


def write_verdict(path: Path, verdict: Verdict, proof: Proof | None, origin: Origin) -> Path:
    """Write verdict.json, whole or not at all; equal verdicts give equal bytes.

    Raises
    ------
    VerdictFileError
        If a record does not fit the schema.
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    content = {
        "schema": VERDICT_SCHEMA, **origin_rows(origin), "verdict": plain(verdict), "proof": plain(proof),
    }  # fmt: skip
    return write_document(path, content, VerdictDocument)


def read_verdict(path: Path) -> StoredVerdict:
    """Read the verdict.json that `write_verdict` wrote; the records are equal, nan included.

    Raises
    ------
    VerdictFileError
        If the file is missing, damaged, of another schema, or holds something else than it should.
    """
    content = read_document(path, VerdictDocument, VERDICT_SCHEMA)
    row = content["verdict"]
    verdict = Verdict(
        kind=VerdictKind(row["kind"]),
        sentence=row["sentence"],
        probability=number(row["probability"]),
        log_bayes_factor=number(row["log_bayes_factor"]),
        effects=effects_of(row["effects"], path),
        group=tuple(row["group"]),
        family=row["family"],
        gates=tuple(
            Gate(g["name"], g["passed"], number(g["statistic"]), number(g["limit"]), g["reason"])
            for g in row["gates"]
        ),
        hypotheses=tuple(
            Hypothesis(
                effects_of(h["effects"], path),
                *(number(h[k]) for k in ("log_evidence", "probability", "chi_square", "degrees_of_freedom")),
            )
            for h in row["hypotheses"]
        ),
        inclusion={name: number(value) for name, value in row["inclusion"].items()},
        next_experiments=tuple(
            Experiment(e["description"], number(e["information"]), number(e["cost"]), e["reason"])
            for e in row["next_experiments"]
        ),
        remarks=tuple(row["remarks"]),
        resembles=tuple(row["resembles"]),
    )
    return StoredVerdict(verdict, _proof(content["proof"]), origin_of(content))


def _proof(row: Mapping[str, Any] | None) -> Proof | None:
    if row is None:
        return None
    before, after = _scores(row["fitted_before"]), _scores(row["fitted_after"])
    assert before is not None
    assert after is not None
    return Proof(
        held_out_before=_scores(row["held_out_before"]),
        held_out_after=_scores(row["held_out_after"]),
        fitted_before=before,
        fitted_after=after,
        gap_closed=number(row["gap_closed"]),
        log_score_gain=number(row["log_score_gain"]),
        log_score_gain_error=number(row["log_score_gain_error"]),
        remaining=row["remaining"],
        gap_reason=row["gap_reason"],
    )


def _scores(row: Mapping[str, Any] | None) -> Scores | None:
    if row is None:
        return None
    numbers = {
        name: number(value) for name, value in row.items() if name not in ("rms", "pit", "sample_count")
    }
    return Scores(
        rms={name: number(value) for name, value in row["rms"].items()},
        pit=tuple(number(value) for value in row["pit"]),
        sample_count=row["sample_count"],
        **numbers,
    )
