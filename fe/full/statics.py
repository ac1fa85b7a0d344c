"""Factorised stiffness, and solutions whose accuracy is checked."""

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import norm

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import SolutionError

from .cholesky import Cholesky

BACKWARD_ERROR_LIMIT = 1e-12
"""Largest backward error max|b - K u| / (|K| max|u| + max|b|) of an accepted solution, in maximum norms."""
CORRECTION_LIMIT = 1e-4
"""Largest change |du| / |u| that one step of iterative refinement may still make.

Thin cells make the condition number about 1e10, so that about 1e-6 is what double precision reaches.
"""


class Factorisation(Cholesky):
    """Factorised symmetric positive definite matrix X, its energy norm, and the norm dual to it.

    Parameters
    ----------
    matrix : sparse (n, n)
        X; a copy of it is kept for the residual.

    Attributes
    ----------
    stiffness : csr (n, n)
        X.

    Raises
    ------
    SolutionError
        If the matrix is not positive definite.
    """

    def __init__(self, matrix: sparse.sparray) -> None:
        self.stiffness = matrix.tocsr()
        super().__init__(self.stiffness)

    def product(self, vectors: FloatArray) -> FloatArray:
        """Return X times vectors (n, k)."""
        return np.asarray(self.stiffness @ vectors)

    def solve(self, right_hand_side: FloatArray) -> FloatArray:
        """Solution (n,) or (n, k), refined once, its backward error and its accuracy checked.

        Raises
        ------
        SolutionError
            If the backward error exceeds `BACKWARD_ERROR_LIMIT` or refinement still changes the solution by
            more than `CORRECTION_LIMIT`.
        """
        solution = self.riesz(right_hand_side)
        correction = self.riesz(right_hand_side - self.stiffness @ solution)
        solution = solution + correction
        error = self.backward_error(solution, right_hand_side)
        change = float(np.linalg.norm(correction)) / max(float(np.linalg.norm(solution)), 1e-300)
        if not (error <= BACKWARD_ERROR_LIMIT and change <= CORRECTION_LIMIT):
            raise SolutionError(
                f"The static solution has a backward error of {error:.2g} (at most {BACKWARD_ERROR_LIMIT:g}) "
                f"and is accurate to {change:.2g} (at most {CORRECTION_LIMIT:g}); the stiffness matrix is "
                "nearly singular, some part of the structure is hardly held."
            )
        return solution

    def backward_error(self, solution: FloatArray, right_hand_side: FloatArray) -> float:
        """Backward error max|b - K u| / (|K| max|u| + max|b|), in maximum norms (0 for a zero load)."""
        size = float(norm(self.stiffness, np.inf))
        scale = size * float(np.abs(solution).max()) + float(np.abs(right_hand_side).max())
        residual = float(np.abs(right_hand_side - self.stiffness @ solution).max())
        return residual / scale if scale > 0.0 else residual
