"""A test of whether a covariance or an information matrix has converged in time."""

import numpy as np

from discrepancy.campaign.records import FloatArray
from fe.compilation import callable_when_compiled

STEADY = 1e-9
"""Largest change of a converged covariance, divided by the standard deviations of its entries."""


@callable_when_compiled
def is_steady(one: FloatArray, other: FloatArray) -> bool:
    """Return whether two covariances (n, n) differ by no more than `STEADY`, entry by entry."""
    variances = np.diag(one)
    return not np.any(np.abs(one - other) > STEADY * np.sqrt(np.outer(variances, variances)))
