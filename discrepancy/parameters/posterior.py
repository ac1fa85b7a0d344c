"""Samples of the posterior of a model's parameters: by quadrature, of a checked Gaussian, or drawn."""

from collections.abc import Mapping
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator
from scipy.optimize import lsq_linear
from scipy.special import log_ndtr, logsumexp, softmax
from scipy.stats import truncnorm
from scipy.stats.qmc import Sobol

from calibration.result.record import Procedure
from calibration.static.posterior import stratified
from discrepancy.campaign.records import FloatArray
from discrepancy.errors import FitError, ModelError
from discrepancy.fits.candidate import Candidate, Point
from discrepancy.fits.fitting import CandidateFit, fit
from discrepancy.fits.normal_equations import cholesky_factor, normal_equations, solve_factored
from discrepancy.fits.problem import Problem

NOTHING = Candidate()
STARTS = 4
"""Draws of the prior from which a fit begins, besides its mean: another optimum may lie apart."""
APART, COMPARABLE = 3.0, 10.0
"""Optima are two where they lie more deviations apart than this, and tell where the evidence of the lesser
is within so many nats."""


class Marginal:
    """-ln p(parameters | campaign) up to a constant [nat], over u = (value - prior mean) / deviation.

    Parameters
    ----------
    problem : Problem
        Campaign and model.

    Attributes
    ----------
    free : (P,) ndarray of int
        Which calibrated parameters have a prior deviation; u is of these.
    low, high : (P,) ndarray
        Ends of the model's range as scaled parameters; the prior is cut off there.
    refused : list of (ndarray, str)
        Where within the range the model could not be had: scaled parameters (P,), NaN for those that were
        fitted, and why.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        shared = problem.shared
        self.free = np.flatnonzero(shared.scale[: shared.count] > 0.0)
        self.low, self.high = shared.ends[:, self.free]
        self._near = problem.start(NOTHING)
        self.refused: list[tuple[FloatArray, str]] = []

    def values(self, u: FloatArray) -> FloatArray:
        """Return parameters (..., P) of scaled ones [units]."""
        shared = self._problem.shared
        return shared.centre[self.free] + shared.scale[self.free] * u

    def inside(self, u: FloatArray) -> NDArray[np.bool_]:
        """Return which scaled parameters (..., P) lie within the model's range."""
        return np.asarray(np.all((u >= self.low) & (u <= self.high), axis=-1))

    def fitted(
        self,
        u: FloatArray,
        trials: Problem | None = None,
        *,
        fixed: NDArray[np.bool_] | None = None,
        near: Point | None = None,
    ) -> CandidateFit:
        """Return the fit of the nuisances alone at scaled parameters (P,).

        Parameters
        ----------
        u : (P,) ndarray
            Scaled parameters.
        trials : Problem, optional
            Other trials of the campaign.
        fixed : (P,) ndarray of bool, optional
            Those that stay at `u`; the others are fitted with the nuisances. All of them if left out.
        near : Point, optional
            Where to begin.

        Raises
        ------
        FitError, ModelError
            If the model cannot have these parameters.
        """
        problem = copy(trials or self._problem)
        shared = problem.shared
        fixed = np.ones(len(self.free), dtype=bool) if fixed is None else fixed
        held = self.free[fixed]
        moments = {name: getattr(shared, name).copy() for name in ("centre", "low", "high", "scale")}
        for values in moments.values():
            values[held] = self.values(u)[fixed]
        moments["scale"][held] = 0.0
        problem.shared = replace(shared, **moments)
        start = near or (self._near if trials is None else problem.start(NOTHING))
        at = start.shared.copy()
        at[held] = 0.0
        try:
            return fit(problem, NOTHING, replace(start, shared=at))
        except ModelError as cause:
            self.refused.append((np.where(fixed, u, np.nan), str(cause)))
            raise

    def __call__(self, u: FloatArray) -> float:
        """Return the energy at scaled parameters (P,); infinite outside the model's range."""
        if not self.inside(u):
            return np.inf
        try:
            found = self.fitted(u)
        except (FitError, ModelError):
            return np.inf
        return 0.5 * float(u @ u) - found.log_evidence

    def optima(self, seed: int) -> list[CandidateFit]:
        """Return the maxima of the posterior that tell, with their evidence within the range, greatest first.

        Raises
        ------
        FitError, ModelError
            If the model fails at its prior mean.
        """
        problem = self._problem
        fits = [fit(problem, NOTHING, problem.start(NOTHING), iterations=40)]
        generator = np.random.default_rng(seed)
        for _ in range(STARTS):
            start = problem.start(NOTHING)
            start.shared[self.free] = generator.standard_normal(len(self.free))
            with suppress(FitError, ModelError):
                fits.append(fit(problem, NOTHING, start, iterations=40))
        found: list[CandidateFit] = []
        every = np.ones(len(self.free), dtype=bool)
        for item in sorted(fits, key=lambda item: round(item.objective, 3)):  # of equal ones the first
            if not any(self._same(other, item) for other in found):
                found.append(replace(item, log_evidence=self.about(item, every).log_evidence))
        found.sort(key=lambda item: -item.log_evidence)
        best = found[0]
        self._near = best.point
        return [item for item in found if item.log_evidence > best.log_evidence - COMPARABLE]

    def _same(self, first: CandidateFit, second: CandidateFit) -> bool:
        free = self.free
        shift = first.point.shared[free] - second.point.shared[free]
        covariance = first.covariance[np.ix_(free, free)]
        return bool(shift @ np.linalg.solve(covariance, shift) < APART**2)

    def about(self, found: CandidateFit, fitted: NDArray[np.bool_]) -> "CutGaussian":
        """Return the Gaussian that a fit tells of those (P,) that were fitted, be it at an end or not."""
        problem, which = self._problem, self.free[fitted]
        equations = normal_equations(problem, found, NOTHING, problem.precisions(found.sums))
        step = solve_factored(cholesky_factor(equations.matrix), equations.gradient)
        return CutGaussian(
            found.point.shared[which] + step[which],
            found.covariance[np.ix_(which, which)],
            self.low[fitted],
            self.high[fitted],
            found.log_evidence + 0.5 * float(equations.gradient @ step),
        )


@dataclass(frozen=True)
class CutGaussian:
    """A Gaussian of scaled parameters, cut off at their range.

    Attributes
    ----------
    mean, covariance : (P,), (P, P) ndarray
        Of the Gaussian that goes on beyond the range; its mean may lie there.
    low, high : (P,) ndarray
        Ends of the range.
    whole : float
        ln of its integral without the range, up to a constant [nat].
    """

    mean: FloatArray
    covariance: FloatArray
    low: FloatArray
    high: FloatArray
    whole: float

    @cached_property
    def tilt(self) -> tuple[FloatArray, FloatArray]:
        """Cholesky factor (P, P), and how ends of the range push what is drawn before them (P,)."""
        factor = np.linalg.cholesky(self.covariance)
        root = np.linalg.inv(factor)
        at_ends = lsq_linear(root, root @ self.mean, (self.low, self.high), method="bvls").x
        normal = root @ (at_ends - self.mean)
        return np.asarray(factor), np.asarray(normal - np.diag(factor) * (root.T @ normal))

    def weighed(self, means: FloatArray, uniform: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return draws (..., P) about means (..., P), and the logs of their weights (...).

        Each parameter is drawn within its range given those before it, and weighed by what of it lies there:
        the mean weight is the share within the range (Genz 1992, J. Comput. Graph. Stat. 1 (2)). It is drawn
        about where the density is largest (Botev 2017, J. R. Statist. Soc. B 79 (1)).

        Parameters
        ----------
        means : (..., P) ndarray
            In place of `mean`.
        uniform : (..., P) ndarray
            Numbers between 0 and 1.
        """
        factor, tilt = self.tilt
        normal, weight = np.zeros_like(uniform), np.zeros(uniform.shape[:-1])
        for at, (row, shift) in enumerate(zip(factor, tilt.tolist(), strict=True)):
            given = means[..., at] + normal @ row
            low, high = ((end[at] - given) / row[at] - shift for end in (self.low, self.high))
            normal[..., at] = shift + truncnorm.ppf(uniform[..., at], low, high)
            # in the lower tail, where no digits are lost
            upper = low > 0.0
            below, above = np.where(upper, -high, low), np.where(upper, -low, high)
            weight += log_ndtr(above) + np.log1p(-np.exp(log_ndtr(below) - log_ndtr(above)))
            weight += shift * (0.5 * shift - normal[..., at])
        return np.clip(means + normal @ factor.T, self.low, self.high), weight

    def energy(self, u: FloatArray) -> float:
        """Return -ln of the density at scaled parameters (P,), up to a constant [nat]."""
        return 0.5 * float((u - self.mean) @ np.linalg.solve(self.covariance, u - self.mean))

    @cached_property
    def even(self) -> tuple[FloatArray, FloatArray]:
        """Draws (N, P) spread evenly, and their weights (N,), whose mean is the share within the range."""
        uniform = Sobol(max(len(self.mean), 1), rng=0).random(EVEN)[:, : len(self.mean)]
        return self.weighed(self.mean, uniform)

    @cached_property
    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean (P,) and covariance (P, P) within the range."""
        points, weight = self.even
        share = softmax(weight)
        return share @ points, np.atleast_2d(np.cov(points.T, aweights=share))

    @property
    def log_evidence(self) -> float:
        """Logarithm of its integral within the range, up to a constant [nat]."""
        return float(self.whole + logsumexp(self.even[1]) - np.log(EVEN))

    def draws(self, count: int, generator: np.random.Generator) -> FloatArray:
        """Return draws (count, P), of equal weight."""
        points, weight = self.weighed(self.mean, generator.random((TRIED * count, len(self.mean))))
        chosen = np.searchsorted(np.cumsum(softmax(weight)), stratified(generator, count))
        return np.asarray(points[np.minimum(chosen, len(points) - 1)])

    def draws_about(self, means: FloatArray, generator: np.random.Generator) -> FloatArray:
        """Return a draw about each of the means (N, P), which stand in place of its own."""
        shape = (TRIED, *means.shape)
        points, weight = self.weighed(np.broadcast_to(means, shape), generator.random(shape))
        chosen = np.argmax(weight + generator.gumbel(size=weight.shape), axis=0)
        return np.asarray(points[chosen, np.arange(len(means))])


# ---------------------------------------------------------------- the posterior

REACH, NEAR, WIDE, BETWEEN = 6.0, 9, 17, 40
"""Quadrature: deviations of the prior to either side, nodes within three deviations of an optimum, nodes over
the whole prior, and points of the density between two nodes."""
LARGEST_MASS, MOST_NODES = 0.04, 90
"""Nodes are added until no interval between two holds more of the posterior than this."""
CHECKED = ((1.0, 0.12), (2.0, 0.5))
"""The posterior is a Gaussian if its energy, so many deviations from the mean along each principal direction,
or where the range ends before, is that of one within so many nats."""
EVEN, TRIED = 1024, 32
"""Draws of a Gaussian that tell its share within the range, and of which one is kept."""
EMPTY = 700.0
"""Energy [nat] above the least where nothing is left of a density."""
LEAST_SPREAD = 1e-9
"""Nodes closer together than this share of the grid are one."""


@dataclass(frozen=True)
class ParameterPosterior:
    """What the campaign says of the parameters.

    Attributes
    ----------
    procedure : Procedure
        How `draws` were made.
    draws : (N, P) ndarray
        Equally weighted scaled parameters.
    optima : tuple of CandidateFit
        Maxima that tell, the most probable first.
    marginal : Marginal
        The density.
    """

    procedure: Procedure
    draws: FloatArray
    optima: tuple[CandidateFit, ...]
    marginal: Marginal


def parameter_posterior(problem: Problem, count: int, seed: int) -> ParameterPosterior:
    """Return `count` draws of the posterior of a problem's parameters.

    One parameter is integrated by quadrature. Of several the Gaussian about the optimum, cut off at the
    range, is taken where the energy along the principal axes of what is left is that of a Gaussian; else the
    parameter that is told least is integrated by quadrature, the others being such a Gaussian given it (a
    nested Laplace approximation, Rue, Martino and Chopin 2009, J. R. Statist. Soc. B 71 (2)). Where several
    optima tell, each has its Gaussian, weighed by its evidence.

    Raises
    ------
    FitError, ModelError
        If the model fails at its prior mean.
    """
    marginal = Marginal(problem)
    optima = tuple(marginal.optima(seed))
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
    every = np.ones(len(marginal.free), dtype=bool)
    parts = [marginal.about(item, every) for item in optima]
    procedure: Procedure = "several optima" if len(optima) > 1 else "Gaussian"
    if len(every) == 1 or (len(parts) == 1 and not is_gaussian(marginal, parts[0])):
        index = int(np.argmax(np.diag(parts[0].moments[1])))
        procedure, draws = "quadrature", _along(index, marginal, optima, count, generator)
    else:
        chosen = generator.choice(len(parts), count, p=softmax([part.log_evidence for part in parts]))
        draws = np.empty((count, len(every)))
        for at in np.unique(chosen):  # an optimum of a small share may have none
            draws[chosen == at] = parts[at].draws(int(np.sum(chosen == at)), generator)
    return ParameterPosterior(procedure, draws, optima, marginal)


def is_gaussian(marginal: Marginal, part: CutGaussian) -> bool:
    """Return whether the energy rises along the principal axes as that of a Gaussian cut off does."""
    mean, covariance = part.moments
    spread, directions = np.linalg.eigh(covariance)
    axes = (directions * np.sqrt(np.maximum(spread, 0.0))).T
    least = marginal(mean) - part.energy(mean)

    def agrees(step: FloatArray, allowed: float) -> bool:
        room = np.where(step > 0.0, part.high - mean, mean - part.low) / np.maximum(np.abs(step), 1e-300)
        point = np.clip(mean + min(1.0, room.min()) * step, part.low, part.high)
        return bool(abs(marginal(point) - part.energy(point) - least) < allowed)

    return all(
        agrees(side * size * axis, allowed)
        for axis, (size, allowed), side in product(axes, CHECKED, (-1.0, 1.0))
    )


def _along(
    index: int,
    marginal: Marginal,
    optima: tuple[CandidateFit, ...],
    count: int,
    generator: np.random.Generator,
) -> FloatArray:
    """Return draws (count, P): one parameter by quadrature, the others given it.

    At each node of the one the others are fitted and integrated with the nuisances: a Gaussian given the
    one, cut off at the model's range.
    """
    free, best = marginal.free, optima[0]
    one = np.arange(len(free)) == index
    centre = float(best.point.shared[free[index]])
    points = {centre: best.point}
    others: dict[float, CutGaussian] = {}
    energy: dict[float, float] = {}

    def visit(node: float) -> None:
        """Fit at a node, from what was found beside it; infinite where the model cannot be had."""
        near = points[min(points, key=lambda place: abs(place - node))]
        energy[node] = np.inf
        with suppress(FitError, ModelError):
            found = marginal.fitted(np.where(one, node, 0.0), fixed=one, near=near)
            points[node], others[node] = found.point, marginal.about(found, ~one)
            energy[node] = 0.5 * node**2 - others[node].log_evidence

    for node in sorted(_first_nodes(marginal, optima, index), key=lambda node: abs(node - centre)):
        visit(node)
    fine, mass = _distribution(energy)
    while len(energy) < MOST_NODES and np.max(shares := np.diff(mass[::BETWEEN])) > LARGEST_MASS:
        largest = int(np.argmax(shares))
        visit(0.5 * sum(sorted(energy)[largest : largest + 2]))
        fine, mass = _distribution(energy)
    values = np.interp(stratified(generator, count), mass, fine)
    nodes = np.array(sorted(others))
    means = np.array([others[node].mean for node in nodes.tolist()])
    draws: FloatArray = np.insert(
        Akima1DInterpolator(nodes, means)(np.clip(values, nodes[0], nodes[-1])), index, values, axis=1
    )
    nearest = np.abs(values[:, None] - nodes).argmin(axis=1)
    for at, node in enumerate(nodes.tolist()):
        rows = np.flatnonzero(nearest == at)
        place = np.ix_(rows, ~one)
        draws[place] = others[node].draws_about(draws[place], generator)
    return draws


def _first_nodes(marginal: Marginal, optima: tuple[CandidateFit, ...], index: int) -> list[float]:
    """Return values of one parameter over the whole prior, and closer about each optimum."""
    low, high, place = marginal.low[index], marginal.high[index], marginal.free[index]
    places = [np.linspace(max(low, -REACH), min(high, REACH), WIDE)]
    for item in optima:
        near = np.sqrt(item.covariance[place, place]) * np.linspace(-3.0, 3.0, NEAR)
        places.append(np.clip(item.point.shared[place] + near, low, high))
    nodes = np.unique(np.concatenate(places))
    apart = np.diff(nodes, prepend=-np.inf) > LEAST_SPREAD * (nodes[-1] - nodes[0])
    return [float(node) for node in nodes[apart]]


def _distribution(energy: Mapping[float, float]) -> tuple[FloatArray, FloatArray]:
    """Return points and the distribution function of a density at them, `BETWEEN` between its nodes."""
    nodes, values = np.array(sorted(energy.items())).T
    values = np.minimum(values - values.min(), EMPTY)
    share = np.linspace(0.0, 1.0, BETWEEN, endpoint=False)
    fine = np.append((nodes[:-1, None] + np.diff(nodes)[:, None] * share).ravel(), nodes[-1])
    density = np.exp(-Akima1DInterpolator(nodes, values)(fine))
    mass = np.concatenate(([0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(fine))))
    return fine, mass / mass[-1]
