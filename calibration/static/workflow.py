"""Calibration step 2 from a folder of measurements to a folder of results."""

import json
from pathlib import Path
from typing import NamedTuple

from calibration.errors import CalibrationRecordError
from reporting.files import atomic_write_text
from reporting.json_file import read_json

from .experiments import published_measurements, read_measurements
from .particle_filter import DEFAULT_PARTICLE_COUNT
from .record import StaticCalibration
from .report import write_report
from .stiffness import calibrate_static
from .stiffness_curve import PUBLISHED_LINE, StiffnessCurve
from .summary import summary_rows

__all__ = ["StaticRun", "read_calibration", "result_files", "run_static", "summary_rows", "write_calibration"]

RECORD_NAME = "calibration.json"
"""Name of the record in the folder of results."""


class StaticRun(NamedTuple):
    """Where `run_static` left its results."""

    record: Path
    report: Path


def result_files(out: Path) -> StaticRun:
    """Return the paths that `run_static` writes in the folder `out`."""
    return StaticRun(record=out / RECORD_NAME, report=out / "report.html")


def run_static(
    data: Path | None = None,
    out: Path | None = None,
    seed: int = 0,
    curve: StiffnessCurve = PUBLISHED_LINE,
    *,
    particle_count: int = DEFAULT_PARTICLE_COUNT,
) -> StaticCalibration:
    """Calibrate e and, where asked to, leave record, figures and report in a folder.

    Parameters
    ----------
    data : Path, optional
        The authors' calibration folder or a CSV file, see `read_measurements`; the published eight pairs
        if absent.
    out : Path, optional
        Folder of the results (made if needed; files of the same names are replaced): `calibration.json`,
        `report.html` and `figures/`.
    seed : int
        Seed of the particle filter.
    curve : StiffnessCurve
        k(e); the published line by default.
    particle_count : int
        Particles of the filter.

    Raises
    ------
    CalibrationError
        If the measurements cannot be read or contradict prior and curve; one class for each cause.
    reporting.errors.FileNotWrittenError
        If the results cannot be written.
    """
    measurements = published_measurements() if data is None else read_measurements(data)
    result = calibrate_static(curve, measurements, seed, particle_count=particle_count)
    if out is not None:
        write_calibration(result, result_files(out).record)
        write_report(result, out)
    return result


def write_calibration(result: StaticCalibration, path: Path) -> None:
    """Write the record as JSON, whole or not at all."""
    atomic_write_text(path, json.dumps(result.to_dict(), allow_nan=False, ensure_ascii=False) + "\n")


def read_calibration(path: Path) -> StaticCalibration:
    """Read the record that `write_calibration` wrote.

    Raises
    ------
    CalibrationRecordError
        If the file is missing, not JSON, or not such a record.
    """
    record = read_json(path, CalibrationRecordError, what="calibration record")
    if not isinstance(record, dict):
        raise CalibrationRecordError(f"{path} is not a calibration record: it holds no table of names.")
    return StaticCalibration.from_dict(record)
