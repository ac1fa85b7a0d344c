"""The interface of a law: a force F(x, x', memory) against the motion x of a port, -F on x.

A law is a subclass of `PortForce` in a file of this folder, with its numbers and their units. A law
of position defines `force_and_slope`, and `advance` if it is hysteretic; a law of speed is one of
the power laws of `fe.runtime.laws.speed`.

`advance` and `force_and_slope` are called at every step, in the subset of Python that numba
compiles too, with:

law : (`PARAMETERS` + E,) array
    The law's parameters, then those of its hysteretic elements: `PortForce.parameter_row`.
memory : (`FIRST_ELEMENT` + E,) array
    The memory of the law: 1 if dry friction holds the port (`STUCK`); the port's last position
    (`POSITION`); the force after the lag with which the residual position follows it
    (`LAGGED_FORCE`); the decaying displacement left by removed loads (`FADING_POSITION`); the law's
    force (`FORCE`); then the states of the hysteretic elements.
x : float
    Position of the port [m or rad].
duration : float
    Time since the last position [s].

NumPy and relative imports only: this file is copied into the FMU.
"""

from dataclasses import replace
from inspect import get_annotations
from typing import Any, ClassVar, Self

import numpy as np

from ..arrays import FloatArray as FloatArray
from ..errors import InvalidPatchError
from ..primitive import Primitive

PARAMETERS = 5
"""Largest number of parameters of a law."""
POSITIVE, NOT_NEGATIVE = "be positive", "not be negative"
"""Requirements on a number, given after the unit in the annotation of the number."""


class PortForce(Primitive):
    """A primitive that is an internal force at a port, given by a law."""

    can_act_in_windows: ClassVar[bool] = True
    depends_on_speed: ClassVar[bool] = False
    """Whether the force depends on the speed; it is then zero at rest."""
    hysteretic: ClassVar[bool] = False
    """Whether the force depends on the history of the motion."""

    port: str
    """Name of the port."""

    @property
    def proportional(self) -> tuple[str, ...]:
        """Names of the parameters that scale the force; it is zero if the first is zero."""
        first_number = next(iter(self.units))
        return (first_number,)

    def scaled(self, factor: float) -> Self:
        """Return the law with its force multiplied by a factor."""
        changes: dict[str, Any] = {}
        for name in self.proportional:
            value = getattr(self, name)
            if isinstance(value, tuple):
                changes[name] = tuple(factor * force for force in value)
            else:
                changes[name] = factor * value
        return replace(self, **changes)

    @property
    def parameter_row(self) -> FloatArray:
        """The `law` parameters of `force_and_slope`, padded with zeros."""
        numbers = [
            float(getattr(self, name))
            for name, value_type in self.value_types().items()
            if value_type is not str
        ]
        return np.pad(numbers, (0, PARAMETERS - len(numbers)))

    @property
    def magnitude(self) -> float:
        """A number that is zero if the law has no force at all."""
        return float(getattr(self, self.proportional[0]))

    def check(self) -> None:
        """Raise `InvalidPatchError` unless each number meets its requirement."""
        for name, hint in get_annotations(type(self)).items():
            for requirement in getattr(hint, "__metadata__", ())[1:]:
                self.require(name, getattr(self, name), requirement)

    def require(self, name: str, value: float, requirement: str) -> None:
        """Raise `InvalidPatchError` unless a number is `POSITIVE` or `NOT_NEGATIVE`."""
        if value < 0.0 or (requirement == POSITIVE and value == 0.0):
            raise InvalidPatchError(
                f"{name} of {self.kind!r} must {requirement}, but is {value:g}."
            )

    @staticmethod
    def advance(law: FloatArray, memory: FloatArray, x: float) -> None:
        """Update the states of the hysteretic elements to the position `x`, in place."""

    @staticmethod
    def force_and_slope(
        law: FloatArray, memory: FloatArray, x: float, duration: float
    ) -> tuple[float, float]:
        """Return the force at `x` and its derivative by `x`; the memory is not changed.

        Dry friction returns its largest force, with the sign for a forward motion.
        """
        return 0.0, 0.0


def power(base: float, exponent: float) -> float:
    """Return base^exponent for a base that is not negative; 0^0 is 1."""
    if exponent == 0.0:
        return 1.0
    if exponent == 1.0:
        return base
    if exponent == 2.0:
        return base * base
    if exponent == 3.0:
        return base * base * base
    return float(base**exponent)
