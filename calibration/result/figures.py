"""Figures of any calibration: samples pair by pair with their correlations, and readings beside the model."""

from collections.abc import Sequence
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from scipy.stats import gaussian_kde

from calibration.result.record import Calibration, Reading
from calibration.result.text import NOTICEABLE_CORRELATION
from calibration.static.experiments import HALF_WIDTH_95
from reporting import figures as style
from reporting.arrays import Float

_COLOURS = (style.PAST, style.PRESENT, style.REFERENCE)
_COLUMNS = 3
_MOST_READINGS = 12
_TITLE_WIDTH = 14  # letters of a line beside an axis


def drawn_parameters(result: Calibration) -> tuple[list[int], list[str]]:
    """Return which parameters are drawn pair by pair, those that have no reading of their own, and titles."""
    measured = {reading.name for reading in result.readings}
    drawn = {at: prior.figure for at, prior in enumerate(result.priors) if prior.name not in measured}
    return list(drawn), [fill(figure.axis_title, _TITLE_WIDTH) for figure in drawn.values()]


@style.publication_style()
def corner_figure(titles: Sequence[str], sets: Sequence[tuple[str, Float]]) -> Figure:
    """Draw samples pair by pair, with their correlations, and others beside.

    Parameters
    ----------
    titles : sequence of str
        What each figure is, with its unit.
    sets : sequence of (str, (N, F) array)
        Name and samples, in the units of the titles, of up to three distributions; correlations are those of
        the first, and each histogram has a scale of its own.
    """
    correlation: Float = np.atleast_2d(np.corrcoef(sets[0][1], rowvar=False))
    size = len(titles)
    height = min(6.6, 1.1 + 1.1 * size)
    bottom = height * (0.075 if size > 3 else 0.16)
    figure, grid = style.panels(
        size, size, height, 0.015 * height, bottom, left=0.105, wspace=0.10, hspace=0.10
    )
    coloured = list(zip(_COLOURS, sets, strict=False))
    limits = [_limits([values[:, index] for _, values in sets]) for index in range(size)]
    for (row, column), axes in np.ndenumerate(np.array(grid)):
        if column > row:
            value = float(correlation[row, column])
            axes.set_axis_off()
            axes.text(
                0.5, 0.5, f"{value:+.2f}".replace("-", "−"), ha="center", va="center",
                transform=axes.transAxes, fontsize=6.5 + 5.0 * abs(value),
                color=style.PAST if abs(value) > NOTICEABLE_CORRELATION else style.OBSERVED,
            )  # fmt: skip
            continue
        axes.xaxis.set_major_locator(MaxNLocator(3, prune="both"))
        axes.yaxis.set_major_locator(MaxNLocator(3, prune="both"))
        axes.ticklabel_format(useOffset=False)
        axes.tick_params(labelsize=6.5)
        axes.set(xlim=limits[column], xlabel=titles[column], ylabel=titles[row] if row > column else "")
        axes.label_outer()
        if column == row:
            axes.set(ylim=(0.0, 1.12), yticks=[])
            axes.spines["left"].set_visible(False)
        else:
            axes.set_ylim(limits[row])
        for colour, (_, values) in coloured:
            if column < row:
                axes.plot(
                    values[:, column], values[:, row], ".", color=colour, ms=1.6, alpha=0.35, mew=0.0,
                    rasterized=True,
                )  # fmt: skip
                continue
            counts, edges = np.histogram(values[:, row], bins=np.linspace(*limits[row], 31))
            first = values is sets[0][1]
            look = {"fill": True, "alpha": 0.45, "lw": 0.0} if first else {"lw": 0.9}
            axes.stairs(counts / max(counts.max(), 1), edges, color=colour, **look)
    handles = [
        Line2D([], [], linestyle="none", marker="s", color=colour, ms=4.0, label=text)
        for colour, (text, _) in coloured
    ]
    figure.legend(handles=handles, loc="upper right", bbox_to_anchor=(0.985, 0.99))
    return figure


def _limits(sets: Sequence[Float]) -> tuple[float, float]:
    low, high = np.quantile(sets[0], [0.002, 0.998])
    low, high = min(low, *map(np.min, sets[1:]), low), max(high, *map(np.max, sets[1:]), high)
    margin = 0.06 * (high - low) or 1e-3 * abs(high)
    return float(low - margin), float(high + margin)


@style.publication_style()
def readings_figure(result: Calibration) -> Figure:
    """Draw figures before and after, with what was measured of them."""
    readings = result.readings[:_MOST_READINGS]
    rows = -(-len(readings) // _COLUMNS)
    height = 0.5 + 1.55 * rows
    figure, grid = style.panels(
        rows, _COLUMNS, height, 0.1 * height, 0.28 / rows * height, left=0.02, wspace=0.14, hspace=0.75
    )
    for axes, reading in zip(style.keep_first_panels(grid, len(readings)), readings, strict=True):
        _draw_reading(axes, result, reading)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="upper left", ncols=3)
    return figure


def _draw_reading(axes: Axes, result: Calibration, reading: Reading) -> None:
    prior, posterior = result.draws_of(reading.name, prior=True), result.draws_of(reading.name)
    value, half = reading.value, HALF_WIDTH_95 * reading.deviation
    mean = float(posterior.mean())
    spread = max(float(posterior.std()), 1e-6 * abs(mean))
    low, high = min(mean - 4.5 * spread, value - 1.6 * half), max(mean + 4.5 * spread, value + 1.6 * half)
    grid = np.linspace(max(low, 0.0) if mean > 0.0 else low, high, 301)
    axes.axvspan(
        value - half,
        value + half,
        color=style.OBSERVED,
        alpha=style.BAND_OPACITY,
        lw=0.0,
        label="measured, 95 %",
    )
    axes.axvline(value, color=style.OBSERVED, lw=0.9)
    before = gaussian_kde(prior)(grid)
    top = float(before.max())
    if posterior.std() > 1e-9 * abs(mean):
        after = gaussian_kde(posterior)(grid)
        top = float(after.max())
        style.band(axes, grid, np.zeros_like(grid), after, style.PAST)
        axes.plot(grid, after, color=style.PAST, lw=1.3, label="after the calibration")
    else:
        axes.axvline(mean, color=style.PAST, lw=1.3, label="after the calibration")
    axes.plot(grid, before, color=style.REFERENCE, lw=1.2, ls="--", label="before")
    title = next(figure.axis_title for figure in result.figures if figure.name == reading.name)
    axes.set(xlim=(grid[0], grid[-1]), ylim=(0.0, 1.12 * top), yticks=[], xlabel=title)
    axes.spines["left"].set_visible(False)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.ticklabel_format(axis="x", useOffset=False)
