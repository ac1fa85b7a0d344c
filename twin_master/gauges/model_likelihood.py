"""Compiled loops: the pairs that are considered, and the density of an observation there.

Notation and method are those of `fault_kernels`.
"""

from typing import NamedTuple

import numpy as np

from fe.compilation import compiled
from reporting.arrays import Float, Index
from twin_master.gauges.fault_kernels import (
    LEAST_TOTAL,
    NEGLIGIBLE_UNDER_FAULT,
    NEGLIGIBLE_UNDER_MODEL,
    Beliefs,
    StandardizedObservation,
    log_density_of_sound_gauges,
)

_NEGLIGIBLE = np.float32(NEGLIGIBLE_UNDER_FAULT)


class ModelLikelihood(NamedTuple):
    """The density of an observation under the model, to compare faults with.

    Attributes
    ----------
    pair : (n,) array
        The indices of the pairs that some fault considers, among all pairs.
    scale_squares : (G,) array
        Degrees of freedom plus the expected sum of squared residuals before the observation.
    density : (n,) array
        The density of the observation over that at the reference pair.
    log_density : float
        The log density at the reference pair, up to a constant of the step.
    reference : int
        The pair, among all pairs, with the largest density.
    """

    pair: Index
    scale_squares: Float
    density: Float
    log_density: float
    reference: int


@compiled
def pairs_of_faults(beliefs: Beliefs, twin: int) -> Index:
    """Return the indices (n,) of the pairs whose probability under some fault is not negligible.

    In all other pairs the beliefs of gauge faults become zero.
    """
    _, pairs, faults = beliefs.gauge.shape
    considered_pairs = np.empty(pairs, np.int64)
    count = 0
    for i in range(pairs):
        believing_faults = np.int64(beliefs.free_gains[twin, i] >= NEGLIGIBLE_UNDER_FAULT)
        if beliefs.gauge_is_nonzero[twin, i]:
            for r in range(faults):
                believing_faults += beliefs.gauge[twin, i, r] >= _NEGLIGIBLE
        if believing_faults > 0:
            considered_pairs[count] = i
            count += 1
        elif beliefs.gauge_is_nonzero[twin, i]:
            for r in range(faults):
                beliefs.gauge[twin, i, r] = 0.0
            beliefs.gauge_is_nonzero[twin, i] = False
    return considered_pairs[:count]


@compiled
def pairs_of_hypotheses(beliefs: Beliefs, twin: int, pairs_of_faults: Index) -> Index:
    """Return the indices of the pairs that any hypothesis of a twin considers, in rising order."""
    pairs = beliefs.model.shape[1]
    is_considered = np.zeros(pairs, np.bool_)
    for i in pairs_of_faults:
        is_considered[i] = True
    considered_pairs = np.empty(pairs, np.int64)
    count = 0
    for i in range(pairs):
        largest = max(beliefs.model[twin, i], beliefs.recovered[twin, i])
        if is_considered[i] or largest >= NEGLIGIBLE_UNDER_MODEL:
            considered_pairs[count] = i
            count += 1
    return considered_pairs[:count]


@compiled
def model_likelihood(
    observation: StandardizedObservation,
    pair: Index,
    scale_squares: Float,
    density: Float,
    log_factor: float,
) -> ModelLikelihood:
    """Return the density of an observation under the model at some pairs, relative to the largest.

    Parameters
    ----------
    pair : (n,) array
        The indices of the pairs.
    scale_squares : (G,) array
        Degrees of freedom plus the expected sum of squared residuals before the observation.
    density : (N,) array
        The density at all pairs under the model, divided by a factor.
    log_factor : float
        The log of that factor, up to a constant of the step.
    """
    count = len(pair)
    relative_density = np.empty(count)
    largest = 0.0
    is_finite = True
    for j in range(count):
        relative_density[j] = density[pair[j]]
        largest = max(largest, relative_density[j])
        is_finite &= relative_density[j] < np.inf
    if not is_finite or largest < LEAST_TOTAL:  # overflow or underflow: compute by logarithms
        log_density_of_sound_gauges(observation, pair, scale_squares, relative_density)
        log_factor = -np.inf
        for j in range(count):
            log_factor = max(log_factor, relative_density[j])
        largest = 1.0
        for j in range(count):
            relative_density[j] = np.exp(relative_density[j] - log_factor)
    reference = 0
    for j in range(count):
        relative_density[j] /= largest
        if relative_density[j] > relative_density[reference]:
            reference = j
    return ModelLikelihood(
        pair, scale_squares, relative_density, log_factor + np.log(largest), pair[reference]
    )
