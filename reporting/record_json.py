"""Records (dataclasses of numbers, words, arrays and other records) as plain data of JSON."""

import math
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import numpy as np


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
