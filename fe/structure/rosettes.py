"""Strain gauges of a structure file, and rosettes: gauges at one point in several directions in one table."""

from typing import Annotated, Any

import numpy as np
from pydantic import Field, model_validator

from fe.wing.parts import Part
from reporting.section import checked

from .tables import Direction, Named, Vector

LEAST_SINE = 1e-3
"""Two axes whose angle has a smaller sine do not span a plane."""


class Gauge(Named):
    """Strain gauge on the surface: mean strain along `direction`, positive in tension.

    The mean is over `length` along the direction and `width` across it.
    """

    point: Vector
    direction: Direction
    length: float = Field(default=0.0, ge=0.0)
    width: float = Field(default=0.0, ge=0.0)


class Rosette(Part):
    """Gauges NAME_a, NAME_b, ... at one point, at `angles` [degrees] from axis 1 towards axis 2.

    Axis 1 is along the first vector of `axes`; axis 2 lies in the plane of both, at right angles to it.
    """

    name: Annotated[str, Field(max_length=30, pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
    point: Vector
    axes: tuple[Vector, Vector]
    angles: Annotated[tuple[float, ...], Field(min_length=2, max_length=6)] = (0.0, 45.0, 90.0)
    length: float = Field(default=0.0, ge=0.0)
    width: float = Field(default=0.0, ge=0.0)

    @model_validator(mode="after")
    def _spans_a_plane(self) -> "Rosette":
        first, second = (np.asarray(axis) for axis in self.axes)
        sizes = float(np.linalg.norm(first) * np.linalg.norm(second))
        if np.linalg.norm(np.cross(first, second)) <= LEAST_SINE * sizes:
            raise ValueError("the two axes must point in two directions of the surface")
        return self

    def gauges(self) -> list[dict[str, Any]]:
        """Return its gauges as tables of a structure file."""
        first = np.asarray(self.axes[0]) / np.linalg.norm(self.axes[0])
        second = np.asarray(self.axes[1]) - (first @ np.asarray(self.axes[1])) * first
        second /= np.linalg.norm(second)
        turned = [
            np.cos(angle) * first + np.sin(angle) * second for angle in np.radians(self.angles).tolist()
        ]
        common = {"point": self.point, "length": self.length, "width": self.width}
        return [
            {"name": f"{self.name}_{letter}", "direction": tuple(direction.tolist())} | common
            for letter, direction in zip("abcdef", turned, strict=False)
        ]


def with_rosettes(content: dict[str, Any], source: str, error: type[Exception]) -> dict[str, Any]:
    """Return the content of a structure file whose rosettes have become gauges, behind its own.

    Raises
    ------
    error
        One sentence that names `source`, the rosette and its fault.
    """
    tables = content.get("rosette")
    if not isinstance(tables, list):
        return content
    rosettes = [
        checked(Rosette, table, f"{source}: rosette[{number}]", error, what="a rosette")
        for number, table in enumerate(tables, start=1)
    ]
    kept = {key: value for key, value in content.items() if key != "rosette"}
    own = content.get("gauge", [])
    if not isinstance(own, list):
        return kept
    return kept | {"gauge": [*own, *(gauge for rosette in rosettes for gauge in rosette.gauges())]}
