"""How much memory this process may still take."""

import contextlib
import math
from pathlib import Path


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
