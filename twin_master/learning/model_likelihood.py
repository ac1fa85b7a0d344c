"""Compiled loops: how the model explains an observation, at the pairs that faults consider.

Notation and method are those of `fault_kernels`.
"""

from typing import NamedTuple

import numpy as np

from fe.compilation import compiled
from reporting.arrays import Float, Index
from twin_master.learning.fault_kernels import (
    NEGLIGIBLE_UNDER_FAULT,
    Beliefs,
    StandardizedObservation,
)

_NEGLIGIBLE = np.float32(NEGLIGIBLE_UNDER_FAULT)


class ModelLikelihood(NamedTuple):
    """How the model explains an observation: what the densities of faults are compared with.

    Attributes
    ----------
    pair : (n,) array
        The indices of the pairs that some fault considers, among all pairs.
    scale_squares : (G,) array
        Degrees of freedom plus the expected sum of squared residuals before the observation.
    residual, prediction : (n, G) array
        Those of the observation at these pairs.
    kernel : (n, G) array
        The kernel 1 + x² / scale_squares of each gauge's density.
    log_density : (n,) array
        The log density of the observation, up to a constant of the step.
    density : (n,) array
        The density over its largest value.
    reference : int
        The pair with the largest density.
    """

    pair: Index
    scale_squares: Float
    residual: Float
    prediction: Float
    kernel: Float
    log_density: Float
    density: Float
    reference: int


@compiled
def considered_pairs(beliefs: Beliefs, twin: int) -> Index:
    """Return the indices (n,) of the pairs that some fault of a twin considers.

    The rows of all other pairs among the beliefs of the faults become zero.
    """
    _, pairs, faults = beliefs.gauge.shape
    considered = np.empty(pairs, np.int64)
    count = 0
    for i in range(pairs):
        considering = np.int64(beliefs.free_gains[twin, i] >= NEGLIGIBLE_UNDER_FAULT)
        if beliefs.gauge_is_nonzero[twin, i]:
            for r in range(faults):
                considering += beliefs.gauge[twin, i, r] >= _NEGLIGIBLE
        if considering > 0:
            considered[count] = i
            count += 1
        elif beliefs.gauge_is_nonzero[twin, i]:
            for r in range(faults):
                beliefs.gauge[twin, i, r] = 0.0
            beliefs.gauge_is_nonzero[twin, i] = False
    return considered[:count]


@compiled
def model_likelihood(
    observation: StandardizedObservation, pair: Index, scale_squares: Float, log_density: Float
) -> ModelLikelihood:
    """Return how the model explains an observation at some pairs.

    Parameters
    ----------
    observation : StandardizedObservation
        The observation.
    pair : (n,) array
        The indices of the pairs.
    scale_squares : (G,) array
        Degrees of freedom plus the expected sum of squared residuals before the observation.
    log_density : (N,) array
        The log density of all pairs under the model.
    """
    gauges = len(scale_squares)
    count = len(pair)
    residual = np.empty((count, gauges))
    prediction = np.empty((count, gauges))
    kernel = np.empty((count, gauges))
    chosen_density = np.empty(count)
    reference = 0
    for j in range(count):
        i = pair[j]
        chosen_density[j] = log_density[i]
        if chosen_density[j] > chosen_density[reference]:
            reference = j
        for g in range(gauges):
            residual[j, g] = observation.residual[g, i]
            prediction[j, g] = observation.prediction[g, i]
            kernel[j, g] = 1.0 + residual[j, g] * residual[j, g] / scale_squares[g]
    density = np.empty(count)
    for j in range(count):
        density[j] = np.exp(chosen_density[j] - chosen_density[reference])
    return ModelLikelihood(
        pair, scale_squares, residual, prediction, kernel, chosen_density, density, reference
    )


@compiled
def multiply_by_power(base: Float, exponent: float, product: Float) -> None:
    """Multiply numbers (n,) by a power of others (n,) in place; the base is overwritten.

    The whole part of the exponent is taken by repeated squaring.
    """
    whole = np.int64(np.floor(exponent))
    fraction = exponent - whole
    if fraction > 0.0:
        for i in range(len(base)):
            product[i] *= base[i] ** fraction
    while whole > 0:
        if whole % 2 == 1:
            for i in range(len(base)):
                product[i] *= base[i]
        whole //= 2
        if whole > 0:
            for i in range(len(base)):
                base[i] *= base[i]
