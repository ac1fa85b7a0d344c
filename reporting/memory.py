"""Results that are kept in memory, and how much memory this process may still take."""

import contextlib
import math
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any, TypeVar

_Value = TypeVar("_Value")


def memory_left() -> float:
    """Bytes that the machine, or the container, has left; infinite where it does not say."""
    left = math.inf
    with contextlib.suppress(OSError, ValueError, IndexError):
        text = Path("/proc/meminfo").read_text(encoding="ascii")
        left = 1024.0 * float(text.split("MemAvailable:")[1].split()[0])
    with contextlib.suppress(OSError, ValueError, IndexError):  # no such files, or the limit is "max"
        group = Path("/sys/fs/cgroup")
        limit, used, parts = (
            (group / f"memory.{key}").read_text(encoding="ascii") for key in ("max", "current", "stat")
        )
        files = float(parts.split("\ninactive_file ")[1].split()[0])  # kept of files until memory is wanted
        left = min(left, float(limit) - float(used) + files)
    return left


def _alike(_: object) -> int:
    return 1


class Memory:
    """Results by key, the least recently used forgotten where there are more than `size`.

    `weight` says how much of the size a result takes; one each if it is left out. `end` is called with each
    that is forgotten. Another process is handed none of them.
    """

    def __init__(
        self, size: int = 256, weight: Callable[[Any], int] = _alike, end: Callable[[Any], object] = _alike
    ) -> None:
        self._size, self._weight, self._end = size, weight, end
        self._values: dict[Hashable, Any] = {}
        self._taken = 0

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_values": {}, "_taken": 0}

    def get(self, key: Hashable, make: Callable[[], _Value]) -> _Value:
        """Return what `make` returned for `key`, calling it if need be."""
        if key in self._values:
            found: _Value = self._values.pop(key)
            self._values[key] = found
            return found
        value = self._values[key] = make()
        self._taken += self._weight(value)
        while self._taken > self._size and len(self._values) > 1:
            self._forget()
        return value

    def clear(self) -> None:
        """Forget all results."""
        while self._values:
            self._forget()

    def _forget(self) -> None:
        value = self._values.pop(next(iter(self._values)))
        self._taken -= self._weight(value)
        self._end(value)
