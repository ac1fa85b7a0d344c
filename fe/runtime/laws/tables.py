"""Laws given by tables: a force at each of some displacements or speeds.

NumPy and relative imports only: this file is copied into the FMU.
"""

from typing import Annotated, ClassVar

import numpy as np

from ..errors import InvalidPatchError
from .interface import PARAMETERS, FloatArray, PortForce

LEAST_DIVISOR = 1e-300
"""Divisor instead of the largest force if that is zero."""


class TabulatedForce:
    """The common part of laws by tables: `forces`, one at each of ascending positions."""

    kind: ClassVar[str]
    forces: tuple[float, ...]
    """Force at each displacement or speed of the table."""

    @property
    def proportional(self) -> tuple[str, ...]:
        """The forces; the positions do not scale the law."""
        return ("forces",)

    @property
    def magnitude(self) -> float:
        """The largest force of the table [N or N m]."""
        return max(map(abs, self.forces), default=0.0)

    @property
    def relative_forces(self) -> FloatArray:
        """The forces divided by the largest one; zeros if all are zero."""
        return np.array(self.forces) / max(self.magnitude, LEAST_DIVISOR)

    def check_positions(self, name: str, positions: tuple[float, ...]) -> None:
        """Raise `InvalidPatchError` unless there are two or more points in ascending order.

        `name` is the name of the displacements or speeds, for the message.
        """
        count = len(positions)
        if count < 2 or len(self.forces) != count or np.any(np.diff(positions) <= 0.0):
            raise InvalidPatchError(
                f"{name} of {self.kind!r} must be two or more rising numbers, each with one of the "
                f"forces, but are {list(positions)} with {len(self.forces)} forces."
            )


class TableStiffness(TabulatedForce, PortForce):
    """F(x) by a table: `forces` at rising `displacements`, and a smooth curve through these points.

    Between two points the curve is a cubic polynomial (Hermite), with the slopes of differences of
    second order at the points. Beyond the first and the last point it goes straight on.
    """

    displacements: Annotated[tuple[float, ...], "m or rad"]
    """Displacements of the table, rising."""
    forces: Annotated[tuple[float, ...], "N or N m"]
    """Force at each displacement or speed of the table."""

    @property
    def parameter_row(self) -> FloatArray:
        """The largest force, the number of points, zeros; then the points of the curve.

        Of the points there are the displacements, then forces and slopes over the largest force.
        """
        forces = self.relative_forces
        slopes = np.gradient(forces, self.displacements)
        unused = [0.0] * (PARAMETERS - 2)
        head = [self.magnitude, len(forces), *unused]
        return np.array([*head, *self.displacements, *forces, *slopes])

    def check(self) -> None:
        """Raise `InvalidPatchError` unless there are two points or more, in rising order."""
        self.check_positions("displacements", self.displacements)

    @staticmethod
    def force_and_slope(
        law: FloatArray, memory: FloatArray, x: float, duration: float
    ) -> tuple[float, float]:
        """Return the force at `x` and its derivative by `x`."""
        largest_force = law[0]
        count = int(law[1])
        displacements = law[PARAMETERS : PARAMETERS + count]
        forces = law[PARAMETERS + count : PARAMETERS + 2 * count]
        slopes = law[PARAMETERS + 2 * count : PARAMETERS + 3 * count]
        if x <= displacements[0] or x >= displacements[-1]:
            end = 0 if x <= displacements[0] else count - 1
            force = forces[end] + slopes[end] * (x - displacements[end])
            return largest_force * force, largest_force * slopes[end]
        left = np.searchsorted(displacements, x) - 1
        slope = slopes[left]
        width = displacements[left + 1] - displacements[left]
        secant = (forces[left + 1] - forces[left]) / width
        # the cubic polynomial in u from 0 to 1: f = f_left + width u (slope + u (square + u cubic))
        u = (x - displacements[left]) / width
        square = 3.0 * secant - 2.0 * slope - slopes[left + 1]
        cubic = slope + slopes[left + 1] - 2.0 * secant
        force = forces[left] + width * u * (slope + u * (square + u * cubic))
        slope_at_x = slope + u * (2.0 * square + 3.0 * u * cubic)
        return largest_force * force, largest_force * slope_at_x
