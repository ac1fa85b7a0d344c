"""A laboratory folder in the layout that the paper's authors published, written from measurements."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from reporting.files import atomic_write_text

from .errors import ExperimentDataError, ExperimentFileError
from .experiments import MEASUREMENTS_FILE, LoadDisplacementData
from .geometry import GEOMETRY_FILE, GeometryCalibration
from .joint.prior import WeighedMass
from .ringdown_records import STEP_FOLDER, RingDownRecord

WEIGHED_MASS_FILE = STEP_FOLDER / "weighed_mass.csv"
"""The weighed total of servos and pitot tube [g]; the authors give theirs in the paper alone."""

_PUBLISHED_LENGTHS = (("length", "semi_span"), ("chord_{root}", "root_chord"), ("chord_{tip}", "tip_chord"))


def write_lab_folder(
    folder: Path,
    *,
    lengths: GeometryCalibration,
    load_test: LoadDisplacementData,
    records: Sequence[RingDownRecord],
    total_mass: WeighedMass | None = None,
) -> tuple[Path, ...]:
    """Write measurements as the readers of `calibration` take them; every file is whole or not there.

    Parameters
    ----------
    folder : Path
        Where `step1`, `step2` and `step3` are made.
    lengths : GeometryCalibration
        Lengths, to `step1/geometry_data.csv` [mm].
    load_test : LoadDisplacementData
        Pairs in the order of their runs, to `step2/load_displacement_measurements.csv` [N], [mm].
    records : sequence of RingDownRecord
        Records, to `step3/initialconditiondata_N.DAT`: time [s], spanwise signal [V], and a chordwise column
        of zeros, because the wing model has no chordwise gauge.
    total_mass : WeighedMass, optional
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
    rows: list[Sequence[object]] = [("parameter", "designed", "manufactured")]
    for published, name in _PUBLISHED_LENGTHS:
        length = getattr(lengths, name)
        rows.append((published, f"{length.designed * 1e3:.10g}", f"{length.measured * 1e3:.10g}"))
    files = [atomic_write_text(folder / GEOMETRY_FILE, _csv(rows))]
    rows = [("load", "displacement")]
    pairs = zip(load_test.load.tolist(), load_test.displacement.tolist(), strict=True)
    rows += [(f"{load:.10g}", f"{displacement * 1e3:.10g}") for load, displacement in pairs]
    files.append(atomic_write_text(folder / MEASUREMENTS_FILE, _csv(rows)))
    for number, record in enumerate(records, start=1):
        table = np.column_stack([record.time, record.signal, np.zeros(record.count)])
        text = io.StringIO()
        np.savetxt(text, table, fmt=("%.6f", "%.9e", "%d"), delimiter="\t")
        file = folder / STEP_FOLDER / f"initialconditiondata_{number}.DAT"
        files.append(atomic_write_text(file, text.getvalue()))
    if total_mass is not None:
        rows = [("mass", "standard_deviation")]
        rows.append((f"{total_mass.mass * 1e3:.10g}", f"{total_mass.standard_deviation * 1e3:.10g}"))
        files.append(atomic_write_text(folder / WEIGHED_MASS_FILE, _csv(rows)))
    return tuple(files)


def read_weighed_mass(folder: Path) -> WeighedMass:
    """Read the weighed total of a laboratory folder; the paper's 472 g where there is no such file.

    Raises
    ------
    ExperimentFileError
        If the file cannot be read or lacks a column or its row.
    ExperimentDataError
        If a figure is not a positive finite number of grams, or looks like kg.
    """
    file = Path(folder) / WEIGHED_MASS_FILE
    if not file.exists():
        return WeighedMass()
    try:
        with file.open(encoding="utf-8-sig", newline="") as stream:
            rows = list(csv.DictReader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ExperimentFileError(f"{file} cannot be read as a CSV text file: {error}.") from error
    if len(rows) != 1 or not {"mass", "standard_deviation"} <= set(rows[0]):
        raise ExperimentFileError(f"{file} needs a header `mass,standard_deviation` and one row in grams.")
    figures = []
    for name in ("mass", "standard_deviation"):
        try:
            value = float(rows[0][name])
        except (TypeError, ValueError):
            value = math.nan
        if not (math.isfinite(value) and value > 0.0):
            raise ExperimentDataError(
                f"{file}: {name} is {rows[0][name]!r}, but a positive finite number of grams is needed."
            )
        figures.append(value)
    if figures[0] < 10.0:
        raise ExperimentDataError(f"{file}: mass is {figures[0]:g} g, which looks like kg: give it in g.")
    return WeighedMass(1e-3 * figures[0], 1e-3 * figures[1])


def _csv(rows: Sequence[Sequence[object]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
