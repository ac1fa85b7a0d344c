"""Compiled loops for Gaussian sensors: log densities of many observations by many draws.

Observations are taken by blocks. The innermost loop of each sum runs over the observations of the
block, so that they are computed side by side, each as it would be alone.
"""

from functools import partial

import numpy as np

from fe.compilation import callable_when_compiled, compiled
from reporting.arrays import Float, Index

LOG_ROOT_TWO_PI = 0.5 * float(np.log(2.0 * np.pi))
BLOCK_SIZE = 32
"""Observations whose densities of all draws stay in the fast memory of a processor."""
INVERSE_LOG_TWO = 1.0 / float(np.log(2.0))
LOG_TWO_HIGH = 6.93147180369123816490e-01
"""The leading digits of log 2: its product with a whole number below 2^11 is exact."""
LOG_TWO_LOW = 1.90821492927058770002e-10
"""The remaining digits of log 2."""
EVEN = (3.00198505138664455042e-6, 2.52448340349684104192e-3, 2.27265548208155028766e-1, 2.0)
"""Even part of a rational approximation of exp within log(2) / 2 of zero (Moshier 1989)."""
ODD = (1.26177193074810590878e-4, 3.02994407707441961300e-2, 1.0)
"""Its odd part; together they are good to 2e-16."""
EXPONENT_BIAS = 1023
"""A double with the exponent bits n + 1023 and the fraction zero is 2^n."""
FRACTION_BITS = 52
"""Number of bits of the fraction of a double."""
LOG_SERIES = (
    6.666666666666735130e-01,
    3.999999999940941908e-01,
    2.857142874366239149e-01,
    2.222219843214978396e-01,
    1.818357216161805012e-01,
    1.531383769920937332e-01,
    1.479819860511658591e-01,
)
"""Coefficients of log((1 + s) / (1 - s)) - 2 s, divided by s, in powers of s^2."""
ROOT_HALF_BITS = 0x3FE6A09E667F3BCD
"""The bits of sqrt(1/2)."""
WHOLE_NUMBER = 1.5 * 2.0**52
"""The last bits of a sum of this and a whole number are the whole number."""
WHOLE_NUMBER_BITS = 0x4338000000000000
LEAST_EXPONENT = -708.0
"""Exponents are cut to this: exp of a smaller number is negligible compared with one."""
ROUNDING = 1e-13
"""Entries that remain of a separated matrix, relative to the largest value, are rounding errors."""


def factor_low_rank(values: Float, largest: float) -> tuple[Float, Float]:
    """Factor a matrix (N, E) of low rank R into matrices (N, R) and (R, E), to rounding.

    The method is a cross approximation with full pivoting (Bebendorf 2000): the product of the
    column and the row of the largest remaining entry is subtracted until only rounding errors
    remain. Unlike a singular value decomposition, it does not depend on a library or its threads.

    Parameters
    ----------
    values : (N, E) array
        The matrix.
    largest : float
        The largest of the numbers from which the matrix was computed; remaining entries below 1e-13
        of it are rounding errors.
    """
    residual = values.copy()
    columns: list[Float] = []
    rows: list[Float] = []
    while residual.size and len(rows) < min(residual.shape):
        row, column = np.unravel_index(np.argmax(np.abs(residual)), residual.shape)
        pivot = residual[row, column]
        if abs(pivot) <= ROUNDING * largest:
            break
        columns.append(residual[:, column].copy())
        rows.append(residual[row] / pivot)
        residual -= columns[-1][:, None] * rows[-1]
    # The shape is given because an array of no columns would have only one axis.
    row_count, column_count = values.shape
    return (
        np.array(columns).reshape(-1, row_count).T,
        np.array(rows).reshape(-1, column_count),
    )


@partial(callable_when_compiled, makes_arrays=False, inline=True)
def fill_exponentials(
    exponent: Float, subtracted: Float, mantissa: Float, power_bits: Index
) -> None:
    """Compute exp(`exponent` - `subtracted`) (B,) as the product of `mantissa` and a power of two.

    `power_bits` are the bits of a power of two. The exponential is written out because the compiler
    does not vectorise calls of a library function. Differences below `LEAST_EXPONENT` are replaced
    by it.
    """
    for b in range(len(exponent)):
        value = max(exponent[b] - subtracted[b], LEAST_EXPONENT)
        # value = whole * log 2 + fraction, the product in two parts to be exact.
        power_of_two = np.floor(value * INVERSE_LOG_TWO + 0.5)
        fraction = (value - power_of_two * LOG_TWO_HIGH) - power_of_two * LOG_TWO_LOW
        # exp(fraction) by a rational approximation, times 2^whole by its bits.
        square = fraction * fraction
        even = ((EVEN[0] * square + EVEN[1]) * square + EVEN[2]) * square + EVEN[3]
        odd = fraction * ((ODD[0] * square + ODD[1]) * square + ODD[2])
        mantissa[b] = 1.0 + 2.0 * odd / (even - odd)
        power_bits[b] = (np.int64(power_of_two) + EXPONENT_BIAS) << FRACTION_BITS


@partial(callable_when_compiled, makes_arrays=False, inline=True)
def fill_logarithms(value: Float, logarithm: Float, work_bits: Index) -> None:
    """Compute the natural logarithms of positive normal numbers (B,) (fdlibm, Sun 1993).

    The method is written out for the reason that `fill_exponentials` gives. `work_bits` (B,) is
    work space.
    """
    # value = 2^power * mantissa, with the mantissa between sqrt(1/2) and sqrt(2).
    bits = value.view(np.int64)
    mantissa = logarithm.view(np.int64)
    for b in range(len(value)):
        power = (bits[b] - ROOT_HALF_BITS) >> FRACTION_BITS
        mantissa[b] = bits[b] - (power << FRACTION_BITS)
        work_bits[b] = power + WHOLE_NUMBER_BITS
    whole_number = work_bits.view(np.float64)
    for b in range(len(value)):
        power_of_two = whole_number[b] - WHOLE_NUMBER
        excess = logarithm[b] - 1.0
        ratio = excess / (2.0 + excess)
        square = ratio * ratio
        series = LOG_SERIES[6]
        series = LOG_SERIES[5] + square * series
        series = LOG_SERIES[4] + square * series
        series = LOG_SERIES[3] + square * series
        series = LOG_SERIES[2] + square * series
        series = LOG_SERIES[1] + square * series
        series = square * (LOG_SERIES[0] + square * series)
        half_square = 0.5 * excess * excess
        low = ratio * (half_square + series) + power_of_two * LOG_TWO_LOW
        logarithm[b] = power_of_two * LOG_TWO_HIGH - ((half_square - low) - excess)


@callable_when_compiled
def _log_sum_exp(
    exponent: Float, largest: Float, total: Float, mantissa: Float, power_bits: Index
) -> None:
    """Fill `total` (B,) with the log of the sum of exp(`exponent`) over its E rows (E, B).

    The other arrays (B,) are work space.
    """
    largest[:] = -np.inf
    total[:] = 0.0
    for e in range(len(exponent)):
        for b in range(len(total)):
            largest[b] = max(largest[b], exponent[e, b])
    power = power_bits.view(np.float64)
    for e in range(len(exponent)):
        fill_exponentials(exponent[e], largest, mantissa, power_bits)
        for b in range(len(total)):
            total[b] += mantissa[b] * power[b]
    for b in range(len(total)):
        total[b] = largest[b] + np.log(total[b]) if largest[b] > -np.inf else -np.inf


@compiled
def log_densities(
    observation: Float,
    mean: Float,
    inverse_deviation: Float,
    interval_directions: Float,
    draw_directions: Float,
    draw_coefficients: Float,
    draw_offset: Float,
    log_scale: Float,
    row: Index,
    result: Float,
) -> None:
    """Fill rows of `result` with log densities in each state, for each draw or their sum.

    With d = (observation - mean) / deviation, the log density of an observation under draw e is

        (|I d|² - |d|²) / 2 + (d A) b_e - offset_e + log scale,

    where I (F, G) are the directions in which F factors move the G sensors within the interval of a
    state, and A b_e is the difference of the draw from the mean, a matrix A (G, R) times a vector.

    Parameters
    ----------
    observation : (G, N) array
        The sensor values, any number if a sensor is lost.
    mean, inverse_deviation : (S, G) array
        The mean over the draws, and one over the standard deviation; the latter is zero if a sensor
        is lost.
    interval_directions : (S, F, G) array
        The matrix I of each state.
    draw_directions : (S, G, R) array
        The matrix A of each state.
    draw_coefficients : (R, E) array
        The vectors b_e.
    draw_offset : (S, E) array
        The term of each draw that does not depend on the observation.
    log_scale : (S,) array
        The log of the normalising factor of the density.
    row : (N,) array
        The row of the result of each observation.
    result : (T, S, E) or (T, S, 1) array
        To be filled in these rows: the log density of each draw, or the log of the sum over the
        draws.
    """
    sensors, observation_count = observation.shape
    directions, draws = draw_coefficients.shape
    factors = interval_directions.shape[1]
    for first in range(0, observation_count, BLOCK_SIZE):
        size = min(BLOCK_SIZE, observation_count - first)
        distance = np.empty((sensors, size))
        slope = np.empty((directions, size))
        exponent = np.empty((draws, size))
        power_bits = np.empty(size, np.int64)
        square = np.empty(size)
        along_direction = np.empty(size)
        mantissa = np.empty(size)
        for s in range(len(mean)):
            # Squared distance |d|², and d A.
            square[:] = 0.0
            slope[:] = 0.0
            for g in range(sensors):
                for b in range(size):
                    difference = observation[g, first + b] - mean[s, g]
                    distance[g, b] = difference * inverse_deviation[s, g]
                    square[b] += distance[g, b] * distance[g, b]
                for r in range(directions):
                    for b in range(size):
                        slope[r, b] += distance[g, b] * draw_directions[s, g, r]
            # Minus the part that the interval of the state explains.
            for f in range(factors):
                along_direction[:] = 0.0
                for g in range(sensors):
                    for b in range(size):
                        along_direction[b] += interval_directions[s, f, g] * distance[g, b]
                for b in range(size):
                    square[b] -= along_direction[b] * along_direction[b]
            for b in range(size):
                if not square[b] < np.inf:  # an absurd observation, whose square overflows
                    square[b] = np.inf
                    slope[:, b] = 0.0
            # The exponent of each draw.
            for e in range(draws):
                for b in range(size):
                    exponent[e, b] = -0.5 * square[b] - draw_offset[s, e]
                for r in range(directions):
                    for b in range(size):
                        exponent[e, b] += slope[r, b] * draw_coefficients[r, e]
            # The log of the sum over draws, if the result has one entry for all draws. Work arrays
            # that are not needed any more are used again.
            if result.shape[2] == 1:
                _log_sum_exp(exponent, along_direction, square, mantissa, power_bits)
                exponent[0] = square
            for b in range(size):
                for e in range(result.shape[2]):
                    result[row[first + b], s, e] = exponent[e, b] + log_scale[s]
