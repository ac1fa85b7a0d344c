"""The whole way from a campaign to the calibration of a model's parameters."""

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.result.record import Calibration, ChannelFit, ParameterPrior, prior_samples
from discrepancy.campaign.records import Campaign
from discrepancy.catalogue.entry import Setting
from discrepancy.errors import CampaignDataError, ModelError
from discrepancy.fits.gates import absolute_gate
from discrepancy.fits.problem import Problem
from discrepancy.model_choice import ModelChoice
from discrepancy.parameters.findings import findings
from discrepancy.parameters.posterior import ParameterPosterior, parameter_posterior
from discrepancy.workflow import checked, without_wrong_ends
from reporting.progress import Progress, SilentProgress
from reporting.provenance import collect_provenance

FloatArray = NDArray[np.float64]

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
    progress = SilentProgress() if progress is None else progress
    model = choice.model
    priors = stated_priors(campaign, choice)  # before the model is asked, which may refuse what is outside
    with progress.stage("Checking the data"):
        campaign, faults = checked(campaign, model, hold_out=False)
    fatal = [fault for fault in faults if fault.fatal]
    if fatal:
        raise CampaignDataError(fatal[0].sentence)
    problem = Problem(campaign, model, Setting(campaign, model, model.scales(campaign)))
    cleaned = without_wrong_ends(problem)
    if cleaned is not campaign:
        campaign = cleaned
        problem = Problem(campaign, model, Setting(campaign, model, model.scales(campaign)))
    with progress.stage("Posterior of the parameters"):
        posterior = parameter_posterior(problem, samples, seed)
    gate = absolute_gate(problem, posterior.optima[0])
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
    for item in choice.model.parameters:
        mean, deviation = campaign.parameters.get(item.name, (item.mean, item.deviation))
        if not item.low <= mean <= item.high:
            raise CampaignDataError(
                f"The campaign states {item.name} = {mean:g}, outside the range {item.low:g} to "
                f"{item.high:g} in which {label} holds: correct [parameters.{item.name}], or widen the range "
                "in the model's file."
            )
        if deviation > 0.0:
            stated = "the campaign" if item.name in campaign.parameters else label
            found.append(replace(item, mean=mean, deviation=deviation, stated_by=stated, title=""))
    if not found:
        names = [item.name for item in choice.model.parameters]
        known = f"all of {', '.join(names)} have the deviation 0" if names else "it lists none"
        raise ModelError(
            f"The model {label} has no parameter to calibrate: {known}; give a [[parameter]] with name, "
            "mean, deviation, low and high in its file."
        )
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
