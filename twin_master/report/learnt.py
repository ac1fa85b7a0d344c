"""What the twin learnt of what does not change in time: its course over the turns, and its last values."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from reporting import figures as style
from reporting.arrays import Float
from reporting.words import between, rounded
from twin_master.report.reading import Run
from twin_master.store.mission_result import LearntQuantity

_ROW_HEIGHT = 1.55


@style.publication_style()
def learnt_figure(run: Run) -> Figure:
    """Draw each learnt quantity over the turns with its 90 % band.

    Of quantities of each sensor the one that departs most from its prior has the band, and beside it stand
    the last values of all sensors.
    """
    whole = [learnt for learnt in run.learnt if not learnt.of_sensors]
    of_sensors = [learnt for learnt in run.learnt if learnt.of_sensors]
    rows = -(-len(whole) // 2) + len(of_sensors)
    labels = iter("abcdefghijklmnopqrstuvwxyz")
    figure, grid = style.panels(
        rows, 2, 0.85 + _ROW_HEIGHT * rows, 0.52, 0.42, left=0.08, hspace=0.62, wspace=0.22
    )
    places = [axes for row in grid for axes in row]
    for axes, learnt in zip(places, whole, strict=False):
        _course(axes, run, learnt.course, learnt.prior, learnt.truth)
        style.panel_label(axes, next(labels), learnt.label)
    if len(whole) % 2:
        places[len(whole)].remove()
        places[len(whole) - 1].set_subplotspec(
            places[len(whole) - 1].get_gridspec()[len(whole) // 2, :]  # type: ignore[index]
        )
    for (axes, beside), learnt in zip(grid[rows - len(of_sensors) :], of_sensors, strict=True):
        last = learnt.course[-1]
        chosen = int(np.nanargmax(np.abs(last[:, 0] - learnt.prior[:, 0]) / last[:, 1]))
        others = np.delete(learnt.course[:, :, 0], chosen, axis=1)
        axes.plot(
            _steps(run), others, color=style.REFERENCE, linewidth=0.5, alpha=0.8,
            label=f"other {run.sensors.word}s",
        )  # fmt: skip
        truth = None if learnt.truth is None else learnt.truth[chosen]
        _course(axes, run, learnt.course[:, chosen], learnt.prior[chosen], truth)
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


def _steps(run: Run) -> Float:
    return np.arange(run.first_step, run.first_step + run.steps, dtype=np.float64)


def _course(axes: Axes, run: Run, course: Float, prior: Float, truth: Float | None) -> None:
    """Draw a course (T, 4) with its band and truth, from its prior (4,) before the first turn on."""
    steps = _steps(run)
    style.band(axes, steps, course[:, 2], course[:, 3], style.PRESENT)
    axes.plot(steps, course[:, 0], color=style.PRESENT, label="learnt, 90 % band")
    if run.first_step == 0:
        look = {"color": style.PAST, "marker": "s", "markersize": 3.2, "capsize": 2.0, "elinewidth": 1.2}
        _bar(axes, -1.0, prior, **look, zorder=4, label="prior, 90 %")
    if truth is not None and np.isfinite(truth):
        axes.axhline(float(truth), **style.TRUTH_LINE, label="truth")
    axes.set_xlim(steps[0] - 1.8, steps[-1] + 0.8)
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.grid(axis="y")
    axes.set_xlabel(run.step, labelpad=1.0)


def _bar(axes: Axes, place: float, figures: Float, **look: Any) -> None:
    """Draw a mean with its interval from (mean, deviation, low, high)."""
    mean, _, low, high = figures.tolist()
    axes.errorbar([place], [mean], yerr=[[mean - low], [high - mean]], linestyle="none", **look)


def _last_panel(axes: Axes, run: Run, learnt: LearntQuantity, chosen: int) -> None:
    place = np.arange(1.0, len(learnt.prior) + 1.0)
    axes.bar(
        place, learnt.prior[:, 3] - learnt.prior[:, 2], bottom=learnt.prior[:, 2], width=1.0,
        color=style.PAST, alpha=0.12, linewidth=0,
    )  # fmt: skip
    for index, figures in enumerate(learnt.course[-1]):
        color = style.PRESENT if index == chosen else style.OBSERVED
        _bar(axes, place[index], figures, color=color, marker="o", markersize=2.6, elinewidth=1.0)
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
    own = [learnt.course[-1] for learnt in run.learnt if learnt.of_sensors]
    rows = zip(run.sensors.titles, *own, strict=True) if own else ()
    return [(title, *map(with_interval, figures)) for title, *figures in rows]
