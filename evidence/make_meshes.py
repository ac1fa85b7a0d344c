"""Make the meshes of the shipped structures: `python -m evidence.make_meshes`."""

import itertools
from collections.abc import Callable, Sequence

import meshio
import numpy as np
from numpy.typing import ArrayLike, NDArray

from scenarios import STRUCTURE_FOLDER

FloatArray = NDArray[np.float64]

CORNERS = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])
EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]


def hexahedra(
    lines: Sequence[ArrayLike], kept: Callable[[float, float, float], bool]
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Points (n, 3) and cells (m, 20) of the cells of a tensor grid that `kept` keeps by their centres."""
    places = [np.asarray(line, dtype=float) for line in lines]
    nodes = []
    for cell in itertools.product(*(range(len(line) - 1) for line in places)):
        corners = np.column_stack([line[cell[k] + CORNERS[:, k]] for k, line in enumerate(places)])
        if kept(*corners.mean(axis=0)):
            nodes.append(np.vstack((corners, [0.5 * (corners[a] + corners[b]) for a, b in EDGES])))
    points, numbers = np.unique(np.round(np.concatenate(nodes), 9), axis=0, return_inverse=True)
    return points, numbers.reshape(-1, 20)


def bracket() -> None:
    """Write an angle: a back of 60 mm bolted to a wall above, an arm of 80 mm, 6 mm thick and 40 mm wide."""
    x = [0, 6, 16, 26, 36, 46, 58, 70, 80]
    z = [0, 6, 16, 26, 36, 48, 60]
    points, cells = hexahedra((x, np.linspace(0, 40, 4), z), lambda x, _, z: x < 6 or z < 6)
    centres = points[cells[:, :8]].mean(axis=1)
    mesh = meshio.Mesh(points, [("hexahedron20", cells)])
    mesh.point_sets = {
        "WALL": np.flatnonzero((points[:, 0] == 0) & (points[:, 2] >= 36)),
        "END": np.flatnonzero(points[:, 0] == 80),
    }
    heel = (centres[:, 0] < 16) & (centres[:, 2] < 16)
    mesh.cell_sets = {
        "HEEL": [np.flatnonzero(heel)],
        "ARM": [np.flatnonzero((centres[:, 0] > 26) & (centres[:, 0] < 46))],
    }
    file = STRUCTURE_FOLDER / "bracket.inp"
    mesh.write(file)
    # meshio names the element by a variant with a pressure of its own
    file.write_text(file.read_text().replace("C3D20RH", "C3D20"))


def panel() -> None:
    """Write a skin of 300 x 200 x 2 mm on two stiffeners of 20 x 3 mm, with the physical groups of Gmsh."""
    x = [0, 25, 50, 75, 100, 125, 150, 175, 200, 225, 250, 275, 300]
    y = [0, 25, 48.5, 51.5, 75, 100, 125, 148.5, 151.5, 175, 200]
    points, cells = hexahedra((x, y, [-20, -10, 0, 2]), lambda _, y, z: z > 0 or abs(abs(y - 100) - 50) < 2)
    centres = points[cells[:, :8]].mean(axis=1)
    group = np.full(len(cells), 1)  # skin
    group[centres[:, 2] < 0] = 2  # stiffeners
    foot = (centres[:, 2] < 0) & (centres[:, 0] > 100) & (centres[:, 0] < 200)
    group[foot & (centres[:, 1] < 100)] = 3
    group[foot & (centres[:, 1] > 100)] = 4
    group[(centres[:, 2] > 0) & (abs(centres[:, 0] - 150) < 25) & (abs(centres[:, 1] - 100) < 30)] = 5
    names = ("skin", "stiffeners", "stiffener 1 middle", "stiffener 2 middle", "skin middle")
    mesh = meshio.Mesh(
        points,
        [("hexahedron20", cells)],
        cell_data={"gmsh:physical": [group], "gmsh:geometrical": [group]},
        field_data={name: np.array([number, 3]) for number, name in enumerate(names, start=1)},
    )
    mesh.write(STRUCTURE_FOLDER / "stiffened_panel.msh", file_format="gmsh22", binary=False)


if __name__ == "__main__":
    bracket()
    panel()
