"""The keys that a table of a file may have, from the class that describes the file."""

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from types import UnionType
from typing import Annotated, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel

TEXTS_ARE_READ = False
"""Whether pydantic reads the texts below the fields of models, which describe their keys.

It reads them when a model is defined, from its source: 0.2 s for those of a scenario. Only
`benchmarks.format_pages`, which writes the JSON Schemas, sets this, before it imports the models.
"""


def keys_of_table(model: object, location: tuple[int | str, ...]) -> list[str]:
    """Return the keys that the table at a location of a file may have.

    If several classes may describe the table, the keys are those of all of them. The list is empty
    if no class describes it.

    Parameters
    ----------
    model : type
        The class that describes the file: a model of pydantic, a dataclass, or a union of them.
    location : tuple of int and str
        The keys and indices that lead to the table. An entry that leads nowhere is passed over,
        since pydantic adds names of types to its locations.
    """
    types = [*_alternatives(model)]
    for step in location:
        inner_types: list[object] = []
        for candidate in types:
            inner_types += _inner_types(candidate, step)
        types = inner_types or types
    keys: dict[str, None] = {}
    for candidate in types:
        keys |= dict.fromkeys(_types_of_keys(candidate))
    return list(keys)


def _alternatives(annotation: object) -> Iterator[object]:
    """Yield the types that an annotation allows for a value, without metadata."""
    origin = get_origin(annotation)
    if origin is Annotated:
        yield from _alternatives(get_args(annotation)[0])
    elif origin in (Union, UnionType):
        for alternative in get_args(annotation):
            yield from _alternatives(alternative)
    else:
        yield annotation


def _inner_types(annotation: object, step: int | str) -> list[object]:
    """Return the types of the entry of a value at a key or an index; empty if there is none."""
    if isinstance(step, int):
        entries = [entry for entry in get_args(annotation) if entry is not Ellipsis]
        return [inner_type for entry in entries for inner_type in _alternatives(entry)]
    types_of_keys = _types_of_keys(annotation)
    if step in types_of_keys:
        return [*_alternatives(types_of_keys[step])]
    arguments = get_args(annotation)
    origin = get_origin(annotation)
    is_mapping = isinstance(origin, type) and issubclass(origin, Mapping)
    if is_mapping and len(arguments) == 2:
        return [*_alternatives(arguments[1])]
    return []


def _types_of_keys(annotation: object) -> dict[str, object]:
    """Return the type of each key of a model or dataclass, by the key; empty for other types."""
    if not isinstance(annotation, type):
        return {}
    if issubclass(annotation, BaseModel):
        model_fields = annotation.model_fields
        return {field.alias or name: field.annotation for name, field in model_fields.items()}
    if is_dataclass(annotation):
        hints = get_type_hints(annotation)
        return {field.name: hints[field.name] for field in fields(annotation)}
    return {}
