"""Records (dataclasses of numbers, words, arrays and other records) as plain data of JSON, and back."""

import math
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

_Record = TypeVar("_Record")


def plain(value: Any) -> Any:
    """Return a value as JSON has it: records by their fields, arrays as lists, what is not finite as null."""
    if is_dataclass(value):
        return {item.name: plain(getattr(value, item.name)) for item in fields(value) if item.init}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def record_of(kind: type[_Record], content: Any) -> _Record:
    """Return the record of which `content` is the plain data; null is NaN where a number must stand.

    Raises
    ------
    KeyError, TypeError, ValueError
        If a field is missing or of another kind.
    """
    hints = get_type_hints(kind)
    names = [item.name for item in fields(kind) if item.init]  # type: ignore[arg-type]
    return kind(**{name: _value(hints[name], content[name]) for name in names})


def _value(hint: Any, content: Any) -> Any:
    if is_dataclass(hint):
        return record_of(hint, content)  # type: ignore[arg-type]
    arguments, origin = get_args(hint), get_origin(hint)
    if origin is tuple:
        return tuple(_value(arguments[0], item) for item in content)
    if origin is np.ndarray:
        return np.array(content)
    if type(None) in arguments:
        return None if content is None else _value(arguments[0], content)
    if hint is float:
        return math.nan if content is None else float(content)
    return hint(content) if hint in (int, str) else content
