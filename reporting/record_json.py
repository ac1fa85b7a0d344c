"""Records (dataclasses of numbers, words, arrays and other records) as plain data of JSON, and back."""

import math
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

_Record = TypeVar("_Record")


def plain(value: Any, odd: Callable[[float], Any] = lambda _: None) -> Any:
    """Return a value as JSON has it: records by their fields, arrays as lists.

    `odd` says what stands for a number that is not finite: null.
    """
    if hasattr(value, "to_list"):  # what says itself how it is written, as a patch does
        return value.to_list()
    if isinstance(value, Enum):
        return value.value
    if is_dataclass(value):
        return {item.name: plain(getattr(value, item.name), odd) for item in fields(value) if item.init}
    if isinstance(value, Mapping):
        return {str(name): plain(item, odd) for name, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, tuple | list):
        return [plain(item, odd) for item in value]
    return odd(value) if isinstance(value, float) and not math.isfinite(value) else value


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
