"""Why this name: what the campaign separates, calibration of predictions and workflow."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from discrepancy.judgement.separability import CONFUSED, DETECTED, Separability
from discrepancy.report.kit import heat_map, panels, plain_powers
from discrepancy.self_calibration import SelfCalibration
from discrepancy.verdict import Scores
from reporting.figures import OBSERVED, PAST, PREDICTION, publication_style

_LARGEST_DISTANCE = 1e4


def pit_figure(scores: Mapping[str, Scores]) -> Figure:
    """Draw histograms of probability integral transforms; keys are titles, in order before and after."""
    with publication_style():
        figure, (row,) = panels(1, 2, 1.9)
        for spare in row[len(scores) :]:
            spare.remove()
        top = max(max(item.pit) for item in scores.values())
        for number, (axes, (title, item)) in enumerate(zip(row, scores.items(), strict=False)):
            count = len(item.pit)
            axes.bar(
                (np.arange(count) + 0.5) / count, item.pit, 0.94 / count,
                color=PREDICTION if number == 0 and len(scores) > 1 else PAST, alpha=0.75,
            )  # fmt: skip
            axes.axhline(1.0 / count, color=OBSERVED, lw=0.9, ls="--")
            axes.set_ylim(0.0, 1.1 * max(top, 0.16))
            axes.set_xlim(0.0, 1.0)
            axes.yaxis.set_major_locator(MaxNLocator(4))
            axes.set_xlabel("probability integral transform")
            axes.set_ylabel("share of samples" if number == 0 else "")
            axes.set_title(f"{'ab'[number]}  {title}" if len(scores) > 1 else title, loc="left")
    return figure


def _map_of_names(
    values: NDArray[np.float64], rows: Sequence[str], columns: Sequence[str], norm: Normalize,
    texts: NDArray[np.str_] | None = None,
) -> tuple[Figure, Axes, AxesImage]:  # fmt: skip
    """Return a figure with a map of square cells between names of effects."""
    figure, ((axes,),) = panels(1, 1, 0.175 * len(rows) + 1.6)
    words = ([name.replace("_", " ") for name in names] for names in (rows, columns))
    image = heat_map(axes, values, (next(words), next(words)), norm, 55, texts)
    axes.set_aspect("equal", anchor="W")
    axes.tick_params(labelsize=6.5)
    return figure, axes, image


def separability_figure(found: Separability) -> Figure | None:
    """Draw how well each effect can be told from each other one; None with fewer than two effects."""
    names = found.identifiers
    if len(names) < 2:
        return None
    # Members of a confusion group stand side by side.
    number = {name: at for at, group in reversed([*enumerate(found.groups)]) for name in group}
    order = sorted(range(len(names)), key=lambda n: (number.get(names[n], len(found.groups)), n))
    distance = found.distance[np.ix_(order, order)]
    table = np.clip(distance, 0.3, _LARGEST_DISTANCE)
    np.fill_diagonal(table, np.nan)
    labels = [names[n] for n in order]
    with publication_style():
        figure, axes, image = _map_of_names(table, labels, labels, LogNorm(1.0, _LARGEST_DISTANCE))
        for row, column in zip(*np.nonzero(distance < CONFUSED), strict=True):
            if row != column:
                axes.plot(column, row, "x", color=PREDICTION, ms=4.0, mew=1.1)
        cell = 1.0 / len(names)
        bar = figure.colorbar(image, cax=axes.inset_axes((1.0 + 0.4 * cell, 0.0, 0.4 * cell, 1.0)))
        bar.set_label("squared distance d²")
        plain_powers(bar.ax.yaxis, (1.0,))
        bar.outline.set_linewidth(0.5)
        bar.ax.axhline(CONFUSED, color=PREDICTION, lw=1.2)
        bar.ax.axhline(DETECTED, color="white", lw=1.2)
    return figure


def confusion_figure(found: SelfCalibration) -> Figure:
    """Draw the confusion matrix of the workflow on simulated campaigns of this geometry."""
    rows, columns, counts = found.confusion()
    share = np.where(counts > 0, counts / np.maximum(counts.sum(axis=1, keepdims=True), 1), np.nan)
    texts = np.where(counts > 0, counts.astype(str), "")
    with publication_style():
        figure, axes, _ = _map_of_names(share, rows, columns, Normalize(0.0, 1.0), texts)
        axes.set_ylabel("what was hidden")
        axes.set_xlabel("verdict")
    return figure
