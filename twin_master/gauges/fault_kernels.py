"""Compiled loops of the filters of gauge faults: an observation, and its density for sound gauges.

A pair is a state and a draw of the parameter; there are N of them, in the order of the states. The
innermost loops run over the gauges or over their faults, whose numbers lie side by side.

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

from fe.compilation import compiled, compiled_with_reordered_sums
from reporting.arrays import Float, Index, Single

NEGLIGIBLE_UNDER_MODEL = 1e-30
"""Pairs of draw and state of smaller probability are left out of the evidence of the model."""
NEGLIGIBLE_UNDER_FAULT = 1e-7
"""The same for a fault; its evidence becomes lower by that, so that an alarm comes later."""
LARGEST_DISTANCE = 1e140
"""Distances are cut to this in the fit within an interval; its square is still a number."""
LEAST_TOTAL = 1e-200
"""A sum of relative densities that is smaller may have lost terms by underflow."""
_GAUGES_OF_A_PRODUCT = 64
"""Kernels of so many gauges are multiplied before a power is taken."""


class Predictions(NamedTuple):
    """The predictions of G gauges at N pairs under U controls, and their F intervals.

    Attributes
    ----------
    value : (U, N, G) array
        The predicted values at the levels, in units of the noise.
    inverse_deviation : (U, N, G) array
        One over the standard deviation of the assumed noise.
    log_inverse_deviation : (U, S, G) array
        Its logarithm, by state.
    interval : (U, F, N, G) array
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
    other_log_density : (B, S) array
        The log density of the other parts of the observation, such as readings of inspections.
    control : (B,) array
        The control in force.
    """

    readings: Float
    other_log_density: Float
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
    """The regression of each gauge of B twins under the fault that some gauges have unknown gains.

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
    """The beliefs and sums of squares of B twins under all hypotheses; R = G K gauge faults.

    Attributes
    ----------
    model, recovered : (B, N) array
        The belief under the model, and after a fault has ended.
    gauge : (B, N, R) array
        The belief under each fault of a gauge, gauge by gauge; most entries are zero.
    gauge_is_nonzero : (B, N) array of bool
        Whether the pair has a probability under any fault of a gauge; else its row is zero.
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
    """The log evidence of an observation under each hypothesis of B twins, up to a common constant.

    Attributes
    ----------
    model, recovered, free_gains : (B,) array
        The log evidence of the model, of "recovered" and of free gains.
    gauge : (B, R) array
        The log evidence of each fault of a single gauge.
    """

    model: Float
    recovered: Float
    free_gains: Float
    gauge: Float


class SoundEvidence(NamedTuple):
    """The evidence of a hypothesis under which all gauges are sound, up to a constant of the step.

    Attributes
    ----------
    log_evidence : float
        The log evidence.
    log_factor : float
        The log of the factor that its densities at the pairs leave out.
    """

    log_evidence: float
    log_factor: float


class StandardizedObservation(NamedTuple):
    """An observation of one twin in units of the noise, at the pairs that are considered.

    Attributes
    ----------
    present : (G,) array of bool
        Whether a gauge reports. A gauge that does not has residuals and predictions of zero.
    residual, prediction : (N, G) array
        The observation minus the prediction, and the prediction.
    log_density : (N,) array
        The log density without that of the standardised residuals.
    degrees_after : (G,) array
        Degrees of freedom plus one: twice the power of the density of a present gauge.
    product : (G,) array
        The number of the product to which each gauge belongs: gauges of one product have the same
        degrees of freedom.
    """

    present: NDArray[np.bool_]
    residual: Float
    prediction: Float
    log_density: Float
    degrees_after: Float
    product: Index


# ----------------------------------------------------------------------------------------------
# The observation in units of the noise
# ----------------------------------------------------------------------------------------------


@compiled
def _normal_root(design: Float, weight: Float, root: Float) -> float:
    """Return half the log determinant of a ridge regression's normal matrix; fill in its factor.

    The normal matrix is I + D W D^T, with the design D and the weights W on the diagonal. Its
    factor is that of Cholesky.

    Parameters
    ----------
    design : (F, G) array
        The change of each gauge within the interval of a state, in units of its noise.
    weight : (G,) array
        The weight of each gauge.
    root : (F, F) array
        To be filled below and on the diagonal.
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
def _solve(root: Float, point: Float) -> None:
    """Solve root root' x = b in place for `point` (F,)."""
    factors = len(root)
    for f in range(factors):
        for k in range(f):
            point[f] -= root[f, k] * point[k]
        point[f] /= root[f, f]
    for f in range(factors - 1, -1, -1):
        for k in range(f + 1, factors):
            point[f] -= root[k, f] * point[k]
        point[f] /= root[f, f]


@compiled_with_reordered_sums
def _fit_within_intervals(
    interval: Float,
    precision: Float,
    draws: int,
    pairs: Index,
    observation: StandardizedObservation,
) -> None:
    """Move the predictions to the most probable point within the interval of each state.

    The point has a standard normal prior for each factor: it is found by a ridge regression, solved
    by Cholesky's method. Each gauge is weighted by its learnt noise; otherwise a faulty gauge would
    shift the point, and with it the residuals of all other gauges.

    Parameters
    ----------
    interval : (F, N, G) array
        The change of each gauge within the interval of a state, in units of the noise.
    precision : (G,) array
        The precision of each gauge over the assumed one.
    pairs : (n,) array
        The pairs that are considered, in rising order.
    observation : StandardizedObservation
        Residuals, predictions and log densities at the levels; updated in place.
    """
    factors, _, gauges = interval.shape
    point = np.empty(factors)
    weight = np.empty(gauges)
    for g in range(gauges):
        weight[g] = precision[g] if observation.present[g] else 0.0
    root = np.zeros((factors, factors))
    half_log_determinant = 0.0
    state_of_root = -1
    for i in pairs:
        residual = observation.residual[i]
        prediction = observation.prediction[i]
        if i // draws != state_of_root:  # the intervals are the same at all draws of a state
            state_of_root = i // draws
            half_log_determinant = _normal_root(interval[:, i], weight, root)
        for f in range(factors):
            point[f] = 0.0
            for g in range(gauges):
                distance = min(max(residual[g], -LARGEST_DISTANCE), LARGEST_DISTANCE)
                point[f] += weight[g] * interval[f, i, g] * distance
        _solve(root, point)
        observation.log_density[i] -= half_log_determinant
        for f in range(factors):
            observation.log_density[i] -= 0.5 * point[f] * point[f]
            for g in range(gauges):
                if observation.present[g]:
                    change = interval[f, i, g] * point[f]
                    residual[g] -= change
                    prediction[g] += change


@compiled_with_reordered_sums
def standardize(
    predictions: Predictions,
    observations: Observations,
    twin: int,
    precision: Float,
    pairs: Index,
    observation: StandardizedObservation,
) -> None:
    """Fill residuals, predictions and log densities of the observation of a twin at some pairs.

    Parameters
    ----------
    precision : (G,) array
        The precision of each gauge over the assumed one.
    pairs : (n,) array
        The pairs that are considered, in rising order.
    observation : StandardizedObservation
        The arrays `residual`, `prediction` and `log_density`, to be filled, and `present`.
    """
    control = observations.control[twin]
    _, states, gauges = predictions.log_inverse_deviation.shape
    draws = predictions.value.shape[1] // states
    is_present = np.empty(gauges)
    reading = np.empty(gauges)
    prediction = np.empty(gauges)
    residual = np.empty(gauges)
    for g in range(gauges):
        is_present[g] = 1.0 if observation.present[g] else 0.0
        reading[g] = observations.readings[twin, g] if observation.present[g] else 0.0
    log_scale = 0.0
    state_of_scale = -1
    for i in pairs:
        state = i // draws
        if state != state_of_scale:
            state_of_scale = state
            log_scale = observations.other_log_density[twin, state]
            for g in range(gauges):
                log_scale += is_present[g] * predictions.log_inverse_deviation[control, state, g]
        observation.log_density[i] = log_scale
        # The compiler vectorises loops that write to arrays of this function only.
        for g in range(gauges):
            value = predictions.value[control, i, g]
            distance = reading[g] * predictions.inverse_deviation[control, i, g] - value
            prediction[g] = is_present[g] * value
            residual[g] = is_present[g] * distance
        for g in range(gauges):
            observation.prediction[i, g] = prediction[g]
            observation.residual[i, g] = residual[g]
    if predictions.interval.shape[1] > 0:
        _fit_within_intervals(predictions.interval[control], precision, draws, pairs, observation)


@compiled
def number_products(degrees_after: Float, product: Index) -> None:
    """Fill `product` (G,) with the number of the product that takes each gauge's density.

    The densities of gauges with equal degrees of freedom are multiplied before a power is taken of
    them, at most `_GAUGES_OF_A_PRODUCT` together. The products are numbered in the order in which
    their first gauges come.

    Parameters
    ----------
    degrees_after : (G,) array
        The degrees of freedom of each gauge's density.
    """
    degrees = np.empty(len(product))
    gauges_in_product = np.zeros(len(product), np.int64)
    product_count = 0
    for g in range(len(product)):
        number = 0
        while number < product_count and (
            degrees[number] != degrees_after[g] or gauges_in_product[number] == _GAUGES_OF_A_PRODUCT
        ):
            number += 1
        if number == product_count:
            degrees[number] = degrees_after[g]
            product_count += 1
        product[g] = number
        gauges_in_product[number] += 1


# ----------------------------------------------------------------------------------------------
# The model, and "recovered"
# ----------------------------------------------------------------------------------------------


@compiled
def multiply_by_power(base: Float, exponent: float, product: Float) -> None:
    """Multiply `product` (n,) by a power of `base` (n,), in place; the base is overwritten.

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


@compiled_with_reordered_sums
def _multiply_kernels(
    observation: StandardizedObservation, pairs: Index, inverse_squares: Float, kernels: Float
) -> None:
    """Fill `kernels` (n,) with the product over the gauges of the kernels of their densities."""
    gauges = len(inverse_squares)
    for j in range(len(pairs)):
        i = pairs[j]
        kernel = 1.0
        for g in range(gauges):
            residual = observation.residual[i, g]
            kernel *= 1.0 + residual * residual * inverse_squares[g]
        kernels[j] = kernel


@compiled
def _density_by_products(
    observation: StandardizedObservation,
    pairs: Index,
    is_counted: NDArray[np.bool_],
    scale_squares: Float,
    density: Float,
) -> float:
    """Fill `density` (n,) for sound gauges, and return the log of a factor left out of it.

    Parameters
    ----------
    pairs : (n,) array
        The indices of the pairs.
    is_counted : (n,) array of bool
        The pairs among which the reference is chosen.
    scale_squares : (G,) array
        Degrees of freedom plus the sum of squared residuals of each gauge.
    density : (n,) array
        To be filled. Where it underflows it is zero, where it overflows it may be NaN.
    """
    gauges = len(scale_squares)
    count = len(pairs)
    inverse_squares = np.empty(gauges)
    kernels = np.empty(count)
    power = np.ones(count)
    log_factor = -np.inf
    for j in range(count):
        log_factor = max(log_factor, observation.log_density[pairs[j]])
    for j in range(count):
        log_density = observation.log_density[pairs[j]]
        density[j] = 1.0  # mostly, because the noise seldom depends on the state
        if log_density < log_factor:
            density[j] = np.exp(log_density - log_factor)
    product = 0
    for g in range(gauges):
        if observation.product[g] != product:
            continue
        for other in range(gauges):
            is_factor = observation.product[other] == product
            inverse_squares[other] = 1.0 / scale_squares[other] if is_factor else 0.0
        _multiply_kernels(observation, pairs, inverse_squares, kernels)
        smallest = np.inf
        for j in range(count):
            if is_counted[j]:
                smallest = min(smallest, kernels[j])
        for j in range(count):
            kernels[j] = smallest / kernels[j]
        multiply_by_power(kernels, observation.degrees_after[g], power)
        log_factor -= 0.5 * observation.degrees_after[g] * np.log(smallest)
        product += 1
    for j in range(count):
        density[j] *= np.sqrt(power[j])
    return float(log_factor)


@compiled
def log_density_of_sound_gauges(
    observation: StandardizedObservation, pairs: Index, scale_squares: Float, log_density: Float
) -> None:
    """Fill in the log density (n,) of the observation at pairs if every gauge is sound."""
    for j in range(len(pairs)):
        i = pairs[j]
        log_density[j] = observation.log_density[i]
        for g in range(len(scale_squares)):
            residual = observation.residual[i, g]
            kernel = 1.0 + residual * residual / scale_squares[g]
            log_density[j] -= 0.5 * observation.degrees_after[g] * np.log(kernel)


@compiled_with_reordered_sums
def _add_expected_squares(
    observation: StandardizedObservation, pairs: Index, belief: Float, squares: Float
) -> None:
    """Add the expected squared residuals under a belief (N,) to `squares` (G,)."""
    gauges = len(squares)
    added = np.zeros(gauges)
    for i in pairs:
        weight = belief[i]
        for g in range(gauges):
            residual = observation.residual[i, g]
            added[g] += weight * residual * residual
    for g in range(gauges):
        squares[g] += added[g]


@compiled
def update_sound_gauges(
    observation: StandardizedObservation,
    pairs: Index,
    degrees_of_freedom: float,
    belief: Float,
    squares: Float,
    density: Float,
) -> SoundEvidence:
    """Correct the belief of a hypothesis under which all gauges are sound, and return its evidence.

    Parameters
    ----------
    pairs : (n,) array
        The pairs that are considered, outside of which the belief is zero or negligible.
    degrees_of_freedom : float
        The degrees of freedom of the prior of the noise scale.
    belief : (N,) array
        The belief; updated in place.
    squares : (G,) array
        The expected sums of squared residuals; updated in place.
    density : (N,) array
        To be filled at the pairs: the density of the observation, up to a factor of the step.
    """
    count = len(pairs)
    scale_squares = np.empty(len(squares))
    for g in range(len(squares)):
        scale_squares[g] = degrees_of_freedom + squares[g]
    prior = np.empty(count)
    is_counted = np.empty(count, np.bool_)
    for j in range(count):
        is_counted[j] = belief[pairs[j]] >= NEGLIGIBLE_UNDER_MODEL
        prior[j] = belief[pairs[j]] if is_counted[j] else 0.0
    density_of_pairs = np.empty(count)
    log_factor = _density_by_products(
        observation, pairs, is_counted, scale_squares, density_of_pairs
    )
    total = 0.0
    for j in range(count):
        total += prior[j] * density_of_pairs[j] if is_counted[j] else 0.0
    if not LEAST_TOTAL < total < np.inf:
        # Exponents are taken relative to the largest one of the pairs that count. Those of other
        # pairs may be larger: they are not used.
        log_density_of_sound_gauges(observation, pairs, scale_squares, density_of_pairs)
        log_factor = -np.inf
        for j in range(count):
            if is_counted[j]:
                log_factor = max(log_factor, density_of_pairs[j])
        total = 0.0
        for j in range(count):
            density_of_pairs[j] = np.exp(density_of_pairs[j] - log_factor)
            total += prior[j] * density_of_pairs[j] if is_counted[j] else 0.0
    for i in range(len(belief)):
        belief[i] = 0.0
    for j in range(count):
        belief[pairs[j]] = prior[j] * density_of_pairs[j] / total if is_counted[j] else 0.0
        density[pairs[j]] = density_of_pairs[j]
    _add_expected_squares(observation, pairs, belief, squares)
    return SoundEvidence(log_factor + np.log(total), log_factor)
