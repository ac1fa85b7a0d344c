"""Densities on tensor grids, which are moved and narrowed until sums over them are accurate."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from reporting.arrays import Float

Axes = tuple[Float, ...]
"""The axes of a tensor grid, an array of equally spaced values for each."""
LogDensity = Callable[[Axes], Float]
"""Returns the logarithm of a density at all points of a tensor grid, up to a constant."""
Transform = Callable[[Float], Float]
"""Returns a quantity for the values of a grid, such as a probability for its log odds."""
RELEVANT_DROP = 13.0
"""Points whose log density is further below the maximum than this are not relevant.

A normal density reaches 13 below its maximum at 5.1 standard deviations: 5.1^2 / 2 = 13.
"""
RESOLVED_SPACING = 1.2
"""Largest ratio of spacing to standard deviation for which sums over a grid are exact to 1e-6."""
LEAST_SHRINKAGE = 0.95
"""A further grid is computed only if an axis becomes shorter than this fraction of its length."""
NEGLIGIBLE_WEIGHT = 1e-9
"""Fraction of the largest weight below which the tails of a distribution are cut."""
SPLINE_POINTS = 4
"""Least number of points of a cubic spline."""
FINE_POINTS = 2001
"""Points on which a distribution is interpolated."""


def logit(probability: Float) -> Float:
    """Return the log odds of probabilities."""
    return np.asarray(np.log(probability) - np.log1p(-probability))


def logistic(log_odds: Float) -> Float:
    """Return the probabilities of log odds."""
    return np.asarray(1.0 / (1.0 + np.exp(-log_odds)))


@dataclass(frozen=True)
class Distribution:
    """The distribution of a quantity: probabilities of equally spaced values of a coordinate.

    Attributes
    ----------
    x : (N,) array
        The equally spaced values of the grid.
    weight : (N,) array
        The probability of each value; those at both ends stand for half an interval.
    transform : callable
        Returns the quantity for values of x, such as a probability for its log odds.
    """

    x: Float
    weight: Float
    transform: Transform = np.asarray

    @cached_property
    def _interpolated(self) -> tuple[Float, Float]:
        """Values of x and their probabilities, from a spline of the log density.

        Sums over the grid itself would be wrong if its points are as far apart as the distribution
        is wide, or if a bound cuts the distribution off.
        """
        from scipy.interpolate import CubicSpline

        # Leave out the tails, whose logarithms would make the spline oscillate, but keep enough
        # points for a cubic spline.
        first, last = np.flatnonzero(self.weight > NEGLIGIBLE_WEIGHT * self.weight.max())[[0, -1]]
        count = max(SPLINE_POINTS, last - first + 1)
        begin = min(first, len(self.x) - count)
        end = begin + count
        x = self.x[begin:end]
        fine_x = np.linspace(x[0], x[-1], FINE_POINTS)
        # The weights at both ends are those of half an interval: double them for the density.
        density = self.weight.copy()
        density[[0, -1]] *= 2.0
        log_density = np.log(np.maximum(density[begin:end], NEGLIGIBLE_WEIGHT * density.max()))
        fine_density = np.exp(CubicSpline(x, log_density)(fine_x) - log_density.max())
        fine_density[[0, -1]] *= 0.5  # the ends of the fine grid have half an interval, too
        return fine_x, fine_density / fine_density.sum()

    @property
    def mean(self) -> float:
        """The mean of the quantity."""
        x, probability = self._interpolated
        return float(probability @ self.transform(x))

    @property
    def standard_deviation(self) -> float:
        """The standard deviation of the quantity."""
        x, probability = self._interpolated
        return float(np.sqrt(probability @ (self.transform(x) - self.mean) ** 2))

    @property
    def summary(self) -> dict[str, float]:
        """Mean, standard deviation and central 95 % interval, as a record."""
        low, high = self.interval()
        return {
            "mean": self.mean,
            "standard_deviation": self.standard_deviation,
            "lower_95": low,
            "upper_95": high,
        }

    def interval(self, probability: float = 0.95) -> tuple[float, float]:
        """Return the ends of the central interval with the given probability."""
        x, probability_of_x = self._interpolated
        # Half of the probability of a value lies below it.
        cumulative = np.cumsum(probability_of_x) - 0.5 * probability_of_x
        levels = [0.5 - probability / 2.0, 0.5 + probability / 2.0]
        low, high = self.transform(np.interp(levels, cumulative, x)).tolist()
        return low, high


def resolve_density(
    log_density: LogDensity, widest_axes: Axes, first_axes: Axes | None = None
) -> tuple[Axes, Float]:
    """Find a grid that resolves a density, by narrowing the axes of a wide grid step by step.

    A grid resolves a density if the spacing of each axis is small compared with the standard
    deviation of its marginal, and if at least a third of the points of each axis is relevant.

    Parameters
    ----------
    log_density : callable
        Returns the logarithm of the density at all points of a grid.
    widest_axes : tuple of (N,) array
        The widest axes.
    first_axes : tuple of (N,) array, optional
        Narrower axes that presumably contain the density, with which the search begins.

    Returns
    -------
    axes : tuple of (N,) array
        Axes with as many points, within the widest ones.
    values : (N, ..., N) array
        The logarithm of the density at their points.
    """
    bounds = [(axis[0], axis[-1]) for axis in widest_axes]
    axes = widest_axes if first_axes is None else first_axes
    values = log_density(axes)
    while _is_cut_off(axes, values, bounds):
        axes = _twice_as_wide(axes, bounds)
        values = log_density(axes)
    while True:
        weight = cell_probabilities(values)
        # For each axis: the range of its relevant points, whether this range is notably shorter,
        # and whether the grid is fine enough.
        ranges = []
        would_shrink = False
        is_resolved = True
        for number, axis in enumerate(axes):
            other_axes = tuple(
                other_number for other_number in range(len(axes)) if other_number != number
            )
            profile = values.max(axis=other_axes)
            relevant = np.flatnonzero(profile > values.max() - RELEVANT_DROP)
            # Each end of the range is moved outwards by three quarters of a step. With a whole
            # step, the range of a grid of few points would hardly become smaller than the axis.
            step = axis[1] - axis[0]
            lowest, highest = bounds[number]
            low = max(lowest, axis[relevant[0]] - 0.75 * step)
            high = min(highest, axis[relevant[-1]] + 0.75 * step)
            ranges.append((low, high))
            would_shrink |= bool(high - low <= LEAST_SHRINKAGE * (axis[-1] - axis[0]))
            marginal = weight.sum(axis=other_axes)
            deviation = np.sqrt(marginal @ (axis - marginal @ axis) ** 2)
            is_fine = bool(step <= RESOLVED_SPACING * deviation)
            is_resolved &= is_fine and len(relevant) >= len(axis) // 3
        if is_resolved or not would_shrink:
            return axes, values
        axes = tuple(
            np.linspace(low, high, len(axis))
            for (low, high), axis in zip(ranges, axes, strict=True)
        )
        values = log_density(axes)


def _is_cut_off(axes: Axes, values: Float, bounds: Sequence[tuple[float, float]]) -> bool:
    """Return whether the density is relevant at an end of an axis that is not a bound."""
    is_relevant = values > values.max() - RELEVANT_DROP
    for number, (axis, (lowest, highest)) in enumerate(zip(axes, bounds, strict=True)):
        at_start, at_end = np.moveaxis(is_relevant, number, 0)[[0, -1]]
        if (axis[0] > lowest and at_start.any()) or (axis[-1] < highest and at_end.any()):
            return True
    return False


def _twice_as_wide(axes: Axes, bounds: Sequence[tuple[float, float]]) -> Axes:
    """Return axes of twice the length with the same centres, within their bounds."""
    wider_axes = []
    for axis, (lowest, highest) in zip(axes, bounds, strict=True):
        half_length = 0.5 * (axis[-1] - axis[0])
        low = max(lowest, axis[0] - half_length)
        high = min(highest, axis[-1] + half_length)
        wider_axes.append(np.linspace(low, high, len(axis)))
    return tuple(wider_axes)


def cell_probabilities(log_density: Float) -> Float:
    """Return the probability of each point of a grid, from its log density.

    This is the trapezoidal rule: the first and the last point of an axis have half an interval.
    """
    weight = np.exp(log_density - log_density.max())
    for axis in range(weight.ndim):
        np.moveaxis(weight, axis, 0)[[0, -1]] *= 0.5
    return np.asarray(weight / weight.sum())


def marginal_distributions(
    weight: Float, axes: Axes, transforms: Sequence[Transform]
) -> tuple[Distribution, ...]:
    """Return the marginal distribution of each axis of a grid.

    Parameters
    ----------
    weight : (N, ..., N) array
        The probability of each point.
    transforms : sequence of callable
        For each axis, a function that returns the quantity for its values.
    """
    marginals = []
    for number, (axis, transform) in enumerate(zip(axes, transforms, strict=True)):
        other_axes = tuple(
            other_number for other_number in range(weight.ndim) if other_number != number
        )
        marginals.append(Distribution(axis, weight.sum(axis=other_axes), transform))
    return tuple(marginals)
