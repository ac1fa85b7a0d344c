"""Compiled loops of the monitor: rival hypotheses about the gauges beside the model as it is."""

import math

import numpy as np
from numpy.typing import NDArray

from fe.compilation import compiled
from twin_master.network.kernels import _exp

__all__ = ["forecast_rows", "mix_onset", "weigh_gauges", "weigh_model", "weigh_none"]

Float = NDArray[np.float64]
Single = NDArray[np.float32]
Unsigned = NDArray[np.uint64]

NEGLIGIBLE = 1e-30
"""States of the model below this probability are left out of its evidence."""
NEGLIGIBLE_RIVAL = 1e-7
"""The same of a rival: what is left out makes its evidence smaller, and an alarm later."""
NEGLIGIBLE_SHARE = 1e-9
"""States below this probability add nothing to a sum of squares."""
LARGE = 1e100
"""Products of densities are taken between this and its inverse: one logarithm for many."""


@compiled
def forecast_rows(
    start: Unsigned, source: Unsigned, probability: Float, first_row: int, before: Float, after: Float
) -> None:
    """Fill after (n, S) with n beliefs one transition later; any kind of float."""
    rows, size = before.shape
    for row in range(rows):
        if not np.any(before[row]):  # a draw that is left out
            after[row] = 0.0
            continue
        for state in range(size):
            total = 0.0
            for i in range(start[first_row + state], start[first_row + state + 1]):
                total += before[row, source[i]] * probability[i]
            after[row, state] = total


@compiled
def mix_onset(
    model: Float, belief: Single, log_weight: Float, log_inflow: Float, turn: float, onset: Float, keep: Float
) -> None:
    """Let rivals begin in this turn: those of before and the model's belief are mixed by their weights.

    belief (n, E, S), log_weight and onset, the expected first turn, (n,) in place; log_inflow (n,); keep (n,)
    becomes the share of those that began before.
    """
    for m in range(len(log_weight)):
        largest = max(log_weight[m], log_inflow[m])
        old, new = _exp(log_weight[m] - largest), _exp(log_inflow[m] - largest)
        keep[m] = old / (old + new)
        log_weight[m] = largest + math.log(old + new)
        onset[m] = keep[m] * onset[m] + (1.0 - keep[m]) * turn
        for e in range(model.shape[0]):
            for s in range(model.shape[1]):
                belief[m, e, s] = keep[m] * belief[m, e, s] + (1.0 - keep[m]) * model[e, s]


@compiled
def weigh_model(
    observation: Float,
    value: Float,
    inverse_deviation: Float,
    degrees: float,
    count: Float,
    squares: Float,
    belief: Float,
    known: Float,
    log_likelihood: Float,
) -> float:
    """Assimilate one observation under the model; return its log evidence, up to a constant of the turn.

    value is (E, S, G), inverse_deviation (S, G); squares (G,), the expected sums of squares of the residuals
    in units of the assumed noise, and belief (E, S), the forecast, are brought up to date. known (E, S, G)
    becomes 1 + x² / (degrees + squares); the sum over the gauges is added to log_likelihood (E, S).
    """
    draws, states, sensors = value.shape
    best = -np.inf
    log_scale = np.zeros(states)
    for s in range(states):
        for g in range(sensors):
            if not np.isnan(observation[g]):
                log_scale[s] += math.log(inverse_deviation[s, g])
    for e in range(draws):
        for s in range(states):
            total, product, power = log_likelihood[e, s] + log_scale[s], 1.0, 0.0
            for g in range(sensors):
                if np.isnan(observation[g]):
                    continue
                x = (observation[g] - value[e, s, g]) * inverse_deviation[s, g]
                known[e, s, g] = 1.0 + x * x / (degrees + squares[g])
                # One logarithm for all sensors with as many observations, until their product is large.
                if power != 0.5 * (degrees + count[g] + 1.0) or product > LARGE:
                    total -= power * math.log(product)
                    product, power = 1.0, 0.5 * (degrees + count[g] + 1.0)
                product *= known[e, s, g]
            total -= power * math.log(product)
            log_likelihood[e, s] = total
            if belief[e, s] >= NEGLIGIBLE:
                best = max(best, total)
    mass = 0.0
    for e in range(draws):
        for s in range(states):
            if belief[e, s] >= NEGLIGIBLE:
                belief[e, s] *= _exp(log_likelihood[e, s] - best)
                mass += belief[e, s]
            else:
                belief[e, s] = 0.0
    added = np.zeros(sensors)
    for e in range(draws):
        for s in range(states):
            belief[e, s] /= mass
            if belief[e, s] >= NEGLIGIBLE_SHARE:
                for g in range(sensors):
                    if not np.isnan(observation[g]):
                        added[g] += belief[e, s] * (known[e, s, g] - 1.0) * (degrees + squares[g])
    squares += added
    return float(best + math.log(mass))


@compiled
def weigh_gauges(
    observation: Float,
    value: Float,
    inverse_deviation: Float,
    gains: Float,
    reach: Float,
    degrees: float,
    count: Float,
    squares_of_model: Float,
    known: Float,
    log_likelihood: Float,
    log_evidence: float,
    belief: Single,
    log_weight: Float,
    squares: Float,
    sums: Float,
) -> None:
    """Assimilate one observation under the rivals "gauge g shows 1 + gains[k] times what is there".

    The gain is learnt within gains[k] ± reach[k], its prior standard deviation, by the sums c² and cx of a
    regression, sums (G, K, 2). squares_of_model (G,) are those before the observation; known, log_likelihood
    and log_evidence are of the model. belief (G, K, E, S), log_weight, squares (G, K) and sums are brought up
    to date.
    """
    draws, states, sensors = value.shape
    log_value, root = np.empty((draws, states)), np.empty((draws, states))
    for g in range(sensors):
        for k in range(len(gains)):
            seen = not np.isnan(observation[g])
            left, power = degrees + squares[g, k], 0.5 * (degrees + count[g] + 1.0)
            constant = 0.5 * math.log((degrees + squares_of_model[g]) / left)
            unknown = 1.0 / (1.0 + sums[g, k, 0])
            fitted = min(max(unknown * sums[g, k, 1], -1.0), 1.0)
            best = -np.inf
            for e in range(draws):
                for s in range(states):
                    if belief[g, k, e, s] < NEGLIGIBLE_RIVAL:
                        belief[g, k, e, s] = 0.0
                        continue
                    total, wide = log_likelihood[e, s], 1.0
                    if seen:
                        c = reach[k] * value[e, s, g] * inverse_deviation[s, g]
                        x = (observation[g] - (1.0 + gains[k]) * value[e, s, g]) * inverse_deviation[s, g]
                        x -= c * fitted
                        wide = 1.0 + c * c * unknown
                        total += constant + power * math.log(known[e, s, g] / (1.0 + x * x / (left * wide)))
                    log_value[e, s], root[e, s] = total, math.sqrt(wide)
                    best = max(best, total)
            mass = 0.0
            for e in range(draws):
                for s in range(states):
                    if belief[g, k, e, s] > 0.0:
                        log_value[e, s] = belief[g, k, e, s] * _exp(log_value[e, s] - best) / root[e, s]
                        mass += log_value[e, s]
            log_weight[g, k] += best + math.log(mass) - log_evidence if mass > 0.0 else -np.inf
            for e in range(draws):
                for s in range(states):
                    if belief[g, k, e, s] > 0.0:
                        belief[g, k, e, s] = log_value[e, s] / mass
            if seen:
                added = _regressed(
                    observation[g], value[:, :, g], inverse_deviation[:, g], 1.0 + gains[k], reach[k], fitted,
                    unknown, belief[g, k],
                )  # fmt: skip
                squares[g, k] += added[3]
                sums[g, k] += added[1:3]


@compiled
def _regressed(
    seen: float,
    value: Float,
    inverse_deviation: Float,
    shown: float,
    gain: float,
    fitted: float,
    unknown: float,
    belief: Single,
) -> Float:
    """Return expected sums over draws and states (4,): x², c², cx, and the innovations over their spread.

    x is what one gauge shows beyond `shown` times its value, and c what a share `gain` of the value is.
    """
    added = np.zeros(4)
    for e in range(belief.shape[0]):
        for s in range(belief.shape[1]):
            share = belief[e, s]
            if share < NEGLIGIBLE_SHARE:
                continue
            x = (seen - shown * value[e, s]) * inverse_deviation[s]
            c = gain * value[e, s] * inverse_deviation[s]
            added[0] += share * x * x
            added[1] += share * c * c
            added[2] += share * c * x
            x -= c * fitted
            added[3] += share * x * x / (1.0 + c * c * unknown)
    return added


@compiled
def weigh_none(
    observation: Float,
    value: Float,
    inverse_deviation: Float,
    gain: float,
    degrees: float,
    count: Float,
    squares_of_model: Float,
    known: Float,
    log_likelihood: Float,
    belief: Single,
    statistics: Float,
) -> float:
    """Assimilate one observation under the rival that some gauges have gains of their own; return its log.

    Which ones is not known: the predictive density of each gauge is a mixture of that without a gain and that
    with a free one. belief (E, S) and statistics (G, 5) are brought up to date: probability that the gain is
    free, sum of squares without, sums c² and cx of the regression, and sum of squares of its innovations over
    their spread (West and Harrison 1997, section 4.6).
    """
    draws, states, sensors = value.shape
    log_value = np.empty((draws, states))
    free = np.zeros((draws, states, sensors))
    best = -np.inf
    without = np.sqrt((degrees + squares_of_model) / (degrees + statistics[:, 1]))
    for e in range(draws):
        for s in range(states):
            if belief[e, s] < NEGLIGIBLE_RIVAL:
                belief[e, s] = 0.0
                continue
            total, product = log_likelihood[e, s], 1.0
            for g in range(sensors):
                if np.isnan(observation[g]):
                    continue
                power = 0.5 * (degrees + count[g] + 1.0)
                x = (observation[g] - value[e, s, g]) * inverse_deviation[s, g]
                left = degrees + statistics[g, 1]
                log_without = power * math.log(known[e, s, g] / (1.0 + x * x / left))
                c = gain * value[e, s, g] * inverse_deviation[s, g]
                x -= c * statistics[g, 3] / (1.0 + statistics[g, 2])
                left = (degrees + statistics[g, 4]) * (1.0 + c * c / (1.0 + statistics[g, 2]))
                log_with = power * math.log(known[e, s, g] / (1.0 + x * x / left))
                largest, own, other = _scaled(statistics[g, 0], log_with, log_without)
                own *= math.sqrt((degrees + squares_of_model[g]) / left)
                both = own + other * without[g]
                total += largest
                free[e, s, g] = own / both
                if not 1.0 / LARGE < product < LARGE:
                    total += math.log(product)
                    product = 1.0
                product *= both
            log_value[e, s] = total + math.log(product)
            best = max(best, total)
    mass = _weigh(belief, log_value, best)
    if mass == 0.0:
        return -np.inf
    for g in range(sensors):
        if not np.isnan(observation[g]):
            _learn_gain(
                observation[g], value[:, :, g], inverse_deviation[:, g], gain, belief, free[:, :, g],
                statistics[g],
            )  # fmt: skip
    return float(best + math.log(mass))


@compiled
def _scaled(share: float, log_one: float, log_other: float) -> tuple[float, float, float]:
    """Return the larger logarithm that counts, and share e^one and (1 - share) e^other over its exponential.

    What is ruled out for good does not count, whatever it would explain; rounding takes a share above one.
    """
    if share <= 0.0 or share >= 1.0:
        return (log_one, 1.0, 0.0) if share > 0.0 else (log_other, 0.0, 1.0)
    if log_one > log_other:
        return log_one, share, (1.0 - share) * _exp(log_other - log_one)
    return log_other, share * _exp(log_one - log_other), 1.0 - share


@compiled
def _weigh(belief: Single, log_value: Float, best: float) -> float:
    """Multiply a belief (E, S) by likelihoods, and normalise it; return its sum before, over exp(best)."""
    mass = 0.0
    for e in range(belief.shape[0]):
        for s in range(belief.shape[1]):
            if belief[e, s] > 0.0:
                log_value[e, s] = belief[e, s] * _exp(log_value[e, s] - best)
                mass += log_value[e, s]
    for e in range(belief.shape[0]):
        for s in range(belief.shape[1]):
            if belief[e, s] > 0.0:
                belief[e, s] = log_value[e, s] / mass
    return mass


@compiled
def _learn_gain(
    seen: float, value: Float, inverse_deviation: Float, gain: float, belief: Single, free: Float, sums: Float
) -> None:
    """Bring the statistics (5,) of one gauge up to date, expected over draws and states."""
    unknown, share = 1.0 / (1.0 + sums[2]), 0.0
    for e in range(belief.shape[0]):
        for s in range(belief.shape[1]):
            share += belief[e, s] * free[e, s]
    sums[0] = share
    sums[1:] += _regressed(seen, value, inverse_deviation, 1.0, gain, unknown * sums[3], unknown, belief)
