"""Published measurements of rigs as campaigns, each with its model beside it: read as they were published.

The data are not part of the package; `docs/measured_rigs.md` says where they are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from discrepancy.errors import CampaignFileError
from reporting.files import atomic_write_text

FloatArray = NDArray[np.float64]

FALLING = 3.0
"""While the reading of the sensor's z is below this share of a rest's, it falls [m/s^2]."""
CUT = 0.04
"""Left out at both ends of a fall: hands let go, and the ground comes [s]."""
HELD_OUT = ("fall_14", "fall_5")
LEVEL_NOISE = 0.02
"""Deviation of the tank's level sensor by the sixth differences of its record [V]."""
LARGEST_LEVEL = 10.0
"""Where the tank's level sensor ends: readings there are left out [V]."""
SMOOTHED = 0.12
"""Window of the local cubic through the pendulum's angle [s]; its encoder counts in 0.0029 rad."""
STEP = 0.02
"""A sample of the pendulum is the mean over this [s]: one of its slower record, six of its faster one."""
TORQUE_NOISE = 0.02
"""Deviation of the pendulum's torque by the (median) sixth differences of its slower record [N m]."""

THE_WING = "real_wing"
"""Among the rigs of the command line, the one with a model of its own (`real_wing.write_wing_campaign`)."""

PHONE = """format = 1
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

TANKS = """format = 1
name = "Two tanks, outflow in proportion to the level"
capacity = [1.0, 1.0]                      # levels in V of the lower one's sensor

[[conductance_part]]
name = "upper outlet"
matrix = [[0.014, 0.0], [-0.014, 0.0]]     # 1/s

[[conductance_part]]
name = "lower outlet"
matrix = [[0.0, 0.0], [0.0, 0.014]]

[[input]]
name = "pump"
vector = [0.029, 0.0]
quantity = "voltage"

[[output]]
name = "lower level"
vector = [0.0, 1.0]
quantity = "voltage"

[[port]]
name = "upper outlet"
vector = [1.0, 0.0]
acts = [1.0, -1.0]                         # what leaves or overflows the upper tank enters the lower one

[[port]]
name = "lower outlet"
vector = [0.0, 1.0]
"""

PENDULUM = """format = 1
name = "Pendulum on a motor"
mass = 0.14                                # kg m2
free = true
damping = { matrix = 0.1 }                 # N m s

[[input]]
name = "angle"
vector = 1.0
quantity = "angle"

[[output]]
name = "torque"
reaction = "angle"
quantity = "torque"

[[port]]
name = "pivot"
vector = 1.0

[[law]]
name = "weight"
kind = "sine_force"
port = "pivot"
coefficient = 2.7                          # m g l [N m]
wave_number = 1.0
phase = 0.0
"""


def _parameters(*terms: tuple[str, str, float]) -> str:
    """Return parameters: name, what it scales, its deviation."""
    rows = [
        f'\n[[parameter]]\nname = "{name}"\nterms = "{term}"\ndeviation = {deviation}\n'
        "low = 0.01\nhigh = 10.0\n"
        for name, term, deviation in terms
    ]
    return "".join(rows)


TANKS += _parameters(
    ("upper_outlet", "upper outlet", 0.5), ("lower_outlet", "lower outlet", 0.5), ("pump_gain", "pump", 0.5)
)
PENDULUM += _parameters(
    ("inertia", "mass", 0.1), ("friction", "damping", 0.5), ("weight_factor", "weight", 0.1)
)


def write_rig_campaign(rig: str, data: Path, folder: Path) -> Path:
    """Write a campaign and `model.toml` from a published folder; return the folder.

    Raises
    ------
    CampaignFileError
        If there is no such rig, a file is missing, or one is not as it was published.
    FileNotWrittenError, DiskFullError
        As `reporting.files.atomic_file`.
    """
    if rig not in RIGS:
        raise CampaignFileError(f"There is no rig {rig!r}: give one of {', '.join((THE_WING, *RIGS))}.")
    texts = RIGS[rig](Path(data))
    last = "campaign.toml"
    for name in (*(name for name in texts if name != last), last):
        atomic_write_text(folder / name, texts[name])
    return folder


def _numbers(file: Path, columns: Sequence[str], separator: str | None = ",", skipped: int = 1) -> FloatArray:
    """Return columns (N, C) of a published table, the first ones, named for the sentence if it is none."""
    if not file.is_file():
        raise CampaignFileError(f"There is no {file}: give the folder of the published records.")
    try:
        found = np.genfromtxt(file, delimiter=separator, skip_header=skipped, usecols=range(len(columns)))
    except ValueError:
        found = np.full((1, 1), np.nan)
    if found.ndim != 2 or len(found) < 8 or not np.all(np.isfinite(found)):
        raise CampaignFileError(
            f"{file} is not as it was published: it needs the columns {', '.join(columns)}."
        )
    if columns[0] == "time" and np.min(np.diff(found[:, 0])) <= 0.0:
        raise CampaignFileError(f"{file} is not as it was published: its times must increase.")
    return np.asarray(found)


def _table(names: Sequence[str], columns: Sequence[FloatArray]) -> str:
    """Return a table; a reading that is left out (NaN) is an empty cell."""
    cells = [["" if np.isnan(value) else repr(value) for value in column.tolist()] for column in columns]
    rows = zip(*cells, strict=True)
    return "\n".join([",".join(names), *(",".join(row) for row in rows)]) + "\n"


def _means(table: FloatArray, joined: int) -> FloatArray:
    """Return the means of so many rows each, (N // joined, C); what is left over at the end is dropped."""
    whole = len(table) // joined
    return np.asarray(table[: whole * joined].reshape(whole, joined, -1).mean(axis=1))


def _section(kind: str, content: Mapping[str, str]) -> str:
    return "\n".join(["", f"[[{kind}]]", *(f"{key} = {value}" for key, value in content.items())]) + "\n"


def _driven(name: str, begins: str, held_out: bool) -> str:
    return _section(
        "trial",
        {
            "name": f'"{name}"',
            "kind": '"driven"',
            "file": f'"{name}.csv"',
            "begins": f'"{begins}"',
            **({"held_out": "true"} if held_out else {}),
        },
    )


def fall_of(file: Path) -> tuple[FloatArray, FloatArray]:
    """Return times [s] from the release and readings z [m/s^2] of the longest fall in a record."""
    data = _numbers(file, ("time", "x", "y", "z"))
    low = np.abs(data[:, 3]) < FALLING
    edges = np.flatnonzero(np.diff(np.r_[False, low, False].astype(int)))
    if not len(edges):
        raise CampaignFileError(f"{file} holds no fall: its column z never stays below {FALLING:g} m/s2.")
    begin, end = max(zip(edges[::2], edges[1::2], strict=True), key=lambda pair: pair[1] - pair[0])
    time, z = data[begin:end, 0], data[begin:end, 3]
    inside = (time >= time[0] + CUT) & (time <= time[-1] - CUT)
    return np.round(time[inside] - time[0], 9), z[inside]


def _phone(data: Path) -> dict[str, str]:
    """Return the falls; the sensor shows acceleration less gravity: nought in a free fall, and its bias."""
    rest = _numbers(data / "at_rest.txt", ("time", "x", "y", "z"), None, 0)
    campaign = 'format = 1\nname = "Falling phone"\n\n[noise]\nfile = "noise.csv"\n' + _section(
        "channel",
        {
            "name": '"z"',
            "quantity": '"acceleration"',
            "unit": '"m/s2"',
            "output": '"accelerometer"',
            "offset_deviation": "0.3  # the sensor's bias",
        },
    )
    texts = {"model.toml": PHONE, "noise.csv": _table(("time", "z"), (np.round(rest[:, 0], 9), rest[:, 3]))}
    files = sorted(data.glob("fall_*.csv"), key=lambda path: path.stem.split("_")[1].zfill(9))
    if not files:
        raise CampaignFileError(
            f"There is no fall_NUMBER.csv in {data}: give the folder of the published records."
        )
    for file in files:
        texts[f"{file.stem}.csv"] = _table(("time", "z"), fall_of(file))
        campaign += _driven(file.stem, "unknown", file.stem in HELD_OUT)
    return texts | {"campaign.toml": campaign}


def _tanks(data: Path) -> dict[str, str]:
    """Return the record for estimation, and the one for validation, held out."""
    table = _numbers(data / "dataBenchmark.csv", ("uEst", "uVal", "yEst", "yVal"))
    time: FloatArray = 4.0 * np.arange(len(table), dtype=np.float64)
    campaign = 'format = 1\nname = "Two tanks"\n'
    campaign += _section(
        "channel",
        {
            "name": '"level"',
            "quantity": '"voltage"',
            "unit": '"V"',
            "output": '"lower level"',
            "noise": f"{{ standard_deviation = {LEVEL_NOISE}, degrees_of_freedom = 200 }}",
        },
    )
    campaign += _section(
        "input", {"name": '"pump"', "quantity": '"voltage"', "unit": '"V"', "hold": '"zero_order"'}
    )
    texts = {"model.toml": TANKS}
    for column, name in enumerate(("estimation", "validation")):
        level = table[:, 2 + column].copy()
        level[level >= LARGEST_LEVEL] = np.nan
        texts[f"{name}.csv"] = _table(("time", "pump", "level"), (time, table[:, column], level))
        campaign += _driven(name, "unknown", column == 1)
    return texts | {"campaign.toml": campaign}


def _pendulum(data: Path) -> dict[str, str]:
    """Return angle in, torque out: of a rod that turns over, a motion from torques would soon be another."""
    campaign = 'format = 1\nname = "Pendulum on a motor"\n'
    campaign += _section(
        "channel",
        {
            "name": '"torque"',
            "quantity": '"torque"',
            "unit": '"N m"',
            "output": '"torque"',
            "offset_deviation": "0.1  # N m",
            "noise": f"{{ standard_deviation = {TORQUE_NOISE}, degrees_of_freedom = 20 }}",
        },
    )
    campaign += _section("input", {"name": '"angle"', "quantity": '"angle"', "unit": '"rad"'})
    texts = {"model.toml": PENDULUM}
    for name in ("pd_trajectory", "ilqr"):
        table = _numbers(data / f"{name}.csv", ("time", "position", "velocity", "torque"))
        joined = max(round(STEP / float(np.median(np.diff(table[:, 0])))), 1)
        time, angle, _, torque = _means(table, joined).T
        angle = savgol_filter(angle, 2 * round(0.5 * SMOOTHED / STEP) + 1, 3)
        texts[f"{name}.csv"] = _table(("time", "angle", "torque"), (np.round(time, 9), angle, torque))
        campaign += _driven(name, "still", name == "ilqr")
    return texts | {"campaign.toml": campaign}


RIGS: dict[str, Callable[[Path], dict[str, str]]] = {
    "falling_phone": _phone,
    "two_tanks": _tanks,
    "pendulum": _pendulum,
}
"""What makes the files of a campaign from a published folder, by the name of the rig."""
