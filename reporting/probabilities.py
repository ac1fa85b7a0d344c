"""Probabilities of hypotheses from the logarithms of their weights."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float


def normalised_probabilities(log_weights: Sequence[float] | Float) -> Float:
    """Return probabilities (N,) that add up to one, given the logarithms of N weights.

    The largest weight is the unit, so that no weight overflows. A rounding error cannot make a
    probability larger than one, because it is a weight over a sum that contains this weight.
    """
    logarithms = np.asarray(log_weights, dtype=np.float64)
    weights = np.exp(logarithms - logarithms.max())
    return np.asarray(weights / weights.sum())


def total_probability(probabilities: Iterable[float]) -> float:
    """Return the sum of the probabilities of hypotheses that exclude each other, at most one."""
    return min(float(sum(probabilities)), 1.0)


def probability_of_some(log_weights: Float, is_counted: NDArray[np.bool_]) -> float:
    """Return the probability that one of the counted hypotheses is true, at most one.

    Parameters
    ----------
    log_weights : (N,) ndarray
        The logarithms of the weights of all hypotheses.
    is_counted : (N,) ndarray of bool
        Which of them are asked about.
    """
    return total_probability(normalised_probabilities(log_weights)[is_counted])
