"""Bodies that boxes of cells are bent into; the files of their structures stand in `inputs`."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

CURVED_KINDS = ("hexahedron20", "tetra10", "wedge15")
"""Kinds of elements whose edges can follow a curve."""


@dataclass(frozen=True)
class Body:
    """What a structure is made of if nothing else is said.

    Attributes
    ----------
    sets : tuple of str
        Its sets of nodes.
    kind : str
        The kind of elements.
    divisions : tuple of int
        The number of cells along each axis.
    """

    sets: tuple[str, ...]
    kind: str
    divisions: tuple[int, int, int]


BODIES = {
    "ring": Body(("bore", "all"), "hexahedron20", (2, 4, 1)),
    "cantilever": Body((), "hexahedron20", (20, 1, 1)),
    "plate": Body(("line",), "hexahedron", (2, 1, 1)),
    "body": Body(("top", "tip"), "hexahedron", (4, 2, 2)),
    "strip": Body(("x", "y", "z", "top", "all"), "hexahedron20", (1, 1, 1)),
    "ply": Body(("x", "y", "z", "top", "all"), "hexahedron20", (1, 1, 1)),
}
SIZES = {"cantilever": (1000, 60, 10), "plate": (20, 10, 10), "body": (100, 25, 10)}
"""Sizes of the bodies in their unit of length; the others are unit cubes."""
RING_INNER = 1.0
RING_OUTER = 2.0
"""Radii of the ring [m]."""


def bend_box(name: str, kind: str, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points of the unit cube as those of a body; second order edges follow its curves."""
    if name == "ring":  # a quarter of a thick one
        x, y, z = points.T
        radius = RING_INNER + (RING_OUTER - RING_INNER) * x
        angle = 0.5 * np.pi * y
        bent = np.column_stack((radius * np.cos(angle), radius * np.sin(angle), 0.1 * z))
        return np.where(np.abs(bent) < 1e-12, 0.0, bent)
    x, y, z = (points * SIZES.get(name, 1)).T
    if name == "body" and kind in CURVED_KINDS:  # in the plane of the top
        y = y + 12.0 * (x / 100.0) ** 2 * (y / 25.0)
    return np.column_stack((x, y, z))


def sets_of_box(points: NDArray[np.float64]) -> dict[str, Any]:
    """Return the sets of nodes of the unit cube, as masks by name."""
    x, y, z = points.T
    return {
        "x": x == 0.0,
        "y": y == 0.0,
        "z": z == 0.0,
        "top": z == 1.0,
        "all": z >= 0.0,
        "bore": x == 0.0,
        "tip": x == 1.0,
        "line": x + y == 0.0,
    }
