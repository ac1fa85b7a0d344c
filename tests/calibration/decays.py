"""A free decay in closed form."""

import numpy as np
from numpy.typing import NDArray


def free_decay(
    time: NDArray[np.float64],
    frequency: float,
    ratio: float,
    amplitude: float = 1.0,
    phase: float = 0.0,
) -> NDArray[np.float64]:
    """Return one mode that is let go.

    Parameters
    ----------
    time : (N,) array
        Samples [s].
    frequency : float
        Natural frequency [Hz].
    ratio : float
        Damping ratio.
    amplitude, phase : float
        Of the wave at time zero.
    """
    omega = 2.0 * np.pi * frequency
    wave = np.cos(omega * np.sqrt(1.0 - ratio**2) * time + phase)
    return np.asarray(amplitude * np.exp(-ratio * omega * time) * wave)
