"""Compiled loops of the filters of gauge faults, for many twins: advance and correct the beliefs.

A pair is a state and a draw of the parameter; there are N of them, in the order of the states. The
innermost loops run over the pairs or over the faults of gauges, whose beliefs lie side by side.

Each hypothesis has Student's density for the value of a gauge, the noise scale being learnt. In
units of the assumed noise of the gauge:

    x = observation - prediction,
    c = (prior standard deviation of the gain) times the prediction.

With integer degrees of freedom the density is a power of a fraction with a half-integer exponent.
So it is computed by multiplications and one square root, relative to a reference pair, which takes
a fifth of the time of logarithms. If that underflows or overflows, logarithms are taken.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fe.compilation import compiled
from reporting.arrays import Float, Index, Single

NEGLIGIBLE_UNDER_MODEL = 1e-30
"""Pairs of draw and state of smaller probability are left out of the evidence of the model."""
NEGLIGIBLE_UNDER_FAULT = 1e-7
"""The same for a fault: leaving pairs out lowers its evidence, so that an alarm comes later."""
LARGEST_DISTANCE = 1e140
"""Distances are cut to this in the fit within an interval; its square is still a number."""
_GAUGES_OF_A_PRODUCT = 8
"""Kernels of so many gauges are multiplied before a logarithm is taken."""


class Predictions(NamedTuple):
    """What U controls and N pairs predict for G gauges; F factors of the state have intervals.

    Attributes
    ----------
    value : (U, G, N) array
        The predicted values at the levels, SI.
    inverse_deviation : (U, G, N) array
        One over the standard deviation of the assumed noise.
    log_inverse_deviation : (U, S, G) array
        Its logarithm, by state.
    interval : (U, F, G, N) array
        The change of each gauge within the interval of a state, in units of the noise.
    """

    value: Float
    inverse_deviation: Float
    log_inverse_deviation: Float
    interval: Float


class Observations(NamedTuple):
    """The observations of B twins in one step.

    Attributes
    ----------
    readings : (B, G) array
        The values of the gauges, SI; NaN where a gauge is lost or left out.
    log_density_beside : (B, S) array
        The log density of the remaining observation, such as readings of inspections.
    control : (B,) array
        The control in force.
    """

    readings: Float
    log_density_beside: Float
    control: Index


class FaultPriors(NamedTuple):
    """The priors of the faults, for K gain errors of a single gauge.

    Attributes
    ----------
    gains, gain_deviations : (K,) array
        The gain errors of single gauges, and their prior standard deviations.
    free_gain_deviation : float
        The prior standard deviation of a free gain.
    degrees_of_freedom : float
        The degrees of freedom of the prior of the noise scale.
    """

    gains: Float
    gain_deviations: Float
    free_gain_deviation: float
    degrees_of_freedom: float


class FreeGainStatistics(NamedTuple):
    """What is learnt about each gauge of B twins if some gauges have unknown gains.

    Attributes
    ----------
    free_probability : (B, G) array
        The probability that the gauge has a gain of its own.
    fixed_squares : (B, G) array
        The sum of squared residuals if it has none.
    sum_cc, sum_cx : (B, G) array
        The sums of c² and c x of the regression if it has one.
    free_squares : (B, G) array
        The sum of squared innovations over their variance if it has one (West and Harrison 1997,
        section 4.6).
    """

    free_probability: Float
    fixed_squares: Float
    sum_cc: Float
    sum_cx: Float
    free_squares: Float


class Beliefs(NamedTuple):
    """Beliefs and sums of squares of all hypotheses of B twins, with R = G K faults of gauges.

    Attributes
    ----------
    model, recovered : (B, N) array
        The belief under the model, and after a fault has ended.
    gauge : (B, N, R) array
        The belief under each fault of a gauge, gauge by gauge; most entries are zero.
    gauge_is_nonzero : (B, N) array of bool
        Whether any fault of a gauge believes in the pair; else its row of `gauge` is zero.
    free_gains : (B, N) array
        The belief if several gauges have unknown gains.
    model_squares, recovered_squares : (B, G) array
        The expected sums of squared residuals.
    gauge_squares, gauge_sum_cc, gauge_sum_cx : (B, R) array
        The sum of squared innovations of the faulty gauge, and the sums c² and c x of the
        regression of its gain.
    """

    model: Float
    recovered: Float
    gauge: Single
    gauge_is_nonzero: NDArray[np.bool_]
    free_gains: Single
    model_squares: Float
    recovered_squares: Float
    gauge_squares: Float
    gauge_sum_cc: Float
    gauge_sum_cx: Float


class LogEvidence(NamedTuple):
    """The log evidence of an observation under each hypothesis of B twins, up to one constant.

    Attributes
    ----------
    model, recovered, free_gains : (B,) array
        Those of the model, of "recovered" and of free gains.
    gauge : (B, R) array
        Those of the faults of single gauges.
    """

    model: Float
    recovered: Float
    free_gains: Float
    gauge: Float


class StandardizedObservation(NamedTuple):
    """An observation of one twin in units of the noise, at all pairs.

    Attributes
    ----------
    present : (G,) array of bool
        Whether a gauge reports. A gauge that does not has residuals and predictions of zero.
    residual, prediction : (G, N) array
        The observation minus the prediction, and the prediction.
    log_density : (N,) array
        The log density without that of the standardised residuals.
    degrees_after : (G,) array
        Degrees of freedom plus one: twice the power of the density of a present gauge.
    """

    present: NDArray[np.bool_]
    residual: Float
    prediction: Float
    log_density: Float
    degrees_after: Float


# ----------------------------------------------------------------------------------------------
# The observation in units of the noise
# ----------------------------------------------------------------------------------------------


@compiled
def _normal_root(design: Float, weight: Float, root: Float) -> float:
    """Fill `root` with Cholesky's factor of the normal matrix of a ridge regression.

    Parameters
    ----------
    design : (F, G) array
        The change of each gauge within the interval of a state, in units of its noise.
    weight : (G,) array
        The weight of each gauge.
    root : (F, F) array
        To be filled below and on the diagonal.

    Returns
    -------
    float
        Half the log determinant of the normal matrix.
    """
    half_log_determinant = 0.0
    for i in range(len(root)):
        for j in range(i + 1):
            total = 1.0 if i == j else 0.0
            for g in range(len(weight)):
                total += weight[g] * design[i, g] * design[j, g]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            root[i, j] = np.sqrt(total) if i == j else total / root[j, j]
        half_log_determinant += np.log(root[i, i])
    return half_log_determinant


@compiled
def _solve(root: Float, first: int, end: int, point: Float) -> None:
    """Solve root root' x = b in place for the columns `first` to `end` of `point` (F, N)."""
    factors = len(root)
    for f in range(factors):
        for k in range(f):
            for i in range(first, end):
                point[f, i] -= root[f, k] * point[k, i]
        for i in range(first, end):
            point[f, i] /= root[f, f]
    for f in range(factors - 1, -1, -1):
        for k in range(f + 1, factors):
            for i in range(first, end):
                point[f, i] -= root[k, f] * point[k, i]
        for i in range(first, end):
            point[f, i] /= root[f, f]


@compiled
def _fit_within_intervals(
    interval: Float, precision: Float, draws: int, observation: StandardizedObservation
) -> None:
    """Move the predictions to the most probable point within the interval of each state.

    The point has a standard normal prior for each factor, so that it is found by a ridge
    regression, solved by Cholesky's method. A gauge is weighted by the noise that is learnt.
    Otherwise a gauge that is off would shift the point, and so the residuals of all other gauges.

    Parameters
    ----------
    interval : (F, G, N) array
        The change of each gauge within the interval of a state, in units of the noise.
    precision : (G,) array
        The precision of each gauge over the assumed one.
    draws : int
        The number E of draws.
    observation : StandardizedObservation
        Residuals, predictions and log densities at the levels; updated in place.
    """
    factors, gauges, pairs = interval.shape
    point = np.zeros((factors, pairs))
    weight = np.empty(gauges)
    for g in range(gauges):
        weight[g] = precision[g] if observation.present[g] else 0.0
    for f in range(factors):
        for g in range(gauges):
            for i in range(pairs):
                residual = observation.residual[g, i]
                residual = min(max(residual, -LARGEST_DISTANCE), LARGEST_DISTANCE)
                point[f, i] += weight[g] * interval[f, g, i] * residual
    root = np.zeros((factors, factors))
    for first in range(0, pairs, draws):
        half_log_determinant = _normal_root(interval[:, :, first], weight, root)
        _solve(root, first, first + draws, point)
        for i in range(first, first + draws):
            observation.log_density[i] -= half_log_determinant
    for f in range(factors):
        for i in range(pairs):
            observation.log_density[i] -= 0.5 * point[f, i] * point[f, i]
        for g in range(gauges):
            if observation.present[g]:
                for i in range(pairs):
                    change = interval[f, g, i] * point[f, i]
                    observation.residual[g, i] -= change
                    observation.prediction[g, i] += change


@compiled
def standardize(
    predictions: Predictions,
    observations: Observations,
    twin: int,
    precision: Float,
    observation: StandardizedObservation,
) -> None:
    """Fill residuals, predictions and log densities of the observation of a twin at all pairs.

    Parameters
    ----------
    predictions : Predictions
        What all controls and pairs predict.
    observations : Observations
        The observations of all twins.
    twin : int
        The twin.
    precision : (G,) array
        The precision of each gauge over the assumed one.
    observation : StandardizedObservation
        The arrays `residual`, `prediction` and `log_density`, to be filled, and `present`.
    """
    control = observations.control[twin]
    _, states, gauges = predictions.log_inverse_deviation.shape
    pairs = predictions.value.shape[2]
    draws = pairs // states
    for s in range(states):
        log_scale = observations.log_density_beside[twin, s]
        for g in range(gauges):
            if observation.present[g]:
                log_scale += predictions.log_inverse_deviation[control, s, g]
        for i in range(s * draws, (s + 1) * draws):
            observation.log_density[i] = log_scale
    for g in range(gauges):
        residual = observation.residual[g]
        prediction = observation.prediction[g]
        if observation.present[g]:
            reading = observations.readings[twin, g]
            value = predictions.value[control, g]
            inverse_deviation = predictions.inverse_deviation[control, g]
            for i in range(pairs):
                prediction[i] = value[i] * inverse_deviation[i]
                residual[i] = (reading - value[i]) * inverse_deviation[i]
        else:
            for i in range(pairs):
                prediction[i] = 0.0
                residual[i] = 0.0
    if predictions.interval.shape[1] > 0:
        _fit_within_intervals(predictions.interval[control], precision, draws, observation)


# ----------------------------------------------------------------------------------------------
# The model, and "recovered"
# ----------------------------------------------------------------------------------------------


@compiled
def _add_log_density_of_residuals(
    observation: StandardizedObservation, scale_squares: Float, log_density: Float
) -> None:
    """Add the log density of all residuals, if every gauge is sound, to `log_density` (N,).

    Parameters
    ----------
    observation : StandardizedObservation
        The observation.
    scale_squares : (G,) array
        Degrees of freedom plus the sum of squared residuals of each gauge.
    log_density : (N,) array
        Updated in place, up to a constant of the step.
    """
    pairs = len(log_density)
    product = np.ones(pairs)
    gauges_in_product = 0
    degrees_of_product = 0.0
    for g in range(len(observation.present)):
        if not observation.present[g]:
            continue
        degrees_of_freedom = observation.degrees_after[g]
        is_full = gauges_in_product == _GAUGES_OF_A_PRODUCT
        if gauges_in_product > 0 and (is_full or degrees_of_freedom != degrees_of_product):
            for i in range(pairs):
                log_density[i] -= 0.5 * degrees_of_product * np.log(product[i])
                product[i] = 1.0
            gauges_in_product = 0
        inverse = 1.0 / scale_squares[g]
        residual = observation.residual[g]
        for i in range(pairs):
            product[i] *= 1.0 + residual[i] * residual[i] * inverse
        gauges_in_product += 1
        degrees_of_product = degrees_of_freedom
    for i in range(pairs):
        log_density[i] -= 0.5 * degrees_of_product * np.log(product[i])


@compiled
def update_sound_gauges(
    observation: StandardizedObservation,
    degrees_of_freedom: float,
    belief: Float,
    squares: Float,
    log_density: Float,
) -> float:
    """Correct the belief of a hypothesis under which all gauges are sound; return its log evidence.

    Parameters
    ----------
    observation : StandardizedObservation
        The observation.
    degrees_of_freedom : float
        The degrees of freedom of the prior of the noise scale.
    belief : (N,) array
        The belief; updated in place.
    squares : (G,) array
        The expected sums of squared residuals; updated in place.
    log_density : (N,) array
        To be filled: the log density of the observation, up to a constant of the step.
    """
    pairs = len(log_density)
    for i in range(pairs):
        log_density[i] = observation.log_density[i]
    scale_squares = np.empty(len(squares))
    for g in range(len(squares)):
        scale_squares[g] = degrees_of_freedom + squares[g]
    _add_log_density_of_residuals(observation, scale_squares, log_density)

    # Exponents are taken relative to the largest one of the pairs that count. Those of other pairs
    # may be larger: they are not used.
    largest = -np.inf
    for i in range(pairs):
        if belief[i] >= NEGLIGIBLE_UNDER_MODEL:
            largest = max(largest, log_density[i])
    total = 0.0
    for i in range(pairs):
        is_considered = belief[i] >= NEGLIGIBLE_UNDER_MODEL
        belief[i] = belief[i] * np.exp(log_density[i] - largest) if is_considered else 0.0
        total += belief[i]
    for i in range(pairs):
        belief[i] /= total
    for g in range(len(squares)):
        residual = observation.residual[g]
        added_squares = 0.0
        for i in range(pairs):
            added_squares += belief[i] * residual[i] * residual[i]
        squares[g] += added_squares
    return float(largest + np.log(total))
