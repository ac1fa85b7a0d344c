"""A record whose force is on or off, as the filter takes it; evidence from what two parts of it tell."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fe.compilation import callable_when_compiled, compiled

from . import event_kernels as kernels
from .kalman_kernels import is_steady
from .regression import LEAST_PRECISION

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
States = tuple[FloatArray, FloatArray, FloatArray, FloatArray]

callable_when_compiled(is_steady)
_heads = compiled(kernels.heads)
_tails = compiled(kernels.tails)


@dataclass(frozen=True, eq=False)
class Steps:
    """A record as the kernels take it, in steps that are `parts` times smaller than its own."""

    moves: FloatArray
    noises: FloatArray
    length: IntArray
    rows: FloatArray
    used: BoolArray
    columns: FloatArray
    begun: FloatArray

    @cached_property
    def roots(self) -> FloatArray:
        """Roots of the noises."""
        return _roots(self.noises)

    def which(self, on: BoolArray) -> IntArray:
        """Return the step (N,) that leads to each sample, the force acting from some on."""
        kind = 2 * np.r_[False, on[:-1]] + on
        return np.asarray(kind * (len(self.moves) // 4) + self.length)

    def before(self, on: BoolArray, first: int, state: Sequence[FloatArray], places: IntArray) -> States:
        """Return the states before steps to some samples, from that before the step to the first on."""
        given = self.moves, self.noises, self.which(on), self.rows, self.used, self.columns
        cover, mean, products, halves = _heads(*given, first, state[0], state[1], places)
        return cover, mean, products + state[2], halves + state[3]

    def after(self, on: BoolArray, places: IntArray) -> States:
        """Return what the readings from some samples on tell of the states there."""
        return _tails(self.moves, self.roots, self.which(on), self.rows, self.used, self.columns, places)

    def begin(self, on: bool) -> States:
        """Return the state at the first sample."""
        n, width = self.rows.shape[1], self.columns.shape[2]
        return self.begun[int(on)], np.zeros((n, width)), np.zeros((width, width)), np.zeros(())


def _roots(covers: FloatArray) -> FloatArray:
    """Return roots (..., n, n) of covariances."""
    values, vectors = np.linalg.eigh(covers)
    return np.ascontiguousarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


def _turned(items: FloatArray) -> FloatArray:
    return np.swapaxes(items, -1, -2)


def without(products: FloatArray, halves: FloatArray, precision: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return products (..., W, W) and half log determinants (...) without the last, unknown, columns."""
    if not len(precision):
        return products, halves
    prior = np.maximum(precision, LEAST_PRECISION)
    count = products.shape[-1] - len(prior)
    root = np.linalg.cholesky(products[..., count:, count:] + np.diag(prior))
    along = np.asarray(np.linalg.solve(root, products[..., count:, :count]))
    halves = halves + np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(-1) - 0.5 * np.log(prior).sum()
    return products[..., :count, :count] - _turned(along) @ along, halves


def joined(before: Sequence[FloatArray], after: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return products (..., W, W) and half log determinants (...) of whole records from both their parts."""
    cover, mean, products, halves = before
    known, along, later, more = after
    root = _roots(cover)
    inner = np.linalg.cholesky(np.eye(cover.shape[-1]) + _turned(root) @ known @ root)
    seen = np.asarray(np.linalg.solve(inner, _turned(root) @ (along - known @ mean)))
    cross = _turned(mean) @ along
    whole = products + later - cross - _turned(cross) + _turned(mean) @ known @ mean - _turned(seen) @ seen
    return whole, halves + more + np.log(np.diagonal(inner, axis1=-2, axis2=-1)).sum(-1)
