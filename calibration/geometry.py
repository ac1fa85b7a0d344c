"""Calibration step 1: the planform of the real wing from its design tolerance and a measurement."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

from fe.state import Geometry

from .errors import ExperimentDataError, ExperimentFileError
from .experiments import HALF_WIDTH_95
from .posterior import GaussianPrior

TOLERANCE = 2.54e-3
"""Design tolerance of a length, half-width of a 95 % interval [m] (Kapteyn et al. 2021, Table 1)."""

READING_UNCERTAINTY = 0.2e-3
"""Uncertainty of a measured length, half-width of a 95 % interval [m] (the authors' script of step 1)."""

GEOMETRY_FILE = Path("step1") / "geometry_data.csv"
"""Where the authors' calibration folder keeps the lengths of step 1."""

LENGTH_NAMES = ("semi_span", "root_chord", "tip_chord")
"""The lengths, in the order of `fe.state.Geometry`."""

# The names that the published file gives to the lengths.
_PUBLISHED_NAMES = {"length": "semi_span", "chord_{root}": "root_chord", "chord_{tip}": "tip_chord"}
_FOLDERS_OF_STEPS = (Path(), Path("datafiles"), Path("src") / "datafiles")
_LARGEST_DEVIATION = 0.10  # of a length from its design; beyond this the units or the wing are others


@dataclass(frozen=True)
class MeasuredLength:
    """One length of the wing, designed and as built.

    Attributes
    ----------
    name : str
        One of `LENGTH_NAMES`.
    designed, measured : float
        The length on the drawing and on the wing [m].
    tolerance, reading_uncertainty : float
        Half-widths of 95 % intervals of the design and of the measurement [m].

    Raises
    ------
    ExperimentDataError
        If a figure is not positive and finite, or the two lengths differ by more than 10 %.
    """

    name: str
    designed: float
    measured: float
    tolerance: float = TOLERANCE
    reading_uncertainty: float = READING_UNCERTAINTY

    def __post_init__(self) -> None:
        for what in ("designed", "measured", "tolerance", "reading_uncertainty"):
            value = getattr(self, what)
            if not (math.isfinite(value) and value > 0.0):
                raise ExperimentDataError(
                    f"{what} of {self.name} is {value:g} m, but a positive finite length is needed."
                )
        if abs(self.measured / self.designed - 1.0) > _LARGEST_DEVIATION:
            raise ExperimentDataError(
                f"{self.name} measures {self.measured * 1e3:g} mm where {self.designed * 1e3:g} mm were "
                "designed, more than 10 % apart: check the units (both in mm) and the wing."
            )

    @property
    def prior(self) -> GaussianPrior:
        """The design and its tolerance [m]."""
        return GaussianPrior(self.designed, self.tolerance / HALF_WIDTH_95)

    @property
    def posterior(self) -> GaussianPrior:
        """Prior times the Gaussian likelihood of the measurement [m].

        The precisions add, and the mean is weighted by them: 1/s² = 1/s_0² + 1/s_r²,
        m = s² (designed / s_0² + measured / s_r²).
        """
        prior = (self.tolerance / HALF_WIDTH_95) ** -2
        reading = (self.reading_uncertainty / HALF_WIDTH_95) ** -2
        mean = self.designed + (self.measured - self.designed) * reading / (prior + reading)
        return GaussianPrior(mean, (prior + reading) ** -0.5)

    @property
    def score(self) -> float:
        """How far the measurement lies from the design, in standard deviations of prior and reading [1]."""
        scatter = math.hypot(self.tolerance, self.reading_uncertainty) / HALF_WIDTH_95
        return (self.measured - self.designed) / scatter

    @property
    def uncertainty_reduction(self) -> float:
        """Share of the prior's standard deviation that the measurement took away [1]."""
        return 1.0 - self.posterior.standard_deviation / self.prior.standard_deviation


@dataclass(frozen=True)
class GeometryCalibration:
    """Posterior of the planform g, Kapteyn et al. 2021, Table 1.

    Attributes
    ----------
    semi_span, root_chord, tip_chord : MeasuredLength
        The three lengths; their errors are independent.
    source : str
        Where the figures come from.
    """

    semi_span: MeasuredLength
    root_chord: MeasuredLength
    tip_chord: MeasuredLength
    source: str

    @property
    def lengths(self) -> tuple[MeasuredLength, MeasuredLength, MeasuredLength]:
        """The three lengths in the order of `LENGTH_NAMES`."""
        return self.semi_span, self.root_chord, self.tip_chord

    @property
    def geometry(self) -> Geometry:
        """The planform at the posterior mean, from which a wing is modelled [m]."""
        return Geometry(*(length.posterior.mean for length in self.lengths))


def published_lengths() -> GeometryCalibration:
    """Return the lengths of the real wing.

    Source: M. G. Kapteyn, UAV-Experimental-Calibration, `step1/geometry_data.csv` (BSD 3-clause);
    Kapteyn et al. 2021, Table 1.
    """
    return GeometryCalibration(
        semi_span=MeasuredLength("semi_span", 1.8288, 1.8280),
        root_chord=MeasuredLength("root_chord", 0.43561, 0.4330),
        tip_chord=MeasuredLength("tip_chord", 0.261112, 0.2600),
        source="published lengths (Kapteyn et al. 2021, Table 1)",
    )


def read_lengths(path: Path) -> GeometryCalibration:
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
        If the file is missing, empty, or lacks a column or a row.
    ExperimentDataError
        If a value is not a positive finite number, or the lengths are in another unit.
    """
    file = _find(Path(path))
    try:
        with file.open(encoding="utf-8-sig", newline="") as stream:
            rows = [
                [cell.strip() for cell in row] for row in csv.reader(stream) if any(c.strip() for c in row)
            ]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ExperimentFileError(f"{file} cannot be read as a CSV text file: {error}.") from error
    if not rows:
        raise ExperimentFileError(
            f"{file} is empty; a header `parameter,designed,manufactured` and three rows are needed."
        )
    header = rows[0]
    missing = [name for name in ("parameter", "designed", "manufactured") if name not in header]
    if missing:
        raise ExperimentFileError(
            f"{file} lacks the column {' and '.join(missing)}; its columns are {', '.join(header)}."
        )
    found: dict[str, MeasuredLength] = {}
    for row in rows[1:]:
        cells = dict(zip(header, row, strict=False))
        name = _PUBLISHED_NAMES.get(cells.get("parameter", ""))
        if name is not None:
            designed, measured = (_length(file, cells, column) for column in ("designed", "manufactured"))
            found[name] = MeasuredLength(name, designed, measured)
    lost = [published for published, name in _PUBLISHED_NAMES.items() if name not in found]
    if lost:
        raise ExperimentFileError(
            f"{file} lacks the row {' and '.join(lost)}; the rows {', '.join(_PUBLISHED_NAMES)} are needed."
        )
    return GeometryCalibration(source=file.name, **found)


def _find(path: Path) -> Path:
    if path.is_file():
        return path
    for folder in _FOLDERS_OF_STEPS:
        if (path / folder / GEOMETRY_FILE).is_file():
            return path / folder / GEOMETRY_FILE
    if not path.exists():
        raise ExperimentFileError(f"{path} does not exist; give the folder that holds {GEOMETRY_FILE}.")
    raise ExperimentFileError(f"{path} does not hold {GEOMETRY_FILE}; give the authors' calibration folder.")


def _length(file: Path, cells: dict[str, str], column: str) -> float:
    text = cells.get(column, "")
    try:
        millimetres = float(text)
    except ValueError:
        millimetres = math.nan
    where = f"{file}: {column} of {cells['parameter']}"
    if not (math.isfinite(millimetres) and millimetres > 0.0):
        raise ExperimentDataError(f"{where} is {text!r}, but a positive finite length in mm is needed.")
    if millimetres < 10.0:
        raise ExperimentDataError(f"{where} is {text} mm, which looks like m: give it in mm.")
    return millimetres * 1e-3
