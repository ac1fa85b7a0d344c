"""The coordinate systems of decks: cylindrical, spherical, or with axes of their own."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fe.elements.elasticity import axes_of
from fe.runtime.arrays import FloatArray

from .deck_text import fail

_LEAST_SINE = 1e-9


@dataclass(frozen=True)
class CoordinateSystem:
    """A Cartesian, cylindrical or spherical coordinate system.

    Attributes
    ----------
    origin : (3,) array
        The origin in global coordinates.
    axes : (3, 3) array
        The unit vectors x, y, z in global coordinates, one in each row.
    kind : {"R", "C", "S"}
        Rectangular: x, y, z. Cylindrical: radius, angle about z from x in degrees, z. Spherical:
        radius, angle from z, angle about z from x in degrees.
    """

    origin: FloatArray
    axes: FloatArray
    kind: str = "R"

    def to_space(self, coordinates: ArrayLike) -> FloatArray:
        """Convert coordinates (..., 3) of this system to global ones (..., 3)."""
        local_points = np.asarray(coordinates, dtype=np.float64)
        if self.kind == "S":
            radius, polar_degrees, azimuth_degrees = np.moveaxis(local_points, -1, 0)
            polar = np.deg2rad(polar_degrees)
            local_points = _from_cylinder(
                radius * np.sin(polar), azimuth_degrees, radius * np.cos(polar)
            )
        elif self.kind == "C":
            radius, azimuth_degrees, height = np.moveaxis(local_points, -1, 0)
            local_points = _from_cylinder(radius, azimuth_degrees, height)
        return np.asarray(self.origin + local_points @ self.axes)


def _from_cylinder(
    radius: FloatArray, azimuth_degrees: FloatArray, height: FloatArray
) -> FloatArray:
    """Convert cylindrical coordinates (...) to x, y, z (..., 3)."""
    azimuth = np.deg2rad(azimuth_degrees)
    return np.stack((radius * np.cos(azimuth), radius * np.sin(azimuth), height), axis=-1)


GLOBAL = CoordinateSystem(np.zeros(3), np.eye(3))


def axes_by_points(
    where: str, points: FloatArray, order: tuple[int, int, int] = (0, 1, 2)
) -> FloatArray:
    """Return the axes of a coordinate system given by three points.

    Parameters
    ----------
    where : str
        File and line, for the error message.
    points : (3, 3) array
        The origin, a point on the first axis, and a point in the plane of the first two axes.
    order : tuple of int
        The indices of x, y and z among the three axes; the third axis is normal to the plane.

    Returns
    -------
    (3, 3) array
        The unit vectors x, y, z, one in each row.

    Raises
    ------
    MeshError
        If the points lie on a line.
    """
    origin, point_on_first_axis, point_in_plane = points
    first = point_on_first_axis - origin
    second = point_in_plane - origin
    # |a x b| = |a| |b| sin(angle)
    product_of_lengths = np.linalg.norm(first) * np.linalg.norm(second)
    spanned_area = np.linalg.norm(np.cross(first, second))
    spans_plane = spanned_area > _LEAST_SINE * product_of_lengths
    if not spans_plane:
        fail(where, "the three points of a coordinate system must not lie on a line.")
    axes = axes_of(first, second)
    return axes[list(order)]
