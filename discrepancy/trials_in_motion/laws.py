"""The force of a law along a motion, and its tangents: derivatives with respect to the motion."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray
from fe.compilation import callable_when_compiled, compiled, law_functions
from fe.runtime.arrays import FIRST_ELEMENT, POSITION
from fe.runtime.laws import LAWS, advance, force_and_slope
from fe.runtime.laws.interface import PARAMETERS, PortForce, power
from fe.runtime.laws.speed import (
    COEFFICIENT,
    EXPONENT,
    LEVEL,
    ONE_SIDED,
    POSITION_EXPONENT,
    TABLE,
    steady_force,
    table_integral,
)
from reporting.arrays import LEAST_DIVISOR

LARGEST_HOLDING_EXPONENT = 0.3
"""Exponent of the speed below which a law may hold a body at rest."""
RELATIVE_HALF_DIFFERENCE = 1e-4
"""Half the difference of the position in the tangent of a law of the speed, as a fraction of the
rms position."""


@dataclass(frozen=True, eq=False)
class PortMotion:
    """The motion of a port at the fine stamps, with what laws along it need.

    Attributes
    ----------
    positions, speeds : (F,) ndarray
        The position and the speed [m or rad, and per s].
    """

    positions: FloatArray
    speeds: FloatArray

    @cached_property
    def rms_position(self) -> float:
        """The rms position [m or rad], never zero."""
        return max(float(np.sqrt(np.mean(self.positions**2))), LEAST_DIVISOR)

    @cached_property
    def rms_speed(self) -> float:
        """The rms speed [m/s or rad/s], never zero."""
        return max(float(np.sqrt(np.mean(self.speeds**2))), LEAST_DIVISOR)

    @cached_property
    def half_passed_speeds(self) -> FloatArray:
        """Half of the speeds (F,) that pass from the middle of a substep to that of the next."""
        return np.asarray(0.5 * np.abs(np.gradient(self.speeds)))

    def half_widths_of_windows(self, speed_window: float) -> FloatArray:
        """Return the half widths (F,) of the windows over which laws of the speed are averaged.

        A window contains at least the speeds that the port passes from the middle of one substep to
        that of the next. The mean over them is the mean over this time, so that dry friction whose
        sign changes within a substep has the right impulse.

        Parameters
        ----------
        speed_window : float
            The least half width, divided by the rms speed.
        """
        return np.maximum(self.half_passed_speeds, speed_window * self.rms_speed)


@dataclass(frozen=True, eq=False)
class LawForce:
    """The force of laws at a port along its motion, with its tangents.

    Tangents are derivatives with respect to the motion.

    A force is counted positive if it acts against the motion.

    Attributes
    ----------
    force : (F,) ndarray
        The force at the fine stamps [N or N m].
    by_position, by_speed : (F,) ndarray
        The derivatives of the force by position and speed of the port [N/m, N s/m or per rad].
    """

    force: FloatArray
    by_position: FloatArray
    by_speed: FloatArray

    def plus(self, other_force: "LawForce") -> "LawForce":
        """Return the sum with the force of other laws at the same port."""
        return LawForce(
            self.force + other_force.force,
            self.by_position + other_force.by_position,
            self.by_speed + other_force.by_speed,
        )


@callable_when_compiled
def mean_force(law: FloatArray, x: float, speed: float, half_width: float) -> float:
    """Return the mean of a law of the speed over a window of speeds, at a position of its port.

    The mean is the difference of the law's integral between both ends of the window, over its
    width. The law is either a table, or a power of the speed above a level, which may be one-sided
    (zero below the level).

    Parameters
    ----------
    law : (R,) array
        The parameters of the law, as `PortForce.parameter_row`.
    x : float
        The position [m or rad].
    speed, half_width : float
        The middle of the window, and half its width [m/s or rad/s].
    """
    if half_width == 0.0:
        return steady_force(law, x, speed)
    if law[ONE_SIDED] == TABLE:
        area = table_integral(law, speed + half_width) - table_integral(law, speed - half_width)
        return float(area / (2.0 * half_width))
    low = speed - half_width - law[LEVEL]
    high = speed + half_width - law[LEVEL]
    if law[ONE_SIDED] == 1.0:
        low = max(low, 0.0)
        high = max(high, 0.0)
    next_exponent = law[EXPONENT] + 1.0
    difference = power(abs(high), next_exponent) - power(abs(low), next_exponent)
    size = law[COEFFICIENT] * power(abs(x), law[POSITION_EXPONENT])
    return float(size * difference / (2.0 * half_width * next_exponent))


@callable_when_compiled
def mean_tangent(law: FloatArray, x: float, speed: float, half_width: float) -> float:
    """Return the derivative of `mean_force` by the speed.

    It is exact: d/dv of the integral of f from v - h to v + h is f(v + h) - f(v - h), divided by
    the width 2 h.
    """
    difference_over_window = steady_force(law, x, speed + half_width) - steady_force(
        law, x, speed - half_width
    )
    return difference_over_window / (2.0 * half_width)


def fill_force_and_tangents(
    law_index: int,
    of_speed: bool,
    law: FloatArray,
    positions: FloatArray,
    speeds: FloatArray,
    half_widths: FloatArray,
    half_difference: float,
    memory: FloatArray,
    force: FloatArray,
    by_position: FloatArray,
    by_speed: FloatArray,
) -> None:
    """Fill the force of a law along a motion of its port, and its tangents, in place.

    A law of the speed is averaged over a window of speeds, so that the jump of dry friction has a
    finite tangent. The tangent of a law with memory is that for its present memory; the influence
    of the earlier motion on the memory is neglected.

    Parameters
    ----------
    law_index : int
        The index of the law's class in `LAWS`.
    of_speed : bool
        Whether the law is a function of position and speed, without memory.
    law : (R,) array
        The parameters of the law, as `PortForce.parameter_row`.
    positions, speeds : (F,) array
        The motion of the port [m or rad, and per s].
    half_widths : (F,) array
        The half width of the window of speeds [m/s or rad/s].
    half_difference : float
        Half the difference of the position in a tangent [m or rad].
    memory : (M,) array
        The memory of the law, which is changed.
    force, by_position, by_speed : (F,) array
        The force and its derivatives by position and speed, which are filled.
    """
    for j in range(len(positions)):
        x, v, half_width = positions[j], speeds[j], half_widths[j]
        if not of_speed:
            advance(law_index, law, memory, x)
            memory[POSITION] = x
            force[j], by_position[j] = force_and_slope(law_index, law, memory, x, 1.0)
            continue
        force[j] = mean_force(law, x, v, half_width)
        by_speed[j] = mean_tangent(law, x, v, half_width)
        if law[POSITION_EXPONENT] != 0.0:
            difference_by_position = mean_force(
                law, x + half_difference, v, half_width
            ) - mean_force(law, x - half_difference, v, half_width)
            by_position[j] = difference_by_position / (2.0 * half_difference)


@cache
def _compiled_fill() -> Callable[..., None]:
    """Return `fill_force_and_tangents`, compiled if numba is installed."""
    return compiled(fill_force_and_tangents, law_functions())


def force_and_tangents(
    law: PortForce, time: FloatArray, motion: PortMotion, speed_window: float
) -> LawForce:
    """Return the force of a law along a motion of its port, with its derivatives (tangents).

    The derivatives are those by position and speed. All are zero outside of the times in which the
    law acts.

    Parameters
    ----------
    law : PortForce
        The law with its parameters.
    time : (F,) ndarray
        The fine stamps [s].
    motion : PortMotion
        The motion of the port at these stamps.
    speed_window : float
        The least half width of the window of speeds over which a law of the speed is averaged,
        divided by the rms speed; see `PortMotion.half_widths_of_windows`.
    """
    row = law.parameter_row
    memory = np.zeros(FIRST_ELEMENT + max(1, len(row) - PARAMETERS))
    force, by_position, by_speed = np.zeros((3, len(time)))
    _compiled_fill()(
        LAWS.index(type(law)),
        type(law).depends_on_speed,
        row,
        motion.positions,
        motion.speeds,
        motion.half_widths_of_windows(speed_window),
        RELATIVE_HALF_DIFFERENCE * motion.rms_position,
        memory,
        force,
        by_position,
        by_speed,
    )
    is_acting = law.acts_at(time)
    return LawForce(force * is_acting, by_position * is_acting, by_speed * is_acting)


def holds_at_rest(law: PortForce) -> bool:
    """Return whether a law of the speed has a force at rest, as dry friction has.

    Its force rises with a small power of the speed, below `LARGEST_HOLDING_EXPONENT`.
    """
    if not type(law).depends_on_speed:
        return False
    return float(law.parameter_row[EXPONENT]) < LARGEST_HOLDING_EXPONENT
