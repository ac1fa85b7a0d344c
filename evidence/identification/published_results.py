"""The authors' masses and frequencies for each of their samples of e: their calibration step 3."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from calibration.dynamics.records import STEP_FOLDER
from calibration.lab_folder import lab_table
from reporting.arrays import Float

RESULTS_FILE = "massoptimizationresults.csv"


class PublishedResults(NamedTuple):
    """The results of the authors' step 3.

    Attributes
    ----------
    states : (N, 3) array
        The samples of e [1], servo mass and pitot mass [kg].
    frequency : (N, 2) array
        The two flapwise frequencies of the authors' model [Hz].
    damping_ratio : (2,) array
        The measured damping ratios of the two modes [1].
    """

    states: Float
    frequency: Float
    damping_ratio: Float


def read_published_results(path: Path) -> PublishedResults:
    """Read the authors' masses and frequencies.

    Parameters
    ----------
    path : Path
        The authors' calibration folder, or `massoptimizationresults.csv` itself.

    Raises
    ------
    ExperimentFileError
        If the file is missing, empty, lacks a column, or has a cell that is not a number.
    ExperimentDataError
        If a value is not positive and finite.
    """
    table = lab_table(path, STEP_FOLDER / RESULTS_FILE)

    def column(name: str) -> Float:
        return table.numbers(name, "the authors' step 3", positive=True)

    for target in ("target_freq_1", "target_freq_2"):
        column(target)  # not used, but must hold positive numbers
    return PublishedResults(
        states=np.column_stack([column("e_sample"), column("mass_servo_1"), column("mass_pitot")]),
        frequency=np.column_stack([column("freq_1"), column("freq_2")]),
        # all rows have the same measured ratios
        damping_ratio=np.array([column("zeta_1")[0], column("zeta_2")[0]]),
    )
