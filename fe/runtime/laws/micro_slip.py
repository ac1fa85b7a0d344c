"""Micro-slip of a joint (Iwan 1966, Segalman 2005): F = k (mean z_i - x), dz_i = dx while |z_i| < d_i.

Parameters: k, count n of Jenkins elements in parallel; slip displacements d_i of the elements. Memory: their
stretches z_i. NumPy and relative imports only: this file is copied into the FMU.
"""

from typing import Annotated, ClassVar

import numpy as np

from ..errors import InvalidPatchError
from .interface import HEAD, PARAMETERS, FloatArray, PortForce

MOST_ELEMENTS = 10_000
"""Far more than the curve of a joint can show."""


class MicroSlip(PortForce):
    """Iwan's joint: `element_count` Jenkins elements in parallel in place of a spring of `stiffness`.

    At rest the elements carry their share of the stiffness that the linear model already has, so F is the
    hysteretic force less `stiffness` x: what slip takes away. The slip forces of the elements are those of a
    density of slip displacements phi ~ d^`chi` on 0 < d <= `slip_force` (2 + chi) / ((1 + chi) stiffness)
    (Segalman 2005 without the macro-slip impulse), -1 < chi <= 0; chi = 0 is the uniform Iwan joint, and a
    single Jenkins element has `element_count` 1 and slips at `slip_force`.
    """

    hysteretic: ClassVar[bool] = True
    proportional: ClassVar[tuple[str, ...]] = ("stiffness", "slip_force")
    positive: ClassVar[tuple[str, ...]] = ("slip_force", "element_count")
    not_negative: ClassVar[tuple[str, ...]] = ("stiffness",)
    slip_force: Annotated[float, "N or N m"]
    stiffness: Annotated[float, "N/m or N m/rad"]
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
        self.require("1 + chi", 1.0 + self.chi, positive=True)
        self.require("-chi", -self.chi, positive=False)
        if self.element_count > MOST_ELEMENTS:
            raise InvalidPatchError(
                f"element_count of {self.kind!r} must be {MOST_ELEMENTS} at most, "
                f"but is {self.element_count}."
            )


def advance(law: FloatArray, memory: FloatArray, x: float, least: int) -> None:
    """Stretch the elements to `x`, each up to its slip."""
    change = x - memory[1]
    memory[1] = x
    for i in range(int(law[1])):
        stretch = memory[HEAD + i] + change
        memory[HEAD + i] = min(max(stretch, -law[PARAMETERS + i]), law[PARAMETERS + i])


def pull(law: FloatArray, memory: FloatArray, x: float, h: float, least: int) -> tuple[float, float]:
    """Return force and slope at `x`."""
    count = int(law[1])
    total = 0.0
    moving = 0
    for i in range(count):
        stretch = memory[HEAD + i] + x - memory[1]
        slip = law[PARAMETERS + i]
        total += min(max(stretch, -slip), slip)
        if abs(stretch) >= slip:
            moving += 1
    return law[0] * (total / count - x), -law[0] * moving / count
