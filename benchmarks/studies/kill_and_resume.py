"""A killed and resumed run has the files of an uninterrupted one.

Shown in docs/explanation/benchmarks.md.

`python -m benchmarks.studies.kill_and_resume --trials 20` flies the shipped mission, kills it at
random moments, resumes it, and compares every file byte for byte. Further options after `--` go to
`python -m twin_master`, for example `-- --strain-library FOLDER`. The exit code is 1 if any trial
differs.
"""

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

COMPARED = (
    "run.nc",
    "config.json",
    "summary.json",
    "calibration.json",
    "wing.vtu",
    "journal.jsonl",
)


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "twin_master", "--quiet", *arguments]


def contents(folder: Path) -> dict[str, bytes]:
    """Return every file that must not depend on interruptions, by its name."""
    paths = [folder / name for name in COMPARED if (folder / name).is_file()]
    paths += sorted((folder / "csv").glob("*.csv")) + sorted(
        path for path in (folder / "asset").rglob("*") if path.is_file()
    )
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def wait_for_moment(
    process: subprocess.Popen[bytes], folder: Path, moment: random.Random, seconds: float
) -> None:
    """Wait for a random moment of the run: anywhere, or soon after the first checkpoint."""
    begin = time.monotonic()
    if moment.random() < 0.5:
        deadline = begin + moment.random() * seconds
    else:
        while process.poll() is None and not (folder / "journal.jsonl").exists():
            time.sleep(0.001)
        deadline = time.monotonic() + moment.random() * 0.1 * seconds
    while process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.001)


def trial(
    scenario: str, options: list[str], folder: Path, moment: random.Random, seconds: float
) -> int:
    """Fly with one to three kills; return how many kills met the run alive."""
    kills = 0
    for _ in range(moment.randint(1, 3)):
        begun = (folder / "config.json").exists()
        arguments = (
            ["--resume", str(folder)] if begun else [scenario, "--out", str(folder), *options]
        )
        with subprocess.Popen(command(*arguments)) as process:
            wait_for_moment(process, folder, moment, seconds)
            if process.poll() is None:
                process.send_signal(signal.SIGKILL)
                kills += 1
    begun = (folder / "config.json").exists()
    arguments = ["--resume", str(folder)] if begun else [scenario, "--out", str(folder), *options]
    subprocess.run(command(*arguments), check=True)
    return kills


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--scenario", default="level_turns")
    parser.add_argument("--seed", type=int, default=0, help="seed of the moments")
    parser.add_argument("options", nargs="*", help="options of the run, after --")
    arguments = parser.parse_args()
    moment = random.Random(arguments.seed)
    different = 0
    with tempfile.TemporaryDirectory() as place:
        uninterrupted = Path(place) / "whole"
        begin = time.monotonic()
        subprocess.run(
            command(arguments.scenario, "--out", str(uninterrupted), *arguments.options), check=True
        )
        seconds = time.monotonic() - begin
        expected = contents(uninterrupted)
        for number in range(arguments.trials):
            folder = Path(place) / f"trial-{number}"
            kills = trial(arguments.scenario, arguments.options, folder, moment, seconds)
            files = contents(folder)
            unequal = sorted(
                name for name in {*expected, *files} if expected.get(name) != files.get(name)
            )
            leftovers = [str(path.relative_to(folder)) for path in folder.rglob(".*")]
            different += bool(unequal or leftovers)
            outcome = (
                f"differs in {', '.join(unequal + leftovers)}"
                if unequal or leftovers
                else "identical"
            )
            print(f"trial {number + 1}: {kills} kills, {len(files)} files, {outcome}", flush=True)
    print(f"{arguments.trials - different} of {arguments.trials} trials bit-identical")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
