"""Samples pair by pair, with their correlations."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from reporting.figures import OBSERVED, PAST, PRESENT, new_figure, publication_style

Float = NDArray[np.float64]

NOTICEABLE_CORRELATION = 0.3
"""From which a correlation is printed in colour."""


def corner_figure(
    titles: Sequence[str],
    samples: Float,
    others: Float | None,
    labels: tuple[str, str],
    *,
    math: bool = False,
) -> Figure:
    """Draw samples pair by pair, with their correlations, and others beside.

    Parameters
    ----------
    titles : sequence of str
        What each figure is, with its unit.
    samples : (N, F) array
        Samples, in the units of the titles.
    others : (M, F) array or None
        Samples of another distribution; histograms have a scale of their own.
    labels : (str, str)
        What samples and others are.
    math : bool
        Whether titles hold formulae.
    """
    correlation: Float = np.atleast_2d(np.corrcoef(samples, rowvar=False))
    size = len(titles)
    drawn = samples if others is None else others
    with publication_style():
        figure = new_figure(height=min(6.6, 2.2 + 1.1 * (size - 1)) if size < 5 else 6.6)
        grid = figure.add_gridspec(
            size, size, wspace=0.10, hspace=0.10, left=0.085, right=0.985,
            bottom=0.075 if size > 3 else 0.16, top=0.985,
        )  # fmt: skip
        limits = [_limits(samples[:, index], drawn[:, index]) for index in range(size)]
        for row in range(size):
            for column in range(size):
                axes = figure.add_subplot(grid[row, column])
                if column > row:
                    _draw_correlation(axes, float(correlation[row, column]))
                    continue
                if column == row:
                    _draw_marginal(
                        axes, samples[:, row], None if others is None else others[:, row], limits[row]
                    )
                else:
                    axes.plot(
                        samples[:, column], samples[:, row], ".", color=PAST, ms=1.6, alpha=0.35, mew=0.0,
                        rasterized=True,
                    )  # fmt: skip
                    if others is not None:
                        axes.plot(others[:, column], others[:, row], ".", color=PRESENT, ms=2.0, mew=0.0)
                    axes.set_ylim(limits[row])
                axes.set_xlim(limits[column])
                _outer_labels(axes, titles, row, column, math)
        shown = ((PAST, labels[0]),) if others is None else ((PAST, labels[0]), (PRESENT, labels[1]))
        handles = [
            Axes.plot(axes, [], [], "s", color=colour, ms=4.0, label=text)[0] for colour, text in shown
        ]
        figure.legend(handles=handles, loc="upper right", bbox_to_anchor=(0.985, 0.99))
    return figure


def _limits(samples: Float, others: Float) -> tuple[float, float]:
    low, high = np.quantile(samples, [0.002, 0.998])
    low, high = min(low, others.min()), max(high, others.max())
    margin = 0.06 * (high - low) or 1e-3 * abs(high)
    return float(low - margin), float(high + margin)


def _draw_marginal(axes: Axes, samples: Float, others: Float | None, limits: tuple[float, float]) -> None:
    edges = np.linspace(*limits, 31)
    axes.hist(samples, bins=edges.tolist(), density=True, color=PAST, alpha=0.45, lw=0.0)
    top = float(np.histogram(samples, bins=edges, density=True)[0].max())
    if others is not None:
        own, _ = np.histogram(others, bins=edges, density=True)
        if own.max() > 0.0:  # its own scale: one may have next to no width
            axes.stairs(own * top / own.max(), edges, color=PRESENT, lw=0.9)
    axes.set_ylim(0.0, 1.12 * top)


def _draw_correlation(axes: Axes, value: float) -> None:
    axes.set_axis_off()
    axes.text(
        0.5, 0.5, f"{value:+.2f}".replace("-", "−"), ha="center", va="center",
        transform=axes.transAxes, fontsize=6.5 + 5.0 * abs(value),
        color=PAST if abs(value) > NOTICEABLE_CORRELATION else OBSERVED,
    )  # fmt: skip


def _outer_labels(axes: Axes, titles: Sequence[str], row: int, column: int, math: bool) -> None:
    size = len(titles)
    axes.xaxis.set_major_locator(MaxNLocator(3, prune="both"))
    axes.yaxis.set_major_locator(MaxNLocator(3, prune="both"))
    axes.ticklabel_format(useOffset=False)
    axes.tick_params(labelsize=6.5)
    if row == size - 1:
        axes.set_xlabel(titles[column], parse_math=math)
    else:
        axes.set_xticklabels([])
    if column == 0 and row > 0:
        axes.set_ylabel(titles[row], parse_math=math)
    elif column != row and column > 0:
        axes.set_yticklabels([])
    if column == row:
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
