"""The certified static solution online, of arrays laid out for the fewest operations in an evaluation.

NumPy only: this file is copied into the FMU. The equations are in `docs/reduced_model.md`.
"""

from bisect import bisect_right
from collections.abc import Callable
from functools import partial
from math import sqrt

import numpy as np
from numpy import einsum
from numpy.linalg import solve

from .arrays import FloatArray
from .reduced_arrays import ReducedArrays
from .state import Losses

Dual = Callable[[FloatArray, Losses], tuple[FloatArray, FloatArray]]
multiply_outer = np.multiply.outer


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
    """

    __slots__ = ("_allowance", "_dual", "_load", "_output", "_reference", "_residual", "square", "stiffness")

    def __init__(self, arrays: ReducedArrays) -> None:
        stiffness = arrays.static_stiffness
        self.square = stiffness.shape[1:]
        self.stiffness = np.ascontiguousarray(stiffness.reshape(len(stiffness), -1))
        self._load, self._output = arrays.static_load, arrays.static_output
        residual = arrays.residual_load[len(stiffness[0]) :]
        terms = arrays.residual_stiffness[len(stiffness[0]) :].reshape(len(residual), -1)
        # times the loads, then the changes of the coefficients times the coordinates: the residual
        self._residual = np.concatenate((residual, -terms), axis=1)
        self._allowance = arrays.residual_allowance
        self._reference = np.append(arrays.bound_reference, 1.0)
        self._dual = (_combined if arrays.dual_output.shape[-1] else _nearest)(arrays)

    def solution(
        self, theta: FloatArray, load: FloatArray, loss: tuple[float, ...]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return coordinates (N,), outputs (O,) and certified bounds (O,) of their errors, rounding left out.

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

        # |l(u) - l(u_N)| = |psi(r)| <= |psi_N(r)| + |r| |l - K psi_N| / alpha, norms dual to the reference
        coefficients = np.empty(self._residual.shape[1])
        loads = load.size
        coefficients[:loads] = load
        change = (theta - self._reference)[:-1]
        multiply_outer(change, coordinates, out=coefficients[loads:].reshape(change.size, -1))
        residual = self._residual @ coefficients
        correction, dual = self._dual(theta, loss)
        coercivity = min((theta / self._reference).tolist())
        outside = self._allowance * sqrt(coordinates @ coordinates)
        remainder = (sqrt(residual @ residual) + outside) / coercivity
        bound = remainder * np.sqrt(einsum("ij,ij->i", dual, dual)) + np.abs(correction @ residual)
        return coordinates, self._output @ coordinates, bound


# An approximate dual solution, at coefficients (T,) of the stiffness and losses of the regions, is what it
# gives applied to the basis of the residuals (O, R), and the dual residuals of the outputs (O, F).


def _nearest(arrays: ReducedArrays) -> Dual:
    """Return the dual solution of the anchor that is next to the losses."""
    (terms, inside, _), dual = arrays.static_stiffness.shape, arrays.dual_residual
    # to be multiplied by theta, as the stiffness
    factors = np.concatenate((-dual[..., 1:], dual[..., :1]), axis=-1)
    anchors = [
        (np.ascontiguousarray(correction), np.ascontiguousarray(factor.reshape(-1, terms)))
        for correction, factor in zip(arrays.dual_correction[..., inside:], factors, strict=True)
    ]
    splits = np.split(arrays.dual_split, np.cumsum(arrays.dual_counts - 1)[:-1])
    return partial(_at_anchor, anchors, [split.tolist() for split in splits])


def _at_anchor(
    anchors: list[tuple[FloatArray, FloatArray]], splits: list[list[float]], theta: FloatArray, loss: Losses
) -> tuple[FloatArray, FloatArray]:
    number = 0
    for split, value in zip(splits, loss, strict=True):
        number = number * (len(split) + 1) + bisect_right(split, value)
    correction, factor = anchors[number]
    return correction, (factor @ theta).reshape(-1, theta.size)


def _combined(arrays: ReducedArrays) -> Dual:
    """Return the Galerkin solution of each output in its M dual functions."""
    terms, inside, _ = arrays.static_stiffness.shape
    by_output = arrays.dual_correction[..., inside:].transpose(1, 0, 2)
    stiffness = np.ascontiguousarray(arrays.dual_stiffness.transpose(1, 0, 2, 3)).reshape(terms, -1)
    corrections, factor = np.ascontiguousarray(by_output), arrays.dual_residual[0]
    return partial(_galerkin, stiffness, arrays.dual_output[:, :, np.newaxis], corrections, factor)


def _galerkin(
    stiffness: FloatArray, output: FloatArray, corrections: FloatArray, factor: FloatArray, theta: FloatArray,
    loss: Losses,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    outputs, functions, _ = output.shape
    weights = solve((theta @ stiffness).reshape(outputs, functions, functions), output)
    across = weights.transpose(0, 2, 1)
    coefficients = np.empty((outputs, factor.shape[2], 1))
    coefficients[:, 0] = 1.0
    coefficients[:, 1:] = (-theta[:, np.newaxis] * across).reshape(outputs, -1, 1)
    return (across @ corrections)[:, 0], (factor @ coefficients)[:, :, 0]
