"""Outputs of an FMU on the grid of its steps, read at the samples of a trial, derived where wanted."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from discrepancy.models.interface import Response

FloatArray = NDArray[np.float64]

SLOPES = (
    np.array(
        [
            [-25, 48, -36, 16, -3],
            [-3, -10, 18, -6, 1],
            [1, -8, 0, 8, -1],
            [-1, 6, -18, 10, 3],
            [3, -16, 36, -48, 25],
        ]
    )
    / 12.0
)
"""Weights by which five values on an even grid give the slope at each of them, of fourth order."""


def sampled(values: FloatArray, step: float, times: FloatArray, derivatives: Sequence[int]) -> Response:
    """Return values and rates at times, from values on an even grid.

    Parameters
    ----------
    values : (K, C) ndarray
        Outputs at 0, `step`, 2 `step`, ...
    step : float
        Of the grid [s].
    times : (N,) ndarray
        Times of the samples [s]; before zero the first value holds.
    derivatives : sequence of int
        For each column, how often it is derived in the response: 0, 1 or 2.
    """
    before = times < 0.0
    index = np.round(times / step)
    on_grid = bool(np.all(np.abs(times / step - index) < 1e-6))
    if on_grid and len(values) >= len(SLOPES) and not any(derivatives):
        at_index = np.clip(index.astype(int), 0, len(values) - 1)
        first = np.clip(at_index - len(SLOPES) // 2, 0, len(values) - len(SLOPES))
        around = values[first[:, np.newaxis] + np.arange(len(SLOPES))]
        rates = np.einsum("nk,nkc->nc", SLOPES[at_index - first] / step, around)
        rates[before] = 0.0
        return Response(values[at_index], rates)
    grid = step * np.arange(len(values))
    curve = CubicSpline(grid, values)
    at = np.clip(times, 0.0, grid[-1])
    shown, rates = curve(at), curve(at, 1)
    if on_grid:
        shown = values[np.clip(index.astype(int), 0, len(values) - 1)]
    rates[before] = 0.0
    for column, order in enumerate(derivatives):
        if order > 0:
            shown = shown if shown.flags.owndata else shown.copy()
            # derivatives of the derivative's own spline keep the order of the first one
            slope = curve.derivative()(grid)[:, column]
            own = CubicSpline(grid, slope)
            shown[:, column] = own(at, order - 1)
            rates[:, column] = own(at, order)
            shown[before, column] = rates[before, column] = 0.0
    return Response(np.ascontiguousarray(shown), np.ascontiguousarray(rates))
