"""The posterior of a parameter from the weights of its draws."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reporting.arrays import Float
from twin_master.network.estimator import Learnt

INTERVAL = (0.05, 0.95)
"""Levels of the reported interval of a learnt quantity."""
_GRID_POINTS = 801
"""Points of the grid on which the interpolated posterior is summed."""
_LARGEST_LOG_RATIO = 60.0
"""Draws whose log evidence is lower than the largest by more than this do not shape the spline."""
_FEWEST_FOR_SPLINE = 4
"""Distinct draws from which the evidence is interpolated: those of a cubic polynomial."""


def posterior_of_draws(values: ArrayLike, prior: ArrayLike, weight: ArrayLike) -> Learnt:
    """Return the posterior of a parameter, given the weights of its draws.

    If the posterior is narrower than the distance between two draws, the weights alone would put it
    on a single draw. So the log evidence, which is smooth and nearly a parabola, is interpolated
    between draws by a cubic spline, and the prior by a piecewise linear distribution function.

    With fewer than four distinct draws, or fewer than two whose evidence is not negligible, the
    posterior is that of the draws as points.

    Parameters
    ----------
    values : (E,) array
        The draws; they may contain a value several times.
    prior, weight : (E,) array
        Their probabilities before and after the observations.
    """
    distinct, position = np.unique(np.asarray(values, dtype=np.float64), return_inverse=True)
    prior_weight: Float = np.zeros(len(distinct))
    posterior_weight: Float = np.zeros(len(distinct))
    prior_weight += np.bincount(position, np.asarray(prior, dtype=np.float64))
    posterior_weight += np.bincount(position, np.asarray(weight, dtype=np.float64))
    # The evidence of a value is the ratio of its posterior to its prior probability.
    with np.errstate(divide="ignore", invalid="ignore"):
        log_evidence = np.log(posterior_weight) - np.log(prior_weight)
    largest = np.max(log_evidence[np.isfinite(log_evidence)])
    relevant_draws = np.flatnonzero(log_evidence >= largest - _LARGEST_LOG_RATIO)
    if len(distinct) < _FEWEST_FOR_SPLINE or len(relevant_draws) < 2:
        return posterior_of_points(distinct, posterior_weight)
    return _interpolated_posterior(distinct, prior_weight, log_evidence, relevant_draws)


def posterior_of_points(values: Float, weight: Float) -> Learnt:
    """Return mean, standard deviation and 90 % interval of increasing weighted values (E,)."""
    mean = float(weight @ values)
    cumulative = np.cumsum(weight)
    # The levels are lowered by a rounding error: otherwise a cumulative sum that rounds below a
    # level could miss the value at which it reaches the level.
    lower, upper = (
        float(values[np.searchsorted(cumulative, level * (1 - 1e-12))]) for level in INTERVAL
    )
    standard_deviation = float(np.sqrt(weight @ (values - mean) ** 2))
    return Learnt(mean, standard_deviation, lower, upper)


def _interpolated_posterior(
    values: Float, prior: Float, log_evidence: Float, relevant_draws: NDArray[np.intp]
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
    relevant_draws : (n,) array of int
        The draws whose evidence is not negligible, two or more.
    """
    from scipy.interpolate import CubicSpline  # slow to import; only a twin that learns needs it

    # The relevant draws with one neighbour on either side.
    begin = max(int(relevant_draws[0]) - 1, 0)
    end = min(int(relevant_draws[-1]) + 2, len(values))

    # Each draw stands for the interval that ends half way to its neighbours. The interval of an
    # outermost draw is symmetric about it.
    edges = np.concatenate([[values[0]], 0.5 * (values[1:] + values[:-1]), [values[-1]]])
    edges[0] -= edges[1] - values[0]
    edges[-1] += values[-1] - edges[-2]

    # Prior mass of the cells of a fine grid.
    grid = np.linspace(edges[begin], edges[end], _GRID_POINTS)
    middle = 0.5 * (grid[1:] + grid[:-1])
    prior_distribution = np.concatenate([[0.0], np.cumsum(prior)])
    prior_mass = np.diff(np.interp(grid, edges, prior_distribution))

    # Posterior mass of the cells. The log evidence of negligible neighbours may be minus infinity;
    # it is raised to a finite floor for the spline.
    floor = np.min(log_evidence[relevant_draws]) - _LARGEST_LOG_RATIO
    spline = CubicSpline(values[begin:end], np.maximum(log_evidence[begin:end], floor))
    log_evidence_on_grid = spline(middle)
    mass = prior_mass * np.exp(log_evidence_on_grid - log_evidence_on_grid.max())
    mass /= mass.sum()

    mean = float(mass @ middle)
    distribution = np.concatenate([[0.0], np.cumsum(mass)])
    lower, upper = np.interp(INTERVAL, distribution, grid)
    standard_deviation = float(np.sqrt(mass @ (middle - mean) ** 2))
    return Learnt(mean, standard_deviation, float(lower), float(upper))
