"""Values under the pointer in the figures of a page: of lines, points and maps, with units.

An SVG of matplotlib holds every point of a line already. It lacks the scales of the panels and the
names of the lines; `annotated` adds these as attributes, and the script of a page (`hover.js`)
reads both.
"""

import html
import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

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

from reporting.arrays import Float
from reporting.formats.table_file import is_number
from reporting.json_file import JsonObject

_POINTS_PER_INCH = 72.0
_MOST_CELLS = 5000
"""Largest map whose values a page holds, in cells."""
_FEW_COLOURS = 20
"""Number of colours below which a colour map is taken to stand for names, such as those of
controls, and not for values."""
_SAME_POSITION = 1e-6  # of two panels, as a fraction of the figure


class _LineLook(NamedTuple):
    """The colour, line style and marker of a line.

    Lines that agree in all three are taken to show the same quantity, also in several panels.
    """

    colour: str
    style: str
    marker: str


class _Annotation(NamedTuple):
    """An attribute that the element of an artist gets in the SVG.

    The value for a panel is not set here: its limits are known only after drawing.
    """

    artist: Artist
    attribute: str
    value: str = ""


@contextmanager
def annotated(figure: Figure) -> Iterator[Callable[[str], str]]:
    """Mark the artists of a figure while it is drawn as SVG, so that a page can show their values.

    The context yields a function that adds to the text of the SVG the attributes which the script
    of the page reads. It must be called inside the context, which marks the artists by group ids
    and removes these at its end.

    Panels get ``data-axes`` (box in units of the SVG; limits, scale, name and tick texts of both
    axes), lines and scatters ``data-series`` (name, colour), bands and error bars ``data-spread``
    (colour).

    Parameters
    ----------
    figure : Figure
        The figure to draw as SVG in the block.
    """
    annotations = _annotations(figure)
    # Matplotlib writes the group id of an artist into the SVG, where `annotate` replaces it.
    for number, annotation in enumerate(annotations):
        annotation.artist.set_gid(f"hover-{number}-")

    def annotate(svg: str) -> str:
        for number, (artist, attribute, value) in enumerate(annotations):
            text = value
            if isinstance(artist, Axes):  # the limits of a panel are known once it is drawn
                text = json.dumps(_panel_record(artist), ensure_ascii=False)
            replacement = f'{attribute}="{html.escape(text)}"'
            svg = svg.replace(f'id="hover-{number}-"', replacement, 1)
        return svg

    try:
        yield annotate
    finally:
        for annotation in annotations:
            annotation.artist.set_gid(None)


def _annotations(figure: Figure) -> list[_Annotation]:
    """Return the attributes from which the script of the page shows values in a figure.

    Each panel that shows lines, points or heat maps gets an attribute, and so does each line,
    scatter, band and error bar in it. Left out are

    - panels with an axis that is neither linear nor logarithmic: the script cannot convert a
      position of the pointer into a value there;
    - artists that have a group id already, because `annotated` would overwrite it.
    """
    line_names = _line_names(figure)
    annotations: list[_Annotation] = []
    for panel in figure.axes:
        axis_scales = {panel.get_xscale(), panel.get_yscale()}
        if not axis_scales <= {"linear", "log"}:
            continue
        inner_annotations = [*_error_bar_annotations(panel), *_data_annotations(panel, line_names)]
        has_series = any(annotation.attribute == "data-series" for annotation in inner_annotations)
        if has_series or _map_records(panel):
            annotations += [*inner_annotations, _Annotation(panel, "data-axes")]
    return [annotation for annotation in annotations if annotation.artist.get_gid() is None]


def _error_bar_annotations(axes: Axes) -> Iterator[_Annotation]:
    """Yield the annotations of the bars of all error bars in a panel, with their colours."""
    for container in axes.containers:
        if isinstance(container, ErrorbarContainer):
            _, _, bars = container.lines
            for bar in bars:
                yield _Annotation(bar, "data-spread", to_hex(np.asarray(bar.get_colors())[0]))


def _data_annotations(panel: Axes, line_names: dict[_LineLook, str]) -> Iterator[_Annotation]:
    """Yield the annotations of the bands, lines and scatters of a panel.

    Left out are the caps of error bars, and lines such as a limit across the panel, of which only
    one coordinate is data.

    Parameters
    ----------
    panel : Axes
        The panel whose artists are annotated.
    line_names : dict of _LineLook to str
        The names of lines without a label of their own, by colour, line style and marker.
    """
    error_bar_caps: list[Artist] = []
    error_bar_names: dict[Artist, str] = {}
    for container in panel.containers:
        if isinstance(container, ErrorbarContainer):
            data_line, cap_lines, _ = container.lines
            error_bar_caps += cap_lines
            if data_line is not None:
                error_bar_names[data_line] = str(container.get_label())
    for artist in (*panel.lines, *panel.collections):
        if isinstance(artist, FillBetweenPolyCollection):
            colour = to_hex(np.asarray(artist.get_facecolor())[0])
            yield _Annotation(artist, "data-spread", colour)
        elif isinstance(artist, Line2D | PathCollection) and artist not in error_bar_caps:
            if not _is_in_data_coordinates(artist, panel):
                continue
            look = _look_of(artist)
            label = error_bar_names.get(artist, str(artist.get_label()))
            name = _public_label(label) or line_names.get(look, "")
            value = json.dumps([name, look.colour], ensure_ascii=False)
            yield _Annotation(artist, "data-series", value)


def _is_in_data_coordinates(artist: Line2D | PathCollection, axes: Axes) -> bool:
    """Return whether both coordinates of an artist are data.

    A line that marks a limit (`axvline`, `axhline`) has one coordinate as a fraction of the panel.
    """
    if isinstance(artist, Line2D):
        return artist.get_transform() == axes.transData
    return artist.get_offset_transform() == axes.transData


def _line_names(figure: Figure) -> dict[_LineLook, str]:
    """Return a name for each combination of colour, line style and marker in a figure.

    All lines of one combination show the same quantity, also those in panels without a legend. The
    name is taken from the first legend entry with this combination. If no legend has it, the name
    is the label of the first such line.
    """
    names: dict[_LineLook, str] = {}
    for legend in (*figure.legends, *(panel.get_legend() for panel in figure.axes)):
        if legend is None:
            continue
        for handle, text in zip(legend.legend_handles, legend.get_texts(), strict=True):
            if isinstance(handle, Line2D):
                names.setdefault(_look_of(handle), text.get_text())
    for panel in figure.axes:
        for line in panel.lines:
            label = str(line.get_label())
            if _public_label(label):
                names.setdefault(_look_of(line), label)
    return names


def _public_label(label: str) -> str:
    """Return a label, or "" for a label that matplotlib has generated, which starts with "_"."""
    return "" if label.startswith("_") else label


def _look_of(artist: Line2D | PathCollection) -> _LineLook:
    """Return colour, line style and marker of a line.

    All scatters have the same empty combination, so none of them gets the name of a line.
    """
    if isinstance(artist, PathCollection):
        return _LineLook("", "", "")
    style = artist.get_linestyle()
    colour = artist.get_markeredgecolor() if style == "None" else artist.get_color()
    return _LineLook(to_hex(colour), str(style), str(artist.get_marker()))


def _panel_record(axes: Axes) -> JsonObject:
    """Return the record of a drawn panel for the script: title, box in the SVG, maps and axes."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    width, height = (_POINTS_PER_INCH * inches for inches in figure.get_size_inches())
    box = axes.get_position()
    # Left, right, bottom, top; the vertical axis of an SVG points down.
    box_ends = [box.x0 * width, box.x1 * width, (1.0 - box.y0) * height, (1.0 - box.y1) * height]
    x_name = _shared_label(axes, figure.axes, 0)
    y_name = _shared_label(axes, figure.axes, 1)
    return {
        "title": axes.get_title(loc="left") or axes.get_title(),
        "maps": _map_records(axes),
        "box": [round(value, 3) for value in box_ends],
        "x": _axis_record(axes.xaxis, axes.get_xlim(), axes.get_xscale(), x_name),
        "y": _axis_record(axes.yaxis, axes.get_ylim(), axes.get_yscale(), y_name),
    }


def _shared_label(axes: Axes, panels: Iterable[Axes], direction: int) -> str:
    """Return the label of an axis of a panel: 0 is the horizontal one, 1 the vertical one.

    If the panel has none, it is the label of another panel with equal limits: in the same column
    for the horizontal axis, in the same row for the vertical one.
    """
    own_axis = (axes.xaxis, axes.yaxis)[direction]
    for panel in (axes, *panels):
        axis = (panel.xaxis, panel.yaxis)[direction]
        has_same_limits = np.array_equal(axis.get_view_interval(), own_axis.get_view_interval())
        offset = abs(panel.get_position().p0[direction] - axes.get_position().p0[direction])
        if has_same_limits and offset < _SAME_POSITION and axis.get_label_text():
            return axis.get_label_text()
    return ""


def _map_records(panel: Axes) -> list[JsonObject]:
    """Return the heat maps of a panel as JSON, for the script that shows values under the mouse.

    A map is left out if

    - it stands in a colour bar, or in a panel with a logarithmic axis;
    - its colour map has fewer than `_FEW_COLOURS` colours: such a map shows categories, not values;
    - it has more than `_MOST_CELLS` cells, or is an image of colours, such as a photograph.

    Returns
    -------
    list of dict
        For each map:

        - "x": the edges of its columns,
        - "y": the edges of its rows,
        - "values": its values row by row, null where a value is not finite,
        - "name": the quantity that it shows.
    """
    figure = panel.get_figure(root=True)
    if figure is None or _is_colour_bar(panel):
        return []
    has_linear_axes = panel.get_xscale() == "linear" and panel.get_yscale() == "linear"
    if not has_linear_axes:
        return []
    # The project's figures show one quantity in all their heat maps: that of the first colour bar.
    colour_bar_labels = [axes.get_ylabel() for axes in figure.axes if _is_colour_bar(axes)]
    quantity = colour_bar_labels[0] if colour_bar_labels else ""
    records: list[JsonObject] = []
    for artist in (*panel.collections, *panel.images):
        if not isinstance(artist, QuadMesh | AxesImage):
            continue
        shows_categories = artist.get_cmap().N < _FEW_COLOURS
        if shows_categories:
            continue
        values: np.ma.MaskedArray[tuple[int, int], np.dtype[np.float64]] = np.ma.masked_invalid(
            np.ma.asarray(artist.get_array())
        )
        if values.ndim != 2 or values.size > _MOST_CELLS:
            continue
        column_edges, row_edges = _cell_edges(artist, values.shape)
        value_rows = []
        for row in values.tolist():  # three significant digits keep the page small
            value_rows.append([None if cell is None else float(f"{cell:.3g}") for cell in row])
        records.append(
            {
                "x": column_edges.tolist(),
                "y": row_edges.tolist(),
                "values": value_rows,
                "name": quantity or "value",
            }
        )
    return records


def _cell_edges(artist: QuadMesh | AxesImage, shape: tuple[int, int]) -> tuple[Float, Float]:
    """Return the edges of the columns (C + 1,) and of the rows (R + 1,) of a heat map.

    `shape` is the number of rows R and of columns C.
    """
    if isinstance(artist, QuadMesh):
        corners = np.asarray(artist.get_coordinates())  # (R + 1, C + 1, 2): x and y
        return corners[0, :, 0], corners[:, 0, 1]
    rows, columns = shape
    left, right, bottom, top = artist.get_extent()
    first, last = (bottom, top) if artist.origin == "lower" else (top, bottom)
    return np.linspace(left, right, columns + 1), np.linspace(first, last, rows + 1)


def _is_colour_bar(axes: Axes) -> bool:
    """Return whether a panel is a colour bar."""
    return hasattr(axes, "_colorbar")


def _axis_record(axis: Axis, limits: tuple[float, float], scale: str, name: str) -> JsonObject:
    """Return the name, limits and scale of an axis as JSON.

    A logarithmic axis has "log". A linear axis has, besides its name and limits,

    - "texts", its ticks with their texts, if these are words instead of numbers;
    - "unlabelled", if it has neither a name nor tick texts: the page shows no value along it.

    Parameters
    ----------
    limits : (float, float)
        The values at its ends.
    scale : str
        "linear" or "log".
    name : str
        The label of the axis.
    """
    record: JsonObject = {
        "name": " ".join(name.split()),
        "limits": [float(f"{end:.9g}") for end in limits],
    }
    if scale == "log":
        record["log"] = True
        return record
    ticks = [float(tick) for tick in axis.get_majorticklocs()]
    texts = axis.get_major_formatter().format_ticks(ticks)
    if not name and not any(texts):
        record["unlabelled"] = True
    # matplotlib writes negative ticks with the Unicode minus sign, which no number in Python has
    ascii_texts = [text.replace("\N{MINUS SIGN}", "-") for text in texts]
    if any(text and not is_number(text) for text in ascii_texts):
        pairs = zip(ticks, texts, strict=True)
        record["texts"] = [[tick, " ".join(text.split())] for tick, text in pairs]
    return record
