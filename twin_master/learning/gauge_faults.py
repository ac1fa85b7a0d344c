"""Compiled loops that correct the beliefs of faults of single gauges by an observation.

Notation and method are those of `fault_kernels`.
"""

from typing import NamedTuple

import numpy as np

from fe.compilation import compiled
from reporting.arrays import Float, Single
from twin_master.learning.fault_kernels import (
    NEGLIGIBLE_UNDER_FAULT,
    Beliefs,
    FaultPriors,
    StandardizedObservation,
)
from twin_master.learning.model_likelihood import ModelLikelihood, multiply_by_power

_LEAST_TOTAL = 1e-200
"""A sum of relative densities that is smaller may have lost terms by underflow."""


class GaugeFaults(NamedTuple):
    """The faults of single gauges before an observation, in units of the noise, each field (R,).

    Attributes
    ----------
    gain, gain_deviation : (R,) array
        The gain error, and its prior standard deviation.
    fitted_gain : (R,) array
        The learnt difference from the gain error over `gain_deviation`, kept within one.
    gain_variance : (R,) array
        The variance of that difference.
    scale_squares : (R,) array
        Degrees of freedom plus the sum of squared innovations.
    """

    gain: Float
    gain_deviation: Float
    fitted_gain: Float
    gain_variance: Float
    scale_squares: Float


class SumsOfFaults(NamedTuple):
    """Sums over the pairs, weighted by the density times the belief, each field (R,).

    Attributes
    ----------
    weight, squares, cc, cx : (R,) array
        Of one, of the squared innovation over its variance, of c² and of c x.
    """

    weight: Float
    squares: Float
    cc: Float
    cx: Float


@compiled
def multiply_by_powers(base: Float, exponents: Float, product: Float) -> None:
    """Do the same for each gauge: powers of numbers (G K,) by exponents (G,) of the gauges."""
    gains = len(base) // len(exponents)
    are_equal = True
    for g in range(len(exponents)):
        are_equal &= exponents[g] == exponents[0]
    if are_equal:
        multiply_by_power(base, exponents[0], product)
        return
    for g in range(len(exponents)):
        faults = slice(g * gains, (g + 1) * gains)
        multiply_by_power(base[faults], exponents[g], product[faults])


@compiled
def weigh_gauge_faults(
    observation: StandardizedObservation,
    model: ModelLikelihood,
    faults: GaugeFaults,
    belief: Single,
) -> tuple[Float, SumsOfFaults]:
    """Return the density of each pair times its belief under all faults of a gauge, and sums of it.

    The density is that of the model, with that of the faulty gauge exchanged. It is relative to the
    density of the model without that gauge at the reference pair: the density of the model times
    kernel / kernel of the fault, to the power of half the degrees of freedom, over the root of the
    variance, where the kernel of the model is divided by its value at the reference pair.

    The compiler vectorises loops that write to arrays of this function only.

    Parameters
    ----------
    observation : StandardizedObservation
        The observation.
    model : ModelLikelihood
        How the model explains it at n pairs.
    faults : GaugeFaults
        The faults.
    belief : (N, R) array
        The beliefs of the faults.

    Returns
    -------
    weight : (n, R) array
        The density times the belief.
    sums : SumsOfFaults
        The sum of the weights, and weighted sums.
    """
    gauges = len(observation.present)
    count = len(faults.gain)
    gains = count // gauges
    weight = np.empty((len(model.pair), count))
    row = np.empty(count)
    residual = np.empty(count)
    c = np.empty(count)
    x = np.empty(count)
    square = np.empty(count)
    base = np.empty(count)
    power = np.empty(count)
    sum_weight = np.zeros(count)
    sum_squares = np.zeros(count)
    sum_cc = np.zeros(count)
    sum_cx = np.zeros(count)
    inverse_reference = np.empty(gauges)
    for g in range(gauges):
        inverse_reference[g] = 1.0 / model.kernel[model.reference, g]
    for j in range(len(model.pair)):
        prior = belief[model.pair[j]]
        density = model.density[j]
        for g in range(gauges):
            relative_kernel = model.kernel[j, g] * inverse_reference[g]
            for r in range(g * gains, (g + 1) * gains):
                residual[r] = model.residual[j, g]
                c[r] = model.prediction[j, g]
                base[r] = relative_kernel
        for r in range(count):
            x[r] = residual[r] - faults.gain[r] * c[r]
            c[r] *= faults.gain_deviation[r]
            innovation = x[r] - c[r] * faults.fitted_gain[r]
            variance = 1.0 + c[r] * c[r] * faults.gain_variance[r]
            scaled_variance = faults.scale_squares[r] * variance
            fault_kernel = scaled_variance + innovation * innovation  # over `scaled_variance`
            inverse = 1.0 / (variance * fault_kernel)
            base[r] *= scaled_variance * variance * inverse
            power[r] = fault_kernel * inverse
            square[r] = innovation * innovation * power[r]
        multiply_by_powers(base, observation.degrees_after, power)
        for r in range(count):
            probability = prior[r] if prior[r] >= NEGLIGIBLE_UNDER_FAULT else 0.0
            row[r] = probability * density * np.sqrt(power[r])
            sum_weight[r] += row[r]
            sum_squares[r] += row[r] * square[r]
            sum_cc[r] += row[r] * c[r] * c[r]
            sum_cx[r] += row[r] * c[r] * x[r]
        for r in range(count):
            weight[j, r] = row[r]
    return weight, SumsOfFaults(sum_weight, sum_squares, sum_cc, sum_cx)


@compiled
def weigh_gauge_fault_in_logs(
    observation: StandardizedObservation,
    model: ModelLikelihood,
    faults: GaugeFaults,
    belief: Single,
    r: int,
    weight: Float,
    sums: SumsOfFaults,
) -> float:
    """Do the same as `weigh_gauge_faults` for fault r, by logarithms, which do not underflow.

    Returns
    -------
    float
        The log of the density to which the weights are relative.
    """
    g = r * len(observation.present) // len(faults.gain)
    power = 0.5 * observation.degrees_after[g]
    log_constant = 0.5 * np.log(model.scale_squares[g] / faults.scale_squares[r])
    log_density = np.empty(len(model.pair))
    largest = -np.inf
    for j in range(len(model.pair)):
        log_density[j] = model.log_density[j]
        if observation.present[g]:
            c = faults.gain_deviation[r] * model.prediction[j, g]
            x = model.residual[j, g] - faults.gain[r] * model.prediction[j, g]
            innovation = x - c * faults.fitted_gain[r]
            variance = 1.0 + c * c * faults.gain_variance[r]
            fault_kernel = 1.0 + innovation * innovation / (faults.scale_squares[r] * variance)
            log_density[j] += log_constant + power * np.log(model.kernel[j, g] / fault_kernel)
            log_density[j] -= 0.5 * np.log(variance)
        if belief[model.pair[j], r] >= NEGLIGIBLE_UNDER_FAULT:
            largest = max(largest, log_density[j])
    sums.weight[r] = 0.0
    sums.squares[r] = 0.0
    sums.cc[r] = 0.0
    sums.cx[r] = 0.0
    for j in range(len(model.pair)):
        probability = belief[model.pair[j], r]
        weight[j, r] = 0.0
        if probability >= NEGLIGIBLE_UNDER_FAULT:
            weight[j, r] = probability * np.exp(log_density[j] - largest)
        c = faults.gain_deviation[r] * model.prediction[j, g]
        x = model.residual[j, g] - faults.gain[r] * model.prediction[j, g]
        innovation = x - c * faults.fitted_gain[r]
        variance = 1.0 + c * c * faults.gain_variance[r]
        sums.weight[r] += weight[j, r]
        sums.squares[r] += weight[j, r] * innovation * innovation / variance
        sums.cc[r] += weight[j, r] * c * c
        sums.cx[r] += weight[j, r] * c * x
    return largest


@compiled
def _gauge_faults(priors: FaultPriors, beliefs: Beliefs, twin: int) -> GaugeFaults:
    """Return the faults of single gauges of a twin before an observation."""
    count = beliefs.gauge.shape[2]
    gains = len(priors.gains)
    faults = GaugeFaults(
        np.empty(count), np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    )
    for r in range(count):
        gain_variance = 1.0 / (1.0 + beliefs.gauge_sum_cc[twin, r])
        faults.gain[r] = priors.gains[r % gains]
        faults.gain_deviation[r] = priors.gain_deviations[r % gains]
        faults.fitted_gain[r] = min(max(gain_variance * beliefs.gauge_sum_cx[twin, r], -1.0), 1.0)
        faults.gain_variance[r] = gain_variance
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

    The gain is learnt by a regression, and kept within one prior standard deviation of the gain
    error.

    Parameters
    ----------
    observation : StandardizedObservation
        The observation of the twin.
    model : ModelLikelihood
        How the model explains it at the n pairs that faults consider.
    priors : FaultPriors
        The gain errors of single gauges.
    beliefs : Beliefs
        The beliefs and sums of all twins; those of the twin are updated in place.
    twin : int
        The twin.
    log_evidence : (R,) array
        To be filled: the log evidence of each fault, up to the same constant as that of the model.
    """
    count = len(log_evidence)
    gains = len(priors.gains)
    faults = _gauge_faults(priors, beliefs, twin)
    belief = beliefs.gauge[twin]
    weight, sums = weigh_gauge_faults(observation, model, faults, belief)
    inverse = np.empty(count)
    for r in range(count):
        g = r // gains
        log_scale = model.log_density[model.reference]
        if observation.present[g]:
            kernel = model.kernel[model.reference, g]
            log_scale += 0.5 * np.log(model.scale_squares[g] / faults.scale_squares[r])
            log_scale += 0.5 * observation.degrees_after[g] * np.log(kernel)
        if not _LEAST_TOTAL < sums.weight[r] < np.inf:
            log_scale = weigh_gauge_fault_in_logs(
                observation, model, faults, belief, r, weight, sums
            )
        inverse[r] = 1.0 / sums.weight[r] if sums.weight[r] > 0.0 else 0.0
        log_evidence[r] = log_scale + np.log(sums.weight[r]) if inverse[r] > 0.0 else -np.inf
        beliefs.gauge_squares[twin, r] += sums.squares[r] * inverse[r]
        beliefs.gauge_sum_cc[twin, r] += sums.cc[r] * inverse[r]
        beliefs.gauge_sum_cx[twin, r] += sums.cx[r] * inverse[r]
    for j in range(len(model.pair)):
        row = weight[j]
        posterior = belief[model.pair[j]]
        beliefs.gauge_is_nonzero[twin, model.pair[j]] = True
        for r in range(count):
            posterior[r] = row[r] * inverse[r]
