"""Residuals of a fit with what their variance should be, for locating, proof and report."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import logsumexp, softmax
from scipy.stats import multivariate_t

from calibration.static.posterior import stratified
from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import NINETY
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.beginnings import from_beginnings, refitted_from_beginnings
from discrepancy.fits.candidate import Candidate, Point
from discrepancy.fits.fitting import LARGEST_EFFECT, CandidateFit, fit, objective, trial_rows
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Screen
from discrepancy.location.residuals import FittedTrial, ResidualSet
from discrepancy.search_settings import SEARCH


def residual_set(problem: Problem, found: CandidateFit, *, sensitivities: bool = True) -> ResidualSet:
    """Return the fitted and the held-out trials of a campaign beside their predictions.

    Parameters
    ----------
    problem : Problem
        Of the fit.
    found : CandidateFit
        With covariance.
    sensitivities : bool
        Whether the exact covariance of the residuals is wanted (P columns a sample) or its diagonal only.

    Notes
    -----
    With a remainder the leverage is that of the trials' own unknowns: what is shared takes a few samples of
    all trials, and its uncertainty is that of the remainder, which χ² against the noise shall show. The noise
    of channels without a record is what the fitted trials leave of them.
    """
    precision = np.where(problem.freedom > 0.0, 1.0, problem.precisions(found.sums))
    fitted = _predicted(problem, found, found, precision, sensitivities=sensitivities)
    if problem.campaign.held_out:
        there, adapted = held_out_fit(problem, found)
        fitted += _predicted(there, found, adapted, precision)
    trials = {item.trial.name: item for item in fitted}
    return ResidualSet(
        problem.campaign.channels,
        tuple(trials[trial.name] for trial in problem.campaign.trials if trial.name in trials),
    )


def held_out_fit(problem: Problem, found: CandidateFit) -> tuple[Problem, CandidateFit]:
    """Return the trials that are held out, and a fit with their own nuisances; what is shared stays."""
    there = problem.with_trials(problem.campaign.held_out)
    start = replace(there.start(found.candidate), shared=found.point.shared, effect=found.point.effect)
    if all(trial.name in problem.beginnings for trial in problem.campaign.held_out):
        start = from_beginnings(there, start)
    adapted = fit(there, found.candidate, start, local_only=True)
    adapted = refitted_from_beginnings(there, adapted, local_only=True)
    if adapted.chi_square > SEARCH.far * float(there.counts.sum()):
        start = _nearest_releases(there, found.candidate, start)
        again = fit(there, found.candidate, start, local_only=True)
        adapted = min(adapted, again, key=lambda item: item.objective)
    return there, adapted


RELEASES = tuple(np.linspace(-2.0, 2.0, 17).tolist())
"""Amplitudes of a release from which the fit of a held-out trial may begin, in prior deviations; of a free
initial state in tenths of the nominal one."""


def _nearest_releases(there: Problem, candidate: Candidate, start: Point) -> Point:
    """Return a start at the amplitudes of releases that leave least of each trial.

    Where friction ends a motion each number of half swings has an optimum of its own.
    """
    nearest = list(start.local)
    for number, data in enumerate(there.trials):
        release, amplitude = data.trial.release, data.unknowns.zeros
        if release is None or amplitude >= data.unknowns.size:
            continue
        nominal = 0.0 if release.at_rest else 1.0 / data.unknowns.scale[amplitude]
        step = 1.0 if release.at_rest else 0.1 * nominal
        least = np.inf
        for size in nominal + step * np.array(RELEASES):
            local = start.local[number].copy()
            local[amplitude] = size
            point = replace(start, local=(*nearest[:number], local, *nearest[number + 1 :]))
            value = objective(there, candidate, point)
            if value < least:
                least, nearest[number] = value, local
    return replace(start, local=tuple(nearest))


def _predicted(
    problem: Problem, found: CandidateFit, adapted: CandidateFit, precision: FloatArray, *,
    sensitivities: bool = False,
) -> list[FittedTrial]:  # fmt: skip
    """Return trials beside their predictions, by what was found and its nuisances as adapted to them.

    `precision` (channels,) is that of the noise of the fitted trials over the recorded one.
    """
    root = np.linalg.cholesky(found.covariance + 1e-14 * np.eye(len(found.covariance)))
    at, items = len(root), []
    total = at + sum(data.unknowns.size for data in problem.trials)
    counted = float(found.remainder is None)
    for number, data in enumerate(problem.trials):
        item = trial_rows(problem, number, adapted, adapted.candidate, precision)
        deviation = data.deviation / np.sqrt(precision[data.groups])
        local, shared = np.split(item.rows, [data.unknowns.size])
        factor, along = item.followed()
        own = solve_triangular(factor, local, trans="T")
        # local unknowns follow the shared ones: J_s - J_l A^-1 B, then what is their own
        follow = (shared - along.T @ local).T @ root[item.index]
        taken, carried = np.einsum("kn,kn->n", own, own), np.einsum("nk,nk->n", follow, follow)
        shape = adapted.residuals[number].shape
        if adapted is not found:
            leverage = np.maximum(counted * carried - taken, -1.0 + 1e-9)
            variance = 1.0 + np.maximum(carried - taken, -1.0 + 1e-9).reshape(shape)
        else:
            leverage = np.minimum(taken + counted * carried, 1.0)
            variance = 1.0 + np.maximum(leverage, 0.0).reshape(shape)
        if found.remainder is not None and data.trial.is_dynamic:
            recorded = problem.freedom[data.groups] > 0.0  # in the others it is in the noise already
            variance = variance + recorded * found.remainder.size[data.groups] ** 2
        sensitive = None
        if sensitivities:
            sensitive = np.zeros((*shape, total))
            sensitive[..., : len(root)] = follow.reshape(*shape, len(root))
            sensitive[..., at : at + len(own)] = own.T.reshape(*shape, len(own))
            at += len(own)
        prediction = problem.prediction(number, adapted.point, adapted.responses[number])
        residual = problem.residual(number, adapted.point, adapted.responses[number])
        items.append(
            FittedTrial(
                trial=replace(data.trial, used=data.weight > 0.0),  # after a gap a filter leaves out more
                prediction=prediction,
                residual=residual * data.deviation,  # what a remainder takes up is what is left
                noise_deviation=deviation,
                predictive_deviation=deviation * np.sqrt(np.maximum(variance, 1e-9)),
                leverage=leverage.reshape(shape),
                rates=np.gradient(prediction, data.trial.time, axis=0) if data.trial.is_dynamic else None,
                sensitivity=sensitive,
            )
        )
    return items


# ---------------------------------------------------------------- draws of the effect


LEAST_RISE = 0.6
"""Rise of the misfit [nat] at the ends of a Gaussian 90 % interval below which the posterior is drawn from;
NINETY^2 / 2 = 1.35 is expected."""
SEED = 20211
ROUNDS, LOOKED_AT, KEPT = 5, 400, 1000
"""Rounds, points of each at which a density is looked at, and draws that are kept."""


def with_draws(problem: Problem, fit: CandidateFit) -> CandidateFit:
    """Return a fit with draws of its effect parameters if their posterior is wider than its covariance.

    Parameters
    ----------
    problem : Problem
        Of the fit.
    fit : CandidateFit
        With covariance.

    Returns
    -------
    CandidateFit
        As it was where the misfit rises enough at the ends of the intervals along all principal directions;
        else with `draws`. The same fit gives the same draws.
    """
    if not fit.candidate.size:
        return fit
    screen = Screen(problem, fit, record_noise=False)
    centre = fit.point.effect

    def energy(effect: FloatArray) -> float:
        if np.abs(effect).max() > LARGEST_EFFECT:
            return np.inf
        try:
            rise = screen.rise(effect)
        except DiscrepancyError:  # more than the structure can carry
            return np.inf
        return rise + 0.5 * float(effect @ effect - centre @ centre)

    spread, directions = np.linalg.eigh(fit.effect_covariance)
    axes = directions * np.sqrt(np.maximum(spread, 0.0))
    rises = [energy(centre + side * NINETY * axis) for axis in axes.T for side in (-1.0, 1.0)]
    if min(rises) > LEAST_RISE:
        return fit
    return replace(fit, draws=drawn_from(energy, centre, axes))


def drawn_from(energy: Callable[[FloatArray], float], centre: FloatArray, axes: FloatArray) -> FloatArray:
    """Return equally weighted draws of a density: adaptive multiple importance sampling.

    Points of each round are drawn of a Cauchy density, whose tails reach far beyond it, with the moments that
    all points before tell; each is weighed by the densities of all rounds together (Cornuet, Marin, Mira and
    Robert 2012, Scand. J. Statist. 39, 798-812). Along a ridge that is bent and a hundred times longer than
    wide the draws cover a part of it.

    Parameters
    ----------
    energy : callable
        -ln of the density at a point (E,), infinite where it vanishes.
    centre : (E,) ndarray
        About which points are drawn at first.
    axes : (E, E) ndarray
        Columns along which they are spread then.

    Returns
    -------
    (KEPT, E) ndarray
        The same density gives the same draws.
    """
    generator, size = np.random.default_rng(SEED), len(centre)
    mean, covariance = centre, axes @ axes.T
    points, values, proposals = np.empty((0, size)), np.empty(0), []
    for _ in range(ROUNDS):
        proposals.append(multivariate_t(mean, covariance + 1e-12 * np.eye(size), df=1.0))
        fresh = proposals[-1].rvs(LOOKED_AT, generator).reshape(LOOKED_AT, size)
        points, values = np.concatenate((points, fresh)), np.append(values, [*map(energy, fresh)])
        weight = softmax(-values - logsumexp([item.logpdf(points) for item in proposals], axis=0))
        mean, covariance = weight @ points, np.atleast_2d(np.cov(points.T, aweights=weight))
    return np.asarray(points[np.searchsorted(np.cumsum(weight)[:-1], stratified(generator, KEPT))])
