"""The JSON Schema of a file format, from the class that reads or writes the format.

The description of a key is the text below the field in its class. The unit of a value stands in
brackets at the end of a clause of this text, as in "Length of the record [s].", or in
`json_schema_extra` of the field's type. The texts of models are there only if
`reporting.formats.known_keys.TEXTS_ARE_READ` was set before they were defined.
"""

import re
from dataclasses import is_dataclass
from functools import cache
from inspect import cleandoc
from math import isfinite
from typing import Annotated, Any, TypeAlias

from pydantic import BaseModel, ConfigDict, TypeAdapter, WithJsonSchema
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue, JsonSchemaWarningKind
from pydantic_core import core_schema
from typing_extensions import is_typeddict

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
    schema = _schema_of(model)
    return {"$schema": DIALECT, "title": title, **{**schema, "title": title}}


def _schema_of(model: Any) -> JsonSchema:
    """Return the JSON Schema of a class, or of a union of classes."""
    # pydantic takes a configuration for a list of records, but not for a record itself
    adapter = TypeAdapter(list[model], config=ConfigDict(use_attribute_docstrings=True))
    schema = adapter.json_schema(schema_generator=_DescribedSchema)
    definitions = schema.get("$defs", {})
    root = schema["items"]
    if "$ref" in root:
        root = definitions.pop(root["$ref"].rpartition("/")[2])
    return {"$defs": definitions, **root} if definitions else root


def _summary_of_class(cls: type) -> str:
    """Return the text of a class's own docstring before its first section, in one paragraph."""
    text, *_ = _SECTION_OF_DOCSTRING.split(cleandoc(cls.__doc__ or ""))
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
        return _edit_schema(super().model_schema(schema), schema["cls"])

    def dataclass_schema(self, schema: core_schema.DataclassSchema) -> JsonSchemaValue:
        """Return the schema of a dataclass."""
        return _edit_schema(super().dataclass_schema(schema), schema["cls"])

    def typed_dict_schema(self, schema: core_schema.TypedDictSchema) -> JsonSchemaValue:
        """Return the schema of a `TypedDict`."""
        return _edit_schema(super().typed_dict_schema(schema), schema["cls"])

    def is_instance_schema(self, schema: core_schema.IsInstanceSchema) -> JsonSchemaValue:
        """Return the schema of an object of Python, such as an array, which no file contains."""
        return {"not": {}}


def _edit_schema(schema: JsonSchemaValue, cls: type) -> JsonSchemaValue:
    """Return the schema that pydantic made of a class, edited for readers of the format.

    - The description of the table is the summary of the docstring of `cls`.
    - A key that no file contains is left out: `NeverInFile` and objects of Python have the schema
      `{"not": {}}`.
    - A key with `MUST_BE_STATED` loses its default and is required.
    - A default that is infinite or NaN is dropped, because JSON has no such number.
    - The unit in brackets moves from the description of a key to the entry `unit`.
    - A key without a text below its field gets the description and the unit from a base class.
    """
    if "properties" not in schema:
        return schema
    required = list(schema.get("required", []))
    edited_keys: JsonSchema = {}
    for key, pydantic_schema in schema["properties"].items():
        if "not" in pydantic_schema:
            continue
        key_schema = {**pydantic_schema}
        if key_schema.pop(MUST_BE_STATED, False):
            key_schema.pop("default", None)
            required.append(key)
        default = key_schema.get("default")
        if isinstance(default, float) and not isfinite(default):
            del key_schema["default"]
        text = key_schema.pop("description", None)
        if text is None:
            key_schema |= _descriptions_of_bases(cls).get(key, {})
        else:
            key_schema |= _description_and_unit(text)
        edited_keys[key] = key_schema
    edited_schema = {**schema, "properties": edited_keys}
    edited_schema["description"] = _summary_of_class(cls)
    if required:
        edited_schema["required"] = [key for key in edited_keys if key in required]
    return edited_schema


@cache
def _descriptions_of_bases(cls: type) -> dict[str, JsonSchema]:
    """Return description and unit of each key that the base classes have.

    pydantic reads the texts below the fields that a class itself declares, and gives them on to
    subclasses of a model only as long as these do not declare the field anew.
    """
    descriptions: dict[str, JsonSchema] = {}
    # a TypedDict has its bases beside the order in which methods are looked up
    for base in (*cls.__dict__.get("__orig_bases__", ()), *reversed(cls.__mro__[1:])):
        if is_dataclass(base) or is_typeddict(base):
            for key, key_schema in _schema_of(base)["properties"].items():
                names = ("description", "unit")
                descriptions[key] = {name: key_schema[name] for name in names if name in key_schema}
        elif isinstance(base, type) and issubclass(base, BaseModel):
            for name, field in base.model_fields.items():
                if field.description:
                    descriptions[field.alias or name] = _description_and_unit(field.description)
    return descriptions


def _description_and_unit(text: str) -> JsonSchema:
    """Return the description of a key without the unit in brackets, and the unit, if it has one."""
    text = " ".join(text.split())
    match = _UNIT.search(text)
    if match is None:
        return {"description": text}
    description = text[: match.start()] + text[match.end() :]
    return {"description": description, "unit": match[1]}
