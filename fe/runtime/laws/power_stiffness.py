"""Spring of any power, on one side or both: F = c |x / x0|^n sgn x where side x >= 0.

Parameters: c, n, side (0: both), x0. No memory. NumPy and relative imports only: this file is copied into the
FMU.
"""

from dataclasses import dataclass
from typing import ClassVar

from ..errors import InvalidPatchError
from .interface import FloatArray, PortForce, power


@dataclass(frozen=True, slots=True)
class PowerStiffness(PortForce):
    """F = coefficient |x / x0|^exponent sgn x; `side` 0: both signs of x, +1 or -1: that sign only.

    A cubic spring has exponent 3 and side 0; a breathing crack exponent 1, side -1, coefficient negative.
    `coefficient` [N or N m] is the force at x0 = `reference_displacement`.
    """

    kind: ClassVar[str] = "power_stiffness"
    proportional: ClassVar[tuple[str, ...]] = ("coefficient",)
    units: ClassVar[dict[str, str]] = {
        "coefficient": "N or N m", "exponent": "1", "reference_displacement": "m or rad"
    }  # fmt: skip
    coefficient: float
    exponent: float
    side: int
    reference_displacement: float

    @property
    def row(self) -> tuple[float, ...]:
        """c, n, side, x0."""
        return self.coefficient, self.exponent, float(self.side), self.reference_displacement

    @property
    def magnitude(self) -> float:
        """Force at x0."""
        return self.coefficient

    def check(self) -> None:
        """Raise `InvalidPatchError` where a number cannot be."""
        self.require(
            positive={"reference_displacement": self.reference_displacement, "exponent": self.exponent},
            least_zero={},
        )
        if abs(self.side) > 1:
            raise InvalidPatchError(f"side of {self.kind!r} must lie from -1 to 1, but is {self.side:g}.")


def force(law: FloatArray, memory: FloatArray, x: float) -> float:
    """Return the force at `x`."""
    if law[2] * x < 0.0 or x == 0.0:
        return 0.0
    size = law[0] * power(abs(x / law[3]), law[1])
    return float(size if x > 0.0 else -size)


def slope(law: FloatArray, elements: FloatArray, memory: FloatArray, x: float) -> float:
    """Return the derivative of the force."""
    if law[2] * x < 0.0 or x == 0.0:
        return float(law[0] / law[3]) if law[1] == 1.0 and law[2] == 0.0 else 0.0
    return float(law[0] * law[1] / law[3] * power(abs(x / law[3]), law[1] - 1.0))


def pull(
    law: FloatArray, elements: FloatArray, memory: FloatArray, x: float, h: float, least: int
) -> tuple[float, float]:
    """Return force and slope at `x`."""
    return force(law, memory, x), slope(law, elements, memory, x)


def settle(
    law: FloatArray, elements: FloatArray, memory: FloatArray, y: float, r: float, h: float, about: float
) -> float:
    """Return F of x + r F(x) = y, and carry the memory to that x."""
    memory[1] = _position(law, y, r)
    return force(law, memory, memory[1])


def _position(law: FloatArray, y: float, r: float) -> float:
    """Return x of x + r F(x) = y: the root of the same sign as y next to zero load."""
    if y == 0.0 or law[2] * y < 0.0:
        return y
    n = law[1]
    size, stiff = abs(y), r * law[0] / law[3]
    sign = 1.0 if y > 0.0 else -1.0
    if n == 1.0:
        return y / (1.0 + stiff) if stiff > -1.0 else y
    x = size
    low, high = 0.0, size
    if stiff < 0.0:
        low, high = size, 1e300
        if n < 1.0:  # beyond the root, from where Newton's steps come down to it
            x = 2.0 * size + law[3] * (-2.0 * stiff) ** (1.0 / (1.0 - n))
    for _ in range(60):
        held = stiff * law[3] * power(x / law[3], n)
        rest = x + held - size
        if abs(rest) <= 1e-14 * (x + size):
            break
        if rest > 0.0:
            high = x
        else:
            low = x
        gradient = 1.0 + n * held / x
        if gradient <= 0.0:
            break  # softer than the flexibility beside it can hold
        step = x - rest / gradient
        x = step if low < step < high else 0.5 * (low + min(high, 2.0 * x + size))
    return sign * x
