"""The certified static solution online, of arrays laid out for the fewest operations in an evaluation.

NumPy only: this file is copied into the FMU. The equations are in `docs/reduced_model.md`.
"""

from bisect import bisect_right
from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy import einsum
from numpy.linalg import solve

from .arrays import FloatArray
from .reduced_arrays import ReducedArrays

multiply_outer = np.multiply.outer


@dataclass(frozen=True, slots=True)
class DualArrays:
    """Approximate dual solutions: `correction` (O, R), and `factor` (T O, T) or their residuals (O, F)."""

    correction: FloatArray
    factor: FloatArray


@dataclass(frozen=True, slots=True)
class CombinedDual:
    """M dual functions of each output, whose Galerkin solution is its approximate dual solution.

    Attributes
    ----------
    stiffness : (T, O M M) ndarray
        Stiffness terms in the functions.
    output : (O, M, 1) ndarray
        Each output of its functions.
    correction : (O M, R) ndarray
        The functions, applied to the basis of the residuals.
    factor : (O, F, 1 + T M) ndarray
        Factors of the dual residuals.
    """

    stiffness: FloatArray
    output: FloatArray
    correction: FloatArray
    factor: FloatArray

    def at(self, theta: FloatArray) -> DualArrays:
        """Return the dual solutions at the coefficients (T,) of the stiffness, with the residuals (O, F)."""
        outputs, functions, _ = self.output.shape
        stiffness = (theta @ self.stiffness).reshape(outputs, functions, functions)
        weights = solve(stiffness, self.output)
        coefficients = np.empty((outputs, self.factor.shape[2], 1))
        coefficients[:, 0] = 1.0
        coefficients[:, 1:] = (-theta[:, np.newaxis] * weights.transpose(0, 2, 1)).reshape(outputs, -1, 1)
        correction = weights.transpose(0, 2, 1) @ self.correction.reshape(outputs, functions, -1)
        return DualArrays(correction[:, 0], (self.factor @ coefficients)[:, :, 0])


class CertifiedSolution(NamedTuple):
    """Coordinates (N,), outputs (O,) and certified bounds (O,) of their errors, rounding left out."""

    coordinates: FloatArray
    output: FloatArray
    bound: FloatArray


class OnlineArrays:
    """T stiffness terms, L loads and O outputs in N basis vectors, with the arrays of the error bound.

    Parameters
    ----------
    arrays : ReducedArrays
        Arrays of the reduced model.

    Attributes
    ----------
    square : tuple of int
        (N, N).
    stiffness : (T, N N) ndarray
        Stiffness terms, flat.
    splits : tuple of list of float
        `dual_split` of each damage region.
    """

    __slots__ = (
        "_allowance", "_combined", "_dual", "_load", "_output", "_reference", "_residual", "splits", "square",
        "stiffness",
    )  # fmt: skip

    def __init__(self, arrays: ReducedArrays) -> None:
        stiffness = arrays.static_stiffness
        self.square = stiffness.shape[1:]
        self.stiffness = np.ascontiguousarray(stiffness.reshape(len(stiffness), -1))
        self._load, self._output = arrays.static_load, arrays.static_output
        residual = arrays.residual_load
        # times the loads, then the stiffness coefficients times the coordinates: the residual
        self._residual = np.concatenate(
            (residual, -arrays.residual_stiffness.reshape(len(residual), -1)), axis=1
        )
        self._allowance = arrays.residual_allowance
        self._reference = (*arrays.bound_reference.tolist(), 1.0)
        ends = np.cumsum(arrays.dual_counts - 1)[:-1]
        self.splits = tuple([float(value) for value in split] for split in np.split(arrays.dual_split, ends))
        dual, functions = arrays.dual_residual, arrays.dual_output.shape[-1]
        self._combined, self._dual = None, []
        if functions:
            by_output = arrays.dual_correction.transpose(1, 0, 2)
            self._combined = CombinedDual(
                np.ascontiguousarray(arrays.dual_stiffness.transpose(1, 0, 2, 3)).reshape(len(stiffness), -1),
                arrays.dual_output[:, :, np.newaxis],
                np.ascontiguousarray(by_output).reshape(-1, by_output.shape[2]),
                dual[0],
            )
            return
        # to be multiplied by theta, as the stiffness
        factors = np.concatenate((-dual[..., 1:], dual[..., :1]), axis=-1)
        self._dual = [
            DualArrays(
                np.ascontiguousarray(correction), np.ascontiguousarray(factor.reshape(-1, len(stiffness)))
            )
            for correction, factor in zip(arrays.dual_correction, factors, strict=True)
        ]

    def solution(self, theta: FloatArray, load: FloatArray, loss: tuple[float, ...]) -> CertifiedSolution:
        """Return the static solution and its bounds.

        Parameters
        ----------
        theta : (T,) ndarray
            Coefficients of the stiffness terms.
        load : (L,) ndarray
            Coefficients of the loads.
        loss : tuple of float
            Stiffness losses of the damage regions, by which the approximate dual solution is chosen.
        """
        stiffness = (theta @ self.stiffness).reshape(self.square)
        coordinates = np.asarray(solve(stiffness, load @ self._load), dtype=np.float64)
        output = self._output @ coordinates

        # |l(u) - l(u_N)| = |psi(r)| <= |psi_N(r)| + |r| |l - K psi_N| / alpha, norms dual to the reference
        coefficients = np.empty(self._residual.shape[1])
        loads = load.size
        coefficients[:loads] = load
        multiply_outer(theta, coordinates, out=coefficients[loads:].reshape(theta.size, -1))
        residual = self._residual @ coefficients
        if self._combined is not None:
            anchor = self._combined.at(theta)
            dual = anchor.factor
        else:
            number = 0
            for split, value in zip(self.splits, loss, strict=True):
                number = number * (len(split) + 1) + bisect_right(split, value)
            anchor = self._dual[number]
            dual = (anchor.factor @ theta).reshape(-1, theta.size)
        coercivity = min(
            value / reference for value, reference in zip(theta.tolist(), self._reference, strict=True)
        )
        outside = self._allowance * sqrt(coordinates @ coordinates)
        remainder = (sqrt(residual @ residual) + outside) / coercivity
        bound = remainder * np.sqrt(einsum("ij,ij->i", dual, dual)) + np.abs(anchor.correction @ residual)
        return CertifiedSolution(coordinates, output, bound)
