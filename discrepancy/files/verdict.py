"""`verdict.json`: what was concluded, what it rests on, and the proof."""

from collections import ChainMap
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from discrepancy.location.residuals import ResidualSet
from discrepancy.verdict import Proof, Verdict
from fe.runtime.patch import ModelPatch
from reporting.folders import restore_folder

from .document import Origin, read_document, write_document
from .patch import PATCH_NAME, read_patch
from .residuals import RESIDUALS_NAME, read_residuals

VERDICT_SCHEMA = "uav-twin verdict 4"
"""Value of the key `schema`; files of earlier numbers are read too."""
VERDICT_NAME = "verdict.json"
_NEW: tuple[dict[str, Any], ...] = (
    {"explained": None, "remainders": [], "not_fitted": [], "windows": []},
    {"parameters": []},
    {"force": None},
)
LATER_KEYS = {f"uav-twin verdict {k + 1}": dict(ChainMap(*_NEW[k:])) for k in range(len(_NEW))}
"""Keys of the verdict that older files lack, by their schema."""


@dataclass(frozen=True)
class StoredVerdict:
    """Content of verdict.json."""

    verdict: Verdict
    proof: Proof | None
    origin: Origin


@dataclass(frozen=True)
class VerdictFolder(StoredVerdict):
    """What `uav-twin discrepancy run` left: the content of `verdict.json`, and more.

    Attributes
    ----------
    patch : ModelPatch or None
        The effects that were found, identical to what was found; None without `patch.json`.
    residuals : ResidualSet or None
        Data minus model with the effects, in standard deviations of the noise; None where faults of the data
        stopped the work.
    """

    patch: ModelPatch | None
    residuals: ResidualSet | None


def write_verdict(path: Path, verdict: Verdict, proof: Proof | None, origin: Origin) -> Path:
    """Write verdict.json, whole or not at all; equal verdicts give equal bytes.

    Raises
    ------
    VerdictFileError
        If a record does not fit the schema.
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    return write_document(path, VERDICT_SCHEMA, StoredVerdict(verdict, proof, origin))


def read_verdict_file(path: Path) -> StoredVerdict:
    """Read the verdict.json that `write_verdict` wrote; the records are equal, nan included.

    Raises
    ------
    VerdictFileError
        If the file is missing, damaged, of another schema, or holds something else than it should.
    """
    older = {schema: partial(_with_later_keys, keys) for schema, keys in LATER_KEYS.items()}
    return read_document(path, VERDICT_SCHEMA, StoredVerdict, older)


def _with_later_keys(keys: dict[str, Any], content: dict[str, Any]) -> dict[str, Any]:
    """Return the content of an older file with the keys that it lacks, empty."""
    verdict = content.get("verdict")
    if not isinstance(verdict, dict):
        return content
    hypotheses = verdict.get("hypotheses")
    if isinstance(hypotheses, list) and all(isinstance(row, dict) for row in hypotheses):
        verdict = {**verdict, "hypotheses": [{"parameters": [], **row} for row in hypotheses]}
    return {"model_file": None, **content, "verdict": {**keys, **verdict}}


def read_verdict(folder: Path | str) -> VerdictFolder:
    """Read the folder of a verdict.

    Parameters
    ----------
    folder : path
        As `uav-twin discrepancy run --out` leaves it.

    Raises
    ------
    VerdictFileError
        If a file is missing, damaged, of another schema, or holds something else than it should.
    """
    place = Path(folder)
    restore_folder(place)
    stored = read_verdict_file(place / VERDICT_NAME)
    patch, residuals = place / PATCH_NAME, place / RESIDUALS_NAME
    return VerdictFolder(
        **vars(stored),
        patch=read_patch(patch).patch if patch.is_file() else None,
        residuals=read_residuals(residuals) if residuals.is_file() else None,
    )
