"""Outputs of an FMU on the grid of its steps, read at the samples of a trial, derived where wanted."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from discrepancy.models.interface import Response

FloatArray = NDArray[np.float64]


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
    grid = step * np.arange(len(values))
    curve = CubicSpline(grid, values)
    at = np.clip(times, 0.0, grid[-1])
    shown, rates = curve(at), curve(at, 1)
    index = times / step
    if np.all(np.abs(index - np.round(index)) < 1e-6):
        shown = values[np.clip(np.round(index).astype(int), 0, len(values) - 1)]
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
