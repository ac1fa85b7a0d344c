"""Loads and prescribed motions as functions of time, also between recorded samples."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import inf, isfinite, pi, sqrt
from typing import ClassVar, Protocol

import numpy as np
from scipy.interpolate import CubicSpline, PPoly

from discrepancy.campaign.records import FloatArray, Hold
from fe.runtime.expression import Expression

SMOOTH_PARTS = 8
"""Time steps in a sampling interval if an input is a spline. Straight lines over these steps
approximate the spline to 1e-6 of its amplitude."""


class LoadHistory(Protocol):
    """The values of a load over time."""

    @property
    def hold(self) -> Hold | None:
        """The way in which the load is interpolated between its samples."""

    @property
    def jump_times(self) -> FloatArray:
        """Times at which the load jumps, begins or ends, (J,) [s]."""

    def values_at(self, time: FloatArray, derivative: int = 0) -> FloatArray:
        """Return the values (N,) at times, or a time derivative of them."""


@dataclass(frozen=True, eq=False)
class RecordedHistory:
    """A recorded load or prescribed motion over time.

    Attributes
    ----------
    time, values : (N,) ndarray
        The times of the samples [s], and the values at these times [SI].
    hold : Hold, optional
        The course between the samples, linear by default. A load keeps its first value before the
        first sample and its last value after the last one.
    motion_order : int, optional
        For a prescribed motion, which is `SMOOTH`: 0 if its displacement was recorded, 1 if its
        velocity, 2 if its acceleration. The latter two begin at zero displacement, and an
        acceleration at zero velocity too. None for a load.
    """

    time: FloatArray
    values: FloatArray
    hold: Hold | None = None
    motion_order: int | None = None

    @property
    def jump_times(self) -> FloatArray:
        """Times at which the history jumps or has a corner, (J,) [s]."""
        if self.hold is Hold.SMOOTH:
            return np.zeros(0)
        return self.time

    @cached_property
    def _spline(self) -> PPoly:
        """The spline through the load, or through the displacement of a prescribed motion."""
        spline: PPoly = CubicSpline(self.time, self.values)
        if self.motion_order:
            return spline.antiderivative(self.motion_order)
        return spline

    def values_at(self, time: FloatArray, derivative: int = 0) -> FloatArray:
        """Return the values (N,) at times [s], or a time derivative of them.

        If a value or slope jumps at a time, the one just before the jump is returned.

        Parameters
        ----------
        time : (N,) ndarray
            The times of the samples [s].
        derivative : int
            The order of the time derivative: 0 or 1 unless the course is `SMOOTH`.
        """
        if self.hold is Hold.SMOOTH:
            is_load = self.motion_order is None
            if is_load:  # it keeps its first and last value outside of the record
                time = np.clip(time, self.time[0], self.time[-1])
            # the spline continues a motion beyond the record
            return np.asarray(self._spline(time, derivative))
        is_linear = self.hold is not Hold.ZERO_ORDER
        if is_linear and derivative == 0:
            return np.asarray(np.interp(time, self.time, self.values))
        if derivative == 0:
            step_values = self.values
        else:
            # (N,): the slope of the straight line that begins at each sample, which is zero after
            # the last sample (no rise over an infinite interval)
            rises = np.diff(self.values, append=self.values[-1])
            step_values = rises / np.diff(self.time, append=np.inf)
        # The last sample before each time is taken. Times are moved back slightly, because a time
        # at a jump may be rounded to just after it.
        just_before = time - 1e-9 * (self.time[-1] - self.time[0]) / len(self.time)
        next_sample = np.searchsorted(self.time, just_before)
        return np.asarray(step_values[np.maximum(next_sample - 1, 0)])


@dataclass(frozen=True, eq=False)
class FormulaHistory:
    """A load by a formula in time, zero outside of its spans.

    Attributes
    ----------
    formula : Expression
        The load as a function of `time` [s].
    spans : tuple of (float, float)
        The beginning and the end of each span [s]; without any the load acts always.
    """

    formula: Expression
    spans: tuple[tuple[float, float], ...] = ()

    hold: ClassVar[Hold | None] = Hold.SMOOTH

    @property
    def jump_times(self) -> FloatArray:
        """Times at which the load begins or ends, (J,) [s]."""
        return np.array([edge for span in self.spans for edge in span if isfinite(edge)])

    def values_at(self, time: FloatArray, derivative: int = 0) -> FloatArray:
        """Return the values (N,) at times [s]; a formula is never differentiated."""
        spans = self.spans or ((-inf, inf),)
        is_inside = np.any([(time >= begin) & (time < end) for begin, end in spans], axis=0)
        return np.where(is_inside, self.formula.values_over_time(time, {"pi": pi}), 0.0)


def equivalent_ramps(
    values_at: Callable[[FloatArray], FloatArray], time: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return start and end values of straight lines that replace a function in each time step.

    Each line goes through the function at the two Gauss-Legendre points of its step, so that the
    integral of the motion over the step is right to fourth order in the step.

    Parameters
    ----------
    values_at : callable
        The function: times (K,) to values (K, ...).
    time : (K + 1,) array
        The boundaries of the steps [s].

    Returns
    -------
    begin, end : (K, ...) arrays
        The values of the lines at the start and at the end of each step.
    """
    middle_time = 0.5 * (time[1:] + time[:-1])
    half_step = 0.5 * np.diff(time)
    # The two points lie at a distance of half_step / sqrt(3) from the middle, so that a line rises
    # over half a step by sqrt(3) / 2 times its rise between them.
    at_first_point = values_at(middle_time - half_step / sqrt(3.0))
    at_second_point = values_at(middle_time + half_step / sqrt(3.0))
    mean = 0.5 * (at_first_point + at_second_point)
    half_rise = 0.5 * sqrt(3.0) * (at_second_point - at_first_point)
    return mean - half_rise, mean + half_rise


def subdivide(time: FloatArray, parts: int) -> FloatArray:
    """Return times (N,) with each interval divided into `parts`: ((N - 1) parts + 1,) times."""
    position = np.arange((len(time) - 1) * parts + 1) / parts  # in intervals of `time`
    return np.interp(position, np.arange(len(time)), time)
