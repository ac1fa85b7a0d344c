"""Mode shapes of a calibrated wing."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from fe.reduction.fields import WingFields
from fe.runtime.reduced import Modes
from reporting.figures import LEVELS, panels, publication_style


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
    # the skin and the damage regions in it, see `fe.reduction.fields.WingFields`
    skin = fields.cells[fields.region <= len(fields.regions)][:, :8]
    upper = np.unique(skin[fields.points[skin][:, :, 2].mean(axis=1) > 0.0])
    points = fields.points[upper]
    # neighbours seen from above; those at the trailing edge, which is in front, are drawn last
    triangles = Triangulation(points[:, 1], points[:, 0]).triangles
    triangles = triangles[np.argsort(points[triangles, 0].mean(axis=1))]
    span = float(np.ptp(points[:, 1]))
    shapes = (fields.modal_displacement @ modes.shape)[upper]
    rows = (len(titles) + 1) // 2
    figure, grid = panels(
        rows, 2, 1.5 * rows, 0.015 * rows, 0.0, wspace=0.06, hspace=0.04, left=0.01, right=0.99
    )
    places = [axes for row in grid for axes in row]
    for axes, shape, title in zip(places, np.moveaxis(shapes, -1, 0), titles, strict=False):
        length = np.linalg.norm(shape, axis=1)
        largest = float(length.max())
        moved = points + shape * (0.14 * span / largest)
        for (x, y, z), value, colours in ((points.T, 0.1 * largest, "Greys"), (moved.T, length, LEVELS)):
            # oblique: span to the right, chord into the page
            seen = Triangulation(y - 0.45 * x, z - 0.40 * x, triangles)
            shade = np.broadcast_to(value, length.shape)
            axes.tripcolor(seen, shade, cmap=colours, clim=(0.0, largest), shading="gouraud", rasterized=True)
        axes.set(xlim=(-0.09 * span, 1.10 * span), ylim=(-0.24 * span, 0.27 * span), aspect="equal")
        axes.set_axis_off()
        axes.text(0.0, 0.97, title, transform=axes.transAxes, va="top", fontsize=8.0, fontweight="bold")
    for spare in places[len(titles) :]:
        spare.remove()
    return figure
