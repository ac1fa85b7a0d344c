"""Mean and spread of a parameter over the assets of a fleet: a normal population, whole in its posterior."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Line", "population"]

Float = NDArray[np.float64]

POINTS = 41
"""Of each axis."""
BELOW = 13.0
"""A value counts whose log density is lower than the largest by no more: five deviations of a normal."""
FEWEST = 15
"""Points that count: those of a normal are then closer than its deviation, where sums are exact."""
FREEDOM = 4.0
"""Of the prior of a spread: twice the scale, or none of it, are nothing unusual."""
FINE = 4
"""Values between two nodes of a member's evidence."""


@dataclass(frozen=True)
class Line:
    """Posterior of one figure on equally spaced values.

    Attributes
    ----------
    values, weight : (n,)
    """

    values: Float
    weight: Float

    @property
    def mean(self) -> float:
        """Mean."""
        return float(self.weight @ self.values)

    @property
    def standard_deviation(self) -> float:
        """Standard deviation."""
        return float(np.sqrt(self.weight @ (self.values - self.mean) ** 2))

    def interval(self, probability: float = 0.95) -> tuple[float, float]:
        """Return the bounds of the central interval: half of a value's weight lies below it."""
        below = np.cumsum(self.weight) - 0.5 * self.weight
        low, high = np.interp([0.5 - probability / 2.0, 0.5 + probability / 2.0], below, self.values)
        return float(low), float(high)


def population(nodes: Float, log_evidence: Float, scale: float) -> tuple[Line, Line]:
    """Return the posterior of mean m and spread s of a normal population of which B members were seen.

    Before the data m is uniform over the nodes, and s half-t with 4 degrees of freedom (Gelman 2006, Bayesian
    Analysis 1, section 7: weak where there are few groups). Both are summed over together, as far as they
    matter: with few members s may be much larger than what the sample shows.

    Parameters
    ----------
    nodes : (E,)
        Equally spaced values of the parameter.
    log_evidence : (B, E)
        Of each member at each value.
    scale : float
        Of the prior of the spread.
    """
    from scipy.interpolate import CubicSpline

    fine = np.linspace(nodes[0], nodes[-1], FINE * (len(nodes) - 1) + 1)
    known = log_evidence[np.isfinite(log_evidence).all(axis=1)]
    known = np.maximum(known - known.max(axis=1, keepdims=True), -700.0)
    likelihood = np.exp(CubicSpline(nodes, known, axis=1)(fine))
    likelihood /= likelihood.sum(axis=1, keepdims=True)
    best, step = likelihood @ fine, fine[1] - fine[0]
    middle, wide = float(best.mean()), float(best.std()) + 2.0 * step
    far = 8.0 * wide / np.sqrt(len(known))
    limits = (nodes[0], nodes[-1]), (0.25 * step, 0.5 * (nodes[-1] - nodes[0]))
    windows = [
        (max(middle - far, nodes[0]), min(middle + far, nodes[-1])),
        (limits[1][0], 3.0 * wide + 8.0 * scale / len(known)),
    ]
    while True:
        means, spreads = (np.linspace(*window, POINTS) for window in windows)
        density = _density(likelihood, fine, means, spreads)
        density -= 0.5 * (FREEDOM + 1.0) * np.log1p((spreads / scale) ** 2 / FREEDOM)
        joint = np.exp(density - density.max())
        joint[:, [0, -1]] *= 0.5
        weights = joint.sum(axis=1) / joint.sum(), joint.sum(axis=0) / joint.sum()
        pairs = zip((means, spreads), weights, limits, strict=True)
        wanted = [_window(values, weight, limit) for values, weight, limit in pairs]
        if wanted == windows:
            return Line(means, weights[0]), Line(spreads, weights[1])
        windows = wanted


def _density(likelihood: Float, fine: Float, means: Float, spreads: Float) -> Float:
    """Return the log density of B members (B, F) for means and spreads, up to a constant: (M, P)."""
    from scipy.special import ndtr

    edges = np.append(fine, 2.0 * fine[-1] - fine[-2]) - 0.5 * (fine[1] - fine[0])
    density = np.empty((len(means), len(spreads)))
    for column, spread in enumerate(spreads):
        below = ndtr((edges[:, None] - means) / spread)
        density[:, column] = np.log(np.maximum(likelihood @ np.diff(below, axis=0), 1e-300)).sum(axis=0)
    return density


def _window(values: Float, weight: Float, limits: tuple[float, float]) -> tuple[float, float]:
    """Return where to look at an axis: the same where it holds all that counts, and resolves it."""
    inside = np.flatnonzero(weight > np.exp(-BELOW) * weight.max())
    first, last, step = int(inside[0]), int(inside[-1]), values[1] - values[0]
    low, high = float(values[0]), float(values[-1])
    if len(inside) < FEWEST:
        low, high = values[first] - step, values[last] + step
    half = 0.5 * (values[-1] - values[0])
    if first == 0:
        low = values[0] - half
    if last == len(values) - 1:
        high = values[-1] + half
    return max(float(low), limits[0]), min(float(high), limits[1])
