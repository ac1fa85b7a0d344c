"""How records stand in JSON: numbers that JSON lacks, and patches by their primitives.

A number that is not a number is null, an infinite one "Infinity" or "-Infinity", because JSON has neither.
The records themselves (`verdict`) say what a file holds; pydantic checks it against them.
"""

import json
import shlex
from collections.abc import Callable, Collection
from dataclasses import dataclass, fields
from importlib import resources
from math import inf, isfinite, isnan, nan
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import PlainValidator, TypeAdapter, ValidationError, WithJsonSchema

from discrepancy.errors import VerdictFileError
from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import PRIMITIVES, ModelPatch, Primitive
from reporting.files import atomic_write_text
from reporting.json_file import plain as json_of
from reporting.json_file import read_json
from reporting.provenance import Provenance

PRIMITIVE_UNITS: dict[str, dict[str, str]] = {kind: item.units for kind, item in PRIMITIVES.items()}
"""Unit of every real parameter of every primitive (translational or rotational port: the first or second)."""

_WORDS = {None: nan, "Infinity": inf, "-Infinity": -inf}
_JSON_TYPES: dict[Any, str] = {float: "number", int: "integer", str: "string"}
_SECONDS = {"type": ["number", "null"], "description": "[s]; null: open."}
_WINDOWS = {
    "type": "array",
    "description": "It acts within these only: stretches of trials, in their time.",
    "items": {
        "type": "object",
        "properties": {"trial": {"type": "string"}, "begin": _SECONDS, "end": _SECONDS},
        "required": ["trial", "begin", "end"],
        "additionalProperties": False,
    },
}


def _number(value: object) -> float:
    if value is None or isinstance(value, str):
        if value not in _WORDS:
            raise ValueError(f'a number, null, "Infinity" or "-Infinity" is expected, and {value!r} came')
        return _WORDS[value]
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise ValueError(f"a finite number is expected, and {value!r} came")
    return float(value)


def _patch(rows: object) -> ModelPatch:
    try:
        return ModelPatch.from_list(rows)
    except InvalidPatchError as cause:
        raise ValueError(str(cause)) from cause


def _primitive_schema(primitive: type[Primitive]) -> dict[str, Any]:
    """Return the JSON Schema of one kind of primitive, from its own fields."""
    units = PRIMITIVE_UNITS[primitive.kind]
    columns: dict[str, Any] = {"kind": {"const": primitive.kind, "type": "string"}}
    for name, kind in primitive.value_types().items():
        columns[name] = {"type": _JSON_TYPES[kind]}
        if name in units:
            columns[name]["description"] = f"[{units[name]}]"
    return {
        "type": "object",
        "title": primitive.__name__,
        "description": (primitive.__doc__ or "").split("\n")[0],
        "properties": {**columns, **({"windows": _WINDOWS} if primitive.can_act_in_windows else {})},
        "required": list(columns),
        "additionalProperties": False,
    }


Number = Annotated[
    float,
    PlainValidator(_number),
    WithJsonSchema(
        {
            "anyOf": [{"type": "number"}, {"enum": ["Infinity", "-Infinity"]}, {"type": "null"}],
            "description": "null: not a number, or not known.",
        }
    ),
]
Patch = Annotated[
    ModelPatch,
    PlainValidator(_patch),
    WithJsonSchema(
        {
            "type": "array",
            "items": {"oneOf": [_primitive_schema(primitive) for primitive in PRIMITIVES.values()]},
        }
    ),
]


# ---------------------------------------------------------------- documents


_Record = TypeVar("_Record")


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
        The command that repeats it in any folder: its paths are absolute.
    provenance : Provenance
        Seed, versions, hashes of the sources.
    model_file : str or None
        Absolute path of the model's file, or of the mission whose twin's model it is; the name of a shipped
        model, empty for the shipped wing. None: not known, as of files before it was recorded.
    """

    campaign: str
    model: str
    data_hash: str
    model_hash: str
    command: str
    provenance: Provenance
    model_file: str | None = None

    @property
    def short_command(self) -> str:
        """The command with the names of files alone, for pages that are handed on."""
        words = shlex.split(self.command)
        return shlex.join(Path(word).name if Path(word).is_absolute() else word for word in words)


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
    """Return records as plain data that JSON can hold: null, "Infinity" and "-Infinity" for odd numbers."""
    return json_of(value, lambda odd: None if isnan(odd) else "Infinity" if odd > 0.0 else "-Infinity")


def write_document(path: Path, schema: str, record: object) -> Path:
    """Check a document, a record with an `origin`, and write it in one step.

    Raises
    ------
    VerdictFileError
        If it could not be read again.
    reporting.errors.FileNotWrittenError
        If it cannot be written.
    """
    content = plain(record)
    _checked(type(record), content, f"{Path(path).name} cannot be written: ", ".")
    whole = {"schema": schema, **content.pop("origin"), **content}
    return atomic_write_text(path, json.dumps(whole, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_document(
    path: Path,
    schema: str,
    kind: type[_Record],
    older: Collection[str] = (),
    upgrade: Callable[[dict[str, Any]], None] | None = None,
    **absent: Any,
) -> _Record:
    """Return the record of a document.

    Parameters
    ----------
    path : Path
        Of the file.
    schema : str
        That of this version.
    kind : type
        Of the record.
    older : collection of str
        Schemas that are read too.
    upgrade : callable, optional
        Makes the content of an older file that of this version, in place.
    **absent
        What an older file may lack.

    Raises
    ------
    VerdictFileError
        If the file is missing, damaged, of another schema or does not fit the record.
    """
    path = Path(path)
    if not path.exists():
        raise VerdictFileError(f"There is no file {path}; give the one that the discrepancy workflow left.")
    content = read_json(path, VerdictFileError)
    came = content.pop("schema", None) if isinstance(content, dict) else None
    if came != schema and came not in older:
        which = f"of the schema {came!r}" if came else "no file of this kind"
        raise VerdictFileError(f"{path} is {which}, but {schema!r} is needed.")
    content = {**({} if came == schema else absent), **content}
    if upgrade is not None and came != schema:
        try:
            upgrade(content)
        except (AttributeError, KeyError, TypeError) as cause:
            raise VerdictFileError(f"{path} does not fit its schema {came!r}; write it again.") from cause
    origin = {item.name: content.pop(item.name) for item in fields(Origin) if item.name in content}
    before, after = f"{path} does not fit its schema: ", "; write it again."
    return _checked(kind, {**content, "origin": origin}, before, after)


def _checked(kind: type[_Record], content: dict[str, Any], before: str, after: str) -> _Record:
    """Return the record of plain data that holds what it should and nothing else."""
    try:
        return TypeAdapter(kind).validate_json(json.dumps(content), strict=True, extra="forbid")
    except ValidationError as cause:
        error = cause.errors()[0]
        place = ".".join(str(part) for part in error["loc"])
        more = f" (and {cause.error_count() - 1} more)" if cause.error_count() > 1 else ""
        raise VerdictFileError(f"{before}{place}: {error['msg']}{more}{after}") from cause
