"""Residuals of a fit with what their variance should be, for locating, proof and report."""

from dataclasses import replace

import numpy as np

from discrepancy.location.residuals import FittedTrial, ResidualSet

from .elimination import trial_block
from .fitting import CandidateFit, fit
from .problem import Problem


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
    fitted = _predicted(problem, found, found, sensitivities=sensitivities)
    held_out = problem.campaign.held_out
    if held_out:
        # what is shared stays as fitted, their own nuisances adapt to them
        there = problem.with_trials(held_out)
        nothing = tuple(np.zeros(data.unknowns.size) for data in there.trials)
        start = replace(found.point, local=nothing)
        adapted = fit(there, found.candidate, start, local_only=True)
        fitted += _predicted(there, found, adapted, held_out=True)
    trials = {item.trial.name: item for item in fitted}
    return ResidualSet(
        problem.campaign.channels,
        tuple(trials[trial.name] for trial in problem.campaign.trials if trial.name in trials),
    )


def _predicted(
    problem: Problem,
    found: CandidateFit,
    adapted: CandidateFit,
    *,
    sensitivities: bool = False,
    held_out: bool = False,
) -> list[FittedTrial]:
    """Return trials beside their predictions, by what was found and its nuisances as adapted to them."""
    root = np.linalg.cholesky(found.covariance + 1e-14 * np.eye(len(found.covariance)))
    at, items = len(root), []
    total = at + sum(data.unknowns.size for data in problem.trials)
    ones, counted = np.ones(len(problem.channel_names)), float(found.remainder is None)
    for number, data in enumerate(problem.trials):
        block = trial_block(problem, number, adapted, adapted.candidate, ones)
        local, shared = block.derivatives.dense()
        own = block.factor.half(local)
        # local unknowns follow the shared ones: J_s - J_l A^-1 B, then what is their own
        follow = (shared - block.followed.T @ local).T @ root[block.index]
        taken, carried = np.einsum("kn,kn->n", own, own), np.einsum("nk,nk->n", follow, follow)
        shape = adapted.residuals[number].shape
        if held_out:
            leverage = np.maximum(counted * carried - taken, -1.0 + 1e-9)
            variance = 1.0 + np.maximum(carried - taken, -1.0 + 1e-9).reshape(shape)
        else:
            leverage = np.minimum(taken + counted * carried, 1.0)
            variance = 1.0 + np.maximum(leverage, 0.0).reshape(shape)
        if found.remainder is not None and data.trial.is_dynamic:
            variance = variance + found.remainder.size[data.groups] ** 2
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
                trial=data.trial,
                prediction=prediction,
                residual=residual * data.deviation,  # what a remainder takes up is what is left
                noise_deviation=data.deviation,
                predictive_deviation=data.deviation * np.sqrt(np.maximum(variance, 1e-9)),
                leverage=leverage.reshape(shape),
                rates=np.gradient(prediction, data.trial.interval, axis=0) if data.trial.is_dynamic else None,
                sensitivity=sensitive,
            )
        )
    return items
