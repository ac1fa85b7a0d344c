"""Posteriors on grids, narrowed until they are resolved: of probabilities, and of populations."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import cycle, product

import numpy as np

from reporting.arrays import Float

Axes = tuple[Float, ...]

POINTS = {1: 17, 2: 13, 3: 9, 4: 7}
"""Points of each axis of the grid of probabilities, by the number of axes."""
LOWEST, HIGHEST = 1e-4, 0.9
"""Probabilities between which is looked."""
BELOW = 13.0
"""A point counts whose log density is lower than the largest by no more: five deviations of a normal."""
RESOLVED = 1.2
"""Spacing of a grid as a share of the standard deviation at which its sums are exact to 1e-6."""
NOTHING = 1e-9
"""Share of the largest weight below which the tails of an interval are cut."""
FINE = 121
"""Points of each axis of a group, and of the mean of the distribution that groups share."""
POPULATION_POINTS = 41
"""Of mean and spread of a population."""
FREEDOM = 4.0
"""Of the prior of a spread: twice the scale, or none of it, are nothing unusual."""
BETWEEN_NODES = 4
"""Values between two nodes of a member's evidence."""


def logit(p: Float) -> Float:
    """Return log p / (1 - p)."""
    return np.asarray(np.log(p) - np.log1p(-p))


def logistic(x: Float) -> Float:
    """Return the probability of a log odds."""
    return np.asarray(1.0 / (1.0 + np.exp(-x)))


@dataclass(frozen=True)
class Line:
    """Distribution of one figure.

    Attributes
    ----------
    x : (N,)
        Equally spaced.
    weight : (N,)
        Probability of each, of `masses`.
    of : callable
        Returns the figure for x: a probability for its log odds.
    """

    x: Float
    weight: Float
    of: Callable[[Float], Float] = np.asarray

    @cached_property
    def _fine(self) -> tuple[Float, Float]:
        """Return many values of x and their shares: the cubic through the log density, between the bounds.

        Where the spacing is as wide as the distribution, or a bound cuts it off, sums over x alone are wrong.
        """
        from scipy.interpolate import CubicSpline

        # Where there is nothing, the logarithm would make the spline swing.
        inside = np.flatnonzero(self.weight > NOTHING * self.weight.max())
        part = slice(max(0, min(inside[0], len(self.x) - 4)), max(4, inside[-1] + 1))
        fine = np.linspace(self.x[part][0], self.x[part][-1], 2001)
        density = self.weight.copy()
        density[[0, -1]] *= 2.0
        log_weight = np.log(np.maximum(density[part], NOTHING * density.max()))
        density = np.exp(CubicSpline(self.x[part], log_weight)(fine) - log_weight.max())
        density[[0, -1]] *= 0.5
        return fine, density / density.sum()

    @property
    def mean(self) -> float:
        """Mean of the figure."""
        fine, share = self._fine
        return float(share @ self.of(fine))

    @property
    def standard_deviation(self) -> float:
        """Standard deviation of the figure."""
        fine, share = self._fine
        return float(np.sqrt(share @ (self.of(fine) - self.mean) ** 2))

    @property
    def figures(self) -> dict[str, float]:
        """Mean, standard deviation and central 95 % interval."""
        low, high = self.interval()
        moments = {"mean": self.mean, "standard_deviation": self.standard_deviation}
        return moments | {"lower_95": low, "upper_95": high}

    def interval(self, probability: float = 0.95) -> tuple[float, float]:
        """Return the bounds of the central interval."""
        fine, share = self._fine
        reached = np.cumsum(share) - 0.5 * share
        bounds = np.interp([0.5 - probability / 2.0, 0.5 + probability / 2.0], reached, fine)
        low, high = self.of(bounds).tolist()
        return low, high


def narrowed(log_density: Callable[[Axes], Float], axes: Axes) -> tuple[Axes, Float]:
    """Return axes that resolve a density within the ones that are given, and its logarithm on them."""
    limits, numbers = [(axis[0], axis[-1]) for axis in axes], range(len(axes))
    while True:
        found = log_density(axes)
        weight, bounds, resolved = masses(found), [], True
        for k, (axis, (low, high)) in enumerate(zip(axes, limits, strict=True)):
            others = tuple(other for other in numbers if other != k)
            inside, step = np.flatnonzero(found.max(axis=others) > found.max() - BELOW), axis[1] - axis[0]
            # With a whole step more grids of few points would stay too wide.
            bounds.append(
                (max(low, axis[inside[0]] - 0.75 * step), min(high, axis[inside[-1]] + 0.75 * step))
            )
            marginal = weight.sum(axis=others)
            spread = np.sqrt(marginal @ (axis - marginal @ axis) ** 2)
            resolved &= bool(step <= RESOLVED * spread) and len(inside) >= len(axis) // 3
        # Where the next grid would be no finer, this is what can be had (a posterior at the bounds).
        if resolved or all(b - a > 0.95 * (x[-1] - x[0]) for (a, b), x in zip(bounds, axes, strict=True)):
            return axes, found
        axes = tuple(np.linspace(a, b, len(x)) for (a, b), x in zip(bounds, axes, strict=True))


@dataclass(frozen=True)
class Grid:
    """Log likelihood of K probabilities on a tensor grid of their log odds.

    Attributes
    ----------
    axes : tuple of (N,)
        Log odds of each probability.
    log_likelihood : (N, ..., N)
        At each point.
    """

    axes: Axes
    log_likelihood: Float

    @property
    def marginals(self) -> tuple[Line, ...]:
        """Posterior of each probability under a uniform prior."""
        log_density = self.log_likelihood + _uniform(self.axes)
        return lines(masses(log_density), self.axes, logistic)


def _uniform(axes: Axes) -> Float:
    """Return the log density of uniform probabilities in their log odds."""
    meshed = np.meshgrid(*axes, indexing="ij")
    return np.asarray(sum(np.log(logistic(x) * logistic(-x)) for x in meshed))


def masses(log_density: Float) -> Float:
    """Return the probability of each point of a grid; those at bounds have half an interval."""
    weight = np.exp(log_density - log_density.max())
    for axis in range(weight.ndim):
        np.moveaxis(weight, axis, 0)[[0, -1]] *= 0.5
    return np.asarray(weight / weight.sum())


def lines(weight: Float, axes: Axes, *of: Callable[[Float], Float]) -> tuple[Line, ...]:
    """Return the marginals of weights on a grid, of figures that the functions give in turn."""
    others = (tuple(i for i in range(weight.ndim) if i != k) for k in range(weight.ndim))
    sums = zip(axes, others, cycle(of), strict=False)
    return tuple(Line(axis, weight.sum(axis=other), own) for axis, other, own in sums)


def refined(log_likelihood: Callable[[Float], Float], count: int) -> Grid:
    """Return a grid that resolves the posterior of K probabilities.

    Parameters
    ----------
    log_likelihood : callable
        Returns it at points (P, K): (P,).
    count : int
        K, from 1 to 4.
    """
    shape = (POINTS[count],) * count

    def density(axes: Axes) -> Float:
        points = np.array(list(product(*axes)))
        return log_likelihood(logistic(points)).reshape(shape) + _uniform(axes)

    axis = np.linspace(logit(np.array(LOWEST)), logit(np.array(HIGHEST)), POINTS[count])
    axes, found = narrowed(density, (axis,) * count)
    return Grid(axes, found - _uniform(axes))


def shared(grids: Sequence[Grid]) -> tuple[list[dict[str, float]], list[tuple[Line, ...]]]:
    """Infer Beta(m kappa, (1 - m) kappa) of one or two probabilities over groups, and each group under it.

    m is uniform in its log odds between the bounds of a probability, and kappa in its logarithm, from 3 to
    3000, before the data. Each group is summed over axes of its own: one that is known well is a thousand
    times narrower than one of few twins.

    Parameters
    ----------
    grids : sequence of Grid
        Log likelihood of each group, of the same K = 1 or 2 probabilities.

    Returns
    -------
    tuple of two lists
        Figures of m and of log10 kappa for each of the K probabilities; the probabilities of each group.
    """
    from scipy.special import betaln

    count = len(grids[0].axes)
    axes = [tuple(np.linspace(axis[0], axis[-1], FINE) for axis in grid.axes) for grid in grids]
    likelihoods = [_resampled(grid, own) for grid, own in zip(grids, axes, strict=True)]
    low, high = (float(logit(np.array(bound))) for bound in (LOWEST, HIGHEST))
    odds, digits = np.linspace(low, high, FINE), np.linspace(np.log10(3.0), np.log10(3000.0), 13)
    means, sizes = (array.ravel() for array in np.meshgrid(logistic(odds), 10.0**digits, indexing="ij"))
    a, b = means * sizes, (1.0 - means) * sizes

    def density(x: Float) -> Float:
        """In the log odds: that in p times p (1 - p). (hyperparameters, points)."""
        p = logistic(x)
        return np.asarray(np.exp(a[:, None] * np.log(p) + b[:, None] * np.log1p(-p) - betaln(a, b)[:, None]))

    # One probability is two, of which the second says nothing.
    priors = [[*(density(x) for x in own), np.ones((1, 1))][:2] for own in axes]
    evidence = [first @ seen @ second.T for (first, second), seen in zip(priors, likelihoods, strict=True)]
    total = np.sum([np.log(np.maximum(one, 1e-300)) for one in evidence], axis=0)
    hyper = masses(total.reshape((len(odds), len(digits)) * count))
    weight = hyper.reshape(total.shape)
    groups = []
    for own, (first, second), seen, told in zip(axes, priors, likelihoods, evidence, strict=True):
        joint = seen * (first.T @ (weight / np.maximum(told, 1e-300)) @ second)
        joint /= joint.sum()
        groups.append(lines(joint.reshape((FINE,) * count), own, logistic))
    found = lines(hyper, (odds, digits) * count, logistic, np.asarray)
    figures = [
        {
            "mean": mean.mean,
            "standard_deviation": mean.standard_deviation,
            "log10_concentration": size.mean,
            "log10_concentration_standard_deviation": size.standard_deviation,
        }
        for mean, size in zip(found[::2], found[1::2], strict=True)
    ]
    return figures, groups


def _resampled(grid: Grid, axes: tuple[Float, ...]) -> Float:
    """Return the likelihood of a grid, times intervals, on finer axes of the same range, FINE points each."""
    from scipy.interpolate import RegularGridInterpolator

    # Far below the largest there is nothing but what would make the spline swing.
    log_likelihood = np.maximum(grid.log_likelihood - grid.log_likelihood.max(), -60.0)
    fine = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return masses(RegularGridInterpolator(grid.axes, log_likelihood, method="cubic")(fine)).reshape(FINE, -1)


def population(nodes: Float, log_evidence: Float, scale: float) -> tuple[Line, Line]:
    """Return the posterior of mean m and spread s of a normal population of which B members were seen.

    Parameters
    ----------
    nodes : (E,)
        Equally spaced values of the parameter.
    log_evidence : (B, E)
        Of what was observed of each member, if its parameter is a node.
    scale : float
        Of the prior of s, half a Student's t of four degrees of freedom; that of m is uniform.
    """
    from scipy.interpolate import CubicSpline
    from scipy.special import ndtr

    fine = np.linspace(nodes[0], nodes[-1], BETWEEN_NODES * (len(nodes) - 1) + 1)
    step = fine[1] - fine[0]
    known = log_evidence[np.isfinite(log_evidence).all(axis=1)]
    known = np.maximum(known - known.max(axis=1, keepdims=True), -700.0)
    likelihood = np.exp(CubicSpline(nodes, known, axis=1)(fine))
    likelihood /= likelihood.sum(axis=1, keepdims=True)
    edges = np.append(fine, fine[-1] + step) - 0.5 * step

    def density(axes: Axes) -> Float:
        found = np.empty((POPULATION_POINTS, POPULATION_POINTS))
        for column, spread in enumerate(axes[1]):
            share = np.diff(ndtr((edges[:, None] - axes[0]) / spread), axis=0)
            found[:, column] = np.log(np.maximum(likelihood @ share, 1e-300)).sum(axis=0)
        return found - 0.5 * (FREEDOM + 1.0) * np.log1p((axes[1] / scale) ** 2 / FREEDOM)

    limits = (nodes[0], nodes[-1]), (0.25 * step, 0.5 * (nodes[-1] - nodes[0]))
    axes, found = narrowed(density, tuple(np.linspace(*limit, POPULATION_POINTS) for limit in limits))
    mean, spread = lines(masses(found), axes, np.asarray)
    return mean, spread
