"""Laplace's approximation and importance sampling of a smooth density of a few quantities."""

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

_NEWTON_STEPS = 50
_DIFFERENCE = 1e-2  # step of the central differences, in rough standard deviations
_TEMPERED_SHARE = 0.1
_MOST_ROUNDS = 60
_INFLATION = 1.15  # of the proposal's covariance over the posterior's


class Laplace(NamedTuple):
    """Mode (D,) and covariance (D, D) from second derivatives; `regular` is False at a cut-off."""

    mode: FloatArray
    covariance: FloatArray
    regular: bool


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


def laplace(log_density: LogDensity, start: FloatArray, scale: FloatArray) -> Laplace:
    """Find the mode by Newton's method, and the Gaussian that fits there.

    Parameters
    ----------
    log_density : callable
        The density.
    start : (D,) array
        Where the search begins.
    scale : (D,) array
        Rough standard deviations: units of the search, and where the covariance is cut off if the mode lies
        at the end of the region.
    """
    here = start
    value = float(log_density(here[None, :])[0])
    for _ in range(_NEWTON_STEPS):
        slope, curvature = _derivatives(log_density, here, scale)
        if not np.all(np.isfinite(curvature)):
            return Laplace(here, np.diag(scale**2), False)  # at the end of the region
        eigenvalue, direction = np.linalg.eigh(-curvature)
        # Uphill also where the density is not yet concave, and not farther than three units.
        step = direction @ ((direction.T @ slope) / np.maximum(np.abs(eigenvalue), 1e-3))
        step *= min(1.0, 3.0 / max(float(np.linalg.norm(step)), 1e-300))
        trials = here + scale * step * 0.5 ** np.arange(12.0)[:, None]
        values = log_density(trials)
        best = int(np.argmax(values))
        if not values[best] > value:
            break
        gained, here, value = float(values[best]) - value, trials[best], float(values[best])
        if gained < 1e-9:
            break
    curvature = _derivatives(log_density, here, scale)[1]
    if np.all(np.isfinite(curvature)) and np.all(np.linalg.eigvalsh(-curvature) > 0.0):
        return Laplace(here, np.linalg.inv(-curvature) * np.outer(scale, scale), True)
    return Laplace(here, np.diag(scale**2), False)


def _derivatives(
    log_density: LogDensity, centre: FloatArray, scale: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return first (D,) and second (D, D) central differences in units of `scale`."""
    size = centre.size
    unit = _DIFFERENCE * np.eye(size)
    signs = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))
    shifts = [a * unit[i] + b * unit[j] for i in range(size) for j in range(size) for a, b in signs]
    values = log_density(centre + scale * np.array([*unit, *-unit, *shifts]))
    if not np.all(np.isfinite(values)):
        return np.full(size, np.nan), np.full((size, size), np.nan)
    slope = (values[:size] - values[size : 2 * size]) / (2.0 * _DIFFERENCE)
    corner = values[2 * size :].reshape(size, size, 4)
    return slope, (corner @ np.array([1.0, -1.0, -1.0, 1.0])) / (4.0 * _DIFFERENCE**2)


def adapted_proposal(
    log_density: LogDensity, start: Laplace, generator: np.random.Generator, *, rounds: int, count: int
) -> StudentT:
    """Return a proposal whose centre and scale follow the density, by rounds of weighted draws.

    Where the draws of a round say too little of the density (its mode may lie at the end of the region, where
    Laplace's approximation is none), their weights are tempered, w^g with g < 1, so that a tenth of them
    counts; the next round then begins closer.
    """
    centre, covariance = start.mode, start.covariance
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
