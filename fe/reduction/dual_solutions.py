"""Offline: approximate dual solutions, on which the sharpness of the error bound rests.

Either the solution at the nearest of several anchors is taken, or those at a few states are combined for each
state, as a reduced basis of each output (Rozza, Huynh and Patera 2008).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from fe.full.subspace import BlockDiagonal, Norm, conjugate_gradients
from fe.runtime.errors import ReductionError

FloatArray = npt.NDArray[np.float64]

DUAL_TOLERANCE, COMBINED_TOLERANCE = 0.05, 0.01
"""Relative residual of approximate dual solutions at their own states, taken alone and combined."""
DEPENDENT = 1e-3
"""Combinations of the dual solutions of an output that are shorter, relative to the longest, are left out."""
MOST_COLUMNS = 48
"""Columns of approximate dual solutions that are iterated together."""


@dataclass(frozen=True)
class DualData:
    """Approximate dual solutions: whitened products with X (A or M, n, O), the rest as in `ReducedArrays`."""

    products: FloatArray
    factors: FloatArray
    stiffness: FloatArray
    output: FloatArray


@dataclass(frozen=True)
class DualProblem:
    """The dual problems of an affine structure: K psi = l for each of its outputs.

    Attributes
    ----------
    terms : tuple of csr (n, n)
        Stiffness terms.
    outputs : (n, O) ndarray
        Outputs.
    norm : Norm
        Energy norm of one stiffness.
    stiffness : callable
        The stiffness at coefficients (T,).
    advance : callable
        Told one more part, and of what.
    """

    terms: tuple[sparse.csr_array, ...]
    outputs: FloatArray
    norm: Norm
    stiffness: Callable[[FloatArray], Any]
    advance: Callable[[int, str], object]

    def nearest(self, anchors: list[FloatArray]) -> DualData:
        """Return the solutions at anchors (T,), with the norms of their residuals elsewhere."""
        count, terms = self.outputs.shape[1], len(self.terms)
        # a rough solution will do: the norm of what it leaves is computed, not assumed
        duals = np.stack(list(self._solutions(anchors, DUAL_TOLERANCE)))
        factors = np.empty((len(anchors), count, terms, terms))
        for number, dual in enumerate(duals):
            images = [np.asarray(term @ dual) for term in self.terms]
            functionals = np.stack((self.outputs - images[-1], *images[:-1]), axis=2)
            factors[number] = [self._factor(functionals[:, output]) for output in range(count)]
        return DualData(self._whitened(duals), factors, np.empty((count, terms, 0, 0)), np.empty((count, 0)))

    def combined(self, states: list[FloatArray]) -> DualData:
        """Return the solutions at coefficients (T,), made orthonormal for each output, to be combined."""
        duals = np.stack(list(self._solutions(states, COMBINED_TOLERANCE)), axis=2)  # (n, O, M)
        terms, count = len(self.terms), self.outputs.shape[1]
        kept = 0
        for dual in duals.transpose(1, 0, 2):
            square, turn = np.linalg.eigh(dual.T @ self.norm.product(dual))
            used = np.flatnonzero(square > DEPENDENT**2 * square[-1])[::-1]
            basis = dual @ (turn[:, used] / np.sqrt(square[used]))
            dual[:] = 0.0
            dual[:, : len(used)] = basis
            kept = max(kept, len(used))
        duals = duals[:, :, :kept]
        factors = np.empty((1, count, 1 + terms * kept, 1 + terms * kept))
        stiffness = np.empty((count, terms, kept, kept))
        for number, (dual, output) in enumerate(zip(duals.transpose(1, 0, 2), self.outputs.T, strict=True)):
            images = [np.asarray(term @ dual) for term in self.terms]
            stiffness[number] = [dual.T @ image for image in images]
            factors[0, number] = self._factor(np.column_stack((output, *images)))
        absent = np.asarray(~duals.any(axis=0))
        stiffness[:, -1] += absent[:, :, np.newaxis] * np.eye(
            kept
        )  # a function that is not there gets no part
        output = np.einsum("no,nom->om", self.outputs, duals)
        return DualData(self._whitened(duals.transpose(2, 0, 1)), factors, stiffness, output)

    def _factor(self, functionals: FloatArray) -> FloatArray:
        """Return R (k, k) with |functionals (n, k) @ c| = |R @ c| in the dual norm."""
        found = np.asarray(np.linalg.qr(self.norm.whitened(functionals), mode="r"))
        if not np.isfinite(found).all():
            raise ReductionError(
                "The dual residuals are not finite; the full model holds a value that is not."
            )
        return found

    def _whitened(self, duals: FloatArray) -> FloatArray:
        """Return X times dual functions (M, n, O), whitened."""
        return np.stack([self.norm.whitened(self.norm.product(dual)) for dual in duals])

    def _solutions(self, states: list[FloatArray], tolerance: float) -> Iterator[FloatArray]:
        """Yield the solutions (n, O) at coefficients (T,), one state after another."""
        at_once = max(1, MOST_COLUMNS // self.outputs.shape[1])
        start = self.norm.riesz(self.outputs)
        for first in range(0, len(states), at_once):
            chosen = states[first : first + at_once]
            duals = conjugate_gradients(
                BlockDiagonal([self.stiffness(theta) for theta in chosen]),
                self.norm,
                np.concatenate([self.outputs] * len(chosen), axis=1),
                np.concatenate([start] * len(chosen), axis=1),
                tolerance=tolerance,
            )
            for dual in np.split(duals, len(chosen), axis=1):
                yield dual
                self.advance(1, "dual solutions")
