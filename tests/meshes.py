"""Meshes of boxes by hand, in the node order of mesh files."""

import itertools

import numpy as np
from numpy.typing import NDArray

from fe.elements.kinds import KINDS

_CORNERS = np.array(
    [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)], dtype=float
)
_PARTS = {  # of a cube, into cells by their number of corners
    8: [[0, 1, 2, 3, 4, 5, 6, 7]],
    6: [[0, 1, 2, 4, 5, 6], [0, 2, 3, 4, 6, 7]],
    4: [[0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]],
}


def box(kind: str, divisions: tuple[int, int, int]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return a mesh of the unit cube: points (nn, 3) and cells (nc, k) of a kind of meshio's."""
    element = KINDS[kind]
    parts_of_cube = _PARTS[len(element.corners)]
    places = itertools.product(*(range(count) for count in divisions))
    cubes = [np.array(place) + _CORNERS for place in places]
    corners = np.array([cube[part] for cube in cubes for part in parts_of_cube])
    middles = [0.5 * (corners[:, first] + corners[:, second]) for first, second in element.edges]
    nodes = np.concatenate([corners, *(middle[:, None] for middle in middles)], axis=1)
    # at half steps, so that coordinates are whole numbers: nodes that coincide are one point
    half_steps = np.rint(2.0 * nodes).astype(np.int64).reshape(-1, 3)
    points, cells = np.unique(half_steps, axis=0, return_inverse=True)
    return points / (2.0 * np.array(divisions)), cells.reshape(nodes.shape[:2])
