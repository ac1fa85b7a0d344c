"""Compiled loops of Gaussian sensors: the log density of what they show in each state.

What the draws add to the mean of a sensor, in units of its noise, is put together from few functions of the
draw (`separated`): with d what is observed beside the mean, -|d - A b_e|^2 / 2 of a draw e then is
-|d|^2 / 2 + (A'd) b_e - |A b_e|^2 / 2, of which the last term is the same for all observations by the same
sensors. Observations are taken by blocks: the innermost loop of each sum runs over those of the block, which
are computed side by side, each as it would be alone.
"""

import numpy as np
from numpy.typing import NDArray

from fe.compilation import callable_when_compiled, compiled
from reporting.arrays import Float, Index

LOG_ROOT_TWO_PI = 0.5 * float(np.log(2.0 * np.pi))
BLOCK = 32
"""Observations whose densities of all draws stay in the fast memory of a processor."""
PER_LOG_TWO = 1.0 / float(np.log(2.0))
LOG_TWO_HIGH, LOG_TWO_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
"""Their sum is log 2; the product of the first with a whole number below 2^11 is exact."""
EVEN = 3.00198505138664455042e-6, 2.52448340349684104192e-3, 2.27265548208155028766e-1, 2.0
ODD = 1.26177193074810590878e-4, 3.02994407707441961300e-2, 1.0
"""Of the rational approximation of exp within log(2) / 2 of zero, good to 2e-16 (Moshier 1989, Cephes)."""
LEAST = -708.0
"""The exponential function of what is below is no number of full precision, and nothing beside one."""
ROUNDING = 1e-13
"""What is left of values that were taken apart, as a share of the largest."""


def separated(values: Float, size: float) -> tuple[Float, Float]:
    """Return (N, R) and (R, E) whose product is (N, E) to rounding of numbers of a size.

    A cross approximation with full pivoting: the largest entry that is left, its column and its row are taken
    out until none is left. Sums of products are left to the caller, so that the result does not depend on a
    library or its threads.
    """
    rest, columns, rows = values.copy(), list[Float](), list[Float]()
    while rest.size and len(rows) < min(rest.shape):
        row, column = np.unravel_index(np.argmax(np.abs(rest)), rest.shape)
        pivot = rest[row, column]
        if abs(pivot) <= ROUNDING * size:
            break
        columns.append(rest[:, column].copy())
        rows.append(rest[row] / pivot)
        rest -= columns[-1][:, None] * rows[-1]
    shape = (len(values), values.shape[1])
    return np.array(columns).reshape(-1, shape[0]).T, np.array(rows).reshape(-1, shape[1])


@callable_when_compiled
def _exponentials(exponent: Float, largest: Float, mantissa: Float, bits: Index) -> None:
    """Fill mantissa (B,) and the bits of a power of two (B,), whose product is exp(exponent - largest).

    The exponential function is written out because a call of one is not computed side by side.
    """
    for b in range(len(exponent)):
        value = max(exponent[b] - largest[b], LEAST)
        whole = np.floor(value * PER_LOG_TWO + 0.5)
        rest = (value - whole * LOG_TWO_HIGH) - whole * LOG_TWO_LOW
        square = rest * rest
        even = ((EVEN[0] * square + EVEN[1]) * square + EVEN[2]) * square + EVEN[3]
        odd = rest * ((ODD[0] * square + ODD[1]) * square + ODD[2])
        mantissa[b] = 1.0 + 2.0 * odd / (even - odd)
        bits[b] = (np.int64(whole) + 1023) << 52


@callable_when_compiled
def _log_sum_exp(exponent: Float, largest: Float, total: Float, mantissa: Float, bits: Index) -> None:
    """Fill total (B,) with log sum exp over rows of exponent (E, B); the other arrays (B,) are for work."""
    largest[:], total[:] = -np.inf, 0.0
    for e in range(len(exponent)):
        for b in range(len(total)):
            largest[b] = max(largest[b], exponent[e, b])
    power = bits.view(np.float64)
    for e in range(len(exponent)):
        _exponentials(exponent[e], largest, mantissa, bits)
        for b in range(len(total)):
            total[b] += mantissa[b] * power[b]
    for b in range(len(total)):
        total[b] = largest[b] + np.log(total[b]) if largest[b] > -np.inf else -np.inf


@callable_when_compiled
def _prepare(
    seen: NDArray[np.bool_], part: Float, function: Float, log_scale: Float, interval: Float,
    outward: Float, outward_part: Float, offset: Float,
) -> float:  # fmt: skip
    """Fill what all observations by the same sensors share in a state, and return the log of their scale.

    The covariance is the unit matrix plus interval times its transpose, inverted by Woodbury's identity: with
    the Cholesky factor L of 1 + interval' interval, outward (F, G) is L^-1 interval'.

    Parameters
    ----------
    seen : (G,) ndarray of bool
        Sensors that report.
    part : (G, R)
        What each function of the draw adds to each sensor.
    function : (R, E)
        By draw.
    log_scale : (G,)
        Minus the log deviation.
    interval : (G, F)
        In units of the deviation.
    outward, outward_part, offset : (F, G), (F, R), (E,)
        To be filled: the third is half the square of what each draw adds.
    """
    sensors, factors = interval.shape
    parts = len(function)
    shared, matrix, square = 0.0, np.eye(factors), np.zeros((parts, parts))
    outward[:], outward_part[:], offset[:] = 0.0, 0.0, 0.0
    for g in range(sensors):
        if not seen[g]:
            continue
        shared += log_scale[g] - LOG_ROOT_TWO_PI
        for f in range(factors):
            outward[f, g] = interval[g, f]
            for h in range(f + 1):
                matrix[f, h] += interval[g, f] * interval[g, h]
        for r in range(parts):
            for k in range(r + 1):
                square[r, k] += part[g, r] * part[g, k]
    for f in range(factors):
        for h in range(f):
            for i in range(h):
                matrix[f, h] -= matrix[f, i] * matrix[h, i]
            matrix[f, h] /= matrix[h, h]
            matrix[f, f] -= matrix[f, h] ** 2
            for g in range(sensors):
                outward[f, g] -= matrix[f, h] * outward[h, g]
        matrix[f, f] = np.sqrt(matrix[f, f])
        shared -= np.log(matrix[f, f])
        for g in range(sensors):
            outward[f, g] /= matrix[f, f]
            for r in range(parts):
                outward_part[f, r] += outward[f, g] * part[g, r]
    for r in range(parts):
        for k in range(r + 1):
            for f in range(factors):
                square[r, k] -= outward_part[f, r] * outward_part[f, k]
            half = square[r, k] * (0.5 if k == r else 1.0)
            for e in range(len(offset)):
                offset[e] += half * function[r, e] * function[k, e]
    return shared


@callable_when_compiled
def _exponents(
    distance: Float, part: Float, function: Float, outward: Float, outward_part: Float, offset: Float,
    square: Float, slope: Float, exponent: Float,
) -> None:  # fmt: skip
    """Fill the log density of each draw (E, B) of observations, `distance` (G, B) off the mean in deviations.

    square (B,) and slope (R, B) are for work.
    """
    square[:], slope[:] = 0.0, 0.0
    for g in range(len(distance)):
        for b in range(len(square)):
            square[b] += distance[g, b] * distance[g, b]
        for r in range(len(slope)):
            for b in range(len(square)):
                slope[r, b] += distance[g, b] * part[g, r]
    for f in range(len(outward)):
        along = np.zeros(len(square))
        for g in range(len(distance)):
            for b in range(len(square)):
                along[b] += outward[f, g] * distance[g, b]
        for b in range(len(square)):
            square[b] -= along[b] * along[b]
            for r in range(len(slope)):
                slope[r, b] -= along[b] * outward_part[f, r]
    for b in range(len(square)):
        if not square[b] < np.inf:  # an absurd observation
            square[b], slope[:, b] = np.inf, 0.0
    for e in range(len(exponent)):
        for b in range(len(square)):
            exponent[e, b] = -0.5 * square[b] - offset[e]
        for r in range(len(slope)):
            for b in range(len(square)):
                exponent[e, b] += slope[r, b] * function[r, e]


@compiled
def log_densities(
    observation: Float,
    control: Index,
    mean: Float,
    part: Float,
    function: Float,
    inverse_deviation: Float,
    log_scale: Float,
    interval: Float,
    log_weight: Float,
    result: Float,
) -> None:
    """Fill result (T, S, E) with the log density for each draw, or (T, S, 1) with that of their average.

    mean, inverse_deviation and log_scale = log inverse_deviation are (U, S, G); part (U, S, G, R) and
    interval (U, S, G, F) are in units of the deviation; function is (R, E) and log_weight (E,).
    """
    sensors, draws, factors = observation.shape[1], len(log_weight), interval.shape[3]
    outward, outward_part = np.empty((factors, sensors)), np.empty((factors, len(function)))
    offset = np.empty(draws)
    for u in range(len(mean)):
        rows = np.nonzero(control == u)[0]
        first = 0
        while first < len(rows):
            seen, size = ~np.isnan(observation[rows[first]]), 1
            while size < min(BLOCK, len(rows) - first) and np.all(
                seen != np.isnan(observation[rows[first + size]])
            ):
                size += 1
            block = rows[first : first + size]
            first += size
            distance, slope = np.empty((sensors, size)), np.empty((len(function), size))
            exponent, bits = np.empty((draws, size)), np.empty(size, np.int64)
            square, largest, mantissa = np.empty(size), np.empty(size), np.empty(size)
            shown = np.zeros((sensors, size))
            for b in range(size):
                for g in range(sensors):
                    shown[g, b] = observation[block[b], g]
            for s in range(mean.shape[1]):
                shared = _prepare(
                    seen, part[u, s], function, log_scale[u, s], interval[u, s], outward, outward_part,
                    offset,
                )  # fmt: skip
                for g in range(sensors):
                    for b in range(size):
                        distance[g, b] = (shown[g, b] - mean[u, s, g]) * inverse_deviation[u, s, g]
                    if not seen[g]:
                        distance[g] = 0.0
                for e in range(draws if result.shape[2] == 1 else 0):
                    offset[e] -= log_weight[e]
                _exponents(
                    distance, part[u, s], function, outward, outward_part, offset, square, slope, exponent
                )
                if result.shape[2] == 1:
                    _log_sum_exp(exponent, largest, square, mantissa, bits)
                    for b in range(size):
                        result[block[b], s, 0] = shared + square[b]
                else:
                    for b in range(size):
                        for e in range(draws):
                            result[block[b], s, e] = shared + exponent[e, b]
