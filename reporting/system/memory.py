"""A cache of results, and how much memory this process may still use."""

import contextlib
import math
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import TypeVar, cast

_Value = TypeVar("_Value")

_KIBIBYTE = 1024.0
_CONTROL_GROUP = Path("/sys/fs/cgroup")


def available_memory() -> float:
    """Return the memory that the machine or the container has left [bytes].

    The result is infinite if the system does not state it.
    """
    available = math.inf
    with contextlib.suppress(OSError, ValueError, IndexError):
        available = _available_memory_of_machine()
    # The files are missing outside a container, and the limit may be the word "max".
    with contextlib.suppress(OSError, ValueError, IndexError):
        available = min(available, _available_memory_of_container())
    return available


def _available_memory_of_machine() -> float:
    """Return the memory that the kernel can give to processes [bytes]."""
    text = Path("/proc/meminfo").read_text(encoding="ascii")
    kibibytes = text.split("MemAvailable:")[1].split()[0]
    return _KIBIBYTE * float(kibibytes)


def _available_memory_of_container() -> float:
    """Return the memory that the limit of the container (control group) leaves [bytes]."""
    limit = (_CONTROL_GROUP / "memory.max").read_text(encoding="ascii")
    used_memory = (_CONTROL_GROUP / "memory.current").read_text(encoding="ascii")
    statistics = (_CONTROL_GROUP / "memory.stat").read_text(encoding="ascii")
    # The kernel gives up cached file pages as soon as a process asks for memory.
    file_cache = float(statistics.split("\ninactive_file ")[1].split()[0])
    return float(limit) - float(used_memory) + file_cache


def _unit_weight(_: object) -> int:
    return 1


def _do_nothing(_: object) -> None:
    pass


class ResultCache:
    """A cache of results by key, which drops the least recently used results when it is full.

    A copy that is sent to another process starts empty.

    Parameters
    ----------
    size : int
        The largest total weight of the results. The newest result stays even if it alone weighs
        more.
    weight : callable
        Returns the weight of a result; 1 by default.
    end : callable
        Called with each result that the cache drops, also by `clear`.
    """

    def __init__(
        self,
        size: int = 256,
        weight: Callable[[object], int] = _unit_weight,
        end: Callable[[object], object] = _do_nothing,
    ) -> None:
        self._size = size
        self._weight = weight
        self._end = end
        self._values: dict[Hashable, object] = {}
        self._total_weight = 0

    def __getstate__(self) -> dict[str, object]:
        return vars(self) | {"_values": {}, "_total_weight": 0}

    def get(self, key: Hashable, make: Callable[[], _Value]) -> _Value:
        """Return the result of a key; if the cache does not hold it, `make` computes it."""
        if key in self._values:
            # Dictionaries keep the order of insertion: the last is the most recently used.
            cached = self._values.pop(key)
            self._values[key] = cached
            # A key always belongs to the same `make`, whose results are of one type.
            return cast(_Value, cached)
        value = make()
        self._values[key] = value
        self._total_weight += self._weight(value)
        while self._total_weight > self._size and len(self._values) > 1:
            self._drop_least_recently_used()
        return value

    def clear(self) -> None:
        """Drop all results."""
        while self._values:
            self._drop_least_recently_used()

    def _drop_least_recently_used(self) -> None:
        """Drop the result that was used least recently."""
        key = next(iter(self._values))
        value = self._values.pop(key)
        self._total_weight -= self._weight(value)
        self._end(value)
