"""Calibration step 1: the planform of the real wing, and the design with this planform."""

from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calibration.errors import ExperimentDataError, ExperimentFileError
from calibration.result.record import ParameterPrior, QuantityReading
from calibration.static.experiments import HALF_WIDTH_95
from calibration.static.posterior import GaussianPrior
from fe.runtime.errors import InvalidDesignError
from fe.runtime.state import Geometry
from fe.wing.design import WingDesign
from reporting.arrays import Float
from reporting.files import hash_record
from reporting.formats.table_file import TextTable
from reporting.words import comma_list

from .lab_folder import lab_table

TOLERANCE = 2.54e-3
"""Design tolerance of a length, half-width of a 95 % interval [m] (Kapteyn et al. 2021)."""

READING_UNCERTAINTY = 0.2e-3
"""Uncertainty of a measured length, half-width of a 95 % interval [m] (the authors' script)."""

GEOMETRY_FILE = Path("step1") / "geometry_data.csv"
"""The file of the lengths of step 1 in the authors' calibration folder."""

PUBLISHED_NAMES = {"length": "semi_span", "chord_{root}": "root_chord", "chord_{tip}": "tip_chord"}
"""Names of the lengths in the published file, with the fields of `fe.runtime.state.Geometry`."""

_NEEDED_BY = "the measured planform"
_LARGEST_DEVIATION = 0.10  # of a length from its design; beyond it the units or the wing differ
_SHORTEST_LENGTH_MM = 10.0  # a smaller number is probably a length in m


@dataclass(frozen=True)
class MeasuredLength:
    """A length of the wing as designed and as built.

    Attributes
    ----------
    name : str
        The field of `Lengths`.
    designed, measured : float
        The length on the drawing and on the wing [m].

    Raises
    ------
    ExperimentDataError
        If the two lengths differ by more than 10 %.
    """

    name: str
    designed: float
    measured: float

    def __post_init__(self) -> None:
        if abs(self.measured / self.designed - 1.0) > _LARGEST_DEVIATION:
            raise ExperimentDataError(
                f"{self.name} measures {self.measured * 1e3:g} mm, but the design has "
                f"{self.designed * 1e3:g} mm, a difference of more than 10 %: check the units "
                "(both in mm) and the wing."
            )

    @property
    def prior(self) -> ParameterPrior:
        """The prior: the designed length with its tolerance."""
        return ParameterPrior(
            name=self.name,
            unit="m",
            mean=self.designed,
            deviation=TOLERANCE / HALF_WIDTH_95,
            low=self.designed * (1.0 - _LARGEST_DEVIATION),
            high=self.designed * (1.0 + _LARGEST_DEVIATION),
            stated_by="design tolerance",
        )

    @property
    def reading(self) -> QuantityReading:
        """The reading: the measured length with its uncertainty."""
        return QuantityReading(
            self.name, "planform", self.measured, READING_UNCERTAINTY / HALF_WIDTH_95
        )

    @property
    def posterior(self) -> GaussianPrior:
        """Prior times the Gaussian likelihood of the measurement [m].

        The precisions add, and the mean is weighted by them: 1/s² = 1/s_0² + 1/s_r², m = s²
        (designed / s_0² + measured / s_r²).
        """
        prior_precision = self.prior.deviation**-2
        reading_precision = self.reading.deviation**-2
        precision = prior_precision + reading_precision
        mean = self.designed + (self.measured - self.designed) * reading_precision / precision
        return GaussianPrior(mean, precision**-0.5)


class Lengths(NamedTuple):
    """The measured lengths of a planform, in the order of `fe.runtime.state.Geometry`.

    Their errors are independent.
    """

    semi_span: MeasuredLength
    root_chord: MeasuredLength
    tip_chord: MeasuredLength

    @property
    def sha256(self) -> str:
        """Hash of the lengths and their uncertainty, the same on every platform."""
        return hash_record([[*astuple(length), TOLERANCE, READING_UNCERTAINTY] for length in self])


def published_lengths() -> Lengths:
    """Return the lengths of the real wing.

    Source: M. G. Kapteyn, UAV-Experimental-Calibration, `step1/geometry_data.csv` (BSD 3-clause);
    Kapteyn et al. 2021, Table 1.
    """
    return Lengths(
        semi_span=MeasuredLength("semi_span", 1.8288, 1.8280),
        root_chord=MeasuredLength("root_chord", 0.43561, 0.4330),
        tip_chord=MeasuredLength("tip_chord", 0.261112, 0.2600),
    )


def read_lengths(path: Path) -> Lengths:
    """Read the lengths of step 1 in the authors' calibration folder, or in one CSV file.

    Parameters
    ----------
    path : Path
        The folder that holds `step1/geometry_data.csv` (also the folder above it in the authors'
        repository), or the CSV file itself: columns `parameter`, `designed` and `manufactured`
        [mm], rows `length`, `chord_{root}`, `chord_{tip}`.

    Raises
    ------
    ExperimentFileError
        If the file is missing, empty, lacks a column or a row, names a length twice, has a row
        whose number of cells is not that of its header, or a cell that is not a number.
    ExperimentDataError
        If a value is not positive and finite, or the lengths are in another unit.
    """
    table = lab_table(path, GEOMETRY_FILE)
    names = table.cells("parameter", _NEEDED_BY)
    table.refuse_repeated(names, "parameter", "keep one of them")
    missing_names = [published for published in PUBLISHED_NAMES if published not in names]
    if missing_names:
        raise ExperimentFileError(
            f"{table.name} lacks the row {' and '.join(missing_names)}; "
            f"{comma_list(PUBLISHED_NAMES)} are needed."
        )
    designed = _lengths_in_millimetres(table, "designed")
    measured_lengths = _lengths_in_millimetres(table, "manufactured")
    lengths = {}
    for published, name in PUBLISHED_NAMES.items():
        row = names.index(published)
        lengths[name] = MeasuredLength(name, 1e-3 * designed[row], 1e-3 * measured_lengths[row])
    return Lengths(**lengths)


def _lengths_in_millimetres(table: TextTable, column: str) -> Float:
    """Return a column of lengths [mm]; raise `ExperimentDataError` if they look like metres."""
    values = table.numbers(column, _NEEDED_BY, positive=True)
    too_short = np.flatnonzero(values < _SHORTEST_LENGTH_MM)
    if too_short.size:
        row = too_short[0]
        raise ExperimentDataError(
            f"{table.name}, line {table.lines[row]}: {column} is {values[row]:g} mm, "
            "which looks like m: give it in mm."
        )
    return values


def tailored_geometry(lengths: Lengths) -> Geometry:
    """Return the posterior means of the lengths [m], rounded to 0.1 mm.

    That is their standard deviation, of which the paper makes no further use.
    """
    return Geometry(*(round(length.posterior.mean, 4) for length in lengths))


def tailored_design(design: WingDesign, lengths: Lengths) -> WingDesign:
    """Return a wing's design with the measured planform.

    Only the semi-span and the chords of the design change:

    - Positions that the design states as fractions move with the planform: those of ribs, point
      masses and bands of the skin along the span, and all positions along the chord.
    - Positions that it states as distances stay: those of gauges and defect regions from the root,
      and that of the test load from the tip.
    - The net load in a turn, the thicknesses of skin and webs, and the size of the largest cell of
      the mesh stay as well.

    Raises
    ------
    ExperimentDataError
        If a length differs from that of the design by more than a tenth; the measurements are then
        probably those of another wing.
    InvalidDesignError
        If the wing with these lengths cannot be built; the message names the part of the design.
    """
    planform = asdict(tailored_geometry(lengths))
    for name, value in planform.items():
        designed = getattr(design.planform, name)
        if abs(value / designed - 1.0) > _LARGEST_DEVIATION:
            raise ExperimentDataError(
                f"{name} measures {value * 1e3:.1f} mm, but the design {design.name} has "
                f"{designed * 1e3:.1f} mm, a difference of more than 10 %: give the design of this "
                "wing with --design."
            )
    try:
        return design.changed(planform=planform)
    except InvalidDesignError as error:
        reason = str(error).removeprefix("the changed design: ")
        dimensions = " x ".join(f"{value * 1e3:.1f}" for value in planform.values())
        raise InvalidDesignError(
            f"the design {design.name} does not fit the measured planform "
            f"({dimensions} mm): {reason}"
        ) from None
