"""Table 1 of the paper with our figures beside it: prior and posterior of the whole digital state."""

from dataclasses import dataclass
from pathlib import Path

from calibration.paper.load_test import ParticlePosterior
from calibration.result.record import Calibration
from reporting.files import atomic_write_text
from reporting.page import Words
from reporting.table_file import table_text

WORDS = Words("calibration.paper", "table_1.toml")

_CSV_COLUMNS = (
    "figure", "prior_mean", "prior_standard_deviation", "mean", "standard_deviation",
    "paper_procedure_mean", "paper_procedure_standard_deviation", "paper_mean", "paper_standard_deviation",
    "difference", "paper_procedure_difference", "source_of_the_papers",
)  # fmt: skip


@dataclass(frozen=True)
class PaperFigure:
    """How a figure is printed, and what the authors found on their wing.

    Title, factor from SI, unit and digits behind the point; posterior mean, standard deviation where it is
    given [SI], and the source.
    """

    title: str
    scale: float
    unit: str
    digits: int
    mean: float
    source: str
    standard_deviation: float | None = None

    def printed(self, mean: float, deviation: float | None = None, *, sign: str = "") -> str:
        """Return a figure as printed, without its unit."""
        text = f"{mean * self.scale:{sign}.{self.digits}f}"
        if deviation is not None:
            text += f" ± {deviation * self.scale:.{self.digits}f}"
        return text.replace("-", "−")


PAPER = {name: PaperFigure(**told) for name, told in WORDS.content["paper"].items()}


@dataclass(frozen=True)
class TableRow:
    """One figure of Table 1, SI.

    Attributes
    ----------
    name : str
        Figure.
    prior, found : (float, float)
        Mean and standard deviation before, and in the samples that are kept.
    paper_way : (float, float)
        The same by the paper's own procedure: the particle filter on its stiffness line for e, its eqs.
        (19), (20) and (25) on our model for masses and damping.
    paper : PaperFigure
        What the authors found.
    """

    name: str
    prior: tuple[float, float]
    found: tuple[float, float]
    paper_way: tuple[float, float]
    paper: PaperFigure

    @property
    def differences(self) -> tuple[float, float]:
        """The means of the kept samples and by the paper's own procedure, less the paper's."""
        return self.found[0] - self.paper.mean, self.paper_way[0] - self.paper.mean


def table_1(result: Calibration, procedure: Calibration, particle: ParticlePosterior) -> tuple[TableRow, ...]:
    """Return the rows of Table 1.

    Parameters
    ----------
    result, procedure : Calibration
        What is kept, and what the paper's procedure finds on our model.
    particle : ParticlePosterior
        e by the paper's particle filter on its own stiffness line.
    """
    stated = {prior.name: (prior.mean, prior.deviation) for prior in result.priors}
    rows = []
    for name, paper in PAPER.items():
        way = procedure.mean(name), procedure.standard_deviation(name)
        if name == "young_modulus_factor":
            way = particle.mean, particle.standard_deviation
        half = name.startswith("damping")  # a normal distribution cut off at its mean
        prior = result.prior_moments(name) if half else stated[name]
        rows.append(TableRow(name, prior, (result.mean(name), result.standard_deviation(name)), way, paper))
    return tuple(rows)


def write_table_1(rows: tuple[TableRow, ...], path: Path) -> Path:
    """Write the table as CSV, in SI.

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    lines = []
    for row in rows:
        found = row.paper.mean, row.paper.standard_deviation
        values = (*row.prior, *row.found, *row.paper_way, *found, *row.differences)
        numbers = ["" if value is None else f"{value:.10g}" for value in values]
        lines.append((row.name, *numbers, row.paper.source))
    return atomic_write_text(path, table_text(dict(zip(_CSV_COLUMNS, zip(*lines, strict=True), strict=True))))
