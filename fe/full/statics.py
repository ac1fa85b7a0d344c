"""Factorised stiffness, and solutions whose accuracy is checked."""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import norm

from fe.runtime.errors import SolutionError

from .cholesky import Cholesky

FloatArray = NDArray[np.float64]

BACKWARD_ERROR_LIMIT = 1e-12
"""Largest backward error max|b - K u| / (|K| max|u| + max|b|) of an accepted solution, in maximum norms."""
CORRECTION_LIMIT = 1e-4
"""Largest change |du| / |u| that one step of iterative refinement may still make.

Thin cells make the condition number about 1e10, so that about 1e-6 is what double precision reaches.
"""


class Factorisation:
    """Factorised symmetric positive definite matrix.

    Parameters
    ----------
    matrix : csr or csc (n, n)
        The matrix; a copy of it is kept for the residual.

    Raises
    ------
    SolutionError
        If the matrix is not positive definite.
    """

    def __init__(self, matrix: sparse.sparray) -> None:
        self._matrix = matrix.tocsr()
        self._norm = float(norm(self._matrix, np.inf))
        try:
            self._factors = Cholesky(self._matrix)
        except SolutionError as error:
            raise SolutionError(
                "The stiffness matrix cannot be factorised; some part of the structure is not held or has no "
                f"stiffness. {error}"
            ) from None

    def raw_solve(self, right_hand_side: FloatArray) -> FloatArray:
        """Solution (n,) or (n, k) without the residual check, for iterations that check their own."""
        return self._factors.solve(right_hand_side)

    def whitened(self, right_hand_side: FloatArray) -> FloatArray:
        """Vectors (n,) or (n, k) of the length that functionals have in the norm dual to the matrix."""
        return self._factors.whitened(right_hand_side)

    def solve(self, right_hand_side: FloatArray) -> FloatArray:
        """Solution (n,) or (n, k), refined once, its backward error and its accuracy checked.

        Raises
        ------
        SolutionError
            If the backward error exceeds `BACKWARD_ERROR_LIMIT` or refinement still changes the solution by
            more than `CORRECTION_LIMIT`.
        """
        solution = self.raw_solve(right_hand_side)
        correction = self.raw_solve(right_hand_side - self._matrix @ solution)
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
        scale = self._norm * float(np.abs(solution).max()) + float(np.abs(right_hand_side).max())
        residual = float(np.abs(right_hand_side - self._matrix @ solution).max())
        return residual / scale if scale > 0.0 else residual
