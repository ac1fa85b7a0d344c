"""What `verdict.json` and `patch.json` share: origin, numbers that JSON lacks, checks, atomic writing."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from importlib import resources
from math import inf, isfinite, isnan, nan
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from discrepancy.errors import VerdictFileError
from discrepancy.verdict import Estimate, NamedEffect
from fe.errors import InvalidPatchError
from fe.patch import ModelPatch
from reporting.files import atomic_write_text
from reporting.provenance import Provenance


@dataclass(frozen=True)
class Origin:
    """What a verdict was reached from.

    Attributes
    ----------
    campaign, model : str
        Names for people.
    data_hash, model_hash : str
        SHA-256 of the campaign's files and of the model.
    command : str
        The command that repeats it, without absolute paths.
    provenance : Provenance
        Seed, versions, hashes of the sources.
    """

    campaign: str
    model: str
    data_hash: str
    model_hash: str
    command: str
    provenance: Provenance


def shipped_schema(name: str) -> dict[str, Any]:
    """Return the JSON Schema that is shipped for "verdict" or "patch".

    Raises
    ------
    VerdictFileError
        If there is none of that name.
    """
    if name not in ("verdict", "patch"):
        raise VerdictFileError(f"There are JSON Schemas for verdict and patch, but not for {name!r}.")
    text = resources.files("discrepancy").joinpath(f"{name}.schema.json").read_text(encoding="utf-8")
    schema: dict[str, Any] = json.loads(text)
    return schema


def plain(value: Any) -> Any:
    """Return records as plain data that JSON can hold."""
    if isinstance(value, ModelPatch):
        return value.to_list()
    if isinstance(value, Enum):
        return value.value
    if is_dataclass(value) and not isinstance(value, type):
        return {item.name: plain(getattr(value, item.name)) for item in fields(value)}
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not isfinite(value):
        return None if isnan(value) else "Infinity" if value > 0.0 else "-Infinity"
    return value


def number(value: float | str | None) -> float:
    """Return the number that a file holds; nan for null."""
    if value is None:
        return nan
    if isinstance(value, str):
        return inf if value == "Infinity" else -inf
    return float(value)


def origin_rows(origin: Origin) -> dict[str, Any]:
    """Return the keys that every document begins with, after its schema."""
    return {
        "campaign": origin.campaign,
        "model": origin.model,
        "command": origin.command,
        "data_hash": origin.data_hash,
        "model_hash": origin.model_hash,
        "provenance": origin.provenance.as_dict(),
    }


def origin_of(content: Mapping[str, Any]) -> Origin:
    """Return the origin of a document that was read."""
    names = ("campaign", "model", "data_hash", "model_hash", "command")
    return Origin(**{name: content[name] for name in names}, provenance=Provenance(**content["provenance"]))


def effects_of(rows: Sequence[Mapping[str, Any]], path: Path) -> tuple[NamedEffect, ...]:
    """Return the effects of a document; raises `VerdictFileError` for an impossible primitive."""
    try:
        return tuple(
            NamedEffect(
                identifier=row["identifier"],
                name=row["name"],
                place=row["place"],
                family=row["family"],
                parameters=_estimates(row["parameters"]),
                shape=_estimates(row["shape"]),
                patch=ModelPatch.from_list(row["patch"], f"The effect {row['identifier']}"),
            )
            for row in rows
        )
    except InvalidPatchError as cause:
        raise VerdictFileError(f"{path} is damaged: {cause}") from cause


def _estimates(rows: Sequence[Mapping[str, Any]]) -> tuple[Estimate, ...]:
    return tuple(
        Estimate(
            e["name"], number(e["value"]), number(e["low"]), number(e["high"]), e["unit"], e["description"]
        )
        for e in rows
    )


def write_document(path: Path, content: dict[str, Any], document: type[BaseModel]) -> Path:
    """Check a document and write it in one step.

    Raises
    ------
    VerdictFileError
        If it does not fit its model.
    reporting.errors.FileNotWrittenError
        If it cannot be written.
    """
    try:
        document.model_validate(content)
    except ValidationError as cause:
        raise VerdictFileError(f"{Path(path).name} cannot be written: {_first(cause)}.") from cause
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
    return atomic_write_text(path, text + "\n")


def read_document(path: Path, document: type[BaseModel], schema: str) -> dict[str, Any]:
    """Return the content of a document as plain data.

    Raises
    ------
    VerdictFileError
        If the file is missing, damaged, of another schema or does not fit its model.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as cause:
        raise VerdictFileError(
            f"There is no file {path}; give the one that the discrepancy workflow left."
        ) from cause
    except OSError as cause:
        raise VerdictFileError(f"{path} cannot be read: {cause.strerror}.") from cause
    except (UnicodeDecodeError, json.JSONDecodeError) as cause:
        raise VerdictFileError(f"{path} is damaged or no JSON file ({cause}); write it again.") from cause
    came = content.get("schema") if isinstance(content, dict) else None
    if came != schema:
        raise VerdictFileError(
            f"{path} is {f'of the schema {came!r}' if came else 'no file of this kind'}, but {schema!r} is "
            "needed."
        )
    try:
        document.model_validate(content)
    except ValidationError as cause:
        raise VerdictFileError(f"{path} does not fit its schema: {_first(cause)}; write it again.") from cause
    checked: dict[str, Any] = content
    return checked


def _first(cause: ValidationError) -> str:
    """Return the place and text of the first thing that is wrong."""
    error = cause.errors()[0]
    place = ".".join(str(part) for part in error["loc"])
    more = f" (and {cause.error_count() - 1} more)" if cause.error_count() > 1 else ""
    return f"{place}: {error['msg']}{more}"
