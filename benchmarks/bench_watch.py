"""A watch that is taken up after few steps and after 20,000, up to its next decision."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from benchmarks.measurement import Measurement
from reporting.progress import SilentProgress
from twin_master.feeds.feed_choice import file_feed
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.scenario.reading import load_scenario
from twin_master.watch.folder import Watch
from twin_master.watch.workflow import begin_watch, resume_watch

STEPS = 20_000
REPETITIONS = 7
SCENARIO = "level_turns"


class _Told(Exception):  # noqa: N818 - ends a watch behind its first decision
    pass


def record(watch: Watch, path: Path, steps: int) -> None:
    """Write what a sound wing shows, with noise."""
    scenario = watch.scenario
    values = watch.models[0].knowledge.sensor_model.value_per_draw[:, 0, 1].mean(axis=0)
    rng = np.random.default_rng(1)
    count = scenario.observation.count
    with path.open("w", encoding="utf-8") as file:
        file.write(
            "step,control," + ",".join(f"strain_{number + 1}" for number in range(count)) + "\n"
        )
        for step in range(steps):
            row = values + rng.normal(0.0, 1.2e-4, count)
            file.write(
                f"{step},{scenario.control_names[1]}," + ",".join(map(repr, row.tolist())) + "\n"
            )


def taken_up(folder: Path, log: Path) -> tuple[float, float]:
    """Return processor seconds until the next decision, with and without preparing the model."""

    def told(_decision: Mapping[str, object]) -> None:
        raise _Told

    journal = folder / JOURNAL_NAME
    size = journal.stat().st_size
    begin = time.process_time()
    with resume_watch(folder, None, SilentProgress()) as watch:
        prepared = time.process_time()
        try:
            watch.last_decision()
            watch.run(file_feed(log, watch.scenario, follow=True), told)
        except _Told:
            end = time.process_time()
    os.truncate(journal, size)
    return end - begin, end - prepared


def in_a_process(folder: Path, log: Path) -> list[float]:
    """Return processor seconds of a new process, and the part of them that `taken_up` measures."""
    command = [sys.executable, "-m", "benchmarks.bench_watch", str(folder), str(log)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return [float(word) for word in done.stdout.split()]


def run() -> list[Measurement]:
    """Measure after one step, after as many as are filtered again, and after years."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        seconds = {}
        log = place / "log.csv"
        for steps in (1, 99, STEPS + 19):  # 32 steps between two lines with all that is needed
            folder = place / str(steps)
            loaded = load_scenario(SCENARIO)
            with begin_watch(loaded.scenario, loaded.file, folder, SilentProgress()) as watch:
                if not log.exists():
                    record(watch, log, STEPS + 20)
                watch.run(file_feed(log, watch.scenario), lambda _decision: None, step_limit=steps)
            seconds[steps] = np.median(
                [in_a_process(folder, log) for _ in range(REPETITIONS)], axis=0
            )
    return [
        Measurement(
            f"a watch taken up after {STEPS + 19} steps{suffix}, beside one after {steps}",
            float(seconds[STEPS + 19][kind]),
            "s",
            None,
            f"after {steps}",
            float(seconds[steps][kind]),
        )
        for steps in (1, 99)
        for kind, suffix in ((0, ", all of its process"), (2, ", what depends on the journal"))
    ]


if __name__ == "__main__":
    without, behind = taken_up(Path(sys.argv[1]), Path(sys.argv[2]))
    print(time.process_time(), without, behind)
