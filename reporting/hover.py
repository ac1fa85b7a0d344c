"""What a reader of a page sees under the pointer: values of lines, points and maps, their names and units.

An SVG of matplotlib has every point of a line already. What it lacks are the scales of the panels and the
names of the lines; `annotated` adds these as attributes, and the script of a page (`hover.js`) reads both.
"""

import html
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import FillBetweenPolyCollection, PathCollection, QuadMesh
from matplotlib.colors import to_hex
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D

from reporting.table_file import is_number

_POINTS_PER_INCH = 72.0
_MOST_CELLS = 5000
"""Cells of a map whose values a page holds."""
_FEW_COLOURS = 20
"""So few colours stand for names, such as those of controls, and not for values."""
_Look = tuple[str, str, str]


@contextmanager
def annotated(figure: Figure) -> Iterator[Callable[[str], str]]:
    """Let a figure be drawn as SVG inside, and yield what adds the attributes to it.

    Panels get ``data-axes`` (box in units of the SVG; limits, scale, name and texts of either axis),
    lines and scatters ``data-series`` (name, colour), bands and error bars ``data-spread`` (colour).
    """
    names = _names(figure)
    marked: list[tuple[Artist, str, str]] = []
    for axes in figure.axes:
        if {axes.get_xscale(), axes.get_yscale()} <= {"linear", "log"}:
            found = list(_marked(axes, names))
            if any(attribute == "data-series" for _, attribute, _ in found) or _maps(axes):
                marked += [*found, (axes, "data-axes", "")]
    marked = [entry for entry in marked if entry[0].get_gid() is None]
    for number, (artist, _, _) in enumerate(marked):
        artist.set_gid(f"hover-{number}-")

    def annotate(svg: str) -> str:
        for number, (artist, attribute, value) in enumerate(marked):
            text = json.dumps(_frame(artist), ensure_ascii=False) if isinstance(artist, Axes) else value
            svg = svg.replace(f'id="hover-{number}-"', f'{attribute}="{html.escape(text)}"', 1)
        return svg

    try:
        yield annotate
    finally:
        for artist, _, _ in marked:
            artist.set_gid(None)


def _marked(axes: Axes, names: dict[_Look, str]) -> Iterator[tuple[Artist, str, str]]:
    """Yield what is read from a panel: the artist, its attribute and the value of this."""
    caps: list[Artist] = []
    titles: dict[Artist, str] = {}
    for container in axes.containers:
        if isinstance(container, ErrorbarContainer):
            line, ends, spans = container.lines
            caps += ends
            if line is not None:
                titles[line] = str(container.get_label())
            for span in spans:
                yield span, "data-spread", to_hex(np.asarray(span.get_colors())[0])
    for artist in (*axes.lines, *axes.collections):
        if isinstance(artist, FillBetweenPolyCollection):
            yield artist, "data-spread", to_hex(np.asarray(artist.get_facecolor())[0])
        elif isinstance(artist, Line2D | PathCollection) and artist not in caps:
            own = artist.get_transform() if isinstance(artist, Line2D) else artist.get_offset_transform()
            if own == axes.transData:  # else a line that marks one coordinate only, such as a limit
                look = _look(artist)
                name = _public(titles.get(artist, str(artist.get_label()))) or names.get(look, "")
                yield artist, "data-series", json.dumps([name, look[0]], ensure_ascii=False)


def _names(figure: Figure) -> dict[_Look, str]:
    """Return what lines are called by legends, and else by other panels where they look the same."""
    found: dict[_Look, str] = {}
    for legend in (*figure.legends, *(axes.get_legend() for axes in figure.axes)):
        if legend is not None:
            for handle, text in zip(legend.legend_handles, legend.get_texts(), strict=True):
                if isinstance(handle, Line2D):
                    found.setdefault(_look(handle), text.get_text())
    for line in (line for axes in figure.axes for line in axes.lines):
        if _public(str(line.get_label())):
            found.setdefault(_look(line), str(line.get_label()))
    return found


def _public(label: str) -> str:
    return "" if label.startswith("_") else label


def _look(artist: Line2D | PathCollection) -> _Look:
    """Return colour, style and marker."""
    if isinstance(artist, PathCollection):
        return "", "", ""
    style, marker = artist.get_linestyle(), str(artist.get_marker())
    colour = artist.get_markeredgecolor() if style == "None" else artist.get_color()
    return to_hex(colour), str(style), marker


def _frame(axes: Axes) -> dict[str, Any]:
    """Return where a drawn panel is and what its axes mean."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    width, height = (_POINTS_PER_INCH * size for size in figure.get_size_inches())
    box = axes.get_position()
    place = [box.x0 * width, box.x1 * width, (1.0 - box.y0) * height, (1.0 - box.y1) * height]
    # One panel of a column names the horizontal axis of all, and one of a row the vertical axis.
    panels = [(other, other.get_position()) for other in (axes, *figure.axes)]
    column = [
        other.get_xlabel() for other, at in panels
        if other.get_xlim() == axes.get_xlim() and abs(at.x0 - box.x0) < 1e-6
    ]  # fmt: skip
    row = [
        other.get_ylabel() for other, at in panels
        if other.get_ylim() == axes.get_ylim() and abs(at.y0 - box.y0) < 1e-6
    ]  # fmt: skip
    return {
        "title": axes.get_title(loc="left") or axes.get_title(),
        "maps": _maps(axes),
        "box": [round(value, 3) for value in place],
        "x": _scale(axes.xaxis, axes.get_xlim(), axes.get_xscale(), next(filter(None, column), "")),
        "y": _scale(axes.yaxis, axes.get_ylim(), axes.get_yscale(), next(filter(None, row), "")),
    }


def _maps(axes: Axes) -> list[dict[str, Any]]:
    """Return the maps of a panel: edges of columns x and rows y, values with null where there is none."""
    figure, found = axes.get_figure(root=True), []
    if figure is None or _is_bar(axes) or {axes.get_xscale(), axes.get_yscale()} != {"linear"}:
        return []
    label = next((other.get_ylabel() for other in figure.axes if _is_bar(other)), "") or "value"
    for artist in (*axes.collections, *axes.images):
        if not isinstance(artist, QuadMesh | AxesImage) or artist.get_cmap().N < _FEW_COLOURS:
            continue
        values: Any = np.ma.masked_invalid(np.ma.asarray(artist.get_array()))
        if values.ndim != 2 or values.size > _MOST_CELLS:
            continue
        if isinstance(artist, QuadMesh):
            corners = np.asarray(artist.get_coordinates())
            x, y = corners[0, :, 0], corners[:, 0, 1]
        else:
            left, right, bottom, top = artist.get_extent()
            ends = (bottom, top) if artist.origin == "lower" else (top, bottom)
            x, y = np.linspace(left, right, values.shape[1] + 1), np.linspace(*ends, values.shape[0] + 1)
        rows = [[None if cell is None else float(f"{cell:.3g}") for cell in row] for row in values.tolist()]
        found.append({"x": x.tolist(), "y": y.tolist(), "values": rows, "name": label})
    return found


def _is_bar(axes: Axes) -> bool:
    """Whether a panel is the scale of colours beside a map."""
    return hasattr(axes, "_colorbar")


def _scale(axis: Axis, limits: tuple[float, float], kind: str, name: str) -> dict[str, Any]:
    """Return limits and name of an axis, and the texts that stand for places where they are no numbers."""
    found: dict[str, Any] = {
        "name": " ".join(name.split()),
        "limits": [float(f"{end:.9g}") for end in limits],
    }
    if kind == "log":
        found["log"] = True
        return found
    places = [float(place) for place in axis.get_majorticklocs()]
    texts = axis.get_major_formatter().format_ticks(places)
    if not name and not any(texts):
        found["unsaid"] = True
    if any(text and not is_number(text.replace("\N{MINUS SIGN}", "-")) for text in texts):
        found["texts"] = [[place, " ".join(text.split())] for place, text in zip(places, texts, strict=True)]
    return found
