"""Cholesky factors of curvatures; one that is singular or not finite is a `FitError`, whatever made it so."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import FitError


def finite(values: FloatArray) -> FloatArray:
    """Return values as they are.

    Raises
    ------
    FitError
        If one of them is not finite.
    """
    if not np.all(np.isfinite(values)):
        raise FitError("The model gives values or derivatives that are not finite where a fit has come to.")
    return values


@dataclass(frozen=True, eq=False)
class Cholesky:
    """A positive definite matrix by its factor, U^T U.

    Attributes
    ----------
    upper : (n, n) ndarray
        U; what stands below its diagonal means nothing.
    """

    upper: FloatArray

    @classmethod
    def of(cls, matrix: FloatArray) -> "Cholesky":
        """Factorise a symmetric matrix (n, n).

        Raises
        ------
        FitError
            If it is not finite or not positive definite.
        """
        try:
            return cls(cho_factor(finite(matrix), check_finite=False)[0])
        except np.linalg.LinAlgError as cause:
            raise FitError(
                "The normal equations of a fit are singular; a parameter has no influence."
            ) from cause

    def solve(self, right: FloatArray) -> FloatArray:
        """Return (U^T U)^-1 b for columns b (n, ...)."""
        return np.asarray(cho_solve((self.upper, False), right, check_finite=False))

    def half(self, right: FloatArray) -> FloatArray:
        """Return U^-T b for columns b (n, ...), whose inner products are those by the matrix's inverse."""
        return np.asarray(solve_triangular(self.upper, right, trans="T", check_finite=False))

    @property
    def log_determinant(self) -> float:
        """Of the matrix, ln det."""
        return 2.0 * float(np.log(np.diag(self.upper)).sum())
