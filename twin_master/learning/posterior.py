"""Posterior of a static quantity from the weights of its draws, between the draws as well."""

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float
from twin_master.network.estimator import Learnt

INTERVAL = (0.05, 0.95)
_POINTS = 801
_REACH = 60.0
"""Draws whose evidence lies this many nats below the best tell the spline nothing that counts."""


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
        from scipy.interpolate import (
            CubicSpline,
        )  # takes a while to load, and only a twin that learns needs it

        distinct, floor = self._distinct, np.min(evidence[near]) - _REACH
        edges = np.concatenate([[distinct[0]], 0.5 * (distinct[1:] + distinct[:-1]), [distinct[-1]]])
        edges[0] -= edges[1] - distinct[0]
        edges[-1] += distinct[-1] - edges[-2]
        grid = np.linspace(edges[first], edges[end], _POINTS)
        middle = 0.5 * (grid[1:] + grid[:-1])
        mass = np.diff(np.interp(grid, edges, np.concatenate([[0.0], np.cumsum(self._before)])))
        # With fewer than four draws that count it is one polynomial.
        log_evidence = CubicSpline(distinct[first:end], np.maximum(evidence[first:end], floor))(middle)
        share = mass * np.exp(log_evidence - log_evidence.max())
        share /= share.sum()
        mean = float(share @ middle)
        lower, upper = np.interp(INTERVAL, np.concatenate([[0.0], np.cumsum(share)]), grid)
        deviation = float(np.sqrt(share @ (middle - mean) ** 2))
        return Learnt(mean, deviation, float(lower), float(upper), self._unit)

    def _of_points(self, weight: Float) -> Learnt:
        values = self._distinct
        mean = float(weight @ values)
        reached = np.cumsum(weight)
        lower, upper = (float(values[np.searchsorted(reached, level * (1 - 1e-12))]) for level in INTERVAL)
        return Learnt(mean, float(np.sqrt(weight @ (values - mean) ** 2)), lower, upper, self._unit)
