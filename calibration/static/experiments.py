"""The static load experiment: tip loads and displacements, published or read from a folder."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.errors import ExperimentDataError
from calibration.lab_folder import lab_table
from reporting.arrays import Float, nan_where_masked
from reporting.files import hash_record

STANDARD_GRAVITY = 9.81
"""Gravity with which the authors convert a mass on the scale to a load [m/s^2]."""

HALF_WIDTH_95 = 1.96
"""Half-width of a 95 % interval of a Gaussian, in standard deviations, as rounded in the paper."""

DISPLACEMENT_STANDARD_DEVIATION = 0.5e-3 / HALF_WIDTH_95
"""Standard deviation of a displacement: +-0.5 mm as the half-width of a 95 % interval [m]."""

LOAD_STANDARD_DEVIATION = 0.010 * STANDARD_GRAVITY / HALF_WIDTH_95
"""Standard deviation of a load: +-10 g as the half-width of a 95 % interval [N]."""

EXPECTED_TIP_STIFFNESS = 677.0
"""Tip stiffness of the wing before calibration, k(1) of eq. (14); reveals wrong units [N/m]."""

MEASUREMENTS_FILE = Path("step2") / "load_displacement_measurements.csv"
"""The file of the pairs of step 2 in the authors' calibration folder."""


class _UnitError(NamedTuple):
    """A unit other than N or mm, which changes load over displacement by a factor."""

    factor: float
    remedy: str


_UNIT_ERRORS = (
    _UnitError(1.0 / 9.80665, "the load looks like kgf: give it in N"),
    _UnitError(
        1000.0 / 9.80665,
        "the load looks like grams, or like kgf beside a displacement in m: give N and mm",
    ),
    _UnitError(1.0 / 4.44822, "the load looks like lbf: give it in N"),
    _UnitError(1e-3, "the load looks like kN: give it in N"),
    _UnitError(1000.0, "the displacement looks like m: give it in mm"),
    _UnitError(10.0, "the displacement looks like cm: give it in mm"),
    _UnitError(25.4, "the displacement looks like inches: give it in mm"),
)
_PLAUSIBLE_FACTOR = 2.0  # between the stiffness of a wing and the expected one
_UNIT_TOLERANCE = 1.25  # factor between the stiffness and that of a recognised unit error


@dataclass(frozen=True, eq=False)
class LoadDisplacementData:
    """Pairs of tip load and tip displacement of a static experiment.

    Attributes
    ----------
    load : (N,) array
        The load at the test point, 5 cm from the tip [N].
    displacement : (N,) array
        The displacement there [m].
    run : (N,) integer array
        The index of the loading run of each pair, from 0.
    load_standard_deviation, displacement_standard_deviation : float
        The standard deviations of the independent Gaussian errors of the readings [N], [m].
    source : str
        The origin of the measurements, for messages.

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
            values = getattr(self, name)
            is_positive = nan_where_masked(values) > 0.0  # false for NaN as well
            not_positive = np.flatnonzero(~is_positive)
            if not_positive.size:
                index = not_positive[0]
                raise ExperimentDataError(
                    f"{self.source}: {name} of reading {index + 1} is {values[index]:g}, "
                    f"but every {name} must be positive; leave out zero and lost readings."
                )

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
        """Hash of values and uncertainty, without `source`, the same on every platform."""
        return hash_record(
            [
                float(self.load_standard_deviation),
                float(self.displacement_standard_deviation),
                self.load.tolist(),
                self.displacement.tolist(),
                self.run.tolist(),
            ]
        )


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
    """Read the pairs of step 2 in the authors' calibration folder, or in one CSV file.

    Parameters
    ----------
    path : Path
        The folder that holds `step2/load_displacement_measurements.csv` (also the folder above it
        in the authors' repository), or the CSV file itself: a header with the columns `load` [N]
        and `displacement` [mm]; further columns are ignored. A new loading run begins where the
        load falls.

    Raises
    ------
    ExperimentFileError
        If the file is missing, empty, lacks a column, has a row whose number of cells is not that
        of its header or a cell that is not a number, or repeats a row in a loading run.
    ExperimentDataError
        If a value is not positive and finite, or load over displacement shows other units.
    """
    table = lab_table(path, MEASUREMENTS_FILE)
    load = table.numbers("load", "a load test", positive=True)
    displacement_mm = table.numbers("displacement", "a load test", positive=True)
    _refuse_other_units(table.name, load, displacement_mm)
    load_falls = np.diff(load) < 0.0
    run = np.concatenate([[0], np.cumsum(load_falls)])
    further_columns = [
        cells for name, cells in table.columns.items() if name not in ("load", "displacement")
    ]
    rows = zip(run.tolist(), load.tolist(), displacement_mm.tolist(), *further_columns, strict=True)
    table.refuse_repeated(
        list(rows), "row", "leave one out, or number repeated readings in a further column"
    )
    return LoadDisplacementData(
        load=load, displacement=displacement_mm * 1e-3, run=run, source=Path(table.name).name
    )


def _refuse_other_units(file: str, load: Float, displacement_mm: Float) -> None:
    """Raise `ExperimentDataError` if loads [N] over displacements [mm] suggest other units."""
    stiffness = float(np.median(load / displacement_mm))  # N/mm
    expected_stiffness = EXPECTED_TIP_STIFFNESS * 1e-3
    ratio = stiffness / expected_stiffness
    if 1.0 / _PLAUSIBLE_FACTOR <= ratio <= _PLAUSIBLE_FACTOR:
        return
    nearest_unit_error = min(_UNIT_ERRORS, key=lambda error: abs(math.log(ratio / error.factor)))
    remedy = nearest_unit_error.remedy
    if abs(math.log(ratio / nearest_unit_error.factor)) > math.log(_UNIT_TOLERANCE):
        remedy = "check the columns, their units (N and mm) and the wing"
    raise ExperimentDataError(
        f"{file}: load over displacement is {stiffness:.3g} N/mm, {ratio:.3g} times the "
        f"{expected_stiffness:.3g} N/mm expected before calibration; {remedy}."
    )
