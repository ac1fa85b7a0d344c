"""Figures of residuals over the load, and of the windows in time with the largest gaps."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from discrepancy.campaign.records import Quantity, TrialKind
from discrepancy.campaign.units import UNITS
from discrepancy.location.residuals import ResidualSet
from discrepancy.report.residual_figures import (
    DrawnModel,
    add_size_bar,
    draw_noise,
    models_to_draw,
    new_panels,
    size_colour_scale,
)
from discrepancy.verdict import GapWindow
from reporting.pages import figures as style

MOST_RECORDS = 12
"""Records that are drawn; those with the largest gaps go first."""
LONGEST_NAME = 26
"""Most characters of a trial's name at the axis."""


class _LoadPanel(NamedTuple):
    """A panel of residuals over the load: trials, label of the load, quantity and channels."""

    kind: TrialKind
    label: str
    quantity: Quantity
    names: list[str]


def _load_panels(residuals: ResidualSet) -> list[_LoadPanel]:
    """Return the panels: one for each measured quantity of static trials, then of flights."""
    load_panels = []
    for kind, label in ((TrialKind.STATIC, "force, N"), (TrialKind.FLIGHT, "load factor")):
        measured: set[str] = set()
        for fitted in residuals.trials:
            if fitted.trial.kind is kind:
                measured.update(fitted.trial.channels)
        for quantity in Quantity:
            names = [
                name
                for name, channel in residuals.channels.items()
                if channel.quantity is quantity and name in measured
            ]
            if names:
                load_panels.append(_LoadPanel(kind, label, quantity, names))
    return load_panels


def load_figure(before: ResidualSet, after: ResidualSet | None) -> Figure | None:
    """Draw the residuals of static trials and flights over the load, a panel for each quantity.

    Parameters
    ----------
    before : ResidualSet
        Residuals of the model without the effect.
    after : ResidualSet or None
        Residuals of the model with the effect.

    Returns
    -------
    Figure or None
        The figure with at most four panels; None if there are no such trials.
    """
    load_panels = _load_panels(before)[:4]
    if not load_panels:
        return None
    columns = min(len(load_panels), 2)
    rows = (len(load_panels) + columns - 1) // columns
    figure, grid = new_panels(rows, columns, 2.25 * rows + 0.3)
    all_axes = style.keep_first_panels(grid, len(load_panels))
    for letter, axes, panel in zip("abcd", all_axes, load_panels, strict=False):
        factor, unit = UNITS[panel.quantity].drawn
        noises = []
        for drawn in models_to_draw(before, after):
            noises.append(_draw_loads(axes, drawn, panel.kind, panel.names, factor))
        draw_noise(axes, noises[0], 0.25)
        axes.axhline(0.0, color=style.OBSERVED, lw=0.6)
        title = f"{letter}  {panel.kind.value}, {panel.quantity.value}"
        axes.set(xlabel=panel.label, ylabel=f"residual, {unit}", title=title)
    handles, labels = all_axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=3)
    return figure


def _draw_loads(
    axes: Axes, drawn: DrawnModel, kind: TrialKind, names: Sequence[str], factor: float
) -> float:
    """Draw the residuals of several channels over the load, one marker for each reading.

    Parameters
    ----------
    axes : Axes
        The axes to draw on.
    drawn : DrawnModel
        Residuals of one model, with the marker, colour and label of that model.
    kind : TrialKind
        Kind of the trials to draw: static trials or flights.
    names : sequence of str
        Names of the channels to draw.
    factor : float
        Factor from SI to the unit of the figure.

    Returns
    -------
    float
        Largest standard deviation of the noise of these channels, in the unit of the figure.
    """
    largest_noise = 0.0
    legend_label = drawn.label
    relative_shift = 0.0 if drawn.marker == "o" else 0.006  # so that models do not hide each other
    for fitted in drawn.residuals.trials:
        trial = fitted.trial
        if trial.kind is not kind:
            continue
        load_range = float(np.ptp(trial.load)) or 1.0
        for name in names:
            if name not in trial.channels:
                continue
            column = fitted.column(name)
            used = fitted.used[:, column]
            largest_noise = max(largest_noise, factor * float(fitted.noise_deviation[column]))
            axes.plot(
                trial.load[used] + relative_shift * load_range,
                factor * fitted.residual[used, column],
                drawn.marker,
                ms=2.8,
                lw=0.0,
                mfc="none" if trial.held_out else drawn.colour,
                mec=drawn.colour,
                mew=0.7,
                alpha=0.8,
                label=legend_label,
            )
            legend_label = "_nolegend_"  # Matplotlib: one entry in the legend for each model
    return largest_noise


def time_line_figure(windows: Sequence[GapWindow]) -> Figure | None:
    """Draw the windows in time in which model and measurements differ, as bars by trial.

    Parameters
    ----------
    windows : sequence of GapWindow
        Windows of the records, each with the size of its gap between model and measurements.

    Returns
    -------
    Figure or None
        The figure with a row for each of the `MOST_RECORDS` trials with the largest gaps; None if
        there are no windows.
    """
    if not windows:
        return None
    largest_gap_of_trial: dict[str, float] = {}
    for window in windows:
        largest_gap_of_trial[window.trial] = max(
            largest_gap_of_trial.get(window.trial, 0.0), window.size
        )
    trials_with_largest_gaps = sorted(
        largest_gap_of_trial, key=lambda name: -largest_gap_of_trial[name]
    )[:MOST_RECORDS]
    trials = [name for name in largest_gap_of_trial if name in trials_with_largest_gaps]
    norm = size_colour_scale([window.size for window in windows])
    has_two_rows = any(window.with_effect for window in windows)
    figure, ((axes,),) = new_panels(1, 1, max(0.34 * len(trials), 1.1) + 0.9)
    for row, name in enumerate(trials):
        windows_of_trial = [window for window in windows if window.trial == name]
        _draw_record(axes, row, windows_of_trial, norm, has_two_rows=has_two_rows)
    axes.set_yticks(range(len(trials)), [_shorten_name(name) for name in trials])
    axes.set_ylim(len(trials) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.set_xlabel("time since the start of the trial, s")
    add_size_bar(figure, norm, [axes])
    return figure


def _draw_record(
    axes: Axes, row: int, windows: Sequence[GapWindow], norm: Normalize, *, has_two_rows: bool
) -> None:
    """Draw the windows of a record as bars, with the uncertainty of their ends.

    Parameters
    ----------
    axes : Axes
        The axes to draw on.
    row : int
        Row of the record, counted downwards.
    windows : sequence of GapWindow
        Windows of the record.
    norm : Normalize
        Scale from the size of a gap to the colour of its bar.
    has_two_rows : bool
        True if the windows that remain with the effect have a line of their own below the others.
    """
    first, last = windows[0].first, windows[0].last
    lines = (row - 0.14, row + 0.2) if has_two_rows else row
    axes.hlines(lines, first, last, color=style.REFERENCE, lw=1.0, zorder=1)
    for window in windows:
        # a window without a start or an end extends to that end of the record
        begin = first if window.begin is None else window.begin.value
        end = last if window.end is None else window.end.value
        if window.with_effect:
            bottom, height = row + 0.1, 0.2
        else:
            bottom, height = row - 0.34, 0.4 if has_two_rows else 0.68
        axes.broken_barh(
            [(begin, end - begin)],
            (bottom, height),
            facecolor=colormaps[style.LEVELS](float(norm(window.size))),
            edgecolor="#333333",
            lw=0.5,
            zorder=2,
        )
        middle = bottom + 0.5 * height
        cap = 0.3 * height
        for moment in (window.begin, window.end):
            if moment is None:
                continue
            axes.hlines(middle, moment.low, moment.high, color="white", lw=2.6, zorder=3)
            axes.hlines(middle, moment.low, moment.high, color=style.OBSERVED, lw=1.2, zorder=4)
            axes.vlines(
                [moment.low, moment.high],
                middle - cap,
                middle + cap,
                color=style.OBSERVED,
                lw=0.9,
                zorder=4,
            )


def _shorten_name(name: str) -> str:
    """Return a name, cut off with an ellipsis if it is long."""
    if len(name) <= LONGEST_NAME:
        return name
    return f"{name[: LONGEST_NAME - 1]}\N{HORIZONTAL ELLIPSIS}"
