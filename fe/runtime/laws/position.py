"""Laws of position, without memory and hysteretic: F = F(x, memory).

NumPy and relative imports only: this file is copied into the FMU.
"""

from typing import Annotated, ClassVar

import numpy as np

from ..arrays import FIRST_ELEMENT, POSITION
from ..errors import InvalidPatchError
from .interface import NOT_NEGATIVE, PARAMETERS, POSITIVE, FloatArray, PortForce, power


class PowerStiffness(PortForce):
    """F = coefficient |x / x0|^exponent sgn x, for one or both signs of x.

    The law acts on both signs of x if `side` is 0, and on one sign only if it is +1 or -1. A cubic
    spring has exponent 3 and side 0; a breathing crack has exponent 1, side -1 and a negative
    coefficient. `coefficient` [N or N m] is the force at x0 = `reference_displacement`.
    """

    coefficient: Annotated[float, "N or N m"]
    """Factor of the law."""
    exponent: Annotated[float, "1", POSITIVE]
    """Exponent of the law."""
    side: int
    """Sign of the displacement on which the law acts; 0 for both."""
    reference_displacement: Annotated[float, "m or rad", POSITIVE]
    """Displacement by which the displacement of the law is divided."""

    def check(self) -> None:
        """Raise `InvalidPatchError` where a number is not possible."""
        super().check()
        if abs(self.side) > 1:
            raise InvalidPatchError(
                f"side of {self.kind!r} must lie from -1 to 1, but is {self.side:g}."
            )

    @staticmethod
    def force_and_slope(
        law: FloatArray, memory: FloatArray, x: float, duration: float
    ) -> tuple[float, float]:
        """Return the force at `x` and its derivative by `x`."""
        coefficient = law[0]
        exponent = law[1]
        side = law[2]
        reference = law[3]
        if side * x < 0.0 or x == 0.0:
            slope = coefficient / reference if exponent == 1.0 and side == 0.0 else 0.0
            return 0.0, slope
        magnitude = coefficient * power(abs(x / reference), exponent)
        return (magnitude if x > 0.0 else -magnitude), exponent * magnitude / abs(x)


class FreePlay(PortForce):
    """F = -stiffness clip(x, -half_width, half_width): a gap in which the port's spring is absent.

    `stiffness` [N/m or N m/rad] is the part of the port's stiffness that the gap removes.
    """

    stiffness: Annotated[float, "N/m or N m/rad"]
    """Stiffness of the spring."""
    half_width: Annotated[float, "m or rad", NOT_NEGATIVE]
    """Half the width of the gap."""

    @property
    def magnitude(self) -> float:
        """The largest force [N or N m]."""
        return self.stiffness * self.half_width

    @staticmethod
    def force_and_slope(
        law: FloatArray, memory: FloatArray, x: float, duration: float
    ) -> tuple[float, float]:
        """Return the force at `x` and its derivative by `x`."""
        stiffness = law[0]
        half_width = law[1]
        force = -stiffness * min(max(x, -half_width), half_width)
        slope = -stiffness if abs(x) < half_width else 0.0
        return force, slope


class SineForce(PortForce):
    """F = coefficient sin(wave_number x + phase): weight of a pendulum, cogging of a motor.

    m g l sin x brings a pendulum back to x = 0.
    """

    coefficient: Annotated[float, "N or N m"]
    """Factor of the law."""
    wave_number: Annotated[float, "rad/m or 1"]
    """Angle of the sine for each unit of displacement."""
    phase: Annotated[float, "rad"]
    """Phase of the sine."""

    @staticmethod
    def force_and_slope(
        law: FloatArray, memory: FloatArray, x: float, duration: float
    ) -> tuple[float, float]:
        """Return the force at `x` and its derivative by `x`."""
        coefficient = law[0]
        wave_number = law[1]
        phase = law[2]
        angle = wave_number * x + phase
        return coefficient * np.sin(angle), coefficient * wave_number * np.cos(angle)


LONGEST_STEP = 0.3
"""Longest step along a Bouc-Wen path, in yield displacements; divided by the order above order
one."""
MOST_ELEMENTS = 10_000
"""Largest number of elements of a joint, far more than its force-displacement curve resolves."""


class BoucWen(PortForce):
    """Bouc-Wen hysteresis: F = stiffness (z - x), z' = v (1 - (1 + sgn(v z)) / 2 |z / z_y|^order).

    z_y is `yield_displacement` [m or rad]. `stiffness` is the part of the port's stiffness that is
    hysteretic, (1 - alpha) k; below yield F is zero.
    """

    hysteretic: ClassVar[bool] = True
    stiffness: Annotated[float, "N/m or N m/rad"]
    """Stiffness of the spring."""
    yield_displacement: Annotated[float, "m or rad", POSITIVE]
    """Displacement at which the law yields."""
    order: Annotated[float, "1", POSITIVE]
    """Order of the law."""

    @staticmethod
    def advance(law: FloatArray, memory: FloatArray, x: float) -> None:
        """Carry z from the last position to `x`, in place."""
        memory[FIRST_ELEMENT] = hysteretic_displacement(law, memory, x)

    @staticmethod
    def force_and_slope(
        law: FloatArray, memory: FloatArray, x: float, duration: float
    ) -> tuple[float, float]:
        """Return the force at `x` and its derivative by `x`."""
        stiffness = law[0]
        yield_displacement = law[1]
        order = law[2]
        z = hysteretic_displacement(law, memory, x)
        is_loading = z * (x - memory[POSITION]) > 0.0
        slope = (
            -stiffness * power(min(abs(z) / yield_displacement, 1.0), order) if is_loading else 0.0
        )
        return stiffness * (z - x), slope


def hysteretic_displacement(law: FloatArray, memory: FloatArray, x: float) -> float:
    """Return the hysteretic displacement z of a Bouc-Wen law at the position `x`.

    The memory has the last position and z there; the position changes from it in one direction. z
    is the stretch of a spring that yields gradually: it follows the motion on unloading, and tends
    to the yield displacement on loading.
    """
    yield_displacement = law[1]
    order = law[2]
    # all displacements in units of the yield displacement
    z = memory[FIRST_ELEMENT] / yield_displacement
    remaining = (x - memory[POSITION]) / yield_displacement
    # unloading: dz = dx until z is zero
    if z * remaining < 0.0:
        unloaded = remaining if abs(remaining) <= abs(z) else -z
        z += unloaded
        remaining -= unloaded
    # loading: dz/dx = 1 - |z|^order by the Runge-Kutta method of order four; the last step is short
    if remaining != 0.0:
        magnitude = abs(z)
        distance = min(abs(remaining), 2.0 + 40.0 / order)  # beyond it, z = 1 exactly
        while distance > 0.0:
            step = min(distance, LONGEST_STEP / max(order, 1.0))
            distance -= step
            slope_1 = 1.0 - power(magnitude, order)
            slope_2 = 1.0 - power(magnitude + 0.5 * step * slope_1, order)
            slope_3 = 1.0 - power(magnitude + 0.5 * step * slope_2, order)
            slope_4 = 1.0 - power(magnitude + step * slope_3, order)
            magnitude = min(
                magnitude + step / 6.0 * (slope_1 + 2.0 * (slope_2 + slope_3) + slope_4), 1.0
            )
        z = magnitude if remaining > 0.0 else -magnitude
    return float(z * yield_displacement)


class MicroSlip(PortForce):
    """Iwan's joint: `element_count` parallel Jenkins elements in place of a spring `stiffness`.

    F = k (mean z_i - x), dz_i = dx while |z_i| < d_i (Iwan 1966). At rest the elements together
    have the stiffness that the linear model already has, so F is the hysteretic force minus
    `stiffness` x: what slip takes away. The slip displacements have the density phi ~ d^`chi` on 0
    < d <= `slip_force` (2 + chi) / ((1 + chi) stiffness) (Segalman 2005 without the impulse of
    macro-slip), -1 < chi <= 0. chi = 0 is the uniform Iwan joint; a single Jenkins element has
    `element_count` 1 and slips at `slip_force`.
    """

    hysteretic: ClassVar[bool] = True
    proportional = ("stiffness", "slip_force")
    slip_force: Annotated[float, "N or N m", POSITIVE]
    """Force at which all elements slip."""
    stiffness: Annotated[float, "N/m or N m/rad", NOT_NEGATIVE]
    """Stiffness of the spring."""
    chi: Annotated[float, "1"]
    """Exponent of the distribution of slip displacements."""
    element_count: int = 12
    """Number of parallel elements."""

    @property
    def parameter_row(self) -> FloatArray:
        """k, the number of elements, zeros, and the slip displacements of the elements."""
        unused = [0.0] * (PARAMETERS - 2)
        return np.array([self.stiffness, self.element_count, *unused, *self.slip_displacements()])

    def slip_displacements(self) -> FloatArray:
        """Return the slip displacements (n,) of the elements [m or rad].

        They are quantile midpoints of phi ~ d^chi, scaled so that the joint as a whole slips at
        `slip_force` exactly.
        """
        quantile = (np.arange(self.element_count) + 0.5) / self.element_count
        slips = quantile ** (1.0 / (1.0 + self.chi))
        return np.asarray(slips * (self.slip_force / self.stiffness / slips.mean()))

    def check(self) -> None:
        """Raise `InvalidPatchError` where a number is not possible."""
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
        """Stretch the elements to the position `x`, each up to its slip, in place."""
        for i in range(int(law[1])):
            slip = law[PARAMETERS + i]
            stretch = memory[FIRST_ELEMENT + i] + (x - memory[POSITION])
            memory[FIRST_ELEMENT + i] = min(max(stretch, -slip), slip)

    @staticmethod
    def force_and_slope(
        law: FloatArray, memory: FloatArray, x: float, duration: float
    ) -> tuple[float, float]:
        """Return the force at `x` and its derivative by `x`."""
        stiffness = law[0]
        count = int(law[1])
        total = 0.0
        slipping = 0
        for i in range(count):
            stretch = memory[FIRST_ELEMENT + i] + (x - memory[POSITION])
            slip = law[PARAMETERS + i]
            total += min(max(stretch, -slip), slip)
            if abs(stretch) >= slip:
                slipping += 1
        return stiffness * (total / count - x), -stiffness * slipping / count
