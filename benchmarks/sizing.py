"""The size of a hidden effect, by what calibration, zeros and other nuisances leave of it."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def unexplained_rms(change: FloatArray, nuisances: FloatArray) -> float:
    """Return the rms over the noise of a change that nuisances within their priors leave.

    Parameters
    ----------
    change : (N,) array
        Change of the readings, over the noise.
    nuisances : (N, K) array
        Changes of the readings by one prior deviation of each nuisance, over the noise.
    """
    count = nuisances.shape[1]
    # Rows of the prior: each nuisance is zero with a unit deviation
    explained = np.linalg.lstsq(
        np.vstack((nuisances, np.eye(count))),
        np.concatenate((change, np.zeros(count))),
        rcond=None,
    )[0]
    return float(np.sqrt(np.mean((change - nuisances @ explained) ** 2)))


def size_leaving(
    wanted: float, largest: float, unexplained: Callable[[float], float]
) -> tuple[float, float]:
    """Return a size of an effect that leaves about `wanted` unexplained, and what it leaves.

    The size is multiplied by the ratio of wanted to remaining until they agree to 10 %.

    Parameters
    ----------
    wanted : float
        Rms over the noise.
    largest : float
        Largest size.
    unexplained : callable
        size -> rms over the noise that the effect of this size leaves; positive.
    """
    size = 0.01
    for _ in range(8):
        tried = min(size, largest)
        remaining = unexplained(tried)
        is_too_small = tried == largest and remaining < wanted
        if abs(remaining / wanted - 1.0) < 0.1 or is_too_small:
            break
        size = tried * float(np.clip(wanted / remaining, 0.1, 10.0))
    return tried, remaining
