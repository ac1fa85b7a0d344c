"""Mode shapes of a calibrated wing."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fe.reduction.fields import WingFields
from fe.runtime.reduced import Modes
from reporting.figures import LEVELS, panels, publication_style

Float = NDArray[np.float64]

_FACES = ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))


@publication_style()
def modes_figure(fields: WingFields, modes: Modes, titles: Sequence[str]) -> Figure:
    """Draw the mode shapes of the upper skin in oblique view, coloured by their displacement.

    Parameters
    ----------
    fields : WingFields
        Bases on the mesh.
    modes : Modes
        Of the calibrated wing.
    titles : sequence of str
        One for each mode.
    """
    faces = _upper_faces(fields)
    points = fields.points
    span = float(np.ptp(points[:, 1]))
    shapes = fields.modal_displacement @ modes.shape
    rows = (len(titles) + 1) // 2
    figure, grid = panels(
        rows, 2, 1.5 * rows, 0.015 * rows, 0.0, wspace=0.06, hspace=0.04, left=0.01, right=0.99
    )
    for axes, shape, title in zip(np.array(grid).flat, np.moveaxis(shapes, -1, 0), titles, strict=False):
        length = np.linalg.norm(shape, axis=1)
        moved = points + shape * (0.14 * span / float(length.max()))
        _draw_skin(axes, points, faces, None)
        _draw_skin(axes, moved, faces, length / float(length.max()))
        axes.set_xlim(-0.09 * span, 1.10 * span)
        axes.set_ylim(-0.24 * span, 0.27 * span)
        axes.text(0.0, 0.97, title, transform=axes.transAxes, va="top", fontsize=8.0, fontweight="bold")
    for spare in np.array(grid).flat[len(titles) :]:
        spare.remove()
    return figure


def _upper_faces(fields: WingFields) -> NDArray[np.int64]:
    """Return the corners of the outer faces of the upper skin, (F, 4)."""
    # the skin and the damage regions in it, see `fe.reduction.fields.WingFields`
    skin = fields.cells[fields.region <= len(fields.regions)][:, :8]
    height = fields.points[skin][:, :, 2]
    skin = skin[height.mean(axis=1) > 0.0]
    candidates = skin[:, np.array(_FACES)]
    corner = fields.points[candidates]
    normal = np.cross(corner[:, :, 2] - corner[:, :, 0], corner[:, :, 3] - corner[:, :, 1])
    area = np.linalg.norm(normal, axis=2)
    broad = area > 0.5 * area.max(axis=1, keepdims=True)  # the skin is thin: inner and outer face
    best = np.where(broad, corner[:, :, :, 2].mean(axis=2), -np.inf).argmax(axis=1)
    return np.asarray(candidates[np.arange(len(skin)), best])


def _draw_skin(axes: Axes, points: Float, faces: NDArray[np.int64], value: Float | None) -> None:
    """Draw faces in oblique projection, those behind first: span to the right, chord into the page."""
    x, y, z = points.T
    flat = np.column_stack([y + 0.45 * -x, 0.40 * -x + z])
    order = np.argsort(x[faces].mean(axis=1))  # the leading edge is at the back
    polygons = flat[faces[order]]
    look: dict[str, Any] = {"facecolors": "#eeeeee", "edgecolors": "#dddddd", "linewidths": 0.2}
    if value is not None:
        shade = value[faces[order]].mean(axis=1)
        look = {"array": shade, "cmap": LEVELS, "edgecolors": "face", "linewidths": 0.15, "clim": (0.0, 1.0)}
    drawn = PolyCollection(list(polygons), rasterized=True, **look)
    axes.add_collection(drawn)
    axes.set_aspect("equal")
    axes.set_axis_off()
