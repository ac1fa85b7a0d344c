"""What a law of a port is: a force F(x, x', memory) that acts against the motion x of a port, -F on x.

A law is one file of this folder: its primitive, a subclass of `PortForce`, and those functions of this file
that it answers otherwise. They stand below as a law of nothing answers them. A law of position has the first
part; a law of speed sets `PortForce.of_speed` and has `pull` and the second part.

They are called at every step, in the subset of Python that numba compiles too. What they are given:

law : (`PARAMETERS` + E,) ndarray
    The law's parameters, then those of its hysteretic elements, `PortForce.row`.
memory : (`HEAD` + E,) ndarray
    1 if friction holds the port; its last position; the law's force after the lag of omitted modes; what
    loads that are gone still add to the position; the last force of damping on a flexible port; then the
    states of the elements.
x : float
    Position of the port [m or rad].
h, least : float, int
    Duration of the way to x [s], and the least number of parts in which it is followed.
strength : float
    What a law of speed takes from the port's speed in a unit of time at unit speed.

NumPy and relative imports only: this file is copied into the FMU.
"""

from typing import ClassVar

import numpy as np

from ..arrays import FloatArray as FloatArray
from ..errors import InvalidPatchError
from ..primitive import Primitive

PARAMETERS = 5
"""Most parameters of a law."""
HEAD = 5
"""Columns of a memory before its hysteretic elements."""


class PortForce(Primitive):
    """A primitive that acts at a port."""

    in_windows: ClassVar[bool] = True
    of_speed: ClassVar[bool] = False
    """Whether the force is one of speed, which is zero at rest."""
    hysteretic: ClassVar[bool] = False
    """Whether the force depends on what happened before."""
    proportional: ClassVar[tuple[str, ...]] = ()
    """The numbers that the force is in proportion to; without the first there is none."""
    positive: ClassVar[tuple[str, ...]] = ()
    """The numbers that must be above zero."""
    not_negative: ClassVar[tuple[str, ...]] = ()
    """The numbers that must be zero or above."""

    port: str

    @property
    def row(self) -> FloatArray:
        """Parameters for the functions of the law: its numbers, in their order, and zeros after fewer."""
        numbers = [float(getattr(self, name)) for name, kind in self.values().items() if kind is not str]
        return np.pad(numbers, (0, PARAMETERS - len(numbers)))

    @property
    def magnitude(self) -> float:
        """Zero where the law gives no force at all."""
        return float(getattr(self, self.proportional[0]))

    def check(self) -> None:
        """Raise `InvalidPatchError` where a number cannot be."""
        for name in self.positive:
            self.require(name, getattr(self, name), positive=True)
        for name in self.not_negative:
            self.require(name, getattr(self, name), positive=False)

    def require(self, name: str, value: float, *, positive: bool) -> None:
        """Raise `InvalidPatchError` for a number that is not positive, or at least zero."""
        if value < 0.0 or (positive and not value > 0.0):
            wanted = "be positive" if positive else "not be negative"
            raise InvalidPatchError(f"{name} of {self.kind!r} must {wanted}, but is {value:g}.")


def power(base: float, exponent: float) -> float:
    """Return base^exponent of a base that is not negative; 0^0 is 1."""
    if exponent == 0.0:
        return 1.0
    if exponent == 1.0:
        return base
    if exponent == 2.0:
        return base * base
    if exponent == 3.0:
        return base * base * base
    return float(base**exponent)


def decayed(size: float, exponent: float, strength: float, duration: float) -> float:
    """Return a positive s after s' = -strength s^exponent alone, zero where it is spent."""
    if exponent == 1.0:
        return float(size * np.exp(-strength * duration))
    if exponent == 2.0:
        return size / (1.0 + strength * duration * size)
    if exponent == 0.0:
        return max(size - strength * duration, 0.0)
    root = size ** (1.0 - exponent) - (1.0 - exponent) * strength * duration
    return float(root ** (1.0 / (1.0 - exponent))) if root > 0.0 else 0.0


# ---------------------------------------------------------------- a law of position


def advance(law: FloatArray, memory: FloatArray, x: float, least: int) -> None:
    """Carry the memory from its last position to `x`."""


def parts(law: FloatArray, way: float) -> int:
    """Return the least number of parts in which a way to a position at rest is followed."""
    return 1


def pull(law: FloatArray, memory: FloatArray, x: float, h: float, least: int) -> tuple[float, float]:
    """Return force and slope at `x`; the memory, of where the way begins, is left as it is.

    Of dry friction the largest force, as if it moved forwards.
    """
    return 0.0, 0.0


# ---------------------------------------------------------------- a law of speed


def dry(law: FloatArray) -> bool:
    """Return whether the force does not depend on the size of the speed."""
    return False


def holds(law: FloatArray) -> bool:
    """Return whether the force can bring a port to rest in finite time, and hold it there."""
    return False


def strength(law: FloatArray, weight: float) -> float:
    """Return the strength, but for `share`, for a port whose speed a unit impulse changes by `weight`."""
    return 0.0


def share(law: FloatArray, x: float) -> float:
    """Return the factor of `strength` at a position."""
    return 1.0


def steady(law: FloatArray, x: float, speed: float) -> float:
    """Return the force at a position and a speed."""
    return 0.0


def kick(law: FloatArray, speed: float, strength: float, duration: float, through: bool) -> float:
    """Return the speed after the law alone has acted; with `through`, dry friction does not stop at zero."""
    return speed


def holding_limit(law: FloatArray, strength: float, duration: float) -> float:
    """Return the largest speed that a law which `holds` brings to rest within `duration`."""
    return 0.0


def crossing(
    law: FloatArray, begin: float, end: float, slopes: tuple[float, float], lost: float, strength: float,
    h: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return what must be added where the speed of a port changes sign within a step.

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
    return 0.0, 0.0, 0.0


FUNCTIONS = (
    "advance", "parts", "pull",
    "dry", "holds", "strength", "share", "steady", "kick", "holding_limit", "crossing",
)  # fmt: skip
"""Functions of a law."""
