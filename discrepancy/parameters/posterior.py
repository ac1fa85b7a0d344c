"""Draws of the posterior of a model's parameters, by quadrature or from Gaussians.

A Gaussian is used only if the energy (-ln of the posterior density) agrees with it.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.interpolate import Akima1DInterpolator
from scipy.special import softmax

from calibration.result.record import Procedure
from calibration.static.posterior import stratified
from discrepancy.campaign.records import FloatArray
from discrepancy.errors import FitError, ModelError
from discrepancy.fits.cut_gaussian import TruncatedGaussian
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.parameters.marginal import MarginalPosterior

QUADRATURE_RANGE = 6.0
"""Half of the range of a quadrature about the prior mean, in prior deviations."""
NODES_PER_OPTIMUM = 9
"""Number of first nodes of a quadrature within three standard deviations of each optimum."""
NODES_OF_PRIOR = 17
"""Number of first nodes of a quadrature over the whole prior."""
INTERPOLATION_INTERVALS = 40
"""Number of intervals between two nodes at which the density is interpolated."""
LARGEST_MASS = 0.04
"""Probability between two neighbouring nodes above which a node is added between them."""
MOST_NODES = 90
"""Largest number of nodes of a quadrature."""
GAUSSIAN_CHECKS = ((1.0, 0.12), (2.0, 0.5))
"""Pairs of a distance from the mean [standard deviations] at which a Gaussian is compared with the
posterior, and the allowed error of its energy there [nat]."""
LARGEST_ENERGY = 700.0
"""Largest energy above the least one; higher energies are reduced to it, as exp(-700) is nearly the
least number of double precision [nat]."""
LEAST_NODE_DISTANCE = 1e-9
"""Distance of two nodes, as a fraction of the length of the grid, below which one is dropped."""


@dataclass(frozen=True)
class ParameterPosterior:
    """The posterior of a model's parameters given a campaign.

    Attributes
    ----------
    procedure : Procedure
        The procedure by which the draws were made.
    draws : (N, P) ndarray
        Scaled parameters of equal weight.
    optima : tuple of CandidateFit
        The maxima of the posterior, the most probable first.
    marginal : MarginalPosterior
        The posterior density.
    """

    procedure: Procedure
    draws: FloatArray
    optima: tuple[CandidateFit, ...]
    marginal: MarginalPosterior


def parameter_posterior(problem: Problem, count: int, seed: int) -> ParameterPosterior:
    """Return draws of the posterior of a problem's parameters.

    There are three procedures. A single parameter is drawn by quadrature of its density. Several
    parameters with one optimum are drawn from the Gaussian about it, truncated at the parameters'
    ranges, if the energy (-ln of the density) along its principal axes is that of a Gaussian.
    If not, the parameter of the largest
    variance is drawn by quadrature, and the others from a truncated Gaussian given its value (a
    nested Laplace approximation, Rue, Martino and Chopin 2009, J. R. Statist. Soc. B 71 (2)).
    If there are several optima, the draws are from a mixture of one Gaussian about each optimum,
    weighted by evidence.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    count : int
        The number of draws.
    seed : int
        The seed of the draws.

    Raises
    ------
    FitError, ModelError
        If the model fails at its prior mean.
    """
    marginal = MarginalPosterior(problem)
    optima = tuple(marginal.find_optima(seed))
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
    parameter_count = len(marginal.parameter_indices)
    all_fitted = np.ones(parameter_count, dtype=bool)
    gaussians = [marginal.laplace_gaussian(optimum, all_fitted) for optimum in optima]
    procedure: Procedure
    if parameter_count == 1 or (len(gaussians) == 1 and not is_gaussian(marginal, gaussians[0])):
        procedure = "quadrature"
        _, covariance = gaussians[0].moments
        least_determined = int(np.argmax(np.diag(covariance)))
        draws = _draws_by_quadrature(least_determined, marginal, optima, count, generator)
    else:
        procedure = "several optima" if len(optima) > 1 else "Gaussian"
        draws = _draws_of_gaussians(gaussians, count, generator)
    return ParameterPosterior(procedure, draws, optima, marginal)


def _draws_of_gaussians(
    gaussians: Sequence[TruncatedGaussian], count: int, generator: np.random.Generator
) -> FloatArray:
    """Return draws (count, P) from a mixture of Gaussians that are weighted by their evidence."""
    probabilities = softmax([gaussian.log_evidence for gaussian in gaussians])
    gaussian_of_draw = generator.choice(len(gaussians), count, p=probabilities)
    draws = np.empty((count, len(gaussians[0].mean)))
    for index in np.unique(gaussian_of_draw):  # a Gaussian of a small weight may have no draw
        is_from_gaussian = gaussian_of_draw == index
        draws[is_from_gaussian] = gaussians[index].draws(int(np.sum(is_from_gaussian)), generator)
    return draws


def is_gaussian(marginal: MarginalPosterior, gaussian: TruncatedGaussian) -> bool:
    """Return whether a posterior agrees with a Gaussian that is truncated at the range.

    Their energies are compared at points on the principal axes, at the distances from the mean that
    `GAUSSIAN_CHECKS` lists, or at the end of the range if that is nearer.

    Parameters
    ----------
    marginal : MarginalPosterior
        The posterior density.
    gaussian : TruncatedGaussian
        The Gaussian about its optimum.
    """
    mean, covariance = gaussian.moments
    variances, directions = np.linalg.eigh(covariance)
    standard_deviations = np.sqrt(np.maximum(variances, 0.0))
    axes = (directions * standard_deviations).T
    energy_at_mean = marginal(mean) - gaussian.energy(mean)
    for axis, (distance, allowed_error), side in product(axes, GAUSSIAN_CHECKS, (-1.0, 1.0)):
        offset = side * distance * axis
        distance_to_end = np.where(offset > 0.0, gaussian.high - mean, mean - gaussian.low)
        fraction_to_end = distance_to_end / np.maximum(np.abs(offset), 1e-300)
        fraction = min(1.0, fraction_to_end.min())
        point = mean + fraction * offset
        point = np.clip(point, gaussian.low, gaussian.high)
        error = marginal(point) - gaussian.energy(point) - energy_at_mean
        if not abs(error) < allowed_error:
            return False
    return True


def _draws_by_quadrature(
    index: int,
    marginal: MarginalPosterior,
    optima: tuple[CandidateFit, ...],
    count: int,
    generator: np.random.Generator,
) -> FloatArray:
    """Return draws of the posterior: one parameter by quadrature, and the others given its value.

    A node is a value of the one parameter. At each node the other parameters are fitted and
    integrated together with the nuisances, by a Gaussian that is truncated at the model's range.

    Parameters
    ----------
    index : int
        The index of the parameter of the quadrature.
    marginal : MarginalPosterior
        The posterior density.
    optima : tuple of CandidateFit
        Its maxima, the most probable first.
    count : int
        The number of draws.
    generator : Generator
        The source of the draws.

    Returns
    -------
    (count, P) ndarray
        Draws of the scaled parameters, of equal weight.
    """
    nodes = _QuadratureNodes(index, marginal, optima[0])
    initial_nodes = _initial_nodes(marginal, optima, index)
    # first nodes, from the optimum outwards, as each fit begins at the nearest fitted node
    for node in sorted(initial_nodes, key=lambda node: abs(node - nodes.centre)):
        nodes.add_node(node)
    distribution_points, distribution = _cumulative_distribution(nodes.energy)
    # further nodes, in the middle of intervals with much probability
    while len(nodes.energy) < MOST_NODES:
        probabilities = np.diff(
            distribution[::INTERPOLATION_INTERVALS]
        )  # between neighbouring nodes
        interval = int(np.argmax(probabilities))
        if not probabilities[interval] > LARGEST_MASS:
            break
        lower_node, upper_node = sorted(nodes.energy)[interval : interval + 2]
        nodes.add_node(0.5 * (lower_node + upper_node))
        distribution_points, distribution = _cumulative_distribution(nodes.energy)
    # the parameter of the quadrature: inverse of its cumulative distribution
    quadrature_values = np.interp(stratified(generator, count), distribution, distribution_points)

    # the other parameters: their mean interpolates those at the nodes, and their covariance is
    # that at the nearest node
    node_values = np.array(sorted(nodes.gaussians))
    gaussians = [nodes.gaussians[node] for node in node_values.tolist()]
    means = np.array([gaussian.mean for gaussian in gaussians])
    values_within_nodes = np.clip(quadrature_values, node_values[0], node_values[-1])
    means_of_draws = Akima1DInterpolator(node_values, means)(values_within_nodes)
    draws: FloatArray = np.insert(means_of_draws, index, quadrature_values, axis=1)
    nearest_node = np.abs(quadrature_values[:, None] - node_values).argmin(axis=1)
    for node_number, gaussian in enumerate(gaussians):
        draws_at_node = np.flatnonzero(nearest_node == node_number)
        entries_of_others = np.ix_(draws_at_node, ~nodes.is_of_quadrature)
        draws[entries_of_others] = gaussian.draws_with_means(draws[entries_of_others], generator)
    return draws


class _QuadratureNodes:
    """Nodes of a quadrature over one parameter, with the Gaussian of the others at each node.

    Parameters
    ----------
    index : int
        The index of the parameter of the quadrature.
    marginal : MarginalPosterior
        The posterior density.
    best : CandidateFit
        The most probable optimum.

    Attributes
    ----------
    centre : float
        The value of the parameter at the optimum.
    is_of_quadrature : (P,) ndarray of bool
        A mask that is True for the parameter of the quadrature, and False for the others.
    energy : dict of float to float
        The energy (-ln of the posterior density) by node [nat]; infinite if the fit at the node
        failed.
    gaussians : dict of float to TruncatedGaussian
        The Gaussian of the other parameters, by node.
    """

    def __init__(self, index: int, marginal: MarginalPosterior, best: CandidateFit) -> None:
        self._marginal = marginal
        self.is_of_quadrature = np.arange(len(marginal.parameter_indices)) == index
        self.centre = float(best.point.shared[marginal.parameter_indices[index]])
        self.energy: dict[float, float] = {}
        self.gaussians: dict[float, TruncatedGaussian] = {}
        self._points = {self.centre: best.point}

    def add_node(self, node: float) -> None:
        """Fit the other parameters and the nuisances at a node, and store its energy and Gaussian.

        The fit starts from the fitted point of the nearest node. If the fit fails, the energy of
        the node is infinite, so that its density is zero, and no point or Gaussian is stored.

        Parameters
        ----------
        node : float
            The value of the parameter of the quadrature, in prior deviations from its prior mean.
        """
        nearest_node = min(self._points, key=lambda fitted_node: abs(fitted_node - node))
        self.energy[node] = np.inf
        with suppress(FitError, ModelError):
            fit_at_node = self._marginal.fit_nuisances(
                np.where(self.is_of_quadrature, node, 0.0),
                is_fixed=self.is_of_quadrature,
                start_point=self._points[nearest_node],
            )
            gaussian = self._marginal.laplace_gaussian(fit_at_node, ~self.is_of_quadrature)
            self._points[node] = fit_at_node.point
            self.gaussians[node] = gaussian
            # The evidence does not contain the prior of the parameter that is fixed at the node.
            # The scaled parameter is standard normal, so that its -ln prior is node^2 / 2.
            self.energy[node] = 0.5 * node**2 - gaussian.log_evidence


def _initial_nodes(
    marginal: MarginalPosterior, optima: tuple[CandidateFit, ...], index: int
) -> list[float]:
    """Return the first nodes: values over the whole prior, and closer ones about each optimum.

    Parameters
    ----------
    marginal : MarginalPosterior
        The posterior density.
    optima : tuple of CandidateFit
        Its maxima.
    index : int
        The index of the parameter of the quadrature.
    """
    low, high = marginal.low[index], marginal.high[index]
    shared_index = marginal.parameter_indices[index]
    node_grids = [
        np.linspace(max(low, -QUADRATURE_RANGE), min(high, QUADRATURE_RANGE), NODES_OF_PRIOR)
    ]
    for optimum in optima:
        posterior_deviation = np.sqrt(optimum.covariance[shared_index, shared_index])
        about_optimum = optimum.point.shared[shared_index] + posterior_deviation * np.linspace(
            -3.0, 3.0, NODES_PER_OPTIMUM
        )
        node_grids.append(np.clip(about_optimum, low, high))
    nodes = np.unique(np.concatenate(node_grids))
    is_separate = np.diff(nodes, prepend=-np.inf) > LEAST_NODE_DISTANCE * (nodes[-1] - nodes[0])
    return [float(node) for node in nodes[is_separate]]


def _cumulative_distribution(energy: Mapping[float, float]) -> tuple[FloatArray, FloatArray]:
    """Return the cumulative distribution of a density whose energy is known at nodes.

    The energy is interpolated between the nodes by Akima's method.

    Parameters
    ----------
    energy : mapping of float to float
        The energy [nat] by node.

    Returns
    -------
    points : (K,) ndarray
        The nodes, with `INTERPOLATION_INTERVALS` - 1 points between any two of them.
    probability : (K,) ndarray
        The probability below each point.
    """
    nodes = np.array(sorted(energy))
    energies = np.array([energy[node] for node in nodes.tolist()])
    energies = np.minimum(energies - energies.min(), LARGEST_ENERGY)
    # density at the nodes and at equally spaced points between them
    fractions = np.linspace(0.0, 1.0, INTERPOLATION_INTERVALS, endpoint=False)
    distances = np.diff(nodes)
    from_each_node = nodes[:-1, None] + distances[:, None] * fractions
    points = np.append(from_each_node.ravel(), nodes[-1])
    interpolated_energy = Akima1DInterpolator(nodes, energies)
    density = np.exp(-interpolated_energy(points))
    # trapezoidal rule
    mean_density = 0.5 * (density[1:] + density[:-1])
    masses = mean_density * np.diff(points)
    cumulative = np.concatenate(([0.0], np.cumsum(masses)))
    return points, cumulative / cumulative[-1]
