"""Compiled loops of Gaussian sensors: the log density of what they show in each state."""

import numpy as np
from numpy.typing import NDArray

from fe.compilation import compiled

__all__ = ["LOG_ROOT_TWO_PI", "log_densities"]

Float = NDArray[np.float64]
Index = NDArray[np.int64]

LOG_ROOT_TWO_PI = 0.5 * float(np.log(2.0 * np.pi))


@compiled
def _log_mean_exp(exponent: Float, log_weight: Float) -> float:
    """Return log sum_e exp(log_weight_e + exponent_e)."""
    largest = -np.inf
    for e in range(len(exponent)):
        exponent[e] += log_weight[e]
        largest = max(largest, exponent[e])
    if largest == -np.inf:
        return largest
    total = 0.0
    for e in range(len(exponent)):
        total += np.exp(exponent[e] - largest)
    return float(largest + np.log(total))


@compiled
def _log_density(
    sensors: range,
    seen: Float,
    value: Float,
    inverse_deviation: Float,
    log_scale: Float,
    interval: Float,
) -> tuple[float, Float]:
    """Return the log density of what sensors see in a state: what all draws share, and of each draw (E,).

    seen is (G,), value (G, E), inverse_deviation and its logarithm (G,), interval (G, F) in units of the
    deviation: the covariance is the unit matrix plus interval times its transpose, inverted by Woodbury's
    identity.
    """
    factors = interval.shape[1]
    exponent = np.zeros(value.shape[1])
    projected, matrix, shared = np.zeros((factors, len(exponent))), np.eye(factors), 0.0
    for g in sensors:
        if np.isnan(seen[g]):
            continue
        shared += log_scale[g] - LOG_ROOT_TWO_PI
        for e in range(len(exponent)):
            residual = (seen[g] - value[g, e]) * inverse_deviation[g]
            exponent[e] -= 0.5 * residual * residual
        for f in range(factors):
            for h in range(f + 1):
                matrix[f, h] += interval[g, f] * interval[g, h]
            scale = interval[g, f] * inverse_deviation[g]
            for e in range(len(exponent)):
                projected[f, e] += (seen[g] - value[g, e]) * scale
    for f in range(factors):  # the Cholesky factor of the matrix in its place, and what it makes of the rest
        for h in range(f):
            for i in range(h):
                matrix[f, h] -= matrix[f, i] * matrix[h, i]
            matrix[f, h] /= matrix[h, h]
            matrix[f, f] -= matrix[f, h] ** 2
            projected[f] -= matrix[f, h] * projected[h]
        matrix[f, f] = np.sqrt(matrix[f, f])
        shared -= np.log(matrix[f, f])
        for e in range(len(exponent)):
            projected[f, e] /= matrix[f, f]
            if exponent[e] > -np.inf:
                exponent[e] += 0.5 * projected[f, e] * projected[f, e]
    return shared, exponent


@compiled
def log_densities(
    observation: Float,
    control: Index,
    value: Float,
    inverse_deviation: Float,
    log_scale: Float,
    interval: Float,
    log_weight: Float,
    inside: bool,
    result: Float,
) -> None:
    """Fill result (T, S, E) with the log density for each draw, or (T, S, 1) with that of their average.

    value is (U, S, G, E) so that the loop over the draws is contiguous; inverse_deviation and log_scale = log
    inverse_deviation are (U, S, G), interval (U, S, G, F) is in units of the deviation.
    """
    steps, sensors = observation.shape
    for t in range(steps):
        u = control[t]
        if np.all(np.isnan(observation[t])):
            result[t] = 0.0
            continue
        together = 1 if inside else sensors  # how many sensors share a draw
        for s in range(value.shape[1]):
            result[t, s] = 0.0
            for first in range(0, sensors, together):
                if inside and np.isnan(observation[t, first]):
                    continue
                shared, exponent = _log_density(
                    range(first, first + together), observation[t], value[u, s], inverse_deviation[u, s],
                    log_scale[u, s], interval[u, s],
                )  # fmt: skip
                result[t, s] += shared
                if result.shape[2] == 1:
                    result[t, s] += _log_mean_exp(exponent, log_weight)
                else:
                    result[t, s] += exponent
