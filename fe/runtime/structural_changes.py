"""The structural changes of a patch: compliant supports, added masses, lost stiffness.

NumPy and relative imports only.
"""

from typing import NamedTuple

import numpy as np

from .arrays import FloatArray

FITTED_REACH = 1.5
"""Largest distance of a mass from its place along each axis, over the reach of the place. The
displacements of the nodes within it give the derivatives of the displacement."""


class AddedMass(NamedTuple):
    """A mass at a place, or beside it.

    Attributes
    ----------
    number : int
        Number of the change, from one.
    kilograms : float
        The mass [kg].
    along, across : float
        Distances from the place [m].
    """

    number: int
    kilograms: float
    along: float
    across: float


def taylor_factors(along: float, across: float) -> FloatArray:
    """Return the factors (5,) of the derivatives of a displacement beside a place.

    They are those of a Taylor series in the distances s and t: s, t, s^2 / 2, s t, t^2 / 2.
    """
    return np.array([along, across, along**2 / 2.0, along * across, across**2 / 2.0])


class StructuralChanges(NamedTuple):
    """The structural changes of a patch, by their numbers in `ChangeableModel`, from one.

    Attributes
    ----------
    compliances : dict of int to float
        Added compliance of motions of supports and interfaces [m/N or rad/(N m)].
    masses : tuple of AddedMass
        Added masses.
    losses : dict of int to float
        Lost fractions of the stiffness of patches [1].
    """

    compliances: dict[int, float]
    masses: tuple[AddedMass, ...]
    losses: dict[int, float]

    @property
    def numbers(self) -> tuple[int, ...]:
        """The numbers of the changes."""
        return (*self.compliances, *(mass.number for mass in self.masses), *self.losses)
