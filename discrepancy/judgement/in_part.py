"""Verdicts if the residuals of every simulation are more than noise.

A verdict then names a set of effects *in part*, or a group of hypotheses that cannot be told apart,
or says that the gap between model and readings is unexplained. A set is named in part if it is
probable and explains most of the gap, in fitted and in held-out trials, with calibrated values that
are consistent with priors of twice the stated deviations. Hypotheses are compared by the missing
force if it can be estimated, else by simulations under a noise as large as their residuals.
"""

from collections.abc import Sequence

import numpy as np

from discrepancy.fits.fitting import CandidateFit
from discrepancy.search.strategy import Search
from discrepancy.search.wide_noise import compare_under_wide_noise
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate, NamedEffect, Verdict, VerdictKind
from reporting.probabilities import normalised_probabilities
from reporting.words import capital, listing, small

from .closed_share import compared_trials_text, percent_with_interval
from .coloured_noise import remainder_estimates, verdict_under_coloured_noise
from .comparison import Comparison, HypothesisT, effect_place_pairs
from .conclusion import (
    LEAST_UNSTATED_GAIN,
    Conclusion,
    VerdictOutcome,
    WeightedHypothesis,
    curve_sentence,
    effects_text,
    has_one_driven_channel,
    is_negligible_instrument_error,
    named_effects,
    names_without_free_shape,
    probability_text,
)
from .force_comparison import ForceComparison
from .part_sentences import shape_sentence, unproved_addition_sentence
from .simulation_comparison import SimulationComparison

LEAST_MENTIONED_SHARE = 0.1
"""Least share of the gap for a hypothesis to be mentioned as the best one if none is named."""


def verdict_in_part(search: Search, simulation_verdict: Verdict) -> VerdictOutcome:
    """Return the verdict if the residuals of the best simulation are more than the recorded noise.

    Parameters
    ----------
    search : Search
        The candidates as fitted under the recorded noise, and the hypotheses that were fitted to
        the missing force, if there is any.
    simulation_verdict : Verdict
        The verdict on the simulations.

    Returns
    -------
    VerdictOutcome
        The verdict. If the gap is unexplained, its fit is that of the best hypothesis that the
        sentence mentions.
    """
    force_search = search.force_search if search.force_estimates else None
    if force_search is not None and not search.force_estimates[0].leaves_no_force:
        return _verdict_by_comparison(ForceComparison(search, force_search), simulation_verdict)
    compare_under_wide_noise(search)
    comparison = SimulationComparison(search)
    outcome = verdict_under_coloured_noise(comparison)
    if outcome is not None:
        return outcome
    comparison.add_free_shape_families()
    return _verdict_by_comparison(comparison, simulation_verdict)


def verdict_naming_laws_only(search: Search, simulation_verdict: Verdict) -> VerdictOutcome | None:
    """Return the verdict that names laws in part, and no errors of readings.

    Errors of readings are not needed if the laws explain nearly all of the missing force.

    Parameters
    ----------
    search : Search
        The search, with hypotheses that were fitted to the missing force.
    simulation_verdict : Verdict
        The verdict on the simulations.

    Returns
    -------
    VerdictOutcome or None
        None if no law is named, or if laws leave more than a tenth of the missing force unexplained
        (`SEARCH.nearly_complete_share`).
    """
    assert search.force_search is not None
    comparison = ForceComparison(search, search.force_search)
    outcome = _verdict_by_comparison(comparison, simulation_verdict)
    if (
        outcome.verdict.kind is not VerdictKind.NAMED_IN_PART
        or comparison.judged_hypothesis is None
    ):
        return None
    share = comparison.held_out_or_fitted_share(comparison.judged_hypothesis)
    return outcome if share.value > SEARCH.nearly_complete_share else None


def verdict_without_negligible_effect(
    search: Search, naming_verdict: Verdict, fit: CandidateFit
) -> VerdictOutcome:
    """Return the verdict on a named set, without an effect that explains hardly anything.

    If the residuals are nearly noise, a slightly wider noise explains them as well as such an
    effect does. So the subsets of the set are compared with it under the wider noise. The effect
    remains if the evidence of the whole set is far above that of the set without it.

    Parameters
    ----------
    search : Search
        The candidates as fitted under the recorded noise.
    naming_verdict : Verdict
        The verdict that names the set.
    fit : CandidateFit
        The fit of the set.
    """
    # nothing is dropped if each effect is notable and no subset explains as much
    comparison = SimulationComparison(search)
    full_set_key = set(fit.candidate.key)
    notable_key = _key_of_notable_terms(comparison, fit)
    least_share = comparison.held_out_or_fitted_share(fit).value - SEARCH.negligible_share
    is_each_notable = notable_key == full_set_key
    if is_each_notable and not _has_equal_subset(comparison, full_set_key, least_share):
        return VerdictOutcome(naming_verdict, search, fit)
    # compare the subsets under the wider noise, those of the fewest effects first
    compare_under_wide_noise(search)
    full_set = search.wide_fits.get(fit.candidate.key, fit)
    for subset in sorted(search.wide_fits.values(), key=lambda fit: len(fit.candidate.terms)):
        subset_key = set(subset.candidate.key)
        if not subset_key or not subset_key < full_set_key:
            continue
        if comparison.held_out_or_fitted_share(subset).value < least_share:
            continue
        least_score = search.score(full_set) - SEARCH.least_gain_of_negligible_effect
        if subset_key == notable_key or search.score(subset) > least_score:
            probability = comparison.probability(subset)
            if comparison.objection_to_naming(subset) or probability < SEARCH.name_probability:
                return _unexplained_outcome(comparison, naming_verdict, subset)
            return _named_in_part_outcome(comparison, subset, probability)
    # the whole set is needed: the verdict remains, and so does the comparison under recorded noise
    search.wide_fits = {}
    return VerdictOutcome(naming_verdict, search, fit)


def _has_equal_subset(
    comparison: SimulationComparison, full_set_key: set[tuple[str, str]], least_share: float
) -> bool:
    """Return whether a subset of a set of effects explains at least some share of the gap."""
    for key, subset in comparison.search.exact_fits.items():
        is_subset = bool(key) and set(key) < full_set_key
        if is_subset and comparison.held_out_or_fitted_share(subset).value > least_share:
            return True
    return False


def _key_of_notable_terms(
    comparison: SimulationComparison, fit: CandidateFit
) -> set[tuple[str, str]]:
    """Return the pairs (label, place) of the effects of a fit that are worth a name of their own.

    Errors of instruments that are too small to be named are left out. So are all errors of readings
    if the campaign has only one channel, under a recorded drive: such an error could not be told
    from a change of the model's parameters.
    """
    problem = comparison.problem
    one_channel = has_one_driven_channel(problem)
    patches = fit.candidate.patches(problem.setting, fit.effect)
    notable_key = set()
    for term, patch in zip(fit.candidate.terms, patches, strict=True):
        if is_negligible_instrument_error(problem, patch, least_unstated_gain=LEAST_UNSTATED_GAIN):
            continue
        if comparison.acts_on_structure(term) or not one_channel:
            notable_key.add((term.label, term.place))
    return notable_key


# ---------------------------------------------------------------- verdicts of a comparison


def _verdict_by_comparison(
    comparison: Comparison[HypothesisT], simulation_verdict: Verdict
) -> VerdictOutcome:
    """Return the verdict of a comparison: named in part, a group, or an unexplained gap.

    Parameters
    ----------
    comparison : Comparison
        The comparison of all hypotheses.
    simulation_verdict : Verdict
        The verdict on the simulations, with the tests that they failed.
    """
    if not comparison.nameable_hypotheses:
        return _unexplained_outcome(comparison, simulation_verdict)
    # the best hypothesis, and those that the data do not separate from it
    best_hypothesis = comparison.simplest_equivalent_hypothesis(comparison.nameable_hypotheses[0])
    members = [best_hypothesis, *comparison.competing_hypotheses(best_hypothesis)]
    other_count = len(members) - 1
    if len(members) > SEARCH.largest_group:
        reason = f"{other_count} others explain as much, so that none of them can be named"
        return _unexplained_outcome(comparison, simulation_verdict, best_hypothesis, reason)
    # conditions that a name must fulfil
    if comparison.enlarges_error(best_hypothesis):
        return _unexplained_outcome(comparison, simulation_verdict, best_hypothesis)
    probability = comparison.probability(*members)
    if probability < SEARCH.name_probability:
        return _unexplained_outcome(comparison, simulation_verdict, best_hypothesis)
    log_bayes_factor = best_hypothesis.log_evidence - comparison.no_effect.log_evidence
    if log_bayes_factor < SEARCH.least_log_bayes_factor:
        reason = (
            "a missing force without any law explains the readings as well "
            f"(ln Bayes factor {log_bayes_factor:.3g}; a name needs "
            f"{SEARCH.least_log_bayes_factor:g})"
        )
        return _unexplained_outcome(comparison, simulation_verdict, best_hypothesis, reason)
    # one hypothesis is named in part; several are a group if all of them pass the absolute test
    if other_count == 0:
        return _named_in_part_outcome(comparison, best_hypothesis, probability)
    if all(comparison.passes_absolute_fit(member) for member in members):
        return _group_outcome(comparison, members, probability)
    names = [effects_text(named_effects(comparison.problem, member)) for member in members[1:]]
    reason = (
        "it leaves more than noise, and these data do not distinguish it from "
        f"{listing(names, 'or')}"
    )
    return _unexplained_outcome(comparison, simulation_verdict, best_hypothesis, reason)


def _named_in_part_outcome(
    comparison: Comparison[HypothesisT], best_hypothesis: HypothesisT, probability: float
) -> VerdictOutcome:
    """Return the verdict that names the effects of a hypothesis in part.

    Parameters
    ----------
    comparison : Comparison
        The comparison of all hypotheses.
    best_hypothesis : HypothesisT
        The hypothesis that is named.
    probability : float
        The probability of that hypothesis.
    """
    effects = named_effects(comparison.problem, best_hypothesis)
    share = comparison.held_out_or_fitted_share(best_hypothesis)
    families = {term.effect.family for term in best_hypothesis.candidate.terms if term.free_shape}
    family = ", ".join(sorted(families))
    # what is missing: effects of the catalogue, and families with a shape of their own
    phrases = []
    names_of_canonical = effects_text(effect for effect in effects if not effect.shape)
    if names_of_canonical:
        phrases.append(names_of_canonical)
    if family:
        phrases.append(f"an effect of the family {family}, with a fitted shape,")
    # what it explains, and what remains
    share_clause = comparison.closed_share_clause(best_hypothesis)
    missing = curve_sentence(comparison.problem, effects, probability)
    if missing:
        sentence = f"{missing} {capital(share_clause)}."
    else:
        sentence = (
            f"{capital(listing(phrases))} is missing (probability "
            f"{probability_text(probability)}): {share_clause}."
        )
    if comparison.has_held_out and not share.held_out:
        sentence += " In the held-out trials it has hardly any force."
    unexplained_text = comparison.unexplained_text(best_hypothesis, share)
    sentence += f" It leaves {unexplained_text}, which is unexplained."
    sentence += shape_sentence(comparison, best_hypothesis)
    sentence += unproved_addition_sentence(comparison, best_hypothesis)
    return _outcome_of_comparison(
        comparison,
        VerdictKind.NAMED_IN_PART,
        sentence,
        probability,
        judged_hypothesis=best_hypothesis,
        members=[best_hypothesis],
        effects=effects,
        family=family,
        gates=(comparison.check_fit(best_hypothesis),),
    )


def _group_outcome(
    comparison: Comparison[HypothesisT], members: Sequence[HypothesisT], probability: float
) -> VerdictOutcome:
    """Return the verdict that one of several hypotheses is true, and the data do not tell which.

    The sentence begins with the effects that all of them have in common.

    Parameters
    ----------
    comparison : Comparison
        The comparison of all hypotheses.
    members : sequence of HypothesisT
        The hypotheses of the group, the best one first.
    probability : float
        The probability that one of them is true.
    """
    effects_by_member = [named_effects(comparison.problem, member) for member in members]
    sentence = _group_sentence(comparison, members, effects_by_member, probability)
    common_pairs = frozenset.intersection(*(effect_place_pairs(member) for member in members))
    common_effects = []
    for effect in effects_by_member[0]:
        if (effect.identifier, effect.place) in common_pairs:
            common_effects.append(effect)
    if common_effects:
        sentence = f"{capital(effects_text(common_effects))} is missing. {sentence}"
    all_effects: list[NamedEffect] = []
    for effects in effects_by_member:
        all_effects.extend(effects)
    group = []
    for member in members:
        group.append(" + ".join(sorted(names_without_free_shape(member.candidate.identifiers))))
    return _outcome_of_comparison(
        comparison,
        VerdictKind.GROUP,
        sentence,
        # rounding may put the sum of the members' probabilities above one
        min(probability, 1.0),
        judged_hypothesis=members[0],
        members=members,
        effects=tuple(all_effects),
        group=tuple(group),
        gates=(comparison.check_fit(members[0]),),
    )


def _group_sentence(
    comparison: Comparison[HypothesisT],
    members: Sequence[HypothesisT],
    effects_by_member: Sequence[Sequence[NamedEffect]],
    probability: float,
) -> str:
    """Return the sentence that lists the members of a group and the share that each explains.

    The probability is that one of the members is true.
    """
    member_texts = []
    for member, effects in zip(members, effects_by_member, strict=True):
        member_share = comparison.errors(member).closed
        share_in_brackets = ""
        if member_share is not None:
            share_in_brackets = f" ({percent_with_interval(member_share)})"
        member_texts.append(f"{effects_text(effects)}{share_in_brackets}")
    sentence = (
        f"Either {listing(member_texts, 'or')} is missing (probability "
        f"{probability_text(probability)}); these data cannot tell which."
    )
    best_share = comparison.errors(members[0]).closed
    if best_share is None:
        return f"{sentence} {capital(comparison.closed_share_clause(members[0]))}."
    return (
        f"{sentence} In brackets the share of the mean square error that each explains in "
        f"{compared_trials_text(best_share)}."
    )


def _unexplained_outcome(
    comparison: Comparison[HypothesisT],
    simulation_verdict: Verdict,
    considered_hypothesis: HypothesisT | None = None,
    reason: str = "",
) -> VerdictOutcome:
    """Return the verdict that there is an unexplained gap.

    Its sentence mentions the best hypothesis, unless that explains hardly anything of the gap or
    makes the error larger.

    Parameters
    ----------
    comparison : Comparison
        The comparison of all hypotheses.
    simulation_verdict : Verdict
        The verdict on the simulations.
    considered_hypothesis : HypothesisT, optional
        The hypothesis that was considered for a name; if left out, the one that explains the
        largest share of the gap is mentioned.
    reason : str
        The reason why it is not named. If left out, it is that of `Comparison.objection_to_naming`,
        or else that its probability is too low.
    """
    gap_sentences = f"{_gap_text(simulation_verdict)} {comparison.gap_sentence()}".strip()
    mentioned_hypothesis = (
        _hypothesis_explaining_most(comparison)
        if considered_hypothesis is None
        else considered_hypothesis
    )
    judged_hypothesis = None
    resembles: tuple[str, ...] = ()
    if mentioned_hypothesis is None or not _explains_mentioned_share(
        comparison, mentioned_hypothesis
    ):
        sentence = f"{gap_sentences} No effect of the catalogue follows it."
    elif comparison.enlarges_error(mentioned_hypothesis):
        sentence = f"{gap_sentences} {_larger_error_sentence(comparison, mentioned_hypothesis)}"
    else:
        reason = reason or comparison.objection_to_naming(mentioned_hypothesis)
        if considered_hypothesis is not None and not reason:
            probability = comparison.probability(mentioned_hypothesis)
            reason = (
                f"its probability is {probability:.2g}: a name needs {SEARCH.name_probability:g}"
            )
        sentence = (
            f"{gap_sentences} {_best_hypothesis_sentence(comparison, mentioned_hypothesis, reason)}"
        )
        judged_hypothesis = mentioned_hypothesis
        resembles = names_without_free_shape(mentioned_hypothesis.candidate.identifiers)
    return _outcome_of_comparison(
        comparison,
        VerdictKind.UNEXPLAINED,
        sentence,
        simulation_verdict.probability,
        judged_hypothesis=judged_hypothesis,
        members=[],
        resembles=resembles,
        gates=simulation_verdict.gates,
    )


def _gap_text(simulation_verdict: Verdict) -> str:
    """Return the sentence that there is a gap, with the reason of the first failed test."""
    reasons = [gate.reason for gate in simulation_verdict.gates if gate.has_failed]
    first_reason = reasons[0] if reasons else ""
    return f"There is a gap that no effect of the catalogue fits. {first_reason}".strip()


def _explains_mentioned_share(comparison: Comparison[HypothesisT], hypothesis: HypothesisT) -> bool:
    """Return whether a hypothesis explains enough of the gap to be mentioned in a sentence."""
    return comparison.held_out_or_fitted_share(hypothesis).value >= LEAST_MENTIONED_SHARE


def _hypothesis_explaining_most(comparison: Comparison[HypothesisT]) -> HypothesisT | None:
    """Return the hypothesis that explains the largest share of the gap; None without effects."""
    with_effects = [
        hypothesis for hypothesis in comparison.ranked_hypotheses if hypothesis.candidate.terms
    ]
    return max(
        with_effects,
        key=lambda hypothesis: comparison.held_out_or_fitted_share(hypothesis).value,
        default=None,
    )


def _best_hypothesis_sentence(
    comparison: Comparison[HypothesisT], hypothesis: HypothesisT, reason: str
) -> str:
    """Return the sentence on the best hypothesis, and the reason why it is not named, if any."""
    effects = effects_text(named_effects(comparison.problem, hypothesis))
    share_clause = comparison.closed_share_clause(hypothesis)
    sentence = f"The best hypothesis is {effects}: {share_clause}."
    return f"{sentence} {not_named_sentence(reason)}" if reason else sentence


def not_named_sentence(reason: str) -> str:
    """Return the sentence that a hypothesis is not named, with the reason.

    Parameters
    ----------
    reason : str
        The reason as a clause or a sentence, such as "The residuals follow the loads."
    """
    return f"It is not named, because {small(reason.removesuffix('.'))}."


def _larger_error_sentence(comparison: Comparison[HypothesisT], hypothesis: HypothesisT) -> str:
    """Return the sentence on a hypothesis that is not named because it makes the error larger."""
    effects = effects_text(named_effects(comparison.problem, hypothesis))
    opening = f"The nearest in the catalogue is {effects}, but"
    if comparison.simulation(hypothesis) is comparison.search.no_effect:
        return f"{opening} it cannot be simulated: no effect is named."
    share_clause = comparison.closed_share_clause(hypothesis)
    return f"{opening} {share_clause}: no effect is named, and there is nothing to apply."


def _outcome_of_comparison(
    comparison: Comparison[HypothesisT],
    kind: VerdictKind,
    sentence: str,
    probability: float,
    *,
    judged_hypothesis: HypothesisT | None,
    members: Sequence[HypothesisT],
    effects: tuple[NamedEffect, ...] = (),
    group: tuple[str, ...] = (),
    family: str = "",
    gates: tuple[Gate, ...] = (),
    resembles: tuple[str, ...] = (),
) -> VerdictOutcome:
    """Return a verdict that lists all hypotheses of a comparison with their probabilities.

    Parameters
    ----------
    comparison : Comparison
        The comparison of all hypotheses.
    kind, sentence, probability
        What is concluded, see `Verdict`.
    judged_hypothesis : HypothesisT or None
        The hypothesis that the verdict is about; None for the model without effect.
    members : sequence of HypothesisT
        The hypotheses that are listed first, in their order.
    effects, group, family, gates, resembles
        Further attributes of the `Verdict`.
    """
    # all hypotheses with their probabilities: the members first, then the others by probability
    other_hypotheses = []
    for hypothesis in comparison.ranked_hypotheses:
        if not any(hypothesis is member for member in members):
            other_hypotheses.append(hypothesis)
    listed_hypotheses: list[HypothesisT] = [*members, *other_hypotheses]
    scores = np.array([comparison.score(hypothesis) for hypothesis in listed_hypotheses])
    probabilities = normalised_probabilities(scores).tolist()
    weighted_hypotheses: list[WeightedHypothesis] = []
    for hypothesis, hypothesis_probability in zip(listed_hypotheses, probabilities, strict=True):
        weighted_hypotheses.append(WeightedHypothesis(hypothesis, hypothesis_probability))
    weighted_members = weighted_hypotheses[: len(members)]
    weighted_others = weighted_hypotheses[len(members) :]
    weighted_others.sort(key=lambda weighted_hypothesis: -weighted_hypothesis.probability)
    # the simulation that represents the verdict
    fit = comparison.search.no_effect
    if judged_hypothesis is not None:
        fit = comparison.simulation(judged_hypothesis)
    comparison.judged_hypothesis = judged_hypothesis
    best_hypothesis = listed_hypotheses[0] if judged_hypothesis is None else judged_hypothesis
    log_bayes_factor = best_hypothesis.log_evidence - comparison.no_effect.log_evidence
    conclusion = Conclusion(comparison.search, log_bayes_factor, weighted_members + weighted_others)
    return conclusion.build_outcome(
        kind,
        sentence,
        probability,
        fit,
        effects=effects,
        group=group,
        family=family,
        gates=gates,
        resembles=resembles,
        remainders=remainder_estimates(comparison.problem, fit),
    )
