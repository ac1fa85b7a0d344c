"""What a law of a port is: a force F(x, x', memory) that acts against the motion x of a port, -F on x.

A law is a subclass of `PortForce` in a file of this folder, with its numbers and their units. A law of
position answers `pull`, and `advance` if it is hysteretic; a law of speed is one of the power laws of
`fe.runtime.laws.speed`.

`advance` and `pull` are called at every step, in the subset of Python that numba compiles too, with:

law : (`PARAMETERS` + E,) ndarray
    The law's parameters, then those of its hysteretic elements, `PortForce.row`.
memory : (`HEAD` + E,) ndarray
    1 if friction holds the port (`HELD`); its last position (`PLACE`); the law's force after the lag of
    omitted modes (`LAGGED`); what loads that are gone still add to the position (`FADING`); the law's force
    (`FORCE`); then the states of the elements.
x : float
    Position of the port [m or rad].
h : float
    Duration of the way from the last position to x [s].

NumPy and relative imports only: this file is copied into the FMU.
"""

from inspect import get_annotations
from typing import ClassVar

import numpy as np

from ..arrays import FloatArray as FloatArray
from ..errors import InvalidPatchError
from ..primitive import Primitive

PARAMETERS = 5
"""Most parameters of a law."""
POSITIVE, NOT_NEGATIVE = "be positive", "not be negative"
"""What a number must, said after its unit."""


class PortForce(Primitive):
    """A primitive that acts at a port."""

    in_windows: ClassVar[bool] = True
    of_speed: ClassVar[bool] = False
    """Whether the force is one of speed, which is zero at rest."""
    hysteretic: ClassVar[bool] = False
    """Whether the force depends on what happened before."""

    port: str

    @property
    def proportional(self) -> tuple[str, ...]:
        """The numbers that the force is in proportion to; without the first there is none."""
        return (next(iter(self.units)),)

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
        for name, hint in get_annotations(type(self)).items():
            for must in getattr(hint, "__metadata__", ())[1:]:
                self.require(name, getattr(self, name), must)

    def require(self, name: str, value: float, must: str) -> None:
        """Raise `InvalidPatchError` for a number that is not `POSITIVE` or `NOT_NEGATIVE`, as it must."""
        if value < 0.0 or (must == POSITIVE and value == 0.0):
            raise InvalidPatchError(f"{name} of {self.kind!r} must {must}, but is {value:g}.")

    @staticmethod
    def advance(law: FloatArray, memory: FloatArray, x: float) -> None:
        """Carry the states of the elements from the last position to `x`."""

    @staticmethod
    def pull(law: FloatArray, memory: FloatArray, x: float, h: float) -> tuple[float, float]:
        """Return force and slope at `x`; the memory, of where the way begins, is left as it is.

        Of dry friction the largest force, as if it moved forwards.
        """
        return 0.0, 0.0


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
