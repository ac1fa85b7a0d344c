"""Table 1 of the paper with our figures beside it: prior and posterior of the whole digital state."""

from dataclasses import dataclass
from pathlib import Path

from calibration.paper.load_test import ParticlePosterior
from calibration.result.record import Calibration
from reporting.files import atomic_write_text
from reporting.table_file import table_text

PAPER_MEAN, PAPER_STANDARD_DEVIATION = 1.0073, 0.0103
"""Posterior of e in the paper (Kapteyn et al. 2021, Table 1)."""

PRINTED = "Kapteyn et al. 2021, Table 1"
SAMPLES = "the authors' published samples (step 3), mean over 100"
EQ_25 = "the authors' published frequencies (step 3) by eq. (25), mean over 100"

_CSV_COLUMNS = (
    "figure", "prior_mean", "prior_standard_deviation", "mean", "standard_deviation",
    "paper_procedure_mean", "paper_procedure_standard_deviation", "paper_mean", "paper_standard_deviation",
    "difference", "paper_procedure_difference", "source_of_the_papers",
)  # fmt: skip
HEADINGS = ("figure", "prior", "this wing", "the paper's procedure", "in the paper", "difference")


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
    standard_deviation: float | None
    source: str

    def printed(self, mean: float, deviation: float | None = None, *, sign: str = "") -> str:
        """Return a figure as printed, without its unit."""
        text = f"{mean * self.scale:{sign}.{self.digits}f}"
        if deviation is not None:
            text += f" ± {deviation * self.scale:.{self.digits}f}"
        return text.replace("-", "−")


PAPER = {
    "semi_span": PaperFigure("semi-span", 1e3, "mm", 2, 1.8280, None, PRINTED),
    "root_chord": PaperFigure("root chord", 1e3, "mm", 2, 0.4330, None, PRINTED),
    "tip_chord": PaperFigure("tip chord", 1e3, "mm", 2, 0.2600, None, PRINTED),
    "young_modulus_factor": PaperFigure(
        "modulus factor e", 1.0, "", 4, PAPER_MEAN, PAPER_STANDARD_DEVIATION, PRINTED
    ),
    "servo_mass": PaperFigure("servo mass", 1e3, "g", 1, 0.1691, 0.0039, SAMPLES),
    "pitot_mass": PaperFigure("pitot mass", 1e3, "g", 1, 0.1337, 0.0077, SAMPLES),
    "damping_alpha": PaperFigure("alpha", 1.0, "1/s", 4, 1.0300, 0.0008, EQ_25),
    "damping_beta": PaperFigure("beta", 1e3, "ms", 4, 7.658e-4, 0.006e-4, EQ_25),
}


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

    @property
    def cells(self) -> tuple[str, ...]:
        """The row as printed, one cell for each of `HEADINGS`."""
        paper = self.paper
        return (
            f"{paper.title}, {paper.unit}" if paper.unit else paper.title,
            *(paper.printed(*pair) for pair in (self.prior, self.found, self.paper_way)),
            paper.printed(paper.mean, paper.standard_deviation),
            paper.printed(self.differences[0], sign="+"),
        )


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
