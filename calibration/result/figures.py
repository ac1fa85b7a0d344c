"""Figures of any calibration: samples pair by pair with their correlations, and readings beside the model."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.stats import gaussian_kde

from calibration.result.record import Calibration, Reading
from calibration.static.experiments import HALF_WIDTH_95
from reporting.figures import (
    BAND_OPACITY,
    OBSERVED,
    PAST,
    PRESENT,
    REFERENCE,
    band,
    panels,
    publication_style,
)

Float = NDArray[np.float64]

NOTICEABLE_CORRELATION = 0.3
"""From which a correlation is printed in colour."""

_COLOURS = (PAST, PRESENT, REFERENCE)
_COLUMNS = 3
_MOST_READINGS = 12


@publication_style()
def corner_figure(titles: Sequence[str], sets: Sequence[tuple[str, Float]]) -> Figure:
    """Draw samples pair by pair, with their correlations, and others beside.

    Parameters
    ----------
    titles : sequence of str
        What each figure is, with its unit.
    sets : sequence of (str, (N, F) array)
        Name and samples, in the units of the titles, of up to three distributions; correlations are those of
        the first, and the histograms of the others have scales of their own.
    """
    correlation: Float = np.atleast_2d(np.corrcoef(sets[0][1], rowvar=False))
    size = len(titles)
    height = min(6.6, 2.2 + 1.1 * (size - 1)) if size < 5 else 6.6
    bottom = height * (0.075 if size > 3 else 0.16)
    figure, grid = panels(size, size, height, 0.015 * height, bottom, left=0.105, wspace=0.10, hspace=0.10)
    limits = [_limits([values[:, index] for _, values in sets]) for index in range(size)]
    for (row, column), axes in np.ndenumerate(np.array(grid)):
        if column > row:
            _draw_correlation(axes, float(correlation[row, column]))
            continue
        if column == row:
            _draw_marginal(axes, [values[:, row] for _, values in sets], limits[row])
        else:
            for colour, (_, values) in zip(_COLOURS, sets, strict=False):
                axes.plot(
                    values[:, column], values[:, row], ".", color=colour, ms=1.6, alpha=0.35, mew=0.0,
                    rasterized=True,
                )  # fmt: skip
            axes.set_ylim(limits[row])
        axes.set_xlim(limits[column])
        _outer_labels(axes, titles, row, column)
    handles = [
        Line2D([], [], linestyle="none", marker="s", color=colour, ms=4.0, label=text)
        for colour, (text, _) in zip(_COLOURS, sets, strict=False)
    ]
    figure.legend(handles=handles, loc="upper right", bbox_to_anchor=(0.985, 0.99))
    return figure


@publication_style()
def readings_figure(result: Calibration) -> Figure:
    """Draw figures before and after, with what was measured of them."""
    readings = result.readings[:_MOST_READINGS]
    rows = -(-len(readings) // _COLUMNS)
    height = 0.5 + 1.55 * rows
    figure, grid = panels(
        rows, _COLUMNS, height, 0.1 * height, 0.28 / rows * height, left=0.02, wspace=0.14, hspace=0.75
    )
    places = [axes for row in grid for axes in row]
    for axes, reading in zip(places, readings, strict=False):
        _draw_reading(axes, result, reading)
    for spare in places[len(readings) :]:
        spare.remove()
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="upper left", ncols=3)
    return figure


def _draw_reading(axes: Axes, result: Calibration, reading: Reading) -> None:
    unit = next(figure.unit for figure in result.figures if figure.name == reading.name)
    prior, posterior = result.draws_of(reading.name, prior=True), result.draws_of(reading.name)
    value, half = reading.value, HALF_WIDTH_95 * reading.deviation
    mean = float(posterior.mean())
    spread = max(float(posterior.std()), 1e-6 * abs(mean))
    low, high = min(mean - 4.5 * spread, value - 1.6 * half), max(mean + 4.5 * spread, value + 1.6 * half)
    grid = np.linspace(max(low, 0.0) if mean > 0.0 else low, high, 301)
    axes.axvspan(
        value - half, value + half, color=OBSERVED, alpha=BAND_OPACITY, lw=0.0, label="measured, 95 %"
    )
    axes.axvline(value, color=OBSERVED, lw=0.9)
    before = gaussian_kde(prior)(grid)
    top = float(before.max())
    if posterior.std() > 1e-9 * abs(mean):
        after = gaussian_kde(posterior)(grid)
        top = float(after.max())
        band(axes, grid, np.zeros_like(grid), after, PAST)
        axes.plot(grid, after, color=PAST, lw=1.3, label="after the calibration")
    else:
        axes.axvline(mean, color=PAST, lw=1.3, label="after the calibration")
    axes.plot(grid, before, color=REFERENCE, lw=1.2, ls="--", label="before")
    axes.set_xlim(grid[0], grid[-1])
    axes.set_ylim(0.0, 1.12 * top)
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.ticklabel_format(useOffset=False)
    axes.set_xlabel(reading.name.replace("_", " ") + ("" if unit == "1" else f" ({unit})"))


def _limits(sets: Sequence[Float]) -> tuple[float, float]:
    low, high = np.quantile(sets[0], [0.002, 0.998])
    low, high = min(low, *map(np.min, sets[1:]), low), max(high, *map(np.max, sets[1:]), high)
    margin = 0.06 * (high - low) or 1e-3 * abs(high)
    return float(low - margin), float(high + margin)


def _draw_marginal(axes: Axes, sets: Sequence[Float], limits: tuple[float, float]) -> None:
    edges = np.linspace(*limits, 31)
    axes.hist(sets[0], bins=edges.tolist(), density=True, color=PAST, alpha=0.45, lw=0.0)
    top = float(np.histogram(sets[0], bins=edges, density=True)[0].max())
    for colour, values in zip(_COLOURS[1:], sets[1:], strict=False):
        own, _ = np.histogram(values, bins=edges, density=True)
        if own.max() > 0.0:  # its own scale: one may have next to no width
            axes.stairs(own * top / own.max(), edges, color=colour, lw=0.9)
    axes.set_ylim(0.0, 1.12 * top)


def _draw_correlation(axes: Axes, value: float) -> None:
    axes.set_axis_off()
    axes.text(
        0.5, 0.5, f"{value:+.2f}".replace("-", "−"), ha="center", va="center",
        transform=axes.transAxes, fontsize=6.5 + 5.0 * abs(value),
        color=PAST if abs(value) > NOTICEABLE_CORRELATION else OBSERVED,
    )  # fmt: skip


def _outer_labels(axes: Axes, titles: Sequence[str], row: int, column: int) -> None:
    size = len(titles)
    axes.xaxis.set_major_locator(MaxNLocator(3, prune="both"))
    axes.yaxis.set_major_locator(MaxNLocator(3, prune="both"))
    axes.ticklabel_format(useOffset=False)
    axes.tick_params(labelsize=6.5)
    if row == size - 1:
        axes.set_xlabel(titles[column])
    else:
        axes.set_xticklabels([])
    if column == 0 and row > 0:
        axes.set_ylabel(titles[row])
    elif column != row and column > 0:
        axes.set_yticklabels([])
    if column == row:
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
