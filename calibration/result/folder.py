"""The folder that a calibration leaves, with its page: complete, or as it was before."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from calibration.result.figures import corner_figure, drawn_parameters, readings_figure
from calibration.result.file import FILE_NAME, result_bytes
from calibration.result.record import Calibration
from calibration.result.text import (
    PROCEDURES,
    WORDS,
    correlation_lines,
)
from reporting.figures import save_figure
from reporting.files import atomic_write_bytes, atomic_write_text, explained_write_errors
from reporting.page import Page, ReportFigure
from reporting.progress import stage

FIGURES, REPORT_NAME = "figures", "report.html"
WING_FIELDS, MODE_FIELDS = "wing.vtu", "modes.vtu"

_DRAWN = (REPORT_NAME, WING_FIELDS, MODE_FIELDS, f"{FIGURES}/*.svg", f"{FIGURES}/*.png")
"""What an older calibration drew: beside a newer file it would show other figures."""


@contextmanager
def calibration_folder(result: Calibration, folder: Path) -> Iterator[Path]:
    """Yield an empty folder; at the end all in it and `calibration.nc` are moved to `folder`.

    A full disk leaves `folder` as it was. Older files of the same names are replaced, the calibration last;
    what an older calibration drew is removed where nothing stands for it.

    Raises
    ------
    FileNotWrittenError
        If a file cannot be written; the folder is then as it was.
    """
    content = result_bytes(result)
    with explained_write_errors(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as scratch:
            fresh = Path(scratch)
            yield fresh
            files = sorted(path.relative_to(fresh) for path in fresh.rglob("*") if path.is_file())
            atomic_write_bytes(fresh / FILE_NAME, content)
            if (folder / FILE_NAME).exists():
                for older in [path for pattern in _DRAWN for path in folder.glob(pattern)]:
                    if older.relative_to(folder) not in files:
                        older.unlink()
                with suppress(OSError):  # not there, or not empty
                    (folder / FIGURES).rmdir()
            for file in (*files, Path(FILE_NAME)):
                (folder / file).parent.mkdir(parents=True, exist_ok=True)
                (fresh / file).replace(folder / file)


def write_calibration_folder(result: Calibration, folder: Path, *, report: bool = True) -> Path:
    """Write page, figures and `calibration.nc`, or without a report the latter alone; return its path.

    Raises
    ------
    FileNotWrittenError
        As `calibration_folder`.
    """
    with calibration_folder(result, folder) as fresh:
        if report:
            with stage("Drawing the report"):
                end_page(begun_page(result, fresh), result, fresh)
    return folder / FILE_NAME


def add_figure(page: Page, figure: ReportFigure, folder: Path) -> None:
    """Add a figure to a page, and leave it in the folder of the page."""
    drawing = save_figure(figure.figure, folder / FIGURES, figure.name)
    page.add_figure(drawing, figure.caption, title=figure.title)


def begun_page(result: Calibration, folder: Path) -> Page:
    """Return a page with all that any calibration says; its figures are left in a folder."""
    title, subtitle, footer = (WORDS.say(name, result=result) for name in ("title", "subtitle", "footer"))
    page = Page(title, subtitle, (footer,))
    page.add_section("Result")
    highlights = []
    for prior in result.priors[:6]:
        value = prior.figure.shown(result.mean(prior.name), result.standard_deviation(prior.name))
        highlights.append((value, prior.figure.title))
    page.add_highlights(highlights)
    for sentence in result.findings:
        page.add_notice(sentence)
    if not result.findings:
        page.add_paragraph(WORDS.say("agreed"))
    procedure = PROCEDURES[result.procedure]
    WORDS.add_table(page, "parameters", result.priors, result=result, procedure=procedure)
    for line in correlation_lines(result):
        page.add_paragraph(f"{line}.")
    places, titles = drawn_parameters(result)
    sets = [("posterior", result.samples[:, places]), ("prior", result.prior_samples[:, places])]
    for name, shown in (("posterior", sets[:1]), ("prior_and_posterior", sets)):
        add_figure(page, WORDS.figure(name, corner_figure(titles, shown)), folder)
    page.add_section("What is left of the readings")
    WORDS.add_table(page, "readings", result.readings, result=result)
    if result.readings:
        add_figure(page, WORDS.figure("readings", readings_figure(result)), folder)
    WORDS.add_table(page, "channels", result.channels)
    return page


def end_page(page: Page, result: Calibration, folder: Path) -> None:
    """Write a page with where the calibration comes from at its end."""
    WORDS.add_table(page, "origin", result=result)
    atomic_write_text(folder / REPORT_NAME, page.render())
