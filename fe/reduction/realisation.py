"""A linear system made from records of its answers to single forces and releases."""

from warnings import catch_warnings, simplefilter

import numpy as np
from scipy.linalg import logm

from fe.runtime.arrays import FloatArray

MOST_STATES = 40
"""Largest order of a linear system that is made from records."""
HANKEL_ROWS, MIXTURES = 64, 3
"""Rows, and mixtures of all outputs in each, in which a system shows its states."""
HANKEL_COLUMNS = 160
INDEPENDENT = 1e5
"""Condition up to which eigenvectors give the logarithm of a matrix, 20 times faster than `logm`."""
THRESHOLDS = 10.0 ** np.arange(-12, -6)
"""Shares of the largest singular value below which one is rounding, one after the other."""
FIT = 1e-7
"""Largest error of a linear system against the record that it is made of, as a share of the record."""


def not_zero(sizes: FloatArray) -> FloatArray:
    """Return sizes to divide by: one where they are zero."""
    return np.where(sizes == 0.0, 1.0, sizes)


def _largest(matrix: FloatArray, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the singular vectors and values of a matrix, the largest ones only where there are more.

    From its image of random vectors (Halko, Martinsson and Tropp 2011). The caller uses values far above the
    rounding of the first alone, so that what is left out changes nothing but rounding.
    """
    if min(matrix.shape) <= count:
        return np.linalg.svd(matrix, full_matrices=False)
    random = np.random.default_rng(0).standard_normal((matrix.shape[1], count))
    image = np.linalg.qr(matrix @ random)[0]
    left, values, right = np.linalg.svd(image.T @ matrix, full_matrices=False)
    return image @ left, values, right


def _logarithm(transition: FloatArray) -> FloatArray:
    values, shapes = np.linalg.eig(transition)
    if np.linalg.cond(shapes) < INDEPENDENT:
        return np.asarray(np.real((shapes * np.log(values.astype(complex))) @ np.linalg.inv(shapes)))
    with catch_warnings():  # of rounding in what decays within a step
        simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.real(logm(transition)))


def realised(records: FloatArray, forces: int, step: float) -> tuple[FloatArray, ...] | None:
    """Return the linear system of answers to unit forces, held over the first step only, and to releases.

    The realisation of Ho and Kalman (1966) as by Juang and Pappa (1985), from mixtures of the outputs.

    Parameters
    ----------
    records : (K, C, E + R) ndarray
        Outputs at the ends of the steps for each force, then for each release.
    forces : int
        E.
    step : float
        [s].

    Returns
    -------
    FmuSystem or None
        None if no system of at most `MOST_STATES` states shows the records within `FIT`.
    """
    count, columns, inputs = records.shape
    size = not_zero(np.max(np.abs(records[1:]), axis=(0, 2)))
    amount = not_zero(np.max(np.abs(records[1:]) / size[:, None], axis=(0, 1)))
    records = records / (size[:, None] * amount)
    seen = np.random.default_rng(1).standard_normal((MIXTURES, columns)) @ records
    height = min(HANKEL_ROWS, (count - 2) // 2)
    width = min(HANKEL_COLUMNS, count - 2 - height)
    both = seen[1 + np.arange(height + 1)[:, None] + np.arange(width)].transpose(0, 2, 1, 3)
    both = both.reshape((height + 1) * MIXTURES, width * inputs)
    hankel, shifted = both[:-MIXTURES], both[MIXTURES:]
    for most in (MOST_STATES // 4, MOST_STATES):
        left, values, right = _largest(hankel, most + 16)
        if values[-1] <= 1e-13 * values[0]:
            break
    goal = records[1:].transpose(0, 2, 1).reshape(-1, columns)
    for order in dict.fromkeys(int(np.sum(values > least * values[0])) for least in THRESHOLDS):
        root = np.sqrt(values[:order])
        transition = (left[:, :order] / root).T @ shifted @ (right[:order].T / root)
        rates = np.linalg.eigvals(transition)
        if not 0 < order <= MOST_STATES or np.max(np.abs(rates)) > 1.0 + 1e-9:
            continue
        drive = np.linalg.lstsq(transition, (root[:, None] * right[:order])[:, :inputs])[0]
        states, power = drive[None], transition
        while len(states) < count:
            states, power = np.concatenate((states, power @ states)), power @ power
        flat = states[1:count].transpose(0, 2, 1).reshape(-1, order)
        unit = np.max(np.abs(flat), axis=0)
        rows = np.linalg.lstsq(flat / unit, goal, rcond=1e-14)[0].T / unit
        error = np.max(np.abs(goal - flat @ rows.T), axis=0)
        if np.all(error <= FIT * np.max(np.abs(goal), axis=0) + 1e-300):
            held, starts = np.split(drive * amount, [forces], axis=1)
            whole = np.block([[transition, held], [np.zeros((forces, order)), np.eye(forces)]])
            generator, push = np.split(_logarithm(whole)[:order] / step, [order], axis=1)
            rows, first = rows * size[:, None], records[0, :, :forces] * size[:, None] * amount[:forces]
            return generator, push, rows, first - rows @ held, np.linalg.solve(transition, starts)
    return None
