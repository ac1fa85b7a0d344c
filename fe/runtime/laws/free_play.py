"""Free play: F = -k clip(x, -d, d), the port's spring is absent inside the gap.

Parameters: k, d. No memory. NumPy and relative imports only: this file is copied into the FMU.
"""

from dataclasses import dataclass
from typing import ClassVar

from .interface import FloatArray, PortForce


@dataclass(frozen=True, slots=True)
class FreePlay(PortForce):
    """F = -stiffness clip(x, -half_width, half_width): the port's spring is absent inside the gap.

    `stiffness` [N/m or N m/rad] is the part of the stiffness that the gap removes.
    """

    kind: ClassVar[str] = "free_play"
    proportional: ClassVar[tuple[str, ...]] = ("stiffness",)
    units: ClassVar[dict[str, str]] = {"stiffness": "N/m or N m/rad", "half_width": "m or rad"}
    stiffness: float
    half_width: float

    @property
    def row(self) -> tuple[float, ...]:
        """k, d."""
        return self.stiffness, self.half_width

    @property
    def magnitude(self) -> float:
        """Largest force."""
        return self.stiffness * self.half_width

    def check(self) -> None:
        """Raise `InvalidPatchError` for a gap of negative width."""
        self.require(positive={}, least_zero={"half_width": self.half_width})


def force(law: FloatArray, memory: FloatArray, x: float) -> float:
    """Return the force at `x`."""
    return float(-law[0] * min(max(x, -law[1]), law[1]))


def slope(law: FloatArray, elements: FloatArray, memory: FloatArray, x: float) -> float:
    """Return the derivative of the force."""
    return float(-law[0]) if abs(x) < law[1] else 0.0


def pull(
    law: FloatArray, elements: FloatArray, memory: FloatArray, x: float, h: float, least: int
) -> tuple[float, float]:
    """Return force and slope at `x`."""
    return force(law, memory, x), slope(law, elements, memory, x)


def settle(
    law: FloatArray, elements: FloatArray, memory: FloatArray, y: float, r: float, h: float, about: float
) -> float:
    """Return F of x + r F(x) = y: F is linear inside the gap and constant outside."""
    within = 1.0 - r * law[0]
    if abs(y) < within * law[1]:
        memory[1] = y / within
    else:
        memory[1] = y + r * law[0] * (law[1] if y > 0.0 else -law[1])
    return force(law, memory, memory[1])
