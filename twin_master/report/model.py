"""The twin's model in the report: what it was tailored with, what was learnt, whether the data agree."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.special import ndtr
from scipy.stats import binom, truncnorm

from reporting import figures as style
from reporting.arrays import Float
from reporting.words import between, parameter_title, rounded
from twin_master.report.mission import step_map
from twin_master.report.reading import NORMAL_95, Run
from twin_master.store.mission_result import LearntQuantity


def true_value(run: Run) -> float | None:
    """Return the value of the parameter that the asset really has; None where nobody knows it."""
    kept, asset, name = run.calibration, run.scenario.asset, run.scenario.calibration.parameter
    known = asset.true_parameters.get(name)
    section = run.config["scenario"]["asset"]
    packed = section.get("design") == "calibration" and not section.get("file")
    if known is None and (packed or ("campaign" in kept and not run.watched)):
        known = kept.get("state", {}).get(name, {}).get("mean")  # at which what is flown starts
    return None if known is None else float(known)


def believed(run: Run) -> tuple[float, float]:
    """Return mean and standard deviation of the parameter as it was calibrated."""
    state = run.calibration.get("state", {}).get(run.scenario.calibration.parameter)
    draws = run["calibration/draw_value"]
    return (
        (state["mean"], state["standard_deviation"]) if state else (float(draws.mean()), float(draws.std()))
    )


def measured(run: Run) -> tuple[Float, Float, Mapping[str, float]] | None:
    """Return measured loads [N] and displacements [m], and the stiffness that they gave; or None."""
    kept = run.calibration
    data = kept.get("data", {})
    stiffness = kept.get("tip_stiffness") or kept.get("quantities", {}).get("tip_stiffness")
    if not stiffness or not data.get("load"):
        return None
    return np.asarray(data["load"], float), np.asarray(data["displacement"], float), stiffness


@style.publication_style()
def calibration_figure(run: Run) -> Figure:
    """Draw the measurements with the stiffness they give, and the distribution of the parameter."""
    found = measured(run)
    figure, (row,) = style.panels(1, 1 if found is None else 2, 2.7, 0.3, 0.43, left=0.088, wspace=0.26)
    if found is not None:
        _pair_panel(row[0], *found)
    _density_panel(row[-1], run, "" if found is None else "b")
    return figure


def _pair_panel(axes: Axes, load: Float, displacement: Float, stiffness: Mapping[str, float]) -> None:
    reach = np.linspace(0.0, 1.08 * float(load.max()), 2)
    mean, deviation = stiffness["mean"], stiffness["standard_deviation"]
    low, high = (1.0e3 * reach / (mean + sign * 2.0 * deviation) for sign in (1.0, -1.0))
    style.band(axes, reach, low, high, style.PRESENT)
    axes.plot(reach, 1.0e3 * reach / mean, color=style.PRESENT, label="calibrated")
    axes.plot(
        load, 1.0e3 * displacement, linestyle="none", marker="o", markersize=3.2, color=style.OBSERVED,
        label="measured",
    )  # fmt: skip
    axes.set(xlim=(0.0, reach[-1]), xlabel="tip load (N)", ylabel="tip displacement (mm)")
    axes.set_ylim(bottom=0.0)
    axes.legend(loc="upper left")
    style.panel_label(axes, "a", "Measurements")


def _density_panel(axes: Axes, run: Run, label: str) -> None:
    draws, kept = run["calibration/draw_value"], run.calibration
    center, spread = float(draws.mean()), float(draws.std())
    reach = 4.5 * spread if spread > 0 else 1e-3 * max(abs(center), 1.0)
    low, high = center - reach, center + 1.5 * reach  # room for the legend
    if spread > 0:
        bins = min(16, max(4, len(draws) // 5))
        axes.hist(
            draws, bins=bins, density=True, color=style.REFERENCE, alpha=0.35, linewidth=0,
            label=f"{len(draws)} draws used",
        )  # fmt: skip
    else:
        axes.axvline(center, color=style.PRESENT, label="value used")
    prior, ends = kept.get("prior", {}), np.array([-np.inf, np.inf])
    if prior.get("standard_deviation"):
        mean, deviation = prior["mean"], prior["standard_deviation"]
        ends = np.array(prior.get("range", ends))
        x = np.linspace(max(low, ends[0]), min(high, ends[1]), 200)
        density = truncnorm.pdf(x, *(ends - mean) / deviation, mean, deviation)
        axes.plot(x, density, color=style.PAST, linewidth=1.2, label="prior")
    if kept.get("posterior"):
        grid, density = (np.asarray(kept["posterior"][name], float) for name in ("grid", "density"))
        inside = (grid >= max(low, ends[0])) & (grid <= min(high, ends[1]))
        axes.plot(grid[inside], density[inside], color=style.PRESENT, label="posterior")
    truth = true_value(run)
    if truth is not None:
        axes.axvline(truth, **style.TRUTH_LINE, label="truth")
    axes.set_ylim(bottom=0.0)
    unit = run.tree["calibration/draw_value"].attrs.get("units", "1")
    title = parameter_title(run.scenario.calibration.parameter) + ("" if unit == "1" else f" ({unit})")
    axes.set(xlim=(low, high), xlabel=title, ylabel="density")
    axes.legend(loc="upper right", handlelength=1.5)
    style.panel_label(axes, label, "The uncertain parameter")


_ROW_HEIGHT = 1.55


@style.publication_style()
def learnt_figure(run: Run) -> Figure:
    """Draw each learnt quantity over the steps with its 90 % band.

    Of quantities of each sensor the one that departs most from its prior has the band, and beside it stand
    the last values of all sensors.
    """
    whole = [learnt for learnt in run.learnt if not learnt.is_per_sensor]
    of_sensors = [learnt for learnt in run.learnt if learnt.is_per_sensor]
    rows = -(-len(whole) // 2) + len(of_sensors)
    labels = iter("abcdefghijklmnopqrstuvwxyz")
    figure, grid = style.panels(
        rows, 2, 0.85 + _ROW_HEIGHT * rows, 0.52, 0.42, left=0.08, hspace=0.62, wspace=0.22
    )
    places = [axes for row in grid for axes in row]
    for axes, learnt in zip(places, whole, strict=False):
        _course(axes, run, learnt.posterior, learnt.prior, learnt.truth)
        style.panel_label(axes, next(labels), learnt.label)
    if len(whole) % 2:
        places[len(whole)].remove()
        places[len(whole) - 1].set_subplotspec(
            places[len(whole) - 1].get_gridspec()[len(whole) // 2, :]  # type: ignore[index]
        )
    for (axes, beside), learnt in zip(grid[rows - len(of_sensors) :], of_sensors, strict=True):
        last = learnt.posterior[-1]
        chosen = int(np.nanargmax(np.abs(last[:, 0] - learnt.prior[:, 0]) / last[:, 1]))
        others = np.delete(learnt.posterior[:, :, 0], chosen, axis=1)
        axes.plot(
            run.numbers, others, color=style.REFERENCE, linewidth=0.5, alpha=0.8,
            label=f"other {run.sensors.word}s",
        )  # fmt: skip
        truth = None if learnt.truth is None else learnt.truth[chosen]
        _course(axes, run, learnt.posterior[:, chosen], learnt.prior[chosen], truth)
        style.panel_label(axes, next(labels), learnt.label)
        axes.text(
            0.99, 0.97, run.sensors.titles[chosen], transform=axes.transAxes, ha="right", va="top",
            color=style.PRESENT,
        )  # fmt: skip
        beside.sharey(axes)
        _last_panel(beside, run, learnt, chosen)
        style.panel_label(beside, next(labels), f"After the last {run.step}")
    style.shared_legend(figure)
    return figure


def _course(axes: Axes, run: Run, course: Float, prior: Float, truth: Float | None) -> None:
    """Draw a course (T, 4) with its band and truth, from its prior (4,) before the first step on."""
    steps = run.numbers
    style.band(axes, steps, course[:, 2], course[:, 3], style.PRESENT)
    axes.plot(steps, course[:, 0], color=style.PRESENT, label="learnt, 90 % band")
    if run.first_step == 0:
        look: dict[str, Any] = {
            "color": style.PAST,
            "marker": "s",
            "markersize": 3.2,
            "capsize": 2.0,
            "elinewidth": 1.2,
        }
        style.interval(axes, -1.0, *prior[[0, 2, 3]], **look, zorder=4, label="prior, 90 %")
    if truth is not None and np.isfinite(truth):
        axes.axhline(float(truth), **style.TRUTH_LINE, label="truth")
    axes.set_xlim(steps[0] - 1.8, steps[-1] + 0.8)
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.grid(axis="y")
    axes.set_xlabel(run.step, labelpad=1.0)


def _last_panel(axes: Axes, run: Run, learnt: LearntQuantity, chosen: int) -> None:
    place = np.arange(1.0, len(learnt.prior) + 1.0)
    axes.bar(
        place, learnt.prior[:, 3] - learnt.prior[:, 2], bottom=learnt.prior[:, 2], width=1.0,
        color=style.PAST, alpha=0.12, linewidth=0,
    )  # fmt: skip
    for index, figures in enumerate(learnt.posterior[-1][:, [0, 2, 3]]):
        color = style.PRESENT if index == chosen else style.OBSERVED
        style.interval(axes, place[index], *figures, color=color, marker="o", markersize=2.6, elinewidth=1.0)
    if learnt.truth is not None:
        axes.hlines(learnt.truth, place - 0.45, place + 0.45, color=style.TRUTH, linewidth=1.0, zorder=3)
    axes.set_xlim(0.2, place[-1] + 0.8)
    axes.xaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 4, 5, 10], integer=True))
    axes.grid(axis="y")
    axes.set_xlabel(run.sensors.word, labelpad=1.0)


def with_interval(figures: Float) -> str:
    """Return a mean and its interval from (mean, deviation, low, high), with the digits that this leaves."""
    mean, _, low, high = figures.tolist()
    return f"{rounded(mean, high - low)} ({between(low, high)})" if np.isfinite(mean) else "—"


def sensor_rows(run: Run) -> list[tuple[str, ...]]:
    """Return the last values of what was learnt of each sensor."""
    own = [learnt.posterior[-1] for learnt in run.learnt if learnt.is_per_sensor]
    rows = zip(run.sensors.titles, *own, strict=True) if own else ()
    return [(title, *map(with_interval, figures)) for title, *figures in rows]


_PIT_BINS = 10
_MOST_CELLS = 6000  # as vectors; more would make the page too large


@dataclass(frozen=True)
class PredictiveCheck:
    """Observations against the posterior predictive distribution of the same step.

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
    noise = run.get("filtered/noise_standard_deviation")
    if noise is None:  # of an earlier version
        noise = np.asarray(run.scenario.observation.standard_deviation)
    total = np.hypot(run["filtered/quantity_standard_deviation"], noise)
    residual = (run.observed - run["filtered/quantity_mean"]) / total
    known = np.isfinite(residual)
    count, seen = known.sum(axis=0), residual[known]
    with np.errstate(invalid="ignore"):
        coverage = (np.abs(residual) <= NORMAL_95).sum(axis=0) / count
        overall = np.divide((np.abs(seen) <= NORMAL_95).sum(), seen.size)
        deviation = np.sqrt(np.divide((seen**2).sum(), seen.size))
    return PredictiveCheck(residual, coverage, count, ndtr(seen), float(overall), float(deviation))


@style.publication_style()
def check_figure(run: Run, check: PredictiveCheck) -> Figure:
    """Draw the residuals of every sensor and step, the coverage of each sensor, and the transform of all."""
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
    look = {**style.RESIDUALS, "rasterized": check.residual.size > _MOST_CELLS}
    image = step_map(axes, run, np.ma.masked_invalid(check.residual), 1, **look)
    ticks = np.arange(1, count + 1, 4 if count > 8 else 1)
    axes.set(xlabel=run.step, ylabel=run.sensors.word, yticks=ticks)
    axes.xaxis.set_major_locator(MaxNLocator(10, integer=True))
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
    least = max(-4.0, 100.0 * min(np.nanmin(check.coverage, initial=1.0), low) - 6.0)
    axes.set(xlabel=run.sensors.word, ylabel="within 95 % interval (%)")
    axes.set(xlim=(0.2, len(number) + 0.8), ylim=(least, 104.0))
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
    axes.set(xlim=(0.0, 1.0), xlabel="probability integral transform", ylabel="density")
    style.panel_label(axes, "c", "All observations")


def _expected(axes: Axes, low: float, high: float, middle: float) -> None:
    """Draw where figures lie if the twin is right."""
    axes.axhspan(low, high, color=style.REFERENCE, alpha=0.25, linewidth=0)
    axes.axhline(middle, color=style.TRUTH, linewidth=0.9, linestyle=(0, (4, 2)))
