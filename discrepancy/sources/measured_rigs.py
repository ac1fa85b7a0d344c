"""Published measurements as campaigns, of rigs with their models beside them: read as they were published.

The data are not part of the package; `docs/measured_rigs.md` says where they are.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import helmert
from scipy.signal import savgol_filter

from calibration.dynamics.records import RingDownRecord, read_records
from calibration.errors import CalibrationError
from calibration.static.experiments import read_measurements
from discrepancy.campaign.reading import CAMPAIGN_FILE
from discrepancy.campaign.records import FloatArray
from discrepancy.errors import CampaignDataError, CampaignFileError, said
from reporting.files import atomic_write_text
from reporting.table_file import table_text
from reporting.toml_file import toml_text
from reporting.words import counted, is_or_are

FALLING = 3.0
"""While the reading of the sensor's z is below this share of a rest's, it falls [m/s^2]."""
CUT = 0.04
"""Left out at both ends of a fall: hands let go, and the ground comes [s]."""
HELD_OUT_FALLS = ("fall_14", "fall_5")
LARGEST_LEVEL = 10.0
"""Where the tank's level sensor ends: readings there are left out [V]."""
SMOOTHED = 7
"""Samples through which the local cubic of the pendulum's angle goes; its encoder counts in 0.0029 rad."""
STEP = 0.02
"""A sample of the pendulum is the mean over this [s]: one of its slower record, six of its faster one."""
SHIPPED = Path(__file__).with_name("rigs")
"""What is known of each campaign, and the model of a rig. Deviations of noise are those of the sixth
differences of its records."""

Made = tuple[dict[str, str], dict[str, Any]]
"""Tables of a campaign by their files, and what its file says besides: as many trials as were published."""


def write_rig_campaign(rig: str, data: Path, folder: Path, **options: Any) -> Path:
    """Write a campaign, and the `model.toml` of a rig, from a published folder; return the folder.

    Parameters
    ----------
    rig : str
        One of `RIGS`.
    data, folder : Path
        Where the records are, and where the campaign goes.
    **options
        Of `real_wing`: those of its records.

    Raises
    ------
    CampaignFileError
        If there is no such rig, a file is missing, or one is not as it was published.
    CampaignDataError
        If a record cannot be used.
    FileNotWrittenError, DiskFullError
        As `reporting.files.atomic_file`.
    """
    if rig not in RIGS:
        raise CampaignFileError(f"There is no rig {rig!r}: give one of {', '.join(RIGS)}.")
    tables, more = RIGS[rig](Path(data), **options)
    shipped = {file.name: file.read_text(encoding="utf-8") for file in (SHIPPED / rig).glob("*.toml")}
    first = toml_text({"remarks": more.pop("remarks", [])})
    whole = f"{first}{shipped.pop(CAMPAIGN_FILE)}\n{toml_text(more)}"
    for name, text in {**shipped, **tables, CAMPAIGN_FILE: whole}.items():
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
        wanted = ", ".join(columns)
        raise CampaignFileError(f"{file} is not as it was published: it needs the columns {wanted}.")
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


def _phone(data: Path) -> Made:
    """Return the falls; the sensor shows acceleration less gravity: nought in a free fall, and its bias."""
    rest = _numbers(data / "at_rest.txt", ("time", "x", "y", "z"), None, 0)
    files = sorted(data.glob("fall_*.csv"), key=lambda path: path.stem.split("_")[1].zfill(9))
    if not files:
        raise CampaignFileError(said("rigs.no_falls", data=data))
    falls = {file.name: table_text(dict(zip(("time", "z"), fall_of(file), strict=True))) for file in files}
    trials = [
        {"name": file.stem, "kind": "driven", "file": file.name, "begins": "unknown",
         "held_out": file.stem in HELD_OUT_FALLS}
        for file in files
    ]  # fmt: skip
    falls["noise.csv"] = table_text({"time": np.round(rest[:, 0], 9), "z": rest[:, 3]})
    return falls, {"trial": trials}


def _tanks(data: Path) -> Made:
    """Return the record for estimation, and the one for validation, held out."""
    table = _numbers(data / "dataBenchmark.csv", ("uEst", "uVal", "yEst", "yVal"))
    time: FloatArray = 4.0 * np.arange(len(table), dtype=np.float64)
    pumps, levels = table[:, :2].T, table[:, 2:].T
    levels[levels >= LARGEST_LEVEL] = np.nan
    return {
        f"{name}.csv": table_text({"time": time, "pump": pump, "level": level})
        for name, pump, level in zip(("estimation", "validation"), pumps, levels, strict=True)
    }, {}


def _pendulum(data: Path) -> Made:
    """Return angle in, torque out: of a rod that turns over, a motion from torques would soon be another."""
    tables = {}
    for name in ("pd_trajectory", "ilqr"):
        table = _numbers(data / f"{name}.csv", ("time", "position", "velocity", "torque"))
        joined = max(round(STEP / float(np.median(np.diff(table[:, 0])))), 1)
        whole = len(table) // joined * joined  # what is left over at the end is dropped
        time, angle, _, torque = table[:whole].reshape(-1, joined, table.shape[1]).mean(axis=1).T
        angle = savgol_filter(angle, SMOOTHED, 3)
        tables[f"{name}.csv"] = table_text({"time": np.round(time, 9), "angle": angle, "torque": torque})
    return tables, {}


# ---------------------------------------------------------------- the wing of Kapteyn et al. 2021


SIGNAL, TIP = "spanwise", "tip"
"""Names of the channels: the strain signal of the ring-downs, the displacement of the loading runs."""
READING_ERROR = 33e-6 / 3.0**0.5
"""Deviation of a value read off the plot [V]: evenly within +-33 microvolt (a pixel is 66).

The plots show the same motion on the same grid, so that its error is common to the trials, and no average
makes it less.
"""
TREND = 67
"""Columns of the moving average that is the slow zero: 0.54 s, three periods of the first mode."""
BEGIN = 0.8
"""Begin of the window since the release [s]; before it higher modes ring that the model does not meet."""
COLUMNS = 4
"""Columns of the plot that are averaged into one sample. Four (32 ms) have a zero of their frequency response
at 30.8 Hz, where the second bending mode rings."""
RELEASE = {"displacement": 0.05, "deviation": 1.0, "at_rest": False, "mode_count": 2}
"""Nominal displacement of the tip at the window's begin [m], where the unknown scale of the signal makes any
value as good; modes whose state there is free."""
AT_TIP = {"name": TIP, "quantity": "displacement", "unit": "m", "output": "load_point_displacement"}
HELD_OUT = (3, 5)
"""Trials kept for proof, counted from 1."""


def _wing(data: Path, *, begin: float = BEGIN, columns: int = COLUMNS, detrended: bool = True) -> Made:
    """Return the ring-downs, of unknown scale, and the loading runs if `step2` is there.

    Parameters
    ----------
    data : path
        The authors' calibration folder, with `step2` and `step3`.
    begin, columns
        In place of `BEGIN` and `COLUMNS`.
    detrended : bool
        Whether the slow zero that the trials share is taken off: the moving average over three periods (Hann
        weights), averaged over the trials. It moves by a third of a millivolt and is no motion of the wing.
        What moves slowly in one trial alone is noise and stays.
    """
    with CampaignFileError.instead_of(
        CalibrationError, before="The measurements of the wing cannot be read: "
    ):
        records = read_records(data)
        loaded = any((data / above / "step2").is_dir() for above in (".", "datafiles", "src/datafiles"))
        pairs = read_measurements(data) if loaded else None
    if any(len(record.time) != len(records[0].time) for record in records) or len(records) < 2:
        raise CampaignDataError(said("rigs.records", data=data, count=len(records)))
    zero = _shared_zero(records) if detrended else np.zeros(records[0].count)
    windows = [_windowed(record, zero, begin, columns) for record in records]
    scatter, interval = trial_scatter(windows), float(windows[0][0][1])
    spread = float(np.std(scatter, ddof=1))
    noise = scatter * np.hypot(1.0, READING_ERROR / spread)
    tables = {"noise.csv": table_text({"time": interval * np.arange(float(len(noise))), SIGNAL: noise})}
    channels: list[dict[str, Any]] = []
    trials: list[dict[str, Any]] = []
    if pairs is not None:
        by_load = pairs.load_standard_deviation * float(np.median(pairs.displacement / pairs.load))
        deviation = float(np.hypot(pairs.displacement_standard_deviation, by_load))
        channels.append({**AT_TIP, "noise": {"standard_deviation": deviation}})
        for number in np.unique(pairs.run).tolist():
            rows, run, file = pairs.run == number, f"run {number + 1}", f"loading_{number + 1}.csv"
            tables[file] = table_text({"force": pairs.load[rows], TIP: pairs.displacement[rows]})
            trials.append({"name": f"loading {run}", "kind": "static", "file": file, "run": run})
    for number, (time, signal) in enumerate(windows, start=1):
        name, file = f"release {number}", f"release_{number}.csv"
        tables[file] = table_text({"time": time, SIGNAL: signal})
        given = {"name": name, "kind": "ringdown", "file": file, "held_out": number in HELD_OUT}
        trials.append({**given, "release": RELEASE})
    remarks = (
        f"Ring-downs: {records[0].source} to {records[-1].source}, from {begin:g} s after the release; "
        f"{counted(columns, 'column')} of the plot averaged into a sample of {1e3 * interval:.3g} ms.",
        f"Noise of the signal: scatter between the trials, {1e6 * spread:.3g} microvolt, and "
        f"the reading error that all share, {1e6 * READING_ERROR:.3g} microvolt.",
    )
    return tables, {"remarks": remarks, **({"channel": channels} if channels else {}), "trial": trials}


def trial_scatter(windows: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """Return noise of the signal ((R - 1) N,) [V] from what differs between R trials of N samples.

    All trials are releases of one kind, so that what they share is the motion, whatever its law; what differs
    beside amplitude, delay and zero is noise. Each trial is fitted by the mean of all, its rate, its second
    derivative and a constant; the R - 1 orthonormal contrasts of what is left (Helmert) are independent of
    each other and have the variance of a single trial. Four degrees of freedom of each contrast went into the
    fit, and the variance allows for it.

    Raises
    ------
    CampaignDataError
        If the records are too short.
    """
    signals = np.array([signal for _, signal in windows])
    count, size = signals.shape
    mean = signals.mean(axis=0)
    rate = np.gradient(mean)
    known = np.stack((mean, rate, np.gradient(rate), np.ones(size)), axis=1)
    known /= np.linalg.norm(known, axis=0)
    left = signals.T - known @ np.linalg.lstsq(known, signals.T, rcond=None)[0]
    noise = (left @ helmert(count).T).T
    return np.asarray(noise.ravel() * np.sqrt(size / (size - known.shape[1])))


def _shared_zero(records: tuple[RingDownRecord, ...]) -> FloatArray:
    """Return the slow zero (N,) that all records share, NaN at the ends, where no average is known."""
    weights = np.hanning(TREND + 2)[1:-1]
    mean = np.mean([record.signal for record in records], axis=0)
    zero = np.full(len(mean), np.nan)
    zero[TREND // 2 : len(mean) - TREND // 2] = np.convolve(mean, weights / weights.sum(), "valid")
    return zero


def _windowed(
    record: RingDownRecord, zero: FloatArray, begin: float, columns: int
) -> tuple[FloatArray, FloatArray]:
    """Return times since the first and samples of a record from the window's begin on."""
    known = np.isfinite(zero)
    inside = np.flatnonzero(known & (record.time >= begin))
    count = len(inside) // columns
    if count < 60:
        left = f"{counted(count, 'sample')} {is_or_are(count)} left"
        raise CampaignDataError(f"{record.source}: {left} after {begin:g} s; 60 are needed.")
    kept = inside[: count * columns].reshape(count, columns)
    time = record.time[kept].mean(axis=1)
    interval = float(time[-1] - time[0]) / (count - 1)
    return interval * np.arange(float(count)), np.asarray((record.signal - zero)[kept].mean(axis=1))


RIGS: dict[str, Callable[..., Made]] = {
    "real_wing": _wing,
    "falling_phone": _phone,
    "two_tanks": _tanks,
    "pendulum": _pendulum,
}
"""What makes the tables of a campaign from a published folder, by the name of the rig."""
