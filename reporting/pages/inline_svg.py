"""Drawings inside an HTML page: one SVG for a wide page, and its tiles for a narrow one."""

import html
import re
from typing import NamedTuple

from reporting.errors import InvalidFigureError

NARROW = 340.0
"""Width of a tile that fits a screen of 400 pixels with letters that can be read [pt]."""
_IDENTIFIER = re.compile(r'\bid="([^"]+)"')
_REFERENCE = re.compile(r'(href="#|url\(#)([^")]+)')
_ATTRIBUTE = re.compile(r'([\w:-]+)="([^"]*)"')
_ATTRIBUTES_OF_FILES = {"viewBox", "width", "height", "version", "data-tiles"}
"""Attributes of an SVG that its element in a page does not have or has anew."""
_READABLE_PIXELS_PER_POINT = 1.15
"""Pixels for each point of a drawing, at which letters of 8 points can be read."""
_MOST_PIXELS_PER_POINT = 1.6
"""The most pixels for each point of a drawing."""
_DRAWING = "drawing"
"""Identifier of a whole drawing in a page, after its prefix."""


class InlineDrawing(NamedTuple):
    """A drawing as elements of an HTML page.

    Attributes
    ----------
    full : str
        The drawing as one element, scaled to the width of the page.
    tiles : tuple of str
        Elements that show the parts of the drawing on a narrow page, in their order; empty if the
        drawing has no parts.
    is_wide : bool
        Whether a tile, or a drawing without tiles, is wider than a narrow page.
    """

    full: str
    tiles: tuple[str, ...]
    is_wide: bool


def inline_svg(svg: bytes, prefix: str, description: str) -> InlineDrawing:
    """Return an SVG as elements of an HTML page.

    Parameters
    ----------
    svg : bytes
        The SVG.
    prefix : str
        The text that is put before all ids and references to them, since ids must be unique in a
        page.
    description : str
        The description for readers who cannot see the drawing.

    Raises
    ------
    InvalidFigureError
        If the bytes are not an SVG that can be scaled.
    """
    text = svg.decode("utf-8", errors="replace")
    start_of_tag = text.find("<svg")
    end_of_tag = text.find(">", start_of_tag)
    if start_of_tag < 0 or end_of_tag < 0:
        raise InvalidFigureError(
            "A figure for a page must be an SVG; the bytes given have no <svg> element."
        )
    attributes = dict(_ATTRIBUTE.findall(text[start_of_tag:end_of_tag]))
    content = text[end_of_tag + 1 :].rstrip().removesuffix("</svg>")
    if "viewBox" not in attributes:
        raise InvalidFigureError(
            "A figure for a page must have a viewBox, or it could not be scaled."
        )
    content = _IDENTIFIER.sub(rf'id="{prefix}-\1"', content)
    content = _REFERENCE.sub(rf"\1{prefix}-\2", content)
    # Inside HTML the parser knows the namespaces, and `href` needs no prefix.
    content = content.replace("xlink:href=", "href=")
    # Attributes such as the size of letters hold for all that is drawn.
    look = ""
    for name, value in attributes.items():
        if name not in _ATTRIBUTES_OF_FILES and not name.startswith("xmlns"):
            look += f' {name}="{value}"'
    label = html.escape(description)
    view_box = attributes["viewBox"]
    full_drawing = (
        f'<svg viewBox="{view_box}" role="img" aria-label="{label}">'
        f'<g id="{prefix}-{_DRAWING}"{look}>{content}</g></svg>'
    )
    tiles = []
    widths = [float(view_box.split()[2])]
    if attributes.get("data-tiles"):
        tile_boxes = attributes["data-tiles"].split(", ")
        widths = [float(tile_box.split()[2]) for tile_box in tile_boxes]
        for tile_box, width in zip(tile_boxes, widths, strict=True):
            tiles.append(_tile_element(tile_box, width, f"{prefix}-{_DRAWING}"))
    return InlineDrawing(full_drawing, tuple(tiles), is_wide=max(widths) > NARROW)


def _tile_element(view_box: str, width: float, drawing: str) -> str:
    """Return the HTML element of a tile: a rectangle that is cut out of a drawing.

    Parameters
    ----------
    view_box : str
        The rectangle as an SVG attribute: left edge, top edge, width and height [pt].
    width : float
        The width of the rectangle [pt].
    drawing : str
        The identifier of the drawing.
    """
    if width > NARROW:
        # wider than a small screen: the tile keeps the width at which its letters can be read
        style = f"width:{_READABLE_PIXELS_PER_POINT * width:.0f}px"
    else:
        # the tile fits the screen, and is not magnified beyond the limit on a wide one
        style = f"max-width:{_MOST_PIXELS_PER_POINT * width:.0f}px"
    return (
        f'<div class="tile"><svg viewBox="{view_box}" style="{style}" aria-hidden="true" '
        f'data-drawing="{drawing}"><use href="#{drawing}"/></svg></div>'
    )
