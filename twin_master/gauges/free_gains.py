"""Compiled loops that correct the belief of the fault that several gauges have unknown gains.

Notation and method are those of `fault_kernels`.
"""

from typing import NamedTuple

import numpy as np

from fe.compilation import compiled, compiled_with_reordered_sums
from reporting.arrays import Float, Index, Single
from twin_master.gauges.exchanged_densities import (
    ExchangeWork,
    GaugeDensities,
    exchange_densities,
    exchange_factors,
    log_exchanged_density,
    log_reference_density,
)
from twin_master.gauges.fault_kernels import (
    LEAST_TOTAL,
    NEGLIGIBLE_UNDER_FAULT,
    FaultPriors,
    FreeGainStatistics,
    StandardizedObservation,
    log_density_of_sound_gauges,
)
from twin_master.gauges.model_likelihood import ModelLikelihood


class FreeGainWeights(NamedTuple):
    """The weights of the pairs under free gains, and which gauges have a gain there.

    Attributes
    ----------
    weight : (n,) array
        The density times the belief, up to a factor.
    free_probability : (n, G) array
        The probability that a gauge has a gain of its own.
    free_square : (n, G) array
        The squared innovation over its variance, if it has one.
    """

    weight: Float
    free_probability: Single
    free_square: Single


@compiled
def _considered_positions(model: ModelLikelihood, belief: Single) -> Index:
    """Return the positions in `model.pair` of the pairs whose belief is not negligible.

    Negligible entries of the belief (N,) become zero.
    """
    for i in range(len(belief)):
        if belief[i] < NEGLIGIBLE_UNDER_FAULT:
            belief[i] = 0.0
    positions = np.empty(len(model.pair), np.int64)
    count = 0
    for j in range(len(model.pair)):
        if belief[model.pair[j]] > 0.0:
            positions[count] = j
            count += 1
    return positions[:count]


@compiled
def free_gain_densities(
    priors: FaultPriors, statistics: FreeGainStatistics, twin: int
) -> GaugeDensities:
    """Return 2 G densities of the gauges of a twin: G with a gain of their own, then G without."""
    gauges = statistics.sum_cc.shape[1]
    deviation = priors.free_gain_deviation
    densities = GaugeDensities(
        np.empty(2 * gauges, np.int64),
        np.zeros(2 * gauges),
        np.zeros(2 * gauges),
        np.empty(2 * gauges),
    )
    for g in range(gauges):
        # the fitted gain with its variance, from the regression so far; without a gain both are 0
        variance = 1.0 / (1.0 + statistics.sum_cc[twin, g])
        fixed = gauges + g
        densities.gauge[g] = g
        densities.gauge[fixed] = g
        densities.gain[g] = deviation * variance * statistics.sum_cx[twin, g]
        densities.gain_variance[g] = deviation * deviation * variance
        densities.scale_squares[g] = priors.degrees_of_freedom + statistics.free_squares[twin, g]
        densities.scale_squares[fixed] = (
            priors.degrees_of_freedom + statistics.fixed_squares[twin, g]
        )
    return densities


@compiled_with_reordered_sums
def weigh_free_gains(
    observation: StandardizedObservation,
    model: ModelLikelihood,
    densities: GaugeDensities,
    free_probability: Float,
    positions: Index,
    belief: Single,
) -> FreeGainWeights:
    """Return the weights of the pairs under free gains, relative to the reference pair.

    The density of each gauge is a mixture of two: without and with a gain of its own.

    Parameters
    ----------
    densities : GaugeDensities
        The densities of the gauges with a gain, and then those without.
    free_probability : (G,) array
        The probability that a gauge has a gain of its own.
    positions : (n,) array
        The positions in `model.pair` of the pairs with a belief that is not negligible.
    belief : (N,) array
    """
    gauges = len(free_probability)
    count = len(positions)
    factors = exchange_factors(observation, model, densities)
    # factors of both densities of each gauge: its probability, and what the ratios leave out
    factor = np.empty(2 * gauges)
    for g in range(gauges):
        fixed = gauges + g
        factor[g] = free_probability[g]
        factor[fixed] = 1.0 - free_probability[g]
        factor[g] *= np.exp(log_reference_density(observation, model, densities, g))
        factor[fixed] *= np.exp(log_reference_density(observation, model, densities, fixed))
    weights = FreeGainWeights(
        np.empty(count),
        np.empty((count, gauges), np.float32),
        np.empty((count, gauges), np.float32),
    )
    residual = np.empty(2 * gauges, np.float32)
    prediction = np.empty(2 * gauges, np.float32)
    square = np.empty(2 * gauges, np.float32)
    ratio = np.empty(2 * gauges, np.float32)
    work = ExchangeWork(
        np.empty(2 * gauges, np.float32),
        np.empty(2 * gauges, np.float32),
        np.empty(2 * gauges, np.float32),
        np.empty(2 * gauges, np.float32),
    )
    for m in range(count):
        i = model.pair[positions[m]]
        for g in range(gauges):
            residual[g] = observation.residual[i, g]
            prediction[g] = observation.prediction[i, g]
            residual[gauges + g] = residual[g]
            prediction[gauges + g] = prediction[g]
        exchange_densities(factors, residual, prediction, square, ratio, work)
        # belief times the density of all gauges: that of the model times the mixture of each gauge
        product = belief[i] * model.density[positions[m]]
        for g in range(gauges):
            free_density = factor[g] * ratio[g]
            mixture = free_density + factor[gauges + g] * ratio[gauges + g]
            weights.free_probability[m, g] = free_density / mixture
            weights.free_square[m, g] = square[g]
            product *= mixture
        weights.weight[m] = product
    return weights


@compiled
def weigh_free_gains_in_logs(
    observation: StandardizedObservation,
    model: ModelLikelihood,
    densities: GaugeDensities,
    free_probability: Float,
    positions: Index,
    belief: Single,
    weights: FreeGainWeights,
) -> float:
    """Fill `weights` as `weigh_free_gains` does, by logarithms that neither overflow nor underflow.

    The first G of `densities` are those of gauges with a gain of their own, and the other G those
    of gauges without.

    Returns
    -------
    float
        The log of the largest density, which has the weight 1, minus `model.log_density`.
    """
    gauges = len(free_probability)
    count = len(positions)
    log_density = np.empty(count)
    log_density_of_sound_gauges(
        observation, model.pair[positions], model.scale_squares, log_density
    )
    largest = -np.inf
    for m in range(count):
        i = model.pair[positions[m]]
        for g in range(gauges):
            log_free = log_exchanged_density(observation, model, densities, g, i)
            log_fixed = log_exchanged_density(observation, model, densities, gauges + g, i)
            log_free += np.log(free_probability[g])
            log_mixture = np.logaddexp(log_free, log_fixed + np.log1p(-free_probability[g]))
            log_density[m] += log_mixture
            innovation = observation.residual[i, g]
            innovation -= densities.gain[g] * observation.prediction[i, g]
            variance = 1.0 + densities.gain_variance[g] * observation.prediction[i, g] ** 2
            weights.free_probability[m, g] = np.exp(log_free - log_mixture)
            weights.free_square[m, g] = innovation * innovation / variance
        largest = max(largest, log_density[m])
    # the weights relative to the largest density
    for m in range(count):
        belief_in_pair = belief[model.pair[positions[m]]]
        weights.weight[m] = belief_in_pair * np.exp(log_density[m] - largest)
    return float(largest - model.log_density)


@compiled
def update_free_gains(
    observation: StandardizedObservation,
    model: ModelLikelihood,
    priors: FaultPriors,
    belief: Single,
    statistics: FreeGainStatistics,
    twin: int,
) -> float:
    """Correct the belief of the fault that some gauges have unknown gains; return its log evidence.

    It is not known which gauges these are. So the predictive density of each gauge is a mixture of
    two: that of a sound gauge, and that of a gauge with a gain of its own.

    Parameters
    ----------
    belief : (N,) array
        The belief; updated in place.
    statistics : FreeGainStatistics
        The regressions of all twins; those of the twin are updated in place.

    Returns
    -------
    float
        The log evidence, up to the same constant as that of the model; minus infinity if the belief
        is negligible everywhere.
    """
    positions = _considered_positions(model, belief)
    count = len(positions)
    if count == 0:
        return -np.inf
    densities = free_gain_densities(priors, statistics, twin)
    free_probability = np.empty(len(observation.present))
    for g in range(len(free_probability)):  # rounding may exceed one
        free_probability[g] = min(max(statistics.free_probability[twin, g], 0.0), 1.0)
    weights = weigh_free_gains(observation, model, densities, free_probability, positions, belief)
    log_scale = model.log_density
    total = 0.0
    for m in range(count):
        total += weights.weight[m]
    if not LEAST_TOTAL < total < 1.0 / LEAST_TOTAL:
        log_scale += weigh_free_gains_in_logs(
            observation, model, densities, free_probability, positions, belief, weights
        )
        total = 0.0
        for m in range(count):
            total += weights.weight[m]
    for m in range(count):
        weights.weight[m] /= total
        belief[model.pair[positions[m]]] = weights.weight[m]
    _update_statistics(
        observation, model, priors.free_gain_deviation, positions, weights, statistics, twin
    )
    return float(log_scale + np.log(total))


@compiled_with_reordered_sums
def _update_statistics(
    observation: StandardizedObservation,
    model: ModelLikelihood,
    deviation: float,
    positions: Index,
    weights: FreeGainWeights,
    statistics: FreeGainStatistics,
    twin: int,
) -> None:
    """Update the regression of each gauge by its expectation over the pairs, in place.

    Parameters
    ----------
    positions : (n,) array
        The positions in `model.pair` of the pairs with a belief that is not negligible.
    """
    gauges = len(observation.present)
    free_probability = np.zeros(gauges)
    fixed_squares = np.zeros(gauges)
    free_squares = np.zeros(gauges)
    sum_cc = np.zeros(gauges)
    sum_cx = np.zeros(gauges)
    # expected values: x is the residual, and c the change of the reading by one prior standard
    # deviation of the gain
    for m in range(len(positions)):
        i = model.pair[positions[m]]
        weight = weights.weight[m]
        for g in range(gauges):
            x = observation.residual[i, g]
            weighted_c = weight * deviation * observation.prediction[i, g]
            free_probability[g] += weight * weights.free_probability[m, g]
            free_squares[g] += weight * weights.free_square[m, g]
            fixed_squares[g] += weight * x * x
            sum_cc[g] += weighted_c * deviation * observation.prediction[i, g]
            sum_cx[g] += weighted_c * x
    # a gauge without a reading keeps its statistics
    for g in range(gauges):
        if observation.present[g]:
            statistics.free_probability[twin, g] = free_probability[g]
            statistics.fixed_squares[twin, g] += fixed_squares[g]
            statistics.free_squares[twin, g] += free_squares[g]
            statistics.sum_cc[twin, g] += sum_cc[g]
            statistics.sum_cx[twin, g] += sum_cx[g]
