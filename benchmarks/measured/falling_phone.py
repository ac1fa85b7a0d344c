"""A phone that falls flat (Air Resistance From the Acceleration of a Falling Smartphone, CC0) as a campaign.

    python -m benchmarks.measured.falling_phone FOLDER_OF_THE_DATA CAMPAIGN

The sensor shows the acceleration less gravity: nought in a free fall, with its bias.
"""

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

FALLING = 3.0
"""While the reading of the sensor's z is below this share of a rest's, it falls [m/s^2]."""
CUT = 0.04
"""Left out at both ends of a fall: hands let go, and the ground comes [s]."""
HELD_OUT = ("fall_14", "fall_5")

MODEL = """format = 1
name = "Body that falls"
mass = 1.0
free = true

[[load]]
name = "gravity"
vector = -9.81
through = "mass"

[[output]]
name = "accelerometer"
vector = 1.0
quantity = "acceleration"
constant = 9.81

[[port]]
name = "air"
vector = 1.0
"""


def fall_of(file: Path) -> tuple[FloatArray, FloatArray]:
    """Return times [s] from the release and readings z [m/s^2] of the longest fall in a record."""
    data = np.loadtxt(file, delimiter=",", skiprows=1)
    low = np.abs(data[:, 3]) < FALLING
    edges = np.flatnonzero(np.diff(np.r_[False, low, False].astype(int)))
    begin, end = max(zip(edges[::2], edges[1::2], strict=True), key=lambda pair: pair[1] - pair[0])
    time, z = data[begin:end, 0], data[begin:end, 3]
    inside = (time >= time[0] + CUT) & (time <= time[-1] - CUT)
    return time[inside] - time[0], z[inside]


def write_campaign(data: Path, folder: Path) -> Path:
    """Write the falls as a campaign with its model beside it; returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.toml").write_text(MODEL)
    rest = np.loadtxt(data / "at_rest.txt")
    rows = [f"{t:.9f},{z!r}" for t, z in zip(rest[:, 0].tolist(), rest[:, 3].tolist(), strict=True)]
    (folder / "noise.csv").write_text("\n".join(["time,z", *rows]) + "\n")
    text = [
        "format = 1",
        'name = "Falling phone"',
        "",
        "[noise]",
        'file = "noise.csv"',
        "",
        "[[channel]]",
        'name = "z"',
        'quantity = "acceleration"',
        'unit = "m/s2"',
        'output = "accelerometer"',
        "offset_deviation = 0.3  # the sensor's bias",
    ]
    for file in sorted(data.glob("fall_*.csv"), key=lambda path: int(path.stem.split("_")[1])):
        time, z = fall_of(file)
        rows = [f"{t:.9f},{value!r}" for t, value in zip(time.tolist(), z.tolist(), strict=True)]
        (folder / f"{file.stem}.csv").write_text("\n".join(["time,z", *rows]) + "\n")
        text += ["", "[[trial]]", f'name = "{file.stem}"', 'kind = "driven"', f'file = "{file.stem}.csv"']
        text += ['begins = "unknown"', *(["held_out = true"] if file.stem in HELD_OUT else [])]
    (folder / "campaign.toml").write_text("\n".join(text) + "\n")
    return folder


if __name__ == "__main__":
    write_campaign(Path(sys.argv[1]), Path(sys.argv[2]))
