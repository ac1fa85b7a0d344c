"""How long a step takes to the screen: `python -m benchmarks.view_latency RUN`.

The journal of a flown mission is written again, line by line, at a given rate, while headless browsers look
at it; each page notes when it had painted a step.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from benchmarks.browser import open_browser
from twin_master.mission.journal import JOURNAL_NAME


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Run `uav-twin view` and give its address."""
    command = [sys.executable, "-m", "uav_twin", "view", str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        try:
            found = re.search(r"http://\S+", process.stdout.readline())
            assert found
            yield found.group()
        finally:
            process.terminate()


def latencies(run: Path, rate: float, viewers: int) -> dict[str, float]:
    """Return milliseconds from the write of a step to the paint that shows it, of every step and viewer."""
    lines = (run / JOURNAL_NAME).read_bytes().splitlines(keepends=True)
    with tempfile.TemporaryDirectory(prefix="uav_twin_view_") as place, open_browser() as browser:
        folder = Path(place) / "run"
        shutil.copytree(run, folder)
        journal = folder / JOURNAL_NAME
        journal.write_bytes(b"".join(lines[:2]))
        with served(folder) as address:
            tabs = [browser.tab() for _ in range(viewers)]
            for tab in tabs:
                tab.go(address)
            for tab in tabs:
                tab.wait("window.painted.length > 0")
            written = []
            with journal.open("ab", buffering=0) as file:
                begin = time.monotonic()
                for number, line in enumerate(lines[2:]):
                    time.sleep(max(0.0, begin + number / rate - time.monotonic()))
                    file.write(line)
                    written.append(1e3 * time.time())
            taken, paints = [], []
            for tab in tabs:
                tab.wait(f"window.painted.at(-1)[0] === {len(written)}")
                painted = np.array(tab.value("window.painted"))
                paints.append(len(painted) / (len(written) + 1))
                shown = np.searchsorted(painted[:, 0], np.arange(1, len(written) + 1))
                taken.append(painted[shown, 1] - np.array(written))
    values = np.concatenate(taken)
    return {
        "viewers": viewers, "steps": len(written), "steps_per_second": rate,
        "load_average": os.getloadavg()[0],
        "median_ms": float(np.median(values)), "p95_ms": float(np.quantile(values, 0.95)),
        "largest_ms": float(values.max()), "painted_share": float(np.mean(paints)),
    }  # fmt: skip


def main() -> None:
    """Print the figures of a flown run folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="a run folder that was flown")
    parser.add_argument("--rate", type=float, default=20.0, help="steps a second")
    parser.add_argument("--viewers", type=int, nargs="*", default=[1, 3])
    given = parser.parse_args()
    for viewers in given.viewers:
        print(json.dumps(latencies(given.run, given.rate, viewers)))


if __name__ == "__main__":
    main()
