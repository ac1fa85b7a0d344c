"""The folder that a calibration leaves."""

from pathlib import Path
from typing import NamedTuple

from calibration.samples.file import FILE_NAME
from calibration.samples.folder import FIGURES, drawing_names, replaced_at_once
from fe.reduction.fields import WingFields, write_modes_vtu, write_wing_vtu
from fe.reduction.model_cache import wing_fields
from reporting.figures import to_png, to_svg
from reporting.files import atomic_write_bytes, atomic_write_text
from reporting.progress import Progress

from .report import FIGURE_NAMES, render_page, report_figures
from .result_file import result_bytes
from .table_1 import table_1, write_table_1
from .three_steps import WingCalibration

LOAD_FACTOR = 3.0
"""Of the turn in which `wing.vtu` shows the wing."""

WING_FIELDS, MODE_FIELDS = "wing.vtu", "modes.vtu"


class CalibrationFiles(NamedTuple):
    """What `write_calibration_folder` leaves."""

    calibration: Path
    report: Path
    table: Path


def calibration_files(folder: Path) -> CalibrationFiles:
    """Return the paths in the folder of a calibration."""
    return CalibrationFiles(folder / FILE_NAME, folder / "report.html", folder / "table_1.csv")


def write_calibration_folder(
    calibration: WingCalibration, folder: Path, progress: Progress, *, report: bool = True
) -> CalibrationFiles:
    """Write page, figures, table, the wing for ParaView, and last `calibration.nc`.

    Without a report, table and `calibration.nc` alone.

    Everything is written beside the folder first and moved into place when it is complete: a full disk leaves
    the folder as it was. An older file of the same name is replaced, an older report that none replaces
    removed.

    Raises
    ------
    FileNotWrittenError
        If a file cannot be written.
    """
    paths = calibration_files(folder)
    content = result_bytes(calibration.result)
    drawings: dict[str, bytes] = {}
    if report:
        with progress.stage("Drawing the report"):
            fields = wing_fields(calibration.result.design, progress=progress)
            figures = report_figures(calibration, fields)
            drawings = {name: to_svg(figure) for name, figure in figures.items()}
            pictures = {name: to_png(figure) for name, figure in figures.items()}
            page = render_page(calibration, drawings)
    companions = [paths.report.name, WING_FIELDS, MODE_FIELDS, *drawing_names(FIGURE_NAMES)]
    with replaced_at_once(folder, companions) as fresh:
        for name in drawings:
            atomic_write_bytes(fresh / FIGURES / f"{name}.svg", drawings[name])
            atomic_write_bytes(fresh / FIGURES / f"{name}.png", pictures[name])
        write_table_1(table_1(calibration), fresh / paths.table.name)
        if report:
            _write_fields(calibration, fields, fresh)
            atomic_write_text(fresh / paths.report.name, page)
        atomic_write_bytes(fresh / paths.calibration.name, content)
    return paths


def _write_fields(calibration: WingCalibration, fields: WingFields, folder: Path) -> None:
    state = calibration.result.mean_state()
    vector = fields.model.vector(state.values, state.stiffness_loss, load_factor=LOAD_FACTOR)
    write_wing_vtu(folder / WING_FIELDS, fields, vector)
    write_modes_vtu(folder / MODE_FIELDS, fields, vector)
