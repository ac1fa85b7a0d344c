"""Compiled loops: the density of an observation after the density of one gauge is exchanged.

Notation and method are those of `fault_kernels`. Single precision suffices: the ratio of two
densities of a gauge is a power of a number near one, which is kept as its excess over one.
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from fe.compilation import callable_when_compiled, compiled
from reporting.arrays import Float, Index, Single
from twin_master.gauges.fault_kernels import StandardizedObservation
from twin_master.gauges.model_likelihood import ModelLikelihood

_DIGITS_TOGETHER = 6
"""Binary digits of an exponent that are treated in one loop."""

_LARGEST_LOG_POWER = 82.0
"""Powers of kernels are cut to exp(82), the square of exp(41): larger ones may overflow."""

_inlined = partial(callable_when_compiled, makes_arrays=False, inline=True)
"""Decorator of functions that become part of their callers: the compiler vectorises a loop only
where it sees that the arrays were made one by one."""


class GaugeDensities(NamedTuple):
    """L densities of gauges, each of which may replace a density of the model.

    Each is Student's, and the gauge shows (1 + gain) times the prediction.

    Attributes
    ----------
    gauge : (L,) array
        The gauge.
    gain, gain_variance : (L,) array
        The expected gain, and its variance.
    scale_squares : (L,) array
        Degrees of freedom plus the sum of squared innovations.
    """

    gauge: Index
    gain: Float
    gain_variance: Float
    scale_squares: Float


class ExchangeFactors(NamedTuple):
    """Factors of the ratios between L densities and those of the model, the same at all pairs.

    A density of Student is k^(-n / 2), where n is the number of degrees of freedom plus one. Its
    kernel is k = 1 + (innovation)^2 / (variance times scale squares), and that of the model is k_0
    = 1 + (residual)^2 / (scale squares). With r, the ratio k_0 / k at the reference pair, the ratio
    of two densities is the power n / 2 of k_0 / (r k).

    Attributes
    ----------
    gain, gain_variance : (L,) array
        Those of `GaugeDensities`.
    inverse_model_squares : (L,) array
        One over the scale squares of the model.
    factor, offset : (L,) array
        r over the scale squares of the density, and r - 1.
    largest_excess : (L,) array
        The excess is cut to this, so that its power is still a number.
    fractions : (L,) array
        The fraction of the exponent n.
    has_fractions : bool
        Whether any fraction is not zero.
    digits : (6 m, L) array
        The binary digits of the whole part of n, see `binary_digits`.
    """

    gain: Single
    gain_variance: Single
    inverse_model_squares: Single
    factor: Single
    offset: Single
    largest_excess: Single
    fractions: Float
    has_fractions: bool
    digits: Single


class ExchangeWork(NamedTuple):
    """Work space for L densities, each field (L,).

    Attributes
    ----------
    excess, power_excess, inverse_variance : (L,) array
        The excess of a ratio of kernels over one, that of its power, and one over the variance.
    sign : (L,) array
        Negative where the density is larger than that of the model, relative to the reference pair.
    """

    excess: Single
    power_excess: Single
    inverse_variance: Single
    sign: Single


@compiled
def reference_ratio(
    observation: StandardizedObservation,
    model: ModelLikelihood,
    densities: GaugeDensities,
    number: int,
) -> float:
    """Return the model's kernel over the kernel of another density, at the reference pair."""
    g = densities.gauge[number]
    residual = observation.residual[model.reference, g]
    prediction = observation.prediction[model.reference, g]
    innovation = residual - densities.gain[number] * prediction
    variance = 1.0 + densities.gain_variance[number] * prediction * prediction
    kernel = 1.0 + innovation * innovation / (densities.scale_squares[number] * variance)
    return float((1.0 + residual * residual / model.scale_squares[g]) / kernel)


@compiled
def log_reference_density(
    observation: StandardizedObservation,
    model: ModelLikelihood,
    densities: GaugeDensities,
    number: int,
) -> float:
    """Return the log of the factor that `exchange_densities` leaves out."""
    g = densities.gauge[number]
    if not observation.present[g]:
        return 0.0
    ratio = reference_ratio(observation, model, densities, number)
    log_scale_ratio = np.log(model.scale_squares[g] / densities.scale_squares[number])
    return float(0.5 * (log_scale_ratio + observation.degrees_after[g] * np.log(ratio)))


@compiled
def log_exchanged_density(
    observation: StandardizedObservation,
    model: ModelLikelihood,
    densities: GaugeDensities,
    number: int,
    pair: int,
) -> float:
    """Return the log ratio between density `number` and the model's at a pair.

    Logarithms are taken from the start, so that nothing overflows.
    """
    g = densities.gauge[number]
    if not observation.present[g]:
        return 0.0
    residual = observation.residual[pair, g]
    prediction = observation.prediction[pair, g]
    innovation = residual - densities.gain[number] * prediction
    variance = 1.0 + densities.gain_variance[number] * prediction * prediction
    kernel = 1.0 + innovation * innovation / (densities.scale_squares[number] * variance)
    model_kernel = 1.0 + residual * residual / model.scale_squares[g]
    log_scale_ratio = np.log(model.scale_squares[g] / densities.scale_squares[number])
    log_power = observation.degrees_after[g] * np.log(model_kernel / kernel)
    return float(0.5 * (log_scale_ratio + log_power - np.log(variance)))


@compiled
def binary_digits(exponents: Float) -> Single:
    """Return the digits of the whole parts of exponents (L,), highest first: (6 m, L)."""
    largest = 0.0
    for exponent in exponents:
        largest = max(largest, exponent)
    count = _DIGITS_TOGETHER
    while np.int64(largest) >> count > 0:
        count += _DIGITS_TOGETHER
    digits = np.empty((count, len(exponents)), np.float32)
    for digit in range(count):
        for number in range(len(exponents)):
            digits[digit, number] = (np.int64(exponents[number]) >> (count - 1 - digit)) & 1
    return digits


@compiled
def exchange_factors(
    observation: StandardizedObservation, model: ModelLikelihood, densities: GaugeDensities
) -> ExchangeFactors:
    """Return the factors of the density ratios that are the same at all pairs.

    A pair is a draw with a state. The ratios are those between the densities of gauges and the
    model's; their formula stands at `ExchangeFactors`.
    """
    count = len(densities.gauge)
    inverse_model_squares = np.empty(count, np.float32)
    factor = np.empty(count, np.float32)
    offset = np.empty(count, np.float32)
    largest_excess = np.empty(count, np.float32)
    exponents = np.empty(count)
    for number in range(count):
        g = densities.gauge[number]
        ratio = reference_ratio(observation, model, densities, number)
        inverse_model_squares[number] = 1.0 / model.scale_squares[g]
        factor[number] = ratio / densities.scale_squares[number]
        offset[number] = ratio - 1.0
        exponents[number] = observation.degrees_after[g]
        # Many densities in succession have the same exponent, and `expm1` is slow.
        if number > 0 and exponents[number] == exponents[number - 1]:
            largest_excess[number] = largest_excess[number - 1]
        else:
            largest_excess[number] = np.expm1(_LARGEST_LOG_POWER / exponents[number])
    fractions = exponents - np.floor(exponents)
    has_fractions = False
    for fraction in fractions:
        has_fractions |= fraction > 0.0
    return ExchangeFactors(
        densities.gain.astype(np.float32),
        densities.gain_variance.astype(np.float32),
        inverse_model_squares,
        factor,
        offset,
        largest_excess,
        fractions,
        has_fractions,
        binary_digits(exponents),
    )


@_inlined
def _append_digits(
    power: np.float32, excess: np.float32, digits: Single, first: int, number: int
) -> np.float32:
    """Return a power with six more binary digits of its exponent; powers are excesses over one.

    The power is squared for each digit, and multiplied by the base if the digit is one: (1 + z)^2 =
    1 + z (2 + z). So single precision suffices for an excess of at least zero, however large the
    exponent. The digits are written out, so that the numbers stay in registers.

    Parameters
    ----------
    digits : (6 m, L) array
        The binary digits of the exponents of L numbers.
    """
    one = np.float32(1.0)
    two = np.float32(2.0)
    power *= two + power
    power += digits[first, number] * excess * (one + power)
    power *= two + power
    power += digits[first + 1, number] * excess * (one + power)
    power *= two + power
    power += digits[first + 2, number] * excess * (one + power)
    power *= two + power
    power += digits[first + 3, number] * excess * (one + power)
    power *= two + power
    power += digits[first + 4, number] * excess * (one + power)
    power *= two + power
    power += digits[first + 5, number] * excess * (one + power)
    return power


@_inlined
def exchange_densities(
    factors: ExchangeFactors,
    residual: Single,
    prediction: Single,
    square: Single,
    ratio: Single,
    work: ExchangeWork,
) -> None:
    """Fill `ratio` with L densities at one pair, each divided by the model's.

    Each is relative to the density whose logarithm `log_reference_density` returns. A ratio below
    exp(-41) is cut to this; one above exp(44) may be infinite or NaN.

    Parameters
    ----------
    residual, prediction : (L,) array
        The residual and the prediction of the gauge of each density.
    square : (L,) array
        To be filled: the squared innovation over its variance.
    ratio : (L,) array
        To be filled.
    """
    excess, power_excess, inverse_variance, sign = work
    one = np.float32(1.0)
    zero = np.float32(0.0)
    for number in range(len(ratio)):
        x = residual[number]
        h = prediction[number]
        innovation = x - factors.gain[number] * h
        innovation_squared = innovation * innovation
        variance = one + factors.gain_variance[number] * h * h
        model_square = x * x * factors.inverse_model_squares[number]
        # The kernel of the model, the difference of that of the other density from it, and the
        # smaller one of the two, all times the variance.
        model_kernel = (one + model_square) * variance
        difference = (factors.offset[number] - model_square) * variance
        difference += factors.factor[number] * innovation_squared
        smaller = model_kernel + min(difference, zero)
        inverse = one / (smaller * variance)
        inverse_variance[number] = smaller * inverse
        square[number] = innovation_squared * inverse_variance[number]
        z = abs(difference) * variance * inverse
        z = z if difference < zero else min(z, factors.largest_excess[number])
        excess[number] = z
        power_excess[number] = _append_digits(zero, z, factors.digits, 0, number)
        sign[number] = difference
    for first in range(_DIGITS_TOGETHER, len(factors.digits), _DIGITS_TOGETHER):
        for number in range(len(ratio)):
            power_excess[number] = _append_digits(
                power_excess[number], excess[number], factors.digits, first, number
            )
    if factors.has_fractions:
        for number in range(len(ratio)):
            base = np.float64(one + excess[number])
            power = np.float32(base ** factors.fractions[number])
            power_excess[number] = power * (one + power_excess[number]) - one
    for number in range(len(ratio)):
        power = one + power_excess[number]
        relative = power if sign[number] < zero else one / power
        ratio[number] = np.sqrt(inverse_variance[number] * relative)
