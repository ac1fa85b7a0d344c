"""How records stand in JSON: numbers that JSON lacks, and patches by their primitives.

A number that is not a number is null, an infinite one "Infinity" or "-Infinity", because JSON has neither.
The records themselves (`verdict`) say what a file holds; pydantic checks it against them.
"""

from math import inf, isfinite, nan
from typing import Annotated, Any

from pydantic import PlainValidator, WithJsonSchema

from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import PRIMITIVES, ModelPatch, Primitive

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
    for name, kind in primitive.values().items():
        columns[name] = {"type": _JSON_TYPES[kind]}
        if name in units:
            columns[name]["description"] = f"[{units[name]}]"
    return {
        "type": "object",
        "title": primitive.__name__,
        "description": (primitive.__doc__ or "").split("\n")[0],
        "properties": {**columns, **({"windows": _WINDOWS} if primitive.in_windows else {})},
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
