"""The verdict on a campaign: the search, the rules of a verdict, and the exceptions to them."""

from collections.abc import Sequence
from dataclasses import replace

from discrepancy.catalogue.entry import Effect
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.search.starts import OnProgress, changes_structure, ignore_progress
from discrepancy.search.strategy import Search
from discrepancy.search.whole_search import OnSearch, ignore_search, search
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Verdict, VerdictKind
from fe.runtime.patch import SENSORS, LoadGain, SensorGain

from .conclusion import (
    LEAST_INSTRUMENT_ERROR,
    VerdictOutcome,
    has_one_driven_channel,
    is_negligible_instrument_error,
)
from .in_part import verdict_in_part, verdict_naming_laws_only, verdict_without_negligible_effect
from .moved_unknowns import (
    hiding_sentences,
    moved_sentence,
    moved_unknowns,
    unknowns_moved_within_prior,
)
from .proof import check_held_out
from .remarks import KINDS_WITHOUT_GAP
from .rules import VerdictCase, decide_verdict, most_probable_sets
from .sensor_estimates import sensor_estimates
from .verdict_checks import check_against_trials

INSTRUMENT_PRIMITIVES = (LoadGain, *SENSORS)
"""Primitives that describe errors of instruments."""


def reach_verdict(
    problem: Problem,
    effects: Sequence[Effect],
    on_progress: OnProgress = ignore_progress,
    on_search: OnSearch = ignore_search,
) -> VerdictOutcome:
    """Return the verdict on a campaign: what the model lacks, named if that is possible.

    Parameters
    ----------
    problem : Problem
        The campaign and the model, with the layout of their unknowns.
    effects : sequence of Effect
        The effects of the catalogue.
    on_progress : callable
        The function that receives a line for the progress display: the fit that runs, and how many
        remain.
    on_search : callable
        The function that receives each search when it begins.

    Returns
    -------
    VerdictOutcome
        The verdict, the search with all candidates, and the fit that represents the verdict. Next
        experiments and faults of the data are added to the verdict elsewhere.
    """
    outcome = check_against_trials(
        _verdict_on_search(search(problem, effects, on_progress, on_search))
    )
    verdict = outcome.verdict
    no_effect = outcome.search.no_effect
    moved = moved_unknowns(problem, no_effect)
    moved_within_prior = unknowns_moved_within_prior(problem, no_effect)
    if verdict.kind in KINDS_WITHOUT_GAP:
        sensors = sensor_estimates(problem, no_effect)
        sentences = hiding_sentences(moved, moved_within_prior, sensors)
    else:
        sentences = moved_sentence(moved)
    verdict = replace(
        verdict,
        sentence=f"{verdict.sentence} {sentences}".strip(),
        moved=moved,
        moved_within_prior=moved_within_prior,
    )
    return outcome._replace(verdict=verdict)


def _effects_acting_on_structure(problem: Problem, fit: CandidateFit) -> list[bool]:
    """Return for each effect of a fit whether it changes the structure, and not only readings."""
    return [changes_structure(term.effect, problem.setting) for term in fit.candidate.terms]


def _verdict_on_search(search: Search) -> VerdictOutcome:
    """Return the verdict on a search: by the rules for noise as recorded, or else in part.

    The result of the rules is tested on held-out trials. If it fails, or if no set is named, the
    verdict is that of `verdict_in_part`.
    """
    outcome = verdict_by_simulations(search)
    verdict = outcome.verdict
    # test on held-out trials
    may_be_named = verdict.kind in (VerdictKind.NAMED, VerdictKind.FAMILY)
    if may_be_named or verdict.kind is VerdictKind.GROUP:
        gate = check_held_out(search.residuals(outcome.fit))
        sentence = verdict.sentence
        if gate.has_failed:
            sentence = f"{sentence} {gate.reason}"
            may_be_named = False
        verdict = replace(verdict, sentence=sentence, gates=(*verdict.gates, gate))
    # reject named errors of instruments that are no cause
    if verdict.kind in (VerdictKind.NAMED, VerdictKind.GROUP):
        rejection = _verdict_rejecting_instruments(search, verdict)
        if rejection is not None:
            return VerdictOutcome(rejection, search, search.no_effect)
    # sets of several effects: drop errors of readings, and effects of hardly any influence
    if may_be_named and len(verdict.effects) > 1:
        laws_only = _outcome_naming_laws_only(search, verdict, outcome.fit)
        if laws_only is not None:
            return laws_only
        return verdict_without_negligible_effect(search, verdict, outcome.fit)
    # no name under the recorded noise: try to name in part
    failed_tests = {gate.name for gate in verdict.gates if gate.has_failed}
    has_misfit = bool(failed_tests & {"absolute fit", "held-out trials"})
    open_kinds = (VerdictKind.NAMED, VerdictKind.FAMILY, VerdictKind.UNEXPLAINED)
    is_open = not may_be_named and (has_misfit or verdict.kind in open_kinds)
    is_open_group = verdict.kind is VerdictKind.GROUP and bool(search.force_estimates)
    if is_open_group or is_open:
        return verdict_in_part(search, verdict)
    return VerdictOutcome(verdict, search, outcome.fit)


def verdict_by_simulations(search: Search) -> VerdictOutcome:
    """Return the verdict under the assumption that a right model leaves only the recorded noise.

    The most probable sets are fitted to convergence first, since the evidence of a fit by few steps
    is only approximate.
    """
    probabilities = search.set_probabilities()
    for _ in range(SEARCH.largest_group):
        exactly_fitted_sets = {fit.candidate.identifiers for fit in search.exact_fits.values()}
        roughly_fitted_sets = [
            names for names in most_probable_sets(probabilities) if names not in exactly_fitted_sets
        ]
        if not roughly_fitted_sets:
            break
        search.fit_to_convergence(search.best_fit_of_set(roughly_fitted_sets[0]))
        probabilities = search.set_probabilities()
    return decide_verdict(VerdictCase(search, probabilities))


def _outcome_naming_laws_only(
    search: Search, verdict: Verdict, fit: CandidateFit
) -> VerdictOutcome | None:
    """Return the verdict that names only the laws of a set, without its errors of readings.

    If laws explain nearly all of the missing force, errors of readings only describe what the laws
    do not explain. None is returned if the set does not contain both kinds of effects, or if laws
    alone cannot be named.
    """
    acts_on_structure = _effects_acting_on_structure(search.problem, fit)
    names_both = any(acts_on_structure) and not all(acts_on_structure)
    if not search.force_estimates or not names_both:
        return None
    return verdict_naming_laws_only(search, verdict)


def _verdict_rejecting_instruments(search: Search, verdict: Verdict) -> Verdict | None:
    """Return the verdict that rejects named errors of instruments; None if they may be the cause.

    There are two reasons to reject them. The errors may be so small that any instrument has them.
    Or they may only serve to keep calibrated parameters within their priors: with one channel and a
    recorded drive, a gain has the same effect as all parameters of a linear model together. If the
    model without effect predicts held-out trials, nothing but these priors supports the gain.
    """
    problem = search.problem
    without_name = replace(verdict, effects=(), group=())
    causes = " or ".join(dict.fromkeys(effect.name for effect in verdict.effects))
    # reason 1: errors that any instrument has
    if all(is_negligible_instrument_error(problem, effect.patch) for effect in verdict.effects):
        sentence = (
            f"The model explains the data except for {causes} below "
            f"{100.0 * LEAST_INSTRUMENT_ERROR:g} % of the quantity; an error that small counts as "
            "a nuisance of the instruments, and is not named."
        )
        return replace(without_name, kind=VerdictKind.NOTHING_MISSING, sentence=sentence)
    # reason 2: a gain that only keeps calibrated parameters within their priors
    if not has_one_driven_channel(problem) or not problem.campaign.held_out:
        return None
    if not _are_instrument_errors_with_gain(verdict):
        return None
    if not check_held_out(search.residuals(search.no_effect)).passed:
        return None
    sentence = (
        "The model predicts held-out trials as it is, but with calibrated parameters outside "
        f"their priors{_implausible_parameters_clause(search)}. An error of the instruments "
        f"({causes}) would explain them as well: with one channel, these data cannot distinguish "
        "the two."
    )
    resembles = tuple(dict.fromkeys(effect.identifier for effect in verdict.effects))
    return replace(
        without_name, kind=VerdictKind.UNEXPLAINED, sentence=sentence, resembles=resembles
    )


def _are_instrument_errors_with_gain(verdict: Verdict) -> bool:
    """Return whether a verdict names only errors of instruments, and among them a wrong gain."""
    has_gain = False
    for effect in verdict.effects:
        for primitive in effect.patch:
            if not isinstance(primitive, INSTRUMENT_PRIMITIVES):
                return False
            if isinstance(primitive, LoadGain | SensorGain):
                has_gain = True
    return has_gain


def _implausible_parameters_clause(search: Search) -> str:
    """Return the parameters that the fit without effect moves far from their priors, in brackets.

    The clause begins with a blank; it is empty if there are no such parameters.
    """
    parameters = search.problem.model.parameters
    # the scaled unknowns are the parameters, in prior deviations, and then the gains of channels
    scaled_values = search.no_effect.point.shared[: len(parameters)]
    texts = []
    for parameter, scaled_value in zip(parameters, scaled_values, strict=True):
        if abs(scaled_value) > SEARCH.reported_prior_deviations:
            texts.append(f"{parameter.name!r} {abs(scaled_value):.1f}")
    return f" ({', '.join(texts)} stated deviations off)" if texts else ""
