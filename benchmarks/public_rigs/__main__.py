"""Campaigns of further rigs that others measured: `python -m benchmarks.public_rigs DATA OUT`.

DATA holds the records as they were published; they are not part of the project, and
docs/explanation/measured_rigs.md says where they are. Campaign and `model.toml` of each rig are in
the folder of its name here; they were written before the first run. Printed: the commands that
search them.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

HERE = Path(__file__).parent
JOINED = 4
"""Number of samples of the gate that are averaged, to remove the table's 5 Hz from ten samples a
second."""
GATE_END = 36.0
"""Time after which the gate swings within the noise [s]."""
HEATER_STRIDE, HEATER_END = 10, 800.0
"""Every tenth sample of the heaters is taken, until this time [s]."""
SWINGS = 289
"""Number of the first samples of the long pendulum that are taken, 9.6 s."""
NEWTONS_PER_POUND = 4.4482216
LOADS = 20
"""Number of loads of the load cell in one of its two loadings."""


class Table(NamedTuple):
    """A table of a campaign: names of its columns, and its rows (N, columns)."""

    columns: str
    rows: FloatArray


def _since_first(rows: FloatArray) -> FloatArray:
    """Return rows of time and a reading (N, 2) with times since the first."""
    (first_time, _), *_ = rows
    return np.asarray(rows - [first_time, 0.0])


def cooling_water(data: Path) -> dict[str, Table]:
    """Return time and temperature of the mug, published with a number and minutes."""
    published = np.genfromtxt(data / "CoolingWater.csv", delimiter=",", skip_header=1)
    _, minutes, temperature = published.T
    return {"cooling": Table("time,water", np.column_stack((60.0 * minutes, temperature)))}


def two_heaters(data: Path) -> dict[str, Table]:
    """Return the power of the first heater and both temperatures, published with a number."""
    published = np.genfromtxt(data / "step_test_data.csv", delimiter=",", skip_header=1)
    seconds, _, power, first, second = published.T
    is_taken = (seconds % HEATER_STRIDE == 0) & (seconds <= HEATER_END)
    rows = np.column_stack((seconds, power, first, second))
    return {"step": Table("time,Q1,T1,T2", rows[is_taken])}


def damped_gate(data: Path) -> dict[str, Table]:
    """Return averaged positions of the gate beside a magnet, after it was blown at."""
    tables = {}
    for name, published, begin in (
        ("magnet_20", "Q2_20.txt", 9.0),
        ("magnet_10", "Q3_10.txt", 12.0),
    ):
        samples = np.genfromtxt(data / published, skip_header=2)
        time, _ = samples.T
        samples = samples[(time >= begin) & (time < GATE_END)]
        count = len(samples) // JOINED * JOINED
        means = samples[:count].reshape(-1, JOINED, 2).mean(axis=1)
        tables[name] = Table("time,position", _since_first(means))
    return tables


def long_pendulum(data: Path) -> dict[str, Table]:
    """Return the horizontal position of the bob in two halves of its first swings."""
    time, x, _ = np.genfromtxt(data / "8047.txt", skip_header=1)[:SWINGS].T
    samples = np.column_stack((time, x))
    half = SWINGS // 2 + 1
    tables = {}
    for name, part in (("first", samples[:half]), ("next", samples[half:])):
        tables[name] = Table("time,x", _since_first(part))
    return tables


def load_cell(data: Path) -> dict[str, Table]:
    """Return force [N] and deflection in two loadings; lines of other than two numbers are text."""
    rows = []
    for line in (data / "Pontius.dat").read_text(encoding="utf-8").splitlines():
        cells = line.split()
        if len(cells) == 2 and all(cell.replace(".", "", 1).isdigit() for cell in cells):
            rows.append([float(cells[1]) * NEWTONS_PER_POUND, float(cells[0])])
    published = np.array(rows)
    return {
        "first": Table("force,deflection", published[:LOADS]),
        "second": Table("force,deflection", published[LOADS:]),
    }


def wiffle_balls(data: Path) -> dict[str, Table]:
    """Return time and height of two balls, in two drops each."""
    tables = {}
    for ball in (1, 2):
        for drop in (1, 2):
            name = f"white_wiffle_{ball}_drop{drop}"
            rows = np.genfromtxt(data / f"{name}.csv", delimiter=",", skip_header=1)
            tables[name] = Table("time,height", rows)
    return tables


RIGS: dict[str, Callable[[Path], dict[str, Table]]] = {
    "cooling_water": cooling_water,
    "damped_gate": damped_gate,
    "load_cell": load_cell,
    "long_pendulum": long_pendulum,
    "two_heaters": two_heaters,
    "wiffle_balls": wiffle_balls,
}
"""Functions that return the tables of a campaign from the folder of the published records."""


def write(rig: str, data: Path, folder: Path) -> Path:
    """Write a campaign and `model.toml` from published records; return the folder."""
    tables = RIGS[rig](data)
    folder.mkdir(parents=True, exist_ok=True)
    for file in ("campaign.toml", "model.toml"):
        (folder / file).write_text(
            (HERE / rig / file).read_text(encoding="utf-8"), encoding="utf-8"
        )
    for name, table in tables.items():
        np.savetxt(
            folder / f"{name}.csv", table.rows, "%.9g", ",", header=table.columns, comments=""
        )
    return folder


def main() -> int:
    """Write the campaigns of the rigs whose records are there."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    for rig in RIGS:
        try:
            folder = write(rig, arguments.data, arguments.out / rig)
        except FileNotFoundError as missing:
            print(f"{rig} is passed over: there is no {missing.filename}.")
            continue
        print(
            f"uav-twin discrepancy run {folder} --model {folder / 'model.toml'} "
            f"--out {folder}_verdict"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
