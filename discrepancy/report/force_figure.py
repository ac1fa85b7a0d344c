"""The missing force over displacement, speed and time, the law through it, and what is left."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from discrepancy.missing_force.force import ForceCourse, MissingForce
from reporting.figures import (
    BAND_OPACITY,
    OBSERVED,
    PREDICTION,
    REFERENCE,
    new_figure,
    panel_label,
    publication_style,
)

FloatArray = NDArray[np.float64]

MOST_DOTS = 3000
"""Dots of a panel; of longer records some are left out evenly."""
MOST_TURNS = 400
"""Samples of the course in time: the stretch where the force is largest."""


def missing_force_figure(missing: MissingForce) -> Figure:
    """Draw the missing force, with its law and what is left where an effect was named."""
    rows = 2 if missing.law else 1
    with publication_style():
        figure = new_figure(2.4 * rows + 0.5)
        grid = figure.add_gridspec(
            rows, 3, left=0.085, right=0.985, bottom=0.2 / rows, top=1.0 - 0.17 / rows, wspace=0.3, hspace=0.5
        )
        shared: Axes | None = None
        for row in range(rows):
            for column in range(3):
                axes = figure.add_subplot(grid[row, column], sharey=shared)
                shared = shared if row else shared or axes
                _draw(axes, missing, column, left=bool(row))
                panel_label(axes, "abcdef"[3 * row + column], ("missing force", "what is left")[row])
        drawn = figure.axes[0].get_legend_handles_labels()
        figure.legend(*drawn, loc="upper right", ncols=2, markerscale=3.0)
    return figure


def _draw(axes: Axes, missing: MissingForce, column: int, *, left: bool) -> None:
    """Draw one panel: over displacement (0), speed (1) or time (2)."""
    axes.axhline(0.0, color=REFERENCE, lw=0.6, zorder=0)
    axes.locator_params(axis="x", nbins=4)  # the integral of a state may have six digits
    if column == 2:
        _draw_in_time(axes, missing, left=left)
    else:
        _draw_over(axes, missing, column, left=left)
    if column == 0:
        axes.set_ylabel("flow" if missing.of_state else "force, N or N m")


def _draw_over(axes: Axes, missing: MissingForce, column: int, *, left: bool) -> None:
    total = sum(len(item.time) for item in missing.courses)
    stride = -(-total // MOST_DOTS)

    def joined(name: str) -> FloatArray:
        return np.concatenate([getattr(item, name)[::stride] for item in missing.courses])

    along = joined(("position", "speed")[column])
    values, deviation = joined("left" if left else "force"), joined("deviation")
    axes.vlines(along, values - deviation, values + deviation, color=OBSERVED, lw=0.4, alpha=BAND_OPACITY)
    axes.plot(along, values, ".", color=OBSERVED, ms=1.6, alpha=0.6, label="seen, ± 1 deviation")
    if missing.law and not left:
        law = np.concatenate([item.law[::stride] for item in missing.courses if item.law is not None])
        axes.plot(along, law, ".", color=PREDICTION, ms=1.2, alpha=0.7, label=missing.law)
    if missing.of_state:
        axes.set_xlabel(("integral of the state", "state")[column])
    else:
        axes.set_xlabel(("displacement, m or rad", "speed, m/s or rad/s")[column])


def _draw_in_time(axes: Axes, missing: MissingForce, *, left: bool) -> None:
    item, stretch = _largest(missing)
    time, deviation = item.time[stretch], item.deviation[stretch]
    values = (item.left if left else item.force)[stretch]
    axes.fill_between(
        time, values - 2.0 * deviation, values + 2.0 * deviation, color=OBSERVED, alpha=BAND_OPACITY, lw=0.0
    )
    axes.plot(time, values, color=OBSERVED, lw=0.9)
    if item.law is not None and not left:
        axes.plot(time, item.law[stretch], "--", color=PREDICTION, lw=0.9)
    axes.set_xlabel(f"time in {item.trial}, s")


def _largest(missing: MissingForce) -> tuple[ForceCourse, slice]:
    """Return the trial and the stretch in which the force is largest."""
    item = max(missing.courses, key=lambda one: float(np.max(np.abs(one.force))))
    middle = int(np.argmax(np.abs(item.force)))
    first = max(min(middle - MOST_TURNS // 2, len(item.time) - MOST_TURNS), 0)
    return item, slice(first, first + MOST_TURNS)
