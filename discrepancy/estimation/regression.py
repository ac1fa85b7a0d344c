"""Linear regression on whitened columns: unknowns with Gaussian priors, and their evidence."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.optimize import lsq_linear

from discrepancy.campaign.records import FloatArray

ROUNDING = 1e-12
"""Relative rounding error of the squared norm of a column. It is added to the diagonal of the
normal equations, so that equal columns do not make them singular."""
ROUNDING_OF_SUM, LARGEST_ROUNDING = 1e-15, 1.0
"""Relative rounding error of a sum of products, and the largest rounding error of a misfit with
which there is an evidence [nat]."""
LEAST_PRECISION = 1e-10
"""Prior precision of an unknown with a flat prior, whose exact precision of zero is singular."""


@dataclass(frozen=True, eq=False)
class Priors:
    """The priors of K unknowns: normal about zero, within ranges.

    Attributes
    ----------
    precision : (K,) ndarray
        The prior precisions.
    low, high : (K,) ndarray
        The least and largest values; infinite without a range.
    """

    precision: FloatArray
    low: FloatArray
    high: FloatArray

    @classmethod
    def without_ranges(cls, precision: FloatArray) -> "Priors":
        """Return normal priors of given precisions (K,)."""
        unbounded = np.full(len(precision), np.inf)
        return cls(precision, -unbounded, unbounded)

    def __len__(self) -> int:
        return len(self.precision)

    def of(self, unknowns: Sequence[int]) -> "Priors":
        """Return the priors of some of the unknowns, given by their indices."""
        indices = np.asarray(unknowns, dtype=np.intp)
        return Priors(self.precision[indices], self.low[indices], self.high[indices])

    def followed_by(self, others: "Priors") -> "Priors":
        """Return the priors of these unknowns and others after them."""
        return Priors(
            np.concatenate((self.precision, others.precision)),
            np.concatenate((self.low, others.low)),
            np.concatenate((self.high, others.high)),
        )


@dataclass(frozen=True, eq=False)
class Solution:
    """The K unknowns of a linear model given the readings.

    Attributes
    ----------
    log_evidence : float
        The log evidence [nat], up to a constant.
    mean : (K,) ndarray
        The posterior mean.
    covariance : (K, K) ndarray
        The posterior covariance.
    """

    log_evidence: float
    mean: FloatArray
    covariance: FloatArray

    def within(self, priors: Priors) -> "Solution":
        """Return the solution at the most probable values within the ranges of the unknowns.

        The log evidence is reduced by the decrease of the log posterior from the mean to these
        values, since values beyond a range are impossible. The covariance is not changed.
        """
        if np.all((priors.low <= self.mean) & (self.mean <= priors.high)):
            return self
        # the mode minimises (u - mean)^T C^-1 (u - mean) = |L^-1 (u - mean)|^2 within the ranges
        whitening = solve_triangular(
            np.linalg.cholesky(self.covariance), np.eye(len(self.mean)), lower=True
        )
        mode = lsq_linear(
            whitening, whitening @ self.mean, (priors.low, priors.high), method="bvls"
        ).x
        decrease = 0.5 * float(np.sum((whitening @ (mode - self.mean)) ** 2))
        return Solution(self.log_evidence - decrease, mode, self.covariance)


@dataclass(frozen=True, eq=False)
class Regression:
    """The normal equations of a linear model with K unknowns, summed over trials.

    Attributes
    ----------
    products : (1 + K, 1 + K) ndarray
        The Gram matrix of the whitened residual (first) and the whitened columns of the unknowns.
        Unknowns of single trials have been eliminated.
    half_log_determinant : float
        Half the log determinant of the covariance of the readings, with the contribution of the
        eliminated unknowns [nat].
    """

    products: FloatArray
    half_log_determinant: float

    def solve(self, unknowns: Sequence[int], priors: Priors) -> Solution:
        """Solve the linear model for some of its unknowns, with all other unknowns at zero.

        The model is r = X u + white noise of unit variance, with the whitened residual r, the
        chosen columns X and the unknowns u. The normal equations are (X^T X + P) mean = X^T r with
        the prior precisions P. The solution is within the ranges of the unknowns.

        Parameters
        ----------
        unknowns : sequence of int
            The indices of the k unknowns to solve for, 0 to K - 1.
        priors : Priors
            The priors of these k unknowns in the same order, with mean zero.

        Returns
        -------
        Solution
            Its log evidence is -inf if rounding errors exceed `LARGEST_ROUNDING`.
        """
        # `products` is the Gram matrix of [r, X]: the residual comes first
        rows = np.array([0, *(1 + unknown for unknown in unknowns)])
        products = self.products[np.ix_(rows, rows)]
        products_of_unknowns = products[1:, 1:]  # X^T X
        right_side = products[1:, 0]  # X^T r
        prior_precision = np.maximum(priors.precision, LEAST_PRECISION)
        # columns may be of any scale and nearly equal: scale the normal equations to unit diagonal
        column_scale = 1.0 / np.sqrt(np.diag(products_of_unknowns) + prior_precision)
        scale_of_pair = np.outer(column_scale, column_scale)
        normal_matrix = (products_of_unknowns + np.diag(prior_precision)) * scale_of_pair
        identity = np.eye(len(prior_precision))
        cholesky, is_lower = cho_factor(normal_matrix + ROUNDING * identity)
        mean = column_scale * cho_solve((cholesky, is_lower), column_scale * right_side)
        covariance = scale_of_pair * cho_solve((cholesky, is_lower), identity)
        # Laplace's approximation of the evidence, which is exact for a linear model:
        # misfit = |r - X mean|^2 + mean^T P mean
        residual_weights = np.r_[1.0, -mean]
        misfit = float(
            residual_weights @ products @ residual_weights + mean @ (prior_precision * mean)
        )
        # the misfit is lost to rounding if it is a small difference of large terms
        sum_of_magnitudes = np.abs(residual_weights) @ np.abs(products) @ np.abs(residual_weights)
        if ROUNDING_OF_SUM * sum_of_magnitudes > LARGEST_ROUNDING:
            return Solution(-np.inf, mean, covariance)
        half_log_det_of_normal_matrix = np.sum(np.log(np.diag(cholesky) / column_scale))
        half_log_det_of_prior = 0.5 * np.sum(np.log(prior_precision))
        log_evidence = (
            -0.5 * misfit
            - self.half_log_determinant
            - float(half_log_det_of_normal_matrix - half_log_det_of_prior)
        )
        return Solution(log_evidence, mean, covariance).within(priors)


def integrate_out_last(
    products: FloatArray, half_log_determinants: FloatArray, precision: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return products and half log determinants with the last unknowns integrated out.

    Parameters
    ----------
    products : (..., W, W) array
        The inner products of the whitened residual (first) and the columns of the unknowns.
    half_log_determinants : (...) array
        Half the log determinants of the covariance of the readings [nat].
    precision : (L,) array
        The prior precisions of the last L unknowns.

    Returns
    -------
    products : (..., W - L, W - L) array
        The products with the last L columns projected out.
    half_log_determinants : (...) array
        Half the log determinants, with the contribution of these unknowns [nat].
    """
    if not len(precision):
        return products, half_log_determinants
    # The Gaussian integral over the last unknowns. Let A be their block of the products plus their
    # prior precisions P, and B their block with the kept columns. The products become the Schur
    # complement, less B^T A^-1 B, and the log determinant grows by ln det A - ln det P. A is at
    # least P, so that P is kept from being exactly singular.
    clipped_precision = np.maximum(precision, LEAST_PRECISION)
    kept_count = products.shape[-1] - len(clipped_precision)
    kept, last = slice(0, kept_count), slice(kept_count, None)
    root_of_a = np.linalg.cholesky(products[..., last, last] + np.diag(clipped_precision))
    whitened_b = np.asarray(np.linalg.solve(root_of_a, products[..., last, kept]))
    schur_complement = products[..., kept, kept] - whitened_b.mT @ whitened_b
    half_log_det_of_a = np.log(np.diagonal(root_of_a, axis1=-2, axis2=-1)).sum(-1)
    half_log_det_of_p = 0.5 * np.log(clipped_precision).sum()
    remaining_half_log_dets = half_log_determinants + half_log_det_of_a - half_log_det_of_p
    return schur_complement, remaining_half_log_dets
