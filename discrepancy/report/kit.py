"""What figures have in common: panels, the two models, maps of sizes."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from numpy.typing import NDArray

from discrepancy.campaign.records import FloatArray
from discrepancy.location.residuals import ResidualSet
from reporting.figures import LEVELS, PAST, PREDICTION, REFERENCE, color_bar, new_figure

AFTER = "with the effect"
EMPTY = "#f0f1f2"
"""Colour of cells of a map that hold nothing."""


class Shown(NamedTuple):
    """Residuals of a model, and how it is drawn."""

    residuals: ResidualSet
    colour: str
    dashes: str
    marker: str
    label: str
    title: str


def models(before: ResidualSet, after: ResidualSet | None) -> list[Shown]:
    """Return the model as it was and, where there is one, with the effect."""
    if after is None:
        return [Shown(before, PREDICTION, "--", "o", "model", "model as it is")]
    return [
        Shown(before, PREDICTION, "--", "o", "model as it was", "a  model as it was"),
        Shown(after, PAST, "-", "D", AFTER, f"b  {AFTER}"),
    ]


def panels(rows: int, columns: int, height: float, **grid: Any) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure of a height [in] and its panels; `grid` as of `matplotlib.figure.Figure.subplots`."""
    figure = new_figure(height)
    figure.set_layout_engine("constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **grid).tolist()


def draw_noise(axes: Axes, deviation: float, opacity: float) -> None:
    """Draw the band of two deviations of the noise."""
    axes.axhspan(
        -2.0 * deviation, 2.0 * deviation, color=REFERENCE, alpha=opacity, lw=0.0, label="noise, ± 2 s0"
    )


def plain_powers(axis: Axis, parts: tuple[float, ...]) -> None:
    """Label a logarithmic axis with plain numbers at parts of its decades."""
    axis.set_major_locator(LogLocator(10.0, parts))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def scale_of(values: Sequence[float] | FloatArray) -> Normalize:
    """Return the colour scale of sizes of residuals: logarithmic, with 1 (noise) near its dark end."""
    found = np.asarray(values, dtype=float)
    largest = float(np.nanmax(found, initial=1.0))
    return LogNorm(0.7, max(largest, 3.0))


def size_bar(figure: Figure, norm: Normalize, beside: Sequence[Axes]) -> None:
    """Draw the colour scale of sizes of residuals beside panels."""
    place = {"ax": beside, "fraction": 0.045, "pad": 0.02, "aspect": 14}
    bar = color_bar(figure, ScalarMappable(norm, LEVELS), "rms residual / noise", **place)
    plain_powers(bar.yaxis, (1.0, 2.0, 5.0) if float(norm.vmax or 1.0) < 50.0 else (1.0,))


def heat_map(
    axes: Axes,
    values: FloatArray,
    names: tuple[Iterable[str], Iterable[str]],
    norm: Normalize,
    slant: float,
    texts: NDArray[Any] | None = None,
) -> AxesImage:
    """Draw values (R, C), nan where a cell is empty, with names of rows and columns, and what cells say."""
    image = axes.imshow(np.ma.masked_invalid(values), cmap=LEVELS, norm=norm, aspect="auto")
    rows, columns = map(list, names)
    axes.set_xticks(range(len(columns)), columns, rotation=slant, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(rows)), rows)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.set_facecolor(EMPTY)
    for (row, column), text in np.ndenumerate([] if texts is None else texts):
        if text:
            dark = float(norm(values[row, column])) < 0.6
            colour = "white" if dark else "black"
            axes.text(column, row, text, ha="center", va="center", fontsize=6.0, color=colour)
    return image
