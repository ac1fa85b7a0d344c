"""Compiled loops of Gaussian sensors: the log density of what they show in each state.

Observations are taken by blocks: the innermost loop of each sum runs over those of the block, which are
computed side by side, each as it would be alone.
"""

import numpy as np

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
def _log_sum_exp(exponent: Float, largest: Float, total: Float, mantissa: Float, bits: Index) -> None:
    """Fill total (B,) with log sum exp over rows of exponent (E, B); the other arrays (B,) are for work.

    The exponential function is written out, as a number times a power of two, because a call of one is not
    computed side by side.
    """
    largest[:], total[:] = -np.inf, 0.0
    for e in range(len(exponent)):
        for b in range(len(total)):
            largest[b] = max(largest[b], exponent[e, b])
    power = bits.view(np.float64)
    for e in range(len(exponent)):
        for b in range(len(total)):
            value = max(exponent[e, b] - largest[b], LEAST)
            whole = np.floor(value * PER_LOG_TWO + 0.5)
            rest = (value - whole * LOG_TWO_HIGH) - whole * LOG_TWO_LOW
            square = rest * rest
            even = ((EVEN[0] * square + EVEN[1]) * square + EVEN[2]) * square + EVEN[3]
            odd = rest * ((ODD[0] * square + ODD[1]) * square + ODD[2])
            mantissa[b] = 1.0 + 2.0 * odd / (even - odd)
            bits[b] = (np.int64(whole) + 1023) << 52
        for b in range(len(total)):
            total[b] += mantissa[b] * power[b]
    for b in range(len(total)):
        total[b] = largest[b] + np.log(total[b]) if largest[b] > -np.inf else -np.inf


@compiled
def log_densities(
    shown: Float, mean: Float, inverse: Float, outward: Float, part: Float, function: Float, offset: Float,
    scale: Float, result: Float,
) -> None:  # fmt: skip
    """Fill result (T, S, E) with the log density of each draw, or (T, S, 1) with that of their sum.

    With d the distances in units of the noise it is (|outward d|² - |d|²) / 2 + d part function - offset
    + scale.

    Parameters
    ----------
    shown : (G, T)
    mean, inverse : (S, G)
        The latter is of the deviation, zero where a sensor is lost.
    outward, part : (S, F, G), (S, G, R)
    function, offset, scale : (R, E), (S, E), (S,)
    result : (T, S, E) or (T, S, 1)
        To be filled.
    """
    sensors, draws, parts, factors = len(shown), offset.shape[1], len(function), outward.shape[1]
    for first in range(0, shown.shape[1], BLOCK):
        size = min(BLOCK, shown.shape[1] - first)
        distance, slope, exponent = (
            np.empty((sensors, size)),
            np.empty((parts, size)),
            np.empty((draws, size)),
        )
        bits, square, along, mantissa = (
            np.empty(size, np.int64),
            np.empty(size),
            np.empty(size),
            np.empty(size),
        )
        for s in range(len(mean)):
            square[:], slope[:] = 0.0, 0.0
            for g in range(sensors):
                for b in range(size):
                    distance[g, b] = (shown[g, first + b] - mean[s, g]) * inverse[s, g]
                    square[b] += distance[g, b] * distance[g, b]
                for r in range(parts):
                    for b in range(size):
                        slope[r, b] += distance[g, b] * part[s, g, r]
            for f in range(factors):
                along[:] = 0.0
                for g in range(sensors):
                    for b in range(size):
                        along[b] += outward[s, f, g] * distance[g, b]
                for b in range(size):
                    square[b] -= along[b] * along[b]
            for b in range(size):
                if not square[b] < np.inf:  # an absurd observation
                    square[b], slope[:, b] = np.inf, 0.0
            for e in range(draws):
                for b in range(size):
                    exponent[e, b] = -0.5 * square[b] - offset[s, e]
                for r in range(parts):
                    for b in range(size):
                        exponent[e, b] += slope[r, b] * function[r, e]
            if result.shape[2] == 1:
                _log_sum_exp(exponent, along, square, mantissa, bits)
                exponent[0] = square
            for b in range(size):
                for e in range(result.shape[2]):
                    result[first + b, s, e] = exponent[e, b] + scale[s]
