"""The posterior of parameters under readings, by importance sampling from a density that adapts to it.

Every reading is a difference from what a model shows and a standard deviation, both functions of the
parameters: a number that was measured of an output (its deviation holds what the model errs, too), or a pair
of a test. Nothing here knows what was measured, or of what.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import softmax
from scipy.stats import multivariate_t

from calibration.errors import PosteriorError
from calibration.result.record import ParameterPrior
from calibration.sentences import said
from calibration.static.posterior import Seed, child_seed

FloatArray = NDArray[np.float64]

Comparison = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Parameters (N, P) within their ranges to differences (N, R) and their standard deviations (N, R)."""

LEAST_EFFECTIVE_SAMPLE_SIZE = 200.0
"""A posterior that the weighted draws describe with fewer effective ones is refused."""

_FREEDOM = 10.0  # of the Student-t proposals: tails heavier than those of the posterior, a cut-off Gaussian
_INFLATION = 1.05  # of the proposal's covariance over the posterior's
_PILOT_COUNT, _PROPOSALS_PER_SAMPLE, _FEWEST_PROPOSALS = 2_000, 20, 4_000
_INSIDE = 0.1  # prior deviations from an end of the range at which the search begins at least
_PURPOSE = 22  # of the seed


def infer(
    priors: tuple[ParameterPrior, ...], compare: Comparison, *, seed: Seed = 0, count: int = 1000
) -> FloatArray:
    """Return equally weighted samples (count, P) of the posterior under everything that was read [units].

    Proposals are Student-t densities in coordinates in which the posterior at its optimum is round, so that
    parameters of which the readings tell next to one combination alone are sampled as well as others. The
    first draws tell the moments for those that are kept.

    Parameters
    ----------
    priors : tuple of ParameterPrior
        Normal distributions, cut off at their ranges.
    compare : callable
        Differences of all readings from the model, and their standard deviations.
    seed : int or SeedSequence
        The same seed gives the same samples.
    count : int
        Number of samples.

    Raises
    ------
    PosteriorError
        If the readings contradict each other so much that no posterior is found.
    """
    generator = np.random.default_rng(child_seed(seed, _PURPOSE))
    mean, deviation, low, high = np.array(
        [(item.mean, item.deviation, item.low, item.high) for item in priors]
    ).T
    ends = (low - mean) / deviation, (high - mean) / deviation

    def values(u: FloatArray) -> FloatArray:
        # within the range to the last digit, whatever rounding does
        return np.asarray(np.clip(mean + deviation * u, low, high))

    def energy(u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what is squared (N, R + P), and logs of scale (N,), at scaled parameters (N, P)."""
        difference, spread = compare(values(u))
        return np.hstack([difference / spread, u]), np.log(spread).sum(axis=1)

    start = np.clip(0.0, ends[0] + _INSIDE, ends[1] - _INSIDE)
    best = least_squares(lambda u: energy(u[None])[0][0], start, bounds=ends, x_scale="jac")
    _, singular, rows = np.linalg.svd(best.jac, full_matrices=False)
    stretch = rows / singular[:, None]

    def drawn(centre: FloatArray, covariance: FloatArray, size: int) -> tuple[FloatArray, FloatArray]:
        """Return draws in round coordinates (N, P) and their weights (N,)."""
        proposal = multivariate_t(centre, covariance, _FREEDOM)
        points = proposal.rvs(size, generator).reshape(size, -1)
        u = best.x + points @ stretch
        squared, scale = energy(u)
        log_weight = -0.5 * np.sum(squared**2, axis=1) - scale - proposal.logpdf(points)
        return points, softmax(np.where(np.all((u >= ends[0]) & (u <= ends[1]), axis=1), log_weight, -np.inf))

    points, weight = drawn(np.zeros(len(priors)), np.eye(len(priors)), _PILOT_COUNT)
    covariance = _INFLATION * np.cov(points.T, aweights=weight)
    proposals = max(_FEWEST_PROPOSALS, _PROPOSALS_PER_SAMPLE * count)
    points, weight = drawn(weight @ points, covariance, proposals)
    effective = 1.0 / float(np.sum(weight**2))
    if not effective >= LEAST_EFFECTIVE_SAMPLE_SIZE:
        raise PosteriorError(said("joint.effective", effective=effective, proposals=proposals))
    chosen = np.searchsorted(np.cumsum(weight), (np.arange(count) + generator.random()) / count)
    return values(best.x + points[generator.permutation(np.minimum(chosen, proposals - 1))] @ stretch)
