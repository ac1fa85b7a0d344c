"""Laws of speed: F = k |x|^a |v - l|^p sgn(v - l), on both sides of the level l or above it.

If only the law acts, the speed s of its port obeys s' = -strength |s - l|^p sgn(s - l). The
strength is w k |x|^a, where w is the port's inverse mass: its speed after a unit impulse. The
functions below solve this in closed form. A law may also be a table of forces over speeds with
linear interpolation, which has a closed solution, too. NumPy and relative imports only: this file
is copied into the FMU.
"""

from typing import Annotated, ClassVar

import numpy as np

from ..arrays import POSITION
from .interface import NOT_NEGATIVE, PARAMETERS, POSITIVE, FloatArray, PortForce, power
from .tables import TabulatedForce

COEFFICIENT, EXPONENT, POSITION_EXPONENT, LEVEL, ONE_SIDED = range(5)
"""Columns of a law's parameters: k, p, a, l, and 1 if there is no force below the level. With
`TABLE` in the last one, the number of points follows, then their speeds, their forces over k, and
the integral of these from the first point on."""
TABLE = 2.0


def force_of_mean_speed(
    law: FloatArray, memory: FloatArray, x: float, duration: float
) -> tuple[float, float]:
    """Return the force of a law of speed at `x`, and its derivative by `x`.

    The speed is the mean speed since the last position, (x - last position) / duration. The force
    is coefficient |x|^a |speed - level|^p with the sign of speed - level, or from a table of the
    speed; a one-sided law has no force below the level. Dry friction (p = 0) returns its largest
    force, with the sign for a forward motion.
    """
    exponent = law[EXPONENT]
    if law[ONE_SIDED] == TABLE:
        force, slope = table_force_and_slope(law, (x - memory[POSITION]) / duration)
        return force, slope / duration
    force = law[COEFFICIENT] * power(abs(x), law[POSITION_EXPONENT])
    above_level = (x - memory[POSITION]) / duration - law[LEVEL]
    if law[ONE_SIDED] == 1.0 and above_level <= 0.0:
        return 0.0, 0.0
    if exponent == 0.0:
        return force, (force * law[POSITION_EXPONENT] / x if x != 0.0 else 0.0)
    if above_level == 0.0:
        if exponent == 1.0:
            return 0.0, force / duration
        return 0.0, (1e300 if exponent < 1.0 else 0.0)  # the force rises vertically, or not at all
    force *= power(abs(above_level), exponent)
    slope = force * exponent / (duration * abs(above_level))
    if above_level < 0.0:
        force = -force
    return force, (slope + force * law[POSITION_EXPONENT] / x if x != 0.0 else slope)


class PowerDamping(PortForce):
    """F = coefficient |v / v0|^velocity_exponent |x / x0|^displacement_exponent sgn v.

    Coulomb friction has both exponents zero, quadratic damping velocity_exponent 2, structural
    damping displacement_exponent 1. `coefficient` [N or N m] is the force at v0 =
    `reference_velocity` and x0 = `reference_displacement`.
    """

    depends_on_speed: ClassVar[bool] = True
    coefficient: Annotated[float, "N or N m", NOT_NEGATIVE]
    """Factor of the law."""
    velocity_exponent: Annotated[float, "1", NOT_NEGATIVE]
    """Exponent of the speed."""
    displacement_exponent: Annotated[float, "1", NOT_NEGATIVE]
    """Exponent of the displacement."""
    reference_velocity: Annotated[float, "m/s or rad/s", POSITIVE]
    """Speed by which the speed of the law is divided."""
    reference_displacement: Annotated[float, "m or rad", POSITIVE]
    """Displacement by which the displacement of the law is divided."""
    force_and_slope = staticmethod(force_of_mean_speed)

    @property
    def parameter_row(self) -> FloatArray:
        """k, p and a; the level is zero, and the law acts on both sides of it."""
        p = self.velocity_exponent
        a = self.displacement_exponent
        k = self.coefficient / self.reference_velocity**p / self.reference_displacement**a
        return np.array((k, p, a, 0.0, 0.0))


class Overflow(PortForce):
    """F = coefficient ((v - level) / v0)^exponent where v > level, else zero.

    v0 is `reference_velocity`.

    A flow that begins at a level, such as that of an overflow or a relief valve. At a port whose
    speed is a filling level, F is a flow out of the full store.
    """

    depends_on_speed: ClassVar[bool] = True
    coefficient: Annotated[float, "N or N m", NOT_NEGATIVE]
    """Factor of the law."""
    exponent: Annotated[float, "1", POSITIVE]
    """Exponent of the law."""
    level: Annotated[float, "m/s or rad/s", NOT_NEGATIVE]
    """Speed, or value of the state, at which the law begins."""
    reference_velocity: Annotated[float, "m/s or rad/s", POSITIVE]
    """Speed by which the speed of the law is divided."""
    force_and_slope = staticmethod(force_of_mean_speed)

    @property
    def parameter_row(self) -> FloatArray:
        """k, p and the level; the law acts above the level only."""
        k = self.coefficient / self.reference_velocity**self.exponent
        return np.array((k, self.exponent, 0.0, self.level, 1.0))


class TableDamping(TabulatedForce, PortForce):
    """F(v) by a table: `forces` at rising `speeds`, with straight lines in between.

    Before the first speed and beyond the last one the force is constant.
    """

    depends_on_speed: ClassVar[bool] = True
    speeds: Annotated[tuple[float, ...], "m/s or rad/s"]
    """Speeds of the table, rising."""
    forces: Annotated[tuple[float, ...], "N or N m"]
    """Force at each displacement or speed of the table."""
    force_and_slope = staticmethod(force_of_mean_speed)

    @property
    def parameter_row(self) -> FloatArray:
        """The largest force as k, and the table as the head of this file says."""
        forces = self.relative_forces
        areas = 0.5 * (forces[1:] + forces[:-1]) * np.diff(self.speeds)
        head = [self.magnitude, 1.0, 0.0, 0.0, TABLE, len(forces)]
        return np.array([*head, *self.speeds, *forces, 0.0, *np.cumsum(areas)])

    def check(self) -> None:
        """Raise `InvalidPatchError` unless there are two points or more, in rising order."""
        self.check_positions("speeds", self.speeds)


def table_force_and_slope(law: FloatArray, speed: float) -> tuple[float, float]:
    """Interpolate the force in a table at a speed; return it and its derivative."""
    count = int(law[PARAMETERS])
    speeds = law[PARAMETERS + 1 : PARAMETERS + 1 + count]
    forces = law[PARAMETERS + 1 + count : PARAMETERS + 1 + 2 * count]
    if speed <= speeds[0]:
        return law[COEFFICIENT] * forces[0], 0.0
    if speed >= speeds[-1]:
        return law[COEFFICIENT] * forces[-1], 0.0
    left = np.searchsorted(speeds, speed) - 1
    slope = (forces[left + 1] - forces[left]) / (speeds[left + 1] - speeds[left])
    force = forces[left] + slope * (speed - speeds[left])
    return law[COEFFICIENT] * force, law[COEFFICIENT] * slope


def table_integral(law: FloatArray, speed: float) -> float:
    """Return the integral of a table's force over the speed, from its first point on."""
    count = int(law[PARAMETERS])
    speeds = law[PARAMETERS + 1 : PARAMETERS + 1 + count]
    forces = law[PARAMETERS + 1 + count : PARAMETERS + 1 + 2 * count]
    integrals = law[PARAMETERS + 1 + 2 * count : PARAMETERS + 1 + 3 * count]
    left = max(int(np.searchsorted(speeds, speed)) - 1, 0)
    force, _ = table_force_and_slope(law, speed)
    # the force is a straight line from the point at the left, or constant beyond the ends
    mean_force = 0.5 * (law[COEFFICIENT] * forces[left] + force)
    return float(law[COEFFICIENT] * integrals[left] + mean_force * (speed - speeds[left]))


def speed_after_table(law: FloatArray, speed: float, strength: float, duration: float) -> float:
    """Return the speed of a port on which only the force of a table has acted.

    Along each linear piece of the table the speed is an exponential function of time. Where the
    force is zero, the speed stays.

    Parameters
    ----------
    law : (5 + E,) array
        The table.
    speed : float
        Speed at the beginning.
    strength : float
        Deceleration by the largest force of the table.
    duration : float
        Duration [s].
    """
    count = int(law[PARAMETERS])
    speeds = law[PARAMETERS + 1 : PARAMETERS + 1 + count]
    forces = law[PARAMETERS + 1 + count : PARAMETERS + 1 + 2 * count]
    remaining = duration
    for _ in range(count + 2):
        force = table_force_and_slope(law, speed)[0] / law[COEFFICIENT]
        if force == 0.0:
            return speed
        # the next point in the direction in which the force drives the speed
        if force > 0.0:
            target = np.searchsorted(speeds, speed) - 1
        else:
            target = np.searchsorted(speeds, speed, "right")
        if target < 0 or target >= count:  # beyond the table the force is constant
            return float(speed - strength * force * remaining)
        distance = speeds[target] - speed
        slope = (forces[target] - force) / distance
        rate = strength * slope
        # the force changes as exp(-rate t), and reaches that of the point unless it vanishes before
        ratio = forces[target] / force
        if abs(ratio - 1.0) < 1e-9:
            time_to_point = -distance / (strength * force)
        elif ratio > 0.0:
            time_to_point = -np.log(ratio) / rate
        else:
            time_to_point = np.inf
        if time_to_point >= remaining:
            decay = rate * remaining
            if abs(decay) < 1e-9:
                return float(speed - strength * force * remaining)
            return float(speed + force / slope * np.expm1(-decay))
        speed = speeds[target]
        remaining -= time_to_point
    return speed


def can_hold(law: FloatArray) -> bool:
    """Return whether the force can stop a port in finite time and hold it."""
    return bool(law[EXPONENT] < 1.0 and law[ONE_SIDED] == 0.0)


def is_dry_friction(law: FloatArray) -> bool:
    """Return whether the magnitude of the force is independent of the speed."""
    return bool(law[EXPONENT] == 0.0)


def strength(law: FloatArray, x: float, inverse_mass: float) -> float:
    """Return the strength of a law at position `x` of a port, see the head of this file."""
    return float(inverse_mass * law[COEFFICIENT] * power(abs(x), law[POSITION_EXPONENT]))


def steady_force(law: FloatArray, x: float, speed: float) -> float:
    """Return the force of a law at a position and a speed."""
    if law[ONE_SIDED] == TABLE:
        return float(table_force_and_slope(law, speed)[0])
    above_level = speed - law[LEVEL]
    if above_level == 0.0 or (law[ONE_SIDED] == 1.0 and above_level < 0.0):
        return 0.0
    magnitude = (
        law[COEFFICIENT]
        * power(abs(x), law[POSITION_EXPONENT])
        * power(abs(above_level), law[EXPONENT])
    )
    return float(magnitude if above_level > 0.0 else -magnitude)


def speed_after(
    law: FloatArray, speed: float, strength: float, duration: float, passes_zero: bool
) -> float:
    """Return the speed of a port on which only the law has acted for a duration [s].

    With the level l and the exponent p of the law, the speed s obeys s' = -strength |s - l|^p
    sgn(s - l), which has a closed solution for each exponent. With `passes_zero`, dry friction
    keeps its sign when the speed passes zero, instead of stopping the port there.
    """
    if law[ONE_SIDED] == TABLE:
        return speed_after_table(law, speed, strength, duration)
    exponent = law[EXPONENT]
    above_level = speed - law[LEVEL]
    distance = abs(above_level)
    impulse = strength * duration
    is_inactive = distance == 0.0 or (law[ONE_SIDED] == 1.0 and above_level < 0.0)
    # The power of a tiny speed would overflow; its change is negligible.
    if is_inactive or (exponent > 1.0 and distance < 1e-60):
        return speed
    if exponent == 0.0:
        distance = distance - impulse if passes_zero else max(distance - impulse, 0.0)
    elif exponent == 1.0:
        distance *= np.exp(-impulse)
    elif exponent == 2.0:
        distance /= 1.0 + impulse * distance
    else:
        base = distance ** (1.0 - exponent) - (1.0 - exponent) * impulse
        distance = base ** (1.0 / (1.0 - exponent)) if base > 0.0 else 0.0
    return float(law[LEVEL] + distance if above_level > 0.0 else law[LEVEL] - distance)


def holding_limit(law: FloatArray, strength: float, duration: float) -> float:
    """Return the largest speed that a law which `can_hold` stops within `duration` [s]."""
    one_minus_exponent = 1.0 - law[EXPONENT]
    return power(one_minus_exponent * strength * duration, 1.0 / one_minus_exponent)


def reversal_correction(
    law: FloatArray,
    begin: float,
    end: float,
    slopes: tuple[float, float],
    speed_lost: float,
    strength: float,
    duration: float,
) -> tuple[float, float, float]:
    """Return the correction of a step in which the speed of a port changes its sign.

    In the step, friction had its first sign throughout. The time of the reversal is the zero of the
    cubic (Hermite) interpolation of the speed by its values and slopes at both ends. The impulse of
    friction and its first moment, which gives the position, are corrected for the time after it.

    Parameters
    ----------
    law : (5 + E,) array
        A law that `can_hold`.
    begin, end : float
        Speed at both ends, with friction of the first sign.
    slopes : tuple of float
        Accelerations at both ends.
    speed_lost : float
        Decrease of the speed by the first half of the impulse.
    strength : float
        Strength of the law at its position.
    duration : float
        Duration of the step [s].

    Returns
    -------
    speed : float
        Correction of the speed at the end.
    position : float
        Correction of the position at the end. If friction holds the port, it is instead the
        distance from the position at the beginning of the step to that of the reversal.
    is_held : float
        1 if friction holds the port from the reversal on, else 0.
    """
    sign = 1.0 if begin > 0.0 else -1.0
    power_plus_one = law[EXPONENT] + 1.0
    # coefficients of the cubic, by the fraction u of the step
    linear = duration * slopes[0]
    square = 3.0 * (end - begin) - 2.0 * linear - duration * slopes[1]
    cubic = linear + duration * slopes[1] - 2.0 * (end - begin)
    # the reversal, by bisection
    low = 0.0
    high = 1.0
    for _ in range(40):
        fraction = 0.5 * (low + high)
        if sign * (begin + fraction * (linear + fraction * (square + fraction * cubic))) > 0.0:
            low = fraction
        else:
            high = fraction
    fraction = 0.5 * (low + high)
    slope = (linear + fraction * (2.0 * square + 3.0 * fraction * cubic)) / duration
    deceleration = max(-sign * slope, 0.0)
    # acceleration towards the other side, without friction
    free_acceleration = -sign * (slope + 2.0 * speed_lost / duration)
    limit = holding_limit(law, strength, 0.5 * duration)
    if free_acceleration <= 0.0 or 0.5 * duration * free_acceleration <= limit:
        distance = (
            duration
            * fraction
            * (
                begin
                + fraction * (linear / 2.0 + fraction * (square / 3.0 + fraction * cubic / 4.0))
            )
        )
        if power_plus_one == 1.0:
            distance -= sign * strength * duration * duration / 12.0
        return 0.0, distance, 1.0
    # impulses and first moment of friction before and after the reversal
    time_before = fraction * duration
    time_after = (1.0 - fraction) * duration
    impulse_before = (
        -sign
        * strength
        * power(deceleration, law[EXPONENT])
        * time_before**power_plus_one
        / power_plus_one
    )
    impulse_after = (
        -sign
        * strength
        * power(free_acceleration, law[EXPONENT])
        * time_after**power_plus_one
        / power_plus_one
    )
    lever_arm = time_after + time_before * power_plus_one / (power_plus_one + 1.0)
    moment = impulse_before * lever_arm - impulse_after * time_after / (power_plus_one + 1.0)
    if power_plus_one == 1.0:
        # Half impulses at both ends of a step shift the position by force h^2 / 12. The shift is
        # undone when the force ends, but here the next force begins, of the other sign.
        moment -= sign * strength * duration * duration / 6.0
    return impulse_before - impulse_after + speed_lost, moment + speed_lost * duration, 0.0
