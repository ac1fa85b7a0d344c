"""Spring of any power, on one side or both: F = c |x / x0|^n sgn x where side x >= 0.

Parameters: c, n, side (0: both), x0. No memory. NumPy and relative imports only: this file is copied into the
FMU.
"""

from typing import Annotated, ClassVar

from ..errors import InvalidPatchError
from .interface import FloatArray, PortForce, power


class PowerStiffness(PortForce):
    """F = coefficient |x / x0|^exponent sgn x; `side` 0: both signs of x, +1 or -1: that sign only.

    A cubic spring has exponent 3 and side 0; a breathing crack exponent 1, side -1, coefficient negative.
    `coefficient` [N or N m] is the force at x0 = `reference_displacement`.
    """

    proportional: ClassVar[tuple[str, ...]] = ("coefficient",)
    positive: ClassVar[tuple[str, ...]] = ("reference_displacement", "exponent")
    coefficient: Annotated[float, "N or N m"]
    exponent: Annotated[float, "1"]
    side: int
    reference_displacement: Annotated[float, "m or rad"]

    def check(self) -> None:
        """Raise `InvalidPatchError` where a number cannot be."""
        super().check()
        if abs(self.side) > 1:
            raise InvalidPatchError(f"side of {self.kind!r} must lie from -1 to 1, but is {self.side:g}.")


def pull(law: FloatArray, memory: FloatArray, x: float, h: float, least: int) -> tuple[float, float]:
    """Return force and slope at `x`."""
    if law[2] * x < 0.0 or x == 0.0:
        return 0.0, (law[0] / law[3] if law[1] == 1.0 and law[2] == 0.0 else 0.0)
    size = law[0] * power(abs(x / law[3]), law[1])
    return (size if x > 0.0 else -size), law[1] * size / abs(x)
