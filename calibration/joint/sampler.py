"""Laplace's approximation and importance sampling of a smooth density of a few quantities."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import gammaln

FloatArray = NDArray[np.float64]

LogDensity = Callable[[FloatArray], FloatArray]
"""(N, D) points to (N,) log densities, minus infinity outside the region where the density lives."""

DEGREES_OF_FREEDOM = 6.0
"""Of the Student-t proposals: tails heavier than those of the posterior, which are cut-off Gaussians."""

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
    """Find the mode and the Gaussian that fits there.

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

    def negative(unknown: FloatArray) -> float:
        value = -float(log_density((start + scale * unknown)[None, :])[0])
        return value if math.isfinite(value) else 1e300

    size = start.size
    found = np.zeros(size)
    for _ in range(2):  # a second simplex around the first result: one alone may stop early
        options = {"xatol": 1e-7, "fatol": 1e-10, "maxiter": 4000, "maxfev": 4000}
        found = minimize(negative, found, method="Nelder-Mead", options=options).x
    mode = start + scale * found
    step = 1e-2
    offsets = step * np.eye(size)
    pairs = [(i, j) for i in range(size) for j in range(size)]
    corners = np.array(
        [
            [found + a * offsets[i] + b * offsets[j] for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
            for i, j in pairs
        ]
    ).reshape(-1, size)
    values = log_density(start + scale * corners).reshape(len(pairs), 4)
    curvature = ((values @ np.array([1.0, -1.0, -1.0, 1.0])) / (4.0 * step**2)).reshape(size, size)
    if np.all(np.isfinite(curvature)) and np.all(np.linalg.eigvalsh(-curvature) > 0.0):
        return Laplace(mode, np.linalg.inv(-curvature) * np.outer(scale, scale), True)
    return Laplace(mode, np.diag(scale**2), False)


def adapted_proposal(
    log_density: LogDensity, start: Laplace, generator: np.random.Generator, *, rounds: int, count: int
) -> StudentT:
    """Return a proposal whose centre and scale follow the density, by rounds of weighted draws."""
    centre, covariance = start.mode, start.covariance
    for _ in range(rounds):
        proposal = StudentT(centre, _INFLATION * covariance)
        points, log_proposal = proposal.draw(generator, count)
        weight, _ = normalised(log_density(points) - log_proposal)
        if effective_sample_size(weight) < 10.0 * centre.size:
            covariance = 4.0 * covariance  # the proposal is too narrow to be improved from: look around
            continue
        centre = weight @ points
        deviation = points - centre
        covariance = (deviation * weight[:, None]).T @ deviation
    return StudentT(centre, _INFLATION * covariance)


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
