"""Results that are asked for again and again, kept by what they depend on."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

KEPT = 256
"""Results that are kept unless told otherwise."""

_Value = TypeVar("_Value")


class Memory:
    """Results by key, the least recently used forgotten."""

    def __init__(self, size: int = KEPT) -> None:
        self._size = size
        self._values: OrderedDict[Hashable, Any] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], _Value]) -> _Value:
        """Return what `make` returned for `key`, calling it if need be."""
        try:
            value = self._values[key]
        except KeyError:
            value = self._values[key] = make()
            if len(self._values) > self._size:
                self._values.popitem(last=False)
            return value
        self._values.move_to_end(key)
        return value  # type: ignore[no-any-return]
