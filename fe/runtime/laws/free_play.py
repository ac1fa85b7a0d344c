"""Free play: F = -k clip(x, -d, d), the port's spring is absent inside the gap.

Parameters: k, d. No memory. NumPy and relative imports only: this file is copied into the FMU.
"""

from typing import Annotated, ClassVar

from .interface import FloatArray, PortForce


class FreePlay(PortForce):
    """F = -stiffness clip(x, -half_width, half_width): the port's spring is absent inside the gap.

    `stiffness` [N/m or N m/rad] is the part of the stiffness that the gap removes.
    """

    proportional: ClassVar[tuple[str, ...]] = ("stiffness",)
    not_negative: ClassVar[tuple[str, ...]] = ("half_width",)
    stiffness: Annotated[float, "N/m or N m/rad"]
    half_width: Annotated[float, "m or rad"]

    @property
    def magnitude(self) -> float:
        """Largest force."""
        return self.stiffness * self.half_width


def pull(law: FloatArray, memory: FloatArray, x: float, h: float, least: int) -> tuple[float, float]:
    """Return force and slope at `x`."""
    return -law[0] * min(max(x, -law[1]), law[1]), (-law[0] if abs(x) < law[1] else 0.0)
