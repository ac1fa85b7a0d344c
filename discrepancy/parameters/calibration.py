"""Calibration: the posterior of a model's parameters given a campaign, with findings in words."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.stats import truncnorm

from calibration.result.record import (
    Calibration,
    ChannelFit,
    ParameterPrior,
    correlation,
    prior_samples,
)
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import BoolArray, Campaign, FloatArray
from discrepancy.checks.fault import DataFault, FaultKind
from discrepancy.checks.model_check import LARGEST_DEVIATION_RATIO
from discrepancy.errors import CampaignDataError, ModelError
from discrepancy.fits.gates import check_absolute_fit
from discrepancy.fits.problem import Problem
from discrepancy.judgement.moved_unknowns import moved_sensors, moved_sentence
from discrepancy.judgement.sensor_estimates import sensor_estimates, sensor_fits
from discrepancy.model_choice import ModelChoice, choose_model
from discrepancy.parameters.posterior import ParameterPosterior, parameter_posterior
from discrepancy.search.wide_noise import estimate_residual_process
from discrepancy.verdict import Gate
from discrepancy.workflow import check_and_prepare, problem_without_wrong_ends
from reporting.progress import Progress, reporter
from reporting.provenance import collect_provenance
from reporting.words import counted, small

SAMPLES = 1000
"""Default number of samples of a calibration."""


def calibrate_parameters(
    campaign: Campaign | str | Path,
    model: ModelChoice | str | Path,
    *,
    asset: str | None = None,
    samples: int = SAMPLES,
    seed: int = 0,
    progress: Progress | None = None,
) -> Calibration:
    """Return the posterior of a model's parameters, assuming that the model lacks no effect.

    Trials that are held out are not fitted; the calibration contains their residuals.

    Parameters
    ----------
    campaign : Campaign, str or Path
        The campaign, or its folder; its `parameters` replace priors of the model.
    model : ModelChoice, str or Path
        The name or the file of a model, as `load_model` takes it, or the record of a chosen model.
    asset : str, optional
        The name of what was measured; that of the campaign by default.
    samples : int
        The number of samples of the posterior, and of the prior.
    seed : int
        The seed of the samples.
    progress : Progress, optional
        Where progress is reported.

    Raises
    ------
    CampaignDataError
        If the data are at fault, or state a parameter that the model does not have.
    ModelError
        If the model has no parameter to calibrate, or cannot be evaluated.
    CalibrationRecordError
        If the name of the asset cannot be printed.
    """
    progress = reporter(progress)
    if not isinstance(campaign, Campaign):
        campaign = read_campaign(campaign)
    choice = model if isinstance(model, ModelChoice) else choose_model(model, progress)
    # before the model is evaluated: it may fail for values outside its range
    priors = stated_priors(campaign, choice)
    with progress.stage("Checking the data"):
        campaign, faults = check_and_prepare(campaign, choice.model, hold_out=False)
    for fault in faults:
        if fault.fatal:
            raise CampaignDataError(fault.sentence)
    problem = problem_without_wrong_ends(campaign, choice.model)
    campaign = problem.campaign
    with progress.stage("Posterior of the parameters"):
        posterior = parameter_posterior(problem, samples, seed)
    # residuals that are correlated as the noise record itself are not a discrepancy
    best = posterior.optima[0]
    best = replace(best, residual_process=estimate_residual_process(problem, best))
    gate = check_absolute_fit(problem, best)
    hashes = {"campaign": campaign.data_hash, "model": choice.source_hash}
    misfits = (
        *_misfit_findings(gate),
        moved_sentence(moved_sensors(problem, best)),
        _repeated_data_finding(campaign, choice),
    )
    return Calibration(
        asset=campaign.name if asset is None else asset,
        model=choice.model.name,
        model_hash=choice.source_hash,
        procedure=posterior.procedure,
        priors=priors,
        samples=posterior.marginal.physical_values(posterior.draws),
        prior_samples=prior_samples(priors, samples, seed),
        explained=gate.passed,
        findings=findings(misfits, priors, posterior, faults, campaign.remarks),
        channels=_channel_fits(problem, posterior),
        source=campaign.name,
        seed=seed,
        provenance=collect_provenance(seed, input_hashes=hashes).as_dict(),
        design_hash=choice.design_hash,
        sensors=sensor_fits(sensor_estimates(problem, best), campaign.channels),
    )


def stated_priors(campaign: Campaign, choice: ModelChoice) -> tuple[ParameterPrior, ...]:
    """Return the uncertain parameters, with the priors of the campaign or the model's file.

    Raises
    ------
    ModelError
        If no parameter is uncertain.
    CampaignDataError
        If the campaign states a mean outside the range of the model.
    """
    model = choice.label or choice.model.name
    priors = []
    moments = choice.model.prior_moments(campaign)
    for parameter, (mean, deviation) in zip(choice.model.parameters, moments, strict=True):
        name = parameter.name
        if not parameter.low <= mean <= parameter.high:
            raise CampaignDataError(
                f"The campaign states {name} = {mean:g}, outside the range {parameter.low:g} to "
                f"{parameter.high:g} in which {model} holds: correct [parameters.{name}], or widen "
                "the range in the model's file."
            )
        if deviation > 0.0 and name not in choice.model.nuisance_parameters:
            stated_by = "the campaign" if name in campaign.parameters else model
            priors.append(
                replace(parameter, mean=mean, deviation=deviation, stated_by=stated_by, title="")
            )
    if not priors:
        names = [parameter.name for parameter in choice.model.parameters]
        known = f"all of {', '.join(names)} have the deviation 0" if names else "it lists none"
        raise ModelError(
            f"The model {model} has no parameter to calibrate: {known}; give a [[parameter]] with "
            "name, mean, deviation, low and high in its file."
        )
    return tuple(priors)


def _channel_fits(problem: Problem, posterior: ParameterPosterior) -> tuple[ChannelFit, ...]:
    """Return the rms residuals of each channel at the prior means and at the optimum.

    They are in noise deviations; nan for a channel without a noise record.
    """
    marginal = posterior.marginal
    optimum = posterior.optima[0].point.shared[marginal.parameter_indices]
    prior_mean = np.zeros_like(optimum)
    problems: dict[Literal["fitted", "held out"], Problem] = {"fitted": problem}
    if problem.campaign.held_out:
        problems["held out"] = problem.with_trials(problem.campaign.held_out)
    channel_fits: list[ChannelFit] = []
    for role, problem_of_role in problems.items():
        at_prior_mean = marginal.fit_nuisances(prior_mean, problem_of_role)
        at_optimum = marginal.fit_nuisances(optimum, problem_of_role)
        for index, name in enumerate(problem_of_role.channel_names):
            sample_count = int(problem_of_role.sample_counts[index])
            if not sample_count:
                continue
            # without a noise record, residuals have no noise deviation to be compared with
            rms_at_prior_mean = rms_at_optimum = np.nan
            if problem_of_role.record_freedom[index] > 0.0:
                rms_at_prior_mean = float(
                    np.sqrt(at_prior_mean.squares_by_channel[index] / sample_count)
                )
                rms_at_optimum = float(np.sqrt(at_optimum.squares_by_channel[index] / sample_count))
            channel_fits.append(
                ChannelFit(name, role, sample_count, rms_at_prior_mean, rms_at_optimum)
            )
    return tuple(channel_fits)


# ---------------------------------------------------------------- findings


FAR_FROM_PRIOR = 3.0
"""Distance of a posterior mean from the prior mean, in prior deviations, above which it is
reported."""
TIED_CORRELATION = 0.95
"""Absolute correlation above which two parameters are reported as not determined separately."""
LARGEST_OPEN_RATIO = 0.62
"""Distance of the outermost 2.5 % of the samples from an end of the range, over that of the
outermost 5 %, below which a posterior is reported as cut off there.

It is that of a Gaussian of which the end cuts off 2 %. A posterior is reported only for a parameter
that the data determine, since any other is truncated just as its prior is."""
REFUSAL_DISTANCE = 4.0
"""Distance from the optimum, in standard deviations, within which a failure of the model is
reported."""


def findings(
    misfits: Sequence[str],
    priors: tuple[ParameterPrior, ...],
    posterior: ParameterPosterior,
    faults: tuple[DataFault, ...],
    remarks: tuple[str, ...],
) -> tuple[str, ...]:
    """Return all findings in sentences: misfit, limits of the posterior, faults and remarks.

    Parameters
    ----------
    misfits : sequence of str
        The findings on the fit itself; empty ones are left out.
    priors : tuple of ParameterPrior
        The priors of the parameters.
    posterior : ParameterPosterior
        Their posterior.
    faults : tuple of DataFault
        The faults of the data.
    remarks : tuple of str
        The remarks of the campaign.
    """
    sentences = [sentence for sentence in misfits if sentence]
    sentences += _prior_findings(priors, posterior)
    sentences += _range_findings(priors, posterior)
    sentences += _optimum_findings(priors, posterior)
    sentences += _undetermined_findings(priors, posterior)
    for fault in faults:
        if fault.kind is not FaultKind.UNOBSERVABLE:  # the posterior says so itself
            sentences.append(fault.sentence)
    return (*sentences, *(remark for remark in remarks if remark not in sentences))


def _misfit_findings(gate: Gate) -> Iterator[str]:
    """Yield a finding if the residuals at the optimum are not explained, or cannot be judged."""
    if gate.has_failed:
        yield (
            f"The campaign is not explained by these parameters: {small(gate.reason)} The "
            "posterior is too narrow and may be biased; `uav-twin discrepancy run` on the same "
            "campaign and model looks for what is missing."
        )
    elif gate.passed is None:
        yield gate.reason


def _repeated_data_finding(campaign: Campaign, choice: ModelChoice) -> str:
    """Return a finding if the model has a patch that was found on this campaign; empty if not."""
    patch = choice.built_in
    if patch is None or patch.origin.data_hash != campaign.data_hash:
        return ""
    return (
        f"The patch {choice.label} was found on this campaign, so that its readings count twice: "
        "the posterior standard deviations are too small. Calibrate with other measurements, or "
        "take the parameters of the patch as they are."
    )


def _parameter_values(priors: Sequence[ParameterPrior], values: FloatArray) -> str:
    """Return values (P,) of the parameters as text such as "a = 1, b = 2"; nan is left out."""
    phrases = []
    for prior, value in zip(priors, values.tolist(), strict=True):
        if np.isfinite(value):
            phrases.append(f"{prior.name} = {value:.4g}")
    return ", ".join(phrases)


def _prior_findings(
    priors: Sequence[ParameterPrior], posterior: ParameterPosterior
) -> Iterator[str]:
    """Yield a finding on each parameter whose posterior mean is far from its prior mean."""
    for prior, mean in zip(priors, posterior.draws.mean(axis=0).tolist(), strict=True):
        if abs(mean) > FAR_FROM_PRIOR:
            side = "above" if mean > 0.0 else "below"
            yield (
                f"{prior.name} comes out {abs(mean):.1f} prior deviations {side} what "
                f"{prior.stated_by} states: the prior is wrong, or the parameter stands for "
                "something that the model lacks."
            )


def _range_findings(
    priors: Sequence[ParameterPrior], posterior: ParameterPosterior
) -> Iterator[str]:
    """Yield findings on posteriors at an end of the range, and on failures within it."""
    marginal = posterior.marginal
    is_cut_off = _is_open_at(posterior.draws - marginal.low)
    is_cut_off |= _is_open_at(marginal.high - posterior.draws)
    is_cut_off &= remaining_deviations(posterior) <= LARGEST_DEVIATION_RATIO
    for prior, cut_off in zip(priors, is_cut_off.tolist(), strict=True):
        if cut_off:
            yield (
                f"The posterior of {prior.name} reaches the end of its range, {prior.low:g} to "
                f"{prior.high:g}, and is cut off there: widen the range if the model holds beyond "
                "it."
            )
    # failures of the model within the range, near the optimum
    refusals = [
        refusal
        for refusal in marginal.refusals
        if _distance_from_optimum(posterior, refusal.parameters) < REFUSAL_DISTANCE
    ]
    if refusals:
        first = refusals[0]
        values = _parameter_values(priors, marginal.physical_values(first.parameters))
        yield (
            f"At {counted(len(refusals), 'place')} near the optimum, within the range of the "
            f"parameters, the model cannot be evaluated, first at {values} "
            f"({first.reason.rstrip('.')}): the posterior leaves these places out; correct the "
            "range in the model's file."
        )


def _is_open_at(distances: FloatArray) -> BoolArray:
    """Return for which parameters (P,) the density is not small at an end of the range.

    The outermost 2.5 and 5 % of the samples (N, P) lie at a ratio of distances from the end that
    is one half for a density that is constant there, and nearly one if it vanishes.
    """
    inner, outer = np.quantile(distances, (0.025, 0.05), axis=0)
    return np.asarray(inner <= LARGEST_OPEN_RATIO * outer)


def _optimum_findings(
    priors: Sequence[ParameterPrior], posterior: ParameterPosterior
) -> Iterator[str]:
    """Yield findings on several optima, and on an iteration that did not converge."""
    marginal = posterior.marginal
    optima = posterior.optima
    if len(optima) > 1:
        evidence = np.array([optimum.log_evidence for optimum in optima])
        relative_evidence = np.exp(evidence - evidence.max())
        probabilities = (relative_evidence / relative_evidence.sum()).tolist()
        phrases = []
        for optimum, probability in zip(optima, probabilities, strict=True):
            values = marginal.physical_values(optimum.point.shared[marginal.parameter_indices])
            phrases.append(f"{_parameter_values(priors, values)} ({probability:.0%})")
        yield (
            f"The posterior has {len(optima)} maxima: {' and '.join(phrases)}; the campaign does "
            "not decide between them, and the mean lies between them."
        )
    if not optima[0].converged:
        yield (
            "The fit ended before it converged: the samples may be wrong; state narrower priors."
        )


def _undetermined_findings(
    priors: Sequence[ParameterPrior], posterior: ParameterPosterior
) -> Iterator[str]:
    """Yield findings on parameters that the campaign does not determine, or not separately."""
    for prior, ratio in zip(priors, remaining_deviations(posterior).tolist(), strict=True):
        if ratio > LARGEST_DEVIATION_RATIO:
            remaining = "all" if ratio > 0.995 else f"{100.0 * ratio:.0f} %"
            yield (
                f"The campaign does not determine {prior.name}: its posterior standard deviation "
                f"is {remaining} of the prior one, so that the result is mostly the prior."
            )
    correlations = correlation(posterior.draws)
    for i, j in combinations(range(len(priors)), 2):
        if abs(correlations[i, j]) > TIED_CORRELATION:
            yield (
                f"{priors[i].name} and {priors[j].name} are determined in combination, but hardly "
                f"each of them (correlation {correlations[i, j]:+.3f}): fly with samples of both, "
                "or measure where they act differently."
            )


def _distance_from_optimum(posterior: ParameterPosterior, u: FloatArray) -> float:
    """Return the Mahalanobis distance of parameters from the best optimum [standard deviations].

    Parameters
    ----------
    posterior : ParameterPosterior
        The posterior.
    u : (P,) ndarray
        Scaled parameters; nan for those that are not fixed, which are left out.
    """
    optimum = posterior.optima[0]
    is_known = np.isfinite(u)
    indices = posterior.marginal.parameter_indices[is_known]
    shift = u[is_known] - optimum.point.shared[indices]
    covariance = optimum.covariance[np.ix_(indices, indices)]
    return float(np.sqrt(shift @ np.linalg.solve(covariance, shift)))


def remaining_deviations(posterior: ParameterPosterior) -> FloatArray:
    """Return the posterior over the prior standard deviation of each parameter, (P,).

    The prior is truncated at the range of the parameter.
    """
    marginal = posterior.marginal
    prior_deviations = truncnorm.std(marginal.low, marginal.high)
    return np.asarray(posterior.draws.std(axis=0, ddof=1) / prior_deviations)
