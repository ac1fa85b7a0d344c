"""Outputs of an FMU at the samples of a trial, and their time derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from discrepancy.campaign.records import FloatArray


class OutputColumns(NamedTuple):
    """Columns of outputs of the FMU, and how many times each is differentiated in time."""

    columns: list[int]
    derivatives: list[int]


class SampledOutputs(NamedTuple):
    """Values and rates (N, C) of outputs at the samples of a trial."""

    values: FloatArray
    rates: FloatArray


@dataclass(frozen=True)
class Readout:
    """Which outputs of an FMU are read, and when.

    Attributes
    ----------
    columns : sequence of int
        Columns of the outputs, C of them.
    derivatives : sequence of int
        How many times each is differentiated in time.
    times : (N,) ndarray
        Times of the samples [s].
    """

    columns: Sequence[int]
    derivatives: Sequence[int]
    times: FloatArray


def sample_by_splines(
    values: FloatArray, step: float, readout: Readout, remaining_derivatives: Sequence[int]
) -> SampledOutputs:
    """Return values and rates of outputs at given times, by cubic splines through an even grid.

    Before time zero the outputs rest: an output has its first value, and its derivatives are zero.
    After the last time of the grid, values and rates are those of this time.

    Parameters
    ----------
    values : (K, C) array
        Values at 0, `step`, 2 `step`, ...
    step : float
        Step of the grid [s].
    readout : Readout
        The C outputs, and the N times at which they are read.
    remaining_derivatives : sequence of int
        How many times each column of `values` is differentiated here (C,): 0 where `values` are the
        derivatives of the readout already.
    """
    grid = step * np.arange(len(values))
    curve = CubicSpline(grid, values)
    clipped_times = np.clip(readout.times, 0.0, grid[-1])
    sampled = curve(clipped_times)
    rates = curve(clipped_times, 1)
    for column, order in enumerate(remaining_derivatives):
        if order > 0:
            # The second derivative of a cubic spline is inaccurate. So its first derivatives are
            # interpolated by another spline, which is differentiated once less.
            derivative = CubicSpline(grid, curve(grid, 1)[:, column])
            sampled[:, column] = derivative(clipped_times, order - 1)
            rates[:, column] = derivative(clipped_times, order)
    is_before = readout.times < 0.0
    rates[is_before] = 0.0
    sampled[np.ix_(is_before, np.array(readout.derivatives) > 0)] = 0.0
    return SampledOutputs(np.ascontiguousarray(sampled), np.ascontiguousarray(rates))
