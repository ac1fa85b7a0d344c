"""Evidence and values of unknowns that act in proportion, from what whitened readings and columns share."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from .filtered import Filtered

FloatArray = NDArray[np.float64]

ROUNDING = 1e-12
"""Share of the squared size of a column that rounding may have made."""
LEAST_PRECISION = 1e-10
"""Of an unknown of which nothing is known before."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Unknowns given the readings: log evidence [nat, up to a constant], mean (K,) and covariance (K, K)."""

    evidence: float
    mean: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class Regression:
    """Products of the whitened residual (first) and K columns, summed over trials.

    Attributes
    ----------
    products : (1 + K, 1 + K) ndarray
        Unknowns of single trials are gone from it.
    log_determinant : float
        What the covariance of the readings and those unknowns take from the evidence [nat].
    """

    products: FloatArray
    log_determinant: float

    def solve(self, chosen: Sequence[int], precision: FloatArray) -> Solution:
        """Return evidence and values of some of the columns (from 0), of given prior precisions (K,)."""
        at = np.array([0, *(1 + k for k in chosen)])
        part = self.products[np.ix_(at, at)]
        prior = np.maximum(precision, LEAST_PRECISION)
        size = 1.0 / np.sqrt(np.diag(part)[1:] + prior)  # columns may be of any scale, and nearly one another
        scaled = (part[1:, 1:] + np.diag(prior)) * np.outer(size, size) + ROUNDING * np.eye(len(size))
        factor = cho_factor(scaled)
        mean = size * cho_solve(factor, size * part[1:, 0])
        left = np.r_[1.0, -mean]
        value = -0.5 * float(left @ part @ left + mean @ (prior * mean)) - self.log_determinant
        value -= float(np.sum(np.log(np.diag(factor[0]) / size)) + 0.5 * np.sum(np.log(prior)))
        return Solution(value, mean, np.outer(size, size) * cho_solve(factor, np.eye(len(prior))))


def local_solution(
    whitened: FloatArray, local: FloatArray, precision: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Return how whitened columns (M, K) depend on unknowns of a trial (M, L), and what they take away.

    Returns
    -------
    coefficients : (L, K) ndarray
        Least squares with the prior.
    products : (K, K) ndarray
        Of the columns, these unknowns being gone.
    half : float
        Half the log determinant that they add [nat].
    """
    if not local.shape[1]:
        return np.zeros((0, whitened.shape[1])), whitened.T @ whitened, 0.0
    prior = np.maximum(precision, LEAST_PRECISION)
    cross = local.T @ whitened
    factor = cho_factor(local.T @ local + np.diag(prior))
    coefficients = cho_solve(factor, cross)
    half = float(np.sum(np.log(np.diag(factor[0])))) - 0.5 * float(np.sum(np.log(prior)))
    return coefficients, whitened.T @ whitened - cross.T @ coefficients, half


def regression(
    filtered: Sequence[Filtered], residuals: Sequence[FloatArray], columns: Sequence[FloatArray]
) -> Regression:
    """Return the products of residuals (N, C) and columns (K, N, C), one of a trial each, whitened alike."""
    total: FloatArray | float = 0.0
    log_determinant = 0.0
    for one, residual, given in zip(filtered, residuals, columns, strict=True):
        trial = one.trial
        whole = one.whitened(np.concatenate((residual[None], given, trial.local)))
        split = 1 + len(given)
        _, products, half = local_solution(whole[:, :split], whole[:, split:], trial.local_precision)
        total = total + products
        log_determinant += one.log_determinant + half
    return Regression(np.asarray(total), log_determinant)
