"""Samples of the posterior of a model's parameters: by quadrature, of a checked Gaussian, or drawn."""

from collections.abc import Mapping
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator
from scipy.special import ndtr
from scipy.stats import multivariate_normal

from calibration.result.record import Procedure
from calibration.static.posterior import stratified
from discrepancy.campaign.records import FloatArray
from discrepancy.errors import FitError, ModelError
from discrepancy.fits.candidate import Candidate, Point
from discrepancy.fits.fitting import CandidateFit, fit
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
        mean, scale = shared.centre[self.free], shared.scale[self.free]
        self.low = (shared.low[self.free] - mean) / scale
        self.high = (shared.high[self.free] - mean) / scale
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
        """Return the maxima of the posterior that tell, the most probable first.

        Raises
        ------
        FitError, ModelError
            If the model fails at its prior mean.
        """
        problem = self._problem
        fits = [self._within(fit(problem, NOTHING, problem.start(NOTHING), iterations=40))]
        generator = np.random.default_rng(seed)
        for _ in range(STARTS):
            start = problem.start(NOTHING)
            start.shared[self.free] = np.clip(generator.standard_normal(len(self.free)), self.low, self.high)
            with suppress(FitError, ModelError):
                fits.append(self._within(fit(problem, NOTHING, start, iterations=40)))
        found: list[CandidateFit] = []
        for item in sorted(fits, key=lambda item: round(item.objective, 3)):  # of equal ones the first
            if not any(self._same(other, item) for other in found):
                found.append(item)
        found.sort(key=lambda item: -item.log_evidence)
        best = found[0]
        self._near = best.point
        return [item for item in found if item.log_evidence > best.log_evidence - COMPARABLE]

    def _within(self, found: CandidateFit) -> CandidateFit:
        """Return a fit at the end of the range where its last step ended beyond it."""
        shared = found.point.shared.copy()
        shared[self.free] = np.clip(shared[self.free], self.low, self.high)
        return replace(found, point=replace(found.point, shared=shared))

    def _same(self, first: CandidateFit, second: CandidateFit) -> bool:
        free = self.free
        shift = first.point.shared[free] - second.point.shared[free]
        covariance = first.covariance[np.ix_(free, free)]
        return bool(shift @ np.linalg.solve(covariance, shift) < APART**2)


# ---------------------------------------------------------------- the posterior

REACH, NEAR, WIDE, BETWEEN = 6.0, 9, 17, 40
"""Quadrature: deviations of the prior to either side, nodes within three deviations of an optimum, nodes over
the whole prior, and points of the density between two nodes."""
LARGEST_MASS, MOST_NODES = 0.04, 90
"""Nodes are added until no interval between two holds more of the posterior than this."""
CHECKED = ((1.0, 0.12), (2.0, 0.5))
"""The posterior is a Gaussian if its energy, so many deviations from the optimum along each principal
direction, is that of one within so many nats."""
CUT = 0.01
"""Share of a Gaussian beyond the model's range from which on it is drawn otherwise."""
EMPTY = 700.0
"""Energy [nat] above the least where nothing is left of a density."""
REDRAWN = 1000
"""Times that a draw beyond the model's range is drawn anew; the few that are left stand at its end."""
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

    One parameter is integrated by quadrature. Of several the Gaussian at the optimum is taken where the
    energy along its principal axes is that of a Gaussian; else the parameter that is most cut off, or told
    least, is integrated by quadrature, the others being Gaussian given it (a nested Laplace approximation,
    Rue, Martino and Chopin 2009, J. R. Statist. Soc. B 71 (2)). Where several optima tell, each has its
    Gaussian, weighed by its Laplace evidence.

    Raises
    ------
    FitError, ModelError
        If the model fails at its prior mean.
    """
    marginal = Marginal(problem)
    optima = tuple(marginal.optima(seed))
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
    free = marginal.free
    centres = [item.point.shared[free] for item in optima]
    spreads = [item.covariance[np.ix_(free, free)] for item in optima]
    trial = generator.multivariate_normal(centres[0], spreads[0], 4000, method="cholesky")
    beyond = np.mean((trial < marginal.low) | (trial > marginal.high), axis=0)
    cut = float(np.mean(~marginal.inside(trial)))
    procedure: Procedure = "several optima" if len(optima) > 1 else "Gaussian"
    if len(free) == 1 or (
        len(optima) == 1 and not (cut < CUT and is_gaussian(marginal, centres[0], spreads[0]))
    ):
        # what is fitted at the end of its range is no Gaussian there: such a parameter is integrated itself
        index = int(np.argmax(beyond if beyond.max() > CUT else np.diag(spreads[0])))
        procedure, draws = "quadrature", _along(index, marginal, optima, count, generator)
    else:
        ends = marginal.low, marginal.high
        shares = [mass_inside(*item, *ends) for item in zip(centres, spreads, strict=True)]
        evidence = np.array([item.log_evidence for item in optima]) + np.log(np.maximum(shares, 1e-300))
        weight = np.exp(evidence - evidence.max())
        chosen = generator.choice(len(optima), count, p=weight / weight.sum())
        draws = np.array(centres)[chosen]
        for at, spread in enumerate(spreads):
            draws[chosen == at] = cut_off(draws[chosen == at], spread, *ends, generator)
    return ParameterPosterior(procedure, draws, optima, marginal)


def is_gaussian(marginal: Marginal, centre: FloatArray, covariance: FloatArray) -> bool:
    """Return whether the energy rises along the principal axes as that of a Gaussian does."""
    least = marginal(centre)
    spread, directions = np.linalg.eigh(covariance)
    axes = (directions * np.sqrt(np.maximum(spread, 0.0))).T
    return all(
        abs(marginal(centre + side * size * axis) - least - 0.5 * size**2) < allowed
        for axis, (size, allowed), side in product(axes, CHECKED, (-1.0, 1.0))
    )


def mass_inside(centre: FloatArray, covariance: FloatArray, low: FloatArray, high: FloatArray) -> float:
    """Return the share of a Gaussian that lies between `low` and `high` (P,) in every direction [1]."""
    if len(centre) == 1:
        deviation = float(np.sqrt(covariance[0, 0]))
        return float(ndtr((high[0] - centre[0]) / deviation) - ndtr((low[0] - centre[0]) / deviation))
    how = {"allow_singular": True, "lower_limit": low, "rng": np.random.default_rng(0)}
    return float(multivariate_normal.cdf(high, centre, covariance, **how))


def cut_off(
    centres: FloatArray,
    covariance: FloatArray,
    low: FloatArray,
    high: FloatArray,
    generator: np.random.Generator,
) -> FloatArray:
    """Return a draw about each of the centres (N, P), anew where it is beyond the range."""
    drawn, rows = np.full_like(centres, np.inf), np.arange(len(centres))
    for _ in range(REDRAWN):
        if not len(rows):
            break
        shift = generator.multivariate_normal(np.zeros(len(low)), covariance, len(rows), method="cholesky")
        drawn[rows] = centres[rows] + shift
        rows = rows[np.any((drawn[rows] < low) | (drawn[rows] > high), axis=1)]
    return np.clip(drawn, low, high)


def _along(
    index: int,
    marginal: Marginal,
    optima: tuple[CandidateFit, ...],
    count: int,
    generator: np.random.Generator,
) -> FloatArray:
    """Return draws (count, P): one parameter by quadrature, the others given it.

    At each node of the one the others are fitted and integrated with the nuisances: Gaussian given the one,
    and cut off at the model's range. The evidence of a node has the share of that Gaussian that lies within.
    """
    free, best = marginal.free, optima[0]
    one = np.arange(len(free)) == index
    ends = marginal.low[~one], marginal.high[~one]
    centre = float(best.point.shared[free[index]])
    fits: dict[float, CandidateFit] = {}
    energy: dict[float, float] = {}

    def others(found: CandidateFit) -> tuple[FloatArray, FloatArray]:
        """Return mean (P - 1,) and covariance of the others at a node."""
        return found.point.shared[free[~one]], found.covariance[np.ix_(free[~one], free[~one])]

    def visit(node: float) -> None:
        """Fit at a node, from what was found beside it; infinite where the model cannot be had."""
        known = {centre: best.point} | {u: item.point for u, item in fits.items()}
        near = known[min(known, key=lambda place: abs(place - node))]
        energy[node] = np.inf
        with suppress(FitError, ModelError):
            fits[node] = found = marginal.fitted(np.where(one, node, 0.0), fixed=one, near=near)
            share = 1.0 if one.all() else mass_inside(*others(found), *ends)
            energy[node] = 0.5 * node**2 - found.log_evidence - float(np.log(max(share, np.exp(-EMPTY))))

    for node in sorted(_first_nodes(marginal, optima, index), key=lambda node: abs(node - centre)):
        visit(node)
    fine, mass = _distribution(energy)
    while len(energy) < MOST_NODES and np.max(shares := np.diff(mass[::BETWEEN])) > LARGEST_MASS:
        largest = int(np.argmax(shares))
        visit(0.5 * sum(sorted(energy)[largest : largest + 2]))
        fine, mass = _distribution(energy)
    values = np.interp(stratified(generator, count), mass, fine)
    draws = np.repeat(values[:, None], len(free), axis=1)
    if not one.all():
        nodes = np.array(sorted(fits))
        means, spreads = zip(*(others(fits[node]) for node in nodes.tolist()), strict=True)
        centres = Akima1DInterpolator(nodes, np.array(means))(np.clip(values, nodes[0], nodes[-1]))
        nearest = np.abs(values[:, None] - nodes).argmin(axis=1)
        for at, spread in enumerate(spreads):
            rows = np.flatnonzero(nearest == at)
            draws[np.ix_(rows, ~one)] = cut_off(centres[rows], spread, *ends, generator)
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
