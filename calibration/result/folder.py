"""The folder that a calibration leaves: complete, or as it was before."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from matplotlib.figure import Figure

from calibration.result.file import FILE_NAME, result_bytes
from calibration.result.page import FIGURE_NAMES, begun_page, ended_page, report_figures
from calibration.result.record import Calibration
from reporting.figures import to_png, to_svg
from reporting.files import atomic_write_bytes, atomic_write_text, write_error
from reporting.page import Page
from reporting.progress import Progress

FIGURES, REPORT_NAME = "figures", "report.html"

Extra = Callable[[Page, Mapping[str, bytes]], None]
"""Adds sections to a page, from all figures as SVG."""


def _nothing(page: Page, drawings: Mapping[str, bytes]) -> None:
    pass


def write_calibration_folder(
    result: Calibration,
    folder: Path,
    progress: Progress,
    *,
    report: bool = True,
    figures: Callable[[], Mapping[str, Figure]] = dict,
    extra: Extra = _nothing,
    companions: Iterable[str] = (),
    write_others: Callable[[Path], None] = lambda folder: None,
) -> Path:
    """Write page, figures and last `calibration.nc`, all at once; return the path of the latter.

    Everything is written beside the folder first and moved into place when it is complete: a full disk leaves
    the folder as it was. An older file of the same name is replaced; page and figures of an older calibration
    are removed where none are written, lest a page shows other figures than the file beside it.

    Parameters
    ----------
    result : Calibration
        The calibration.
    folder : Path
        Where the files go.
    progress : Progress
        Where drawing is reported.
    report : bool
        Whether page and figures are written.
    figures : callable
        Draws further figures of the page, by the name of their files.
    extra : callable
        Adds further sections to the page.
    companions : iterable of str
        Further files that may stand beside the calibration.
    write_others : callable
        Writes further files into a folder.

    Raises
    ------
    FileNotWrittenError
        If a file cannot be written; the folder is then as it was.
    """
    content = result_bytes(result)
    drawn: dict[str, Figure] = {}
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as scratch:
            fresh = Path(scratch)
            if report:
                with progress.stage("Drawing the report"):
                    drawn = report_figures(result) | dict(figures())
                    drawings = {name: to_svg(figure) for name, figure in drawn.items()}
                    for name, figure in drawn.items():
                        atomic_write_bytes(fresh / FIGURES / f"{name}.svg", drawings[name])
                        atomic_write_bytes(fresh / FIGURES / f"{name}.png", to_png(figure))
                    page = begun_page(result, drawings)
                    extra(page, drawings)
                    atomic_write_text(fresh / REPORT_NAME, ended_page(page, result))
            write_others(fresh)
            atomic_write_bytes(fresh / FILE_NAME, content)
            _replace(folder, fresh, {REPORT_NAME, *drawing_names(FIGURE_NAMES), *companions})
    except OSError as error:
        raise write_error(error, folder) from error
    return folder / FILE_NAME


def drawing_names(names: Iterable[str]) -> list[str]:
    """Return the files of figures in the folder of a calibration."""
    return [f"{FIGURES}/{name}.{kind}" for name in names for kind in ("svg", "png")]


def _replace(folder: Path, fresh: Path, companions: set[str]) -> None:
    """Move all files to a folder, the calibration last; of an older one no companion stays."""
    files = sorted(path.relative_to(fresh).as_posix() for path in fresh.rglob("*") if path.is_file())
    if (folder / FILE_NAME).exists():
        for name in companions - set(files):
            (folder / name).unlink(missing_ok=True)
        figures = folder / FIGURES
        if figures.is_dir() and not any(figures.iterdir()):
            figures.rmdir()
    for name in sorted(files, key=lambda name: (name == FILE_NAME, name)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (fresh / name).replace(folder / name)
