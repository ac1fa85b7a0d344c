"""Gaussian sensors: what the draws add, taken apart, and the compiled loop of what is shown in each state."""

import numpy as np

from fe.compilation import compiled
from reporting.arrays import Float, Index
from twin_master.network.kernels import NEGLIGIBLE

LOG_ROOT_TWO_PI = 0.5 * float(np.log(2.0 * np.pi))
ROUNDING = 1e-13
"""What is left of values that were taken apart, as a share of the largest."""


def separated(values: Float, size: float) -> tuple[Float, Float]:
    """Return (N, R) and (R, E) whose product is (N, E) to rounding of numbers of a size.

    A cross approximation with full pivoting: the largest entry that is left, its column and its row are taken
    out until none is left.
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


@compiled
def log_densities(
    observation: Float,
    rows: Index,
    mean: Float,
    inverse_deviation: Float,
    asked: Float,
    added: Float,
    function: Float,
    result: Float,
) -> None:
    """Fill rows of result with log densities: (T, S, E) of each draw, or (T, S, 1) of all draws together.

    With d what is observed beside the mean in deviations, that of draw e is
    -|d|^2 / 2 + |L d|^2 / 2 + (A'd) b_e + c_e.

    Parameters
    ----------
    observation : (T, G)
    rows : (N,)
        Those whose sensors are the same ones, under the same control.
    mean, inverse_deviation : (S, G)
        The latter is zero where a sensor is lost.
    asked : (S, G, F + R)
        L and A, transposed.
    added, function : (S, E), (R, E)
        c and b.
    """
    sensors, draws = mean.shape[1], added.shape[1]
    factors = asked.shape[2] - len(function)
    along, exponent = np.empty(asked.shape[2]), np.empty(draws)
    for t in rows:
        for s in range(len(mean)):
            square, best, total = 0.0, -np.inf, 0.0
            along[:] = 0.0
            for g in range(sensors):
                if inverse_deviation[s, g] > 0.0:
                    distance = (observation[t, g] - mean[s, g]) * inverse_deviation[s, g]
                    square += distance * distance
                    for k in range(len(along)):
                        along[k] += asked[s, g, k] * distance
            for f in range(factors):
                square -= along[f] * along[f]
            if not square < np.inf:  # an absurd observation
                square, along[:] = np.inf, 0.0
            for e in range(draws):
                exponent[e] = added[s, e] - 0.5 * square
                for r in range(len(function)):
                    exponent[e] += along[factors + r] * function[r, e]
                best = max(best, exponent[e])
            if result.shape[2] == draws:
                result[t, s] = exponent
                continue
            for e in range(draws):
                if exponent[e] > best + NEGLIGIBLE:
                    total += np.exp(exponent[e] - best)
            result[t, s, 0] = best + np.log(total) if best > -np.inf else -np.inf
