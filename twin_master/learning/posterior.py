"""Posterior of a static quantity from the weights of its draws, between the draws as well."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin_master.network.estimator import Learnt

__all__ = ["DrawsPosterior"]

Float = NDArray[np.float64]

INTERVAL = (0.05, 0.95)
_POINTS = 801
_REACH = 60.0
"""Draws whose evidence lies this many nats below the best tell the spline nothing that counts."""
_PARTS_KEPT = 8
_DRAWS_PREPARED = 256
"""More draws are interpolated anew each time: for them the memory would count, and not the time."""


@dataclass(frozen=True)
class _Part:
    """Neighbouring draws that count: n of them, interpolated within m cells.

    Attributes
    ----------
    grid, middle : (m + 1,), (m,)
        Edges and middles of the cells.
    mass : (m,)
        Prior probability of the cells.
    interpolate : callable
        From the log evidence of the draws (n,) to that in the middles (m,), by a cubic spline.
    """

    grid: Float
    middle: Float
    mass: Float
    interpolate: Callable[[Float], Float]


class DrawsPosterior:
    """The posterior of a parameter whose draws have weights.

    The evidence of a draw is a smooth function of the parameter, and its logarithm nearly a parabola. When it
    is narrower than the distance of the draws, their weights alone would give a point; so the log evidence is
    interpolated between them by a cubic spline, and the prior by the straight lines of its distribution
    function.

    Parameters
    ----------
    values : (E,)
        Draws.
    prior : (E,)
        Their probabilities before the observations.
    unit : str
    """

    def __init__(self, values: ArrayLike, prior: ArrayLike, unit: str = "1") -> None:
        self._unit = unit
        self._distinct, self._place = np.unique(np.asarray(values, dtype=np.float64), return_inverse=True)
        self._before: Float = np.bincount(self._place, np.asarray(prior, dtype=np.float64)).astype(np.float64)
        with np.errstate(divide="ignore"):
            self._log_before = np.log(self._before)
        self._parts: dict[tuple[int, int], _Part] = {}

    def of(self, weight: ArrayLike) -> Learnt:
        """Return the posterior.

        Parameters
        ----------
        weight : (E,)
            Probabilities of the draws after the observations.
        """
        after: Float = np.bincount(self._place, np.asarray(weight, dtype=np.float64)).astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            evidence = np.log(after) - self._log_before
        near = np.flatnonzero(evidence >= np.max(evidence[np.isfinite(evidence)]) - _REACH)
        count = len(self._distinct)
        if count < 4 or len(near) < 2:
            return self._of_points(after)
        first, end = max(int(near[0]) - 1, 0), min(int(near[-1]) + 2, count)
        part = self._part(first, end)
        floor = np.min(evidence[near]) - _REACH
        log_evidence = part.interpolate(np.maximum(evidence[first:end], floor))
        share = part.mass * np.exp(log_evidence - log_evidence.max())
        share /= share.sum()
        mean = float(share @ part.middle)
        reached = np.concatenate([[0.0], np.cumsum(share)])
        lower, upper = np.interp(INTERVAL, reached, part.grid)
        deviation = float(np.sqrt(share @ (part.middle - mean) ** 2))
        return Learnt(mean, deviation, float(lower), float(upper), self._unit)

    def _part(self, first: int, end: int) -> _Part:
        if (first, end) not in self._parts:
            if len(self._parts) == _PARTS_KEPT:
                del self._parts[next(iter(self._parts))]
            self._parts[first, end] = self._prepared(first, end)
        return self._parts[first, end]

    def _prepared(self, first: int, end: int) -> _Part:
        distinct, x = self._distinct, self._distinct[first:end]
        edges = np.concatenate([[distinct[0]], 0.5 * (distinct[1:] + distinct[:-1]), [distinct[-1]]])
        edges[0] -= edges[1] - distinct[0]
        edges[-1] += distinct[-1] - edges[-2]
        grid = np.linspace(edges[first], edges[end], _POINTS)
        middle = 0.5 * (grid[1:] + grid[:-1])
        mass = np.diff(np.interp(grid, edges, np.concatenate([[0.0], np.cumsum(self._before)])))
        return _Part(grid, middle, mass, _spline(x, middle))

    def _of_points(self, weight: Float) -> Learnt:
        values = self._distinct
        mean = float(weight @ values)
        reached = np.cumsum(weight)
        lower, upper = (float(values[np.searchsorted(reached, level * (1 - 1e-12))]) for level in INTERVAL)
        return Learnt(mean, float(np.sqrt(weight @ (values - mean) ** 2)), lower, upper, self._unit)


def _spline(x: Float, at: Float) -> Callable[[Float], Float]:
    """Return what interpolates values at `x` (n,); with fewer than four of them it is one polynomial."""
    from scipy.interpolate import CubicSpline  # takes a while to load, and only a twin that learns needs it

    if len(x) > _DRAWS_PREPARED:
        return lambda values: np.asarray(CubicSpline(x, values)(at))
    matrix: Float = np.ascontiguousarray(CubicSpline(x, np.eye(len(x)))(at))  # it is linear in the values
    return lambda values: matrix @ values
