"""The posterior of a parameter from the weights of its draws."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reporting.arrays import Float
from twin_master.network.estimator import Learnt

INTERVAL = (0.05, 0.95)
"""Levels of the bounds of the interval in which a learnt quantity is reported."""
_GRID_POINTS = 801
_LARGEST_LOG_RATIO = 60.0
"""Draws whose log evidence lies this far below the best do not shape the spline."""
_FEWEST_FOR_SPLINE = 4
"""Distinct draws from which the evidence is interpolated: those of a cubic polynomial."""


def posterior_of_draws(values: ArrayLike, prior: ArrayLike, weight: ArrayLike) -> Learnt:
    """Return the posterior of a parameter, given the weights of its draws.

    The evidence of a draw is a smooth function of the parameter, and its logarithm is nearly a
    parabola. If it is narrower than the distance of the draws, their weights alone would give a
    point. So the log evidence is interpolated between them by a cubic spline, and the prior by the
    straight lines of its distribution function.

    Parameters
    ----------
    values : (E,) array
        The draws; they may contain a value several times.
    prior, weight : (E,) array
        Their probabilities before and after the observations.
    """
    distinct, position = np.unique(np.asarray(values, dtype=np.float64), return_inverse=True)
    before: Float = np.zeros(len(distinct))
    after: Float = np.zeros(len(distinct))
    before += np.bincount(position, np.asarray(prior, dtype=np.float64))
    after += np.bincount(position, np.asarray(weight, dtype=np.float64))
    with np.errstate(divide="ignore", invalid="ignore"):
        log_evidence = np.log(after) - np.log(before)
    best = np.max(log_evidence[np.isfinite(log_evidence)])
    considered = np.flatnonzero(log_evidence >= best - _LARGEST_LOG_RATIO)
    if len(distinct) < _FEWEST_FOR_SPLINE or len(considered) < 2:
        return _posterior_of_points(distinct, after)
    return _interpolated_posterior(distinct, before, log_evidence, considered)


def _posterior_of_points(values: Float, weight: Float) -> Learnt:
    """Return mean, standard deviation and quantiles of increasing values (E,) with weights (E,)."""
    mean = float(weight @ values)
    cumulative = np.cumsum(weight)
    # The levels are lowered by a rounding error, or a sum that rounds below one would miss its end.
    lower, upper = (
        float(values[np.searchsorted(cumulative, level * (1 - 1e-12))]) for level in INTERVAL
    )
    standard_deviation = float(np.sqrt(weight @ (values - mean) ** 2))
    return Learnt(mean, standard_deviation, lower, upper)


def _interpolated_posterior(
    values: Float, prior: Float, log_evidence: Float, considered: NDArray[np.intp]
) -> Learnt:
    """Return the posterior with the log evidence interpolated between the draws.

    Parameters
    ----------
    values : (E,) array
        The distinct draws, increasing.
    prior : (E,) array
        Their probabilities before the observations.
    log_evidence : (E,) array
        The log evidence of each draw.
    considered : (n,) array of int
        The draws whose evidence is not negligible, two or more.
    """
    from scipy.interpolate import CubicSpline  # slow to import; only a twin that learns needs it

    # The considered draws with one neighbour on either side.
    first = max(int(considered[0]) - 1, 0)
    end = min(int(considered[-1]) + 2, len(values))

    # Each draw stands for the interval half way to its neighbours; the outer ones are symmetric.
    edges = np.concatenate([[values[0]], 0.5 * (values[1:] + values[:-1]), [values[-1]]])
    edges[0] -= edges[1] - values[0]
    edges[-1] += values[-1] - edges[-2]

    # Prior mass of the cells of a fine grid.
    grid = np.linspace(edges[first], edges[end], _GRID_POINTS)
    middle = 0.5 * (grid[1:] + grid[:-1])
    prior_distribution = np.concatenate([[0.0], np.cumsum(prior)])
    prior_mass = np.diff(np.interp(grid, edges, prior_distribution))

    # Posterior mass of the cells. The spline through fewer than four draws is one polynomial.
    floor = np.min(log_evidence[considered]) - _LARGEST_LOG_RATIO
    spline = CubicSpline(values[first:end], np.maximum(log_evidence[first:end], floor))
    log_evidence_on_grid = spline(middle)
    mass = prior_mass * np.exp(log_evidence_on_grid - log_evidence_on_grid.max())
    mass /= mass.sum()

    mean = float(mass @ middle)
    distribution = np.concatenate([[0.0], np.cumsum(mass)])
    lower, upper = np.interp(INTERVAL, distribution, grid)
    standard_deviation = float(np.sqrt(mass @ (middle - mean) ** 2))
    return Learnt(mean, standard_deviation, float(lower), float(upper))
