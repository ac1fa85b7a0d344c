"""Calibration step 1: the planform of the real wing, and the design brought to it."""

from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calibration.errors import ExperimentDataError, ExperimentFileError, said
from calibration.result.record import ParameterPrior, Reading
from calibration.static.experiments import HALF_WIDTH_95
from calibration.static.posterior import GaussianPrior
from fe.runtime.errors import InvalidDesignError
from fe.runtime.state import Geometry
from fe.wing.design import WingDesign
from reporting.files import hash_record

from .lab_folder import lab_table

TOLERANCE = 2.54e-3
"""Design tolerance of a length, half-width of a 95 % interval [m] (Kapteyn et al. 2021, Table 1)."""

READING_UNCERTAINTY = 0.2e-3
"""Uncertainty of a measured length, half-width of a 95 % interval [m] (the authors' script of step 1)."""

GEOMETRY_FILE = Path("step1") / "geometry_data.csv"
"""Where the authors' calibration folder keeps the lengths of step 1."""

PUBLISHED_NAMES = {"length": "semi_span", "chord_{root}": "root_chord", "chord_{tip}": "tip_chord"}
"""The names that the published file gives to the lengths, beside those of `fe.runtime.state.Geometry`."""

_USER = "the measured planform"
_LARGEST_DEVIATION = 0.10  # of a length from its design; beyond this the units or the wing are others


@dataclass(frozen=True)
class MeasuredLength:
    """One length of the wing, designed and as built.

    Attributes
    ----------
    name : str
        A field of `Lengths`.
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
            lengths = self.measured * 1e3, self.designed * 1e3
            raise ExperimentDataError(said("geometry.apart", self=self, lengths=lengths))

    @property
    def prior(self) -> ParameterPrior:
        """The design and its tolerance."""
        low, high = (self.designed * (1.0 + side * _LARGEST_DEVIATION) for side in (-1.0, 1.0))
        deviation = TOLERANCE / HALF_WIDTH_95
        return ParameterPrior(self.name, "m", self.designed, deviation, low, high, "design tolerance")

    @property
    def reading(self) -> Reading:
        """What was measured."""
        return Reading(self.name, "planform", self.measured, READING_UNCERTAINTY / HALF_WIDTH_95)

    @property
    def posterior(self) -> GaussianPrior:
        """Prior times the Gaussian likelihood of the measurement [m].

        The precisions add, and the mean is weighted by them: 1/s² = 1/s_0² + 1/s_r²,
        m = s² (designed / s_0² + measured / s_r²).
        """
        prior, reading = self.prior.deviation**-2, self.reading.deviation**-2
        mean = self.designed + (self.measured - self.designed) * reading / (prior + reading)
        return GaussianPrior(mean, (prior + reading) ** -0.5)


class Lengths(NamedTuple):
    """The measured lengths of a planform g, as `fe.runtime.state.Geometry` has them; errors independent."""

    semi_span: MeasuredLength
    root_chord: MeasuredLength
    tip_chord: MeasuredLength

    @property
    def sha256(self) -> str:
        """Hash of the figures and their uncertainty, the same on every platform."""
        return hash_record([[*astuple(item), TOLERANCE, READING_UNCERTAINTY] for item in self])


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
    """Read the lengths of step 1 from the authors' calibration folder, or from one CSV file.

    Parameters
    ----------
    path : Path
        The folder that holds `step1/geometry_data.csv` (also the folder above it in the authors'
        repository), or the CSV file itself: columns `parameter`, `designed` and `manufactured` [mm], rows
        `length`, `chord_{root}`, `chord_{tip}`.

    Raises
    ------
    ExperimentFileError
        If the file is missing, empty, lacks a column or a row, names a length twice, has a row with another
        number of cells than its header or a cell that is no number.
    ExperimentDataError
        If a value is not positive and finite, or the lengths are in another unit.
    """
    table = lab_table(path, GEOMETRY_FILE)
    names = table.cells("parameter", _USER)
    table.refuse_repeated(names, "parameter", "keep one of them")
    lost = [published for published in PUBLISHED_NAMES if published not in names]
    if lost:
        lacks = " and ".join(lost)
        raise ExperimentFileError(said("geometry.no_row", table=table, lacks=lacks, known=PUBLISHED_NAMES))
    lengths = {column: table.numbers(column, _USER, positive=True) for column in ("designed", "manufactured")}
    for column, values in lengths.items():
        for row in np.flatnonzero(values < 10.0):
            where = f"{table.name}, line {table.lines[row]}: {column}"
            raise ExperimentDataError(said("geometry.metres", where=where, value=values[row]))
    rows = {name: names.index(published) for published, name in PUBLISHED_NAMES.items()}
    return Lengths(
        *(MeasuredLength(name, *(1e-3 * of[row] for of in lengths.values())) for name, row in rows.items())
    )


def tailored_geometry(lengths: Lengths) -> Geometry:
    """Return the posterior means, rounded to what the measurement leaves uncertain, 0.1 mm [m].

    The paper keeps the means and drops their standard deviation, which is 0.1 mm.
    """
    return Geometry(*(round(length.posterior.mean, 4) for length in lengths))


def tailored_design(design: WingDesign, lengths: Lengths) -> WingDesign:
    """Return the design with the measured planform; the mesh follows.

    The planform alone is replaced. What the design places by a fraction moves with it: ribs, point masses
    and bands of the skin along the span, and everything along the chord. What it places by a distance stays
    where it is on the wing: gauges and defect regions from the root, the test load from the tip. The
    net load of a turn, skin and web thicknesses, and the largest cell stay.

    Raises
    ------
    ExperimentDataError
        If a length differs from that of the design by more than a tenth: it is another wing.
    InvalidDesignError
        If the tailored wing cannot be built; the sentence names the place.
    """
    planform = asdict(tailored_geometry(lengths))
    for name, value in planform.items():
        drawn = getattr(design.planform, name)
        if abs(value / drawn - 1.0) > _LARGEST_DEVIATION:
            both = value * 1e3, drawn * 1e3
            raise ExperimentDataError(said("geometry.another", name=name, lengths=both, design=design))
    try:
        return design.changed(planform=planform)
    except InvalidDesignError as error:
        reason = str(error).removeprefix("the changed design: ")
        shown = " x ".join(f"{value * 1e3:.1f}" for value in planform.values())
        why = said("geometry.unfit", design=design, shown=shown, reason=reason)
        raise InvalidDesignError(why) from None
