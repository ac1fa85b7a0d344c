"""Importance sampling of a smooth density of a few quantities."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

FloatArray = NDArray[np.float64]

LogDensity = Callable[[FloatArray], FloatArray]
"""(N, D) points to (N,) log densities, minus infinity outside the region where the density lives."""

DEGREES_OF_FREEDOM = 6.0
"""Of the Student-t proposals: tails heavier than those of the posterior, which are cut-off Gaussians."""

_TEMPERED_SHARE = 0.1
_MOST_ROUNDS = 60
_INFLATION = 1.15  # of the proposal's covariance over the posterior's


class StudentT(NamedTuple):
    """A multivariate Student-t density with `DEGREES_OF_FREEDOM`: centre (D,), scale matrix (D, D)."""

    centre: FloatArray
    scale: FloatArray

    def draw(self, generator: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
        """Return points (N, D) and their log densities (N,)."""
        size = self.centre.size
        factor = np.linalg.cholesky(self.scale)
        standard = generator.standard_normal((count, size))
        stretch = generator.chisquare(DEGREES_OF_FREEDOM, count) / DEGREES_OF_FREEDOM
        standard /= np.sqrt(stretch)[:, None]
        freedom = DEGREES_OF_FREEDOM
        constant = gammaln(0.5 * (freedom + size)) - gammaln(0.5 * freedom)
        constant -= 0.5 * size * math.log(freedom * math.pi) + float(np.log(np.diag(factor)).sum())
        square = np.sum(standard**2, axis=1)
        log_density = constant - 0.5 * (freedom + size) * np.log1p(square / freedom)
        return self.centre + standard @ factor.T, np.asarray(log_density)


def adapted_proposal(
    log_density: LogDensity,
    start: StudentT,
    generator: np.random.Generator,
    *,
    rounds: int,
    count: int,
) -> StudentT:
    """Return a proposal whose centre and scale follow the density, by rounds of weighted draws.

    Where the draws of a round say too little of the density, their weights are tempered, w^g with g < 1, so
    that a tenth of them counts; the next round then begins closer.
    """
    centre, covariance = start
    least = _TEMPERED_SHARE * count
    good = 0
    for _ in range(_MOST_ROUNDS):
        proposal = StudentT(centre, _INFLATION * covariance)
        points, log_proposal = proposal.draw(generator, count)
        log_weight = log_density(points) - log_proposal
        if np.count_nonzero(np.isfinite(log_weight)) <= least:
            covariance = 0.25 * covariance  # most draws lie outside the region
            continue
        power = _tempering(log_weight, least)
        weight, _ = normalised(power * log_weight)
        centre = weight @ points
        deviation = points - centre
        covariance = (deviation * weight[:, None]).T @ deviation
        good += power == 1.0
        if good == rounds:
            break
    return StudentT(centre, _INFLATION * covariance)


def _tempering(log_weight: FloatArray, least: float) -> float:
    """Return the greatest power g up to 1 at which weights w^g have an effective sample size of `least`."""
    low, high = 0.0, 1.0
    if effective_sample_size(normalised(log_weight)[0]) >= least:
        return 1.0
    finite = log_weight[np.isfinite(log_weight)]
    for _ in range(30):
        middle = 0.5 * (low + high)
        enough = effective_sample_size(normalised(middle * finite)[0]) >= least
        low, high = (middle, high) if enough else (low, middle)
    return low


def normalised(log_weight: FloatArray) -> tuple[FloatArray, float]:
    """Return weights of sum one, and the log of the mean weight (minus infinity if all are zero)."""
    largest = float(log_weight.max())
    if not math.isfinite(largest):
        return np.full(log_weight.shape, 1.0 / log_weight.size), -math.inf
    weight = np.exp(log_weight - largest)
    total = float(weight.sum())
    return weight / total, largest + math.log(total / log_weight.size)


def effective_sample_size(weight: FloatArray) -> float:
    """Return 1 / sum w^2 of weights of sum one."""
    return float(1.0 / np.sum(weight**2))


def systematic_resampling(
    weight: FloatArray, generator: np.random.Generator, count: int
) -> NDArray[np.int64]:
    """Return `count` indices in random order, each drawn about `count` times its weight."""
    position = (np.arange(count) + generator.random()) / count
    chosen = np.searchsorted(np.cumsum(weight), position * (1.0 - 1e-12))
    return generator.permutation(np.minimum(chosen, weight.size - 1))
