"""Rayleigh damping, Kapteyn et al. 2021, eqs. (17) and (18).

NumPy and relative imports only: this file is copied into the FMU.
"""

import math
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


def rayleigh_damping_ratio(alpha: float, beta: float, frequency: npt.ArrayLike) -> FloatArray:
    """Return the damping ratios of modes under V = alpha M + beta K.

    Kapteyn et al. 2021, eq. (18): zeta = alpha / (2 omega) + beta omega / 2, omega = 2 pi f.

    Parameters
    ----------
    alpha : float
        Mass-proportional coefficient [1/s].
    beta : float
        Stiffness-proportional coefficient [s].
    frequency : (M,) array_like
        Undamped natural frequencies [Hz], all positive.

    Returns
    -------
    (M,) ndarray
        Damping ratios [1]; values of 1 and more mean that the mode does not oscillate.
    """
    angular: Any = 2.0 * math.pi * np.asarray(frequency, dtype=np.float64)
    return np.asarray(0.5 * (alpha / angular + beta * angular), dtype=np.float64)


def rayleigh_coefficients(
    frequency: tuple[float, float], damping_ratio: tuple[float, float]
) -> tuple[float, float]:
    """Return the Rayleigh coefficients that give two modes their damping ratios.

    The inverse of Kapteyn et al. 2021, eq. (18), for two modes.

    Parameters
    ----------
    frequency : tuple of float
        Two different natural frequencies [Hz].
    damping_ratio : tuple of float
        Their damping ratios [1].

    Returns
    -------
    alpha : float
        Mass-proportional coefficient [1/s].
    beta : float
        Stiffness-proportional coefficient [s].

    Raises
    ------
    ValueError
        If the two frequencies are equal or not positive.
    """
    first, second = (2.0 * math.pi * f for f in frequency)
    if not (first > 0.0 and second > 0.0) or first == second:
        raise ValueError(
            f"Two different positive frequencies are needed for two Rayleigh coefficients, but {frequency} "
            "Hz were given."
        )
    difference = second**2 - first**2
    beta = 2.0 * (damping_ratio[1] * second - damping_ratio[0] * first) / difference
    alpha = 2.0 * first * second * (damping_ratio[0] * second - damping_ratio[1] * first) / difference
    return alpha, beta
