"""Damping and friction by powers: F = c |v / v0|^p |x / x0|^a sgn v.

Parameters: c, p, a, v0, x0. Memory: whether friction holds the port, and where. Alone at a port of speed s it
takes s' = -strength |s|^p sgn s, which has a closed form. NumPy and relative imports only: this file is
copied into the FMU.
"""

from typing import Annotated, ClassVar

import numpy as np

from .interface import FloatArray, PortForce, decayed, power


class PowerDamping(PortForce):
    """F = coefficient |v / v0|^velocity_exponent |x / x0|^displacement_exponent sgn v.

    Coulomb friction has both exponents zero, quadratic damping velocity_exponent 2, structural damping
    displacement_exponent 1. `coefficient` [N or N m] is the force at v0 = `reference_velocity` and
    x0 = `reference_displacement`.
    """

    of_speed: ClassVar[bool] = True
    proportional: ClassVar[tuple[str, ...]] = ("coefficient",)
    positive: ClassVar[tuple[str, ...]] = ("reference_velocity", "reference_displacement")
    not_negative: ClassVar[tuple[str, ...]] = (
        "coefficient", "velocity_exponent", "displacement_exponent"
    )  # fmt: skip
    coefficient: Annotated[float, "N or N m"]
    velocity_exponent: Annotated[float, "1"]
    displacement_exponent: Annotated[float, "1"]
    reference_velocity: Annotated[float, "m/s or rad/s"]
    reference_displacement: Annotated[float, "m or rad"]


def pull(law: FloatArray, memory: FloatArray, x: float, h: float, least: int) -> tuple[float, float]:
    """Return force and slope at `x`, the speed being that of the way; of dry friction the largest force."""
    way = abs(x - memory[1])
    size = law[0] * power(abs(x / law[4]), law[2])
    if law[1] == 0.0:
        return size, (size * law[2] / x if x != 0.0 else 0.0)
    if way == 0.0:
        return 0.0, (size / (h * law[3]) if law[1] == 1.0 else 1e300 if law[1] < 1.0 else 0.0)
    size *= power(way / (h * law[3]), law[1])
    slope = size * law[1] / way
    if x < memory[1]:
        size = -size
    return size, (slope + size * law[2] / x if x != 0.0 else slope)


# ---------------------------------------------------------------- as a law of speed


def dry(law: FloatArray) -> bool:
    """Return whether p is zero."""
    return bool(law[1] == 0.0)


def holds(law: FloatArray) -> bool:
    """Return whether p is below one."""
    return bool(law[1] < 1.0)


def strength(law: FloatArray, weight: float) -> float:
    """Return the strength at x0 for a port whose speed a unit impulse changes by `weight`."""
    return float(weight * law[0] / power(law[3], law[1]))


def share(law: FloatArray, x: float) -> float:
    """Return |x / x0|^a."""
    return float(power(abs(x / law[4]), law[2]))


def steady(law: FloatArray, x: float, speed: float) -> float:
    """Return the force at a position and a speed."""
    size = law[0] * power(abs(x / law[4]), law[2])
    return float(size * (power(abs(speed) / law[3], law[1]) * np.sign(speed)))


def kick(law: FloatArray, speed: float, strength: float, duration: float, through: bool) -> float:
    """Return the speed after s' = -strength |s|^p sgn s alone; with `through`, dry friction turns it."""
    exponent = law[1]
    if through and exponent == 0.0:
        after = speed - duration * strength if speed > 0.0 else speed + duration * strength
        return 0.0 if speed == 0.0 else after
    size = abs(speed)
    if size == 0.0 or (exponent > 1.0 and size < 1e-60):
        return speed
    size = decayed(size, exponent, strength, duration)
    return size if speed > 0.0 else -size


def holding_limit(law: FloatArray, strength: float, duration: float) -> float:
    """Return the largest speed that `kick` brings to rest within `duration`, p below one."""
    rest = 1.0 - law[1]
    return power(rest * strength * duration, 1.0 / rest)


def crossing(
    law: FloatArray, begin: float, end: float, slopes: tuple[float, float], lost: float, strength: float,
    h: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return what to add to speed and position where a port turns within a step, and whether it is held.

    The turn is that of the cubic through the values and slopes of the speed. Impulse and first moment of the
    force are those of the way before and after it.
    """
    exponent = law[1]
    sign = 1.0 if begin > 0.0 else -1.0
    a, b, m, n = begin, end, h * slopes[0], h * slopes[1]
    low, high = 0.0, 1.0
    for _ in range(40):  # bisection of the cubic through values and slopes
        u = 0.5 * (low + high)
        value = (
            a * (1.0 + u * u * (2.0 * u - 3.0))
            + m * u * (1.0 - u) * (1.0 - u)
            + b * u * u * (3.0 - 2.0 * u)
            + n * u * u * (u - 1.0)
        )
        if sign * value > 0.0:
            low = u
        else:
            high = u
    u = 0.5 * (low + high)
    slope = (6.0 * (b - a) * u * (1.0 - u) + m * (1.0 - u) * (1.0 - 3.0 * u) + n * u * (3.0 * u - 2.0)) / h
    before = max(-sign * slope, 0.0)
    free = -sign * (slope + 2.0 * lost / h)  # backwards acceleration without this friction
    if free <= 0.0 or 0.5 * h * free <= holding_limit(law, strength, 0.5 * h):
        u2 = u * u
        way = h * (
            a * (u - u2 * u + 0.5 * u2 * u2)
            + m * (0.5 * u2 - 2.0 / 3.0 * u2 * u + 0.25 * u2 * u2)
            + b * (u2 * u - 0.5 * u2 * u2)
            + n * (0.25 * u2 * u2 - u2 * u / 3.0)
        )
        if exponent == 0.0:
            way -= sign * strength * h * h / 12.0
        return 0.0, way, 1.0
    one = exponent + 1.0
    first, rest = u * h, (1.0 - u) * h
    drag, push = power(before, exponent), power(free, exponent)
    impulse = -sign * strength * (drag * first**one - push * rest**one) / one
    moment = (
        -sign
        * strength
        * (
            drag * (rest * first**one / one + first ** (one + 1.0) / (one + 1.0))
            - push * rest ** (one + 1.0) * (1.0 / one - 1.0 / (one + 1.0))
        )
    )
    if exponent == 0.0:
        # Half kicks at both ends of a step shift the position by force h^2 / 12. The shift is undone when
        # the force ends, but here the next force begins, of the other sign.
        moment -= sign * strength * h * h / 6.0
    return impulse + lost, moment + lost * h, 0.0
