"""The force of a law along a motion, and its tangents.

What a filter needs to have the law inside of it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from discrepancy.campaign.records import FloatArray
from fe.compilation import compiled, law_functions
from fe.runtime.arrays import FIRST_ELEMENT, POSITION
from fe.runtime.laws import LAWS, advance, force_and_slope
from fe.runtime.laws.interface import PARAMETERS, PortForce
from fe.runtime.laws.speed import steady_force

NODES = 8
"""Speeds of a window over which a law of speed is averaged."""
NUDGE = 1e-4
"""Step of the tangent of a law of speed by the position, over the usual position."""


@dataclass(frozen=True, eq=False)
class ForceAlong:
    """The force of laws at a port along its motion, against the motion.

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

    def plus(self, other: "ForceAlong") -> "ForceAlong":
        """Return the sum with other laws at the same port."""
        return ForceAlong(
            self.force + other.force,
            self.by_position + other.by_position,
            self.by_speed + other.by_speed,
        )


def along(
    number: int,
    of_speed: bool,
    law: FloatArray,
    positions: FloatArray,
    speeds: FloatArray,
    half_width: float,
    nudge: float,
    memory: FloatArray,
    force: FloatArray,
    by_position: FloatArray,
    by_speed: FloatArray,
) -> None:
    """Fill force and tangents (F,) of a law along positions and speeds (F,).

    A law of speed is averaged over a window of speeds, so that the step of dry friction has a
    tangent. The tangent of a law with memory is that at its present state: how the past would have
    changed is left out.
    """
    for j in range(len(positions)):
        x, v = positions[j], speeds[j]
        if not of_speed:
            advance(number, law, memory, x)
            memory[POSITION] = x
            force[j], by_position[j] = force_and_slope(number, law, memory, x, 1.0)
            continue
        total = 0.0
        for i in range(NODES):
            offset = half_width * ((2.0 * i + 1.0) / NODES - 1.0)
            total += steady_force(law, x, v + offset)
        force[j] = total / NODES
        ends = steady_force(law, x, v + half_width) - steady_force(law, x, v - half_width)
        by_speed[j] = ends / (2.0 * half_width)
        if law[2] != 0.0:
            beside = steady_force(law, x + nudge, v) - steady_force(law, x - nudge, v)
            by_position[j] = beside / (2.0 * nudge)


@cache
def _compiled_along() -> Callable[..., None]:
    return compiled(along, law_functions())


def force_along(
    law: PortForce, time: FloatArray, positions: FloatArray, speeds: FloatArray, smoothing: float
) -> ForceAlong:
    """Return the force of a law along a motion of its port, and its tangents.

    Zero outside of its windows.

    Parameters
    ----------
    law : PortForce
        The law with its numbers.
    time, positions, speeds : (F,) ndarray
        Fine stamps [s], and the motion of the port there [m or rad, and per s].
    smoothing : float
        Half the window of speeds over which a law of speed is averaged, over the usual speed.
    """
    row = law.parameter_row
    memory = np.zeros(FIRST_ELEMENT + max(1, len(row) - PARAMETERS))
    force, by_position, by_speed = np.zeros((3, len(time)))
    usual_speed = max(float(np.sqrt(np.mean(speeds**2))), 1e-300)
    usual_position = max(float(np.sqrt(np.mean(positions**2))), 1e-300)
    _compiled_along()(
        LAWS.index(type(law)),
        type(law).depends_on_speed,
        row,
        np.ascontiguousarray(positions),
        np.ascontiguousarray(speeds),
        smoothing * usual_speed,
        NUDGE * usual_position,
        memory,
        force,
        by_position,
        by_speed,
    )
    acts = law.acts_at(time)
    return ForceAlong(force * acts, by_position * acts, by_speed * acts)
