"""Whether a covariance or an information has become steady."""

import numpy as np

from discrepancy.campaign.records import FloatArray
from fe.compilation import callable_when_compiled

STEADY = 1e-9
"""A covariance that moves less than this, over the deviations that it holds, is steady."""


@callable_when_compiled
def is_steady(one: FloatArray, other: FloatArray) -> bool:
    """Return whether two covariances (n, n) are the same within `STEADY`."""
    squares = np.diag(one)
    return not np.any(np.abs(one - other) > STEADY * np.sqrt(np.outer(squares, squares)))
