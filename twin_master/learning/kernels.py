"""Compiled loops of learning: one filter for each static hypothesis, conjugate statistics for each gauge."""

import math

import numpy as np
from numpy.typing import NDArray

from fe.compilation import compiled
from twin_master.network.kernels import SAFE, _exp, _log_forecast

__all__ = ["forecast_all", "gauge_statistics", "log_likelihood", "normalise", "regression"]

Float = NDArray[np.float64]
Index = NDArray[np.int64]
Unsigned = NDArray[np.uint64]

LOG_TWO_PI = math.log(2.0 * math.pi)
LARGE = 1e100
"""A product is taken to the logarithm above this."""
NEGLIGIBLE_WEIGHT = 1e-30
"""States below this share of a hypothesis add nothing to its statistics that doubles can hold."""


@compiled
def forecast_all(
    log_before: Float,
    row_begin: Index,
    start: Unsigned,
    source: Unsigned,
    probability: Float,
    log_probability: Float,
    log_forecast: Float,
) -> None:
    """Fill log_forecast (K, S) with the beliefs of K hypotheses after one transition.

    `row_begin` (K,) is the first row of the predecessor lists of each hypothesis.
    """
    hypotheses, size = log_before.shape
    linear = np.empty(size)
    for k in range(hypotheses):
        for state in range(size):
            linear[state] = _exp(log_before[k, state])
        for state in range(size):
            row = row_begin[k] + state
            total = 0.0
            for i in range(start[row], start[row + 1]):
                total += linear[source[i]] * probability[i]
            if total >= SAFE:
                log_forecast[k, state] = np.log(total)
            else:
                log_forecast[k, state] = _log_forecast(
                    start[row], start[row + 1], source, log_probability, log_before[k]
                )


@compiled
def regression(statistics: Float, result: Float) -> None:
    """Fill result (K, G, 6): coefficients (2), their covariance (3) and the squares that they leave.

    statistics (K, G, 6) are the sums of a², ac, c², ax, cx, x² over what was observed; the coefficients of
    a and c have the prior N(0, 1) in units of the noise.
    """
    hypotheses, sensors = statistics.shape[:2]
    for k in range(hypotheses):
        for g in range(sensors):
            aa, ac, cc, ax, cx, xx = statistics[k, g]
            first, second = 1.0 + aa, 1.0 + cc
            determinant = first * second - ac * ac
            result[k, g, 0] = (second * ax - ac * cx) / determinant
            result[k, g, 1] = (first * cx - ac * ax) / determinant
            result[k, g, 2] = second / determinant
            result[k, g, 3] = -ac / determinant
            result[k, g, 4] = first / determinant
            left = xx - ax * result[k, g, 0] - cx * result[k, g, 1]
            result[k, g, 5] = max(left, 0.0)


@compiled
def log_likelihood(
    observation: Float,
    draw: Index,
    value: Float,
    inverse_deviation: Float,
    log_scale: Float,
    offset: Float,
    gain: Float,
    fitted: Float,
    count: Float,
    degrees: float,
    result: Float,
) -> None:
    """Fill result (K, S) with log p(o | state, hypothesis, what was observed before).

    value is (E, S, G), inverse_deviation and its logarithm log_scale (S, G), offset and gain (G,) their
    prior deviations; fitted (K, G, 6) as `regression` gives it, count (G,) of the observations. Without
    `degrees` the noise is known, else the predictive density of each gauge is Student's. Products of
    densities of the same degrees of freedom are formed before their logarithm is taken, which is what costs.
    """
    hypotheses, states = result.shape
    sensors = len(observation)
    constant = np.empty(sensors)
    for g in range(sensors):
        freedom = degrees + count[g]
        constant[g] = -0.5 * LOG_TWO_PI
        if degrees > 0.0:
            constant[g] = math.lgamma(0.5 * (freedom + 1.0)) - math.lgamma(0.5 * freedom)
            constant[g] -= 0.5 * math.log(math.pi)
    for k in range(hypotheses):
        e = draw[k]
        own = 0.0  # of the hypothesis, whatever the state
        for g in range(sensors):
            if not np.isnan(observation[g]):
                own += constant[g]
                if degrees > 0.0:
                    own -= 0.5 * math.log(degrees + fitted[k, g, 5])
        for s in range(states):
            total, product, half = own, 1.0, 0.0
            for g in range(sensors):
                if np.isnan(observation[g]):
                    continue
                scale = inverse_deviation[s, g]
                x = (observation[g] - value[e, s, g]) * scale
                spread = 1.0
                total += log_scale[s, g]
                if offset[g] > 0.0 or gain[g] > 0.0:
                    a, c = offset[g] * scale, gain[g] * value[e, s, g] * scale
                    x -= a * fitted[k, g, 0] + c * fitted[k, g, 1]
                    spread += (
                        a * a * fitted[k, g, 2] + 2.0 * a * c * fitted[k, g, 3] + c * c * fitted[k, g, 4]
                    )
                    total -= 0.5 * math.log(spread)
                if degrees > 0.0:
                    power = 0.5 * (degrees + count[g] + 1.0)
                    if power != half or product > LARGE:
                        total -= half * math.log(product)
                        product, half = 1.0, power
                    product *= 1.0 + x * x / ((degrees + fitted[k, g, 5]) * spread)
                else:
                    total -= 0.5 * x * x / spread
            result[k, s] = total - half * math.log(product)


@compiled
def normalise(log_belief: Float, filtered: Float) -> float:
    """Normalise log_belief (K, S) in place, fill filtered; return the log of the sum, -inf if it is zero."""
    best = -np.inf
    for k in range(log_belief.shape[0]):
        for s in range(log_belief.shape[1]):
            best = max(best, log_belief[k, s])
    if best == -np.inf:
        return best
    total = 0.0
    for k in range(log_belief.shape[0]):
        for s in range(log_belief.shape[1]):
            filtered[k, s] = _exp(log_belief[k, s] - best)
            total += filtered[k, s]
    evidence = float(best + np.log(total))
    for k in range(log_belief.shape[0]):
        for s in range(log_belief.shape[1]):
            filtered[k, s] /= total
            log_belief[k, s] -= evidence
    return evidence


@compiled
def gauge_statistics(
    observation: Float,
    draw: Index,
    value: Float,
    inverse_deviation: Float,
    offset: Float,
    gain: Float,
    log_belief: Float,
    statistics: Float,
) -> None:
    """Add what each gauge showed to statistics (K, G, 6), expected over the state given the hypothesis."""
    hypotheses, states = log_belief.shape
    weight = np.empty(states)
    for k in range(hypotheses):
        best = -np.inf
        for s in range(states):
            best = max(best, log_belief[k, s])
        if best == -np.inf:
            continue
        total = 0.0
        for s in range(states):
            weight[s] = _exp(log_belief[k, s] - best)
            total += weight[s]
        e = draw[k]
        for s in range(states):
            share = weight[s] / total
            if share < NEGLIGIBLE_WEIGHT:
                continue
            for g in range(len(observation)):
                if np.isnan(observation[g]):
                    continue
                scale = inverse_deviation[s, g]
                x = (observation[g] - value[e, s, g]) * scale
                a, c = offset[g] * scale, gain[g] * value[e, s, g] * scale
                statistics[k, g, 0] += share * a * a
                statistics[k, g, 1] += share * a * c
                statistics[k, g, 2] += share * c * c
                statistics[k, g, 3] += share * a * x
                statistics[k, g, 4] += share * c * x
                statistics[k, g, 5] += share * x * x
