"""Published results of step 3: samples of e, and the authors' fitted masses and frequencies."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .dynamics import DynamicCalibration, DynamicTargets, damping_coefficients
from .errors import ExperimentDataError, ExperimentFileError
from .ringdown_records import STEP_FOLDER

SAMPLES_FILE = "e_samples.csv"
"""Samples of e, one in a line, without header."""

RESULTS_FILE = "massoptimizationresults.csv"
"""The authors' masses and frequencies for each of these samples."""

_FOLDERS_OF_STEPS = (Path(), Path("datafiles"), Path("src") / "datafiles")
_RESULT_COLUMNS = (
    "e_sample", "target_freq_1", "target_freq_2", "zeta_1", "zeta_2",
    "mass_servo_1", "mass_pitot", "freq_1", "freq_2",
)  # fmt: skip


def read_factor_samples(path: Path) -> NDArray[np.float64]:
    """Read samples of e from the authors' calibration folder, or from one file; (N,) array [1].

    Raises
    ------
    ExperimentFileError
        If the file is missing or empty.
    ExperimentDataError
        If a line is not one positive finite number.
    """
    file = _find(Path(path), SAMPLES_FILE)
    lines = [row[0].strip() for row in _rows(file)]
    return np.array([_number(file, f"sample {place + 1}", text) for place, text in enumerate(lines)])


def read_published_results(path: Path) -> DynamicCalibration:
    """Read the authors' masses and frequencies, and add alpha and beta by eq. (25).

    Parameters
    ----------
    path : Path
        The authors' calibration folder, or `massoptimizationresults.csv` itself.

    Raises
    ------
    ExperimentFileError
        If the file is missing, empty, or lacks a column.
    ExperimentDataError
        If a value is not a positive finite number.
    """
    file = _find(Path(path), RESULTS_FILE)
    rows = _rows(file)
    header = [cell.strip() for cell in rows[0]]
    missing = [name for name in _RESULT_COLUMNS if name not in header]
    if missing:
        raise ExperimentFileError(
            f"{file} lacks the column {' and '.join(missing)}; its columns are {', '.join(header)}."
        )
    if len(rows) == 1:
        raise ExperimentFileError(f"{file} holds a header but no row.")
    column = {name: _column(file, rows, header.index(name), name) for name in _RESULT_COLUMNS}
    ratios = float(column["zeta_1"][0]), float(column["zeta_2"][0])
    pairs = np.column_stack([column["freq_1"], column["freq_2"]])
    damping = np.array([damping_coefficients((first, second), ratios) for first, second in pairs.tolist()])
    return DynamicCalibration(
        young_modulus_factor=column["e_sample"],
        servo_mass=column["mass_servo_1"],
        pitot_mass=column["mass_pitot"],
        frequency=pairs,
        damping_alpha=damping[:, 0],
        damping_beta=damping[:, 1],
        targets=DynamicTargets(
            (float(column["target_freq_1"][0]), float(column["target_freq_2"][0])), ratios
        ),
        source=f"the authors' model ({file.name})",
    )


def _find(path: Path, name: str) -> Path:
    if path.is_file():
        return path
    for folder in (*(above / STEP_FOLDER for above in _FOLDERS_OF_STEPS), Path()):
        if (path / folder / name).is_file():
            return path / folder / name
    if not path.exists():
        raise ExperimentFileError(f"{path} does not exist; give the folder that holds {STEP_FOLDER / name}.")
    raise ExperimentFileError(
        f"{path} does not hold {STEP_FOLDER / name}; give the authors' calibration folder."
    )


def _rows(file: Path) -> list[list[str]]:
    try:
        with file.open(encoding="utf-8-sig", newline="") as stream:
            rows = [row for row in csv.reader(stream) if any(cell.strip() for cell in row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ExperimentFileError(f"{file} cannot be read as a CSV text file: {error}.") from error
    if not rows:
        raise ExperimentFileError(f"{file} is empty.")
    return rows


def _column(file: Path, rows: list[list[str]], place: int, name: str) -> NDArray[np.float64]:
    return np.array(
        [
            _number(file, f"{name} of row {number}", row[place].strip() if place < len(row) else "")
            for number, row in enumerate(rows[1:], start=1)
        ]
    )


def _number(file: Path, what: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise ExperimentDataError(f"{file}: {what} is {text!r}, but a positive finite number is needed.")
    return value
