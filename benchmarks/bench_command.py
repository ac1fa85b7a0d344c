"""Commands in processes of their own: first compilation, a run with everything kept, and the help.

Processor seconds of each command and of all processes that it starts.
"""

import os
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from benchmarks.measurement import Measurement, run_command

SCENARIO = "paper_level_turns"
REPEATS = 5
COMPILATION_NOTE = "Compiling loops"
"""What a command prints before it compiles."""
FIT_CODE = "from benchmarks.bench_estimation import fit_law; fit_law()"
"""A fit of a law to a record by simulation, as a search makes it for each hypothesis."""


def run() -> Iterator[Measurement]:
    """Measure the same commands with machine code that is kept, and from an empty folder."""
    command = [sys.executable, "-m", "uav_twin"]
    help_text = [*command, "--help"]
    yield Measurement("uav-twin --help", least_seconds_of_command(help_text, os.environ), "s", 0.2)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        flight = [*command, "run", SCENARIO, "--no-report", "--out", str(folder / "run")]
        flight += ["--replace"]
        kept = os.environ | {"NUMBA_CACHE_DIR": str(folder / "kept")}
        run_command(flight, os.environ)  # builds models, which are kept
        first_seconds = run_announced(flight, kept)
        warm_seconds = least_seconds_of_command(flight, kept)
        yield Measurement(
            f"uav-twin run {SCENARIO} --no-report, everything kept", warm_seconds, "s", 1.5
        )
        yield Measurement(
            "first compilation of a run, announced", first_seconds - warm_seconds, "s", 20.0
        )
        fit = [sys.executable, "-c", FIT_CODE]
        first_seconds = run_command(fit, kept).processor_seconds
        warm_seconds = run_command(fit, kept).processor_seconds
        yield Measurement(
            "first compilation of a fit, after that of a run",
            first_seconds - warm_seconds,
            "s",
            20.0,
        )


def least_seconds_of_command(command: list[str], environment: Mapping[str, str]) -> float:
    """Return the least processor seconds of a command, after one run to warm it."""
    run_command(command, environment)
    return min(run_command(command, environment).processor_seconds for _ in range(REPEATS))


def run_announced(command: list[str], environment: Mapping[str, str]) -> float:
    """Return the processor seconds of a command that compiles, and says so.

    Raises
    ------
    RuntimeError
        If the command does not announce that it compiles.
    """
    finished = run_command(command, environment)
    if COMPILATION_NOTE not in finished.output:
        raise RuntimeError(
            f"The command {' '.join(command[1:4])!r} compiled for the first time and did not "
            f"announce it by {COMPILATION_NOTE!r}."
        )
    return finished.processor_seconds
