"""Measurements for the three steps of the calibration: published, or from a lab folder."""

import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np

from calibration.dynamics.extremes import refine_by_extremes
from calibration.dynamics.records import STEP_FOLDER, RingDownRecord, find_records, read_records
from calibration.dynamics.trials import Fits, fit_trials
from calibration.errors import ExperimentDataError, ExperimentFileError
from calibration.geometry import (
    GEOMETRY_FILE,
    PUBLISHED_NAMES,
    Lengths,
    published_lengths,
    read_lengths,
)
from calibration.joint.measured_modes import PUBLISHED_MODES, measured_modes
from calibration.joint.wing_table import weighed_mass
from calibration.lab_folder import find_in_lab_folder, lab_table
from calibration.result.record import QuantityReading
from calibration.static.experiments import (
    MEASUREMENTS_FILE,
    LoadDisplacementData,
    published_measurements,
    read_measurements,
)
from reporting.choices import require_one_of
from reporting.files import atomic_write_text, hash_file, hash_record
from reporting.formats.table_file import table_text

WEIGHED_MASS_FILE = STEP_FOLDER / "weighed_mass.csv"
"""The file of the weighed total of servos and pitot tube [g]; the authors have none."""

_LIGHTEST_GRAMS = 10.0  # a smaller mass is probably in kg
_HEAVIEST_GRAMS = 1e5  # a larger mass is probably in mg


def write_lab_folder(
    folder: Path,
    *,
    lengths: Lengths,
    load_test: LoadDisplacementData,
    records: Sequence[RingDownRecord],
    total_mass: QuantityReading,
) -> tuple[Path, ...]:
    """Write measurements into a folder, in the layout that `read_lab_folder` reads.

    Parameters
    ----------
    folder : Path
        The folder, in which `step1`, `step2` and `step3` are made.
    lengths : Lengths
        The lengths, for `step1/geometry_data.csv` [mm].
    load_test : LoadDisplacementData
        The pairs in the order of their runs, for `step2/load_displacement_measurements.csv` [N],
        [mm].
    records : sequence of RingDownRecord
        The records, for `step3/initialconditiondata_N.DAT`: time [s], spanwise signal [V], and a
        chordwise column of zeros, because the wing model has no chordwise gauge.
    total_mass : QuantityReading
        The weighed total, for `step3/weighed_mass.csv` [g].

    Returns
    -------
    tuple of Path
        The files.

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If a file cannot be written.
    """
    folder = Path(folder)
    geometry_table = {
        "parameter": list(PUBLISHED_NAMES),
        "designed": _cells(1e3 * length.designed for length in lengths),
        "manufactured": _cells(1e3 * length.measured for length in lengths),
    }
    load_table = {
        "load": _cells(load_test.load),
        "displacement": _cells(load_test.displacement * 1e3),
    }
    mass_table = {
        "mass": _cells([total_mass.value * 1e3]),
        "standard_deviation": _cells([total_mass.deviation * 1e3]),
    }
    files = [
        atomic_write_text(folder / GEOMETRY_FILE, table_text(geometry_table)),
        atomic_write_text(folder / MEASUREMENTS_FILE, table_text(load_table)),
    ]
    for number, record in enumerate(records, start=1):
        file = folder / STEP_FOLDER / f"initialconditiondata_{number}.DAT"
        files.append(atomic_write_text(file, _record_text(record)))
    files.append(atomic_write_text(folder / WEIGHED_MASS_FILE, table_text(mass_table)))
    return tuple(files)


def _cells(values: Iterable[float]) -> list[str]:
    """Format numbers as cells of a table, with ten digits."""
    return [f"{value:.10g}" for value in values]


def _record_text(record: RingDownRecord) -> str:
    """Format a ring-down record as the text of a file: time, spanwise signal, zeros."""
    table = np.column_stack([record.time, record.signal, np.zeros(record.count)])
    stream = io.StringIO()
    np.savetxt(stream, table, fmt=("%.6f", "%.9e", "%d"), delimiter="\t")
    return stream.getvalue()


def read_weighed_mass(file: Path) -> QuantityReading:
    """Read the weighed total of a laboratory.

    Raises
    ------
    ExperimentFileError
        If the file cannot be read, lacks a column, has not exactly one row, or a cell is not a
        number.
    ExperimentDataError
        If a value is not a positive finite number of grams, or looks like kg or mg.
    """
    table = lab_table(file, WEIGHED_MASS_FILE)
    if len(table) != 1:
        raise ExperimentFileError(
            f"{file} needs a header `mass,standard_deviation` and one row in grams, but "
            f"{len(table)} rows were given."
        )
    mass = float(table.numbers("mass", "a weighing", positive=True)[0])
    deviation = float(table.numbers("standard_deviation", "a weighing", positive=True)[0])
    if mass < _LIGHTEST_GRAMS:
        raise ExperimentDataError(f"{file}: mass is {mass:g} g, which looks like kg: give it in g.")
    if mass > _HEAVIEST_GRAMS:
        raise ExperimentDataError(f"{file}: mass is {mass:g} g, which looks like mg: give it in g.")
    if deviation >= mass:
        raise ExperimentDataError(
            f"{file}: the standard deviation, {deviation:g} g, must be less than the mass, "
            f"{mass:g} g."
        )
    return weighed_mass(1e-3 * mass, 1e-3 * deviation)


Targets = Literal["measured", "published"]
"""The frequencies and damping ratios to which step 3 calibrates."""


class StepOrigin(NamedTuple):
    """The origin of the measurements of one step.

    Attributes
    ----------
    step : int
        The number of the step.
    read : bool
        Whether they were read from a folder; otherwise they are published.
    text : str
        The origin in a few words.
    """

    step: int
    read: bool
    text: str


@dataclass(frozen=True, eq=False)
class LabData:
    """The measurements of one wing, step by step.

    Attributes
    ----------
    lengths : Lengths
        The lengths of step 1.
    pairs : LoadDisplacementData
        The load test of step 2.
    readings : tuple of QuantityReading
        The weighed mass of two servos and the pitot tube, the frequencies and the damping ratios.
    origins : tuple of StepOrigin
        The origin of the measurements of each step.
    input_hashes : dict of str to str
        The SHA-256 of each input.
    trials : Fits or None
        The fitted ring-downs of step 3; None if the readings are the published ones.
    authors : PaperSamples or None
        The authors' own results of step 3, to be drawn next to ours.
    """

    lengths: Lengths
    pairs: LoadDisplacementData
    readings: tuple[QuantityReading, ...]
    origins: tuple[StepOrigin, ...]
    input_hashes: dict[str, str]
    trials: Fits | None = None


def published_data() -> LabData:
    """Return the published measurements of the wing of Kapteyn et al. 2021."""
    lengths = published_lengths()
    pairs = published_measurements()
    origins = [StepOrigin(step, read=False, text=text) for step, text in _PUBLISHED.items()]
    return LabData(
        lengths=lengths,
        pairs=pairs,
        readings=(weighed_mass(), *PUBLISHED_MODES),
        origins=tuple(origins),
        input_hashes={"lengths": lengths.sha256, "load_test": pairs.sha256},
    )


def read_lab_folder(
    path: Path, targets: Targets | None = None, *, frequencies_fitted: bool = False
) -> LabData:
    """Read the measurements in a lab folder; a missing step gets the published measurements.

    Parameters
    ----------
    path : Path
        The folder that holds `step1`, `step2`, `step3`, or some of them (also the folder above it
        in the authors' repository). Ring-down records may also lie in the folder itself.
    targets : {"measured", "published"}, optional
        Whether step 3 uses the ring-down records; by default it does if there are any.
    frequencies_fitted : bool
        Whether the frequencies of a record are fitted; otherwise they are those of its spectrum, as
        in the authors' procedure.

    Raises
    ------
    ExperimentFileError
        If the folder does not exist or holds no step at all, a step's folder lacks its file, or
        records are required and there are none.
    ExperimentDataError
        If a file holds impossible measurements; see the readers of the steps.
    InvalidChoiceError
        If `targets` is another word.
    """
    if targets is not None:
        require_one_of(targets, get_args(Targets), "targets")
    path = Path(path)
    if not path.is_dir():
        state = "not a folder" if path.exists() else "missing"
        raise ExperimentFileError(
            f"{path} is {state}; give the folder that holds step1, step2 and step3."
        )
    steps = [
        step for step in (1, 2, 3) if find_in_lab_folder(path, Path(f"step{step}")) is not None
    ]
    record_files = find_records(path)
    if not steps and not record_files:
        raise ExperimentFileError(
            f"{path} holds none of the folders step1, step2 and step3; give the authors' "
            "calibration folder or one laid out like it."
        )
    if targets == "measured" and not record_files:
        raise ExperimentFileError(
            f"{path} holds no ring-down record, and --measured asks for them; "
            "give --published instead."
        )
    lab = published_data()
    if 1 in steps:
        lab = _with_lengths(lab, path)
    if 2 in steps:
        lab = _with_load_test(lab, path)
    if record_files and targets != "published":
        lab = _with_ring_downs(lab, path, record_files, frequencies_fitted=frequencies_fitted)
    elif record_files:
        lab = _with_origin(lab, 3, f"records ignored as requested; {_PUBLISHED[3]}", read=False)
    mass_file = find_in_lab_folder(path, WEIGHED_MASS_FILE)
    if mass_file is not None:
        lab = _with_weighed_mass(lab, mass_file)
    return lab


def _with_origin(lab: LabData, step: int, text: str, *, read: bool) -> LabData:
    """Return lab data with another origin of one step."""
    origins = {origin.step: origin for origin in lab.origins}
    origins[step] = StepOrigin(step, read, text)
    return replace(lab, origins=tuple(origins.values()))


def _with_hashes(lab: LabData, **hashes: str) -> LabData:
    """Return lab data with the hashes of further inputs."""
    return replace(lab, input_hashes=lab.input_hashes | hashes)


def _with_lengths(lab: LabData, path: Path) -> LabData:
    """Return lab data with the lengths of step 1 from a folder."""
    lengths = read_lengths(path)
    lab = _with_hashes(replace(lab, lengths=lengths), lengths=lengths.sha256)
    return _with_origin(lab, 1, f"{GEOMETRY_FILE.as_posix()} read", read=True)


def _with_load_test(lab: LabData, path: Path) -> LabData:
    """Return lab data with the load test of step 2 from a folder."""
    pairs = read_measurements(path)
    lab = _with_hashes(replace(lab, pairs=pairs), load_test=pairs.sha256)
    text = f"{MEASUREMENTS_FILE.as_posix()} read, {pairs.count} pairs"
    return _with_origin(lab, 2, text, read=True)


def _with_ring_downs(
    lab: LabData, path: Path, record_files: Sequence[Path], *, frequencies_fitted: bool
) -> LabData:
    """Return lab data with the ring-downs of step 3, and frequencies and damping from them.

    The first reading, the mass, is kept; the others are replaced.
    """
    trials = fit_trials(read_records(path), frequencies_fitted=frequencies_fitted)
    if all(fit.record.lowest is not None for fit in trials):
        # These records were read off plots. The lowest and the highest ink in a column of pixels
        # are extremes of the signal in its interval, while the middle between them is not quite
        # the average.
        trials = refine_by_extremes(trials)
    mass = lab.readings[0]
    lab = replace(lab, trials=trials, readings=(mass, *measured_modes(trials)))
    hashes = {}
    for number, file in enumerate(record_files, start=1):
        hashes[f"ring_down_{number}"] = hash_file(file)
    lab = _with_hashes(lab, **hashes)
    first_name = record_files[0].name
    last_name = record_files[-1].name
    names = first_name if len(record_files) == 1 else f"{first_name} to {last_name}"
    return _with_origin(lab, 3, f"{names} read", read=True)


def _with_weighed_mass(lab: LabData, file: Path) -> LabData:
    """Return lab data with the weighed mass in a file as the first reading."""
    mass = read_weighed_mass(file)
    _, *modes = lab.readings
    lab = replace(lab, readings=(mass, *modes))
    lab = _with_hashes(lab, weighed_mass=hash_record([mass.value, mass.deviation]))
    origin = next(origin for origin in lab.origins if origin.step == 3)
    text = f"{origin.text}; {WEIGHED_MASS_FILE.as_posix()} read"
    return _with_origin(lab, 3, text, read=origin.read)


_PUBLISHED = {
    1: "published lengths (Kapteyn et al. 2021, Table 1)",
    2: "published pairs (Kapteyn et al. 2021, Fig. 5)",
    3: "published frequencies and damping ratios (the authors' step 3)",
}
