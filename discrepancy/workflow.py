"""From a campaign to a verdict: check, locate, name, prove, propose the next experiment."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from discrepancy.campaign.held_out import choose_held_out
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import BoolArray, Campaign, FloatArray, Trial
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.catalogue.library import load_catalogue
from discrepancy.checks.fault import DataFault, FaultKind
from discrepancy.checks.model_check import check_against_model
from discrepancy.checks.outliers import mark_outliers, wrong_end_readings
from discrepancy.checks.quality import check_data
from discrepancy.errors import CampaignDataError
from discrepancy.fits.beginnings import refit_from_first_readings
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.fitting import fit as fit_to
from discrepancy.fits.gates import time_step_error
from discrepancy.fits.predictive import fit_held_out, residual_set
from discrepancy.fits.problem import Problem
from discrepancy.judgement.decide import comparison_of, reach_verdict
from discrepancy.judgement.exact_sensors import exact_sensor_remarks
from discrepancy.judgement.hypotheses import UNEXPLAINED_GAP, calibrated_parameters
from discrepancy.judgement.next_experiment import next_experiments
from discrepancy.judgement.proof import errors_of_fit, prove_effects
from discrepancy.judgement.remarks import (
    KINDS_OF_NOISE_ALONE,
    KINDS_WITH_NAME,
    KINDS_WITHOUT_GAP,
    look_alike_remark,
    verdict_with_only_sensor,
    verdict_with_times,
    verdict_with_untested_effects,
)
from discrepancy.judgement.sensor_estimates import sensor_estimates
from discrepancy.location.locate import Location, locate, outlier_remarks
from discrepancy.location.residuals import ResidualSet
from discrepancy.missing_force.port_force import MissingForce, missing_force_of_verdict
from discrepancy.missing_force.windows import add_window_sizes, gap_windows, windows_of_residuals
from discrepancy.model_choice import load_model
from discrepancy.pictures import plot_missing_force
from discrepancy.proof_record import Proof
from discrepancy.search.starts import OnProgress
from discrepancy.search.strategy import Search
from discrepancy.search.whole_search import OnSearch, ignore_search
from discrepancy.search_settings import SEARCH
from discrepancy.sources.from_run import RUN_FILE, run_campaign
from discrepancy.system.interface import Model
from discrepancy.system.names_of_model import campaign_in_names_of
from discrepancy.verdict import Experiment, GapWindow, Verdict, VerdictKind, effect_label
from discrepancy.verdict_remarks import (
    effects_not_fitted,
    implausible_value_remarks,
    left_out_modes_remark,
    missing_port_remark,
)
from fe.runtime.patch import ModelPatch
from reporting.progress import Progress, reporter
from reporting.words import brief, is_or_are, rows_of_table

if TYPE_CHECKING:  # it takes long to import
    from matplotlib.axes import Axes

DRAWS = 400
CLOSED_KINDS = (VerdictKind.NOTHING_MISSING, VerdictKind.NAMED, VerdictKind.DATA_ERROR)
"""Verdicts after which no experiment is proposed."""


@dataclass(frozen=True)
class Investigation:
    """Results of an investigation.

    Attributes
    ----------
    campaign : Campaign
        The campaign as it was used, with outliers marked and held-out trials chosen.
    model : Model
        The model without effects.
    faults : tuple of DataFault
        Faults of the data.
    verdict : Verdict
        The conclusion.
    location : Location or None
        Where model and data disagree before an effect is added.
    missing : MissingForce or None
        The force that the model lacks at a port; None if no force is missing, or none can be
        determined.
    proof : Proof or None
        Proof of the effects that are named or most probable; None without effects.
    before, after : ResidualSet or None
        Residuals without and with these effects, over the same noise; None if faults of the data
        stopped the work.
    problem, search, fit : Problem, Search, CandidateFit or None
        The problem that was solved, the search for effects, and the fit that stands for the
        verdict.
    seconds : dict of str to float
        Wall time by stage.
    """

    campaign: Campaign
    model: Model
    faults: tuple[DataFault, ...]
    verdict: Verdict
    location: Location | None = None
    proof: Proof | None = None
    before: ResidualSet | None = None
    after: ResidualSet | None = None
    problem: Problem | None = None
    search: Search | None = None
    fit: CandidateFit | None = None
    seconds: dict[str, float] | None = None
    missing: MissingForce | None = None

    def __repr__(self) -> str:
        return brief(self, campaign=self.campaign.name, model=self.model.name, verdict=self.verdict)

    def _repr_html_(self) -> str:
        """Return the verdict, for a notebook."""
        return self.verdict._repr_html_()

    def plot(self, axes: "Axes | Sequence[Axes] | None" = None) -> "list[Axes]":
        """Draw the force that the model lacks over time, see `plot_missing_force`."""
        return plot_missing_force(self, axes)


def investigate(
    campaign: Campaign | str | Path,
    model: Model | str | Path | None = None,
    effects: Sequence[Effect] | None = None,
    *,
    seed: int = 0,
    thorough: bool = True,
    progress: Progress | None = None,
    on_search: OnSearch = ignore_search,
) -> Investigation:
    """Find what a model lacks in comparison with measured data, and prove it on held-out trials.

    Parameters
    ----------
    campaign : Campaign or path
        Measured data: a campaign, its folder, or the folder of a mission whose flight is meant.
    model : Model or path, optional
        The model that is compared with the data, as `load_model` takes it. The default is the model
        of the twin if `campaign` is a mission, else the shipped wing.
    effects : sequence of Effect, optional
        The catalogue; by default the shipped one with the user's installed entries.
    seed : int
        Seed of all draws.
    thorough : bool
        False to leave out the map of residuals and the next experiment, for studies over many
        campaigns.
    progress : Progress, optional
        Where progress is reported.
    on_search : callable, optional
        Called with each search as it begins, to follow it.

    Raises
    ------
    DiscrepancyError
        If the campaign cannot be compared with the model at all.
    """
    campaign, model = _read_input(campaign, model)
    stages = _Stages(progress)
    with stages.stage("Checking the data", "check"):
        campaign, faults = check_and_prepare(campaign, model)
    remarks = [fault.sentence for fault in faults]
    fatal = [fault for fault in faults if fault.fatal]
    if fatal:
        kind = VerdictKind.DATA_ERROR
        verdict = Verdict(kind, fatal[0].sentence, nan, nan, remarks=tuple(remarks))
        return Investigation(campaign, model, faults, verdict, seconds=stages.seconds)
    searching = "Fitting the known parameters, and searching the catalogue"
    with stages.stage(searching, "name") as show_message:
        problem = problem_without_wrong_ends(campaign, model)
        campaign = problem.campaign
        catalogue = load_catalogue() if effects is None else effects
        verdict, search, fit = reach_verdict(
            problem, catalogue, on_progress=show_message, on_search=on_search
        )
        verdict = verdict_with_untested_effects(verdict, problem.setting, catalogue)
        verdict = verdict_with_only_sensor(verdict, campaign)
    remarks += _remarks(problem, catalogue, verdict, search, fit)
    with stages.stage("Checking the time steps", "steps"):
        remarks += _remarks_on_time_steps(problem, fit)
    with stages.stage("Residuals", "residuals"):
        before = search.residuals(search.no_effect)
        if thorough:
            before = residual_set(problem, search.no_effect)
        after = before if fit is search.no_effect else search.residuals(fit)
    location = None
    missing = None
    proof = None
    windows: tuple[GapWindow, ...] = ()
    if thorough:
        with stages.stage("Locating the gap", "locate"):
            location = locate(before, seed=seed)
            no_force_is_left = _laws_leave_no_force(verdict, search, fit)
            windows = gap_windows(problem, fit, before, leaves_no_force=no_force_is_left, seed=seed)
            if after is not before:
                windows += windows_of_residuals(after, seed=seed, with_effect=True)
            windows = add_window_sizes(windows, before, after)
            remarks += [text for text in location.remarks if text not in remarks]
            remarks += outlier_remarks(after)  # a wrong reading stays far out whatever is added
    if thorough and verdict.kind not in KINDS_WITHOUT_GAP and not verdict.unfitted:
        with stages.stage("Estimating the missing force", "force"):
            missing = missing_force_of_verdict(
                problem,
                search.force_search,
                search.estimate_of(fit.candidate),
                fit,
                is_named=verdict.kind is not VerdictKind.UNEXPLAINED,
            )
    if fit.candidate.terms:
        with stages.stage("Proving on held-out trials", "prove"):
            errors = errors_of_fit(search, fit)
            proof = prove_effects(
                before, after, errors=errors, effects=effect_labels(fit), seed=seed
            )
    if missing is not None and verdict.sentence == UNEXPLAINED_GAP:
        verdict = replace(verdict, sentence=missing.at_port.sentence)
    fit_of_sensors, fit_of_parameters = _fits_of_estimates(verdict, search, fit)
    experiments: tuple[Experiment, ...] = ()
    if thorough and verdict.kind not in CLOSED_KINDS:
        with stages.stage("Looking for the next experiment", "next"):
            experiments = next_experiments(problem, comparison_of(search).open_hypotheses())
    verdict = replace(
        verdict_with_times(verdict, windows),
        remarks=tuple(remarks),
        next_experiments=experiments,
        not_fitted=effects_not_fitted(problem.setting, catalogue, search),
        windows=windows,
        parameters=calibrated_parameters(problem, fit_of_parameters),
        sensors=sensor_estimates(problem, fit_of_sensors),
        force=None if missing is None else missing.at_port,
    )
    return Investigation(
        campaign=campaign,
        model=model,
        faults=faults,
        verdict=verdict,
        location=location,
        proof=proof,
        before=before,
        after=after,
        problem=problem,
        search=search,
        fit=fit,
        seconds=stages.seconds,
        missing=missing,
    )


class _Stages:
    """The stages of an investigation: each is reported to the user, and its duration is kept.

    Attributes
    ----------
    seconds : dict of str to float
        Wall time of the finished stages by their keys [s].
    """

    def __init__(self, progress: Progress | None) -> None:
        self.seconds: dict[str, float] = {}
        self._reporter = reporter(progress)

    @contextmanager
    def stage(self, description: str, key: str) -> Iterator[OnProgress]:
        """Report a stage of the work, and yield the function that shows messages in it."""
        start = time.perf_counter()
        with self._reporter.stage(description) as shown_stage:
            yield lambda message: shown_stage.advance(0, message)
        self.seconds[key] = time.perf_counter() - start


def _remarks_on_time_steps(problem: Problem, fit: CandidateFit) -> list[str]:
    """Return a remark if the error of the time steps may be visible in the noise; else nothing."""
    step_error = time_step_error(problem, fit)
    if step_error <= SEARCH.largest_step_error:
        return []
    return [
        f"The time steps cost up to {step_error:.2g} of the noise (rms), more than the "
        f"permitted {SEARCH.largest_step_error:g}: probabilities may be too sharp."
    ]


def _fits_of_estimates(
    verdict: Verdict, search: Search, fit: CandidateFit
) -> tuple[CandidateFit, CandidateFit]:
    """Return the fit from which sensors are estimated, and the one for the parameters.

    Sensors are estimated beside the effects of `fit` only if these are named, else without effects.
    Parameters are estimated beside the effects also if these have no name, unless there is no gap.
    """
    has_unnamed_effects = bool(fit.candidate.terms) and verdict.kind not in KINDS_WITH_NAME
    fit_of_sensors = search.no_effect if has_unnamed_effects else fit
    fit_of_parameters = fit_of_sensors if verdict.kind in KINDS_WITHOUT_GAP else fit
    return fit_of_sensors, fit_of_parameters


def effect_labels(fit: CandidateFit) -> tuple[str, ...]:
    """Return the effects of a fit with their places, sorted, as `Hypothesis.labels` has them."""
    terms = fit.candidate.terms
    labels = [
        effect_label(term.effect.identifier, term.place, free_shape=term.free_shape)
        for term in terms
    ]
    return tuple(sorted(labels))


def _laws_leave_no_force(verdict: Verdict, search: Search, fit: CandidateFit) -> bool:
    """Return whether the effects of a verdict explain the whole force that the model lacks.

    The answer is no if none of the effects is a law at a port, or if one acts only in some
    stretches of time. The answer is yes for kinds of verdict whose effects leave only noise when
    they are simulated. Otherwise the estimate of the missing force beside these effects decides.
    """
    terms = fit.candidate.terms
    has_law = any(term.port in search.problem.model.ports for term in terms)
    acts_throughout = not any(term.effect.variant_of for term in terms)
    if not has_law or not acts_throughout:
        return False
    if verdict.kind in KINDS_OF_NOISE_ALONE:
        return True
    estimate = search.estimate_of(fit.candidate)
    return estimate is not None and estimate.leaves_no_force


def _remarks(
    problem: Problem,
    catalogue: Sequence[Effect],
    verdict: Verdict,
    search: Search,
    fit: CandidateFit,
) -> list[str]:
    """Return the remarks of the campaign, and those on the fit, the catalogue and the model."""
    remarks = [*problem.campaign.remarks]
    remarks += implausible_value_remarks(problem, fit)
    remarks += missing_port_remark(problem.setting, catalogue)
    if verdict.kind not in KINDS_WITHOUT_GAP:
        remarks += exact_sensor_remarks(problem, search.no_effect)
    look_alikes = look_alike_remark(verdict, search.effects)
    if look_alikes is not None:
        remarks.append(look_alikes)
    if verdict.kind is VerdictKind.UNEXPLAINED:
        left_out_modes = left_out_modes_remark(problem)
        if left_out_modes is not None:
            remarks.append(left_out_modes)
    if len(problem.model.parameters) == len(problem.model.nuisance_parameters):
        remarks.append(
            f"The model {problem.model.name!r} has no uncertain parameter, so that a small error "
            "in stiffness or damping can be mistaken for an effect: give it uncertain parameters "
            "with their standard deviations."
        )
    if fit.candidate.terms and not fit.converged:
        remarks.append(
            "The fit of the verdict ended before it converged: its intervals may be too narrow."
        )
    return remarks


def _read_input(
    campaign: Campaign | str | Path, model: Model | str | Path | None
) -> tuple[Campaign, Model]:
    """Return campaign and model, read from files where paths are given.

    For the folder of a mission, the default of the model is that of its twin.
    """
    if not isinstance(campaign, Campaign):
        is_run_folder = (Path(campaign) / RUN_FILE).is_file()
        if is_run_folder and model is None:
            model = Path(campaign)
        campaign = run_campaign(campaign) if is_run_folder else read_campaign(Path(campaign))
    if model is None or isinstance(model, str | Path):
        model = load_model(model)
    return campaign, model


def check_and_prepare(
    campaign: Campaign, model: Model, *, hold_out: bool = True
) -> tuple[Campaign, tuple[DataFault, ...]]:
    """Return the campaign as it is investigated, and the faults of its data.

    Outputs and load places have the names of the model, outliers are marked, and trials are held
    out.

    Parameters
    ----------
    campaign : Campaign
        The campaign as it was read.
    model : Model
        The model without a patch.
    hold_out : bool
        False to hold out only the trials that the campaign marks.

    Raises
    ------
    CampaignDataError
        If the campaign states a calibrated parameter that the model does not have.
    """
    names = [parameter.name for parameter in model.parameters]
    for parameter in campaign.parameters:
        if parameter not in names:
            raise CampaignDataError(
                f"The campaign states the parameter {parameter!r}, which {model.name} does not "
                f"have; it has {', '.join(names) or 'none'}: correct the name, or leave "
                f"[parameters.{parameter}] out."
            )
    campaign = campaign_in_names_of(campaign, model)
    faults = check_data(campaign)
    campaign = mark_outliers(campaign)
    faults = (*faults, *check_against_model(campaign, model))
    return choose_held_out(campaign) if hold_out else campaign, faults


def problem_without_wrong_ends(campaign: Campaign, model: Model) -> Problem:
    """Return the problem of a campaign and a model, with wrong readings at record ends left out.

    Wrong readings are found in the residuals of a fit without effects, which need not describe the
    data well; `outliers.wrong_end_readings` states the rule. A remark reports them for each channel
    and trial, unless the campaign accepts outliers there.
    """
    problem = Problem(campaign, model, Setting(campaign, model, model.scales(campaign)))
    first_fit = fit_to(problem, Candidate(), problem.prior_mean_point(Candidate()))
    no_effect = refit_from_first_readings(problem, first_fit)
    fits = [(problem, no_effect)]
    if problem.campaign.held_out:
        fits.append(fit_held_out(problem, no_effect))
    trials = {trial.name: trial for trial in problem.campaign.trials}
    new_remarks: list[str] = []
    for problem_of_trials, fitted in fits:
        for data, residual in zip(problem_of_trials.trials, fitted.residuals, strict=True):
            trial = trials[data.trial.name]
            if not trial.is_dynamic:
                continue
            # Residuals (N, C) are in units of the noise, whose deviation is thus 1. Without a noise
            # record it counts as not known, which is 0 here.
            has_noise = [campaign.channels[name].noise is not None for name in trial.channels]
            noise = np.array(has_noise, dtype=float)
            is_wrong = wrong_end_readings(residual, data.weight > 0.0, noise)
            is_wrong &= ~_accepts_outliers(campaign, trial)
            for column in np.flatnonzero(is_wrong.any(axis=0)):
                rows = np.flatnonzero(is_wrong[:, column]).tolist()
                new_remarks.append(
                    f"{len(rows)} of {len(is_wrong)} readings of {trial.channels[column]!r} at the "
                    f"ends of the trial {trial.name!r} ({rows_of_table(rows)}) "
                    f"{is_or_are(len(rows))} far from both model and neighbours, and left out."
                )
            trials[trial.name] = replace(trial, used=trial.used & ~is_wrong)
    if not new_remarks:
        return problem
    remarks = (*problem.campaign.remarks, *new_remarks)
    campaign = replace(problem.campaign, trials=tuple(trials.values()), remarks=remarks)
    return Problem(campaign, problem.model, replace(problem.setting, campaign=campaign))


def _accepts_outliers(campaign: Campaign, trial: Trial) -> BoolArray:
    """Return whether the campaign accepts outliers in each channel (C,) of a trial."""
    fault = FaultKind.OUTLIERS.value
    return np.array(
        [fault in campaign.accepted_faults(name, trial.name) for name in trial.channels]
    )


def patch_draws(
    problem: Problem, fit: CandidateFit, seed: int, count: int = DRAWS
) -> list[list[ModelPatch]]:
    """Return the patches of each effect of a fit at draws of its posterior.

    The draws are taken from the posterior draws of the fit if it has some, else from the Gaussian
    approximation.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    fit : CandidateFit
        The fit.
    seed : int
        Seed of the draws.
    count : int
        Number of draws.

    Returns
    -------
    list of list of ModelPatch
        For each effect, its patch at each draw.
    """
    patches_by_draw = []
    for effect_parameters in _effect_draws(fit, seed, count):
        patches_by_draw.append(fit.candidate.patches(problem.setting, effect_parameters))
    # from a list of effects for each draw to a list of draws for each effect
    return [list(patches_of_effect) for patches_of_effect in zip(*patches_by_draw, strict=True)]


def _effect_draws(fit: CandidateFit, seed: int, count: int) -> FloatArray:
    """Return draws (count, E) of the E scaled effect parameters of a fit from its posterior."""
    generator = np.random.default_rng(seed)
    if fit.draws is not None:
        return np.asarray(generator.choice(fit.draws, count))
    # Gaussian approximation, by the Cholesky factor of the covariance (E, E). The diagonal is
    # raised slightly, because the matrix may be singular to rounding.
    size = fit.candidate.parameter_count
    covariance = fit.whole_effect_covariance + 1e-15 * np.eye(size)
    cholesky_factor = np.linalg.cholesky(covariance)
    standard_normal = generator.standard_normal((count, size))
    return np.asarray(fit.point.effect + standard_normal @ cholesky_factor.T)
