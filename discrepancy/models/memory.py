"""Results that are asked for again and again, kept by what they depend on."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

KEPT = 256
"""Results that are kept unless told otherwise."""

_Value = TypeVar("_Value")


class Memory:
    """Results by key, the least recently used forgotten where there are more than `size`.

    `weight` says how much of the size a result takes; one each if it is left out. `end` is called with each
    that is forgotten.
    """

    def __init__(
        self,
        size: int = KEPT,
        weight: Callable[[Any], int] = lambda _: 1,
        end: Callable[[Any], None] = lambda _: None,
    ) -> None:
        self._size, self._weight, self._end, self._taken = size, weight, end, 0
        self._values: OrderedDict[Hashable, Any] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], _Value]) -> _Value:
        """Return what `make` returned for `key`, calling it if need be."""
        try:
            value = self._values[key]
        except KeyError:
            value = self._values[key] = make()
            self._taken += self._weight(value)
            while self._taken > self._size and len(self._values) > 1:
                self._forget()
            return value
        self._values.move_to_end(key)
        return value  # type: ignore[no-any-return]

    def clear(self) -> None:
        """Forget all results."""
        while self._values:
            self._forget()

    def _forget(self) -> None:
        value = self._values.popitem(last=False)[1]
        self._taken -= self._weight(value)
        self._end(value)
