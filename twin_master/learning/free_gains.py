"""Compiled loops that correct the belief of the fault that several gauges have unknown gains.

Notation and method are those of `fault_kernels`.
"""

from typing import NamedTuple

import numpy as np

from fe.compilation import compiled
from reporting.arrays import Float, Index, Single
from twin_master.learning.fault_kernels import (
    NEGLIGIBLE_UNDER_FAULT,
    FaultPriors,
    FreeGainStatistics,
    StandardizedObservation,
)
from twin_master.learning.model_likelihood import ModelLikelihood, multiply_by_power

_LEAST_RATIO = 1e-60
"""Densities of a gauge over that of the model are multiplied if they lie between this and 1e60."""
_GAUGES_OF_A_PRODUCT = 4
"""So many are multiplied before a logarithm is taken."""


class PairsOfFreeGains(NamedTuple):
    """The pairs that the fault of free gains believes in, n of them, in units of the noise.

    Attributes
    ----------
    pair : (n,) array
        The index of each among all pairs.
    x, c : (G, n) array
        The residuals, and their derivatives by the gain over its prior standard deviation.
    kernel : (G, n) array
        The kernel of each gauge's density under the model.
    """

    pair: Index
    x: Float
    c: Float
    kernel: Float


class GaugeWithFreeGain(NamedTuple):
    """A gauge that may have a gain of its own, before an observation.

    Attributes
    ----------
    gauge : int
        The gauge.
    free_probability : float
        The probability that it has.
    fitted_gain, gain_variance : float
        The learnt gain over its prior standard deviation, and its variance.
    degrees_of_freedom : float
        Twice the power of the density.
    model_squares, fixed_squares, free_squares : float
        Degrees of freedom plus the sum of squares: under the model, and without and with a gain.
    """

    gauge: int
    free_probability: float
    fitted_gain: float
    gain_variance: float
    degrees_of_freedom: float
    model_squares: float
    fixed_squares: float
    free_squares: float


@compiled
def _take_pairs(
    model: ModelLikelihood, deviation: float, belief: Single, weight: Float
) -> PairsOfFreeGains:
    """Return the pairs with a belief that is not negligible; the belief of all others becomes zero.

    Parameters
    ----------
    model : ModelLikelihood
        How the model explains the observation, at the pairs that faults consider.
    deviation : float
        The prior standard deviation of a free gain.
    belief : (N,) array
        The belief; updated in place.
    weight : (n,) array
        Its first entries are filled with the log density of the model at the pairs.
    """
    gauges = len(model.scale_squares)
    index = np.empty(len(model.pair), np.int64)
    count = 0
    for i in range(len(belief)):
        if belief[i] < NEGLIGIBLE_UNDER_FAULT:
            belief[i] = 0.0
    for j in range(len(model.pair)):
        if belief[model.pair[j]] > 0.0:
            index[count] = j
            count += 1
    pair = np.empty(count, np.int64)
    x = np.empty((gauges, count))
    c = np.empty((gauges, count))
    kernel = np.empty((gauges, count))
    for m in range(count):
        j = index[m]
        pair[m] = model.pair[j]
        weight[m] = model.log_density[j]
        for g in range(gauges):
            x[g, m] = model.residual[j, g]
            c[g, m] = deviation * model.prediction[j, g]
            kernel[g, m] = model.kernel[j, g]
    return PairsOfFreeGains(pair, x, c, kernel)


@compiled
def mix_densities(
    pairs: PairsOfFreeGains, gauge: GaugeWithFreeGain, mixture: Float, free_part: Float
) -> bool:
    """Fill in the density of a gauge over that of the model, and its part with a gain of its own.

    The compiler vectorises loops that write to arrays of this function only.

    Parameters
    ----------
    pairs : PairsOfFreeGains
        The n pairs.
    gauge : GaugeWithFreeGain
        The gauge.
    mixture, free_part : (n,) array
        To be filled: the density, and the fraction of it that a gain of its own adds.

    Returns
    -------
    bool
        Whether all densities are neither so large nor so small that their products may overflow or
        underflow.
    """
    count = len(mixture)
    x = pairs.x[gauge.gauge]
    c = pairs.c[gauge.gauge]
    kernel = pairs.kernel[gauge.gauge]
    base_free = np.empty(count)
    power_free = np.empty(count)
    base_fixed = np.empty(count)
    power_fixed = np.ones(count)
    for j in range(count):
        innovation = x[j] - c[j] * gauge.fitted_gain
        variance = 1.0 + c[j] * c[j] * gauge.gain_variance
        free_kernel = gauge.free_squares * variance + innovation * innovation
        fixed_kernel = gauge.fixed_squares + x[j] * x[j]
        inverse = 1.0 / (variance * free_kernel)
        base_free[j] = kernel[j] * gauge.free_squares * variance * variance * inverse
        power_free[j] = free_kernel * inverse
        base_fixed[j] = kernel[j] * gauge.fixed_squares / fixed_kernel
    multiply_by_power(base_free, gauge.degrees_of_freedom, power_free)
    multiply_by_power(base_fixed, gauge.degrees_of_freedom, power_fixed)
    constant_free = gauge.free_probability * np.sqrt(gauge.model_squares / gauge.free_squares)
    constant_fixed = np.sqrt(gauge.model_squares / gauge.fixed_squares)
    constant_fixed *= 1.0 - gauge.free_probability
    for j in range(count):
        base_free[j] = constant_free * np.sqrt(power_free[j])
        power_fixed[j] = base_free[j] + constant_fixed * np.sqrt(power_fixed[j])
        base_free[j] /= power_fixed[j]
    largest = 0.0
    smallest = np.inf
    for j in range(count):
        mixture[j] = power_fixed[j]
        free_part[j] = base_free[j]
        largest = max(largest, mixture[j])
        smallest = min(smallest, mixture[j])
    return bool(smallest > _LEAST_RATIO and largest < 1.0 / _LEAST_RATIO)


@compiled
def mix_densities_in_logs(
    pairs: PairsOfFreeGains, gauge: GaugeWithFreeGain, log_mixture: Float, free_part: Float
) -> None:
    """Do the same as `mix_densities`, by logarithms, which neither overflow nor underflow."""
    g = gauge.gauge
    log_free_constant = np.log(gauge.free_probability)
    log_free_constant += 0.5 * np.log(gauge.model_squares / gauge.free_squares)
    log_fixed_constant = np.log1p(-gauge.free_probability)
    log_fixed_constant += 0.5 * np.log(gauge.model_squares / gauge.fixed_squares)
    power = 0.5 * gauge.degrees_of_freedom  # of the kernels of Student's density
    for j in range(len(log_mixture)):
        x = pairs.x[g, j]
        innovation = x - pairs.c[g, j] * gauge.fitted_gain
        variance = 1.0 + pairs.c[g, j] * pairs.c[g, j] * gauge.gain_variance
        free_kernel = 1.0 + innovation * innovation / (gauge.free_squares * variance)
        fixed_kernel = 1.0 + x * x / gauge.fixed_squares
        kernel = pairs.kernel[g, j]
        log_free = log_free_constant + power * np.log(kernel / free_kernel)
        log_free -= 0.5 * np.log(variance)
        log_fixed = log_fixed_constant + power * np.log(kernel / fixed_kernel)
        log_mixture[j] = np.logaddexp(log_free, log_fixed)
        free_part[j] = np.exp(log_free - log_mixture[j])


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
    observation : StandardizedObservation
        The observation of the twin.
    model : ModelLikelihood
        How the model explains it.
    priors : FaultPriors
        The prior of free gains.
    belief : (N,) array
        The belief; updated in place.
    statistics : FreeGainStatistics
        What is learnt of all twins; that of the twin is updated in place.
    twin : int
        The twin.

    Returns
    -------
    float
        The log evidence, up to the same constant as that of the model; minus infinity if no pair is
        believed.
    """
    weight_at_all = np.empty(len(model.pair))
    pairs = _take_pairs(model, priors.free_gain_deviation, belief, weight_at_all)
    count = len(pairs.pair)
    if count == 0:
        return -np.inf
    weight = weight_at_all[:count]
    free_part = np.empty((len(observation.present), count))
    mixture = np.empty(count)
    product = np.ones(count)
    gauges_in_product = 0
    for g in range(len(observation.present)):
        if not observation.present[g]:
            continue
        gauge = _gauge_with_free_gain(observation, model, priors, statistics, twin, g)
        if not mix_densities(pairs, gauge, mixture, free_part[g]):
            mix_densities_in_logs(pairs, gauge, mixture, free_part[g])
            for j in range(count):
                weight[j] += mixture[j]
            continue
        for j in range(count):
            product[j] *= mixture[j]
        gauges_in_product += 1
        if gauges_in_product == _GAUGES_OF_A_PRODUCT:
            for j in range(count):
                weight[j] += np.log(product[j])
                product[j] = 1.0
            gauges_in_product = 0

    largest = -np.inf
    for j in range(count):
        weight[j] += np.log(product[j])
        largest = max(largest, weight[j])
    total = 0.0
    for j in range(count):
        weight[j] = belief[pairs.pair[j]] * np.exp(weight[j] - largest)
        total += weight[j]
    for j in range(count):
        weight[j] /= total
        belief[pairs.pair[j]] = weight[j]
    _update_statistics(observation, pairs, weight, free_part, statistics, twin)
    return float(largest + np.log(total))


@compiled
def _gauge_with_free_gain(
    observation: StandardizedObservation,
    model: ModelLikelihood,
    priors: FaultPriors,
    statistics: FreeGainStatistics,
    twin: int,
    gauge: int,
) -> GaugeWithFreeGain:
    """Return a gauge of a twin that may have a gain of its own."""
    gain_variance = 1.0 / (1.0 + statistics.sum_cc[twin, gauge])
    return GaugeWithFreeGain(
        gauge,
        min(max(statistics.free_probability[twin, gauge], 0.0), 1.0),  # rounding exceeds one
        gain_variance * statistics.sum_cx[twin, gauge],
        gain_variance,
        observation.degrees_after[gauge],
        model.scale_squares[gauge],
        priors.degrees_of_freedom + statistics.fixed_squares[twin, gauge],
        priors.degrees_of_freedom + statistics.free_squares[twin, gauge],
    )


@compiled
def _update_statistics(
    observation: StandardizedObservation,
    pairs: PairsOfFreeGains,
    weight: Float,
    free_part: Float,
    statistics: FreeGainStatistics,
    twin: int,
) -> None:
    """Update what is learnt of each gauge by the expectation over the pairs, in place.

    Parameters
    ----------
    observation : StandardizedObservation
        The observation of the twin.
    pairs : PairsOfFreeGains
        The n pairs.
    weight : (n,) array
        Their probabilities.
    free_part : (G, n) array
        The probability that a gauge has a gain of its own, at each pair.
    statistics : FreeGainStatistics
        Updated for the twin.
    twin : int
        The twin.
    """
    for g in range(len(free_part)):
        if not observation.present[g]:
            continue
        gain_variance = 1.0 / (1.0 + statistics.sum_cc[twin, g])
        fitted_gain = gain_variance * statistics.sum_cx[twin, g]
        free_probability = 0.0
        fixed_squares = 0.0
        free_squares = 0.0
        sum_cc = 0.0
        sum_cx = 0.0
        for j in range(len(weight)):
            x = pairs.x[g, j]
            c = pairs.c[g, j]
            innovation = x - c * fitted_gain
            free_probability += weight[j] * free_part[g, j]
            fixed_squares += weight[j] * x * x
            free_squares += weight[j] * innovation * innovation / (1.0 + c * c * gain_variance)
            sum_cc += weight[j] * c * c
            sum_cx += weight[j] * c * x
        statistics.free_probability[twin, g] = free_probability
        statistics.fixed_squares[twin, g] += fixed_squares
        statistics.free_squares[twin, g] += free_squares
        statistics.sum_cc[twin, g] += sum_cc
        statistics.sum_cx[twin, g] += sum_cx
