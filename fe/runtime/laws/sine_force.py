"""A force that is a sine of position: weight of a pendulum, cogging of a motor, F = c sin(k x + p).

Parameters: c, k, p. No memory. NumPy and relative imports only: this file is copied into the FMU.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from .interface import FloatArray, PortForce


@dataclass(frozen=True, slots=True)
class SineForce(PortForce):
    """F = coefficient sin(wave_number x + phase), against x; m g l sin x brings a pendulum back to x = 0."""

    kind: ClassVar[str] = "sine_force"
    proportional: ClassVar[tuple[str, ...]] = ("coefficient",)
    units: ClassVar[dict[str, str]] = {
        "coefficient": "N or N m", "wave_number": "rad/m or 1", "phase": "rad"
    }  # fmt: skip
    coefficient: float
    wave_number: float
    phase: float

    @property
    def row(self) -> tuple[float, ...]:
        """c, k, p."""
        return self.coefficient, self.wave_number, self.phase

    @property
    def magnitude(self) -> float:
        """The largest force."""
        return self.coefficient


def force(law: FloatArray, memory: FloatArray, x: float) -> float:
    """Return the force at `x`."""
    return float(law[0] * np.sin(law[1] * x + law[2]))


def slope(law: FloatArray, elements: FloatArray, memory: FloatArray, x: float) -> float:
    """Return the derivative of the force."""
    return float(law[0] * law[1] * np.cos(law[1] * x + law[2]))


def pull(
    law: FloatArray, elements: FloatArray, memory: FloatArray, x: float, h: float, least: int
) -> tuple[float, float]:
    """Return force and slope at `x`."""
    return force(law, memory, x), slope(law, elements, memory, x)


def settle(
    law: FloatArray, elements: FloatArray, memory: FloatArray, y: float, r: float, h: float, about: float
) -> float:
    """Return F of x + r F(x) = y, and carry the memory to that x: the root between y - r c and y + r c."""
    low, high = y - abs(r * law[0]), y + abs(r * law[0])
    x = min(max(about, low), high)
    for _ in range(60):
        rest = x + r * force(law, memory, x) - y
        if abs(rest) <= 1e-14 * (abs(x) + high - low) or high - low <= 1e-15 * abs(high):
            break
        if rest > 0.0:
            high = x
        else:
            low = x
        gradient = 1.0 + r * slope(law, elements, memory, x)
        step = x - rest / gradient if gradient > 0.0 else low
        x = step if low < step < high else 0.5 * (low + high)
    memory[1] = x
    return force(law, memory, x)
