"""Offline: approximate dual solutions, on which the sharpness of the error bound rests.

Either the solution at the nearest of several anchors is taken, or those at a few states are combined for each
state, as a reduced basis of each output (Rozza, Huynh and Patera 2008, section 11).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from fe.full.subspace import BlockDiagonal, Norm, conjugate_gradients, triangular_factors

FloatArray = npt.NDArray[np.float64]

DUAL_TOLERANCE, COMBINED_TOLERANCE = 0.05, 0.01
"""Relative residual of approximate dual solutions at their own states, taken alone and combined."""
DEPENDENT = 1e-3
"""Combinations of the dual solutions of an output that are shorter than this part of the longest are left out."""
MOST_COLUMNS = 48
"""Columns of approximate dual solutions that are iterated together."""


@dataclass(frozen=True)
class DualData:
    """Approximate dual solutions: products with X (A or M, n, O), and as `AffineArrays` has them, the rest."""

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
        Energy norm at `reference`.
    reference : (T - 1,) ndarray
        Coefficients of the stiffness terms of the norm, without the last.
    stiffness : callable
        The stiffness at coefficients (T,).
    together : int
        How many states are solved at once.
    advance : callable
        Told one more part, and of what.
    """

    terms: tuple[sparse.csr_array, ...]
    outputs: FloatArray
    norm: Norm
    reference: FloatArray
    stiffness: Callable[[FloatArray], Any]
    together: int
    advance: Callable[[int, str], object]

    def nearest(self, anchors: list[FloatArray]) -> DualData:
        """Return the solutions at anchors (T,), with the norms of their residuals elsewhere."""
        terms, (n, count) = len(self.terms), self.outputs.shape
        at_reference = self.norm.riesz(self.outputs)
        products = np.empty((len(anchors), n, count))
        factors = np.empty((len(anchors), count, terms, terms))
        # a rough solution will do: the norm of what it leaves is computed, not assumed
        for number, dual in enumerate(self._solutions(anchors, at_reference, DUAL_TOLERANCE)):
            images = [np.asarray(term @ dual) for term in self.terms]
            lifted = self._lifted(images[:-1])
            # X^-1 K_base dual, since X is the sum of all terms at the reference
            base = dual - sum(t * part for t, part in zip(self.reference, lifted, strict=True))
            factors[number] = triangular_factors(
                np.stack((at_reference - base, *lifted), axis=2),
                np.stack((self.outputs - images[-1], *images[:-1]), axis=2),
            )
            products[number] = self.norm.product(dual)
        return DualData(products, factors, np.empty((count, terms, 0, 0)), np.empty((count, 0)))

    def combined(self, states: list[FloatArray]) -> DualData:
        """Return the solutions at coefficients (T,), made orthonormal for each output, to be combined."""
        solutions = self._solutions(states, self.norm.riesz(self.outputs), COMBINED_TOLERANCE)
        duals = np.stack(list(solutions), axis=2)  # (n, O, M)
        terms, (n, count, functions) = len(self.terms), duals.shape
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
            functionals = np.column_stack((output, *images))
            factors[0, number] = np.linalg.qr(self.norm.whitened(functionals), mode="r")
        absent = ~duals.any(axis=0)
        stiffness[:, -1] += absent[:, :, np.newaxis] * np.eye(kept)  # a function that is not there gets no part
        products = np.stack([self.norm.product(duals[:, :, number]) for number in range(kept)])
        return DualData(products, factors, stiffness, np.einsum("no,nom->om", self.outputs, duals))

    def _solutions(self, states: list[FloatArray], start: FloatArray, tolerance: float) -> Any:
        """Yield the solutions (n, O) at coefficients (T,), one state after another."""
        at_once = 1 if self.together == 1 else max(1, MOST_COLUMNS // self.outputs.shape[1])
        for first in range(0, len(states), at_once):
            chosen = states[first : first + at_once]
            matrices = [self.stiffness(theta) for theta in chosen]
            duals = conjugate_gradients(
                matrices[0] if len(matrices) == 1 else BlockDiagonal(matrices),
                self.norm,
                beside([self.outputs] * len(chosen)),
                beside([start] * len(chosen)),
                tolerance=tolerance,
            )
            for dual in np.split(duals, len(chosen), axis=1):
                yield dual
                self.advance(1, "dual solutions")

    def _lifted(self, images: list[FloatArray]) -> list[FloatArray]:
        """Return the representatives of functionals, several (n, k) each."""
        if self.together == 1:
            return [self.norm.riesz(image) for image in images]
        return np.split(self.norm.riesz(np.concatenate(images, axis=1)), len(images), axis=1)


def beside(blocks: list[FloatArray]) -> FloatArray:
    """Return blocks (n, k) beside each other; one alone as it is: its layout decides how sums round."""
    return blocks[0] if len(blocks) == 1 else np.concatenate(blocks, axis=1)
