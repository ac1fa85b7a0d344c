"""Figures of any calibration: samples pair by pair, and readings compared with the model."""

import math
from collections.abc import Sequence
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from scipy.stats import gaussian_kde

from calibration.result.record import Calibration, QuantityReading
from calibration.result.text import NOTICEABLE_CORRELATION
from calibration.static.experiments import HALF_WIDTH_95
from reporting.arrays import Float
from reporting.pages import figures as style

_COLOURS = (style.PAST, style.PRESENT, style.REFERENCE)
_COLUMNS = 3
_MOST_MARGINAL_COLUMNS = 5
_MOST_READINGS = 12
_TITLE_WIDTH = 14  # of a line beside an axis, in characters


def unmeasured_parameters(result: Calibration) -> tuple[list[int], list[str]]:
    """Return the columns and axis titles of parameters that have no reading.

    The corner figures show these parameters.
    """
    measured_names = {reading.name for reading in result.readings}
    columns = []
    titles = []
    for column, prior in enumerate(result.priors):
        if prior.name not in measured_names:
            columns.append(column)
            titles.append(fill(prior.quantity.axis_title, _TITLE_WIDTH))
    return columns, titles


@style.publication_style()
def corner_figure(titles: Sequence[str], sets: Sequence[tuple[str, Float]]) -> Figure:
    """Draw a corner plot: histograms, scatter plots of pairs of parameters, and correlations.

    Parameters
    ----------
    titles : sequence of str
        The title of each parameter, with its unit.
    sets : sequence of (str, (N, F) array)
        The names and samples of up to three distributions, in the units of the titles. The printed
        correlations are those of the first distribution. Each histogram is scaled to its own
        maximum.
    """
    samples = [values for _, values in sets]
    correlation: Float = np.atleast_2d(np.corrcoef(samples[0], rowvar=False))
    parameter_count = len(titles)
    height = min(6.6, 1.1 + 1.1 * parameter_count)
    bottom = height * (0.075 if parameter_count > 3 else 0.16)
    figure, grid = style.panels(
        parameter_count,
        parameter_count,
        height,
        0.015 * height,
        bottom,
        left=0.105,
        wspace=0.10,
        hspace=0.10,
    )
    limits = [
        _limits([values[:, column] for values in samples]) for column in range(parameter_count)
    ]
    # correlations above the diagonal, histograms on it, scatter plots below
    for (row, column), axes in np.ndenumerate(np.array(grid)):
        if column > row:
            _write_correlation(axes, float(correlation[row, column]))
            continue
        _prepare_corner_axes(axes)
        axes.set(xlim=limits[column], xlabel=titles[column])
        axes.set_ylabel(titles[row] if row > column else "")
        axes.label_outer()
        if column == row:
            _draw_histograms(axes, [values[:, row] for values in samples], limits[row])
        else:
            axes.set_ylim(limits[row])
            _draw_scatter(axes, samples, column, row)
    _draw_legend(figure, sets)
    return figure


def _draw_legend(figure: Figure, sets: Sequence[tuple[str, Float]]) -> None:
    """Draw the names of the distributions beside their colours, in the upper right corner."""
    handles = []
    for colour, (name, _) in zip(_COLOURS, sets, strict=False):
        handles.append(
            Line2D([], [], linestyle="none", marker="s", color=colour, ms=4.0, label=name)
        )
    figure.legend(
        handles=handles, loc="upper right", bbox_to_anchor=(0.985, 1.0), ncols=len(handles)
    )


@style.publication_style()
def marginal_figure(titles: Sequence[str], sets: Sequence[tuple[str, Float]]) -> Figure:
    """Draw histograms of samples, a panel for each parameter; the first set is filled.

    Parameters
    ----------
    titles : sequence of str
        The title of each parameter, with its unit.
    sets : sequence of (str, (N, F) array)
        The names and samples of up to three distributions, in the units of the titles.
    """
    columns = min(len(titles), _MOST_MARGINAL_COLUMNS)
    rows = math.ceil(len(titles) / columns)
    height = 0.35 + 1.5 * rows
    figure, grid = style.panels(
        rows, columns, height, 0.3, 0.6, left=0.03, right=0.97, wspace=0.15, hspace=0.85
    )
    for column, axes in enumerate(style.keep_first_panels(grid, len(titles))):
        values = [samples[:, column] for _, samples in sets]
        limits = _limits(values)
        _prepare_corner_axes(axes)
        axes.set(xlim=limits, xlabel=titles[column])
        _draw_histograms(axes, values, limits)
    _draw_legend(figure, sets)
    return figure


def _write_correlation(axes: Axes, correlation: float) -> None:
    """Write a correlation in a panel, in a font size that grows with its magnitude."""
    axes.set_axis_off()
    is_noticeable = abs(correlation) > NOTICEABLE_CORRELATION
    axes.text(
        0.5,
        0.5,
        f"{correlation:+.2f}".replace("-", "−"),
        ha="center",
        va="center",
        transform=axes.transAxes,
        fontsize=6.5 + 5.0 * abs(correlation),
        color=style.PAST if is_noticeable else style.OBSERVED,
    )


def _prepare_corner_axes(axes: Axes) -> None:
    """Give a panel few, small tick labels."""
    axes.xaxis.set_major_locator(MaxNLocator(3, prune="both"))
    axes.yaxis.set_major_locator(MaxNLocator(3, prune="both"))
    axes.ticklabel_format(useOffset=False)
    axes.tick_params(labelsize=6.5)


def _draw_histograms(axes: Axes, samples: Sequence[Float], limits: tuple[float, float]) -> None:
    """Draw histograms of up to three sets of samples (N,), the first one filled."""
    axes.set(ylim=(0.0, 1.12), yticks=[])
    axes.spines["left"].set_visible(False)
    bins = np.linspace(*limits, 31)
    for number, (colour, values) in enumerate(zip(_COLOURS, samples, strict=False)):
        counts, edges = np.histogram(values, bins=bins)
        heights = counts / max(counts.max(), 1)
        if number == 0:
            axes.stairs(heights, edges, color=colour, fill=True, alpha=0.45, lw=0.0)
        else:
            axes.stairs(heights, edges, color=colour, lw=0.9)


def _draw_scatter(axes: Axes, samples: Sequence[Float], column: int, row: int) -> None:
    """Draw two columns of up to three sets of samples (N, F) against each other."""
    for colour, values in zip(_COLOURS, samples, strict=False):
        axes.plot(
            values[:, column],
            values[:, row],
            ".",
            color=colour,
            ms=1.6,
            alpha=0.35,
            mew=0.0,
            rasterized=True,
        )


def _limits(samples: Sequence[Float]) -> tuple[float, float]:
    """Return the limits of an axis for several sets of samples (N,).

    Outliers of the first set are cut off; the other sets are shown completely.
    """
    first_set, *other_sets = samples
    low, high = np.quantile(first_set, [0.002, 0.998])
    for other_set in other_sets:
        low = min(low, np.min(other_set))
        high = max(high, np.max(other_set))
    margin = 0.06 * (high - low)
    if margin == 0.0:
        margin = 1e-3 * abs(high)
    return float(low - margin), float(high + margin)


@style.publication_style()
def readings_figure(result: Calibration) -> Figure:
    """Draw the prior and posterior of each measured quantity, with its reading."""
    readings = result.readings[:_MOST_READINGS]
    rows = math.ceil(len(readings) / _COLUMNS)
    height = 0.5 + 1.55 * rows
    figure, grid = style.panels(
        rows,
        _COLUMNS,
        height,
        0.1 * height,
        0.28 / rows * height,
        left=0.02,
        wspace=0.14,
        hspace=0.75,
    )
    for axes, reading in zip(style.keep_first_panels(grid, len(readings)), readings, strict=True):
        _draw_reading(axes, result, reading)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="upper left", ncols=3)
    return figure


def _draw_reading(axes: Axes, result: Calibration, reading: QuantityReading) -> None:
    """Draw the prior and posterior density of a quantity, with its reading."""
    prior = result.draws_of(reading.name, prior=True)
    posterior = result.draws_of(reading.name)
    value = reading.value
    half_width = HALF_WIDTH_95 * reading.deviation
    mean = float(posterior.mean())
    deviation = max(float(posterior.std()), 1e-6 * abs(mean))
    # the range shows the posterior and the reading; a positive quantity begins at zero
    low = min(mean - 4.5 * deviation, value - 1.6 * half_width)
    high = max(mean + 4.5 * deviation, value + 1.6 * half_width)
    if mean > 0.0:
        low = max(low, 0.0)
    grid = np.linspace(low, high, 301)
    axes.axvspan(
        value - half_width,
        value + half_width,
        color=style.OBSERVED,
        alpha=style.BAND_OPACITY,
        lw=0.0,
        label="measured, 95 %",
    )
    axes.axvline(value, color=style.OBSERVED, lw=0.9)
    # densities by Gaussian kernels; a posterior of one value only has none, and is a line
    prior_density = gaussian_kde(prior)(grid)
    highest_density = float(prior_density.max())
    if posterior.std() > 1e-9 * abs(mean):
        posterior_density = gaussian_kde(posterior)(grid)
        highest_density = float(posterior_density.max())
        style.band(axes, grid, np.zeros_like(grid), posterior_density, style.PAST)
        axes.plot(grid, posterior_density, color=style.PAST, lw=1.3, label="after the calibration")
    else:
        axes.axvline(mean, color=style.PAST, lw=1.3, label="after the calibration")
    axes.plot(grid, prior_density, color=style.REFERENCE, lw=1.2, ls="--", label="before")
    titles = {quantity.name: quantity.axis_title for quantity in result.all_quantities}
    axes.set(xlim=(grid[0], grid[-1]), ylim=(0.0, 1.12 * highest_density), yticks=[])
    axes.set_xlabel(titles[reading.name])
    axes.spines["left"].set_visible(False)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.ticklabel_format(axis="x", useOffset=False)
