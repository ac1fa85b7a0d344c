"""A test of whether a covariance or an information matrix has converged in time."""

import numpy as np

from discrepancy.campaign.records import FloatArray
from fe.compilation import callable_when_compiled

STEADY = 1e-9
"""Largest change of an entry of a converged covariance, over the standard deviations of its row and
column."""


@callable_when_compiled
def is_steady(covariance: FloatArray, previous_covariance: FloatArray) -> bool:
    """Return whether two covariances (n, n) differ by no more than `STEADY`, entry by entry."""
    variances = np.diag(covariance)
    return not np.any(
        np.abs(covariance - previous_covariance) > STEADY * np.sqrt(np.outer(variances, variances))
    )
