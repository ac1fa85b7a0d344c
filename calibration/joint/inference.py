"""The posterior of parameters under readings, by importance sampling from a density that adapts to it.

Every reading is a difference from what a model shows and a standard deviation, both functions of the
parameters: a number that was measured of an output (its deviation holds what the model errs, too), or a pair
of a test. Nothing here knows what was measured, or of what.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import gammaln

from calibration.errors import PosteriorError
from calibration.result.record import ParameterPrior
from calibration.sentences import said
from calibration.static.posterior import Seed, check_count, child_seed

FloatArray = NDArray[np.float64]

Comparison = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Parameters (N, P) within their ranges to differences (N, R) and their standard deviations (N, R)."""

LEAST_EFFECTIVE_SAMPLE_SIZE = 200.0
"""A posterior that the weighted draws describe with fewer effective ones is refused."""

_FREEDOM = 10.0  # of the Student-t proposals: tails heavier than those of the posterior, a cut-off Gaussian
_INFLATION = 1.05  # of the proposal's covariance over the posterior's
_STARTS = 4  # of the search for the optimum: the prior's mean, and draws of it
_STEP = 1e-7  # of a scaled parameter, for slopes
_ROUNDS, _MOST_ROUNDS, _ADAPTATION_COUNT = 3, 60, 1000
_TEMPERED_SHARE = 0.1
_PROPOSALS_PER_SAMPLE, _FEWEST_PROPOSALS = 20, 4_000
_MOST_SAMPLES = 100_000  # the proposals of more do not fit into memory
_PURPOSE = 22  # of the seed


class Draws(NamedTuple):
    """A posterior as samples.

    Attributes
    ----------
    samples : (N, P) array
        Equally weighted samples of the parameters, in no order [their units].
    mean, standard_deviation : (P,) array
        Of all weighted draws, closer to the posterior's than those of the samples.
    proposals : int
        Weighted draws from which the samples were taken.
    effective : float
        (sum w)^2 / sum w^2 of their weights.
    log_evidence : float
        Log of the probability density of all readings under the priors.
    """

    samples: FloatArray
    mean: FloatArray
    standard_deviation: FloatArray
    proposals: int
    effective: float
    log_evidence: float


def infer(
    priors: tuple[ParameterPrior, ...], compare: Comparison, *, seed: Seed = 0, count: int = 1000
) -> Draws:
    """Return the posterior of parameters under everything that was read.

    The search begins at the most probable parameters; proposals are Student-t densities in coordinates in
    which the posterior there is round, so that parameters of which the readings tell next to one combination
    alone are sampled as well as others.

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
        If `count` is not 1 to 100,000, a prior lies outside its range, or the readings contradict each other
        so much that no posterior is found.
    """
    check_count(count, PosteriorError, most=_MOST_SAMPLES)
    normaliser = sum(prior.log_share_inside for prior in priors)
    generator = np.random.default_rng(child_seed(seed, _PURPOSE))
    density = _Density(priors, compare, generator)
    centre: FloatArray = np.zeros(len(priors))
    factor: FloatArray = np.eye(len(priors))
    good, least = 0, _TEMPERED_SHARE * _ADAPTATION_COUNT
    for _ in range(_MOST_ROUNDS):
        points, log_weight = density.weighted(centre, factor, _ADAPTATION_COUNT, generator)
        if np.count_nonzero(np.isfinite(log_weight)) <= least:
            factor = 0.5 * factor  # most draws lie outside the range
            continue
        weight, tempered = _normalised(log_weight), False
        while _effective(weight) < least:  # they say too little: the next round begins closer
            log_weight, tempered = 0.5 * log_weight, True
            weight = _normalised(log_weight)
        centre = weight @ points
        deviation = points - centre
        covariance = (deviation * weight[:, None]).T @ deviation
        factor = np.asarray(np.linalg.cholesky(_INFLATION * covariance), dtype=np.float64)
        good += not tempered
        if good == _ROUNDS:
            break
    proposals = max(_FEWEST_PROPOSALS, _PROPOSALS_PER_SAMPLE * count)
    points, log_weight = density.weighted(centre, factor, proposals, generator)
    weight = _normalised(log_weight)
    largest = float(log_weight.max())
    effective = _effective(weight) if math.isfinite(largest) else 0.0
    if effective < LEAST_EFFECTIVE_SAMPLE_SIZE:
        raise PosteriorError(said("joint.effective", effective=effective, proposals=proposals))
    values = density.values(points)
    mean = weight @ values
    chosen = np.searchsorted(np.cumsum(weight), (np.arange(count) + generator.random()) / count)
    return Draws(
        samples=values[generator.permutation(np.minimum(chosen, proposals - 1))],
        mean=mean,
        standard_deviation=np.sqrt(weight @ (values - mean) ** 2),
        proposals=proposals,
        effective=effective,
        log_evidence=largest + math.log(np.mean(np.exp(log_weight - largest))) + density.scale - normaliser,
    )


class _Density:
    """The posterior up to its normaliser over z, in which it is round where it is greatest.

    Parameters are mean + deviation u with the prior's moments, and u = optimum + stretch z. `scale` is the
    log of the volume of u for that of z.
    """

    def __init__(
        self, priors: tuple[ParameterPrior, ...], compare: Comparison, generator: np.random.Generator
    ) -> None:
        self._compare = compare
        self._mean, self._deviation, low, high = np.array(
            [(prior.mean, prior.deviation, prior.low, prior.high) for prior in priors]
        ).T
        self._ends = low, high
        self._low, self._high = (low - self._mean) / self._deviation, (high - self._mean) / self._deviation
        starts = [np.zeros(len(priors)), *generator.standard_normal((_STARTS - 1, len(priors)))]
        width = self._high - self._low
        inside = [np.clip(start, self._low + 1e-6 * width, self._high - 1e-6 * width) for start in starts]
        limits = self._low, self._high
        found = [
            least_squares(lambda u: self._residuals(u[None])[0], start, self._jacobian, limits, x_scale="jac")
            for start in inside
        ]
        best = max(found, key=lambda item: float(self._log_density(item.x[None])[0]))
        _, singular, rows = np.linalg.svd(best.jac, full_matrices=False)
        self._optimum, self._stretch = best.x, rows.T / singular
        self.scale = -float(np.log(singular).sum())

    def values(self, points: FloatArray) -> FloatArray:
        """Return the parameters of points z (N, P) [their units]."""
        return self._at(self._optimum + points @ self._stretch.T)

    def _at(self, u: FloatArray) -> FloatArray:
        # within the range to the last digit, whatever rounding does
        return np.asarray(np.clip(self._mean + self._deviation * u, *self._ends))

    def weighted(
        self, centre: FloatArray, factor: FloatArray, count: int, generator: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Return draws z (N, P) of a Student-t density and the logs of their weights; -inf outside."""
        size = len(centre)
        standard = generator.standard_normal((count, size))
        standard /= np.sqrt(generator.chisquare(_FREEDOM, count) / _FREEDOM)[:, None]
        constant = gammaln(0.5 * (_FREEDOM + size)) - gammaln(0.5 * _FREEDOM)
        constant -= 0.5 * size * math.log(_FREEDOM * math.pi) + float(np.log(np.diag(factor)).sum())
        square = np.sum(standard**2, axis=1)
        log_proposal = constant - 0.5 * (_FREEDOM + size) * np.log1p(square / _FREEDOM)
        points = centre + standard @ factor.T
        return points, self._log_density(self._optimum + points @ self._stretch.T) - log_proposal

    def _log_density(self, u: FloatArray) -> FloatArray:
        inside = np.all((u >= self._low) & (u <= self._high), axis=1)
        value = np.full(len(u), -np.inf)
        if inside.any():
            difference, deviation = self._compare(self._at(u[inside]))
            terms = -0.5 * (difference / deviation) ** 2 - np.log(deviation) - 0.5 * math.log(2.0 * math.pi)
            prior = -0.5 * np.sum(u[inside] ** 2, axis=1) - 0.5 * u.shape[1] * math.log(2.0 * math.pi)
            value[inside] = prior + terms.sum(axis=1)
        return value

    def _residuals(self, u: FloatArray) -> FloatArray:
        difference, deviation = self._compare(self._at(u))
        return np.hstack([difference / deviation, u])

    def _jacobian(self, u: FloatArray) -> FloatArray:
        step = np.where(u + _STEP < self._high, _STEP, -_STEP)
        residuals = self._residuals(np.vstack([u, u + np.diag(step)]))
        return np.asarray((residuals[1:] - residuals[0]).T / step)


def _normalised(log_weight: FloatArray) -> FloatArray:
    """Return weights of sum one; all alike where no draw has one."""
    largest = float(log_weight.max())
    weight = np.exp(log_weight - largest) if math.isfinite(largest) else np.ones(len(log_weight))
    return np.asarray(weight / weight.sum())


def _effective(weight: FloatArray) -> float:
    return float(1.0 / np.sum(weight**2))
