"""Campaigns of further rigs that others measured: `python -m benchmarks.public_rigs DATA OUT`.

DATA holds the records as they were published, `falling.txt`, `CoolingWater.csv` and `Q1.txt`, which
are not part of the project (docs/explanation/measured_rigs.md says where they are). Campaign and
`model.toml`
of each are in the folder of its name here; they were written before the first run. Printed: the
commands that search them.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

HERE = Path(__file__).parent
BLOWN = 9.0
"""The seismometer is blown at until then [s]."""
JOINED = 4
"""Number of samples that are averaged, to remove the table's 5 Hz from ten samples a second."""


def fall(data: FloatArray) -> FloatArray:
    """Return time [s] since the first sample, and height [m] of the coffee filter."""
    return np.asarray(data - [data[0, 0], 0.0])


def cooling(data: FloatArray) -> FloatArray:
    """Return time [s] and temperature [degC] of the mug, published with a number and minutes."""
    return np.asarray(data[:, 1:] * [60.0, 1.0])


def swing(data: FloatArray) -> FloatArray:
    """Return times [s] and averaged positions [V] of the seismometer after it was blown at."""
    data = data[data[:, 0] >= BLOWN]
    count = len(data) // JOINED * JOINED
    means = data[:count].reshape(-1, JOINED, 2).mean(axis=1)
    return np.asarray(means - [means[0, 0], 0.0])


RIGS: dict[str, tuple[str, int, str, str, Callable[[FloatArray], FloatArray]]] = {
    "coffee_filter": ("falling.txt", 2, "fall.csv", "height", fall),
    "cooling_water": ("CoolingWater.csv", 1, "cooling.csv", "water", cooling),
    "swinging_gate": ("Q1.txt", 2, "swing.csv", "position", swing),
}
"""Published file, heading lines, table of the campaign, its column, and its converter."""


def write(rig: str, data: Path, folder: Path) -> Path:
    """Write a campaign and `model.toml` from a published record; return the folder."""
    name, heading, table, column, convert = RIGS[rig]
    separator = "," if name.endswith(".csv") else None
    values = convert(np.genfromtxt(data / name, delimiter=separator, skip_header=heading))
    folder.mkdir(parents=True, exist_ok=True)
    for file in ("campaign.toml", "model.toml"):
        (folder / file).write_text(
            (HERE / rig / file).read_text(encoding="utf-8"), encoding="utf-8"
        )
    np.savetxt(folder / table, values, "%.9g", ",", header=f"time,{column}", comments="")
    return folder


def main() -> int:
    """Write the campaigns of the rigs whose records are there."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    for rig, (name, *_) in RIGS.items():
        if (arguments.data / name).is_file():
            folder = write(rig, arguments.data, arguments.out / rig)
            print(
                f"uav-twin discrepancy run {folder} --model {folder / 'model.toml'} "
                f"--out {folder}_verdict"
            )
        else:
            print(f"{rig} is passed over: there is no {arguments.data / name}.")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
