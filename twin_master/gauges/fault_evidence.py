"""The compiled loop that corrects all hypotheses about gauges by an observation, for many twins.

Notation and method are those of `fault_kernels`.
"""

import numpy as np

from fe.compilation import compiled
from reporting.arrays import Float
from twin_master.gauges.fault_kernels import (
    Beliefs,
    FaultPriors,
    FreeGainStatistics,
    LogEvidence,
    Observations,
    Predictions,
    StandardizedObservation,
    number_products,
    standardize,
    update_sound_gauges,
)
from twin_master.gauges.free_gains import update_free_gains
from twin_master.gauges.gauge_faults import update_gauge_faults
from twin_master.gauges.model_likelihood import (
    drop_pairs_negligible_under_faults,
    model_likelihood,
    pairs_of_hypotheses,
)


@compiled
def _unfilled_observation(pairs: int, gauges: int) -> StandardizedObservation:
    """Return an observation of one twin with arrays that are still to be filled."""
    return StandardizedObservation(
        np.empty(gauges, np.bool_),
        np.empty((pairs, gauges)),
        np.empty((pairs, gauges)),
        np.empty(pairs),
        np.empty(gauges),
        np.empty(gauges, np.int64),
    )


@compiled
def correct_beliefs(
    predictions: Predictions,
    observations: Observations,
    priors: FaultPriors,
    observation_count: Float,
    beliefs: Beliefs,
    statistics: FreeGainStatistics,
    log_evidence: LogEvidence,
) -> None:
    """Correct the beliefs of all hypotheses of B twins by an observation of each.

    Parameters
    ----------
    observation_count : (B, G) array
        The number of earlier observations of each gauge.
    beliefs : Beliefs
        The beliefs and sums of squares; updated in place.
    statistics : FreeGainStatistics
        What is learnt of free gains; updated in place.
    log_evidence : LogEvidence
        To be filled.
    """
    twins, gauges = observations.readings.shape
    pairs = beliefs.model.shape[1]
    observation = _unfilled_observation(pairs, gauges)
    precision = np.empty(gauges)
    model_squares = np.empty(gauges)
    density = np.empty(pairs)
    for twin in range(twins):
        # Each hypothesis has learnt noise scales of its own. They enter the constant of Student's
        # density: 1 / sqrt(degrees of freedom + squares) for each gauge.
        log_scale_ratio = 0.0
        for g in range(gauges):
            observation.present[g] = not np.isnan(observations.readings[twin, g])
            degrees_of_freedom = priors.degrees_of_freedom + observation_count[twin, g]
            observation.degrees_after[g] = degrees_of_freedom + 1.0
            model_squares[g] = priors.degrees_of_freedom + beliefs.model_squares[twin, g]
            precision[g] = min(degrees_of_freedom / model_squares[g], 1.0)
            if observation.present[g]:
                recovered_squares = priors.degrees_of_freedom + beliefs.recovered_squares[twin, g]
                log_scale_ratio += np.log(model_squares[g] / recovered_squares)
        number_products(observation.degrees_after, observation.product)
        fault_pairs = drop_pairs_negligible_under_faults(beliefs, twin)
        considered_pairs = pairs_of_hypotheses(beliefs, twin, fault_pairs)
        standardize(predictions, observations, twin, precision, considered_pairs, observation)

        recovered_evidence = update_sound_gauges(
            observation,
            considered_pairs,
            priors.degrees_of_freedom,
            beliefs.recovered[twin],
            beliefs.recovered_squares[twin],
            density,
        )
        log_evidence.recovered[twin] = recovered_evidence.log_evidence + 0.5 * log_scale_ratio
        evidence = update_sound_gauges(
            observation,
            considered_pairs,
            priors.degrees_of_freedom,
            beliefs.model[twin],
            beliefs.model_squares[twin],
            density,
        )
        log_evidence.model[twin] = evidence.log_evidence
        model = model_likelihood(
            observation, fault_pairs, model_squares, density, evidence.log_factor
        )
        update_gauge_faults(observation, model, priors, beliefs, twin, log_evidence.gauge[twin])
        log_evidence.free_gains[twin] = update_free_gains(
            observation, model, priors, beliefs.free_gains[twin], statistics, twin
        )
