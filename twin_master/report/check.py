"""The posterior predictive check: whether the observations look as the twin expects them to look."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.special import ndtr
from scipy.stats import binom

from reporting import figures as style
from reporting.arrays import Float
from twin_master.report.reading import Run
from twin_master.report.view import NORMAL_95

_PIT_BINS = 10
_MOST_CELLS = 6000  # as vectors; more would make the page too large


@dataclass(frozen=True)
class PredictiveCheck:
    """Observations against the posterior predictive distribution of the same turn.

    Attributes
    ----------
    residual : (T, G)
        (observation - expected) / standard deviation of noise and expectation; NaN where lost.
    coverage : (G,)
        Share of the observations of each sensor within their 95 % interval; NaN without observations.
    count : (G,)
        Number of observations of each sensor.
    transform : (n,)
        Probability integral transform of all observations; uniform if the twin is right.
    overall_coverage, standard_deviation : float
        Share of all observations within their intervals, and the root mean square of the residuals, 1 if the
        assumed noise is the real one; NaN without observations.
    """

    residual: Float
    coverage: Float
    count: NDArray[np.integer[Any]]
    transform: Float
    overall_coverage: float
    standard_deviation: float


def predictive_check(run: Run) -> PredictiveCheck:
    """Compare observations with their posterior predictive distribution."""
    section, expected = run.scenario.observation, run["filtered/quantity_mean"]
    total, learnt = run["filtered/quantity_standard_deviation"], run.get("filtered/noise_standard_deviation")
    if learnt is None:
        noise = np.asarray(section.standard_deviation)
        total = np.hypot(np.hypot(total, noise), np.asarray(section.model_error) * expected)
    else:
        total = np.hypot(total, learnt)  # which has the error of the model
    residual = (run.observed - expected) / total
    known = np.isfinite(residual)
    count, seen = known.sum(axis=0), residual[known]
    with np.errstate(invalid="ignore"):
        coverage = (np.abs(residual) <= NORMAL_95).sum(axis=0) / count
        overall = np.divide((np.abs(seen) <= NORMAL_95).sum(), seen.size)
        deviation = np.sqrt(np.divide((seen**2).sum(), seen.size))
    return PredictiveCheck(residual, coverage, count, ndtr(seen), float(overall), float(deviation))


@style.publication_style()
def check_figure(run: Run, check: PredictiveCheck) -> Figure:
    """Draw the residuals of every sensor and turn, the coverage of each sensor, and the transform of all."""
    figure = style.new_figure(4.9)
    grid = figure.add_gridspec(
        2, 2, left=0.075, right=0.955, top=0.945, bottom=0.09, hspace=0.42, wspace=0.2,
        height_ratios=(1.25, 1.0), width_ratios=(1.6, 1.0),
    )  # fmt: skip
    _residual_panel(figure, figure.add_subplot(grid[0, :]), run, check)
    _coverage_panel(figure.add_subplot(grid[1, 0]), run, check)
    _transform_panel(figure.add_subplot(grid[1, 1]), check)
    return figure


def _residual_panel(figure: Figure, axes: Axes, run: Run, check: PredictiveCheck) -> None:
    axes.set_facecolor("#c8c8c8")
    count = len(run.sensors.titles)
    image = axes.pcolormesh(
        np.arange(run.steps + 1) - 0.5, np.arange(count + 1) + 0.5, np.ma.masked_invalid(check.residual.T),
        cmap="PuOr_r", vmin=-4.0, vmax=4.0, rasterized=check.residual.size > _MOST_CELLS,
    )  # fmt: skip
    axes.set_xlabel(run.step)
    axes.set_ylabel(run.sensors.word)
    axes.xaxis.set_major_locator(MaxNLocator(10, integer=True))
    axes.set_yticks(np.arange(1, count + 1, 4 if count > 8 else 1))
    style.panel_label(axes, "a", "Standardised residuals")
    style.color_bar(figure, image, "standard deviations", ax=axes, pad=0.015, fraction=0.03, extend="both")


def _coverage_panel(axes: Axes, run: Run, check: PredictiveCheck) -> None:
    number = np.arange(1, len(check.count) + 1)
    typical = int(np.median(check.count[check.count > 0])) if check.count.any() else 1
    low, high = binom.ppf([0.025, 0.975], typical, 0.95) / typical
    _expected(axes, 100.0 * low, 100.0 * high, 95.0)
    axes.plot(
        number, 100.0 * check.coverage, linestyle="none", marker="o", color=style.PAST, label="coverage"
    )
    axes.set_xlabel(run.sensors.word)
    axes.set_ylabel("within 95 % interval (%)")
    axes.set_ylim(max(-4.0, 100.0 * min(np.nanmin(check.coverage, initial=1.0), low) - 6.0), 104.0)
    axes.set_xlim(0.2, len(number) + 0.8)
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    axes.grid(axis="y")
    style.panel_label(axes, "b", f"Coverage of each {run.sensors.word}")


def _transform_panel(axes: Axes, check: PredictiveCheck) -> None:
    total = max(len(check.transform), 1)
    count, edges = np.histogram(check.transform, bins=_PIT_BINS, range=(0.0, 1.0))
    low, high = binom.ppf([0.025, 0.975], total, 1 / _PIT_BINS) * _PIT_BINS / total
    _expected(axes, low, high, 1.0)
    axes.bar(
        edges[:-1], count * _PIT_BINS / total, width=0.92 / _PIT_BINS, align="edge", color=style.PAST,
        alpha=0.75, linewidth=0,
    )  # fmt: skip
    axes.set_xlim(0.0, 1.0)
    axes.set_xlabel("probability integral transform")
    axes.set_ylabel("density")
    style.panel_label(axes, "c", "All observations")


def _expected(axes: Axes, low: float, high: float, middle: float) -> None:
    """Draw where figures lie if the twin is right."""
    axes.axhspan(low, high, color=style.REFERENCE, alpha=0.25, linewidth=0)
    axes.axhline(middle, color=style.TRUTH, linewidth=0.9, linestyle=(0, (4, 2)))
