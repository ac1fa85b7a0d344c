"""Faults of gauges as hypotheses that compete with the model to explain an observation.

Each hypothesis has a belief over pairs of a draw and a state, of which there are N. There are two
kinds of fault: a single gauge shows 1 + gain times the value that the model predicts, or several
gauges have unknown gains of their own ("free gains"; users read "none of these"). A pair whose
probability is negligible is left out.

Predictive densities are Student's, with the noise scale of each gauge learnt by the hypothesis. In
units of the assumed noise of a gauge:

    x = observation - prediction,
    c = (prior standard deviation of the gain) times the prediction.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fe.compilation import compiled
from reporting.arrays import Float, Single

NEGLIGIBLE_UNDER_MODEL = 1e-30
"""Pairs of draw and state of smaller probability are left out of the evidence of the model."""
NEGLIGIBLE_UNDER_FAULT = 1e-7
"""The same for a fault: leaving pairs out lowers its evidence, so that an alarm comes later."""


class StandardizedObservation(NamedTuple):
    """One observation and its predictions for N pairs of a draw and a state, in units of noise.

    Attributes
    ----------
    present : (G,) array of bool
        Whether a gauge reports. A gauge that does not has residuals and predictions of zero.
    residual : (N, G) array
        The observation minus the prediction.
    prediction : (N, G) array
        The predicted value.
    power : (G,) array
        The power of the predictive density, (degrees + count + 1) / 2.
    degrees : float
        Degrees of freedom of the prior of the noise scale.
    """

    present: NDArray[np.bool_]
    residual: Float
    prediction: Float
    power: Float
    degrees: float


class ModelLikelihood(NamedTuple):
    """How the model explains an observation: what the densities of faults are compared with.

    Attributes
    ----------
    squares : (G,) array
        The expected sum of squared residuals before the observation.
    kernel : (N, G) array
        The kernel 1 + x² / (degrees + squares) of each gauge's density.
    log_likelihood : (N,) array
        The log density of the observation, up to a constant of the step.
    """

    squares: Float
    kernel: Float
    log_likelihood: Float


@dataclass
class FreeGainStatistics:
    """What is learnt about each gauge if some gauges have unknown gains, each field (G,).

    Attributes
    ----------
    free_probability : (G,) array
        The probability that the gauge has a gain of its own.
    fixed_squares : (G,) array
        The sum of squared residuals if it has none.
    sum_cc, sum_cx : (G,) array
        The sums of c² and c x of the regression if it has one.
    free_squares : (G,) array
        The sum of squared innovations over their variance if it has one (West and Harrison 1997,
        section 4.6).
    """

    free_probability: Float
    fixed_squares: Float
    sum_cc: Float
    sum_cx: Float
    free_squares: Float

    @classmethod
    def from_array(cls, array: Float) -> "FreeGainStatistics":
        """Return a copy of the statistics in an array (G, 5), in the order of the fields."""
        free_probability, fixed_squares, sum_cc, sum_cx, free_squares = array.T.copy()
        return cls(free_probability, fixed_squares, sum_cc, sum_cx, free_squares)

    def as_array(self) -> Float:
        """Return the statistics as an array (G, 5), in the order of the fields."""
        return np.column_stack(
            [
                self.free_probability,
                self.fixed_squares,
                self.sum_cc,
                self.sum_cx,
                self.free_squares,
            ]
        )


def mix_in_beginning_faults(
    model_belief: Float,
    fault_belief: Single,
    log_evidence: Float,
    onset: Float,
    log_begin_probability: float,
    step: float,
) -> Float:
    """Let R faults begin in this step, and return the weights (R,) of those that began earlier.

    The weight of a fault is the probability that it began before this step, if it has begun at all.

    A fault that begins now has the belief of the model. It is mixed with the belief of the fault
    that began earlier, so that one belief stands for all first steps.

    Parameters
    ----------
    model_belief : (E, S) array
        The belief of the model.
    fault_belief : (R, E, S) array
        The beliefs of the faults; updated in place.
    log_evidence : (R,) array
        The log evidence of each fault over that of the model; updated in place.
    onset : (R,) array
        The expected first step of each fault; updated in place.
    log_begin_probability : float
        The log prior probability that a fault begins in this step.
    step : float
        The number of this step.
    """
    log_total = np.logaddexp(log_evidence, log_begin_probability)
    earlier_weight = np.exp(log_evidence - log_total)
    log_evidence[:] = log_total
    onset[:] = earlier_weight * onset + (1.0 - earlier_weight) * step
    single_weight = earlier_weight[:, None, None].astype(
        np.float32
    )  # single precision, as the beliefs
    fault_belief[:] = single_weight * fault_belief + (1.0 - single_weight) * model_belief.astype(
        np.float32
    )
    return np.asarray(earlier_weight)


def update_model(
    observation: StandardizedObservation, squares: Float, belief: Float, log_likelihood: Float
) -> tuple[float, Float]:
    """Correct the belief of the model, or of another hypothesis under which all gauges are sound.

    Parameters
    ----------
    observation : StandardizedObservation
        The observation of this step.
    squares : (G,) array
        The expected sums of squared residuals; updated in place.
    belief : (N,) array
        The belief; updated in place.
    log_likelihood : (N,) array
        The log density without the standardised residuals; their densities are added in place.

    Returns
    -------
    log_evidence : float
        The log evidence, up to a constant of the step.
    kernel : (N, G) array
        The kernel 1 + x² / (degrees + squares) of each gauge's density.
    """
    kernel = 1.0 + observation.residual**2 / (observation.degrees + squares)
    log_likelihood -= np.log(kernel) @ observation.power
    considered = belief >= NEGLIGIBLE_UNDER_MODEL
    # The exponents are taken relative to the largest one of the pairs that count. Those of other
    # pairs may be larger: they are cut to zero, so that they do not overflow, and not used.
    largest = log_likelihood[considered].max()
    belief *= np.where(considered, np.exp(np.minimum(log_likelihood - largest, 0.0)), 0.0)
    total = belief.sum()
    belief /= total
    squares += belief @ observation.residual**2
    return float(largest + np.log(total)), kernel


@compiled
def update_gauge_faults(
    observation: StandardizedObservation,
    model: ModelLikelihood,
    gains: Float,
    gain_deviations: Float,
    belief: Single,
    squares: Float,
    sum_cc: Float,
    sum_cx: Float,
) -> Float:
    """Correct the beliefs of the faults "gauge g shows 1 + gain times the predicted value".

    The gain is learnt by a regression, and kept within one prior standard deviation of `gains[k]`.

    Parameters
    ----------
    observation : StandardizedObservation
        The observation of this step.
    model : ModelLikelihood
        How the model explains it.
    gains, gain_deviations : (K,) array
        The gain errors that are compared, and their prior standard deviations.
    belief : (G K, N) array
        The belief of each fault, gauge by gauge; updated in place.
    squares : (G, K) array
        The sum of squared innovations of the faulty gauge; updated in place.
    sum_cc, sum_cx : (G, K) array
        The sums of the regression of its gain; updated in place.

    Returns
    -------
    (G, K) array
        The log evidence of each fault, up to the same constant as that of the model.
    """
    model_squares, kernel, log_likelihood = model
    is_present, residual, prediction, power, degrees = observation
    log_evidence = np.empty_like(squares)
    weight = np.empty(len(log_likelihood))
    for fault in range(len(belief)):
        g, k = divmod(fault, len(gains))
        fault_belief = belief[fault]
        # Gain of the regression, kept within one prior standard deviation.
        gain_variance = 1.0 / (1.0 + sum_cc[g, k])
        fitted_gain = min(max(gain_variance * sum_cx[g, k], -1.0), 1.0)
        scale_squares = degrees + squares[g, k]
        log_constant = 0.5 * np.log((degrees + model_squares[g]) / scale_squares)

        # Log densities: those of the model, with that of gauge g exchanged.
        largest = -np.inf
        for n in range(len(fault_belief)):
            if fault_belief[n] < NEGLIGIBLE_UNDER_FAULT:
                fault_belief[n] = 0.0
                continue
            weight[n] = log_likelihood[n]
            # Replace the kernel of gauge g by that of the fault. The factor 1 / sqrt(variance) of
            # its density follows below.
            if is_present[g]:
                c = gain_deviations[k] * prediction[n, g]
                x = residual[n, g] - gains[k] * prediction[n, g] - c * fitted_gain
                variance = 1.0 + c * c * gain_variance
                fault_kernel = 1.0 + x * x / (scale_squares * variance)
                weight[n] += log_constant + power[g] * np.log(kernel[n, g] / fault_kernel)
            largest = max(largest, weight[n])

        # Weights of the pairs, and what they add to the sums.
        total = 0.0
        added_squares = 0.0
        added_cc = 0.0
        added_cx = 0.0
        for n in range(len(fault_belief)):
            if fault_belief[n] > 0.0:
                c = gain_deviations[k] * prediction[n, g]
                x = residual[n, g] - gains[k] * prediction[n, g]
                variance = 1.0 + c * c * gain_variance
                deviation = np.sqrt(variance) if is_present[g] else 1.0
                weight[n] = fault_belief[n] * np.exp(weight[n] - largest) / deviation
                total += weight[n]
                added_cc += weight[n] * c * c
                added_cx += weight[n] * c * x
                added_squares += weight[n] * (x - c * fitted_gain) ** 2 / variance
        log_evidence[g, k] = largest + np.log(total) if total > 0.0 else -np.inf

        # Normalised belief, and the sums.
        for n in range(len(fault_belief)):
            if fault_belief[n] > 0.0:
                fault_belief[n] = weight[n] / total
        if total > 0.0:
            squares[g, k] += added_squares / total
            sum_cc[g, k] += added_cc / total
            sum_cx[g, k] += added_cx / total
    return log_evidence


def update_free_gains(
    observation: StandardizedObservation,
    model: ModelLikelihood,
    gain_deviation: float,
    belief: Single,
    statistics: FreeGainStatistics,
) -> float:
    """Correct the belief of the fault that some gauges have unknown gains.

    It is not known which gauges these are. So the predictive density of each gauge is a mixture of
    two: that of a sound gauge, and that of a gauge with a gain of its own.

    Parameters
    ----------
    observation : StandardizedObservation
        The observation of this step.
    model : ModelLikelihood
        How the model explains it.
    gain_deviation : float
        The prior standard deviation of a free gain.
    belief : (N,) array
        The belief over pairs of a draw and a state; updated in place.
    statistics : FreeGainStatistics
        What is learnt of the gain of each gauge; updated in place.

    Returns
    -------
    float
        The log evidence, up to the same constant as that of the model; minus infinity if no pair of
        draw and state is believed.
    """
    belief[belief < NEGLIGIBLE_UNDER_FAULT] = 0.0
    considered = np.flatnonzero(belief > 0.0)
    if not considered.size:
        return -np.inf
    x = observation.residual[considered]
    c = gain_deviation * observation.prediction[considered]
    kernel = model.kernel[considered]
    gain_variance = 1.0 / (1.0 + statistics.sum_cc)
    innovation = x - c * gain_variance * statistics.sum_cx
    variance = 1.0 + c**2 * gain_variance

    def log_ratio_to_model(squared_residual: Float, squares: Float) -> Float:
        """Return the log ratio of a gauge's density to that of the model, for n pairs: (n, G)."""
        scale_squares = observation.degrees + squares
        log_constant = 0.5 * np.log((observation.degrees + model.squares) / scale_squares)
        log_kernel_ratio = np.log(kernel / (1.0 + squared_residual / scale_squares))
        return np.asarray(log_constant * observation.present + observation.power * log_kernel_ratio)

    # Mixture over whether the gain of each gauge is free.
    free_probability = statistics.free_probability.clip(0.0, 1.0)  # rounding takes it above one
    log_ratio_free = log_ratio_to_model(innovation**2 / variance, statistics.free_squares)
    log_free = np.log(free_probability) + log_ratio_free - 0.5 * np.log(variance)
    log_ratio_fixed = log_ratio_to_model(x**2, statistics.fixed_squares)
    log_mixture = np.logaddexp(log_free, np.log1p(-free_probability) + log_ratio_fixed)

    # Belief over the pairs.
    log_density = model.log_likelihood[considered] + log_mixture.sum(axis=1)
    largest = log_density.max()
    weight = belief[considered] * np.exp(log_density - largest)
    total = weight.sum()
    weight /= total
    belief[considered] = weight

    # Statistics, expected over the pairs.
    statistics.free_probability = np.where(
        observation.present, weight @ np.exp(log_free - log_mixture), statistics.free_probability
    )
    statistics.fixed_squares = statistics.fixed_squares + weight @ x**2
    statistics.sum_cc = statistics.sum_cc + weight @ c**2
    statistics.sum_cx = statistics.sum_cx + weight @ (c * x)
    statistics.free_squares = statistics.free_squares + weight @ (innovation**2 / variance)
    return float(largest + np.log(total))
