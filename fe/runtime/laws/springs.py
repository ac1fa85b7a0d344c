"""Laws of position without memory. NumPy and relative imports only: this file is copied into the FMU."""

from typing import Annotated

import numpy as np

from ..errors import InvalidPatchError
from .interface import NOT_NEGATIVE, POSITIVE, FloatArray, PortForce, power


class PowerStiffness(PortForce):
    """F = coefficient |x / x0|^exponent sgn x; `side` 0: both signs of x, +1 or -1: that sign only.

    A cubic spring has exponent 3 and side 0; a breathing crack exponent 1, side -1, coefficient negative.
    `coefficient` [N or N m] is the force at x0 = `reference_displacement`.
    """

    coefficient: Annotated[float, "N or N m"]
    exponent: Annotated[float, "1", POSITIVE]
    side: int
    reference_displacement: Annotated[float, "m or rad", POSITIVE]

    def check(self) -> None:
        """Raise `InvalidPatchError` where a number cannot be."""
        super().check()
        if abs(self.side) > 1:
            raise InvalidPatchError(f"side of {self.kind!r} must lie from -1 to 1, but is {self.side:g}.")

    @staticmethod
    def pull(law: FloatArray, memory: FloatArray, x: float, h: float) -> tuple[float, float]:
        """Return force and slope at `x`."""
        if law[2] * x < 0.0 or x == 0.0:
            return 0.0, (law[0] / law[3] if law[1] == 1.0 and law[2] == 0.0 else 0.0)
        size = law[0] * power(abs(x / law[3]), law[1])
        return (size if x > 0.0 else -size), law[1] * size / abs(x)


class FreePlay(PortForce):
    """F = -stiffness clip(x, -half_width, half_width): the port's spring is absent inside the gap.

    `stiffness` [N/m or N m/rad] is the part of the stiffness that the gap removes.
    """

    stiffness: Annotated[float, "N/m or N m/rad"]
    half_width: Annotated[float, "m or rad", NOT_NEGATIVE]

    @property
    def magnitude(self) -> float:
        """Largest force."""
        return self.stiffness * self.half_width

    @staticmethod
    def pull(law: FloatArray, memory: FloatArray, x: float, h: float) -> tuple[float, float]:
        """Return force and slope at `x`."""
        return -law[0] * min(max(x, -law[1]), law[1]), (-law[0] if abs(x) < law[1] else 0.0)


class SineForce(PortForce):
    """F = coefficient sin(wave_number x + phase), against x: weight of a pendulum, cogging of a motor.

    m g l sin x brings a pendulum back to x = 0.
    """

    coefficient: Annotated[float, "N or N m"]
    wave_number: Annotated[float, "rad/m or 1"]
    phase: Annotated[float, "rad"]

    @staticmethod
    def pull(law: FloatArray, memory: FloatArray, x: float, h: float) -> tuple[float, float]:
        """Return force and slope at `x`."""
        angle = law[1] * x + law[2]
        return law[0] * np.sin(angle), law[0] * law[1] * np.cos(angle)
