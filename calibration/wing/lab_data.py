"""What a lab folder holds for the three steps of the calibration, written and read, or published."""

import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from calibration.dynamics.extremes import refine_by_extremes
from calibration.dynamics.records import STEP_FOLDER, RingDownRecord, find_records, read_records
from calibration.dynamics.trials import Fits, fit_trials
from calibration.errors import ExperimentDataError, ExperimentFileError, said
from calibration.geometry import (
    GEOMETRY_FILE,
    PUBLISHED_NAMES,
    Lengths,
    published_lengths,
    read_lengths,
)
from calibration.joint.measured_modes import PUBLISHED_MODES, measured_modes
from calibration.joint.wing_table import weighed
from calibration.lab_folder import lab_place, lab_table
from calibration.paper.procedure import RESULTS_FILE, PaperSamples, read_published_results
from calibration.result.record import Reading
from calibration.static.experiments import (
    MEASUREMENTS_FILE,
    LoadDisplacementData,
    published_measurements,
    read_measurements,
)
from reporting.choices import require_one_of
from reporting.files import atomic_write_text, hash_file, hash_record
from reporting.table_file import table_text

WEIGHED_MASS_FILE = STEP_FOLDER / "weighed_mass.csv"
"""The weighed total of servos and pitot tube [g]; the authors give theirs in the paper alone."""

_WEIGHED_COLUMNS = ("mass", "standard_deviation")


def write_lab_folder(
    folder: Path,
    *,
    lengths: Lengths,
    load_test: LoadDisplacementData,
    records: Sequence[RingDownRecord],
    total_mass: Reading,
) -> tuple[Path, ...]:
    """Write measurements as the readers of `calibration` take them; every file is whole or not there.

    Parameters
    ----------
    folder : Path
        Where `step1`, `step2` and `step3` are made.
    lengths : Lengths
        Lengths, to `step1/geometry_data.csv` [mm].
    load_test : LoadDisplacementData
        Pairs in the order of their runs, to `step2/load_displacement_measurements.csv` [N], [mm].
    records : sequence of RingDownRecord
        Records, to `step3/initialconditiondata_N.DAT`: time [s], spanwise signal [V], and a chordwise column
        of zeros, because the wing model has no chordwise gauge.
    total_mass : Reading
        Weighed total, to `step3/weighed_mass.csv` [g].

    Returns
    -------
    tuple of Path
        The files.

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If a file cannot be written.
    """

    def write(name: Path, **columns: Iterable[float | str]) -> Path:
        cells = [
            [item if isinstance(item, str) else f"{item:.10g}" for item in of] for of in columns.values()
        ]
        return atomic_write_text(Path(folder) / name, table_text(dict(zip(columns, cells, strict=True))))

    designed, measured = ([1e3 * getattr(item, of) for item in lengths] for of in ("designed", "measured"))
    files = [
        write(GEOMETRY_FILE, parameter=PUBLISHED_NAMES, designed=designed, manufactured=measured),
        write(MEASUREMENTS_FILE, load=load_test.load, displacement=load_test.displacement * 1e3),
    ]
    for number, record in enumerate(records, start=1):
        table = np.column_stack([record.time, record.signal, np.zeros(record.count)])
        lines = io.StringIO()
        np.savetxt(lines, table, fmt=("%.6f", "%.9e", "%d"), delimiter="\t")
        file = Path(folder) / STEP_FOLDER / f"initialconditiondata_{number}.DAT"
        files.append(atomic_write_text(file, lines.getvalue()))
    grams = [total_mass.value * 1e3], [total_mass.deviation * 1e3]
    return *files, write(WEIGHED_MASS_FILE, **dict(zip(_WEIGHED_COLUMNS, grams, strict=True)))


def read_weighed_mass(file: Path) -> Reading:
    """Read the weighed total of a laboratory.

    Raises
    ------
    ExperimentFileError
        If the file cannot be read, lacks a column, has not exactly one row, or a cell is no number.
    ExperimentDataError
        If a figure is not a positive finite number of grams, or looks like kg.
    """
    table = lab_table(file, WEIGHED_MASS_FILE)
    if len(table) != 1:
        raise ExperimentFileError(said("readings.mass", file=file, came=len(table)))
    mass, deviation = (
        float(table.numbers(name, "a weighing", positive=True)[0]) for name in _WEIGHED_COLUMNS
    )
    for wrong, unit in ((mass < 10.0, "kg"), (mass > 1e5, "mg")):
        if wrong:
            raise ExperimentDataError(f"{file}: mass is {mass:g} g, which looks like {unit}: give it in g.")
    if deviation >= mass:
        raise ExperimentDataError(said("readings.mass_deviation", file=file, given=(deviation, mass)))
    return weighed(1e-3 * mass, 1e-3 * deviation)


Targets = Literal["measured", "published"]
"""Whose frequencies and damping ratios step 3 aims at."""


class StepOrigin(NamedTuple):
    """Where the figures of one step come from: its number, whether they were read, and a few words."""

    step: int
    read: bool
    text: str


@dataclass(frozen=True, eq=False)
class LabData:
    """The measurements of one wing, step by step.

    Attributes
    ----------
    lengths : Lengths
        Step 1.
    pairs : LoadDisplacementData
        Step 2.
    readings : tuple of Reading
        Weighed mass of two servos and the pitot tube, frequencies and damping ratios.
    trials : Fits or None
        Step 3, fitted; None where the published frequencies and damping ratios stand in.
    authors : PaperSamples or None
        The authors' own results of step 3, to be drawn beside ours.
    origins : tuple of StepOrigin
        Where the figures of each step come from.
    input_hashes : dict
        Name of an input -> SHA-256 of its content.
    """

    lengths: Lengths
    pairs: LoadDisplacementData
    readings: tuple[Reading, ...]
    origins: tuple[StepOrigin, ...]
    input_hashes: dict[str, str]
    trials: Fits | None = None
    authors: PaperSamples | None = None


def published_data() -> LabData:
    """Return the published measurements of the wing of Kapteyn et al. 2021."""
    lengths, pairs = published_lengths(), published_measurements()
    return LabData(
        lengths=lengths,
        pairs=pairs,
        readings=(weighed(), *PUBLISHED_MODES),
        origins=tuple(StepOrigin(step, False, text) for step, text in _PUBLISHED.items()),
        input_hashes={"lengths": lengths.sha256, "load_test": pairs.sha256},
    )


def read_lab_folder(path: Path, targets: Targets | None = None, *, free: bool = False) -> LabData:
    """Read a lab folder in the authors' layout; a step that is not there is taken as published.

    Parameters
    ----------
    path : Path
        The folder that holds `step1`, `step2`, `step3`, or some of them (also the folder above it in the
        authors' repository). Ring-down records may also lie in the folder itself.
    targets : {"measured", "published"}, optional
        Whether step 3 aims at the ring-down records; by default where there are any.
    free : bool
        Whether the frequencies of a record are fitted; else they are those of its spectrum, as the authors
        do.

    Raises
    ------
    ExperimentFileError
        If the folder does not exist, holds no step at all, or a step's folder lacks its file; and where
        records are asked for and there are none.
    ExperimentDataError
        If what is there cannot be a measurement; see the readers of the steps.
    InvalidChoiceError
        If `targets` is another word.
    """
    if targets is not None:
        require_one_of(targets, get_args(Targets), "targets")
    path = Path(path)
    if not path.is_dir():
        what = "no folder" if path.exists() else "not there"
        raise ExperimentFileError(said("readings.no_folder", path=path, what=what))
    steps = {step for step in (1, 2, 3) if lab_place(path, Path(f"step{step}")) is not None}
    records = find_records(path)
    if not steps and not records:
        raise ExperimentFileError(said("readings.no_steps", path=path))
    if targets == "measured" and not records:
        raise ExperimentFileError(said("readings.measured", path=path))
    lab = published_data()
    hashes, origins = lab.input_hashes, {origin.step: origin for origin in lab.origins}
    found: dict[str, Any] = {}
    mass, modes = lab.readings[0], lab.readings[1:]
    if 1 in steps:
        found["lengths"] = read_lengths(path)
        hashes["lengths"] = found["lengths"].sha256
        origins[1] = StepOrigin(1, True, f"{GEOMETRY_FILE.as_posix()} read")
    if 2 in steps:
        found["pairs"] = pairs = read_measurements(path)
        hashes["load_test"] = pairs.sha256
        origins[2] = StepOrigin(2, True, f"{MEASUREMENTS_FILE.as_posix()} read, {pairs.count} pairs")
    if records and targets != "published":
        trials = fit_trials(read_records(path), free=free)
        if all(fit.record.lowest is not None for fit in trials):
            # extremes are averages of the signal; the middle of the ink is none
            trials = refine_by_extremes(trials)
        found["trials"] = trials
        modes = measured_modes(trials)
        hashes |= {f"ring_down_{number}": hash_file(file) for number, file in enumerate(records, start=1)}
        names = records[0].name if len(records) == 1 else f"{records[0].name} to {records[-1].name}"
        origins[3] = StepOrigin(3, True, f"{names} read")
    elif records:
        origins[3] = StepOrigin(3, False, "records left aside as asked; " + _PUBLISHED[3])
    if (file := lab_place(path, WEIGHED_MASS_FILE)) is not None:
        mass = read_weighed_mass(file)
        hashes["weighed_mass"] = hash_record([mass.value, mass.deviation])
        origins[3] = origins[3]._replace(text=f"{origins[3].text}; {WEIGHED_MASS_FILE.as_posix()} read")
    if (file := lab_place(path, STEP_FOLDER / RESULTS_FILE)) is not None:
        found["authors"] = read_published_results(file)
    return replace(lab, readings=(mass, *modes), origins=tuple(origins.values()), **found)


_PUBLISHED = {
    1: "published lengths (Kapteyn et al. 2021, Table 1)",
    2: "published pairs (Kapteyn et al. 2021, Fig. 5)",
    3: "published frequencies and damping ratios (the authors' step 3)",
}
