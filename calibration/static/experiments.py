"""The static load experiment: tip loads and tip displacements, published or read from the authors' folder."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.errors import ExperimentDataError, said
from calibration.lab_folder import lab_table
from reporting.arrays import Float
from reporting.files import hash_record

STANDARD_GRAVITY = 9.81
"""Gravity by which the authors turn a mass on the scale into a load [m/s^2]."""

HALF_WIDTH_95 = 1.96
"""Half-width of a 95 % interval of a Gaussian, in standard deviations, as rounded in the paper."""

DISPLACEMENT_STANDARD_DEVIATION = 0.5e-3 / HALF_WIDTH_95
"""Standard deviation of a displacement reading: +-0.5 mm as the half-width of a 95 % interval [m]."""

LOAD_STANDARD_DEVIATION = 0.010 * STANDARD_GRAVITY / HALF_WIDTH_95
"""Standard deviation of a load: +-10 g as the half-width of a 95 % interval [N]."""

EXPECTED_TIP_STIFFNESS = 677.0
"""Tip stiffness of the wing before calibration, k(1) of eq. (14) [N/m]; used to recognise wrong units."""

MEASUREMENTS_FILE = Path("step2") / "load_displacement_measurements.csv"
"""Where the authors' calibration folder keeps the pairs of step 2."""

# Factors by which load over displacement changes when a column is in another unit than N and mm.
_UNIT_SLIPS = (
    (1.0 / 9.80665, "the load looks like kgf: give it in N"),
    (1000.0 / 9.80665, "the load looks like grams, or like kgf beside a displacement in m: give N and mm"),
    (1.0 / 4.44822, "the load looks like lbf: give it in N"),
    (1e-3, "the load looks like kN: give it in N"),
    (1000.0, "the displacement looks like m: give it in mm"),
    (10.0, "the displacement looks like cm: give it in mm"),
    (25.4, "the displacement looks like inches: give it in mm"),
)


@dataclass(frozen=True, eq=False)
class LoadDisplacementData:
    """Pairs of tip load and tip displacement of a static experiment.

    Attributes
    ----------
    load : (N,) array
        Load at the test point, 5 cm from the tip [N].
    displacement : (N,) array
        Displacement there [m].
    run : (N,) integer array
        Index of the loading run to which a pair belongs, from 0.
    load_standard_deviation, displacement_standard_deviation : float
        Standard deviations of the independent Gaussian errors of the readings [N], [m].
    source : str
        Where the figures come from.

    Raises
    ------
    ExperimentDataError
        If a load or a displacement is not positive.
    """

    load: Float
    displacement: Float
    run: NDArray[np.int64]
    load_standard_deviation: float = LOAD_STANDARD_DEVIATION
    displacement_standard_deviation: float = DISPLACEMENT_STANDARD_DEVIATION
    source: str = "unnamed measurements"

    def __post_init__(self) -> None:
        for name in ("load", "displacement"):
            column = getattr(self, name)
            for wrong in np.flatnonzero(column <= 0.0):
                found = wrong + 1, column[wrong]
                raise ExperimentDataError(said("load_test.positive", self=self, name=name, found=found))

    @property
    def count(self) -> int:
        """Number of pairs."""
        return int(self.load.size)

    @property
    def run_indices(self) -> tuple[int, ...]:
        """The loading runs in ascending order."""
        return tuple(int(index) for index in np.unique(self.run))

    @property
    def sha256(self) -> str:
        """Hash of the figures and their uncertainty (not of `source`), the same on every platform."""
        deviations = self.load_standard_deviation, self.displacement_standard_deviation
        columns = self.load, self.displacement, self.run
        return hash_record([*map(float, deviations), *(column.tolist() for column in columns)])


def published_measurements() -> LoadDisplacementData:
    """Return the eight pairs measured on the real wing, two loading runs of four.

    Loads are 250, 500, 750 and 1000 g; displacements were read in mm. Source: M. G. Kapteyn,
    UAV-Experimental-Calibration, `step2/load_displacement_measurements.csv` (BSD 3-clause);
    Kapteyn et al. 2021, Fig. 5. Uncertainty: +-10 g and +-0.5 mm, half-widths of 95 % intervals.
    """
    displacement_mm = np.array([3.937, 7.6962, 10.8712, 14.5542, 3.3528, 7.2898, 10.7442, 13.7922])
    return LoadDisplacementData(
        load=np.tile([2.4525, 4.905, 7.3575, 9.81], 2),
        displacement=displacement_mm * 1e-3,
        run=np.repeat([0, 1], 4),
        source="published measurements (Kapteyn et al. 2021, Fig. 5)",
    )


def read_measurements(path: Path) -> LoadDisplacementData:
    """Read the pairs of step 2 from the authors' calibration folder, or from one CSV file.

    Parameters
    ----------
    path : Path
        The folder that holds `step2/load_displacement_measurements.csv` (also the folder above it in the
        authors' repository), or the CSV file itself: a header with the columns `load` [N] and
        `displacement` [mm]; further columns are ignored. A new loading run begins where the load falls.

    Raises
    ------
    ExperimentFileError
        If the file is missing, empty, lacks a column, has a row with another number of cells than its header
        or a cell that is no number, or holds one row twice in a loading run.
    ExperimentDataError
        If a value is not positive and finite, or load over displacement shows other units.
    """
    table = lab_table(path, MEASUREMENTS_FILE)
    load, displacement = (
        table.numbers(name, "a load test", positive=True) for name in ("load", "displacement")
    )
    _refuse_other_units(table.name, load, displacement)
    run = np.concatenate([[0], np.cumsum(np.diff(load) < 0.0)])
    rest = [table.columns[name] for name in table.columns if name not in ("load", "displacement")]
    table.refuse_repeated(
        [*zip(run.tolist(), load.tolist(), displacement.tolist(), *rest, strict=True)],
        "row",
        "leave one out, or number repeated readings in a further column",
    )
    return LoadDisplacementData(
        load=load, displacement=displacement * 1e-3, run=run, source=Path(table.name).name
    )


def _refuse_other_units(file: str, load: Float, displacement_mm: Float) -> None:
    stiffness = float(np.median(load / displacement_mm))  # N/mm
    expected = EXPECTED_TIP_STIFFNESS * 1e-3
    ratio = stiffness / expected
    if 0.5 <= ratio <= 2.0:
        return
    factor, remedy = min(_UNIT_SLIPS, key=lambda slip: abs(math.log(ratio / slip[0])))
    if abs(math.log(ratio / factor)) > math.log(1.25):
        remedy = "check the columns, their units (N and mm) and the wing"
    found = stiffness, ratio, expected
    raise ExperimentDataError(said("load_test.stiffness", file=file, found=found, remedy=remedy))
