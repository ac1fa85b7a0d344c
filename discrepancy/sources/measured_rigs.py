"""Published measurements of rigs as campaigns, read as they were published.

The data are not part of the package; `docs/explanation/measured_rigs.md` says where they are.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter

from discrepancy.campaign.reading import CAMPAIGN_FILE
from discrepancy.campaign.records import FloatArray
from discrepancy.checks.held import runs_of_true
from discrepancy.errors import CampaignFileError
from discrepancy.sources.real_wing import real_wing
from discrepancy.sources.rig_files import RigFiles
from reporting.files import atomic_write_text
from reporting.formats.table_file import table_text
from reporting.formats.toml_file import toml_text

LARGEST_FALLING_READING = 3.0
"""Absolute reading of the phone's axis z below which it falls [m/s^2]."""
END_CUT = 0.04
"""Time that is left out at both ends of a fall, for the hands and the ground [s]."""
HELD_OUT_FALLS = ("fall_14", "fall_5")
"""Falls that are kept for proof."""
LARGEST_LEVEL = 10.0
"""End of the range of the tank's level sensor, where readings are left out [V]."""
SMOOTHED_SAMPLES = 7
"""Samples of the local cubic that smooths the pendulum's angle.

Its encoder has steps of 0.0029 rad.
"""
AVERAGING_TIME = 0.02
"""Time over which a sample of the pendulum is averaged [s]: one of its slower record, six of the
faster one."""
SHIPPED = Path(__file__).with_name("rigs")
"""Folder with a `campaign.toml` for each rig, and the model of a rig.

Deviations of noise are those of the sixth differences of its records."""


def write_rig_campaign(rig: str, data: Path, folder: Path, **options: object) -> Path:
    """Write the campaign of a rig from a folder of published measurements.

    The shipped TOML files of the rig (`campaign.toml`, and `model.toml` if it has one) are written
    too; trials, channels and remarks that come from the records are added to `campaign.toml`.

    Parameters
    ----------
    rig : str
        The name of the rig, one of `RIGS`.
    data : Path
        The folder of the published records.
    folder : Path
        The folder of the campaign.
    **options
        Options of the function in `RIGS`.

    Returns
    -------
    Path
        The folder of the campaign.

    Raises
    ------
    CampaignFileError
        If there is no such rig, a file is missing, or one is not as it was published.
    CampaignDataError
        If a record cannot be used.
    FileNotWrittenError, DiskFullError
        For the causes of `reporting.files.atomic_file`.
    """
    if rig not in RIGS:
        raise CampaignFileError(f"There is no rig {rig!r}: give one of {', '.join(RIGS)}.")
    files = RIGS[rig](Path(data), **options)
    keys = dict(files.campaign_keys)
    texts = {}
    for file in (SHIPPED / rig).glob("*.toml"):
        texts[file.name] = file.read_text(encoding="utf-8")
    texts |= files.tables
    # remarks are a key of the top level, which must come before the first table
    remarks = toml_text({"remarks": keys.pop("remarks", [])})
    texts[CAMPAIGN_FILE] = f"{remarks}{texts.pop(CAMPAIGN_FILE)}\n{toml_text(keys)}"
    for name, text in texts.items():
        atomic_write_text(folder / name, text)
    return folder


def _read_numbers(
    file: Path, columns: Sequence[str], separator: str | None = ",", skipped: int = 1
) -> dict[str, FloatArray]:
    """Return the first columns (N,) of a published table by the given names, in this order.

    `separator` is None for blanks between cells, and `skipped` the number of lines before the first
    line of numbers. Raises `CampaignFileError` if there is no such file, if it has fewer than 8
    rows or a cell that is no number, or if a column "time" does not increase.
    """
    if not file.is_file():
        raise CampaignFileError(f"There is no {file}: give the folder of the published records.")
    try:
        table = np.genfromtxt(
            file, delimiter=separator, skip_header=skipped, usecols=range(len(columns))
        )
    except ValueError:
        table = np.full((1, 1), np.nan)
    if table.ndim != 2 or len(table) < 8 or not np.all(np.isfinite(table)):
        raise CampaignFileError(
            f"{file} is not as it was published: it needs the columns {', '.join(columns)}."
        )
    numbers = dict(zip(columns, table.T, strict=True))
    if "time" in numbers and np.min(np.diff(numbers["time"])) <= 0.0:
        raise CampaignFileError(f"{file} is not as it was published: its times must increase.")
    return numbers


def longest_fall(file: Path) -> tuple[FloatArray, FloatArray]:
    """Return the longest free fall in a record of a phone, without `END_CUT` seconds at its ends.

    An accelerometer shows acceleration minus gravity, and so reads nearly zero in free fall. The
    phone falls while the absolute reading is below `LARGEST_FALLING_READING`.

    Returns
    -------
    time : (N,) ndarray
        Times since the release [s].
    acceleration : (N,) ndarray
        Readings of the acceleration along z [m/s^2].

    Raises
    ------
    CampaignFileError
        If the file is not as it was published, or holds no fall.
    """
    columns = _read_numbers(file, ("time", "x", "y", "z"))
    falls = runs_of_true(np.abs(columns["z"]) < LARGEST_FALLING_READING)  # (falls, 2)
    if not len(falls):
        raise CampaignFileError(
            f"{file} holds no fall: its column z never stays below {LARGEST_FALLING_READING:g} "
            "m/s2."
        )
    first_sample, end = falls[int(np.argmax(falls[:, 1] - falls[:, 0]))]
    in_fall = slice(first_sample, end)
    time, acceleration = columns["time"][in_fall], columns["z"][in_fall]
    is_inside = (time >= time[0] + END_CUT) & (time <= time[-1] - END_CUT)
    return np.round(time[is_inside] - time[0], 9), acceleration[is_inside]


def _phone_files(data: Path) -> RigFiles:
    """Return the files of a campaign of falls of a phone, and of its noise record.

    The accelerometer shows acceleration minus gravity, so that a free fall shows its bias alone.
    """
    at_rest = _read_numbers(
        data / "at_rest.txt", ("time", "x", "y", "z"), separator=None, skipped=0
    )
    files = sorted(data.glob("fall_*.csv"), key=lambda path: path.stem.split("_")[1].zfill(9))
    if not files:
        raise CampaignFileError(
            f"There is no fall_NUMBER.csv in {data}: give the folder of the published records."
        )
    tables = {}
    trials = []
    for file in files:
        time, acceleration = longest_fall(file)
        tables[file.name] = table_text({"time": time, "z": acceleration})
        trials.append(
            {
                "name": file.stem,
                "kind": "driven",
                "file": file.name,
                "begins": "unknown",
                "held_out": file.stem in HELD_OUT_FALLS,
            }
        )
    tables["noise.csv"] = table_text({"time": np.round(at_rest["time"], 9), "z": at_rest["z"]})
    return RigFiles(tables, {"trial": trials})


def _tank_files(data: Path) -> RigFiles:
    """Return the files of two records of two tanks: one for estimation, one for validation.

    Readings at the end of the range of the level sensor become empty cells.
    """
    columns = _read_numbers(data / "dataBenchmark.csv", ("uEst", "uVal", "yEst", "yVal"))
    # the records have no times: they were sampled every 4 s
    time: FloatArray = 4.0 * np.arange(len(columns["uEst"]), dtype=np.float64)
    tables = {}
    for name, suffix in (("estimation", "Est"), ("validation", "Val")):
        level = columns[f"y{suffix}"]
        level[level >= LARGEST_LEVEL] = np.nan
        tables[f"{name}.csv"] = table_text(
            {"time": time, "pump": columns[f"u{suffix}"], "level": level}
        )
    return RigFiles(tables, {})


def _pendulum_files(data: Path) -> RigFiles:
    """Return the files of two records of a pendulum, with the angle as input and torque as output.

    The torque is not the input: the rod turns over, and a motion that is simulated from the torque
    soon diverges from the measured one, because small errors grow at the upper equilibrium. Samples
    are averaged over `AVERAGING_TIME`, and angles are smoothed by a Savitzky-Golay filter.
    """
    tables = {}
    for name in ("pd_trajectory", "ilqr"):
        columns = _read_numbers(data / f"{name}.csv", ("time", "position", "velocity", "torque"))
        published_interval = float(np.median(np.diff(columns["time"])))
        group_size = max(round(AVERAGING_TIME / published_interval), 1)
        samples = np.stack((columns["time"], columns["position"], columns["torque"]), axis=1)
        # means of successive groups of samples; an incomplete group at the end is dropped
        group_count = len(samples) // group_size
        groups = samples[: group_count * group_size].reshape(group_count, group_size, 3)
        time, angle, torque = groups.mean(axis=1).T  # (groups,) each
        angle = savgol_filter(angle, SMOOTHED_SAMPLES, 3)
        tables[f"{name}.csv"] = table_text(
            {"time": np.round(time, 9), "angle": angle, "torque": torque}
        )
    return RigFiles(tables, {})


RIGS: dict[str, Callable[..., RigFiles]] = {
    "real_wing": real_wing,
    "falling_phone": _phone_files,
    "two_tanks": _tank_files,
    "pendulum": _pendulum_files,
}
"""Functions that make the files of a campaign from a published folder, by the name of the rig."""
