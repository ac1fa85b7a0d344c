"""The one reader of JSON: a fault of a file is one sentence of the caller's exception.

Also records (dataclasses of numbers, words, arrays and other records) as plain data of JSON.
"""

import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from math import isfinite
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

import numpy as np

from reporting.text_file import check_nesting, decoded, read_text, too_deep

_SMALLEST_INTEGER = -(2**63)
_LARGEST_INTEGER = 2**63 - 1
_LONGEST_INTEGER = len(str(_SMALLEST_INTEGER))

JsonDocument: TypeAlias = Any
"""Plain data of JSON. Its type is open, because the reader of a file checks what the file holds."""
JsonRecord: TypeAlias = Mapping[str, JsonDocument]
"""An object of JSON that is read."""
JsonObject: TypeAlias = dict[str, JsonDocument]
"""An object of JSON that is made or changed."""


def read_json(path: Path | str, error: type[Exception], *, what: str = "file") -> JsonDocument:
    """Return the content of a JSON file.

    Parameters
    ----------
    path : Path or str
        The file; UTF-8, with or without a byte order mark.
    what : str
        What the file should be, for the message: "patch".

    Raises
    ------
    error
        If the file does not exist, cannot be read, is not UTF-8 or not JSON (which has no NaN), is
        nested too deeply, repeats a key, or holds a number that does not fit in 64 bits.
    """
    return parse_json(read_text(path, error, what=what), f"The {what} {path}", error)


def parse_json(
    content: bytes | str, source: str, error: type[Exception], *, any_number: bool = False
) -> JsonDocument:
    """Return the content of a JSON text.

    Parameters
    ----------
    source : str
        Where the text is from; begins the message.
    error : type of Exception
        The exception to raise, for the reasons of `read_json`.
    any_number : bool
        Whether the text may hold NaN, infinities, and integers beyond 64 bits, which become floats.
    """
    text = decoded(content, source, error) if isinstance(content, bytes) else content
    try:
        document = json.loads(
            text,
            parse_int=_parse_long_integer if any_number else _parse_integer,
            parse_float=float if any_number else _parse_finite_float,
            parse_constant=float if any_number else _refuse_number,
            object_pairs_hook=_object_without_repeated_keys,
        )
    except ValueError as cause:
        raise error(f"{source} is not valid JSON: {cause}.") from cause
    except RecursionError:
        raise error(too_deep(source)) from None
    check_nesting(document, source, error)
    return document


def _object_without_repeated_keys(pairs: list[tuple[str, object]]) -> dict[str, object]:
    """Return an object of JSON; Python itself would keep the last of repeated keys."""
    table = dict(pairs)
    if len(table) < len(pairs):
        counts = Counter(name for name, _ in pairs)
        repeated_key, _ = counts.most_common(1)[0]
        raise ValueError(f"the key {repeated_key!r} comes twice")
    return table


def _refuse_number(text: str) -> NoReturn:
    raise ValueError(f"{text[:40]} is not a number in JSON")


def _parse_finite_float(text: str) -> float:
    number = float(text)
    if not isfinite(number):
        _refuse_number(text)
    return number


def _parse_long_integer(digits: str) -> float:
    """Return a whole number as an integer, or as a float if it needs more than 64 bits."""
    if len(digits) < _LONGEST_INTEGER:
        return int(digits)
    return float(digits)


def _parse_integer(digits: str) -> int:
    """Return an integer that NumPy, HDF5 and `float` can hold; integers of Python have no limit."""
    # The length comes first: Python refuses to convert thousands of digits.
    if len(digits) <= _LONGEST_INTEGER:
        number = int(digits)
        if _SMALLEST_INTEGER <= number <= _LARGEST_INTEGER:
            return number
    raise ValueError(f"an integer of {len(digits)} digits, but a file may have 64 bits")


def _null(_: float) -> None:
    return None


def plain(value: object, not_finite: Callable[[float], object] = _null) -> JsonDocument:
    """Return a value as plain data of JSON, with all values inside it.

    The first of these cases that holds decides:

    - An object with a method `to_list` becomes the result of that method.
    - An enum becomes its value.
    - A dataclass becomes an object with the fields that its constructor takes.
    - A mapping becomes an object, whose keys are texts.
    - An array, tuple or list becomes a list, and a scalar of NumPy a number.
    - A NaN or an infinity, which JSON lacks, is replaced by `not_finite`.
    - Any other value is returned as it is.

    Parameters
    ----------
    not_finite : callable
        Is called with a NaN or an infinity, and returns the value to write in its place; null by
        default.
    """
    if hasattr(value, "to_list"):
        return value.to_list()
    if isinstance(value, Enum):
        return value.value
    if is_dataclass(value):
        arguments = [field.name for field in fields(value) if field.init]
        return {name: plain(getattr(value, name), not_finite) for name in arguments}
    if isinstance(value, Mapping):
        return {str(name): plain(entry, not_finite) for name, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, tuple | list):
        return [plain(entry, not_finite) for entry in value]
    if isinstance(value, float) and not isfinite(value):
        return not_finite(value)
    return value
