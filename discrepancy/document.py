"""Reading and writing records such as a verdict as JSON documents.

JSON has no values for nan and infinity: nan is written as null, infinity as "Infinity" or
"-Infinity". A patch is written as the list of its primitives. The content of a file is defined by
the record classes (`discrepancy.verdict`), against which pydantic checks it.
"""

import json
import shlex
from collections.abc import Callable, Collection
from dataclasses import dataclass, fields
from math import inf, isfinite, isnan, nan
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import (
    GetJsonSchemaHandler,
    PlainValidator,
    TypeAdapter,
    ValidationError,
    WithJsonSchema,
)
from pydantic_core import CoreSchema

from discrepancy.errors import VerdictFileError
from fe.runtime.errors import InvalidPatchError
from fe.runtime.laws import INSTALLED_LAWS
from fe.runtime.patch import PRIMITIVES, ModelPatch, Primitive
from reporting.files import atomic_write_text
from reporting.formats.schema import JsonSchema, format_schema
from reporting.json_file import JsonDocument, JsonObject, read_json
from reporting.json_file import plain as json_of
from reporting.provenance import Provenance

_WORDS = {None: nan, "Infinity": inf, "-Infinity": -inf}
"""What stands in JSON for numbers that it does not have."""
_NAME_OF_TRIAL = {"type": "string", "description": "Name of the trial."}
_BEGIN = {
    "type": ["number", "null"],
    "description": "Beginning in the time of the trial; null if it is open.",
    "unit": "s",
}
_END = {**_BEGIN, "description": "End in the time of the trial; null if it is open."}
_WINDOWS = {
    "type": "array",
    "description": "Stretches of trials in which the primitive acts; without them it acts always.",
    "items": {
        "type": "object",
        "description": "A stretch of a trial in which a primitive acts.",
        "properties": {"trial": _NAME_OF_TRIAL, "begin": _BEGIN, "end": _END},
        "required": ["trial", "begin", "end"],
        "additionalProperties": False,
    },
}


def _parse_number(value: object) -> float:
    """Return a number of a document; raise `ValueError` for anything else, such as a boolean."""
    if value is None or isinstance(value, str):
        if value not in _WORDS:
            raise ValueError(
                f'a number, null, "Infinity" or "-Infinity" is expected, but {value!r} was given'
            )
        return _WORDS[value]
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise ValueError(f"a finite number is expected, but {value!r} was given")
    return float(value)


def _parse_patch(rows: object) -> ModelPatch:
    """Return the patch of a list of primitives; raise `ValueError` if it is not one."""
    try:
        return ModelPatch.from_list(rows)
    except InvalidPatchError as cause:
        raise ValueError(str(cause)) from cause


def _primitive_schema(primitive: type[Primitive]) -> JsonObject:
    """Return the JSON Schema of one kind of primitive, from its own fields."""
    schema = format_schema(primitive, primitive.__name__)
    columns: JsonObject = {
        "kind": {"const": primitive.kind, "description": "Kind of the primitive."}
    }
    for name in primitive.value_types():
        column = schema["properties"][name]
        column.pop("default", None)  # a file states all values
        unit = primitive.units.get(name)
        columns[name] = {**column, "unit": unit} if unit else column
    windows = {"windows": _WINDOWS} if primitive.can_act_in_windows else {}
    return {
        "type": "object",
        "title": primitive.__name__,
        "description": schema["description"],
        "properties": {**columns, **windows},
        "required": list(columns),
        "additionalProperties": False,
    }


class _SchemaOfPatch:
    """Gives a patch its JSON Schema, which is made only if it is asked for."""

    @staticmethod
    def __get_pydantic_json_schema__(_: CoreSchema, __: GetJsonSchemaHandler) -> JsonObject:
        # editors know the shipped laws only
        shipped = [kind for kind in PRIMITIVES.values() if kind not in INSTALLED_LAWS]
        return {"type": "array", "items": {"oneOf": [_primitive_schema(kind) for kind in shipped]}}


Number = Annotated[
    float,
    PlainValidator(_parse_number),
    WithJsonSchema(
        {
            "anyOf": [{"type": "number"}, {"enum": ["Infinity", "-Infinity"]}, {"type": "null"}],
        }
    ),
]
Patch = Annotated[ModelPatch, PlainValidator(_parse_patch), _SchemaOfPatch()]


# ---------------------------------------------------------------- documents


_Record = TypeVar("_Record")


@dataclass(frozen=True)
class Origin:
    """What a verdict was reached from."""

    campaign: str
    """Name of the campaign, for messages and pages."""
    model: str
    """Name of the model, for messages and pages."""
    data_hash: str
    """SHA-256 of the campaign's files."""
    model_hash: str
    """SHA-256 of the model."""
    command: str
    """The command that repeats the investigation in any folder, with absolute paths."""
    provenance: Provenance
    """Seed, versions, hashes of the sources."""
    model_file: str | None = None
    """Absolute path of the model's file, or of the folder of a mission whose twin used the model;
    for a shipped model its name, empty for the shipped wing. None in files of versions that did not
    record it."""

    @property
    def short_command(self) -> str:
        """The command with file names in place of absolute paths, for pages that are shared."""
        words = shlex.split(self.command)
        return shlex.join(Path(word).name if Path(word).is_absolute() else word for word in words)


def document_schema(record_class: type, schema: str) -> JsonSchema:
    """Return the JSON Schema of a document, such as a verdict file.

    A document is the JSON text of a record with an attribute `origin`. The attributes of the origin
    are keys of the document itself, beside those of the record. The schema requires all keys and
    allows no others, as a document is always written with every key.

    Parameters
    ----------
    record_class : type
        Class of the record.
    schema : str
        Name of the schema, which a document states under its key `schema`.
    """
    record_schema = format_schema(record_class, schema)
    # nested objects: all keys are required
    definitions = record_schema["$defs"]
    origin_properties = definitions.pop("Origin")["properties"]
    for definition in definitions.values():
        if "properties" in definition:
            definition["required"] = list(definition["properties"])
            definition["additionalProperties"] = False
    # the document: the name of the schema, the keys of the origin, the other keys of the record
    record_properties = {
        key: entry for key, entry in record_schema["properties"].items() if key != "origin"
    }
    name_of_schema = {"const": schema, "description": "Name and version of the format."}
    properties = {"schema": name_of_schema, **origin_properties, **record_properties}
    return {
        **record_schema,
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


def plain_data(value: object) -> JsonDocument:
    """Return a record as plain data for JSON, with nan as None and infinity as "Infinity"."""

    def not_finite(number: float) -> str | None:
        if isnan(number):
            return None
        return "Infinity" if number > 0.0 else "-Infinity"

    return json_of(value, not_finite)


def write_document(path: Path, schema: str, record: object) -> Path:
    """Write a record with an `origin` as a JSON document, after a check that it can be read again.

    The file is written completely or not at all.

    Parameters
    ----------
    path : Path
        The file.
    schema : str
        Name of the schema, written under the key `schema`.
    record : dataclass instance
        The record. The fields of its `origin` become keys of the document itself.

    Raises
    ------
    VerdictFileError
        If the document could not be read again.
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    content = plain_data(record)
    try:
        _record_from_data(type(record), content)
    except _InvalidDocumentError as cause:
        raise VerdictFileError(f"{Path(path).name} cannot be written: {cause}.") from cause
    document = {"schema": schema, **content.pop("origin"), **content}
    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
    return atomic_write_text(path, f"{text}\n")


def read_document(
    path: Path,
    schema: str,
    record_class: type[_Record],
    older: Collection[str] = (),
    upgrade: Callable[[JsonObject], None] | None = None,
    **absent: JsonDocument,
) -> _Record:
    """Read a JSON document as a record, also one of an older schema.

    Parameters
    ----------
    path : Path
        The file.
    schema : str
        Name of the schema of this version.
    record_class : type
        Class of the record.
    older : collection of str
        Names of earlier schemas that are read, too.
    upgrade : callable, optional
        Changes the content of an older file to this schema, in place.
    **absent
        Keys that an older file may lack, and their values.

    Raises
    ------
    VerdictFileError
        If the file is missing, damaged, of another schema or does not fit the record.
    """
    path = Path(path)
    if not path.exists():
        raise VerdictFileError(
            f"There is no file {path}; give the one that the discrepancy workflow left."
        )
    content = read_json(path, VerdictFileError)
    schema_of_file = content.pop("schema", None) if isinstance(content, dict) else None
    if schema_of_file != schema and schema_of_file not in older:
        what = f"of the schema {schema_of_file!r}" if schema_of_file else "not a file of this kind"
        raise VerdictFileError(f"{path} is {what}, but {schema!r} is needed.")
    if schema_of_file != schema:
        content = {**absent, **content}
        if upgrade is not None:
            try:
                upgrade(content)
            except (AttributeError, KeyError, TypeError) as cause:
                raise VerdictFileError(
                    f"{path} does not fit its schema {schema_of_file!r}; write it again."
                ) from cause
    names_of_origin = [entry.name for entry in fields(Origin) if entry.name in content]
    origin = {name: content.pop(name) for name in names_of_origin}
    try:
        return _record_from_data(record_class, {**content, "origin": origin})
    except _InvalidDocumentError as cause:
        raise VerdictFileError(
            f"{path} does not fit its schema: {cause}; write it again."
        ) from cause


class _InvalidDocumentError(ValueError):
    """Plain data that are not a document; the message is its first fault."""


def _record_from_data(record_class: type[_Record], content: JsonObject) -> _Record:
    """Return plain data as a record of a class.

    Raises
    ------
    _InvalidDocumentError
        If the data lack an entry, have an unknown one, or one of another type.
    """
    try:
        return TypeAdapter(record_class).validate_json(
            json.dumps(content), strict=True, extra="forbid"
        )
    except ValidationError as cause:
        first = cause.errors()[0]
        place = ".".join(str(key) for key in first["loc"])
        count = cause.error_count()
        further = f" (and {count - 1} more)" if count > 1 else ""
        raise _InvalidDocumentError(f"{place}: {first['msg']}{further}") from cause
