"""The one reader of JSON: whatever is wrong with a file becomes one sentence of the caller's exception.

Also records (dataclasses of numbers, words, arrays and other records) as plain data of JSON.
"""

import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from math import isfinite
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from reporting.text_file import check_nesting, decoded, read_text, too_deep

_LONGEST_INTEGER = len(str(-(2**63)))


def read_json(path: Path | str, error: type[Exception], *, what: str = "file") -> Any:
    """Return the content of a JSON file; parameters as `reporting.toml_file.read_toml`.

    Raises
    ------
    error
        The file is not there, cannot be read, is not UTF-8 or not JSON (which has no NaN), is nested too
        deeply, names a key twice, or holds a number that 64 bits cannot.
    """
    return parse_json(read_text(path, error, what=what), f"The {what} {path}", error)


def parse_json(content: bytes | str, source: str, error: type[Exception], *, any_number: bool = False) -> Any:
    """Return the content of JSON that was read elsewhere; `source` names it in the sentence of `error`.

    With `any_number` it may have NaN, infinities and numbers that 64 bits cannot hold, which are floats.
    """
    text = decoded(content, source, error) if isinstance(content, bytes) else content
    try:
        found = json.loads(
            text,
            parse_int=_any_integer if any_number else _integer,
            parse_float=float if any_number else _decimal,
            parse_constant=float if any_number else _refuse,
            object_pairs_hook=_table,
        )
    except ValueError as cause:
        raise error(f"{source} is not valid JSON: {cause}.") from cause
    except RecursionError:
        raise error(too_deep(source)) from None
    check_nesting(found, source, error)
    return found


def _table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object of JSON; of a key that comes twice Python would take the last."""
    table = dict(pairs)
    if len(table) < len(pairs):
        twice = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"the key {twice!r} comes twice")
    return table


def _refuse(number: str) -> NoReturn:
    raise ValueError(f"{number[:40]} is no number in JSON")


def _decimal(text: str) -> float:
    number = float(text)
    return number if isfinite(number) else _refuse(text)


def _any_integer(digits: str) -> float:
    return int(digits) if len(digits) < _LONGEST_INTEGER else float(digits)


def _integer(digits: str) -> int:
    """Return an integer that NumPy, HDF5 and `float` hold; Python's own is as long as the text."""
    if len(digits) > _LONGEST_INTEGER or not -(2**63) <= (number := int(digits)) < 2**63:
        raise ValueError(f"an integer of {len(digits)} digits, and 64 bits are what a file may hold")
    return number


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
    return odd(value) if isinstance(value, float) and not isfinite(value) else value
