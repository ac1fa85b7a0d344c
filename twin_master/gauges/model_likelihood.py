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

_NEGLIGIBLE_IN_SINGLE = np.float32(NEGLIGIBLE_UNDER_FAULT)
"""The same in the precision of `Beliefs.gauge`, whose many entries are compared with it."""


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
def drop_pairs_negligible_under_faults(beliefs: Beliefs, twin: int) -> Index:
    """Zero a twin's beliefs in gauge faults where negligible; return the indices (n,) of the rest.

    A pair of draw and state is negligible if its probability is below `NEGLIGIBLE_UNDER_FAULT`
    under each fault of a gauge and under free gains. There `beliefs.gauge` and
    `beliefs.gauge_is_nonzero` are changed in place.
    """
    _, pair_count, fault_count = beliefs.gauge.shape  # (B, N, R)
    considered_pairs = np.empty(pair_count, np.int64)
    count = 0
    probability_under_free_gains = beliefs.free_gains[twin]  # (N,)
    for i in range(pair_count):
        hypotheses_of_pair = np.int64(probability_under_free_gains[i] >= NEGLIGIBLE_UNDER_FAULT)
        if beliefs.gauge_is_nonzero[twin, i]:
            for r in range(fault_count):
                hypotheses_of_pair += beliefs.gauge[twin, i, r] >= _NEGLIGIBLE_IN_SINGLE
        if hypotheses_of_pair > 0:
            considered_pairs[count] = i
            count += 1
        elif beliefs.gauge_is_nonzero[twin, i]:
            for r in range(fault_count):
                beliefs.gauge[twin, i, r] = 0.0
            beliefs.gauge_is_nonzero[twin, i] = False
    return considered_pairs[:count]


@compiled
def pairs_of_hypotheses(beliefs: Beliefs, twin: int, fault_pairs: Index) -> Index:
    """Return the pairs that are not negligible under any hypothesis of a twin, in rising order.

    Added to `fault_pairs` (n,) are those whose probability under the model, or after a fault has
    ended, is at least `NEGLIGIBLE_UNDER_MODEL`.
    """
    pair_count = beliefs.model.shape[1]
    is_considered = np.zeros(pair_count, np.bool_)
    for i in fault_pairs:
        is_considered[i] = True
    considered_pairs = np.empty(pair_count, np.int64)
    count = 0
    for i in range(pair_count):
        largest = max(beliefs.model[twin, i], beliefs.recovered[twin, i])
        if is_considered[i] or largest >= NEGLIGIBLE_UNDER_MODEL:
            considered_pairs[count] = i
            count += 1
    return considered_pairs[:count]


@compiled
def model_likelihood(
    observation: StandardizedObservation,
    pair_indices: Index,
    scale_squares: Float,
    density: Float,
    log_factor: float,
) -> ModelLikelihood:
    """Return the density of an observation under the model at some pairs, relative to the largest.

    A pair is a state and a draw of the parameter. The function is compiled, hence the loops.

    Parameters
    ----------
    pair_indices : (n,) array
        The indices of n of the N pairs.
    scale_squares : (G,) array
        What divides the squared residual of each of G gauges in Student's density: the degrees of
        freedom plus the expected sum of squared residuals before the observation.
    density : (N,) array
        The density at all pairs under the model, divided by a factor.
    log_factor : float
        The log of that factor, plus a constant that is the same for all pairs and hypotheses of the
        step.
    """
    count = len(pair_indices)
    relative_density = np.empty(count)  # to the factor at first, at the end to the largest density
    largest = 0.0
    is_finite = True
    for j in range(count):
        relative_density[j] = density[pair_indices[j]]
        largest = max(largest, relative_density[j])
        is_finite &= relative_density[j] < np.inf
    if not is_finite or largest < LEAST_TOTAL:  # overflow or underflow: compute by logarithms
        log_density = np.empty(count)
        log_density_of_sound_gauges(observation, pair_indices, scale_squares, log_density)  # fills
        log_factor = -np.inf
        for j in range(count):
            log_factor = max(log_factor, log_density[j])
        largest = 1.0
        for j in range(count):
            relative_density[j] = np.exp(log_density[j] - log_factor)
    reference = 0
    for j in range(count):
        relative_density[j] /= largest
        if relative_density[j] > relative_density[reference]:
            reference = j
    return ModelLikelihood(
        pair_indices,
        scale_squares,
        relative_density,
        log_factor + np.log(largest),
        pair_indices[reference],
    )
