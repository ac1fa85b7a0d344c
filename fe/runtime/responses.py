"""What a reduced model gives: a static response, or modes.

NumPy only: this file is copied into the FMU.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class StaticResponse:
    """Static response of the wing to one load at one state.

    Attributes
    ----------
    strain : (G,) ndarray
        Gauge strains, dimensionless, positive where the upper skin is compressed.
    tip_displacement : float
        Displacement of the tip [m], upwards positive.
    strain_error_bound : float
        Certified: no gauge of the full model differs from `strain` by more than this (dimensionless).
    tip_displacement_error_bound : float
        Certified: the tip of the full model does not differ by more than this [m].
    coordinates : (N,) ndarray
        Coefficients of the static basis vectors, from which a field can be reconstructed.
    """

    strain: FloatArray
    tip_displacement: float
    strain_error_bound: float
    tip_displacement_error_bound: float
    coordinates: FloatArray


@dataclass(frozen=True, slots=True)
class Modes:
    """First undamped eigenmodes at one state, Kapteyn et al. 2021, eq. (16), in ascending frequency.

    Attributes
    ----------
    frequency : (M,) ndarray
        Natural frequencies [Hz].
    shape : (N, M) ndarray
        Coefficients of the modal basis vectors; mass-normalised, the tip moves upwards.
    tip_displacement : (M,) ndarray
        Displacement of the tip per unit of modal coordinate [kg^-1/2].
    strain : (G, M) ndarray
        Gauge strains per unit of modal coordinate [m^-1 kg^-1/2].
    lift_participation : (M,) ndarray
        Modal force of the lift at load factor 1 [N kg^-1/2].
    tip_participation : (M,) ndarray
        Modal force of a tip force of 1 N [kg^-1/2].
    flapwise : tuple of int
        Indices of the first and second flapwise bending, followed by their shape, never by their rank.
    flapwise_mac : tuple of float
        Modal assurance criterion (mass-weighted) of these two against the shapes that define them.
    """

    frequency: FloatArray
    shape: FloatArray
    tip_displacement: FloatArray
    strain: FloatArray
    lift_participation: FloatArray
    tip_participation: FloatArray
    flapwise: tuple[int, int]
    flapwise_mac: tuple[float, float]
