"""The picture of a structure in the report: its surface under the last estimate, from `structure.vtu`."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fe.elements.kinds import KINDS, meshio_with_wedges
from reporting import figures as style

FloatArray = NDArray[np.float64]

FIELD_NAME = "structure.vtu"
_LENGTH = 0.08
"""Length of the largest displacement in the picture, as a part of the structure's."""


class StructurePicture(NamedTuple):
    """A picture, the largest displacement [m] in it, and how many times displacements are exaggerated."""

    figure: Figure
    largest: float
    scale: float


def structure_figure(run_folder: Path) -> StructurePicture | None:
    """Draw the surface of the structure of a run, coloured by the stiffness that its regions have lost.

    None, where the run has no such field.
    """
    path = run_folder / FIELD_NAME
    if not path.is_file():
        return None
    mesh = meshio_with_wedges().read(path)
    kind = KINDS[mesh.cells[0].type]
    loss = np.asarray(mesh.cell_data["stiffness_loss"][0], dtype=np.float64)
    region = np.asarray(mesh.cell_data["region"][0])
    displacement = np.asarray(mesh.point_data["displacement"], dtype=np.float64)
    largest = float(np.linalg.norm(displacement, axis=1).max())
    size = float(np.linalg.norm(np.ptp(mesh.points, axis=0)))
    scale = _LENGTH * size / largest if largest > 0.0 else 0.0
    cells, corners = surface(kind.faces, np.asarray(mesh.cells[0].data))
    points = np.asarray(mesh.points + scale * displacement)
    return StructurePicture(_drawn(points, corners, loss[cells], region[cells] > 0), largest, scale)


def surface(
    faces: tuple[tuple[int, ...], ...], cells: NDArray[np.int64]
) -> tuple[NDArray[np.int64], list[NDArray[np.int64]]]:
    """Return the cell and the corners of each face that belongs to one cell alone."""
    found: dict[tuple[int, ...], tuple[int, NDArray[np.int64]] | None] = {}
    for face in faces:
        for number, nodes in enumerate(cells[:, list(face)]):
            key = tuple(sorted(nodes.tolist()))
            found[key] = None if key in found else (number, nodes)
    outer = [entry for entry in found.values() if entry is not None]
    return np.array([number for number, _ in outer]), [nodes for _, nodes in outer]


def _drawn(
    points: FloatArray, corners: list[NDArray[np.int64]], loss: FloatArray, in_region: NDArray[np.bool_]
) -> Figure:
    # seen from above, in front and the right; what is farther is drawn first
    turn, tilt = np.radians(-60.0), np.radians(28.0)
    across = np.array([-np.sin(turn), np.cos(turn), 0.0])
    towards = np.array([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)])
    up = np.cross(towards, across)
    plane, depth = points @ np.column_stack((across, up)), points @ towards
    order = np.argsort([depth[nodes].mean() for nodes in corners])
    with style.publication_style():
        figure = style.new_figure(0.55 * style.FULL_WIDTH)
        axes = figure.add_axes((0.0, 0.0, 0.86, 1.0))
        patches = PolyCollection(
            [plane[corners[number]] for number in order],
            array=100.0 * loss[order],
            cmap="YlOrRd",
            edgecolors=["black" if in_region[number] else "0.6" for number in order],
            linewidths=0.4,
            clim=(0.0, 100.0),
        )
        axes.add_collection(patches)
        axes.autoscale_view()
        axes.set_aspect("equal")
        axes.axis("off")
        figure.colorbar(patches, cax=figure.add_axes((0.88, 0.2, 0.02, 0.6)), label="stiffness loss (%)")
    return figure
