"""Posteriors of probabilities that groups share, and of mean and deviation of populations."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from reporting.arrays import Float
from twin_master.fleet.learning.grid_density import (
    Axes,
    Distribution,
    LogDensity,
    cell_probabilities,
    logistic,
    logit,
    marginal_distributions,
    resolve_density,
)

GRID_POINTS = {1: 17, 2: 13, 3: 9, 4: 7}
"""Points of each axis of the grid of probabilities, by the number of axes."""
LOWEST, HIGHEST = 1e-4, 0.9
"""Bounds of a probability of worsening, which keep its log odds finite."""
SHARED_POINTS = 121
"""Points of each axis of a group, and of the mean of the distribution that groups share."""
CONCENTRATION_POINTS = 13
"""Points of the concentration of the distribution that groups share."""
LOWEST_CONCENTRATION, HIGHEST_CONCENTRATION = 3.0, 3000.0
LEAST_LOG_LIKELIHOOD = -60.0
"""Log likelihood, relative to its maximum, to which a group's grid is cut before interpolation."""
POPULATION_POINTS = 41
"""Points of the mean and of the standard deviation of a population."""
PRIOR_FREEDOM = 4.0
"""Degrees of freedom of the half-t prior of a population's standard deviation.

Few degrees of freedom give it a heavy tail, so that large deviations remain possible.
"""
POINTS_BETWEEN_NODES = 4
"""Number of intervals into which each interval between two nodes of the evidence is divided."""
LEAST_PRIOR_WIDTH = 2.0 / 3.0
"""Least standard deviation of the prior of a member, over the distance between two of its values.

With this width the mean over the values is that of the normal distribution to 1e-3 of the distance.
"""
LEAST_LOG_EVIDENCE = -700.0
"""Log evidence, relative to its maximum, below which the exponential function would underflow."""
_MEMBERS_TOGETHER = 1024
"""Members whose evidence in all populations is computed in one product of matrices, 14 MB.

Threads of the product that wait for each other cost more than the product of a few members.
"""
_TINY = 1e-300
"""Smallest number whose logarithm is taken."""


@dataclass(frozen=True)
class LikelihoodGrid:
    """The log likelihood of K probabilities on a tensor grid of their log odds.

    Attributes
    ----------
    axes : tuple of (N,) array
        The log odds of each probability.
    log_likelihood : (N, ..., N) array
        The log likelihood at each point.
    """

    axes: Axes
    log_likelihood: Float

    @property
    def marginals(self) -> tuple[Distribution, ...]:
        """The posterior of each probability under a uniform prior."""
        log_density = self.log_likelihood + _log_uniform_prior(self.axes)
        return marginal_distributions(
            cell_probabilities(log_density), self.axes, [logistic] * len(self.axes)
        )


def _log_uniform_prior(axes: Axes) -> Float:
    """Return the log prior density of log odds if the probabilities p are uniform.

    The density of log odds is that of p times dp / d(log odds) = p (1 - p).
    """
    log_odds = np.meshgrid(*axes, indexing="ij")
    return np.asarray(sum(np.log(logistic(x) * logistic(-x)) for x in log_odds))


def likelihood_grid(
    log_likelihood: LogDensity, count: int, first_axes: Axes | None = None
) -> LikelihoodGrid:
    """Return the likelihood of K probabilities on a grid that resolves their posterior.

    The prior is uniform in the probabilities. The axes of the grid are log odds.

    Parameters
    ----------
    log_likelihood : callable
        Returns the log likelihood at all points of a grid of log odds.
    first_axes : tuple of (N,) array, optional
        The log odds at which the search for the grid starts; by default the whole range.
    """

    def log_posterior(axes: Axes) -> Float:
        """Return the log posterior density of the log odds at all points of a grid."""
        return log_likelihood(axes) + _log_uniform_prior(axes)

    lowest_log_odds = logit(np.array(LOWEST))
    highest_log_odds = logit(np.array(HIGHEST))
    widest_axis = np.linspace(lowest_log_odds, highest_log_odds, GRID_POINTS[count])
    axes, log_density = resolve_density(log_posterior, (widest_axis,) * count, first_axes)
    return LikelihoodGrid(axes, log_density - _log_uniform_prior(axes))


@dataclass(frozen=True)
class SharedPosterior:
    """The posterior of K probabilities that differ between groups and share a distribution.

    Attributes
    ----------
    hyperparameters : list of dict
        For each probability, mean and standard deviation of the mean over groups, and of the
        decimal logarithm of the concentration.
    groups : list of tuple of Distribution
        For each group, the posterior of its K probabilities.
    """

    hyperparameters: list[dict[str, float]]
    groups: list[tuple[Distribution, ...]]


def shared_posterior(grids: Sequence[LikelihoodGrid]) -> SharedPosterior:
    """Infer the Beta distribution that the probabilities of several groups share.

    A probability of a group has the distribution Beta(m kappa, (1 - m) kappa) with the mean m and
    the concentration kappa, which are the hyperparameters. Their prior is uniform in the log odds
    of m, between the bounds of a probability, and in the logarithm of kappa. Each group has axes of
    its own for its probabilities, because the posterior of a group with many twins can be a
    thousand times narrower than that of a group with few.

    Parameters
    ----------
    grids : sequence of LikelihoodGrid
        The log likelihood of each group, of the same K = 1 or 2 probabilities.
    """
    count = len(grids[0].axes)
    mean_axis = np.linspace(
        float(logit(np.array(LOWEST))), float(logit(np.array(HIGHEST))), SHARED_POINTS
    )
    concentration_axis = np.linspace(
        np.log10(LOWEST_CONCENTRATION), np.log10(HIGHEST_CONCENTRATION), CONCENTRATION_POINTS
    )
    groups = [_group_on_axes(grid, mean_axis, concentration_axis) for grid in grids]
    # Evidence of all groups at each pair of hyperparameters (H, H), or (H, 1) for one probability.
    log_evidence = np.sum([np.log(np.maximum(group.evidence, _TINY)) for group in groups], axis=0)
    shape = (len(mean_axis), len(concentration_axis)) * count
    hyper_weight = cell_probabilities(log_evidence.reshape(shape))
    weight = hyper_weight.reshape(log_evidence.shape)
    marginals = marginal_distributions(
        hyper_weight, (mean_axis, concentration_axis) * count, (logistic, np.asarray) * count
    )
    records = []
    for mean, concentration in zip(marginals[::2], marginals[1::2], strict=True):
        records.append(
            {
                "mean": mean.mean,
                "standard_deviation": mean.standard_deviation,
                "log10_concentration": concentration.mean,
                "log10_concentration_standard_deviation": concentration.standard_deviation,
            }
        )
    return SharedPosterior(
        hyperparameters=records,
        groups=[group.posterior(weight) for group in groups],
    )


@dataclass(frozen=True)
class _GroupOnAxes:
    """A group's likelihood, and the priors of its probabilities for all hyperparameters.

    P is `SHARED_POINTS`, and H the number of pairs of mean and concentration. If there is only one
    probability, the second one is a placeholder with a single value and the density 1.

    Attributes
    ----------
    axes : tuple of (P,) array
        The log odds of its K probabilities.
    prior_of_first : (H, P) array
        The density of the first probability for each pair of hyperparameters.
    prior_of_second : (H, P) or (1, 1) array
        The same for the second probability.
    """

    axes: Axes
    likelihood: Float
    prior_of_first: Float
    prior_of_second: Float

    @cached_property
    def evidence(self) -> Float:
        """The evidence of the group for hyperparameters of both probabilities, (H, H) or (H, 1)."""
        return self.prior_of_first @ self.likelihood @ self.prior_of_second.T

    def posterior(self, hyper_weight: Float) -> tuple[Distribution, ...]:
        """Return the posterior of the probabilities, averaged over weighted hyperparameters.

        The weights, (H, H) or (H, 1), are the posterior of the hyperparameters given all groups.
        """
        # With the hyperparameters h, and the group's probabilities p and data d:
        # p(p | all data) = p(d | p) * sum over h of p(p | h) p(h | all data) / p(d | h).
        posterior_over_evidence = hyper_weight / np.maximum(self.evidence, _TINY)
        mixed_prior = self.prior_of_first.T @ posterior_over_evidence @ self.prior_of_second
        joint = self.likelihood * mixed_prior
        joint /= joint.sum()
        count = len(self.axes)
        shape = (SHARED_POINTS,) * count
        return marginal_distributions(joint.reshape(shape), self.axes, [logistic] * count)


def _group_on_axes(
    grid: LikelihoodGrid, mean_axis: Float, concentration_axis: Float
) -> _GroupOnAxes:
    """Return a group's likelihood on fine axes, and its prior for each pair of hyperparameters.

    `mean_axis` (M,) holds log odds, `concentration_axis` (C,) decimal logarithms; they have
    H = M C pairs.
    """
    axes = tuple(np.linspace(axis[0], axis[-1], SHARED_POINTS) for axis in grid.axes)
    mean, concentration = np.meshgrid(logistic(mean_axis), 10.0**concentration_axis, indexing="ij")
    a = mean.ravel() * concentration.ravel()
    b = (1.0 - mean.ravel()) * concentration.ravel()
    is_single = len(axes) == 1
    return _GroupOnAxes(
        axes=axes,
        likelihood=_interpolated_likelihood(grid, axes),
        prior_of_first=_beta_density(axes[0], a, b),
        prior_of_second=np.ones((1, 1)) if is_single else _beta_density(axes[1], a, b),
    )


def _beta_density(log_odds: Float, a: Float, b: Float) -> Float:
    """Return H densities Beta(a, b) as densities of log odds (P,), an (H, P) array.

    The density of log odds is that of p times p (1 - p), so its exponents are a and b instead of a
    - 1 and b - 1.
    """
    from scipy.special import betaln

    p = logistic(log_odds)
    log_density = a[:, None] * np.log(p) + b[:, None] * np.log1p(-p) - betaln(a, b)[:, None]
    return np.asarray(np.exp(log_density))


def _interpolated_likelihood(grid: LikelihoodGrid, axes: Axes) -> Float:
    """Interpolate the log likelihood of a group to finer axes, and return normalised weights.

    There are P = `SHARED_POINTS` points on each axis; the result is (P, P), or (P, 1) for one
    probability.
    """
    from scipy.interpolate import RegularGridInterpolator

    # Large negative logarithms, where the likelihood is practically 0, would make the cubic spline
    # oscillate: cut them off.
    relative_log_likelihood = grid.log_likelihood - grid.log_likelihood.max()
    cut_log_likelihood = np.maximum(relative_log_likelihood, LEAST_LOG_LIKELIHOOD)
    interpolate = RegularGridInterpolator(grid.axes, cut_log_likelihood, method="cubic")
    fine_points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    weights = cell_probabilities(interpolate(fine_points))
    return weights.reshape(SHARED_POINTS, -1)


@dataclass(frozen=True)
class PopulationPosterior:
    """The posterior of the mean and of the standard deviation of a normal population."""

    mean: Distribution
    deviation: Distribution

    def prior_of_member(self, nodes: Float) -> Float:
        """Return the prior probabilities (E,) of E equally spaced values of a member's parameter.

        The prior is normal, with the variance of the posterior predictive: the expected variance of
        the population plus the variance of its mean. It has a least width, because nearly all of a
        prior that is narrower than the distance of two values would fall on a single value.
        """
        predictive_variance = (
            self.deviation.mean**2
            + self.deviation.standard_deviation**2
            + self.mean.standard_deviation**2
        )
        least_deviation = LEAST_PRIOR_WIDTH * (nodes[1] - nodes[0])
        variance = max(predictive_variance, least_deviation**2)
        weight = np.exp(-0.5 * (nodes - self.mean.mean) ** 2 / variance)
        return np.asarray(weight / weight.sum())


def population_posterior(
    nodes: Float, log_evidence: Iterable[Float], scale: float
) -> PopulationPosterior:
    """Infer mean and standard deviation of a normal population from observed members.

    A parameter of the members is distributed normally in the population. The prior of the mean is
    uniform over the range of the nodes. The prior of the standard deviation is a half-t
    distribution with `PRIOR_FREEDOM` degrees of freedom (Gelman 2006).

    Parameters
    ----------
    nodes : (E,) array
        Equally spaced values of the parameter.
    log_evidence : iterable of (B, E) array
        The log evidence of each member's observations at each of these values, some members at a
        time. It is iterated over several times.
    scale : float
        The scale of the prior of the standard deviation.
    """
    from scipy.special import ndtr

    count = POINTS_BETWEEN_NODES * (len(nodes) - 1) + 1
    values = np.linspace(nodes[0], nodes[-1], count)
    step = values[1] - values[0]
    # Each value stands for the interval between two edges half a step away.
    edges = np.append(values, values[-1] + step) - 0.5 * step

    def log_density(axes: Axes) -> Float:
        """Return the log posterior (means, deviations) of the population, up to a constant."""
        means, deviations = axes
        # The probability of each value, in rows, in each population, in columns: all means with the
        # first deviation, all means with the second one, and so on.
        probabilities = np.hstack(
            [
                np.diff(ndtr((edges[:, None] - means) / deviation), axis=0)
                for deviation in deviations
            ]
        )
        log_likelihood = np.zeros(len(deviations) * len(means))
        for log_evidence_of_members in log_evidence:
            likelihood = _member_likelihood(nodes, log_evidence_of_members, values)
            for first in range(0, len(likelihood), _MEMBERS_TOGETHER):
                evidence = likelihood[first : first + _MEMBERS_TOGETHER] @ probabilities
                log_likelihood += np.log(np.maximum(evidence, _TINY)).sum(axis=0)
        # The density of Student's t is (1 + (x / scale)^2 / freedom)^(-(freedom + 1) / 2).
        log_prior = (
            -0.5 * (PRIOR_FREEDOM + 1.0) * np.log1p((deviations / scale) ** 2 / PRIOR_FREEDOM)
        )
        return log_likelihood.reshape(len(deviations), len(means)).T + log_prior

    mean_axis = np.linspace(nodes[0], nodes[-1], POPULATION_POINTS)
    deviation_axis = np.linspace(0.25 * step, 0.5 * (nodes[-1] - nodes[0]), POPULATION_POINTS)
    # Grid on which the posterior is well resolved, with the probability of each of its points
    axes, log_values = resolve_density(log_density, (mean_axis, deviation_axis))
    weight = cell_probabilities(log_values)
    # Both axes are the quantities themselves, so that no transformation is needed.
    mean, deviation = marginal_distributions(weight, axes, (np.asarray, np.asarray))
    return PopulationPosterior(mean, deviation)


def _member_likelihood(nodes: Float, log_evidence: Float, values: Float) -> Float:
    """Return the normalised likelihood (at most B, V) of each member at finer parameter values.

    The log evidence (B, E) at the nodes is interpolated. Members whose observations are impossible
    at a node are left out.
    """
    from scipy.interpolate import CubicSpline

    finite_log_evidence = log_evidence[np.isfinite(log_evidence).all(axis=1)]
    relative_log_evidence = finite_log_evidence - finite_log_evidence.max(axis=1, keepdims=True)
    relative_log_evidence = np.maximum(relative_log_evidence, LEAST_LOG_EVIDENCE)
    likelihood = np.exp(CubicSpline(nodes, relative_log_evidence, axis=1)(values))
    likelihood /= likelihood.sum(axis=1, keepdims=True)
    return np.asarray(likelihood)
