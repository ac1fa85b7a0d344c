"""Posterior of a static quantity from the weights of its draws, between the draws as well."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from twin_master.network.estimator import Learnt

__all__ = ["draws_posterior"]

Float = NDArray[np.float64]

INTERVAL = (0.05, 0.95)
_POINTS = 801
_REACH = 60.0
"""Draws whose evidence lies this many nats below the best tell the spline nothing that counts."""


def draws_posterior(values: ArrayLike, prior: ArrayLike, weight: ArrayLike, unit: str = "1") -> Learnt:
    """Return the posterior of a parameter whose draws have weights.

    The evidence of a draw is a smooth function of the parameter, and its logarithm nearly a parabola. When it
    is narrower than the distance of the draws, their weights alone would give a point; so the log evidence is
    interpolated between them by a cubic spline, and the prior by the straight lines of its distribution
    function.

    Parameters
    ----------
    values : (E,)
        Draws.
    prior, weight : (E,)
        Their probabilities before and after the observations.
    unit : str
    """
    values, prior, weight = (np.asarray(item, dtype=np.float64) for item in (values, prior, weight))
    distinct, place = np.unique(values, return_inverse=True)
    before: Float = np.bincount(place, prior).astype(np.float64)
    after: Float = np.bincount(place, weight).astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        evidence = np.log(after) - np.log(before)
    near = np.flatnonzero(evidence >= np.max(evidence[np.isfinite(evidence)]) - _REACH)
    if len(distinct) < 4 or len(near) < 2:
        return _of_points(distinct, after, unit)
    part = slice(max(int(near[0]) - 1, 0), min(int(near[-1]) + 2, len(distinct)))
    x, known = distinct[part], evidence[part]
    floor = np.min(evidence[near]) - _REACH
    edges = np.concatenate([[distinct[0]], 0.5 * (distinct[1:] + distinct[:-1]), [distinct[-1]]])
    edges[0] -= edges[1] - distinct[0]
    edges[-1] += distinct[-1] - edges[-2]
    grid = np.linspace(edges[part.start], edges[part.stop], _POINTS)
    middle = 0.5 * (grid[1:] + grid[:-1])
    mass = np.diff(np.interp(grid, edges, np.concatenate([[0.0], np.cumsum(before)])))
    order = len(x)
    log_evidence = (
        CubicSpline(x, np.maximum(known, floor))(middle)
        if order >= 4
        else np.polynomial.Polynomial.fit(x, np.maximum(known, floor), order - 1)(middle)
    )
    share = mass * np.exp(log_evidence - log_evidence.max())
    share /= share.sum()
    mean = float(share @ middle)
    reached = np.concatenate([[0.0], np.cumsum(share)])
    lower, upper = np.interp(INTERVAL, reached, grid)
    deviation = float(np.sqrt(share @ (middle - mean) ** 2))
    return Learnt(mean, deviation, float(lower), float(upper), unit)


def _of_points(values: Float, weight: Float, unit: str) -> Learnt:
    mean = float(weight @ values)
    reached = np.cumsum(weight)
    lower, upper = (float(values[np.searchsorted(reached, level * (1 - 1e-12))]) for level in INTERVAL)
    return Learnt(mean, float(np.sqrt(weight @ (values - mean) ** 2)), lower, upper, unit)
