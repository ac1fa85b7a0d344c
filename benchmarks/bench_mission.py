"""A whole run: from nothing, with the cache warm, and its 50 steps."""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.measurement import Measurement

MEBIBYTE = 1024.0


def fly(folder: Path, cache: Path) -> tuple[float, float]:
    """Return the seconds of the shipped mission in a process of its own, and those of its steps."""
    begin = time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "twin_master", "level_turns", "--quiet", "--out", str(folder)],
        check=True,
        env=os.environ | {"XDG_CACHE_HOME": str(cache)},
    )
    seconds = time.perf_counter() - begin
    timing = json.loads((folder / "timing.json").read_text(encoding="utf-8"))
    steps = sum(timing[f"{part}_seconds"]["total"] for part in ("asset", "twin", "checkpoint"))
    return seconds, steps


def run() -> list[Measurement]:
    with tempfile.TemporaryDirectory() as place:
        cache = Path(place) / "cache"
        cold, _ = fly(Path(place) / "cold", cache)
        largest = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / MEBIBYTE
        warm = [fly(Path(place) / f"warm-{index}", cache) for index in range(3)]
    fastest = min(seconds for seconds, _ in warm)
    steps = min(seconds for _, seconds in warm)
    return [
        Measurement(
            "mission from nothing, design to report",
            cold,
            "s",
            90.0,
            "the same, cache warm",
            fastest,
        ),
        Measurement("largest process of a mission from nothing", largest, "MiB", 2048.0),
        Measurement("mission with the cache warm", fastest, "s", 10.0, "its 50 steps", steps),
        Measurement("50 steps through the worker, checkpoints included", steps, "s", 1.0),
    ]
