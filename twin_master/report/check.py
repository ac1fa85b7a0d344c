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
from twin_master.report.data import NORMAL_95, RunRecord
from twin_master.report.view import sensor_word

Float = NDArray[np.floating[Any]]

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
    """

    residual: Float
    coverage: Float
    count: NDArray[np.integer[Any]]
    transform: Float

    @property
    def overall_coverage(self) -> float:
        """Share of all observations within their 95 % intervals."""
        known = np.isfinite(self.residual)
        return float(np.mean(np.abs(self.residual[known]) <= NORMAL_95)) if known.any() else float("nan")

    @property
    def standard_deviation(self) -> float:
        """Root mean square of the residuals; 1 if the assumed noise is the real one."""
        known = np.isfinite(self.residual)
        return float(np.sqrt(np.mean(self.residual[known] ** 2))) if known.any() else float("nan")


def assumed_noise(record: RunRecord) -> Float | None:
    """Return the sensor noise that the twin assumes, one or (G,); None if the run folder does not tell."""
    section = record.scenario.get("observation")
    value = section.get("standard_deviation") if isinstance(section, dict) else None
    try:
        noise = np.asarray(np.nan if value is None else value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    fits = noise.shape in ((), (len(record.sensors),)) and np.all(np.isfinite(noise) & (noise > 0.0))
    return noise if fits else None


def assumed_model_error(record: RunRecord) -> Float | None:
    """Return the relative model error that the twin assumes, one or (G,); None where it assumes none."""
    section = record.scenario.get("observation")
    value = section.get("model_error") if isinstance(section, dict) else None
    try:
        error = np.asarray(0.0 if value is None else value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    fits = error.shape in ((), (len(record.sensors),)) and np.all(np.isfinite(error))
    return error if fits and np.any(error > 0.0) else None


def predictive_check(record: RunRecord) -> PredictiveCheck | None:
    """Compare observations with their posterior predictive distribution; None if something is missing."""
    learnt, quantity = record.learnt_noise, record.filtered.quantity
    noise = assumed_noise(record) if learnt is None else learnt
    if record.observation is None or quantity is None or noise is None:
        return None
    spread = record.filtered.quantity_standard_deviation
    total = np.hypot(noise, 0.0 if spread is None else spread)
    error = assumed_model_error(record)
    if error is not None and learnt is None:  # which has it
        total = np.hypot(total, error * quantity.mean)
    residual = (record.observation - quantity.mean) / total
    known = np.isfinite(residual)
    count = known.sum(axis=0)
    inside = (np.abs(np.where(known, residual, np.inf)) <= NORMAL_95).sum(axis=0)
    coverage = np.divide(inside, count, out=np.full(len(count), np.nan), where=count > 0)
    return PredictiveCheck(residual, coverage, count, ndtr(residual[known]))


def check_figure(record: RunRecord, check: PredictiveCheck) -> Figure:
    """Draw the residuals of every sensor and turn, the coverage of each sensor, and the transform of all."""
    with style.publication_style():
        figure = style.new_figure(4.9)
        grid = figure.add_gridspec(
            2, 2, left=0.075, right=0.955, top=0.945, bottom=0.09, hspace=0.42, wspace=0.2,
            height_ratios=(1.25, 1.0), width_ratios=(1.6, 1.0),
        )  # fmt: skip
        _residual_panel(figure, figure.add_subplot(grid[0, :]), record, check)
        _coverage_panel(figure.add_subplot(grid[1, 0]), record, check)
        _transform_panel(figure.add_subplot(grid[1, 1]), check)
    return figure


def _residual_panel(figure: Figure, axes: Axes, record: RunRecord, check: PredictiveCheck) -> None:
    axes.set_facecolor("#c8c8c8")
    image = axes.pcolormesh(
        np.arange(record.step_count + 1) - 0.5, np.arange(len(record.sensors) + 1) + 0.5,
        np.ma.masked_invalid(check.residual.T), cmap="PuOr_r", vmin=-4.0, vmax=4.0,
        rasterized=check.residual.size > _MOST_CELLS,
    )  # fmt: skip
    axes.set_xlabel(record.step_word)
    axes.set_ylabel(sensor_word(record).lower())
    axes.xaxis.set_major_locator(MaxNLocator(10, integer=True))
    axes.set_yticks(np.arange(1, len(record.sensors) + 1, 4 if len(record.sensors) > 8 else 1))
    style.panel_label(axes, "a", "Standardised residuals")
    bar = figure.colorbar(image, ax=axes, pad=0.015, fraction=0.03, extend="both")
    bar.set_label("standard deviations")
    bar.outline.set_linewidth(0.5)


def _coverage_panel(axes: Axes, record: RunRecord, check: PredictiveCheck) -> None:
    number = np.arange(1, len(record.sensors) + 1)
    typical = int(np.median(check.count[check.count > 0])) if (check.count > 0).any() else 1
    low, high = binom.ppf([0.025, 0.975], typical, 0.95) / typical
    axes.axhspan(100 * low, 100 * high, color=style.REFERENCE, alpha=0.25, linewidth=0)
    axes.axhline(95.0, color=style.TRUTH, linewidth=0.9, linestyle=(0, (4, 2)))
    axes.plot(
        number, 100.0 * check.coverage, linestyle="none", marker="o", color=style.PAST, label="coverage"
    )
    axes.set_xlabel(sensor_word(record).lower())
    axes.set_ylabel("within 95 % interval (%)")
    bottom = min(np.nanmin(check.coverage, initial=1.0), low)
    axes.set_ylim(max(-4.0, 100.0 * bottom - 6.0), 104.0)
    axes.set_xlim(0.2, len(number) + 0.8)
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    axes.grid(axis="y")
    style.panel_label(axes, "b", f"Coverage of each {sensor_word(record).lower()}")


def _transform_panel(axes: Axes, check: PredictiveCheck) -> None:
    total = len(check.transform)
    density, edges = np.histogram(check.transform, bins=_PIT_BINS, range=(0.0, 1.0))
    share = density * _PIT_BINS / max(total, 1)
    if total:
        low, high = binom.ppf([0.025, 0.975], total, 1 / _PIT_BINS) * _PIT_BINS / total
        axes.axhspan(low, high, color=style.REFERENCE, alpha=0.25, linewidth=0)
    axes.axhline(1.0, color=style.TRUTH, linewidth=0.9, linestyle=(0, (4, 2)))
    axes.bar(
        edges[:-1], share, width=0.92 / _PIT_BINS, align="edge", color=style.PAST, alpha=0.75, linewidth=0
    )
    axes.set_xlim(0.0, 1.0)
    axes.set_xlabel("probability integral transform")
    axes.set_ylabel("density")
    style.panel_label(axes, "c", "All observations")
