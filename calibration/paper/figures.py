"""Table 1 (the digital state) and Fig. 5 (calibration step 2) of the paper, with our results."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibration.paper.load_test import Moments, ParticlePosterior, StaticCalibration
from calibration.result.record import Calibration
from calibration.static.experiments import HALF_WIDTH_95
from calibration.static.posterior import ScalarPosterior
from reporting.files import atomic_write_text
from reporting.formats.table_file import table_text
from reporting.pages import figures as style
from reporting.pages.page_words import Words
from reporting.pages.table import RecordColumn, Table, number_cells, table_of_records, text_cells

WORDS = Words("calibration.paper", "table_1.toml")


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


def table_1(
    result: Calibration, procedure: Calibration, particle: ParticlePosterior
) -> tuple[TableRow, ...]:
    """Return the rows of Table 1 of the paper: each parameter before and after the calibration.

    Parameters
    ----------
    procedure : Calibration
        The calibration of the same model by the paper's procedure, for comparison.
    particle : ParticlePosterior
        The posterior of the Young's modulus factor by the paper's particle filter.
    """
    priors = {prior.name: prior for prior in result.priors}
    rows = []
    for name, paper in PAPER.items():
        if name == "young_modulus_factor":
            paper_procedure = Moments(particle.mean, particle.standard_deviation)
        else:
            paper_procedure = Moments(procedure.mean(name), procedure.standard_deviation(name))
        if name.startswith("damping"):
            # The prior is a Gaussian that is cut off at its mean, so its moments are others.
            prior_mean, prior_deviation = result.prior_moments(name)
            prior = Moments(prior_mean, prior_deviation)
        else:
            prior = Moments(priors[name].mean, priors[name].deviation)
        posterior = Moments(result.mean(name), result.standard_deviation(name))
        rows.append(TableRow(name, prior, posterior, paper_procedure, paper))
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


_MARKERS = ("o", "s", "^", "D", "v", "P")
_RUN_LINES = ("-", "--", "-.", ":")


@style.publication_style()
def calibration_figure(result: StaticCalibration) -> Figure:
    """Draw Fig. 5 of the paper: the load test, and the densities of e and of the tip stiffness.

    e is the factor on Young's modulus.
    """
    figure = style.new_figure(height=4.4)
    axes = figure.subplot_mosaic(
        [
            ["loads", "factor"],
            ["loads", "stiffness"],
        ],
        width_ratios=(1.05, 1.0),
        gridspec_kw={"wspace": 0.22, "hspace": 0.48},
    )
    figure.subplots_adjust(left=0.062, right=0.985, bottom=0.095, top=0.94)
    _draw_loads(axes["loads"], result)
    _draw_factor(axes["factor"], result)
    _draw_stiffness(axes["stiffness"], result)
    return figure


def _draw_factor(axes: Axes, result: StaticCalibration) -> None:
    """Draw the densities of e: its prior, the likelihood of each measured pair, its posteriors."""
    particle = result.particle
    run_numbers = np.searchsorted(result.data.run_indices, result.data.run).tolist()
    for pair, run in enumerate(run_numbers):
        axes.plot(
            particle.likelihood_grid,
            particle.likelihood[pair],
            color=style.OBSERVED,
            lw=0.7,
            ls=_RUN_LINES[run % len(_RUN_LINES)],
            label="likelihood of one pair" if pair == 0 else None,
        )
    _draw_densities(axes, result.before, result.exact, particle)
    paper_mean = PAPER["young_modulus_factor"].mean
    axes.axvline(paper_mean, color=style.REFERENCE, lw=0.7, ls=":", label="mean in the paper")
    axes.set_xlabel("Young's modulus factor $e$", parse_math=True)
    axes.set_ylabel("probability density")
    style.panel_label(axes, "b", "Prior, likelihoods, posterior")
    _draw_legend_of_densities(axes)


def _draw_stiffness(axes: Axes, result: StaticCalibration) -> None:
    """Draw the densities of the tip stiffness."""
    posterior = result.tip_stiffness_exact
    particle = result.particle.stiffness
    _draw_densities(axes, result.tip_stiffness_prior, posterior, particle, 1e-3)
    axes.set_xlabel("tip stiffness $k$ (N/mm)", parse_math=True)
    axes.set_ylabel("probability density (mm/N)")
    text = f"{posterior.mean * 1e-3:.4f} ± {posterior.standard_deviation * 1e-3:.4f} N/mm"
    axes.text(
        0.99, 0.60, text, transform=axes.transAxes, color=style.PAST, ha="right", fontsize=6.8
    )
    style.panel_label(axes, "c", "Quantity of interest")
    _draw_legend_of_densities(axes)


def _draw_legend_of_densities(axes: Axes) -> None:
    axes.legend(
        loc="upper left", fontsize=6.8, handlelength=1.6, borderaxespad=0.1, labelspacing=0.35
    )


def _draw_loads(axes: Axes, result: StaticCalibration) -> None:
    """Draw measured pairs of load and tip displacement, and the bands before and after them.

    A band is the 95 % interval of the load by the tip stiffness, a priori and a posteriori.
    """
    data = result.data
    largest_displacement = 1.12 * float(data.displacement.max())
    displacement = np.array([0.0, largest_displacement])
    for density, colour, name, line in (
        (result.tip_stiffness_prior, style.REFERENCE, "prior", {"lw": 1.0, "ls": "--"}),
        (result.tip_stiffness_exact, style.PAST, "posterior", {"lw": 1.2}),
    ):
        lower, upper = density.interval(0.95)
        axes.fill_between(
            displacement * 1e3,
            lower * displacement,
            upper * displacement,
            color=colour,
            alpha=0.35,
            lw=0.0,
            label=f"{name}, 95 % band",
        )
        axes.plot(displacement * 1e3, density.mean * displacement, color=colour, **line)
    for number, index in enumerate(data.run_indices):
        is_in_run = data.run == index
        axes.errorbar(
            data.displacement[is_in_run] * 1e3,
            data.load[is_in_run],
            xerr=HALF_WIDTH_95 * data.displacement_standard_deviation * 1e3,
            yerr=HALF_WIDTH_95 * data.load_standard_deviation,
            fmt=_MARKERS[number % len(_MARKERS)],
            color=style.OBSERVED,
            ms=3.6,
            mew=0.9,
            elinewidth=0.8,
            mfc="white" if number % 2 else style.OBSERVED,
            capsize=1.8,
            zorder=3 + number,
            label=f"measured, run {index + 1}",
        )
    axes.set(xlim=(0.0, largest_displacement * 1e3), ylim=(0.0, 1.12 * float(data.load.max())))
    axes.set_xlabel("tip displacement $x$ (mm)", parse_math=True)
    axes.set_ylabel("tip load $f$ (N)", parse_math=True)
    axes.legend(loc="upper left", handlelength=1.5)
    style.panel_label(axes, "a", "Load and displacement")


def _draw_densities(
    axes: Axes,
    prior: ScalarPosterior,
    exact: ScalarPosterior,
    particle: ScalarPosterior,
    scale: float = 1.0,
) -> None:
    """Draw prior, exact posterior with its 95 % interval, and the particles as a histogram.

    `scale` is the factor from SI to the unit of the panel.
    """
    lower, upper = exact.interval(0.95)
    is_inside = (exact.grid >= lower) & (exact.grid <= upper)
    axes.fill_between(
        exact.grid[is_inside] * scale,
        exact.density[is_inside] / scale,
        color=style.PAST,
        alpha=style.BAND_OPACITY,
        lw=0.0,
        label="95 % interval",
    )
    axes.plot(
        prior.grid * scale, prior.density / scale, color=style.REFERENCE, lw=1.8, label="prior"
    )
    axes.plot(
        exact.grid * scale,
        exact.density / scale,
        color=style.PAST,
        lw=1.6,
        label="posterior, exact",
    )
    edges = particle.mean + particle.standard_deviation * np.linspace(-4.0, 4.0, 33)
    histogram = np.diff(particle.cumulative(edges)) / np.diff(edges)
    axes.stairs(
        histogram / scale,
        edges * scale,
        color=style.PRESENT,
        lw=0.9,
        label="posterior, particles",
    )
    half_width = 3.6 * prior.standard_deviation
    left = (prior.mean - half_width) * scale
    right = (prior.mean + half_width) * scale
    axes.set(xlim=(left, right), ylim=(0.0, 1.12 * float(exact.density.max()) / scale))
