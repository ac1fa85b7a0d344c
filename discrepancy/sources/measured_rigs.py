"""Published measurements of rigs as campaigns, each with its model beside it: read as they were published.

The data are not part of the package; `docs/measured_rigs.md` says where they are.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import CampaignFileError
from reporting.files import atomic_write_text
from reporting.table_file import table_text

FALLING = 3.0
"""While the reading of the sensor's z is below this share of a rest's, it falls [m/s^2]."""
CUT = 0.04
"""Left out at both ends of a fall: hands let go, and the ground comes [s]."""
HELD_OUT = ("fall_14", "fall_5")
LARGEST_LEVEL = 10.0
"""Where the tank's level sensor ends: readings there are left out [V]."""
SMOOTHED = 0.12
"""Window of the local cubic through the pendulum's angle [s]; its encoder counts in 0.0029 rad."""
STEP = 0.02
"""A sample of the pendulum is the mean over this [s]: one of its slower record, six of its faster one."""
THE_WING = "real_wing"
"""Among the rigs of the command line, the one with a model of its own (`real_wing.write_wing_campaign`)."""
SHIPPED = Path(__file__).with_name("rigs")
"""Model and campaign of each rig. Deviations of noise are those of the sixth differences of its records."""
TRIAL = """
[[trial]]
name = "{name}"
kind = "driven"
file = "{name}.csv"
begins = "unknown"
"""


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
    tables = RIGS[rig](Path(data))
    campaign, model = (
        (SHIPPED / rig / name).read_text(encoding="utf-8") for name in ("campaign.toml", "model.toml")
    )
    for name in (name for name in tables if name.startswith("fall_")):  # as many as were published
        trial = name.removesuffix(".csv")
        campaign += TRIAL.format(name=trial) + ("held_out = true\n" if trial in HELD_OUT else "")
    for name, text in {"model.toml": model, **tables, "campaign.toml": campaign}.items():
        atomic_write_text(folder / name, text)
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
    files = sorted(data.glob("fall_*.csv"), key=lambda path: path.stem.split("_")[1].zfill(9))
    if not files:
        raise CampaignFileError(
            f"There is no fall_NUMBER.csv in {data}: give the folder of the published records."
        )
    falls = {file.name: table_text(dict(zip(("time", "z"), fall_of(file), strict=True))) for file in files}
    return {"noise.csv": table_text({"time": np.round(rest[:, 0], 9), "z": rest[:, 3]}), **falls}


def _tanks(data: Path) -> dict[str, str]:
    """Return the record for estimation, and the one for validation, held out."""
    table = _numbers(data / "dataBenchmark.csv", ("uEst", "uVal", "yEst", "yVal"))
    time: FloatArray = 4.0 * np.arange(len(table), dtype=np.float64)
    pumps, levels = table[:, :2].T, table[:, 2:].T
    levels[levels >= LARGEST_LEVEL] = np.nan
    return {
        f"{name}.csv": table_text({"time": time, "pump": pump, "level": level})
        for name, pump, level in zip(("estimation", "validation"), pumps, levels, strict=True)
    }


def _pendulum(data: Path) -> dict[str, str]:
    """Return angle in, torque out: of a rod that turns over, a motion from torques would soon be another."""
    tables = {}
    for name in ("pd_trajectory", "ilqr"):
        table = _numbers(data / f"{name}.csv", ("time", "position", "velocity", "torque"))
        joined = max(round(STEP / float(np.median(np.diff(table[:, 0])))), 1)
        whole = len(table) // joined * joined  # what is left over at the end is dropped
        time, angle, _, torque = table[:whole].reshape(-1, joined, table.shape[1]).mean(axis=1).T
        angle = savgol_filter(angle, 2 * round(0.5 * SMOOTHED / STEP) + 1, 3)
        tables[f"{name}.csv"] = table_text({"time": np.round(time, 9), "angle": angle, "torque": torque})
    return tables


RIGS: dict[str, Callable[[Path], dict[str, str]]] = {
    "falling_phone": _phone,
    "two_tanks": _tanks,
    "pendulum": _pendulum,
}
"""What makes the tables of a campaign from a published folder, by the name of the rig."""
