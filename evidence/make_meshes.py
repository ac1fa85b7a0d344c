"""Make the meshes of the shipped structures: `python -m evidence.make_meshes`."""

import itertools
from collections.abc import Callable, Sequence

import meshio
import numpy as np
from numpy.typing import ArrayLike, NDArray

from scenarios import STRUCTURE_FOLDER

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CORNERS = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))
"""Corners of a hexahedron: whether each lies at the upper end of the cell along x, y and z."""
EDGES = (
    (0, 1),
    (1, 2),
    (2, 3),
    (3, 0),
    (4, 5),
    (5, 6),
    (6, 7),
    (7, 4),
    (0, 4),
    (1, 5),
    (2, 6),
    (3, 7),
)
"""Edges of a hexahedron: the two corners of each."""
CORNER_COUNT = len(CORNERS)

SKIN = 1
STIFFENERS = 2
FIRST_STIFFENER_MIDDLE = 3
SECOND_STIFFENER_MIDDLE = 4
SKIN_MIDDLE = 5
PANEL_GROUPS = {
    "skin": SKIN,
    "stiffeners": STIFFENERS,
    "stiffener 1 middle": FIRST_STIFFENER_MIDDLE,
    "stiffener 2 middle": SECOND_STIFFENER_MIDDLE,
    "skin middle": SKIN_MIDDLE,
}
"""Physical groups of the stiffened panel, with their numbers in the mesh file."""


def hexahedra(
    lines: Sequence[ArrayLike], is_material: Callable[[float, float, float], bool]
) -> tuple[FloatArray, IntArray]:
    """Return points and 20-node hexahedra of the cells of a tensor grid that hold material.

    Parameters
    ----------
    lines : sequence of 3 arrays
        Coordinates of the grid lines along x, y and z.
    is_material : callable
        Returns whether the cell with the centre x, y, z holds material.

    Returns
    -------
    points : (n, 3) array
        Positions of the nodes.
    cells : (m, 20) array
        Nodes of the cells: the corners, then the middles of the edges.
    """
    grid_lines = [np.asarray(line, dtype=float) for line in lines]
    cell_counts = [len(line) - 1 for line in grid_lines]
    node_positions = []
    for cell in itertools.product(*map(range, cell_counts)):
        corners = _corner_positions(grid_lines, cell)
        x, y, z = corners.mean(axis=0)
        if is_material(x, y, z):
            middles = [0.5 * (corners[start] + corners[end]) for start, end in EDGES]
            node_positions.append(np.vstack((corners, middles)))
    # Neighbouring cells share nodes: equal positions become one point.
    rounded = np.round(np.concatenate(node_positions), 9)
    points, numbers = np.unique(rounded, axis=0, return_inverse=True)
    return points, numbers.reshape(-1, CORNER_COUNT + len(EDGES))


def _corner_positions(grid_lines: Sequence[FloatArray], cell: Sequence[int]) -> FloatArray:
    """Return the positions (8, 3) of the corners of a cell, given its index along each axis."""
    positions = []
    for line, index, offset in zip(grid_lines, cell, np.transpose(CORNERS), strict=True):
        positions.append(line[index + offset])
    return np.column_stack(positions)


def _cell_centres(points: FloatArray, cells: IntArray) -> FloatArray:
    """Return x, y and z of the centre of each cell, as an array (3, m)."""
    corners = points[cells[:, :CORNER_COUNT]]
    return np.asarray(corners.mean(axis=1).T)


def bracket() -> None:
    """Write an angle bracket, 6 mm thick and 40 mm wide.

    A back of 60 mm is bolted to a wall in its upper part and carries an arm of 80 mm.
    """
    x_lines = [0, 6, 16, 26, 36, 46, 58, 70, 80]
    y_lines = np.linspace(0, 40, 4)
    z_lines = [0, 6, 16, 26, 36, 48, 60]
    points, cells = hexahedra((x_lines, y_lines, z_lines), lambda x, _, z: x < 6 or z < 6)
    mesh = meshio.Mesh(points, [("hexahedron20", cells)])

    x, _, z = points.T
    mesh.point_sets = {
        "WALL": np.flatnonzero((x == 0) & (z >= 36)),
        "END": np.flatnonzero(x == 80),
    }
    x, _, z = _cell_centres(points, cells)
    mesh.cell_sets = {
        "HEEL": [np.flatnonzero((x < 16) & (z < 16))],
        "ARM": [np.flatnonzero((x > 26) & (x < 46))],
    }
    file = STRUCTURE_FOLDER / "bracket.inp"
    mesh.write(file)
    # meshio names the element by a variant with a pressure of its own
    file.write_text(file.read_text().replace("C3D20RH", "C3D20"))


def panel() -> None:
    """Write a skin of 300 x 200 x 2 mm on two stiffeners of 20 x 3 mm, with physical groups."""
    x_lines = [0, 25, 50, 75, 100, 125, 150, 175, 200, 225, 250, 275, 300]
    y_lines = [0, 25, 48.5, 51.5, 75, 100, 125, 148.5, 151.5, 175, 200]
    z_lines = [-20, -10, 0, 2]
    points, cells = hexahedra(
        (x_lines, y_lines, z_lines), lambda _, y, z: z > 0 or abs(abs(y - 100) - 50) < 2
    )
    x, y, z = _cell_centres(points, cells)
    in_stiffener = z < 0
    in_stiffener_middle = in_stiffener & (x > 100) & (x < 200)
    group = np.full(len(cells), SKIN)
    group[in_stiffener] = STIFFENERS
    group[in_stiffener_middle & (y < 100)] = FIRST_STIFFENER_MIDDLE
    group[in_stiffener_middle & (y > 100)] = SECOND_STIFFENER_MIDDLE
    group[(z > 0) & (abs(x - 150) < 25) & (abs(y - 100) < 30)] = SKIN_MIDDLE
    dimension = len(points.T)
    mesh = meshio.Mesh(
        points,
        [("hexahedron20", cells)],
        cell_data={"gmsh:physical": [group], "gmsh:geometrical": [group]},
        field_data={name: np.array([number, dimension]) for name, number in PANEL_GROUPS.items()},
    )
    mesh.write(STRUCTURE_FOLDER / "stiffened_panel.msh", file_format="gmsh22", binary=False)


if __name__ == "__main__":
    bracket()
    panel()
