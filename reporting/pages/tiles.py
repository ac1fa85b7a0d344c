"""The tiles of a figure, which a narrow page shows below one another.

A figure is drawn for the width of a page. On the screen of a telephone its letters would be too
small to read, so the page shows the panels one below the other instead. The figure is cut where no
panel is cut: between columns of panels or, where a panel is as wide as the figure, between rows
(recursive X-Y cut, Nagy and Seth 1984).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.transforms import Bbox

from reporting.pages.inline_svg import NARROW

_ALLOWED_OVERLAP = 4.0
"""Overlap of two boxes that is ignored, since it is the margin around their letters [pt]."""
_MARGIN = 3.0
"""Margin around the boxes of a tile [pt]."""
_WIDER_LETTERS = 0.1
"""Space behind the text of a legend, as a fraction of it: a browser may have wider letters."""
_POINTS_PER_INCH = 72.0


class Tile(NamedTuple):
    """A rectangle of a figure in the coordinates of its SVG, whose vertical axis points down.

    Attributes
    ----------
    x, y, width, height : float
        Position of the upper left corner, and size [pt].
    """

    x: float
    y: float
    width: float
    height: float

    @property
    def x_end(self) -> float:
        """Position of the right edge [pt]."""
        return self.x + self.width

    @property
    def y_end(self) -> float:
        """Position of the lower edge [pt]."""
        return self.y + self.height

    @property
    def view_box(self) -> str:
        """The rectangle as the attribute `viewBox` of an SVG."""
        return " ".join(f"{value:.1f}" for value in self)

    @property
    def is_narrow(self) -> bool:
        """Whether the tile fits a narrow screen."""
        return self.width <= NARROW


def tiles_of_figure(figure: Figure) -> list[Tile]:
    """Return the tiles into which a figure is cut for a narrow screen, in the order of reading.

    A tile is a rectangle around a few panels or entries of a legend, narrow enough to be shown
    alone. The legends of the whole figure come first. Then the columns of panels follow from left
    to right, each from top to bottom; a colour bar stays beside its panel.

    Parameters
    ----------
    figure : Figure
        The figure with all its panels drawn.
    """
    figure.draw_without_rendering()  # places the entries of legends
    renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]
    width, height = (_POINTS_PER_INCH * inches for inches in figure.get_size_inches())

    def tile_of_box(box: Bbox) -> Tile:
        """Convert a box in pixels, with y upwards, to a tile in points, with y downwards."""
        scale = _POINTS_PER_INCH / figure.dpi
        return Tile(scale * box.x0, height - scale * box.y1, scale * box.width, scale * box.height)

    legend_boxes: list[Tile] = []
    for legend in figure.legends:
        legend_boxes += [tile_of_box(box) for box in _boxes_of_entries(legend, renderer)]
    panel_boxes = [tile_of_box(box) for box in _boxes_of_panels(figure, renderer)]
    panel_boxes += [tile_of_box(text.get_window_extent(renderer)) for text in figure.texts]
    groups = [*_split_into_narrow_groups(legend_boxes), *_split_into_narrow_groups(panel_boxes)]
    return [_surrounding_tile(group, width, height) for group in groups]


def _boxes_of_entries(legend: Legend, renderer: RendererAgg) -> list[Bbox]:
    """Return the box of each entry of a legend: its handle with its text, in pixels."""
    boxes = []
    for handle, text in zip(legend.legend_handles, legend.get_texts(), strict=True):
        box = text.get_window_extent(renderer)
        box = Bbox.from_extents(box.x0, box.y0, box.x1 + _WIDER_LETTERS * box.width, box.y1)
        if handle is not None:
            box_of_handle = handle.get_window_extent(renderer)
            if np.isfinite(box_of_handle.extents).all():  # a handle without a line has no extent
                box = Bbox.union([box_of_handle, box])
        boxes.append(box)
    return boxes


def _boxes_of_panels(figure: Figure, renderer: RendererAgg) -> list[Bbox]:
    """Return the box of each panel in pixels, which includes its titles, labels and colour bars."""
    panel_of_colour_bar: dict[Axes, Axes] = {}
    for panel in figure.axes:
        for artist in (*panel.collections, *panel.images):
            if artist.colorbar is not None:
                panel_of_colour_bar[artist.colorbar.ax] = panel
    # matplotlib counts colour bars among the axes, beside the panels
    boxes: dict[Axes, Bbox] = {}
    for axes in figure.axes:
        box = axes.get_tightbbox(renderer)
        if box is not None and axes.get_visible():
            boxes[axes] = box
    panels = [axes for axes in boxes if not hasattr(axes, "_colorbar")]
    colour_bars = [axes for axes in boxes if hasattr(axes, "_colorbar")]
    for colour_bar in colour_bars:
        # A colour bar may be made for a colour scale alone, without a map in any panel. It then
        # belongs to the nearest panel.
        panel_beside = panel_of_colour_bar.get(colour_bar)
        if panel_beside is None:
            panel_beside = _nearest_panel(boxes, panels, colour_bar)
        if panel_beside in boxes:
            boxes[panel_beside] = Bbox.union([boxes[panel_beside], boxes.pop(colour_bar)])
    return list(boxes.values())


def _nearest_panel(
    boxes: Mapping[Axes, Bbox], panels: Sequence[Axes], colour_bar: Axes
) -> Axes | None:
    """Return the panel whose box has the smallest gap to that of a colour bar; None if no panel.

    The gap is the sum of the horizontal and the vertical distance between the two boxes.
    """
    bar_box = boxes[colour_bar]

    def gap(panel: Axes) -> float:
        panel_box = boxes[panel]
        horizontal_gap = max(panel_box.x0 - bar_box.x1, bar_box.x0 - panel_box.x1, 0.0)
        vertical_gap = max(panel_box.y0 - bar_box.y1, bar_box.y0 - panel_box.y1, 0.0)
        return float(horizontal_gap + vertical_gap)

    return min(panels, key=gap, default=None)


def _split_into_narrow_groups(boxes: Sequence[Tile]) -> Iterator[list[Tile]]:
    """Yield groups of boxes that are at most `NARROW` wide, unless a box would have to be cut.

    Columns of boxes are yielded from left to right, rows of boxes from top to bottom.
    """
    if not boxes:
        return
    x_start = min(box.x for box in boxes)
    x_end = max(box.x_end for box in boxes)
    if x_end - x_start <= NARROW - 2.0 * _MARGIN:
        yield list(boxes)
        return
    columns = _separate(boxes, lambda box: (box.x, box.x_end))
    if len(columns) > 1:
        for group in _side_by_side(columns):
            yield from [group] if len(group) == len(boxes) else _split_into_narrow_groups(group)
        return
    rows = _separate(boxes, lambda box: (box.y, box.y_end))
    if len(rows) > 1:
        for row in rows:
            yield from _split_into_narrow_groups(row)
        return
    yield list(boxes)


def _separate(
    boxes: Sequence[Tile], ends_of: Callable[[Tile], tuple[float, float]]
) -> list[list[Tile]]:
    """Return boxes in groups, ordered along one direction, that do not overlap in this direction.

    Parameters
    ----------
    boxes : sequence of Tile
        The boxes, with low and high ends in both directions.
    ends_of : callable
        Returns the ends of a box along the direction.
    """
    in_order = sorted(boxes, key=ends_of)
    groups = [[in_order[0]]]
    for box in in_order[1:]:
        end_of_group = max(ends_of(member)[1] for member in groups[-1])
        if ends_of(box)[0] > end_of_group - _ALLOWED_OVERLAP:
            groups.append([box])
        else:
            groups[-1].append(box)
    return groups


def _side_by_side(columns: Sequence[list[Tile]]) -> list[list[Tile]]:
    """Return neighbouring columns joined, as many as are narrow together."""
    groups = [list(columns[0])]
    for column in columns[1:]:
        x_start = min(box.x for box in groups[-1])
        x_end = max(box.x_end for box in column)
        if x_end - x_start <= NARROW - 2.0 * _MARGIN:
            groups[-1] += column
        else:
            groups.append(list(column))
    return groups


def _surrounding_tile(boxes: Sequence[Tile], width: float, height: float) -> Tile:
    """Return the tile around some boxes, with a margin, inside a figure of a given size [pt]."""
    x_start = max(0.0, min(box.x for box in boxes) - _MARGIN)
    y_start = max(0.0, min(box.y for box in boxes) - _MARGIN)
    x_end = min(width, max(box.x_end for box in boxes) + _MARGIN)
    y_end = min(height, max(box.y_end for box in boxes) + _MARGIN)
    return Tile(x_start, y_start, x_end - x_start, y_end - y_start)
