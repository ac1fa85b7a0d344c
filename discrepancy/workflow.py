"""The whole way from a campaign to a verdict: check, locate, name, prove, propose the next experiment."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import isnan, nan
from pathlib import Path

import numpy as np

from discrepancy.campaign.held_out import choose_held_out
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import BoolArray, Campaign, Trial
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.catalogue.library import load_catalogue
from discrepancy.catalogue.needs import NO_PORT
from discrepancy.checks.fault import DataFault, FaultKind
from discrepancy.checks.model_check import check_against_model
from discrepancy.checks.outliers import mark_outliers, wrong_ends
from discrepancy.checks.quality import check_data
from discrepancy.errors import CampaignDataError, said
from discrepancy.fits.beginnings import refit_from_first_readings
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.fitting import fit as fit_to
from discrepancy.fits.gates import time_step_error
from discrepancy.fits.predictive import held_out_fit, residual_set
from discrepancy.fits.problem import Problem
from discrepancy.judgement.conclusion import calibrated_parameters
from discrepancy.judgement.exact_sensors import exact_sensor_remarks
from discrepancy.judgement.naming import reach_verdict
from discrepancy.judgement.next_experiment import next_experiments
from discrepancy.judgement.proof import prove
from discrepancy.judgement.remarks import NO_GAP, look_alike_remark, with_date, with_untested
from discrepancy.location.locate import Location, locate, outlier_remarks
from discrepancy.location.residuals import ResidualSet
from discrepancy.missing_force.port_force import MissingForce, seen_force
from discrepancy.missing_force.windows import gap_windows, residual_windows, sized_windows
from discrepancy.model_choice import load_model
from discrepancy.proof_record import Proof
from discrepancy.search.starts import OnProgress
from discrepancy.search.strategy import Search
from discrepancy.search.whole_search import OnSearch, ignore_search
from discrepancy.search_settings import SEARCH
from discrepancy.sources.from_run import RUN_FILE, run_campaign
from discrepancy.system.interface import Model
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.verdict import Experiment, GapWindow, NotFitted, Verdict, VerdictKind, effect_label
from fe.runtime.patch import ModelPatch
from reporting.progress import Progress, reporter
from reporting.words import brief, is_or_are, listing

DRAWS = 400
IMPLAUSIBLE = 4.0
"""Prior deviations from which on a parameter or a gain is remarked on."""
CLOSED_KINDS = (VerdictKind.NOTHING_MISSING, VerdictKind.NAMED, VerdictKind.DATA_ERROR)
"""Verdicts after which no experiment is proposed."""


@dataclass(frozen=True)
class Investigation:
    """All that came out.

    Attributes
    ----------
    campaign : Campaign
        As used: outliers marked, held-out trials chosen.
    model : Model
        The model as it was.
    faults : tuple of DataFault
        What is wrong with the data.
    verdict : Verdict
        The conclusion.
    location : Location or None
        Where model and data disagree, before anything is added.
    missing : MissingForce or None
        The force that the model lacks at a port; None where there is none, or none can be seen.
    proof : Proof or None
        Where an effect was named, or is the most probable one.
    before, after : ResidualSet or None
        Residuals without and with it, over the same noise; None where faults of the data stopped the work.
    problem, search, fit : Problem, Search, CandidateFit or None
        What the naming side worked with; `fit` stands for the verdict.
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
    """Find out what a model lacks.

    Parameters
    ----------
    campaign : Campaign or path
        Measured data: a campaign, its folder, or the folder of a mission whose flight is meant.
    model : Model or path, optional
        The model that is to explain them, as `load_model` takes it: that of the mission's twin if left out
        beside a mission, else the shipped wing.
    effects : sequence of Effect, optional
        The catalogue; the shipped one with the user's installed entries if left out.
    seed : int
        Of all draws.
    thorough : bool
        False: no map of residuals and no next experiment, for studies over many campaigns.
    progress : Progress, optional
        Where to report.
    on_search : callable, optional
        Takes each search as it begins, to look at while it goes on.

    Returns
    -------
    Investigation
        Verdict, evidence, proof.

    Raises
    ------
    DiscrepancyError
        If the campaign cannot be compared with the model at all.
    """
    campaign, model = _given(campaign, model)
    shown, seconds = reporter(progress), {}

    @contextmanager
    def stage(description: str, key: str) -> Iterator[OnProgress]:
        began = time.perf_counter()
        with shown.stage(description) as under_way:
            yield lambda what: under_way.advance(0, what)
        seconds[key] = time.perf_counter() - began

    with stage("Checking the data", "check"):
        campaign, faults = checked(campaign, model)
    remarks = [fault.sentence for fault in faults]
    fatal = [fault for fault in faults if fault.fatal]
    if fatal:
        kind = VerdictKind.DATA_ERROR
        verdict = Verdict(kind, fatal[0].sentence, nan, nan, remarks=tuple(remarks))
        return Investigation(campaign, model, faults, verdict, seconds=seconds)
    with stage("Fitting what is known, and searching the catalogue", "name") as tell:
        problem = without_wrong_ends(campaign, model)
        campaign, setting = problem.campaign, problem.setting
        catalogue = load_catalogue() if effects is None else effects
        verdict, search, fit = reach_verdict(problem, catalogue, on_progress=tell, on_search=on_search)
        verdict = with_untested(verdict, setting, catalogue)
    remarks += _remarks(problem, catalogue, verdict, search, fit)
    with stage("Checking the time steps", "steps"):
        share = time_step_error(problem, fit)
        if share > SEARCH.solver_share:
            remarks.append(said("remarks.time_steps", share=share, wanted=SEARCH.solver_share))
    with stage("Residuals", "residuals"):
        before = residual_set(problem, search.no_effect, sensitivities=thorough)
        after = residual_set(problem, fit, sensitivities=False) if fit is not search.no_effect else before
    location, missing, proof = None, None, None
    windows: tuple[GapWindow, ...] = ()
    if thorough:
        with stage("Locating the gap", "locate"):
            location = locate(before, seed=seed)
            windows = gap_windows(problem, fit, before, seed=seed)
            if after is not before:
                windows += residual_windows(after, seed=seed, with_effect=True)
            windows = sized_windows(windows, before, after)
            remarks += [text for text in location.remarks if text not in remarks]
            remarks += outlier_remarks(after)  # a wrong reading stays far out whatever is added
    if thorough and verdict.kind not in NO_GAP and not verdict.unfitted:
        with stage("Seeing the missing force", "force"):
            missing = seen_force(problem, search.force_search, search.force_hypotheses, fit)
    if fit.candidate.terms:
        with stage("Proving on held-out trials", "prove"):
            proof = prove(before, after, effects=added_effects(fit), seed=seed)
    experiments: tuple[Experiment, ...] = ()
    if thorough and verdict.kind not in CLOSED_KINDS:
        with stage("Looking for the next experiment", "next"):
            experiments = next_experiments(problem, open_hypotheses(search))
    verdict = replace(
        verdict, sentence=with_date(verdict, windows), remarks=tuple(remarks), next_experiments=experiments,
        not_fitted=not_fitted(problem.setting, catalogue, search), windows=windows,
        parameters=calibrated_parameters(problem, fit), force=None if missing is None else missing.at_port,
    )  # fmt: skip
    return Investigation(
        campaign, model, faults, verdict, location, proof, before, after, problem, search, fit, seconds,
        missing,
    )  # fmt: skip


def added_effects(fit: CandidateFit) -> tuple[str, ...]:
    """Return the effects of a fit with their places, sorted, as `Hypothesis.labels` has them."""
    terms = fit.candidate.terms
    labels = [effect_label(term.effect.identifier, term.place, free_shape=term.free_shape) for term in terms]
    return tuple(sorted(labels))


def _remarks(
    problem: Problem, catalogue: Sequence[Effect], verdict: Verdict, search: Search, fit: CandidateFit
) -> list[str]:
    """Return what has to be said beside a verdict."""
    remarks = [*problem.campaign.remarks, *strained(problem, fit), *without_port(problem.setting, catalogue)]
    if verdict.kind not in NO_GAP:
        remarks += exact_sensor_remarks(problem, search.no_effect)
    alike = look_alike_remark(verdict, search.effects)
    remarks += [] if alike is None else [alike]
    if not problem.model.parameters:
        remarks.append(said("remarks.no_parameter", model=problem.model.name))
    if fit.candidate.terms and not fit.converged:
        remarks.append(said("remarks.not_settled"))
    return remarks


def _given(campaign: Campaign | str | Path, model: Model | str | Path | None) -> tuple[Campaign, Model]:
    """Return campaign and model, read where a path was given."""
    if not isinstance(campaign, Campaign):
        flown = (Path(campaign) / RUN_FILE).is_file()
        model = Path(campaign) if model is None and flown else model
        campaign = run_campaign(campaign) if flown else read_campaign(Path(campaign))
    if model is None or isinstance(model, str | Path):
        model = load_model(model)
    return campaign, model


def checked(
    campaign: Campaign, model: Model, *, hold_out: bool = True
) -> tuple[Campaign, tuple[DataFault, ...]]:
    """Return the campaign with outliers marked and trials held out, and what is wrong with it.

    Without `hold_out` only those trials are held out that the campaign marks.

    Raises
    ------
    CampaignDataError
        If the campaign states a calibrated parameter that the model does not have.
    """
    known = [item.name for item in model.parameters]
    for parameter in campaign.parameters:
        if parameter not in known:
            told = {"model": model.name, "known": ", ".join(known) or "none"}
            raise CampaignDataError(said("remarks.unknown_parameter", parameter=parameter, **told))
    faults = check_data(campaign)
    campaign = mark_outliers(campaign)
    faults = (*faults, *check_against_model(campaign, model))
    return choose_held_out(campaign) if hold_out else campaign, faults


def without_wrong_ends(campaign: Campaign, model: Model) -> Problem:
    """Return the problem of campaign and model, single wrong readings at the ends of records left out.

    The model as it is need not fit: see `outliers.wrong_ends`.
    """
    problem = Problem(campaign, model, Setting(campaign, model, model.scales(campaign)))
    none = refit_from_first_readings(problem, fit_to(problem, Candidate(), problem.start(Candidate())))
    fits = [(problem, none)]
    if problem.campaign.held_out:
        fits.append(held_out_fit(problem, none))
    trials = {trial.name: trial for trial in problem.campaign.trials}
    remarks = list(problem.campaign.remarks)
    for part, fitted in fits:
        for data, residual in zip(part.trials, fitted.residuals, strict=True):
            trial = trials[data.trial.name]
            if not trial.is_dynamic:
                continue
            has_noise = [campaign.channels[name].noise is not None for name in trial.channels]
            noise = np.array(has_noise, dtype=float)  # residuals are in deviations of the noise
            found = wrong_ends(residual, data.weight > 0.0, noise) & ~_taken_as_right(campaign, trial)
            for number in np.flatnonzero(found.any(axis=0)):
                count = int(found[:, number].sum())
                told = {"channel": trial.channels[number], "trial": trial.name, "are": is_or_are(count)}
                remarks.append(said("remarks.wrong_ends", count=count, total=len(found), **told))
            trials[trial.name] = replace(trial, used=trial.used & ~found)
    if len(remarks) == len(problem.campaign.remarks):
        return problem
    campaign = replace(problem.campaign, trials=tuple(trials.values()), remarks=tuple(remarks))
    return Problem(campaign, problem.model, replace(problem.setting, campaign=campaign))


def _taken_as_right(campaign: Campaign, trial: Trial) -> BoolArray:
    """Return the channels (C,) of a trial of which the campaign accepts readings that look like outliers."""
    word = FaultKind.OUTLIERS.value
    return np.array([word in campaign.accepted(name, trial.name) for name in trial.channels])


def strained(problem: Problem, fit: CandidateFit) -> list[str]:
    """Return a sentence for each calibrated parameter and gain that a fit takes far from its prior.

    What an implausible nuisance has taken up leaves no residual; the absolute gate judges all gains together,
    and all parameters.
    """
    names = [f"The parameter {item.name!r}" for item in problem.model.parameters]
    names += [f"The gain of the channel {name!r}" for name in problem.shared.gain_channels]
    rows = zip(names, fit.point.shared, problem.shared.precision, strict=True)
    return [
        said("remarks.strained", name=name, off=abs(u))
        for name, u, precision in rows
        if precision > 0.0 and abs(u) > IMPLAUSIBLE
    ]


def without_port(setting: Setting, effects: Sequence[Effect]) -> list[str]:
    """Return a sentence on the effects that were not tested because the model has no port, if there are."""
    names = [effect.name for effect in effects if NO_PORT in (effect.unavailable(setting) or "")]
    if not names:
        return []
    model, such_as = setting.model, ""
    if isinstance(model, LumpedModel) and model.description.input:
        first = model.description.input[0]
        vector = ", ".join(f"{value:g}" for value in first.vector)
        such_as = said("remarks.such_as", vector=vector, first=first.name)
    return [said("remarks.no_port", names=listing(names), such_as=such_as)]


def not_fitted(setting: Setting, effects: Sequence[Effect], search: Search) -> tuple[NotFitted, ...]:
    """Return the effects of a catalogue that were not fitted, each with the reason."""
    along = {term.effect.identifier for item in search.force_hypotheses for term in item.candidate.terms}
    fitted, rows = search.fitted_effects() | along, []
    for effect in effects:
        unavailable = effect.unavailable(setting)
        if unavailable is not None:
            rows.append(NotFitted(effect.identifier, unavailable))
        elif effect.identifier not in fitted:
            gain = search.screened_gains.get(effect.identifier, nan)
            why = said("remarks.screened_out", gain=gain)
            cause = search.problem.refusals.get(effect.identifier)
            if cause is not None and not 0.0 < gain < SEARCH.worth_fitting:
                why = said("remarks.could_not", cause=cause)
            elif isnan(gain):
                where = "along the missing force" if along else "at first sight"
                why = said("remarks.less_promising", where=where)
            rows.append(NotFitted(effect.identifier, why, gain))
    return tuple(rows)


def open_hypotheses(search: Search, count: int = 5) -> list[tuple[CandidateFit, float]]:
    """Return the most probable hypotheses with their probabilities, different sets of effects."""
    ranked = list(search.set_probabilities().items())[:count]
    return [(search.best_of(identifiers), probability) for identifiers, probability in ranked]


def patch_draws(problem: Problem, fit: CandidateFit, seed: int, count: int = DRAWS) -> list[list[ModelPatch]]:
    """Return for each effect of a fit its patch at draws of the posterior: of the fit, else Gaussian."""
    generator = np.random.default_rng(seed)
    if fit.draws is not None:
        draws = generator.choice(fit.draws, count)
    else:
        size = fit.candidate.size
        root = np.linalg.cholesky(fit.effect_covariance + 1e-15 * np.eye(size))
        draws = fit.point.effect + generator.standard_normal((count, size)) @ root.T
    drawn = [fit.candidate.patches(problem.setting, draw) for draw in draws]
    return [list(of_effect) for of_effect in zip(*drawn, strict=True)]
