"""Compiled loops that correct the beliefs of faults of single gauges by an observation.

Notation and method are those of `fault_kernels`.
"""

from typing import NamedTuple

import numpy as np

from fe.compilation import compiled, compiled_with_reordered_sums
from reporting.arrays import Float, Single
from twin_master.gauges.exchanged_densities import (
    ExchangeWork,
    GaugeDensities,
    exchange_densities,
    exchange_factors,
    log_exchanged_density,
    log_reference_density,
)
from twin_master.gauges.fault_kernels import (
    NEGLIGIBLE_UNDER_FAULT,
    Beliefs,
    FaultPriors,
    StandardizedObservation,
    log_density_of_sound_gauges,
)
from twin_master.gauges.model_likelihood import ModelLikelihood
from twin_master.scenario.tables import GAINS_PER_SENSOR

_LEAST_TOTAL = 1e-9
"""A sum of relative densities that is smaller may have lost terms by underflow."""


class SumsOfFaults(NamedTuple):
    """Sums over the pairs, weighted by the density times the belief, each field (R,).

    Attributes
    ----------
    weight, squares, predictions, products : (R,) array
        The sums of one, of the squared innovation over its variance, of the squared prediction,
        and of the prediction times the residual of the model.
    """

    weight: Single
    squares: Single
    predictions: Single
    products: Single


@compiled_with_reordered_sums
def weigh_gauge_faults(
    observation: StandardizedObservation,
    model: ModelLikelihood,
    faults: GaugeDensities,
    belief: Single,
) -> tuple[Single, SumsOfFaults]:
    """Return the density times the belief at each pair under all faults of a gauge, and its sums.

    The density is relative to that of the model at the reference pair, times the factor whose
    logarithm `log_reference_density` returns. The compiler vectorises loops that write to arrays of
    this function only.

    Parameters
    ----------
    model : ModelLikelihood
        How the model explains it at n pairs.
    belief : (N, R) array
        The beliefs of the faults.

    Returns
    -------
    weight : (n, R) array
        The density times the belief.
    """
    count = len(faults.gauge)
    factors = exchange_factors(observation, model, faults)
    zero = np.float32(0.0)
    negligible = np.float32(NEGLIGIBLE_UNDER_FAULT)
    weight = np.empty((len(model.pair), count), np.float32)
    residual = np.empty(count, np.float32)
    prediction = np.empty(count, np.float32)
    square = np.empty(count, np.float32)
    ratio = np.empty(count, np.float32)
    work = ExchangeWork(
        np.empty(count, np.float32),
        np.empty(count, np.float32),
        np.empty(count, np.float32),
        np.empty(count, np.float32),
    )
    row = np.empty(count, np.float32)
    sum_weight = np.zeros(count, np.float32)
    sum_squares = np.zeros(count, np.float32)
    sum_predictions = np.zeros(count, np.float32)
    sum_products = np.zeros(count, np.float32)
    for j in range(len(model.pair)):
        i = model.pair[j]
        # density under each fault: that of the model, with the density of the gauge exchanged
        density = np.float32(model.density[j])
        for r in range(count):
            residual[r] = observation.residual[i, r // GAINS_PER_SENSOR]
            prediction[r] = observation.prediction[i, r // GAINS_PER_SENSOR]
        exchange_densities(factors, residual, prediction, square, ratio, work)
        for r in range(count):
            product = density * belief[i, r] * ratio[r]
            row[r] = product if belief[i, r] >= negligible else zero
            sum_weight[r] += row[r]
            sum_squares[r] += row[r] * square[r]
            weighted_prediction = row[r] * prediction[r]
            sum_predictions[r] += weighted_prediction * prediction[r]
            sum_products[r] += weighted_prediction * residual[r]
        for r in range(count):
            weight[j, r] = row[r]
    return weight, SumsOfFaults(sum_weight, sum_squares, sum_predictions, sum_products)


@compiled
def weigh_gauge_fault_in_logs(
    observation: StandardizedObservation,
    model: ModelLikelihood,
    faults: GaugeDensities,
    belief: Single,
    r: int,
    weight: Single,
    sums: SumsOfFaults,
) -> float:
    """Fill `weight` and `sums` for fault r as `weigh_gauge_faults` does, by logarithms.

    Returns
    -------
    float
        The log of the density to which the weights are relative.
    """
    g = faults.gauge[r]
    count = len(model.pair)
    log_density = np.empty(count)
    log_density_of_sound_gauges(observation, model.pair, model.scale_squares, log_density)
    # the log density under the fault at each pair, and the largest one at pairs that count
    largest = -np.inf
    for j in range(count):
        i = model.pair[j]
        log_density[j] += log_exchanged_density(observation, model, faults, r, i)
        if belief[i, r] >= NEGLIGIBLE_UNDER_FAULT:
            largest = max(largest, log_density[j])
    # the weights relative to the largest density, and their sums
    total = 0.0
    sum_squares = 0.0
    sum_predictions = 0.0
    sum_products = 0.0
    for j in range(count):
        i = model.pair[j]
        residual = observation.residual[i, g]
        prediction = observation.prediction[i, g]
        innovation = residual - faults.gain[r] * prediction
        variance = 1.0 + faults.gain_variance[r] * prediction * prediction
        probability = 0.0
        if belief[i, r] >= NEGLIGIBLE_UNDER_FAULT:
            probability = belief[i, r] * np.exp(log_density[j] - largest)
        weight[j, r] = probability
        total += probability
        sum_squares += probability * innovation * innovation / variance
        sum_predictions += probability * prediction * prediction
        sum_products += probability * prediction * residual
    sums.weight[r] = total
    sums.squares[r] = sum_squares
    sums.predictions[r] = sum_predictions
    sums.products[r] = sum_products
    return largest


@compiled
def _densities_of_faults(priors: FaultPriors, beliefs: Beliefs, twin: int) -> GaugeDensities:
    """Return the predictive density of the gauge's reading under each fault of a twin's gauges.

    Each gauge has `GAINS_PER_SENSOR` faults, one around each gain error. The gain is that of the
    regression so far, kept within one prior standard deviation of the gain error.
    """
    count = beliefs.gauge.shape[2]
    faults = GaugeDensities(
        np.empty(count, np.int64), np.empty(count), np.empty(count), np.empty(count)
    )
    for r in range(count):
        gain_error = priors.gains[r % GAINS_PER_SENSOR]
        deviation = priors.gain_deviations[r % GAINS_PER_SENSOR]
        variance = 1.0 / (1.0 + beliefs.gauge_sum_cc[twin, r])
        fitted_gain = min(max(variance * beliefs.gauge_sum_cx[twin, r], -1.0), 1.0)
        faults.gauge[r] = r // GAINS_PER_SENSOR
        faults.gain[r] = gain_error + deviation * fitted_gain
        faults.gain_variance[r] = deviation * deviation * variance
        faults.scale_squares[r] = priors.degrees_of_freedom + beliefs.gauge_squares[twin, r]
    return faults


@compiled
def update_gauge_faults(
    observation: StandardizedObservation,
    model: ModelLikelihood,
    priors: FaultPriors,
    beliefs: Beliefs,
    twin: int,
    log_evidence: Float,
) -> None:
    """Correct the beliefs of the faults "gauge g shows 1 + gain times the predicted value".

    The gain is fitted by a regression, and kept within one prior standard deviation of the gain
    error.

    Parameters
    ----------
    model : ModelLikelihood
        How the model explains it at the n pairs that faults consider.
    beliefs : Beliefs
        The beliefs and sums of all twins; those of the twin are updated in place.
    log_evidence : (R,) array
        To be filled: the log evidence of each fault, up to the same constant as that of the model.
    """
    count = len(log_evidence)
    faults = _densities_of_faults(priors, beliefs, twin)
    belief = beliefs.gauge[twin]
    weight, sums = weigh_gauge_faults(observation, model, faults, belief)
    inverse = np.empty(count, np.float32)
    zero = np.float32(0.0)
    # the evidence of each fault, and its regression by expected products over the pairs
    for r in range(count):
        log_scale = model.log_density + log_reference_density(observation, model, faults, r)
        largest = sums.weight[r] + sums.squares[r] + sums.predictions[r] + abs(sums.products[r])
        if not (sums.weight[r] > _LEAST_TOTAL and largest < np.inf):
            # single precision overflowed or underflowed
            log_scale = weigh_gauge_fault_in_logs(
                observation, model, faults, belief, r, weight, sums
            )
        inverse[r] = 0.0
        log_evidence[r] = -np.inf
        if sums.weight[r] > 0.0:
            inverse[r] = 1.0 / sums.weight[r]
            log_evidence[r] = log_scale + np.log(np.float64(sums.weight[r]))
        gain = priors.gains[r % GAINS_PER_SENSOR]
        deviation = priors.gain_deviations[r % GAINS_PER_SENSOR]
        sum_of_c_squared = deviation * deviation * sums.predictions[r]
        sum_of_c_x = deviation * (sums.products[r] - gain * sums.predictions[r])
        beliefs.gauge_squares[twin, r] += sums.squares[r] * inverse[r]
        beliefs.gauge_sum_cc[twin, r] += sum_of_c_squared * inverse[r]
        beliefs.gauge_sum_cx[twin, r] += sum_of_c_x * inverse[r]
    # the belief in each pair under each fault, with the sum 1
    for j in range(len(model.pair)):
        i = model.pair[j]
        believing = np.int64(0)
        for r in range(count):
            belief[i, r] = weight[j, r] * inverse[r]
            believing += belief[i, r] > zero
        beliefs.gauge_is_nonzero[twin, i] = believing > 0
