"""The verdict on a campaign: the search, the rules of a verdict, and what speaks against it.

Is anything missing? Is one set of effects so probable that it has a name, and does its simulation
leave only noise (`noise_verdict`)? If it leaves more: is it still most of the gap, in trials that
were not fitted, too (`remainder_verdict`)?
"""

from collections.abc import Sequence
from dataclasses import replace

from discrepancy.catalogue.entry import Effect
from discrepancy.fits.problem import Problem
from discrepancy.search.starts import OnProgress, ignore_progress
from discrepancy.search.strategy import Search
from discrepancy.search.whole_search import OnSearch, ignore_search, search
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Verdict, VerdictKind

from .comparison import Comparison, HypothesisT
from .force_comparison import ForceComparison
from .hypotheses import VerdictOutcome, is_gain_error
from .instrument_errors import notable_terms, verdict_rejecting_instruments
from .moved_unknowns import (
    GAIN_OF,
    hiding_sentences,
    moved_sentence,
    moved_unknowns,
    unknowns_moved_within_prior,
)
from .noise_case import NoiseCase
from .noise_verdict import decide_on_noise
from .proof import check_held_out
from .remainder_verdict import decide_on_remainder, named_in_part_outcome, unexplained_outcome
from .remarks import KINDS_OF_NOISE_ALONE, KINDS_WITHOUT_GAP
from .sensor_estimates import sensor_estimates
from .simulation_comparison import SimulationComparison
from .verdict_checks import check_against_trials

COLOURED = "which is coloured as its records admit"
"""Clause on noise that is correlated in time as in its records."""


def reach_verdict(
    problem: Problem,
    effects: Sequence[Effect],
    on_progress: OnProgress = ignore_progress,
    on_search: OnSearch = ignore_search,
) -> VerdictOutcome:
    """Return the verdict on a campaign: what the model lacks, named if that is possible.

    Parameters
    ----------
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
    outcome = check_against_trials(_decide(search(problem, effects, on_progress, on_search)))
    verdict = outcome.verdict
    no_effect = outcome.search.no_effect
    moved = moved_unknowns(problem, no_effect)
    moved_within_prior = unknowns_moved_within_prior(problem, no_effect)
    if verdict.kind in KINDS_WITHOUT_GAP:
        sensors = sensor_estimates(problem, no_effect)
        sentences = hiding_sentences(moved, moved_within_prior, sensors)
    else:
        named_gains = {
            f"{GAIN_OF}{effect.place}" for effect in verdict.effects if is_gain_error(effect)
        }
        sentences = moved_sentence([item for item in moved if item.name not in named_gains])
    verdict = replace(verdict, moved=moved, moved_within_prior=moved_within_prior)
    return outcome._replace(verdict=verdict.with_reasons(sentences))


def comparison_of(search: Search) -> ForceComparison | SimulationComparison:
    """Return the comparison of the hypotheses of a search.

    Hypotheses that were estimated with the force that they leave missing are compared by these
    estimates, others by their simulations.
    """
    if search.force_estimates and search.force_search is not None:
        return ForceComparison(search, search.force_search)
    return SimulationComparison(search)


def _decide(search: Search) -> VerdictOutcome:
    """Return the verdict on the hypotheses of a search."""
    comparison = comparison_of(search)
    # the two calls are one for the reader: all hypotheses of a comparison have the same type
    if isinstance(comparison, ForceComparison):
        return _decide_on_comparison(comparison)
    return _decide_on_comparison(comparison)


def _decide_on_comparison(comparison: Comparison[HypothesisT]) -> VerdictOutcome:
    """Return the verdict of a comparison: by the rules for noise, or for more than that."""
    comparison.fit_probable_sets()
    outcome = _with_test_on_held_out(comparison, decide_on_noise(NoiseCase(comparison)))
    verdict = outcome.verdict
    rejection = verdict_rejecting_instruments(comparison, verdict)
    if rejection is not None:
        return VerdictOutcome(rejection, comparison.search, comparison.search.no_effect)
    if not _leaves_more_than_noise(verdict):
        return _without_superfluous_effect(comparison, outcome)
    comparison.admit_remainder()
    if isinstance(comparison, SimulationComparison):
        coloured_outcome = _decide_on_coloured_noise(comparison)
        if coloured_outcome is not None:
            return coloured_outcome
        comparison.add_free_shape_families()
    return decide_on_remainder(comparison, verdict)


def _with_test_on_held_out(
    comparison: Comparison[HypothesisT], outcome: VerdictOutcome
) -> VerdictOutcome:
    """Return the outcome with the test of its effects on held-out trials, if it has effects."""
    verdict = outcome.verdict
    if verdict.kind not in KINDS_OF_NOISE_ALONE:
        return outcome
    fit = outcome.fit
    if fit.residual_process is not None:  # a χ² against the recorded noise alone
        fit = replace(fit, residual_process=None)
    gate = check_held_out(comparison.search.residuals(fit))
    if gate.has_failed:
        verdict = verdict.with_reasons(gate.reason)
    return outcome._replace(verdict=replace(verdict, gates=(*verdict.gates, gate)))


def _leaves_more_than_noise(verdict: Verdict) -> bool:
    """Return whether the verdict on noise found a gap that no hypothesis reduces to noise.

    That is so if the gap is unexplained, or if the test of absolute fit or that on held-out trials
    failed.
    """
    failed_tests = {gate.name for gate in verdict.gates if gate.has_failed}
    return verdict.kind is VerdictKind.UNEXPLAINED or bool(
        failed_tests & {"absolute fit", "held-out trials"}
    )


def _decide_on_coloured_noise(comparison: SimulationComparison) -> VerdictOutcome | None:
    """Return the verdict under coloured noise, or None if it is not conclusive.

    It is returned if

    - it says that nothing is missing or that the gap is too small to be detected, or names one set
      of effects;
    - the residuals are noise, white or correlated in time as in the noise records;
    - neither the test of absolute fit nor that on held-out trials fails.
    """
    outcome = decide_on_noise(NoiseCase(comparison, noise=COLOURED))
    outcome = _with_test_on_held_out(comparison, outcome)
    verdict = outcome.verdict
    is_decided = verdict.kind in (*KINDS_WITHOUT_GAP, VerdictKind.NAMED)
    final_fit = comparison.no_effect if verdict.kind in KINDS_WITHOUT_GAP else outcome.fit
    process = final_fit.residual_process
    has_recorded_colour = process is not None and process.is_all_recorded_colour
    if not is_decided or not has_recorded_colour or _leaves_more_than_noise(verdict):
        return None
    return outcome


# ---------------------------------------------------------------- effects that are not needed


def _without_superfluous_effect(
    comparison: Comparison[HypothesisT], outcome: VerdictOutcome
) -> VerdictOutcome:
    """Return the verdict without those named effects that explain hardly anything.

    Such an effect may only describe a small remainder that is not quite noise. So if a subset
    explains nearly the same share of the gap, or some effects deserve no name (`notable_terms`),
    all are compared again together with what each leaves. A subset with nearly the same share then
    replaces the set if it has just the effects that deserve a name, or if the score of the set is
    not far above its own.
    """
    verdict, fit = outcome.verdict, outcome.fit
    may_be_named = verdict.kind in (VerdictKind.NAMED, VerdictKind.FAMILY)
    if not may_be_named or len(verdict.effects) < 2:
        return outcome
    full_set = comparison.hypothesis_of(fit.candidate)
    if full_set is None:
        return outcome
    notable_key = notable_terms(comparison, fit)
    least_share = comparison.held_out_or_fitted_share(full_set).value - SEARCH.negligible_share
    is_each_notable = notable_key == set(fit.candidate.key)
    has_equal_subset = any(
        comparison.held_out_or_fitted_share(subset).value > least_share
        for subset in comparison.subsets(full_set)
    )
    if is_each_notable and not has_equal_subset:
        return outcome
    comparison.admit_remainder()
    full_set = comparison.hypothesis_of(fit.candidate) or full_set
    for subset in comparison.subsets(full_set):
        if comparison.held_out_or_fitted_share(subset).value < least_share:
            continue
        least_score = comparison.score(full_set) - SEARCH.least_gain_of_negligible_effect
        if set(subset.candidate.key) == notable_key or comparison.score(subset) > least_score:
            probability = comparison.probability(subset)
            if comparison.objection_to_naming(subset) or probability < SEARCH.name_probability:
                return unexplained_outcome(comparison, verdict, subset)
            return named_in_part_outcome(comparison, subset, probability)
    comparison.admit_no_remainder()  # the whole set is needed
    return outcome
