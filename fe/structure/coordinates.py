"""Coordinate systems of decks: points that are given by radii and angles, or along other axes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .deck import fail

FloatArray = NDArray[np.float64]

_LEAST_SINE = 1e-9


@dataclass(frozen=True)
class System:
    """A coordinate system.

    Attributes
    ----------
    origin : (3,)
        Its origin in space.
    axes : (3, 3)
        Its axes x, y, z in space, one in each row.
    kind : {"R", "C", "S"}
        What its coordinates are: x, y, z; radius, angle about z from x in degrees, z; or radius, angle from
        z, angle about z from x.
    """

    origin: FloatArray
    axes: FloatArray
    kind: str = "R"

    def place(self, coordinates: ArrayLike) -> FloatArray:
        """Place in space (..., 3) of coordinates (..., 3)."""
        given = np.asarray(coordinates, dtype=np.float64)
        if self.kind != "R":
            radius, angle, height = np.moveaxis(given, -1, 0)
            if self.kind == "S":
                polar, angle = np.deg2rad(angle), height
                radius, height = radius * np.sin(polar), radius * np.cos(polar)
            turn = np.deg2rad(angle)
            given = np.stack((radius * np.cos(turn), radius * np.sin(turn), height), axis=-1)
        return np.asarray(self.origin + given @ self.axes)


GLOBAL = System(np.zeros(3), np.eye(3))


def frame(where: str, points: FloatArray, order: tuple[int, int, int] = (0, 1, 2)) -> FloatArray:
    """Axes (3, 3) from an origin, a point on the first axis and one beside it, `points` (3, 3).

    `order` says which of the three found axes is x, y and z: the first, the one towards the last point, and
    the one at right angles to both.

    Raises
    ------
    MeshError
        If the points lie on a line.
    """
    first, second = points[1] - points[0], points[2] - points[0]
    third = np.cross(first, second)
    size = np.linalg.norm(first) * np.linalg.norm(second)
    if not np.linalg.norm(third) > _LEAST_SINE * size:
        fail(where, "the three points of a coordinate system must not lie on a line.")
    axes = np.array([first, np.cross(third, first), third])
    return np.asarray((axes / np.linalg.norm(axes, axis=1)[:, None])[list(order)])
