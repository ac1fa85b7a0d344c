"""Table 1 of the paper, the digital state, with our results."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.studies.paper.particle_filter import Moments
from calibration.result.record import Calibration
from reporting.files import atomic_write_text
from reporting.formats.table_file import table_text
from reporting.pages.page_words import Words
from reporting.pages.table import RecordColumn, Table, number_cells, table_of_records, text_cells

WORDS = Words("benchmarks.studies.paper")


@dataclass(frozen=True)
class PublishedQuantity:
    """The authors' value of a quantity, and how it is printed.

    Attributes
    ----------
    scale : float
        The factor from SI to `unit`.
    unit : str
        The printed unit.
    digits : int
        The number of printed decimals.
    mean : float
        The posterior mean [SI].
    source : str
        Where the value is published.
    standard_deviation : float or None
        The posterior standard deviation, if it is published [SI].
    """

    title: str
    scale: float
    unit: str
    digits: int
    mean: float
    source: str
    standard_deviation: float | None = None

    @property
    def title_with_unit(self) -> str:
        """The title, and the printed unit if there is one."""
        return f"{self.title}, {self.unit}" if self.unit else self.title

    def printed(self, mean: float, deviation: float | None = None, *, sign: str = "") -> str:
        """Format a value [SI] and its standard deviation in the printed unit, without the unit.

        `sign` may be "+", to print the sign of a positive value, too.
        """
        text = f"{mean * self.scale:{sign}.{self.digits}f}"
        if deviation is not None:
            text += f" ± {deviation * self.scale:.{self.digits}f}"
        return text.replace("-", "−")


PAPER = {name: PublishedQuantity(**entry) for name, entry in WORDS.content["paper"].items()}
"""The quantities of Table 1 by name."""


@dataclass(frozen=True)
class TableRow:
    """One quantity of Table 1.

    Attributes
    ----------
    prior, posterior : Moments
        The prior, and the posterior of the calibration.
    paper_procedure : Moments
        The result of the paper's procedure: for e the particle filter on the paper's stiffness
        line, for masses and damping eqs. (19), (20) and (25) on our model.
    paper : PublishedQuantity
        The authors' value.
    """

    name: str
    prior: Moments
    posterior: Moments
    paper_procedure: Moments
    paper: PublishedQuantity

    @property
    def difference(self) -> float:
        """The posterior mean minus the authors' [SI]."""
        return self.posterior.mean - self.paper.mean

    @property
    def paper_procedure_difference(self) -> float:
        """The mean by the paper's procedure minus the authors' [SI]."""
        return self.paper_procedure.mean - self.paper.mean


def _printed_moments(row: TableRow, moments: Moments) -> str:
    """Format the mean and standard deviation of a quantity."""
    return row.paper.printed(moments.mean, moments.standard_deviation)


def printed_table_1(rows: Sequence[TableRow]) -> Table:
    """Return Table 1 of the paper with the values of this calibration added."""
    columns: list[RecordColumn[TableRow]] = [
        text_cells(
            "figure", lambda row: ", ".join(filter(None, (row.paper.title, row.paper.unit)))
        ),
        number_cells("prior", lambda row: _printed_moments(row, row.prior)),
        number_cells("this wing", lambda row: _printed_moments(row, row.posterior)),
        number_cells(
            "the paper's procedure", lambda row: _printed_moments(row, row.paper_procedure)
        ),
        number_cells(
            "in the paper",
            lambda row: row.paper.printed(row.paper.mean, row.paper.standard_deviation),
        ),
        number_cells("difference", lambda row: row.paper.printed(row.difference, sign="+")),
    ]
    return table_of_records(columns, rows, **WORDS.words("tables", "table_1"))


def table_1(result: Calibration, paper_procedure: Mapping[str, Moments]) -> tuple[TableRow, ...]:
    """Return the rows of Table 1 of the paper: each parameter before and after the calibration.

    `paper_procedure` has the result of the paper's procedure for each parameter.
    """
    priors = {prior.name: prior for prior in result.priors}
    rows = []
    for name, paper in PAPER.items():
        if name.startswith("damping"):
            # The prior is a Gaussian that is cut off at its mean, so its moments are others.
            prior_mean, prior_deviation = result.prior_moments(name)
            prior = Moments(prior_mean, prior_deviation)
        else:
            prior = Moments(priors[name].mean, priors[name].deviation)
        posterior = Moments(result.mean(name), result.standard_deviation(name))
        rows.append(TableRow(name, prior, posterior, paper_procedure[name], paper))
    return tuple(rows)


def write_table_1(rows: tuple[TableRow, ...], path: Path) -> Path:
    """Write the table as CSV in SI units; return the path.

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    numbers: dict[str, list[float | None]] = {
        "prior_mean": [row.prior.mean for row in rows],
        "prior_standard_deviation": [row.prior.standard_deviation for row in rows],
        "mean": [row.posterior.mean for row in rows],
        "standard_deviation": [row.posterior.standard_deviation for row in rows],
        "paper_procedure_mean": [row.paper_procedure.mean for row in rows],
        "paper_procedure_standard_deviation": [
            row.paper_procedure.standard_deviation for row in rows
        ],
        "paper_mean": [row.paper.mean for row in rows],
        "paper_standard_deviation": [row.paper.standard_deviation for row in rows],
        "difference": [row.difference for row in rows],
        "paper_procedure_difference": [row.paper_procedure_difference for row in rows],
    }
    columns = {"figure": [row.name for row in rows]}
    for name, values in numbers.items():
        columns[name] = ["" if value is None else f"{value:.10g}" for value in values]
    columns["source_of_the_papers"] = [row.paper.source for row in rows]
    return atomic_write_text(path, table_text(columns))
