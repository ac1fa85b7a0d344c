"""Laws of position, without memory and with. NumPy and relative imports only: copied into the FMU."""

from typing import Annotated, ClassVar

import numpy as np

from ..arrays import HEAD, PLACE
from ..errors import InvalidPatchError
from .interface import NOT_NEGATIVE, PARAMETERS, POSITIVE, FloatArray, PortForce, power


class PowerStiffness(PortForce):
    """F = coefficient |x / x0|^exponent sgn x; `side` 0: both signs of x, +1 or -1: that sign only.

    A cubic spring has exponent 3 and side 0; a breathing crack exponent 1, side -1, coefficient negative.
    `coefficient` [N or N m] is the force at x0 = `reference_displacement`.
    """

    coefficient: Annotated[float, "N or N m"]
    exponent: Annotated[float, "1", POSITIVE]
    side: int
    reference_displacement: Annotated[float, "m or rad", POSITIVE]

    def check(self) -> None:
        """Raise `InvalidPatchError` where a number cannot be."""
        super().check()
        if abs(self.side) > 1:
            raise InvalidPatchError(f"side of {self.kind!r} must lie from -1 to 1, but is {self.side:g}.")

    @staticmethod
    def pull(law: FloatArray, memory: FloatArray, x: float, h: float) -> tuple[float, float]:
        """Return force and slope at `x`."""
        if law[2] * x < 0.0 or x == 0.0:
            return 0.0, (law[0] / law[3] if law[1] == 1.0 and law[2] == 0.0 else 0.0)
        size = law[0] * power(abs(x / law[3]), law[1])
        return (size if x > 0.0 else -size), law[1] * size / abs(x)


class FreePlay(PortForce):
    """F = -stiffness clip(x, -half_width, half_width): the port's spring is absent inside the gap.

    `stiffness` [N/m or N m/rad] is the part of the stiffness that the gap removes.
    """

    stiffness: Annotated[float, "N/m or N m/rad"]
    half_width: Annotated[float, "m or rad", NOT_NEGATIVE]

    @property
    def magnitude(self) -> float:
        """Largest force."""
        return self.stiffness * self.half_width

    @staticmethod
    def pull(law: FloatArray, memory: FloatArray, x: float, h: float) -> tuple[float, float]:
        """Return force and slope at `x`."""
        return -law[0] * min(max(x, -law[1]), law[1]), (-law[0] if abs(x) < law[1] else 0.0)


class SineForce(PortForce):
    """F = coefficient sin(wave_number x + phase), against x: weight of a pendulum, cogging of a motor.

    m g l sin x brings a pendulum back to x = 0.
    """

    coefficient: Annotated[float, "N or N m"]
    wave_number: Annotated[float, "rad/m or 1"]
    phase: Annotated[float, "rad"]

    @staticmethod
    def pull(law: FloatArray, memory: FloatArray, x: float, h: float) -> tuple[float, float]:
        """Return force and slope at `x`."""
        angle = law[1] * x + law[2]
        return law[0] * np.sin(angle), law[0] * law[1] * np.cos(angle)


STEP = 0.3
"""Longest way in one step of a Bouc-Wen path, in yield displacements over an order above one."""
MOST_ELEMENTS = 10_000
"""Far more than the curve of a joint can show."""


class BoucWen(PortForce):
    """Bouc-Wen hysteresis: F = stiffness (z - x), z' = v (1 - (1 + sgn(v z)) / 2 |z / z_y|^order).

    z_y is `yield_displacement` [m or rad].

    `stiffness` is the part of the port's stiffness that is hysteretic ((1 - alpha) k); below yield F is zero.
    """

    hysteretic: ClassVar[bool] = True
    stiffness: Annotated[float, "N/m or N m/rad"]
    yield_displacement: Annotated[float, "m or rad", POSITIVE]
    order: Annotated[float, "1", POSITIVE]

    @staticmethod
    def advance(law: FloatArray, memory: FloatArray, x: float) -> None:
        """Follow z to `x`."""
        memory[HEAD] = followed(law, memory, x)

    @staticmethod
    def pull(law: FloatArray, memory: FloatArray, x: float, h: float) -> tuple[float, float]:
        """Return force and slope at `x`."""
        z = followed(law, memory, x)
        loading = z * (x - memory[PLACE]) > 0.0
        gradient = -law[0] * power(min(abs(z) / law[1], 1.0), law[2]) if loading else 0.0
        return law[0] * (z - x), gradient


def followed(law: FloatArray, memory: FloatArray, x: float) -> float:
    """Return z of a Bouc-Wen law at `x`."""
    width, order = law[1], law[2]
    z, rest = memory[HEAD] / width, (x - memory[PLACE]) / width
    if z * rest < 0.0:  # unloading: dz = dx until z is zero
        part = rest if abs(rest) <= abs(z) else -z
        z += part
        rest -= part
    if rest != 0.0:  # loading: dz/dx = 1 - |z|^order by Runge and Kutta, in steps of which the last is short
        size, way = abs(z), min(abs(rest), 2.0 + 40.0 / order)  # by then it yields to the last bit
        while way > 0.0:
            h = min(way, STEP / max(order, 1.0))
            way -= h
            first = 1.0 - power(size, order)
            second = 1.0 - power(size + 0.5 * h * first, order)
            third = 1.0 - power(size + 0.5 * h * second, order)
            last = 1.0 - power(size + h * third, order)
            size = min(size + h / 6.0 * (first + 2.0 * (second + third) + last), 1.0)
        z = size if rest > 0.0 else -size
    return float(z * width)


class MicroSlip(PortForce):
    """Iwan's joint: `element_count` Jenkins elements in parallel in place of a spring of `stiffness`.

    F = k (mean z_i - x), dz_i = dx while |z_i| < d_i (Iwan 1966): at rest the elements carry their share of
    the stiffness that the linear model already has, so F is the hysteretic force less `stiffness` x, what
    slip takes away. The elements slip as by a density of slip displacements phi ~ d^`chi` on
    0 < d <= `slip_force` (2 + chi) / ((1 + chi) stiffness) (Segalman 2005 without the macro-slip impulse),
    -1 < chi <= 0; chi = 0 is the uniform Iwan joint, and a single Jenkins element has `element_count` 1 and
    slips at `slip_force`.
    """

    hysteretic: ClassVar[bool] = True
    proportional = ("stiffness", "slip_force")
    slip_force: Annotated[float, "N or N m", POSITIVE]
    stiffness: Annotated[float, "N/m or N m/rad", NOT_NEGATIVE]
    chi: Annotated[float, "1"]
    element_count: int = 12

    @property
    def row(self) -> FloatArray:
        """k, n, and the slip displacements of the elements."""
        return np.array((self.stiffness, self.element_count, *[0.0] * (PARAMETERS - 2), *self.elements()))

    def elements(self) -> FloatArray:
        """Return the slip displacements (n,) of the elements.

        Quantile midpoints of phi ~ d^chi, scaled so that the joint as a whole slips at `slip_force` exactly.
        """
        part = (np.arange(self.element_count) + 0.5) / self.element_count
        slips = part ** (1.0 / (1.0 + self.chi))
        return np.asarray(slips * (self.slip_force / self.stiffness / slips.mean()))

    def check(self) -> None:
        """Raise `InvalidPatchError` where a number cannot be."""
        super().check()
        self.require("element_count", self.element_count, POSITIVE)
        self.require("1 + chi", 1.0 + self.chi, POSITIVE)
        self.require("-chi", -self.chi, NOT_NEGATIVE)
        if self.element_count > MOST_ELEMENTS:
            raise InvalidPatchError(
                f"element_count of {self.kind!r} must be {MOST_ELEMENTS} at most, "
                f"but is {self.element_count}."
            )

    @staticmethod
    def advance(law: FloatArray, memory: FloatArray, x: float) -> None:
        """Stretch the elements to `x`, each up to its slip."""
        for i in range(int(law[1])):
            slip = law[PARAMETERS + i]
            memory[HEAD + i] = min(max(memory[HEAD + i] + (x - memory[PLACE]), -slip), slip)

    @staticmethod
    def pull(law: FloatArray, memory: FloatArray, x: float, h: float) -> tuple[float, float]:
        """Return force and slope at `x`."""
        count, total, moving = int(law[1]), 0.0, 0
        for i in range(count):
            stretch, slip = memory[HEAD + i] + (x - memory[PLACE]), law[PARAMETERS + i]
            total += min(max(stretch, -slip), slip)
            if abs(stretch) >= slip:
                moving += 1
        return law[0] * (total / count - x), -law[0] * moving / count
