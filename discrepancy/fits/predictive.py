"""Residuals of a fit with what their variance should be, for locating, proof and report."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import Trial
from discrepancy.location.residuals import FittedTrial, ResidualSet

from .cholesky import Cholesky
from .fitting import CandidateFit, TrialBlock, fit, trial_block
from .problem import Problem

FloatArray = NDArray[np.float64]


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
    all trials, and its uncertainty is that of the remainder, which χ² against the noise shall show.
    """
    fitted = _fitted(problem, found, sensitivities=sensitivities)
    held_out = problem.campaign.held_out
    trials = {item.trial.name: item for item in fitted}
    if held_out:
        trials.update({item.trial.name: item for item in _held_out(problem, found, held_out)})
    return ResidualSet(
        problem.campaign.channels,
        tuple(trials[trial.name] for trial in problem.campaign.trials if trial.name in trials),
    )


def _fitted(problem: Problem, found: CandidateFit, *, sensitivities: bool) -> list[FittedTrial]:
    shared_root = np.linalg.cholesky(found.covariance + 1e-14 * np.eye(len(found.covariance)))
    shared_size = len(shared_root)
    total = shared_size + sum(data.unknowns.size for data in problem.trials)
    at, items = shared_size, []
    ones = np.ones(len(problem.channel_names))
    for number, data in enumerate(problem.trials):
        block = trial_block(
            problem, number, found.point, found.linearisations[number], found.candidate,
            found.residuals[number], ones,
        )  # fmt: skip
        local, shared = _halves(block)
        factor = Cholesky.of(block.local)
        own = factor.half(local)
        # local unknowns follow the shared ones: J_s - J_l A^-1 B, then what is their own
        follow = (shared - factor.solve(block.cross).T @ local).T @ shared_root[block.index]
        leverage = np.einsum("kn,kn->n", own, own)
        if found.remainder is None:
            leverage = leverage + np.einsum("nk,nk->n", follow, follow)
        shape = found.residuals[number].shape
        sensitive = None
        if sensitivities:
            sensitive = np.zeros((*shape, total))
            sensitive[..., :shared_size] = follow.reshape(*shape, shared_size)
            sensitive[..., at : at + len(own)] = own.T.reshape(*shape, len(own))
        items.append(
            _item(problem, number, found, np.minimum(leverage, 1.0).reshape(shape), sensitive, held_out=False)
        )
        at += data.unknowns.size
    return items


def _halves(block: TrialBlock) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives (L, N C) and (K, N C) by the trial's own and by the shared unknowns."""
    dense = block.derivatives.dense()
    return dense[: len(block.local)], dense[len(block.local) :]


def _held_out(problem: Problem, found: CandidateFit, trials: tuple[Trial, ...]) -> list[FittedTrial]:
    """Predict held-out trials: what is shared stays as fitted, their own nuisances adapt to them."""
    there = problem.with_trials(trials)
    nothing = tuple(np.zeros(data.unknowns.size) for data in there.trials)
    start = replace(found.point, local=nothing)
    adapted = replace(fit(there, found.candidate, start, local_only=True), remainder=found.remainder)
    items = []
    ones = np.ones(len(there.channel_names))
    for number in range(len(there.trials)):
        block = trial_block(
            there, number, adapted.point, adapted.linearisations[number], adapted.candidate,
            adapted.residuals[number], ones,
        )  # fmt: skip
        local, shared = _halves(block)
        factor = Cholesky.of(block.local)
        follow = shared - factor.solve(block.cross).T @ local
        own = np.einsum("kn,kn->n", local, factor.solve(local))
        covariance = found.covariance[np.ix_(block.index, block.index)]
        carried = np.einsum("kn,kn->n", follow, covariance @ follow)
        shape = adapted.residuals[number].shape
        leverage = np.maximum(carried - own, -1.0 + 1e-9).reshape(shape)
        item = _item(there, number, adapted, leverage, None, held_out=True)
        if found.remainder is not None:
            item = replace(item, leverage=np.maximum(-own, -1.0 + 1e-9).reshape(shape))
        items.append(item)
    return items


def _item(
    problem: Problem,
    number: int,
    found: CandidateFit,
    leverage: FloatArray,
    sensitive: FloatArray | None,
    *,
    held_out: bool,
) -> FittedTrial:
    data = problem.trials[number]
    trial = data.trial
    prediction = problem.prediction(number, found.point, found.responses[number])
    residual = problem.residual(number, found.point, found.responses[number])
    variance = 1.0 + leverage if held_out else 1.0 + np.maximum(leverage, 0.0)
    if found.remainder is not None and trial.is_dynamic:
        variance = variance + found.remainder.size[data.groups] ** 2
    rates = None
    if trial.is_dynamic:
        rates = np.gradient(prediction, trial.interval, axis=0)
    return FittedTrial(
        trial=trial,
        prediction=prediction,
        residual=residual * data.deviation,  # what a remainder takes up is what is left
        noise_deviation=data.deviation,
        predictive_deviation=data.deviation * np.sqrt(np.maximum(variance, 1e-9)),
        leverage=leverage,
        rates=rates,
        sensitivity=sensitive,
    )
