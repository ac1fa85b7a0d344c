"""The JSON Schema of a file format, from the class that reads or writes the format.

The description of a key is the text below the field in its class, or the entry of the key in the
section *Attributes* of the class's docstring. The unit of a value stands in brackets at the end of
a clause of its description, as in "Length of the record [s].", or in `json_schema_extra` of the
field's type.
"""

import ast
import inspect
import re
from collections.abc import Mapping
from functools import cache
from math import isfinite
from textwrap import dedent
from typing import Annotated, Any, TypeAlias

from pydantic import TypeAdapter, WithJsonSchema
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue, JsonSchemaWarningKind
from pydantic_core import core_schema

from reporting.json_file import JsonObject

JsonSchema: TypeAlias = JsonObject
"""A JSON Schema as plain data."""

DIALECT = "https://json-schema.org/draft/2020-12/schema"
"""The version of JSON Schema in which the schemas are written."""

NeverInFile = Annotated[object, WithJsonSchema({"not": {}})]
"""The type, for the schema, of a field of a record that a file must not contain."""

MUST_BE_STATED = "must_be_stated"
"""Key of `json_schema_extra` of a field that has a default in memory, but not in a file."""

_UNIT = re.compile(r"\s*\[([^\[\],]+)\](?=[.,;:)]|$)")
"""A unit in brackets at the end of a clause."""
_SECTION_OF_DOCSTRING = re.compile(r"^(\w[\w ]*)\n-{3,}\n", re.MULTILINE)
"""The heading of a section of a docstring in NumPy's form."""


def format_schema(model: Any, title: str) -> JsonSchema:
    """Return the JSON Schema of a format, which editors and other programs can use.

    Parameters
    ----------
    model : type
        The class that reads or writes the format: a model of pydantic, a dataclass, a `TypedDict`,
        or a union of them.
    title : str
        What a file of this format is, for people: "scenario".
    """
    schema = TypeAdapter(model).json_schema(schema_generator=_DescribedSchema)
    return {"$schema": DIALECT, "title": title, **{**schema, "title": title}}


def attribute_descriptions(cls: type) -> dict[str, str]:
    """Return the description of each attribute of a class, own or inherited, by name."""
    descriptions: dict[str, str] = {}
    # A TypedDict has its bases beside the order in which methods are looked up.
    bases = (*cls.__dict__.get("__orig_bases__", ()), *cls.__mro__)
    for base in reversed(bases):
        if isinstance(base, type) and base.__module__.partition(".")[0] not in (
            "builtins",
            "typing",
            "pydantic",
            "enum",
        ):
            descriptions |= _own_descriptions(base)
    return descriptions


@cache
def _own_descriptions(cls: type) -> Mapping[str, str]:
    """Return the descriptions of attributes that the text of a class itself contains."""
    return {**_entries_of_docstring(cls.__dict__.get("__doc__") or ""), **_texts_below_fields(cls)}


def _entries_of_docstring(docstring: str) -> dict[str, str]:
    """Return the entries of the section *Attributes* of a docstring, by the attribute's name."""
    pieces = _SECTION_OF_DOCSTRING.split(inspect.cleandoc(docstring))
    # The pieces after the text are pairs: a heading and the text of its section.
    sections = dict(zip(pieces[1::2], pieces[2::2], strict=True))
    entries: dict[str, str] = {}
    names: list[str] = []
    for line in sections.get("Attributes", "").splitlines():
        if line and not line.startswith(" "):
            names = [name.strip() for name in line.partition(" : ")[0].split(",")]
            entries |= dict.fromkeys(names, "")
            continue
        for name in names:
            entries[name] = f"{entries[name]} {line.strip()}".strip()
    return entries


def _texts_below_fields(cls: type) -> dict[str, str]:
    """Return the texts that stand below fields in the source of a class, by the field's name."""
    try:
        source = dedent(inspect.getsource(cls))
    except (OSError, TypeError):  # a class that was made at run time has no source
        return {}
    (definition,) = ast.parse(source).body
    texts: dict[str, str] = {}
    if not isinstance(definition, ast.ClassDef):
        return texts
    for statement, next_statement in zip(definition.body, definition.body[1:], strict=False):
        if not isinstance(statement, ast.AnnAssign) or not isinstance(statement.target, ast.Name):
            continue
        if not isinstance(next_statement, ast.Expr):
            continue
        text = next_statement.value
        if isinstance(text, ast.Constant) and isinstance(text.value, str):
            texts[statement.target.id] = " ".join(text.value.split())
    return texts


def summary_of_class(cls: type) -> str:
    """Return the text of a class's own docstring before its first section, in one paragraph."""
    docstring = inspect.cleandoc(cls.__dict__.get("__doc__") or "")
    text = _SECTION_OF_DOCSTRING.split(docstring)[0]
    return " ".join(text.split())


class _DescribedSchema(GenerateJsonSchema):
    """Generates JSON Schemas whose keys have descriptions and units, and no titles."""

    # A default such as an empty array of NumPy belongs to a field that no file contains.
    ignored_warning_kinds: set[JsonSchemaWarningKind] = {  # noqa: RUF012 - as in the base class
        "skipped-choice",
        "non-serializable-default",
    }

    def field_title_should_be_set(self, schema: object) -> bool:
        """Return false: a title of a key would only repeat the name of the key."""
        return False

    def model_schema(self, schema: core_schema.ModelSchema) -> JsonSchemaValue:
        """Return the schema of a model of pydantic."""
        return _described(super().model_schema(schema), schema["cls"])

    def dataclass_schema(self, schema: core_schema.DataclassSchema) -> JsonSchemaValue:
        """Return the schema of a dataclass."""
        fields: Any = schema["schema"].get("fields", [])
        names = {field.get("validation_alias", field["name"]): field["name"] for field in fields}
        return _described(super().dataclass_schema(schema), schema["cls"], names)

    def typed_dict_schema(self, schema: core_schema.TypedDictSchema) -> JsonSchemaValue:
        """Return the schema of a `TypedDict`."""
        return _described(super().typed_dict_schema(schema), schema["cls"])

    def is_instance_schema(self, schema: core_schema.IsInstanceSchema) -> JsonSchemaValue:
        """Return the schema of an object of Python, such as an array, which no file contains."""
        return {"not": {}}


def _described(
    schema: JsonSchemaValue, cls: type, attribute_of_key: Mapping[str, str] | None = None
) -> JsonSchemaValue:
    """Return the schema of a class with the descriptions and units of its keys.

    Keys that no file contains are left out.

    Parameters
    ----------
    schema : dict
        The schema of the class without descriptions.
    cls : type
        The class.
    attribute_of_key : mapping of str to str, optional
        The attribute of each key; by default a key has the name of its attribute.
    """
    if "properties" not in schema:
        return schema
    descriptions = attribute_descriptions(cls)
    required = list(schema.get("required", []))
    properties: JsonSchema = {}
    for key, key_schema in schema["properties"].items():
        if "not" in key_schema:
            continue
        described = {**key_schema}
        if described.pop(MUST_BE_STATED, False):
            described.pop("default", None)
            required.append(key)
        default = described.get("default")
        if isinstance(default, float) and not isfinite(default):  # JSON has no such number
            del described["default"]
        attribute = (attribute_of_key or {}).get(key, key)
        if attribute in descriptions:
            described |= _description_and_unit(descriptions[attribute])
        properties[key] = described
    described_schema = {**schema, "properties": properties}
    summary = summary_of_class(cls)
    if summary:
        described_schema["description"] = summary
    if required:
        described_schema["required"] = [key for key in properties if key in required]
    return described_schema


def _description_and_unit(text: str) -> JsonSchema:
    """Return the description of a key without the unit in brackets, and the unit, if it has one."""
    match = _UNIT.search(text)
    if match is None:
        return {"description": text}
    description = text[: match.start()] + text[match.end() :]
    return {"description": description, "unit": match[1]}
