"""Published results of step 3: samples of e, and the authors' fitted masses and frequencies."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.lab_folder import LAB_ERRORS, find_lab_file
from reporting.table_file import read_table

from .masses_and_damping import DynamicCalibration, DynamicTargets, damping_coefficients
from .records import STEP_FOLDER

SAMPLES_FILE = "e_samples.csv"
"""Samples of e, one in a line, without header."""

RESULTS_FILE = "massoptimizationresults.csv"
"""The authors' masses and frequencies for each of these samples."""

_RESULT_COLUMNS = (
    "e_sample", "target_freq_1", "target_freq_2", "zeta_1", "zeta_2",
    "mass_servo_1", "mass_pitot", "freq_1", "freq_2",
)  # fmt: skip


def read_factor_samples(path: Path) -> NDArray[np.float64]:
    """Read samples of e from the authors' calibration folder, or from one file; (N,) array [1].

    Raises
    ------
    ExperimentFileError
        If the file is missing or empty, or a line does not hold one number.
    ExperimentDataError
        If a number is not positive and finite.
    """
    file = find_lab_file(Path(path), STEP_FOLDER / SAMPLES_FILE)
    return read_table(file, LAB_ERRORS, header=("e",)).positive_numbers("e", "step 3")


def read_published_results(path: Path) -> DynamicCalibration:
    """Read the authors' masses and frequencies, and add alpha and beta by eq. (25).

    Parameters
    ----------
    path : Path
        The authors' calibration folder, or `massoptimizationresults.csv` itself.

    Raises
    ------
    ExperimentFileError
        If the file is missing, empty, lacks a column, or has a cell that is no number.
    ExperimentDataError
        If a value is not positive and finite.
    """
    file = find_lab_file(Path(path), STEP_FOLDER / RESULTS_FILE)
    table = read_table(file, LAB_ERRORS)
    column = {name: table.positive_numbers(name, "the authors' step 3") for name in _RESULT_COLUMNS}
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
