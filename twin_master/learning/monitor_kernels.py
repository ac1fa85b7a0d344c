"""Compiled loop of the monitor: rival hypotheses about the gauges beside the model as it is."""

import math

import numpy as np
from numpy.typing import NDArray

from fe.compilation import compiled
from twin_master.learning.kernels import regression
from twin_master.network.kernels import _exp

__all__ = ["watch_turn"]

Float = NDArray[np.float64]
Unsigned = NDArray[np.uint64]

NEGLIGIBLE = 1e-30
"""States of a hypothesis below this probability are left out of its likelihood until they come back."""


@compiled
def watch_turn(
    observation: Float,
    value: Float,
    inverse_deviation: Float,
    gain: Float,
    all_gain: float,
    degrees: float,
    memory: float,
    forecast: Float,
    statistics: Float,
    count: Float,
    log_evidence: Float,
) -> None:
    """Assimilate one observation under G + 2 hypotheses, in place.

    Hypothesis 0 has every gauge as the model says, hypothesis g the gain of gauge g free, the last one the
    gain of every gauge. value is (E, S, G), inverse_deviation (S, G), gain (G,) the prior deviation of the
    gain of hypothesis g, all_gain that of the last; forecast (H, E, S) becomes the belief; log_evidence (H,)
    is that of the observation. statistics (H, G, 6) and count (H, G) are the sums of the regressions, those of
    the gain fading by `memory` a turn; the sum of squares is that of the innovations over their spread
    (West and Harrison 1997, section 4.6), so that what a gain explained once stays explained.
    """
    hypotheses, draws, states = forecast.shape
    sensors = len(observation)
    fitted = np.zeros_like(statistics)
    regression(statistics, fitted)
    standard = np.empty((draws, states, sensors))
    known = np.zeros((draws, states, sensors))
    total = np.zeros((draws, states))
    constant = np.zeros((hypotheses, sensors))
    for m in range(hypotheses):
        for g in range(sensors):
            half = 0.5 * (degrees + count[m, g])
            constant[m, g] = math.lgamma(half + 0.5) - math.lgamma(half)
            constant[m, g] -= 0.5 * math.log(degrees + statistics[m, g, 5])
    for e in range(draws):
        for s in range(states):
            for g in range(sensors):
                if np.isnan(observation[g]):
                    continue
                scale = inverse_deviation[s, g]
                x = (observation[g] - value[e, s, g]) * scale
                power = 0.5 * (degrees + count[0, g] + 1.0)
                known[e, s, g] = constant[0, g] - power * math.log1p(x * x / (degrees + statistics[0, g, 5]))
                standard[e, s, g] = x
                total[e, s] += known[e, s, g] + math.log(scale)
    for m in range(hypotheses):
        best = -np.inf
        belief = forecast[m]
        for e in range(draws):
            for s in range(states):
                if belief[e, s] < NEGLIGIBLE:
                    belief[e, s] = -np.inf
                    continue
                log_value = total[e, s]
                first = 0 if m == hypotheses - 1 else m - 1
                last = sensors if m == hypotheses - 1 else m
                for g in range(max(first, 0), last):
                    if np.isnan(observation[g]):
                        continue
                    prior = all_gain if m == hypotheses - 1 else gain[g]
                    c = prior * value[e, s, g] * inverse_deviation[s, g]
                    x = standard[e, s, g] - c * fitted[m, g, 1]
                    spread = 1.0 + c * c * fitted[m, g, 4]
                    power = 0.5 * (degrees + count[m, g] + 1.0)
                    log_value += constant[m, g] - 0.5 * math.log(spread) - known[e, s, g]
                    log_value -= power * math.log1p(x * x / ((degrees + statistics[m, g, 5]) * spread))
                belief[e, s] = log_value + math.log(belief[e, s])
                best = max(best, belief[e, s])
        mass = 0.0
        for e in range(draws):
            for s in range(states):
                belief[e, s] = _exp(belief[e, s] - best) if best > -np.inf else 0.0
                mass += belief[e, s]
        log_evidence[m] = best + math.log(mass) if mass > 0.0 else -np.inf
        for e in range(draws):
            for s in range(states):
                belief[e, s] /= max(mass, NEGLIGIBLE)
        first = 0 if m == hypotheses - 1 or m == 0 else m - 1
        last = sensors if m == hypotheses - 1 or m == 0 else m
        for g in range(first, last):
            for i in range(5):
                statistics[m, g, i] *= memory
            if np.isnan(observation[g]):
                continue
            count[m, g] += 1.0
            prior = 0.0 if m == 0 else all_gain if m == hypotheses - 1 else gain[g]
            for e in range(draws):
                for s in range(states):
                    share = belief[e, s]
                    if share < 1e-12:
                        continue
                    x = standard[e, s, g]
                    c = prior * value[e, s, g] * inverse_deviation[s, g]
                    statistics[m, g, 2] += share * c * c
                    statistics[m, g, 4] += share * c * x
                    x -= c * fitted[m, g, 1]
                    statistics[m, g, 5] += share * x * x / (1.0 + c * c * fitted[m, g, 4])
