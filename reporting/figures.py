"""One publication style for every figure of the project, and reproducible bytes from a figure.

Text is drawn as it is written, whatever signs a user's title holds; a text with mathematics between dollar
signs is given ``parse_math=True``.

Figures are made with `new_figure` or `panels` inside ``with publication_style():``, or in a function under
``@publication_style()``, and never through pyplot, so that nothing global is left behind. Equal data give
equal bytes: ids are salted, dates and program names left out.
"""

import html
import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, LogFormatter, LogLocator, NullLocator
from numpy.typing import ArrayLike

from reporting.errors import InvalidFigureError
from reporting.files import atomic_write_bytes
from reporting.hover import annotated

# Okabe and Ito's palette for colour-blind readers; each colour has one meaning everywhere.
OBSERVED: Final = "#595959"
"""Measurements (small grey dots)."""
PAST: Final = "#0072B2"
"""Estimates of past steps, given all observations (blue, full line)."""
PRESENT: Final = "#009E73"
"""The estimate of the present step, or the running filtered estimate (green, diamond)."""
PREDICTION: Final = "#D55E00"
"""Predicted steps (vermilion, dashed or open marks)."""
TRUTH: Final = "#000000"
"""What is really so (black, thin dash-dot line); the twin does not know it."""
DECISION: Final = "#CC79A7"
"""Controls and policies (purple)."""
REFERENCE: Final = "#999999"
"""Limits, reference lines and other things to read against (light grey)."""
LEVELS: Final = "cividis"
"""Colour map of magnitudes: perceptually even and safe for colour-blind readers."""

RESIDUALS: Final[dict[str, Any]] = {"cmap": "PuOr_r", "vmin": -4.0, "vmax": 4.0}
"""How residuals are drawn, in standard deviations."""

BAND_OPACITY: Final = 0.22
TRUTH_LINE: Final[dict[str, Any]] = {"color": TRUTH, "linewidth": 1.0, "linestyle": (0, (4, 1.5, 1, 1.5))}
"""How a truth is drawn."""
FULL_WIDTH: Final = 7.2
"""Width of a figure over two columns of a journal, in inches."""
PNG_RESOLUTION: Final = 200.0

_STYLE: Final[dict[Any, Any]] = {
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
    "axes.formatter.useoffset": False,  # a number beside an axis is what is there
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
    "text.parse_math": False,  # a title may hold any sign; a text that is mathematics says so itself
}


@contextmanager
def publication_style() -> Iterator[None]:
    """Draw in the style of the project whatever the user's own settings are, and restore these after."""
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_STYLE)
        yield


def new_figure(height: float, width: float = FULL_WIDTH) -> Figure:
    """Return an empty figure of the given size in inches, drawn by Agg and unknown to pyplot.

    Raises
    ------
    InvalidFigureError
        A size is not positive.
    """
    if not (height > 0.0 and width > 0.0):
        raise InvalidFigureError(f"A figure needs a positive size in inches, not {width} by {height}.")
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    return figure


def panels(
    rows: int, columns: int, height: float, top: float, bottom: float, **grid: Any
) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure of a height [in] and its panels, row by row.

    Parameters
    ----------
    rows, columns, height
        How many panels, and the height of the figure [in].
    top, bottom
        Room above and below the panels [in].
    **grid
        What `Figure.add_gridspec` takes, in shares of the figure.
    """
    figure = new_figure(height)
    room = {"top": 1.0 - top / height, "bottom": bottom / height, "left": 0.085, "right": 0.985}
    cells = figure.add_gridspec(rows, columns, **{**room, **grid})
    return figure, [[figure.add_subplot(cells[row, n]) for n in range(columns)] for row in range(rows)]


def first_of(grid: list[list[Axes]], count: int) -> list[Axes]:
    """Return the first panels, row by row; the others are taken away."""
    every = [axes for row in grid for axes in row]
    for spare in every[count:]:
        spare.remove()
    return every[:count]


def plain_powers(axis: Axis, parts: tuple[float, ...]) -> None:
    """Label a logarithmic axis with plain numbers at parts of its decades."""
    axis.set_major_locator(LogLocator(10.0, parts))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def band(axes: Axes, x: ArrayLike, low: ArrayLike, high: ArrayLike, color: str) -> None:
    """Draw the band between two lines (n,)."""
    axes.fill_between(x, low, high, color=color, alpha=BAND_OPACITY, linewidth=0)


def interval(axes: Axes, place: float, mean: float, low: float, high: float, **look: Any) -> None:
    """Draw a mean with its interval, which holds it but for rounding."""
    ends = [[max(mean - low, 0.0)], [max(high - mean, 0.0)]]
    axes.errorbar([place], [mean], yerr=ends, linestyle="none", **look)


def swatches(names: Sequence[str], colors: Sequence[str], **look: Any) -> list[Rectangle]:
    """Return what a legend shows of named colours."""
    named = zip(names, colors, strict=True)
    return [Rectangle((0, 0), 1, 1, facecolor=color, label=name, **look) for name, color in named]


def shared_legend(figure: Figure, rows: int = 1, **place: Any) -> None:
    """Name above the panels, in some rows, what is drawn with a label in any of them."""
    pairs = (pair for axes in figure.axes for pair in zip(*axes.get_legend_handles_labels(), strict=True))
    named = {label: handle for handle, label in pairs}
    place = {"loc": "upper center", "bbox_to_anchor": (0.53, 1.0), **place}
    figure.legend(named.values(), named.keys(), ncols=-(-len(named) // rows), **place)


def color_bar(figure: Figure, drawn: Any, label: str, **place: Any) -> Axes:
    """Draw the scale of colours of what was drawn; `place` is `ax`, beside a panel, or `cax`, in one."""
    bar = figure.colorbar(drawn, **place)
    bar.set_label(label)
    bar.outline.set_linewidth(0.5)
    return bar.ax


def panel_label(axes: Axes, label: str, title: str = "") -> None:
    """Put a panel's letter and short title above its upper left corner.

    Parameters
    ----------
    axes
        The panel.
    label
        Its letter, such as ``a``.
    title
        A few words beside the letter.
    """
    axes.set_title("  ".join(part for part in (label, title) if part), loc="left")


def to_svg(figure: Figure) -> bytes:
    """Return the figure as SVG: text as outlines, values for the reader's pointer, no date, no DTD."""
    buffer = io.BytesIO()
    with publication_style():
        _read_powers(figure)
        with annotated(figure) as annotate:
            # All four must be left out for the block of metadata, with its addresses, to vanish.
            figure.savefig(
                buffer,
                format="svg",
                dpi=PNG_RESOLUTION,  # of what is rasterised in it
                metadata={"Date": None, "Creator": None, "Format": None, "Type": None},
            )
        text = annotate(buffer.getvalue().decode("utf-8"))
    text = re.sub(r"<!DOCTYPE[^>]*>\s*", "", text, count=1)
    return text.encode("utf-8")


def to_png(figure: Figure, resolution: float = PNG_RESOLUTION) -> bytes:
    """Return the figure as PNG at `resolution` dots per inch, without program name."""
    buffer = io.BytesIO()
    with publication_style():
        _read_powers(figure)
        figure.savefig(buffer, format="png", dpi=resolution, metadata={"Software": None})
    return buffer.getvalue()


def save_figure(figure: Figure, folder: Path, name: str) -> bytes:
    """Write `name` as SVG and as PNG to a folder; return the SVG.

    Raises
    ------
    FileNotWrittenError
        If a file cannot be written.
    """
    drawing = to_svg(figure)
    atomic_write_bytes(folder / f"{name}.svg", drawing)
    atomic_write_bytes(folder / f"{name}.png", to_png(figure))
    return drawing


def _read_powers(figure: Figure) -> None:
    """Let logarithmic axes show the powers of ten that matplotlib writes as mathematics."""
    for axis in (axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)):
        for formatter, ticks, places in (
            (axis.get_major_formatter(), axis.get_major_ticks, axis.get_majorticklocs()),
            (axis.get_minor_formatter(), axis.get_minor_ticks, axis.get_minorticklocs()),
        ):
            if isinstance(formatter, LogFormatter):
                for tick in ticks(len(places)):
                    tick.label1.set_parse_math(True)
                    tick.label2.set_parse_math(True)


_IDENTIFIER = re.compile(r'\bid="([^"]+)"')
_REFERENCE = re.compile(r'(href="#|url\(#)([^")]+)')


def inline_svg(svg: bytes, prefix: str, description: str) -> str:
    """Return an SVG ready to stand inside an HTML page.

    The XML heading goes, every id and every reference to one get `prefix` (ids must be unique in a page), the
    size follows the page, and a description is there for those who cannot see it.

    Raises
    ------
    InvalidFigureError
        The bytes are not an SVG.
    """
    text = svg.decode("utf-8", errors="replace")
    start = text.find("<svg")
    end = text.find(">", start)
    if start < 0 or end < 0:
        raise InvalidFigureError("A figure for a page must be an SVG; the bytes given have no <svg> element.")
    opening, body = text[start:end], text[end:].rstrip()
    view_box = re.search(r'viewBox="([^"]+)"', opening)
    if view_box is None:
        raise InvalidFigureError("A figure for a page must have a viewBox, or it could not be scaled.")
    body = _IDENTIFIER.sub(rf'id="{prefix}-\1"', body)
    body = _REFERENCE.sub(rf"\1{prefix}-\2", body)
    # Inside HTML the parser knows the namespaces; `href` without the xlink prefix is the current standard.
    body = body.replace("xlink:href=", "href=")
    return f'<svg viewBox="{view_box.group(1)}" role="img" aria-label="{html.escape(description)}"{body}'
