"""Posterior of a static quantity from the weights of its draws, between the draws as well."""

import numpy as np
from numpy.typing import ArrayLike

from twin_master.network.estimator import Learnt

INTERVAL = (0.05, 0.95)
_POINTS = 801
_REACH = 60.0
"""Draws whose evidence lies this many nats below the best tell the spline nothing that counts."""


def posterior_of_draws(values: ArrayLike, prior: ArrayLike, weight: ArrayLike) -> Learnt:
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
    """
    distinct, place = np.unique(np.asarray(values, dtype=np.float64), return_inverse=True)
    before, after = (np.bincount(place, np.asarray(given, dtype=np.float64)) for given in (prior, weight))
    with np.errstate(divide="ignore", invalid="ignore"):
        evidence = np.log(after) - np.log(before)
    near = np.flatnonzero(evidence >= np.max(evidence[np.isfinite(evidence)]) - _REACH)
    count = len(distinct)
    if count < 4 or len(near) < 2:
        mean, reached = float(after @ distinct), np.cumsum(after)
        lower, upper = (float(distinct[np.searchsorted(reached, level * (1 - 1e-12))]) for level in INTERVAL)
        return Learnt(mean, float(np.sqrt(after @ (distinct - mean) ** 2)), lower, upper)
    first, end = max(int(near[0]) - 1, 0), min(int(near[-1]) + 2, count)
    from scipy.interpolate import CubicSpline  # takes a while to load; only a twin that learns needs it

    floor = np.min(evidence[near]) - _REACH
    edges = np.concatenate([[distinct[0]], 0.5 * (distinct[1:] + distinct[:-1]), [distinct[-1]]])
    edges[0] -= edges[1] - distinct[0]
    edges[-1] += distinct[-1] - edges[-2]
    grid = np.linspace(edges[first], edges[end], _POINTS)
    middle = 0.5 * (grid[1:] + grid[:-1])
    mass = np.diff(np.interp(grid, edges, np.concatenate([[0.0], np.cumsum(before)])))
    # With fewer than four draws that count it is one polynomial.
    log_evidence = CubicSpline(distinct[first:end], np.maximum(evidence[first:end], floor))(middle)
    share = mass * np.exp(log_evidence - log_evidence.max())
    share /= share.sum()
    mean = float(share @ middle)
    lower, upper = np.interp(INTERVAL, np.concatenate([[0.0], np.cumsum(share)]), grid)
    deviation = float(np.sqrt(share @ (middle - mean) ** 2))
    return Learnt(mean, deviation, float(lower), float(upper))
