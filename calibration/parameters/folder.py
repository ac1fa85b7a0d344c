"""The folder that a calibration of parameters leaves."""

from pathlib import Path

from calibration.parameters.report import FIGURE_NAMES, render_page, report_figures
from calibration.parameters.result import ParameterCalibration
from calibration.parameters.result_file import result_bytes
from calibration.samples.file import FILE_NAME
from calibration.samples.folder import FIGURES, drawing_names, replaced_at_once
from reporting.figures import to_png, to_svg
from reporting.files import atomic_write_bytes, atomic_write_text
from reporting.progress import Progress

REPORT_NAME = "report.html"


def write_parameters_folder(
    result: ParameterCalibration, folder: Path, progress: Progress, *, report: bool = True
) -> Path:
    """Write page, figures and last `calibration.nc`, all at once; return the path of the latter.

    Page and figures of an older calibration are removed where none are written.

    Raises
    ------
    FileNotWrittenError
        If a file cannot be written; the folder is then as it was.
    """
    content = result_bytes(result)
    with replaced_at_once(folder, [REPORT_NAME, *drawing_names(FIGURE_NAMES)]) as fresh:
        if report:
            with progress.stage("Drawing the report"):
                figures = report_figures(result)
                drawings = {name: to_svg(figure) for name, figure in figures.items()}
                for name, figure in figures.items():
                    atomic_write_bytes(fresh / FIGURES / f"{name}.svg", drawings[name])
                    atomic_write_bytes(fresh / FIGURES / f"{name}.png", to_png(figure))
                atomic_write_text(fresh / REPORT_NAME, render_page(result, drawings))
        atomic_write_bytes(fresh / FILE_NAME, content)
    return folder / FILE_NAME
