"""A laboratory folder in the layout that the paper's authors published, written from measurements."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.dynamics.records import STEP_FOLDER, RingDownRecord
from calibration.errors import ExperimentDataError, ExperimentFileError
from calibration.geometry import GEOMETRY_FILE, PUBLISHED_NAMES, Lengths
from calibration.joint.prior import weighed
from calibration.lab_folder import lab_table
from calibration.result.record import Reading
from calibration.static.experiments import MEASUREMENTS_FILE, LoadDisplacementData
from reporting.files import atomic_write_text
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
    total_mass: Reading | None = None,
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
    total_mass : Reading, optional
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
    folder = Path(folder)
    columns = [
        [*PUBLISHED_NAMES],
        [f"{length.designed * 1e3:.10g}" for length in lengths],
        [f"{length.measured * 1e3:.10g}" for length in lengths],
    ]
    text = table_text(("parameter", "designed", "manufactured"), columns)
    files = [atomic_write_text(folder / GEOMETRY_FILE, text)]
    columns = [
        [f"{load:.10g}" for load in load_test.load.tolist()],
        [f"{displacement * 1e3:.10g}" for displacement in load_test.displacement.tolist()],
    ]
    files.append(atomic_write_text(folder / MEASUREMENTS_FILE, table_text(("load", "displacement"), columns)))
    for number, record in enumerate(records, start=1):
        table = np.column_stack([record.time, record.signal, np.zeros(record.count)])
        lines = io.StringIO()
        np.savetxt(lines, table, fmt=("%.6f", "%.9e", "%d"), delimiter="\t")
        file = folder / STEP_FOLDER / f"initialconditiondata_{number}.DAT"
        files.append(atomic_write_text(file, lines.getvalue()))
    if total_mass is not None:
        columns = [[f"{kilograms * 1e3:.10g}"] for kilograms in (total_mass.value, total_mass.deviation)]
        files.append(atomic_write_text(folder / WEIGHED_MASS_FILE, table_text(_WEIGHED_COLUMNS, columns)))
    return tuple(files)


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
        raise ExperimentFileError(
            f"{file} needs a header `mass,standard_deviation` and one row in grams, and {len(table)} came."
        )
    mass, deviation = (float(table.positive_numbers(name, "a weighing")[0]) for name in _WEIGHED_COLUMNS)
    for wrong, unit in ((mass < 10.0, "kg"), (mass > 1e5, "mg")):
        if wrong:
            raise ExperimentDataError(f"{file}: mass is {mass:g} g, which looks like {unit}: give it in g.")
    if deviation >= mass:
        raise ExperimentDataError(
            f"{file}: the standard deviation, {deviation:g} g, must be less than the mass, {mass:g} g."
        )
    return weighed(1e-3 * mass, 1e-3 * deviation)
