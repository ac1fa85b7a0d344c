"""The whole way from a campaign to the calibration of a model's parameters."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import Literal

import numpy as np
from scipy.special import ndtr
from scipy.stats import truncnorm

from calibration.result.record import Calibration, ChannelFit, ParameterPrior, correlation, prior_samples
from discrepancy.campaign.records import Campaign, FloatArray
from discrepancy.checks.fault import DataFault, FaultKind
from discrepancy.checks.model_check import LEFT
from discrepancy.errors import CampaignDataError, ModelError, said
from discrepancy.fits.gates import check_absolute_fit
from discrepancy.fits.problem import Problem
from discrepancy.model_choice import ModelChoice
from discrepancy.parameters.posterior import ParameterPosterior, parameter_posterior
from discrepancy.search.wide_noise import residual_process_of
from discrepancy.verdict import Gate
from discrepancy.workflow import checked, without_wrong_ends
from reporting.progress import Progress, reporter
from reporting.provenance import collect_provenance
from reporting.words import counted, small

SAMPLES = 1000


def calibrate_parameters(
    campaign: Campaign,
    choice: ModelChoice,
    *,
    asset: str | None = None,
    samples: int = SAMPLES,
    seed: int = 0,
    progress: Progress | None = None,
) -> Calibration:
    """Return the posterior of a model's parameters under a campaign, nothing being missing of the model.

    Trials that the campaign marks as held out are not fitted; their residuals are told.

    Parameters
    ----------
    campaign : Campaign
        Its `parameters` replace priors of the model.
    choice : ModelChoice
        The model and where it comes from.
    asset : str, optional
        Name of what was measured; that of the campaign if left out.
    samples : int
        Of the posterior, and of the prior.
    seed : int
        Of the samples.
    progress : Progress, optional
        Where to report.

    Raises
    ------
    CampaignDataError
        If the data are at fault, or state a parameter that the model does not have.
    ModelError
        If the model has no parameter to calibrate, or fails.
    CalibrationRecordError
        If the name of the asset cannot be printed.
    """
    progress = reporter(progress)
    model = choice.model
    priors = stated_priors(campaign, choice)  # before the model is asked, which may refuse what is outside
    with progress.stage("Checking the data"):
        campaign, faults = checked(campaign, model, hold_out=False)
    fatal = [fault for fault in faults if fault.fatal]
    if fatal:
        raise CampaignDataError(fatal[0].sentence)
    problem = without_wrong_ends(campaign, model)
    campaign = problem.campaign
    with progress.stage("Posterior of the parameters"):
        posterior = parameter_posterior(problem, samples, seed)
    best = posterior.optima[0]  # what noise is coloured like, beyond what its record tells, is no gap
    gate = check_absolute_fit(problem, replace(best, residual_process=residual_process_of(problem, best)))
    hashes = {"campaign": campaign.data_hash, "model": choice.source_hash}
    return Calibration(
        asset=campaign.name if asset is None else asset,
        model=model.name,
        model_hash=choice.source_hash,
        procedure=posterior.procedure,
        priors=priors,
        samples=posterior.marginal.values(posterior.draws),
        prior_samples=prior_samples(priors, samples, seed),
        explained=gate.passed,
        findings=findings(priors, posterior, gate, faults, campaign.remarks),
        channels=_channels(problem, posterior),
        source=campaign.name,
        seed=seed,
        provenance=collect_provenance(seed, input_hashes=hashes).as_dict(),
        design_hash=choice.design_hash,
    )


def stated_priors(campaign: Campaign, choice: ModelChoice) -> tuple[ParameterPrior, ...]:
    """Return the parameters that have a prior deviation, as the campaign or the model's file states them.

    Raises
    ------
    ModelError
        If there is none.
    CampaignDataError
        If the campaign states a mean outside the range of the model.
    """
    label = choice.label or choice.model.name
    found = []
    moments = choice.model.stated(campaign)
    for item, (mean, deviation) in zip(choice.model.parameters, moments, strict=True):
        if not item.low <= mean <= item.high:
            raise CampaignDataError(said("parameters.outside", item=item, mean=mean, model=label))
        if deviation > 0.0:
            stated = "the campaign" if item.name in campaign.parameters else label
            found.append(replace(item, mean=mean, deviation=deviation, stated_by=stated, title=""))
    if not found:
        names = [item.name for item in choice.model.parameters]
        known = f"all of {', '.join(names)} have the deviation 0" if names else "it lists none"
        raise ModelError(said("parameters.none", model=label, known=known))
    return tuple(found)


def _channels(problem: Problem, posterior: ParameterPosterior) -> tuple[ChannelFit, ...]:
    """Return the residuals of each channel at the prior means and at the optimum."""
    marginal = posterior.marginal
    found: list[ChannelFit] = []
    best = posterior.optima[0].point.shared[marginal.free]
    parts: dict[Literal["fitted", "held out"], Problem] = {"fitted": problem}
    if problem.campaign.held_out:
        parts["held out"] = problem.with_trials(problem.campaign.held_out)
    for trials, part in parts.items():
        fits = [marginal.fitted(u, part) for u in (np.zeros_like(best), best)]
        for number, name in enumerate(part.channel_names):
            count = int(part.counts[number])
            if not count:
                continue
            before, after = (
                float(np.sqrt(item.sums[number] / count)) if part.freedom[number] > 0.0 else np.nan
                for item in fits
            )
            found.append(ChannelFit(name, trials, count, before, after))
    return tuple(found)


# ---------------------------------------------------------------- what it says


FAR = 3.0
"""Prior deviations from which on a posterior mean is remarked on."""
TIED = 0.95
"""Correlation from which on two parameters are told together rather than one by one."""
EDGE = 0.02
"""Share of a posterior beyond the model's range from which on it is remarked on, where the parameter is told:
one that is not is cut off as its prior is."""

REFUSED = 4.0
"""Standard deviations from the optimum within which a place that the model refuses is remarked on."""


def findings(
    priors: tuple[ParameterPrior, ...],
    posterior: ParameterPosterior,
    gate: Gate,
    faults: tuple[DataFault, ...],
    remarks: tuple[str, ...],
) -> tuple[str, ...]:
    """Return all sentences: what disagrees first, then what the campaign does not tell, then remarks."""
    found: list[str] = []
    if gate.passed is False:
        found.append(said("parameters.not_explained", reason=small(gate.reason)))
    elif gate.passed is None:
        found.append(gate.reason)
    found += _of_posterior(priors, posterior)
    found += [fault.sentence for fault in faults if fault.kind is not FaultKind.UNOBSERVABLE]
    return (*found, *(text for text in remarks if text not in found))


def _of_posterior(priors: tuple[ParameterPrior, ...], posterior: ParameterPosterior) -> Iterator[str]:
    marginal, optima = posterior.marginal, posterior.optima

    def listed(values: FloatArray) -> str:
        pairs = zip(priors, values.tolist(), strict=True)
        return ", ".join(f"{prior.name} = {value:.4g}" for prior, value in pairs if np.isfinite(value))

    for prior, mean in zip(priors, posterior.draws.mean(axis=0).tolist(), strict=True):
        if abs(mean) > FAR:
            side = "above" if mean > 0.0 else "below"
            yield said("parameters.off_prior", prior=prior, off=abs(mean), side=side)
    best = optima[0].point.shared[marginal.free]
    deviation = np.maximum(np.sqrt(np.diag(optima[0].covariance)[marginal.free]), 1e-12)
    beyond = ndtr((marginal.low - best) / deviation) + ndtr((best - marginal.high) / deviation)
    told = kept_shares(posterior) <= LEFT
    for prior, share, known in zip(priors, beyond.tolist(), told.tolist(), strict=True):
        if known and share > EDGE:
            yield said("parameters.cut_off", prior=prior)
    missing = [item for item in marginal.refused if _told_apart(posterior, item[0]) < REFUSED]
    if missing:
        place, reason = missing[0]
        where = {"count": counted(len(missing), "place"), "places": listed(marginal.values(place))}
        yield said("parameters.refused", reason=reason.rstrip("."), **where)
    if len(optima) > 1:
        evidence = np.array([item.log_evidence for item in optima])
        weight = np.exp(evidence - evidence.max())
        values = [listed(marginal.values(item.point.shared[marginal.free])) for item in optima]
        shares = zip(values, (weight / weight.sum()).tolist(), strict=True)
        places = " and ".join(f"{there} ({share:.0%})" for there, share in shares)
        yield said("parameters.maxima", count=len(optima), places=places)
    if not optima[0].converged:
        yield said("parameters.not_settled")
    for prior, share in zip(priors, kept_shares(posterior).tolist(), strict=True):
        if share > LEFT:
            left = "all" if share > 0.995 else f"{100.0 * share:.0f} %"
            yield said("parameters.not_told", prior=prior, left=left)
    matrix = correlation(posterior.draws)
    for (at, first), (beside, second) in combinations(enumerate(priors), 2):
        if abs(matrix[at, beside]) > TIED:
            yield said("parameters.tied", first=first, second=second, value=matrix[at, beside])


def _told_apart(posterior: ParameterPosterior, u: FloatArray) -> float:
    """Return how far from the best optimum scaled parameters (P,) are [standard deviations]; NaN: any."""
    known = np.flatnonzero(np.isfinite(u))
    index, best = posterior.marginal.free[known], posterior.optima[0]
    shift = u[known] - best.point.shared[index]
    return float(np.sqrt(shift @ np.linalg.solve(best.covariance[np.ix_(index, index)], shift)))


def kept_shares(posterior: ParameterPosterior) -> FloatArray:
    """Return the deviation of each parameter (P,) over that of its prior, cut off at its range [1]."""
    marginal = posterior.marginal
    return np.asarray(posterior.draws.std(axis=0, ddof=1) / truncnorm.std(marginal.low, marginal.high))
