"""The whole way from a campaign to a verdict: check, locate, name, prove, propose the next experiment."""

import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from math import isnan, nan
from pathlib import Path
from typing import Protocol

import numpy as np

from discrepancy.campaign.held_out import choose_held_out
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import Campaign
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.catalogue.library import load_catalogue
from discrepancy.catalogue.needs import NO_PORT
from discrepancy.checks.fault import DataFault
from discrepancy.checks.outliers import wrong_ends
from discrepancy.checks.quality import check_against_model, check_data, mark_outliers
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.fitting import fit as fit_to
from discrepancy.fits.gates import solver_share
from discrepancy.fits.linearisation import Point
from discrepancy.fits.predictive import residual_set
from discrepancy.fits.problem import Problem
from discrepancy.judgement.conclusion import calibrated_parameters
from discrepancy.judgement.look_alikes import look_alike_remark, with_untested
from discrepancy.judgement.naming import name
from discrepancy.judgement.next_experiment import next_experiments
from discrepancy.judgement.proof import prove
from discrepancy.judgement.when import acting_sentence, begins_inside, when_sentence
from discrepancy.location.locate import Location, locate, outlier_remarks
from discrepancy.location.residuals import ResidualSet
from discrepancy.missing_force.force import MissingForce
from discrepancy.missing_force.windows import gap_windows, residual_windows
from discrepancy.models.interface import Model
from discrepancy.models.lumped import LumpedModel
from discrepancy.search.strategy import Search
from discrepancy.sources.from_run import RUN_FILE, run_campaign
from fe.runtime.patch import ModelPatch
from reporting.words import be

from .errors import CampaignDataError
from .force_told import shown_force, told_force
from .model_choice import load_model
from .search_settings import SEARCH
from .verdict import Experiment, GapWindow, NotFitted, Proof, Verdict, VerdictKind

DRAWS = 400
IMPLAUSIBLE = 4.0
"""Prior deviations from which on a parameter or a gain is remarked on."""
OPEN_KINDS = (
    VerdictKind.GROUP,
    VerdictKind.UNEXPLAINED,
    VerdictKind.FAMILY,
    VerdictKind.NAMED_IN_PART,
    VerdictKind.BELOW_LIMIT,
)


class Stage(Protocol):
    """A stretch of work under way."""

    def advance(self, amount: int = 1, detail: str | None = None) -> None:
        """Report so many parts done, and what is done now."""


class Progress(Protocol):
    """Where the work reports how far it is; `reporting.progress` has implementations."""

    def stage(
        self, description: str, total: int | None = None, unit: str = ""
    ) -> AbstractContextManager[Stage]:
        """Open a stretch of work."""


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
        Residuals without and with it; None where faults of the data stopped the work.
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


def investigate(
    campaign: Campaign | str | Path,
    model: Model | str | Path | None = None,
    effects: Sequence[Effect] | None = None,
    *,
    seed: int = 0,
    thorough: bool = True,
    progress: Progress | None = None,
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
    seconds: dict[str, float] = {}

    def stage(description: str, key: str) -> "_Timed":
        return _Timed(progress, description, key, seconds)

    with stage("Checking the data", "check"):
        campaign, faults = checked(campaign, model)
    fatal = [fault for fault in faults if fault.fatal]
    if fatal:
        verdict = Verdict(
            VerdictKind.DATA_ERROR,
            fatal[0].sentence,
            float("nan"),
            float("nan"),
            remarks=tuple(fault.sentence for fault in faults),
        )
        return Investigation(campaign, model, faults, verdict, seconds=seconds)
    setting = Setting(campaign, model, model.scales(campaign))
    with stage("Fitting what is known, and searching the catalogue", "name") as searching:
        problem = Problem(campaign, model, setting)
        cleaned = without_wrong_ends(problem)
        if cleaned is not campaign:
            campaign, setting = cleaned, replace(setting, campaign=cleaned)
            problem = Problem(campaign, model, setting)
        catalogue = load_catalogue() if effects is None else effects
        verdict, search, fit = name(problem, catalogue, tell=searching.tell)
        verdict = with_untested(verdict, setting, catalogue)
    remarks = [fault.sentence for fault in faults]
    remarks += _remarks(problem, catalogue, verdict, search, fit)
    with stage("Checking the time steps", "steps"):
        share = solver_share(problem, fit)
        if share > SEARCH.solver_share:
            remarks.append(
                f"The time steps cost up to {share:.2g} of the noise (rms), more than the "
                f"{SEARCH.solver_share:g} that is wanted: probabilities may be too sharp."
            )
    with stage("Residuals", "residuals"):
        before = residual_set(problem, search.none, sensitivities=thorough)
        after = residual_set(problem, fit, sensitivities=False) if fit is not search.none else before
    location = None
    windows: tuple[GapWindow, ...] = ()
    if thorough:
        with stage("Locating the gap", "locate"):
            location = locate(before, seed=seed)
            windows = gap_windows(problem, fit, before, seed=seed)
            if after is not before:
                windows += residual_windows(after, seed=seed, with_effect=True)
            remarks += [text for text in location.remarks if text not in remarks]
            remarks += outlier_remarks(after)  # a wrong reading stays far out whatever is added
    missing, force = None, None
    if thorough and verdict.kind not in (VerdictKind.NOTHING_MISSING, VerdictKind.BELOW_LIMIT):
        with stage("Seeing the missing force", "force"):
            missing = shown_force(problem, search, fit)
            force = None if missing is None else told_force(problem, search, fit, missing)
    proof = None
    if fit.candidate.terms:
        with stage("Proving on held-out trials", "prove"):
            proof = prove(before, after, seed=seed)
    experiments: tuple[Experiment, ...] = ()
    if thorough and verdict.kind in OPEN_KINDS:
        with stage("Looking for the next experiment", "next"):
            experiments = next_experiments(problem, open_hypotheses(search))
    verdict = replace(
        verdict, sentence=_dated(verdict, windows), remarks=tuple(remarks), next_experiments=experiments,
        not_fitted=not_fitted(problem.setting, catalogue, search), windows=windows,
        parameters=calibrated_parameters(problem, fit), force=force,
    )  # fmt: skip
    return Investigation(
        campaign,
        model,
        faults,
        verdict,
        location,
        proof,
        before,
        after,
        problem,
        search,
        fit,
        seconds,
        missing,
    )


def _dated(verdict: Verdict, windows: tuple[GapWindow, ...]) -> str:
    """Return the sentence of a verdict, with when the gap is there where that tells something."""
    acting = acting_sentence(verdict.effects)
    if acting:
        return f"{verdict.sentence} {acting}"
    known = verdict.kind is VerdictKind.NOTHING_MISSING or verdict.kind is VerdictKind.BELOW_LIMIT
    if known or not (begins_inside(windows) or verdict.kind is VerdictKind.UNEXPLAINED):
        return verdict.sentence
    return f"{verdict.sentence} {when_sentence(windows)}".strip()


def _remarks(
    problem: Problem, catalogue: Sequence[Effect], verdict: Verdict, search: Search, fit: CandidateFit
) -> list[str]:
    """Return what has to be said beside a verdict."""
    remarks = list(problem.campaign.remarks)
    remarks += strained(problem, fit)
    remarks += without_port(problem.setting, catalogue)
    alike = look_alike_remark(verdict, search.effects)
    remarks += [] if alike is None else [alike]
    if not problem.model.parameters:
        remarks.append(
            f"The model {problem.model.name!r} has no uncertain parameter, so a stiffness or damping a "
            "little off can be taken for an effect: give it some with their deviations."
        )
    if fit.candidate.terms and not fit.converged:
        remarks.append(
            "The fit of the verdict had not settled when it ended: its intervals may be too narrow."
        )
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
            raise CampaignDataError(
                f"The campaign states the parameter {parameter!r}, which {model.name} does not have; it has "
                f"{', '.join(known) or 'none'}: correct the name, or leave [parameters.{parameter}] out."
            )
    faults = check_data(campaign)
    campaign = mark_outliers(campaign)
    faults = (*faults, *check_against_model(campaign, model))
    return choose_held_out(campaign) if hold_out else campaign, faults


def without_wrong_ends(problem: Problem) -> Campaign:
    """Return a problem's campaign without single wrong readings at the ends of its records in time.

    The model as it is need not fit: see `outliers.wrong_ends`.
    """
    none = fit_to(problem, Candidate(), problem.start(Candidate()), evidence=False)
    fits = [(problem, none)]
    if problem.campaign.held_out:
        there = problem.with_trials(problem.campaign.held_out)
        local = tuple(np.zeros(data.unknowns.size) for data in there.trials)
        start = Point(none.point.shared, local, none.point.effect)
        fits.append((there, fit_to(there, Candidate(), start, local_only=True, evidence=False)))
    trials = {trial.name: trial for trial in problem.campaign.trials}
    remarks = list(problem.campaign.remarks)
    for part, fitted in fits:
        for data, residual in zip(part.trials, fitted.residuals, strict=True):
            trial = trials[data.trial.name]
            if not trial.is_dynamic:
                continue
            found = wrong_ends(residual, data.weight > 0.0)
            for number in np.flatnonzero(found.any(axis=0)):
                count = int(found[:, number].sum())
                remarks.append(
                    f"{count} of {len(found)} readings of {trial.channels[number]!r} in the trial "
                    f"{trial.name!r}, at its ends, {be(count)} far off model and neighbours and left out."
                )
            trials[trial.name] = replace(trial, used=trial.used & ~found)
    if len(remarks) == len(problem.campaign.remarks):
        return problem.campaign
    return replace(problem.campaign, trials=tuple(trials.values()), remarks=tuple(remarks))


def strained(problem: Problem, fit: CandidateFit) -> list[str]:
    """Return a sentence for each calibrated parameter and gain that a fit takes far from its prior.

    What an implausible nuisance has taken up leaves no residual; the absolute gate judges all gains together,
    and all parameters.
    """
    names = [f"The parameter {item.name!r}" for item in problem.model.parameters]
    names += [f"The gain of the channel {name!r}" for name in problem.shared.gain_channels]
    rows = zip(names, fit.point.shared, problem.shared.precision, strict=True)
    return [
        f"{name} lies {abs(u):.1f} of its stated deviations off in the hypothesis of the verdict, which "
        "rests on that deviation: check it."
        for name, u, precision in rows
        if precision > 0.0 and abs(u) > IMPLAUSIBLE
    ]


def without_port(setting: Setting, effects: Sequence[Effect]) -> list[str]:
    """Return a sentence on the effects that were not tested because the model has no port, if there are."""
    names = [effect.name for effect in effects if NO_PORT in (effect.unavailable(setting) or "")]
    if not names:
        return []
    what = "a [[port]] in the model's file"
    model = setting.model
    if isinstance(model, LumpedModel) and model.description.input:
        first = model.description.input[0]
        vector = ", ".join(f"{value:g}" for value in first.vector)
        what += f", such as vector = [{vector}] between the ground and {first.name!r}"
    listed = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
    return [f"Not tested for lack of a port: {listed}; declare {what} where such a force may act."]


def not_fitted(setting: Setting, effects: Sequence[Effect], search: Search) -> tuple[NotFitted, ...]:
    """Return the effects of a catalogue that were not fitted, each with the reason."""
    along = {term.effect.identifier for item in search.forces for term in item.candidate.terms}
    fitted, rows = search.fitted() | along, []
    for effect in effects:
        unavailable = effect.unavailable(setting)
        if unavailable is not None:
            rows.append(NotFitted(effect.identifier, unavailable))
        elif effect.identifier not in fitted:
            gain = search.promised.get(effect.identifier, nan)
            why = f"screened out: {gain:.1f} nat at most beside the model as it is"
            if effect.identifier in search.problem.refusals and not 0.0 < gain < SEARCH.worth_fitting:
                why = f"could not be fitted: {search.problem.refusals[effect.identifier]}"
            elif isnan(gain):
                why = f"less promising than others {'along the missing force' if along else 'at first sight'}"
            rows.append(NotFitted(effect.identifier, why, gain))
    return tuple(rows)


def open_hypotheses(search: Search, count: int = 5) -> list[tuple[CandidateFit, float]]:
    """Return the most probable hypotheses with their probabilities, different sets of effects."""
    found = []
    for identifiers, probability in list(search.set_probabilities().items())[:count]:
        options = [item for item in search.all().values() if item.candidate.identifiers == identifiers]
        found.append((max(options, key=search.score), probability))
    return found


def patch_draws(problem: Problem, fit: CandidateFit, seed: int, count: int = DRAWS) -> list[list[ModelPatch]]:
    """Return for each effect of a fit its patch at draws of the posterior: of the fit, else Gaussian."""
    generator = np.random.default_rng(seed)
    if fit.draws is not None:
        draws = generator.choice(fit.draws, count)
    else:
        size = fit.candidate.size
        root = np.linalg.cholesky(fit.effect_covariance + 1e-15 * np.eye(size))
        draws = fit.point.effect + generator.standard_normal((count, size)) @ root.T
    patches: list[list[ModelPatch]] = []
    at = 0
    for term in fit.candidate.terms:
        width = len(term.parameters)
        alone = Candidate((term,))
        patches.append([alone.patch(problem.setting, draw[at : at + width]) for draw in draws])
        at += width
    return patches


class _Timed:
    def __init__(
        self, progress: Progress | None, description: str, key: str, seconds: dict[str, float]
    ) -> None:
        self._stage = nullcontext() if progress is None else progress.stage(description)
        self._key, self._seconds = key, seconds
        self._under_way: Stage | None = None

    def __enter__(self) -> "_Timed":
        self._began = time.perf_counter()
        self._under_way = self._stage.__enter__()
        return self

    def tell(self, what: str) -> None:
        """Say what is done now."""
        if self._under_way is not None:
            self._under_way.advance(0, what)

    def __exit__(self, *error: object) -> None:
        self._stage.__exit__(*error)  # type: ignore[arg-type]
        self._seconds[self._key] = time.perf_counter() - self._began
