"""The style of all figures of the project, and their files as reproducible bytes.

Text is drawn as it is written, whatever characters a user's title holds; a text with mathematics
between dollar signs needs ``parse_math=True``.

Figures are made with `new_figure` or `panels` inside ``with publication_style():``, or in a
function under ``@publication_style()``. They never use pyplot, which would change global state.
Equal data give equal bytes: ids in SVG files follow from a fixed salt, dates and program names are
left out.
"""

import io
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, TypedDict, Unpack

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.axis import Axis, Tick
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colorizer import ColorizingArtist
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, LogFormatter, LogLocator, NullLocator
from numpy.typing import ArrayLike

from reporting.errors import InvalidFigureError
from reporting.files import atomic_write_bytes
from reporting.pages.hover import annotated
from reporting.pages.page import PageFigure, ReportFigure
from reporting.pages.tiles import tiles_of_figure

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

# Okabe and Ito's palette for colour-blind readers; each colour has one meaning in all figures.
OBSERVED: Final = "#595959"
"""Measurements (small grey dots)."""
PAST: Final = "#0072B2"
"""Estimates of past steps, given all observations (blue, full line)."""
PRESENT: Final = "#009E73"
"""The estimate of the present step, or the running filtered estimate (green, diamond)."""
PREDICTION: Final = "#D55E00"
"""Predicted steps (vermilion, dashed or open marks)."""
TRUTH: Final = "#000000"
"""The true state (black, thin dash-dot line), which the twin does not know."""
DECISION: Final = "#CC79A7"
"""Controls and policies (purple)."""
REFERENCE: Final = "#999999"
"""Limits and reference lines (light grey)."""


class ColorScale(TypedDict, total=False):
    """Colours of values: the colour map, and the values at its ends."""

    cmap: str | Colormap
    vmin: float
    vmax: float


class MarkStyle(TypedDict, total=False):
    """The look of marks, as arguments of `Axes.plot`."""

    color: str
    marker: str
    markersize: float
    markerfacecolor: str
    markeredgecolor: str
    markeredgewidth: float


class LineStyle(MarkStyle, total=False):
    """The look of a line and its marks, as arguments of `Axes.plot`."""

    linewidth: float
    linestyle: str | tuple[float, Sequence[float]]


class IntervalStyle(MarkStyle, total=False):
    """The look of a mean with its interval, as arguments of `Axes.errorbar`."""

    capsize: float
    elinewidth: float


class SwatchStyle(TypedDict, total=False):
    """The look of a patch of a legend, as arguments of `Rectangle`."""

    edgecolor: str
    linewidth: float


class GridMargins(TypedDict, total=False):
    """Margins of a figure, and gaps between its panels, as fractions."""

    left: float
    right: float
    wspace: float
    hspace: float


class ColorBarShape(TypedDict, total=False):
    """The shape of a scale of colours, as arguments of `Figure.colorbar`."""

    pad: float
    fraction: float
    aspect: float
    extend: Literal["neither", "both", "min", "max"]


LEVELS: Final = "cividis"
"""Colour map of magnitudes: perceptually even and safe for colour-blind readers."""

RESIDUALS: Final[ColorScale] = {"cmap": "PuOr_r", "vmin": -4.0, "vmax": 4.0}
"""Colours of a map of residuals, in standard deviations."""

BAND_OPACITY: Final = 0.22
TRUTH_LINE: Final[LineStyle] = {
    "color": TRUTH,
    "linewidth": 1.0,
    "linestyle": (0, (4, 1.5, 1, 1.5)),
}
"""The line of the true state."""
FULL_WIDTH: Final = 7.2
"""Width of a figure over two columns of a journal, in inches."""
PNG_RESOLUTION: Final = 200.0

_STYLE: Final["dict[RcKeyType, object]"] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 5.0,
    "axes.labelsize": 8.0,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,  # a number beside an axis is the value itself
    "axes.grid": False,
    "axes.unicode_minus": True,
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.6,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "xtick.major.size": 3.0,
    "ytick.major.size": 3.0,
    "lines.linewidth": 1.5,
    "lines.markersize": 4.0,
    "patch.linewidth": 0.7,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "legend.handlelength": 1.9,
    "legend.columnspacing": 1.4,
    "figure.facecolor": "white",
    "axes.facecolor": "white",
    "savefig.facecolor": "white",
    "figure.dpi": 100.0,
    "mathtext.fontset": "dejavusans",
    "svg.fonttype": "path",
    "svg.hashsalt": "uav-twin",
    "svg.image_inline": True,
    "path.simplify": True,
    "text.usetex": False,
    "text.parse_math": False,  # a title may hold a dollar sign
}


@contextmanager
def publication_style() -> Iterator[None]:
    """Return a context with matplotlib's settings for figures of the project.

    The user's own settings have no effect in it, and are restored at its end.
    """
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_STYLE)
        yield


def new_figure(height: float, width: float = FULL_WIDTH) -> Figure:
    """Return an empty figure that is drawn by Agg and that pyplot does not keep.

    Parameters
    ----------
    height, width : float
        The size [in].

    Raises
    ------
    InvalidFigureError
        If the size is not positive.
    """
    if not (height > 0.0 and width > 0.0):
        raise InvalidFigureError(
            f"A figure needs a positive size in inches, not {width} by {height}."
        )
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    return figure


def panels(
    rows: int, columns: int, height: float, top: float, bottom: float, **grid: Unpack[GridMargins]
) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure and its panels, row by row.

    Parameters
    ----------
    rows, columns : int
        The number of rows and columns of panels.
    height : float
        The height of the figure [in].
    top, bottom : float
        The margins above and below the panels [in].
    **grid : GridMargins
        Margins left and right, and gaps between the panels, as fractions.
    """
    figure = new_figure(height)
    margins = {"top": 1.0 - top / height, "bottom": bottom / height, "left": 0.085, "right": 0.985}
    cells = figure.add_gridspec(rows, columns, **{**margins, **grid})
    grid_of_axes = []
    for row in range(rows):
        grid_of_axes.append([figure.add_subplot(cells[row, column]) for column in range(columns)])
    return figure, grid_of_axes


def keep_first_panels(grid_of_axes: list[list[Axes]], count: int) -> list[Axes]:
    """Return the first `count` panels, row by row, and remove the others from their figure."""
    panels_in_order = list(chain.from_iterable(grid_of_axes))
    for axes in panels_in_order[count:]:
        axes.remove()
    return panels_in_order[:count]


def plain_powers(axis: Axis, multiples: tuple[float, ...]) -> None:
    """Label a logarithmic axis with plain numbers.

    Parameters
    ----------
    multiples : tuple of float
        The multiples of powers of ten that are labelled, such as (1, 2, 5).
    """
    axis.set_major_locator(LogLocator(10.0, multiples))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def band(axes: Axes, x: ArrayLike, low: ArrayLike, high: ArrayLike, color: str) -> None:
    """Draw the band between two lines, each an (N,) array, at x, an (N,) array."""
    axes.fill_between(x, low, high, color=color, alpha=BAND_OPACITY, linewidth=0)


def interval(
    axes: Axes,
    x: float,
    mean: float,
    low: float,
    high: float,
    *,
    label: str | None = None,
    zorder: float = 2.0,
    **style: Unpack[IntervalStyle],
) -> None:
    """Draw a mean with its interval.

    Parameters
    ----------
    x : float
        The horizontal coordinate.
    mean, low, high : float
        The mean and the ends of its interval. By rounding the mean may lie just outside.
    label : str, optional
        The text in the legend.
    zorder : float
        The order of drawing; what has a higher number covers it.
    **style : IntervalStyle
        The look of the mark, as arguments of `Axes.errorbar`.
    """
    lengths = [[max(mean - low, 0.0)], [max(high - mean, 0.0)]]
    axes.errorbar([x], [mean], yerr=lengths, linestyle="none", label=label, zorder=zorder, **style)


def swatches(
    names: Sequence[str], colors: Sequence[str], **style: Unpack[SwatchStyle]
) -> list[Rectangle]:
    """Return the patches that a legend shows for named colours.

    Parameters
    ----------
    names, colors : sequence of str
        The names and their colours.
    **style : SwatchStyle
        The look of the patches, as arguments of `Rectangle`.
    """
    return [
        Rectangle((0, 0), 1, 1, facecolor=color, label=name, **style)
        for name, color in zip(names, colors, strict=True)
    ]


def shared_legend(
    figure: Figure, rows: int = 1, bbox_to_anchor: tuple[float, float] = (0.53, 1.0)
) -> None:
    """Draw one legend above all panels of a figure; equal labels appear once.

    Parameters
    ----------
    rows : int
        The number of rows of the legend.
    bbox_to_anchor : (float, float)
        The middle of the legend's upper edge, as fractions of the figure.
    """
    handle_of_label = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handle_of_label[label] = handle
    figure.legend(
        list(handle_of_label.values()),
        list(handle_of_label),
        ncols=math.ceil(len(handle_of_label) / rows),
        loc="upper center",
        bbox_to_anchor=bbox_to_anchor,
    )


def color_bar(
    figure: Figure,
    artist: ScalarMappable | ColorizingArtist,
    label: str,
    *,
    ax: Axes | Sequence[Axes] | None = None,
    cax: Axes | None = None,
    location: Literal["left", "right", "top", "bottom"] | None = None,
    **shape: Unpack[ColorBarShape],
) -> Axes:
    """Draw the colour bar of an artist, and return the panel of the bar.

    Parameters
    ----------
    artist : ScalarMappable or ColorizingArtist
        The map or the points whose colours stand for values.
    label : str
        The quantity and its unit.
    ax : Axes or sequence of Axes, optional
        The panels that are made smaller to give the bar room, if it has no panel of its own.
    cax : Axes, optional
        The panel in which the bar is drawn.
    location : str, optional
        The side of the panels on which the bar is drawn; the right by default.
    **shape : ColorBarShape
        Gap, size and ends of the bar.
    """
    bar = figure.colorbar(artist, ax=ax, cax=cax, location=location, **shape)
    bar.set_label(label)
    bar.outline.set_linewidth(0.5)
    return bar.ax


def panel_label(axes: Axes, label: str, title: str = "") -> None:
    """Put a panel's letter and short title above its upper left corner.

    Parameters
    ----------
    label : str
        Its letter, such as ``a``.
    title : str
        A few words after the letter.
    """
    stated_texts = [text for text in (label, title) if text]
    axes.set_title("  ".join(stated_texts), loc="left")


def to_svg(figure: Figure) -> bytes:
    """Return a figure as SVG, with texts as outlines and with the values that the pointer shows.

    The file has neither a date nor a document type. Its attribute ``data-tiles`` has the view boxes
    of the tiles that a narrow page shows below one another.
    """
    buffer = io.BytesIO()
    with publication_style():
        _parse_tick_labels_of_powers(figure)
        # Lays out the panels, which the drawing of the file then leaves where they are.
        view_boxes = ", ".join(tile.view_box for tile in tiles_of_figure(figure))
        with _fixed_layout(figure), annotated(figure) as annotate:
            # Matplotlib leaves out the block of metadata only if all four are None.
            figure.savefig(
                buffer,
                format="svg",
                dpi=PNG_RESOLUTION,  # of the parts that are rasterised
                metadata={"Date": None, "Creator": None, "Format": None, "Type": None},
            )
            text = annotate(buffer.getvalue().decode("utf-8"))
    text = text.replace("<svg ", f'<svg data-tiles="{view_boxes}" ', 1)
    text = re.sub(r"<!DOCTYPE[^>]*>\s*", "", text, count=1)
    return text.encode("utf-8")


def to_png(figure: Figure, resolution: float = PNG_RESOLUTION) -> bytes:
    """Return a figure as PNG without the name of the program.

    Parameters
    ----------
    resolution : float
        The resolution in dots per inch.
    """
    buffer = io.BytesIO()
    with publication_style():
        _parse_tick_labels_of_powers(figure)
        figure.savefig(buffer, format="png", dpi=resolution, metadata={"Software": None})
    return buffer.getvalue()


def write_picture(path: Path, figure: Figure) -> None:
    """Write a figure as PNG if the file ends in ".png", else as SVG."""
    picture = to_png(figure) if path.suffix.lower() == ".png" else to_svg(figure)
    atomic_write_bytes(path, picture)


def page_figure(figure: ReportFigure) -> PageFigure:
    """Return a figure rendered for a page."""
    return PageFigure(figure.name, to_svg(figure.figure), figure.title, figure.caption)


def save_figure(figure: ReportFigure, folder: Path, *, png: bool = True) -> PageFigure:
    """Write a figure as SVG, and as PNG unless `png` is False, and return it for a page.

    Raises
    ------
    FileNotWrittenError
        If a file cannot be written.
    """
    drawn = page_figure(figure)
    atomic_write_bytes(folder / f"{figure.name}.svg", drawn.svg)
    if png:
        with _fixed_layout(figure.figure):  # that of the SVG
            atomic_write_bytes(folder / f"{figure.name}.png", to_png(figure.figure))
    return drawn


@contextmanager
def _fixed_layout(figure: Figure) -> Iterator[None]:
    """Keep the panels of a figure where they are within the context.

    Matplotlib would draw everything once more for each file, only to lay the panels out anew.
    """
    engine = figure.get_layout_engine()
    with publication_style():  # which asks for no engine
        figure.set_layout_engine(None)
    try:
        yield
    finally:
        if engine is not None:
            figure.set_layout_engine(engine)


def _parse_tick_labels_of_powers(figure: Figure) -> None:
    """Let tick labels of logarithmic axes be parsed as mathematics, as in "$10^3$".

    The style of the project turns this off for all other texts.
    """
    ticks: list[Tick] = []
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            if isinstance(axis.get_major_formatter(), LogFormatter):
                ticks += axis.get_major_ticks(len(axis.get_majorticklocs()))
            if isinstance(axis.get_minor_formatter(), LogFormatter):
                ticks += axis.get_minor_ticks(len(axis.get_minorticklocs()))
    for tick in ticks:
        tick.label1.set_parse_math(True)
        tick.label2.set_parse_math(True)
