"""Section shape: the symmetric four-digit family of NACA Report 460 (Jacobs, Ward and Pinkerton, 1933)."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

_SHAPE = (0.2969, -0.1260, -0.3516, 0.2843, -0.1015)


def four_digit_half_thickness(chord_fraction: ArrayLike, thickness_ratio: float) -> NDArray[np.float64]:
    """Half thickness of a symmetric four-digit section, as a fraction of the chord.

    Parameters
    ----------
    chord_fraction : array_like (...,)
        Distance from the leading edge over the chord, clipped to 0..1.
    thickness_ratio : float
        Largest thickness over the chord.

    Returns
    -------
    ndarray (...,)
    """
    xi = np.clip(np.asarray(chord_fraction, dtype=float), 0.0, 1.0)
    a0, a1, a2, a3, a4 = _SHAPE
    polynomial = a0 * np.sqrt(xi) + xi * (a1 + xi * (a2 + xi * (a3 + xi * a4)))
    return np.asarray(5.0 * thickness_ratio * polynomial)


def four_digit_slope(chord_fraction: ArrayLike, thickness_ratio: float) -> NDArray[np.float64]:
    """Slope of the upper surface, the derivative of `four_digit_half_thickness` (...,)."""
    xi = np.clip(np.asarray(chord_fraction, dtype=float), 1e-6, 1.0)
    a0, a1, a2, a3, a4 = _SHAPE
    derivative = 0.5 * a0 / np.sqrt(xi) + a1 + xi * (2.0 * a2 + xi * (3.0 * a3 + 4.0 * xi * a4))
    return np.asarray(5.0 * thickness_ratio * derivative)
