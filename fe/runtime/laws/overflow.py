"""What begins at a level, an overflow or a relief valve: F = c ((v - l) / v0)^n where v is above l.

Of speed, so that at a port of a state it is a flow out of what is full: v is the level. Parameters: c, n, l,
v0. Alone at a port of speed s it takes s' = -strength (s - l)^n, which has a closed form. NumPy and relative
imports only: this file is copied into the FMU.
"""

from typing import Annotated, ClassVar

from .interface import FloatArray, PortForce, decayed, power


class Overflow(PortForce):
    """F = coefficient ((v - level) / v0)^exponent where v > level, v0 = `reference_velocity`; else zero."""

    of_speed: ClassVar[bool] = True
    proportional: ClassVar[tuple[str, ...]] = ("coefficient",)
    positive: ClassVar[tuple[str, ...]] = ("reference_velocity", "exponent")
    not_negative: ClassVar[tuple[str, ...]] = ("coefficient", "level")
    coefficient: Annotated[float, "N or N m"]
    exponent: Annotated[float, "1"]
    level: Annotated[float, "m/s or rad/s"]
    reference_velocity: Annotated[float, "m/s or rad/s"]


def pull(law: FloatArray, memory: FloatArray, x: float, h: float, least: int) -> tuple[float, float]:
    """Return force and slope at `x`, the speed being that of the way."""
    above = (x - memory[1]) / h - law[2]
    if above <= 0.0:
        return 0.0, 0.0
    size = law[0] * power(above / law[3], law[1])
    return size, size * law[1] / (above * h)


# ---------------------------------------------------------------- as a law of speed


def strength(law: FloatArray, weight: float) -> float:
    """Return the strength for a port whose speed a unit impulse changes by `weight`."""
    return float(weight * law[0] / power(law[3], law[1]))


def steady(law: FloatArray, x: float, speed: float) -> float:
    """Return the flow at a level."""
    return float(law[0] * power(max(speed - law[2], 0.0) / law[3], law[1]))


def kick(law: FloatArray, speed: float, strength: float, duration: float, through: bool) -> float:
    """Return the level after s' = -strength (s - l)^n alone."""
    above = speed - law[2]
    return float(law[2] + decayed(above, law[1], strength, duration)) if above > 0.0 else speed
