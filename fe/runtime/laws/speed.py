"""Laws of speed, powers of it: F = k |x|^a |v - l|^p sgn(v - l), on both sides of the level l or above it.

Their row: k, p, a, l, and 1 where there is none below the level. Alone at a port of speed s a law takes
s' = -strength |s - l|^p sgn(s - l), strength = w k |x|^a, w the speed by a unit impulse, in closed form.
NumPy and relative imports only: this file is copied into the FMU.
"""

from typing import Annotated, ClassVar

import numpy as np

from ..arrays import PLACE
from .interface import NOT_NEGATIVE, POSITIVE, FloatArray, PortForce, power


def way_pull(law: FloatArray, memory: FloatArray, x: float, h: float) -> tuple[float, float]:
    """Return force and slope at `x`, the speed being that of the way; of dry friction the largest force."""
    size, exponent = law[0] * power(abs(x), law[2]), law[1]
    above = (x - memory[PLACE]) / h - law[3]
    if law[4] == 1.0 and above <= 0.0:
        return 0.0, 0.0
    if exponent == 0.0:
        return size, (size * law[2] / x if x != 0.0 else 0.0)
    if above == 0.0:
        return 0.0, (size / h if exponent == 1.0 else 1e300 if exponent < 1.0 else 0.0)
    size *= power(abs(above), exponent)
    slope = size * exponent / (h * abs(above))
    if above < 0.0:
        size = -size
    return size, (slope + size * law[2] / x if x != 0.0 else slope)


class PowerDamping(PortForce):
    """F = coefficient |v / v0|^velocity_exponent |x / x0|^displacement_exponent sgn v.

    Coulomb friction has both exponents zero, quadratic damping velocity_exponent 2, structural damping
    displacement_exponent 1. `coefficient` [N or N m] is the force at v0 = `reference_velocity` and
    x0 = `reference_displacement`.
    """

    of_speed: ClassVar[bool] = True
    coefficient: Annotated[float, "N or N m", NOT_NEGATIVE]
    velocity_exponent: Annotated[float, "1", NOT_NEGATIVE]
    displacement_exponent: Annotated[float, "1", NOT_NEGATIVE]
    reference_velocity: Annotated[float, "m/s or rad/s", POSITIVE]
    reference_displacement: Annotated[float, "m or rad", POSITIVE]
    pull = staticmethod(way_pull)

    @property
    def row(self) -> FloatArray:
        """k, p and a."""
        p, a = self.velocity_exponent, self.displacement_exponent
        size = self.coefficient / self.reference_velocity**p / self.reference_displacement**a
        return np.array((size, p, a, 0.0, 0.0))


class Overflow(PortForce):
    """F = coefficient ((v - level) / v0)^exponent where v > level, v0 = `reference_velocity`; else zero.

    What begins at a level, an overflow or a relief valve: of speed, so that at a port of a state it is a flow
    out of what is full, v the level.
    """

    of_speed: ClassVar[bool] = True
    coefficient: Annotated[float, "N or N m", NOT_NEGATIVE]
    exponent: Annotated[float, "1", POSITIVE]
    level: Annotated[float, "m/s or rad/s", NOT_NEGATIVE]
    reference_velocity: Annotated[float, "m/s or rad/s", POSITIVE]
    pull = staticmethod(way_pull)

    @property
    def row(self) -> FloatArray:
        """k, p, the level, and that there is none below."""
        size = self.coefficient / self.reference_velocity**self.exponent
        return np.array((size, self.exponent, 0.0, self.level, 1.0))


def holds(law: FloatArray) -> bool:
    """Return whether the force can bring a port to rest in finite time, and hold it there."""
    return bool(law[1] < 1.0 and law[4] == 0.0)


def strength(law: FloatArray, x: float, weight: float) -> float:
    """Return the strength at a position, for a port whose speed a unit impulse changes by `weight`."""
    return float(weight * law[0] * power(abs(x), law[2]))


def steady(law: FloatArray, x: float, speed: float) -> float:
    """Return the force at a position and a speed."""
    above = speed - law[3]
    if above == 0.0 or (law[4] == 1.0 and above < 0.0):
        return 0.0
    size = law[0] * power(abs(x), law[2]) * power(abs(above), law[1])
    return float(size if above > 0.0 else -size)


def kick(law: FloatArray, speed: float, strength: float, duration: float, through: bool) -> float:
    """Return the speed after the law alone has acted; with `through`, dry friction does not stop at zero."""
    exponent, above = law[1], speed - law[3]
    size, spent = abs(above), strength * duration
    if size == 0.0 or (law[4] == 1.0 and above < 0.0) or (exponent > 1.0 and size < 1e-60):
        return speed
    if exponent == 0.0:
        size = size - spent if through else max(size - spent, 0.0)
    elif exponent == 1.0:
        size *= np.exp(-spent)
    elif exponent == 2.0:
        size /= 1.0 + spent * size
    else:
        root = size ** (1.0 - exponent) - (1.0 - exponent) * spent
        size = root ** (1.0 / (1.0 - exponent)) if root > 0.0 else 0.0
    return float(law[3] + size if above > 0.0 else law[3] - size)


def holding_limit(law: FloatArray, strength: float, duration: float) -> float:
    """Return the largest speed that a law which `holds` brings to rest within `duration`."""
    rest = 1.0 - law[1]
    return power(rest * strength * duration, 1.0 / rest)


def crossing(
    law: FloatArray, begin: float, end: float, slopes: tuple[float, float], lost: float, strength: float,
    h: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return what must be added where the speed of a port changes sign within a step.

    The turn is that of the cubic through the values and slopes of the speed. Impulse and first moment of the
    force are those of the way before and after it.

    Parameters
    ----------
    law : ndarray
        A law that `holds`.
    begin, end : float
        Speed at both ends as friction of the first sign would have it.
    slopes : tuple of float
        Its derivatives there.
    lost : float
        What the first half kick took from the speed.
    strength, h : float
        Of the law at its position; duration of the step.

    Returns
    -------
    speed : float
        To be added to the speed at the end.
    position : float
        To be added to the position at the end; or, if friction holds, the way from the step's begin to the
        turn.
    held : float
        1 if friction holds from the turn on.
    """
    sign, one = (1.0 if begin > 0.0 else -1.0), law[1] + 1.0
    linear = h * slopes[0]
    square = 3.0 * (end - begin) - 2.0 * linear - h * slopes[1]
    cubic = linear + h * slopes[1] - 2.0 * (end - begin)
    low, high = 0.0, 1.0
    for _ in range(40):
        u = 0.5 * (low + high)
        if sign * (begin + u * (linear + u * (square + u * cubic))) > 0.0:
            low = u
        else:
            high = u
    u = 0.5 * (low + high)
    slope = (linear + u * (2.0 * square + 3.0 * u * cubic)) / h
    before = max(-sign * slope, 0.0)
    free = -sign * (slope + 2.0 * lost / h)  # backwards acceleration without this friction
    if free <= 0.0 or 0.5 * h * free <= holding_limit(law, strength, 0.5 * h):
        way = h * u * (begin + u * (linear / 2.0 + u * (square / 3.0 + u * cubic / 4.0)))
        if one == 1.0:
            way -= sign * strength * h * h / 12.0
        return 0.0, way, 1.0
    first, rest = u * h, (1.0 - u) * h
    drag = -sign * strength * power(before, law[1]) * first**one / one
    push = -sign * strength * power(free, law[1]) * rest**one / one
    moment = drag * (rest + first * one / (one + 1.0)) - push * rest / (one + 1.0)
    if one == 1.0:
        # Half kicks at both ends of a step shift the position by force h^2 / 12. The shift is undone when
        # the force ends, but here the next force begins, of the other sign.
        moment -= sign * strength * h * h / 6.0
    return drag - push + lost, moment + lost * h, 0.0
