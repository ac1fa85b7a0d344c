"""The folder that a calibration leaves."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from calibration.errors import CalibrationRecordError
from fe.reduction.fields import WingFields, write_modes_vtu, write_wing_vtu
from fe.reduction.model_cache import wing_fields
from reporting.errors import FileNotWrittenError
from reporting.figures import to_png, to_svg
from reporting.files import atomic_write_bytes, atomic_write_text, write_error
from reporting.progress import Progress

from .report import render_page, report_figures
from .result_file import FILE_NAME, load_calibration, result_bytes
from .table_1 import table_1, write_table_1
from .three_steps import WingCalibration

LOAD_FACTOR = 3.0
"""Of the turn in which `wing.vtu` shows the wing."""


class CalibrationFiles(NamedTuple):
    """What `write_calibration_folder` leaves."""

    calibration: Path
    report: Path
    table: Path


def calibration_files(folder: Path) -> CalibrationFiles:
    """Return the paths in the folder of a calibration."""
    return CalibrationFiles(folder / FILE_NAME, folder / "report.html", folder / "table_1.csv")


def check_folder(folder: Path, asset: str | None = None) -> None:
    """Look at the place before the work begins.

    Raises
    ------
    FileNotWrittenError
        If it is no folder, or holds the calibration of another wing.
    """
    if folder.exists() and not folder.is_dir():
        raise FileNotWrittenError(f"{folder} exists and is no folder: choose another --out.")
    kept = folder / FILE_NAME
    if not kept.exists():
        return
    try:
        found = load_calibration(kept).asset
    except CalibrationRecordError:
        return  # what cannot be read is of no use to anyone
    if asset is not None and found != asset:
        raise FileNotWrittenError(
            f"{kept} is the calibration of {found}, not of {asset}: choose another --out, one for each wing."
        )


def write_calibration_folder(
    calibration: WingCalibration, folder: Path, progress: Progress, *, report: bool = True
) -> CalibrationFiles:
    """Write page, figures, table, the wing for ParaView, and last `calibration.nc`.

    Without a report, table and `calibration.nc` alone.

    Everything is written beside the folder first and moved into place when it is complete: a full disk leaves
    the folder as it was. An older file of the same name is replaced.

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
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as scratch:
            fresh = Path(scratch)
            for name in drawings:
                atomic_write_bytes(fresh / "figures" / f"{name}.svg", drawings[name])
                atomic_write_bytes(fresh / "figures" / f"{name}.png", pictures[name])
            write_table_1(table_1(calibration), fresh / paths.table.name)
            if report:
                _write_fields(calibration, fields, fresh)
                atomic_write_text(fresh / paths.report.name, page)
            atomic_write_bytes(fresh / paths.calibration.name, content)
            _move(fresh, folder, last=paths.calibration.name)
    except OSError as error:
        raise write_error(error, folder) from error
    return paths


def _move(fresh: Path, folder: Path, last: str) -> None:
    """Move all files into the folder, the calibration itself at the end."""
    files = sorted(path.relative_to(fresh) for path in fresh.rglob("*") if path.is_file())
    for name in sorted(files, key=lambda name: (name.name == last, name)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (fresh / name).replace(folder / name)


def _write_fields(calibration: WingCalibration, fields: WingFields, folder: Path) -> None:
    state = calibration.result.mean_state()
    write_wing_vtu(
        folder / "wing.vtu",
        fields,
        young_modulus_factor=state.young_modulus_factor,
        stiffness_loss=state.stiffness_loss,
        load_factor=LOAD_FACTOR,
    )
    write_modes_vtu(
        folder / "modes.vtu",
        fields,
        young_modulus_factor=state.young_modulus_factor,
        stiffness_loss=state.stiffness_loss,
        servo_mass=state.servo_mass,
        pitot_mass=state.pitot_mass,
    )
