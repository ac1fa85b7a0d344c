"""Write a calibration with its page to a folder, as a whole or not at all."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from calibration.result.figures import (
    corner_figure,
    marginal_figure,
    readings_figure,
    unmeasured_parameters,
)
from calibration.result.file import FILE_NAME, result_bytes
from calibration.result.record import Calibration
from calibration.result.tables import (
    channels_table,
    origin_table,
    parameters_table,
    readings_table,
    sensors_table,
)
from calibration.result.text import NOTICEABLE_CORRELATION, correlation_lines, outcome_sentences
from reporting.files import atomic_write_bytes, atomic_write_text, explained_write_errors
from reporting.pages.figures import save_figure
from reporting.pages.page import (
    Fold,
    Highlights,
    Notice,
    Page,
    ReportFigure,
    Section,
    render_page,
)
from reporting.progress import stage

FIGURES = "figures"
REPORT_NAME = "report.html"
WING_FIELDS = "wing.vtu"
MODE_FIELDS = "modes.vtu"

MOST_SHOWN_VALUES = 5
"""Most parameters whose values stand on the first screen of the page, in one row."""
_DRAWN = (REPORT_NAME, WING_FIELDS, MODE_FIELDS, f"{FIGURES}/*.svg", f"{FIGURES}/*.png")
"""Files that show a calibration; those of an older one must not stay beside a newer
`calibration.nc`."""


@contextmanager
def calibration_folder(result: Calibration, folder: Path) -> Iterator[Path]:
    """Return a context in which the files of a calibration are written, all or none of them.

    The context yields an empty temporary folder, into which the caller writes the report and the
    other files. At the end of the context they are moved to `folder`, followed by `calibration.nc`,
    which this function writes. Older files of the same names are replaced, and other drawings of an
    older calibration are removed.

    Raises
    ------
    FileNotWrittenError
        If a file cannot be written, such as on a full disk; `folder` is then unchanged.
    """
    content = result_bytes(result)
    with explained_write_errors(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as scratch:
            new_folder = Path(scratch)
            yield new_folder
            new_files = sorted(
                path.relative_to(new_folder) for path in new_folder.rglob("*") if path.is_file()
            )
            atomic_write_bytes(new_folder / FILE_NAME, content)
            if (folder / FILE_NAME).exists():
                _remove_older_drawings(folder, new_files)
            for file in (*new_files, Path(FILE_NAME)):
                (folder / file).parent.mkdir(parents=True, exist_ok=True)
                (new_folder / file).replace(folder / file)


def _remove_older_drawings(folder: Path, new_files: Sequence[Path]) -> None:
    """Remove drawings of an older calibration, except those that new files replace.

    The paths of the new files are relative to the folder.
    """
    for pattern in _DRAWN:
        for drawing in list(folder.glob(pattern)):
            if drawing.relative_to(folder) not in new_files:
                drawing.unlink()
    with suppress(OSError):  # the folder is missing or not empty
        (folder / FIGURES).rmdir()


def write_calibration_folder(result: Calibration, folder: Path, *, report: bool = True) -> Path:
    """Write a calibration to a folder, with a report if wanted; return its `calibration.nc`.

    Raises
    ------
    FileNotWrittenError
        If a file cannot be written; the folder is then unchanged.
    """
    with calibration_folder(result, folder) as new_folder:
        if report:
            with stage("Drawing the report"):
                write_page(result, new_folder)
    return folder / FILE_NAME


def write_page(result: Calibration, folder: Path, further_sections: Sequence[Section] = ()) -> None:
    """Write the page of a calibration, and the files of its figures.

    `further_sections` stand after the parameters and the residuals.
    """
    hashes = result.provenance["input_hashes"].items()
    inputs = ", ".join(f"{name} {value[:12]}" for name, value in hashes)
    values = []
    for prior in result.priors[:MOST_SHOWN_VALUES]:
        value = prior.quantity.printed(
            result.mean(prior.name), result.standard_deviation(prior.name)
        )
        values.append((value, prior.quantity.title))
    parameter_columns, titles = unmeasured_parameters(result)
    posterior_set = ("posterior", result.samples[:, parameter_columns])
    prior_set = ("prior", result.prior_samples[:, parameter_columns])
    posterior = ReportFigure(
        "posterior",
        corner_figure(titles, [posterior_set]),
        title="Posterior",
        caption=(
            "Samples of the posterior; upper right: correlations. Numbers over "
            f"{NOTICEABLE_CORRELATION:g} are blue."
        ),
    )
    prior_and_posterior = ReportFigure(
        "prior_and_posterior",
        marginal_figure(titles, [posterior_set, prior_set]),
        title="Prior and posterior",
        caption=(
            "Samples of each parameter before and after the calibration. Each histogram has a "
            "scale of its own."
        ),
    )
    parameters = Section(
        "Parameters",
        [
            parameters_table(result),
            *(f"{line}." for line in correlation_lines(result)),
            save_figure(posterior, folder / FIGURES),
        ],
    )
    page = Page(
        title=f"Calibration of {result.asset}",
        subtitle=f"Parameters of {result.model} from {result.source}",
        sentence=outcome_sentences(result),
        picture=save_figure(prior_and_posterior, folder / FIGURES),
        outcome=[Highlights(values), *(Notice(finding) for finding in result.findings)],
        sections=[
            parameters,
            _residual_section(result, folder),
            *further_sections,
            Section("Where the calibration comes from", [Fold("Origin", [origin_table(result)])]),
        ],
        footer=(f"Seed {result.seed}. Inputs: {inputs}{'.' if inputs else ''}",),
    )
    atomic_write_text(folder / REPORT_NAME, render_page(page))


def _residual_section(result: Calibration, folder: Path) -> Section:
    """Return the section on residuals, with the fitted gains and zeros; write its figure."""
    readings = None
    if result.readings:
        figure = ReportFigure(
            "readings",
            readings_figure(result),
            title="Readings",
            caption=(
                "The model before and after the calibration, and the measured values with 95 % "
                "intervals. Each panel has a vertical scale of its own."
            ),
        )
        readings = save_figure(figure, folder / FIGURES)
    return Section(
        "Residuals of the readings",
        [readings, readings_table(result), channels_table(result), sensors_table(result)],
    )
