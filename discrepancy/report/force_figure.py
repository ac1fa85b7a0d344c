"""The missing force over displacement, speed and time, the law through it, and what is left."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from discrepancy.missing_force.force import MissingForce
from discrepancy.report.kit import panels
from discrepancy.report.text import motion_of
from discrepancy.verdict import ForceAtPort
from reporting.figures import BAND_OPACITY, OBSERVED, PREDICTION, REFERENCE, panel_label, publication_style

MOST_DOTS = 3000
"""Dots of a panel; of longer records some are left out evenly."""
MOST_TURNS = 400
"""Samples of the course in time: the stretch where the force is largest."""


def missing_force_figure(missing: MissingForce, told: ForceAtPort) -> Figure:
    """Draw a missing force and what is told of it, with its law and what is left where there is one."""
    parts = [("missing force", "force"), ("what is left", "left")][: 2 if missing.law else 1]
    what, place, rate = motion_of(told)
    integral, state = ("displacement", "speed") if place else ("integral of the state", "state")
    along = (("position", ", ".join(filter(None, (integral, place)))), ("speed", f"{state}, {rate}"))
    with publication_style():
        figure, rows = panels(len(parts), 3, 2.4 * len(parts) + 0.5)
        for number, (row, (title, name)) in enumerate(zip(rows, parts, strict=True)):
            for axes, (motion, label) in zip(row[:2], along, strict=True):
                _draw_over(axes, missing, motion, name)
                axes.set_xlabel(label)
            _draw_in_time(row[2], missing, name)
            row[0].set_ylabel(f"{what}, {told.unit}")
            for column, axes in enumerate(row):
                axes.axhline(0.0, color=REFERENCE, lw=0.6, zorder=0)
                axes.locator_params(axis="x", nbins=4)  # the integral of a state may have six digits
                if axes is not rows[0][0]:
                    axes.sharey(rows[0][0])
                panel_label(axes, "abcdef"[3 * number + column], title)
        drawn = rows[0][0].get_legend_handles_labels()
        figure.legend(*drawn, loc="outside upper right", ncols=2, markerscale=3.0)
    return figure


def _draw_over(axes: Axes, missing: MissingForce, motion: str, name: str) -> None:
    total = sum(len(item.time) for item in missing.courses)
    every = -(-total // MOST_DOTS)
    along, values, deviation = (
        np.concatenate([getattr(item, key)[::every] for item in missing.courses])
        for key in (motion, name, "deviation")
    )
    axes.vlines(along, values - deviation, values + deviation, color=OBSERVED, lw=0.4, alpha=BAND_OPACITY)
    axes.plot(along, values, ".", color=OBSERVED, ms=2.6, alpha=0.6, label="seen, ± 1 deviation")
    if missing.law and name == "force":
        law = np.concatenate([item.law[::every] for item in missing.courses if item.law is not None])
        axes.plot(along, law, ".", color=PREDICTION, ms=1.2, alpha=0.7, label=missing.law)


def _draw_in_time(axes: Axes, missing: MissingForce, name: str) -> None:
    """Draw the stretch of the trial in which the force is largest."""
    item = max(missing.courses, key=lambda one: float(np.max(np.abs(one.force))))
    first = int(np.argmax(np.abs(item.force))) - MOST_TURNS // 2
    first = max(min(first, len(item.time) - MOST_TURNS), 0)
    stretch = slice(first, first + MOST_TURNS)
    time, values, deviation = item.time[stretch], getattr(item, name)[stretch], item.deviation[stretch]
    reach = 2.0 * deviation
    axes.fill_between(time, values - reach, values + reach, color=OBSERVED, alpha=BAND_OPACITY, lw=0.0)
    axes.plot(time, values, color=OBSERVED, lw=0.9)
    if item.law is not None and name == "force":
        axes.plot(time, item.law[stretch], "--", color=PREDICTION, lw=0.9)
    axes.set_xlabel(f"time in {item.trial}, s")
