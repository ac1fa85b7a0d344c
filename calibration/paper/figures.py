"""Table 1 and Fig. 5 of the paper with our figures: the whole digital state, and calibration step 2."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibration.paper.load_test import ParticlePosterior, StaticCalibration
from calibration.result.record import Calibration
from calibration.static.experiments import HALF_WIDTH_95
from calibration.static.posterior import ScalarPosterior
from reporting import figures as style
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


_MARKERS = ("o", "s", "^", "D", "v", "P")
_RUN_LINES = ("-", "--", "-.", ":")


@style.publication_style()
def calibration_figure(result: StaticCalibration) -> Figure:
    """Draw the three panels of Fig. 5: measurements and bands, densities of e, densities of the stiffness."""
    figure = style.new_figure(height=4.4)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.05, 1.0), wspace=0.22, hspace=0.48)
    figure.subplots_adjust(left=0.062, right=0.985, bottom=0.095, top=0.94)
    _draw_loads(figure.add_subplot(grid[:, 0]), result)
    factor, stiffness = (figure.add_subplot(grid[row, 1]) for row in (0, 1))
    for pair, run in enumerate(np.searchsorted(result.data.run_indices, result.data.run).tolist()):
        factor.plot(
            result.particle.likelihood_grid, result.particle.likelihood[pair], color=style.OBSERVED, lw=0.7,
            ls=_RUN_LINES[run % len(_RUN_LINES)], label="likelihood of one pair" if pair == 0 else None,
        )  # fmt: skip
    _draw_densities(factor, result.before, result.exact, result.particle)
    factor.axvline(
        PAPER["young_modulus_factor"].mean, color=style.REFERENCE, lw=0.7, ls=":", label="mean in the paper"
    )
    factor.set_xlabel("Young's modulus factor $e$", parse_math=True)
    factor.set_ylabel("probability density")
    style.panel_label(factor, "b", "Prior, likelihoods, posterior")
    after = result.tip_stiffness_exact
    _draw_densities(stiffness, result.tip_stiffness_prior, after, result.particle.stiffness, 1e-3)
    stiffness.set_xlabel("tip stiffness $k$ (N/mm)", parse_math=True)
    stiffness.set_ylabel("probability density (mm/N)")
    told = f"{after.mean * 1e-3:.4f} ± {after.standard_deviation * 1e-3:.4f} N/mm"
    stiffness.text(
        0.99, 0.60, told, transform=stiffness.transAxes, color=style.PAST, ha="right", fontsize=6.8
    )
    style.panel_label(stiffness, "c", "Quantity of interest")
    for axes in (factor, stiffness):
        axes.legend(loc="upper left", fontsize=6.8, handlelength=1.6, borderaxespad=0.1, labelspacing=0.35)
    return figure


def _draw_loads(axes: Axes, result: StaticCalibration) -> None:
    data = result.data
    reach = 1.12 * float(data.displacement.max())
    displacement = np.array([0.0, reach])
    for posterior, colour, name, line in (
        (result.tip_stiffness_prior, style.REFERENCE, "prior", {"lw": 1.0, "ls": "--"}),
        (result.tip_stiffness_exact, style.PAST, "posterior", {"lw": 1.2}),
    ):
        lower, upper = (end * displacement for end in posterior.interval(0.95))
        label = f"{name}, 95 % band"
        axes.fill_between(displacement * 1e3, lower, upper, color=colour, alpha=0.35, lw=0.0, label=label)
        axes.plot(displacement * 1e3, posterior.mean * displacement, color=colour, **line)
    for number, index in enumerate(data.run_indices):
        of_run = data.run == index
        axes.errorbar(
            data.displacement[of_run] * 1e3, data.load[of_run],
            xerr=HALF_WIDTH_95 * data.displacement_standard_deviation * 1e3,
            yerr=HALF_WIDTH_95 * data.load_standard_deviation,
            fmt=_MARKERS[number % len(_MARKERS)], color=style.OBSERVED, ms=3.6, mew=0.9, elinewidth=0.8,
            mfc="white" if number % 2 else style.OBSERVED, capsize=1.8, zorder=3 + number,
            label=f"measured, run {index + 1}",
        )  # fmt: skip
    axes.set(xlim=(0.0, reach * 1e3), ylim=(0.0, 1.12 * float(data.load.max())))
    axes.set_xlabel("tip displacement $x$ (mm)", parse_math=True)
    axes.set_ylabel("tip load $f$ (N)", parse_math=True)
    axes.legend(loc="upper left", handlelength=1.5)
    style.panel_label(axes, "a", "Load and displacement")


def _draw_densities(
    axes: Axes, prior: ScalarPosterior, exact: ScalarPosterior, particle: ScalarPosterior, scale: float = 1.0
) -> None:
    """Draw prior, exact posterior with its 95 % interval, and the posterior of particles as a histogram."""
    lower, upper = exact.interval(0.95)
    inside = (exact.grid >= lower) & (exact.grid <= upper)
    axes.fill_between(
        exact.grid[inside] * scale, exact.density[inside] / scale,
        color=style.PAST, alpha=style.BAND_OPACITY, lw=0.0, label="95 % interval",
    )  # fmt: skip
    axes.plot(prior.grid * scale, prior.density / scale, color=style.REFERENCE, lw=1.8, label="prior")
    axes.plot(exact.grid * scale, exact.density / scale, color=style.PAST, lw=1.6, label="posterior, exact")
    edges = particle.mean + particle.standard_deviation * np.linspace(-4.0, 4.0, 33)
    density = np.diff(particle.cumulative(edges)) / np.diff(edges)
    axes.stairs(density / scale, edges * scale, color=style.PRESENT, lw=0.9, label="posterior, particles")
    reach = 3.6 * prior.standard_deviation
    ends = (prior.mean - reach) * scale, (prior.mean + reach) * scale
    axes.set(xlim=ends, ylim=(0.0, 1.12 * float(exact.density.max()) / scale))
