"""The published measurements of the wing of Kapteyn et al. 2021 as a campaign."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.linalg import helmert

from calibration.dynamics.records import RingDownRecord, read_records
from calibration.errors import CalibrationError
from calibration.static.experiments import LoadDisplacementData, read_measurements
from discrepancy.campaign.records import FloatArray
from discrepancy.errors import CampaignDataError, CampaignFileError
from discrepancy.sources.rig_files import RigFiles
from reporting.formats.table_file import table_text
from reporting.words import counted, is_or_are


class PlotWindow(NamedTuple):
    """Samples of a ring-down in a window of a published plot.

    Attributes
    ----------
    time : (N,) ndarray
        Times since the first sample [s].
    signal : (N,) ndarray
        The signal of the strain gauge [V].
    """

    time: FloatArray
    signal: FloatArray


SIGNAL = "spanwise"
"""Name of the channel of the ring-downs: their strain signal."""
TIP = "tip"
"""Name of the channel of the loading runs: the displacement of the tip."""
READING_ERROR = 33e-6 / 3.0**0.5
"""Standard deviation of a value read off the plot [V]: uniform within +-33 microvolt.

The plots show the same motion on the same grid, so that the error is common to the trials, and
averaging does not reduce it.
"""
TREND_COLUMNS = 67
"""Columns of the moving average that is the drifting zero: 0.54 s, three periods of the first
mode."""
WINDOW_BEGIN = 0.8
"""Start of the window after the release [s].

Before it higher modes ring, which the model does not have.
"""
AVERAGED_COLUMNS = 4
"""Columns of the plot that are averaged into one sample.

Four columns (32 ms) have a zero of their frequency response at 30.8 Hz, where the second bending
mode rings."""
LEAST_SAMPLES = 60
"""Least number of samples of a ring-down."""
RELEASE = {"displacement": 0.05, "deviation": 1.0, "at_rest": False, "mode_count": 2}
"""Release of the ring-downs: nominal displacement of the tip at the start of the window [m].

As the scale of the signal is unknown, any displacement would do. The state of two modes is free."""
AT_TIP = {"name": TIP, "quantity": "displacement", "unit": "m", "output": "load_point_displacement"}
HELD_OUT = (3, 5)
"""Trials kept for proof, counted from 1."""


def real_wing(
    data: Path,
    *,
    begin: float = WINDOW_BEGIN,
    columns: int = AVERAGED_COLUMNS,
    detrended: bool = True,
) -> RigFiles:
    """Return the ring-downs of the wing of Kapteyn et al., and its loading runs if there are any.

    The noise record of the signal is the scatter between the ring-downs (`trial_scatter`), scaled
    up so that its variance includes the reading error that they share.

    Parameters
    ----------
    data : Path
        The authors' calibration folder, with `step2` and `step3`.
    begin : float
        The start of the window after the release [s].
    columns : int
        Columns of the plot that are averaged into one sample.
    detrended : bool
        True to subtract the slow zero that the trials share: a moving average over three periods
        (Hann weights), averaged over the trials. This zero moves by a third of a millivolt and is
        not a motion of the wing. Slow changes of a single trial are noise and stay.

    Raises
    ------
    CampaignFileError
        If the measurements cannot be read.
    CampaignDataError
        If there are fewer than two records, or of several lengths, or too short ones.
    """
    records, measurements = _read_lab_data(data)
    zero = _shared_zero(records) if detrended else np.zeros(records[0].count)
    windows = [_plot_window(record, zero, begin, columns) for record in records]
    interval = float(windows[0].time[1])
    scatter = trial_scatter(windows)
    deviation = float(np.std(scatter, ddof=1))
    # scaled to the variance deviation^2 + READING_ERROR^2
    noise = scatter * np.hypot(1.0, READING_ERROR / deviation)
    tables = {
        "noise.csv": table_text({"time": interval * np.arange(float(len(noise))), SIGNAL: noise})
    }
    keys: dict[str, object] = {
        "remarks": (
            f"Ring-downs: {records[0].source} to {records[-1].source}, from {begin:g} s after the "
            f"release; {counted(columns, 'column')} of the plot averaged into a sample of "
            f"{1e3 * interval:.3g} ms.",
            "The noise of the signal has two parts: the scatter between the trials, "
            f"{1e6 * deviation:.3g} microvolt, and the reading error that all trials share, "
            f"{1e6 * READING_ERROR:.3g} microvolt.",
        )
    }
    trials: list[dict[str, object]] = []
    if measurements is not None:
        loading = _loading_runs(measurements)
        tables |= loading.tables
        keys["channel"] = loading.campaign_keys["channel"]
        trials += loading.campaign_keys["trial"]
    for number, window in enumerate(windows, start=1):
        trial = {
            "name": f"release {number}",
            "kind": "ringdown",
            "file": f"release_{number}.csv",
            "held_out": number in HELD_OUT,
            "release": RELEASE,
        }
        tables[f"release_{number}.csv"] = table_text({"time": window.time, SIGNAL: window.signal})
        trials.append(trial)
    return RigFiles(tables, {**keys, "trial": trials})


class _LabData(NamedTuple):
    """The ring-downs of the wing, and its loading runs; None if the folder has no loading runs."""

    records: tuple[RingDownRecord, ...]
    measurements: LoadDisplacementData | None


def _read_lab_data(data: Path) -> _LabData:
    """Read the ring-downs and loading runs of the wing from the authors' calibration folder.

    Raises
    ------
    CampaignFileError
        If the measurements cannot be read.
    CampaignDataError
        If there are fewer than two ring-downs, or ring-downs of several lengths.
    """
    with CampaignFileError.instead_of(
        CalibrationError, before="The measurements of the wing cannot be read: "
    ):
        records = read_records(data)
        folders = [data / above / "step2" for above in (".", "datafiles", "src/datafiles")]
        measurements = None
        if any(folder.is_dir() for folder in folders):
            measurements = read_measurements(data)
    if len({len(record.time) for record in records}) > 1 or len(records) < 2:
        raise CampaignDataError(
            f"{data} must hold two or more ring-down records of one length; it holds "
            f"{len(records)}."
        )
    return _LabData(records, measurements)


def _loading_runs(measurements: LoadDisplacementData) -> RigFiles:
    """Return the loading runs of the wing as static trials, and the channel of the tip.

    An error of the load counts as noise: that of the displacement which it causes.
    """
    compliance = float(np.median(measurements.displacement / measurements.load))
    deviation_by_load = measurements.load_standard_deviation * compliance
    deviation = float(np.hypot(measurements.displacement_standard_deviation, deviation_by_load))
    channel = {**AT_TIP, "noise": {"standard_deviation": deviation}}
    tables = {}
    trials = []
    for index in np.unique(measurements.run).tolist():
        rows = measurements.run == index
        run = f"run {index + 1}"
        file = f"loading_{index + 1}.csv"
        tables[file] = table_text(
            {"force": measurements.load[rows], TIP: measurements.displacement[rows]}
        )
        trials.append({"name": f"loading {run}", "kind": "static", "file": file, "run": run})
    return RigFiles(tables, {"channel": [channel], "trial": trials})


def trial_scatter(windows: Sequence[PlotWindow]) -> FloatArray:
    """Return the noise of the signal from the differences between R trials of N samples.

    All trials are releases of one kind, and so have the same motion, whatever its law is. They may
    differ in amplitude, delay and zero; other differences are noise. Each trial is therefore fitted
    by the mean of all trials (amplitude), its first and second time derivatives (delay, by Taylor's
    series) and a constant (zero). The R - 1 orthonormal Helmert contrasts of the residuals are
    independent, each with the variance of a single trial. This variance is corrected for the four
    degrees of freedom that the fit takes from each contrast.

    Parameters
    ----------
    windows : sequence of PlotWindow
        The R windows, one of each ring-down, with N samples each.

    Returns
    -------
    ((R - 1) N,) ndarray
        Noise [V], one contrast after the other.
    """
    signals = np.array([window.signal for window in windows])  # (R, N)
    trial_count, sample_count = signals.shape
    mean = signals.mean(axis=0)
    rate = np.gradient(mean)
    basis = np.stack((mean, rate, np.gradient(rate), np.ones(sample_count)), axis=1)  # (N, 4)
    basis /= np.linalg.norm(basis, axis=0)
    coefficients, *_ = np.linalg.lstsq(basis, signals.T, rcond=None)
    residual = signals.T - basis @ coefficients  # (N, R)
    contrasts = (residual @ helmert(trial_count).T).T  # (R - 1, N)
    correction = np.sqrt(sample_count / (sample_count - basis.shape[1]))
    return np.asarray(contrasts.ravel() * correction)


def _shared_zero(records: tuple[RingDownRecord, ...]) -> FloatArray:
    """Return the slow drift of the zero (N,) [V] that all records share.

    The drift is the moving average of the mean record, with Hann weights over `TREND_COLUMNS`
    samples; nan at the ends, where the average is incomplete.
    """
    weights = np.hanning(TREND_COLUMNS + 2)[1:-1]
    mean = np.mean([record.signal for record in records], axis=0)
    zero = np.full(len(mean), np.nan)
    half = TREND_COLUMNS // 2
    zero[half : len(mean) - half] = np.convolve(mean, weights / weights.sum(), "valid")
    return zero


def _plot_window(
    record: RingDownRecord, zero: FloatArray, begin: float, columns_per_sample: int
) -> PlotWindow:
    """Return the samples of a ring-down from `begin` [s] on, without the drift of its zero.

    The record was read off a published plot, with one value for each column of pixels. Each sample
    is the mean of `columns_per_sample` such values. Columns where the zero is not known are left
    out, and so are columns at the end that do not fill a sample. The samples are evenly spaced, and
    their time starts at zero.

    Parameters
    ----------
    record : RingDownRecord
        The record, with N columns.
    zero : (N,) ndarray
        The slowly drifting zero of the signal [V], nan where it is not known.
    begin : float
        Start of the window after the release [s].
    columns_per_sample : int
        The number of columns that are averaged.

    Raises
    ------
    CampaignDataError
        If fewer than `LEAST_SAMPLES` samples are left.
    """
    inside = np.flatnonzero(np.isfinite(zero) & (record.time >= begin))
    count = len(inside) // columns_per_sample
    if count < LEAST_SAMPLES:
        raise CampaignDataError(
            f"{record.source}: {counted(count, 'sample')} {is_or_are(count)} left after {begin:g} "
            f"s; {LEAST_SAMPLES} are needed."
        )
    columns_of_sample = inside[: count * columns_per_sample].reshape(count, columns_per_sample)
    time = record.time[columns_of_sample].mean(axis=1)
    signal = np.asarray((record.signal - zero)[columns_of_sample].mean(axis=1))
    interval = float(time[-1] - time[0]) / (count - 1)
    return PlotWindow(interval * np.arange(float(count)), signal)
