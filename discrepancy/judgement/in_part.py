"""Verdicts if the residuals of every simulation are more than noise.

A verdict then names a set of effects *in part*, or a group of hypotheses that cannot be told apart,
or says that the gap between model and readings is unexplained. A set is named in part if it is
probable and explains most of the gap, in fitted and in held-out trials, with calibrated values that
are consistent with priors of twice the stated deviations. Hypotheses are compared by the missing
force if it can be estimated, else by simulations under a noise as large as their residuals.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import logsumexp

from discrepancy.fits.fitting import CandidateFit
from discrepancy.search.strategy import Search
from discrepancy.search.wide_noise import compare_under_wide_noise
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate, NamedEffect, Verdict, VerdictKind
from reporting.words import capital, listing

from .closed_share import share_text, trials_text
from .coloured_noise import remainder_estimates, verdict_under_coloured_noise
from .comparison import Comparison, H, effects_at_places
from .conclusion import (
    UNSTATED_GAIN,
    Conclusion,
    VerdictOutcome,
    WeightedHypothesis,
    effects_text,
    has_one_driven_channel,
    is_small,
    named_effects,
    plain_names,
    probability_text,
)
from .force_comparison import ForceComparison
from .part_sentences import shape_sentence, unproved_addition_sentence
from .simulation_comparison import SimulationComparison

LEAST_MENTIONED = 0.1
"""Least share of the gap for a hypothesis to be mentioned as the best one if none is named."""


def verdict_in_part(search: Search, first: Verdict) -> VerdictOutcome:
    """Return the verdict if the residuals of the best simulation are more than the recorded noise.

    Parameters
    ----------
    search : Search
        The candidates as fitted under the recorded noise, and the hypotheses that were fitted to
        the missing force, if there is any.
    first : Verdict
        The verdict on the simulations.

    Returns
    -------
    VerdictOutcome
        The verdict. If the gap is unexplained, its fit is that of the best hypothesis that the
        sentence mentions.
    """
    force_search = search.force_search if search.force_hypotheses else None
    if force_search is not None and not _missing_force_vanishes(search):
        return _verdict_by_comparison(ForceComparison(search, force_search), first)
    compare_under_wide_noise(search)
    comparison = SimulationComparison(search)
    outcome = verdict_under_coloured_noise(comparison)
    if outcome is not None:
        return outcome
    comparison.add_families()
    return _verdict_by_comparison(comparison, first)


def _missing_force_vanishes(search: Search) -> bool:
    """Return whether a simulation is more probable than every hypothesis with a missing force.

    A simulation is the limit of an estimate whose missing force is zero. It is compared with the
    other estimates on the same readings and under the same noise. This is possible only if all
    trials are in motion, as trials at rest show no missing force, and if every channel has a noise
    record.
    """
    if not search.is_all_in_motion or not np.all(search.problem.record_freedom > 0.0):
        return False
    simulations = [fit for fit in search.exact_fits.values() if fit.candidate.terms]
    scores = [search.score_under_recorded_noise(fit) for fit in simulations]
    best_with_force = max(search.score(hypothesis) for hypothesis in search.force_hypotheses)
    return max(scores, default=-np.inf) > best_with_force


def verdict_by_laws_alone(search: Search, first: Verdict) -> VerdictOutcome | None:
    """Return the verdict that names laws alone in part, without errors of readings.

    They must explain nearly all of the missing force.

    Parameters
    ----------
    search : Search
        The search, with hypotheses that were fitted to the missing force.
    first : Verdict
        The verdict on the simulations.

    Returns
    -------
    VerdictOutcome or None
        None if there are no such laws.
    """
    assert search.force_search is not None
    comparison = ForceComparison(search, search.force_search)
    outcome = _verdict_by_comparison(comparison, first)
    if outcome.verdict.kind is not VerdictKind.NAMED_IN_PART or comparison.standing is None:
        return None
    share = comparison.decisive_share(comparison.standing)
    return outcome if share.value > SEARCH.nearly_all else None


def without_negligible_effect(search: Search, first: Verdict, fit: CandidateFit) -> VerdictOutcome:
    """Return the verdict on a named set, without an effect that explains hardly anything.

    If the residuals are nearly noise, a slightly wider noise explains them as well as such an
    effect does. So the subsets of the set are compared with it under the wider noise. The effect
    remains if the evidence of the whole set is far above that of the set without it.

    Parameters
    ----------
    search : Search
        The candidates as fitted under the recorded noise.
    first : Verdict
        The verdict that names the set.
    fit : CandidateFit
        The fit of the set.
    """
    comparison = SimulationComparison(search)
    whole_key = set(fit.candidate.key)
    notable_key = _key_of_notable_terms(comparison, fit)
    least_share = comparison.decisive_share(fit).value - SEARCH.sliver
    is_each_notable = notable_key == whole_key
    if is_each_notable and not _has_equal_subset(comparison, whole_key, least_share):
        return VerdictOutcome(first, search, fit)
    compare_under_wide_noise(search)
    whole = search.wide_fits.get(fit.candidate.key, fit)
    for subset in sorted(search.wide_fits.values(), key=lambda fit: len(fit.candidate.terms)):
        key = set(subset.candidate.key)
        if not key or not key < whole_key:
            continue
        if comparison.decisive_share(subset).value < least_share:
            continue
        least_score = search.score(whole) - SEARCH.sliver_gain
        if key == notable_key or search.score(subset) > least_score:
            probability = comparison.probability(subset)
            if comparison.objection(subset) or probability < SEARCH.sure:
                return _unexplained(comparison, first, subset)
            return _named_in_part(comparison, subset, probability)
    search.wide_fits = {}
    return VerdictOutcome(first, search, fit)


def _has_equal_subset(
    comparison: SimulationComparison, whole_key: set[tuple[str, str]], least_share: float
) -> bool:
    """Return whether a subset of a set of effects explains at least some share of the gap."""
    for key, subset in comparison.search.exact_fits.items():
        is_subset = bool(key) and set(key) < whole_key
        if is_subset and comparison.decisive_share(subset).value > least_share:
            return True
    return False


def _key_of_notable_terms(
    comparison: SimulationComparison, fit: CandidateFit
) -> set[tuple[str, str]]:
    """Return the pairs (label, place) of the effects of a fit that are worth a name of their own.

    Errors of instruments that are too small are not. If the campaign has one channel under a
    recorded drive, no error of readings is.
    """
    problem = comparison.problem
    one_channel = has_one_driven_channel(problem)
    patches = fit.candidate.patches(problem.setting, fit.effect)
    notable = set()
    for term, patch in zip(fit.candidate.terms, patches, strict=True):
        if is_small(problem, patch, unstated=UNSTATED_GAIN):
            continue
        if comparison.acts_on_structure(term) or not one_channel:
            notable.add((term.label, term.place))
    return notable


# ---------------------------------------------------------------- verdicts of a comparison


def _verdict_by_comparison(comparison: Comparison[H], first: Verdict) -> VerdictOutcome:
    """Return the verdict that a comparison of hypotheses leads to.

    Parameters
    ----------
    comparison : Comparison
        The hypotheses.
    first : Verdict
        The verdict on the simulations, with the tests that they failed.
    """
    if not comparison.contenders:
        return _unexplained(comparison, first)
    best = comparison.simplest_equivalent(comparison.contenders[0])
    members = [best, *comparison.competitors(best)]
    others = len(members) - 1
    if len(members) > SEARCH.largest_group:
        reason = f"{others} others are as much of it: that tells nothing"
        return _unexplained(comparison, first, best, reason)
    if comparison.enlarges_error(best):
        return _unexplained(comparison, first, best)
    probability = comparison.probability(*members)
    if probability < SEARCH.sure:
        return _unexplained(comparison, first, best)
    log_bayes_factor = best.log_evidence - comparison.no_effect.log_evidence
    if log_bayes_factor < SEARCH.bayes_factor:
        reason = (
            "a missing force without any law explains the readings as well "
            f"(ln Bayes factor {log_bayes_factor:.3g}; a name needs {SEARCH.bayes_factor:g})"
        )
        return _unexplained(comparison, first, best, reason)
    if others == 0:
        return _named_in_part(comparison, best, probability)
    if all(comparison.passes_absolute_fit(member) for member in members):
        return _group(comparison, members, probability)
    names = [effects_text(named_effects(comparison.problem, member)) for member in members[1:]]
    reason = f"it leaves more than noise, and these data do not tell it from {listing(names, 'or')}"
    return _unexplained(comparison, first, best, reason)


def _named_in_part(comparison: Comparison[H], best: H, probability: float) -> VerdictOutcome:
    """Return the verdict that names the effects of a hypothesis in part.

    Parameters
    ----------
    comparison : Comparison
        The hypotheses.
    best : H
        The hypothesis that is named.
    probability : float
        Its probability.
    """
    effects = named_effects(comparison.problem, best)
    share = comparison.decisive_share(best)
    families = {term.effect.family for term in best.candidate.terms if term.free_shape}
    family = ", ".join(sorted(families))
    phrases = []
    canonical = effects_text(effect for effect in effects if not effect.shape)
    if canonical:
        phrases.append(canonical)
    if family:
        phrases.append(f"an effect of the family {family}, with a shape of its own,")
    _, explains = comparison.closed_share(best)
    sentence = (
        f"{capital(listing(phrases))} is missing (probability {probability_text(probability)}): "
        f"{explains}."
    )
    if comparison.has_held_out and not share.held_out:
        sentence += " In the trials held out it has hardly any force."
    sentence += f" It leaves {comparison.remaining_text(best, share)}, which is unexplained."
    sentence += shape_sentence(comparison, best)
    sentence += unproved_addition_sentence(comparison, best)
    return _outcome(
        comparison,
        VerdictKind.NAMED_IN_PART,
        sentence,
        probability,
        standing=best,
        members=[best],
        effects=effects,
        family=family,
        gates=(comparison.check_fit(best),),
    )


def _group(comparison: Comparison[H], members: Sequence[H], probability: float) -> VerdictOutcome:
    """Return the verdict that one of several hypotheses is true, which cannot be told apart.

    The sentence begins with the effects that all of them have in common.

    Parameters
    ----------
    comparison : Comparison
        The hypotheses.
    members : sequence of H
        The hypotheses of the group, the best one first.
    probability : float
        The probability that one of them is true.
    """
    effects_by_member = [named_effects(comparison.problem, member) for member in members]
    member_texts = []
    for member, effects in zip(members, effects_by_member, strict=True):
        closed, _ = comparison.closed_share(member)
        share_in_brackets = "" if closed is None else f" ({share_text(closed)})"
        member_texts.append(f"{effects_text(effects)}{share_in_brackets}")
    sentence = f"Either {listing(member_texts, 'or')} is missing; these data cannot tell which."
    closed, reason = comparison.closed_share(members[0])
    if closed is None:
        sentence += f" {capital(reason)}."
    else:
        sentence += (
            " In brackets the share of the mean square error that each explains in "
            f"{trials_text(closed)}."
        )
    common = frozenset.intersection(*(effects_at_places(member) for member in members))
    common_effects = []
    for effect in effects_by_member[0]:
        if (effect.identifier, effect.place) in common:
            common_effects.append(effect)
    if common_effects:
        sentence = f"{capital(effects_text(common_effects))} is missing. {sentence}"
    all_effects: list[NamedEffect] = []
    for effects in effects_by_member:
        all_effects.extend(effects)
    group = []
    for member in members:
        group.append(" + ".join(sorted(plain_names(member.candidate.identifiers))))
    return _outcome(
        comparison,
        VerdictKind.GROUP,
        sentence,
        min(probability, 1.0),
        standing=members[0],
        members=members,
        effects=tuple(all_effects),
        group=tuple(group),
        gates=(comparison.check_fit(members[0]),),
    )


def _unexplained(
    comparison: Comparison[H], first: Verdict, nearest: H | None = None, reason: str = ""
) -> VerdictOutcome:
    """Return the verdict that there is an unexplained gap, with the hypothesis that explains most.

    Parameters
    ----------
    comparison : Comparison
        The hypotheses.
    first : Verdict
        The verdict on the simulations.
    nearest : H, optional
        The hypothesis that was considered for a name; if left out, the one that explains the
        largest share of the gap is mentioned.
    reason : str
        The reason why it is not named. If left out, it is that of `Comparison.objection`, or else
        that its probability is too low.
    """
    failed_gate_reason = next((gate.reason for gate in first.gates if gate.passed is False), "")
    gap = f"There is a gap that no effect of the catalogue fits. {failed_gate_reason}".strip()
    gap = f"{gap} {comparison.gap_sentence()}".strip()
    mentioned = nearest
    if mentioned is None:
        with_effects = [other for other in comparison.ranked if other.candidate.terms]
        mentioned = max(
            with_effects, key=lambda other: comparison.decisive_share(other).value, default=None
        )
    if mentioned is None or comparison.decisive_share(mentioned).value < LEAST_MENTIONED:
        mentioned = None
        sentence = f"{gap} No effect of the catalogue follows it."
    elif comparison.enlarges_error(mentioned):
        sentence = f"{gap} {_larger_error_sentence(comparison, mentioned)}"
        mentioned = None
    else:
        reason = reason or comparison.objection(mentioned)
        if nearest is not None and not reason:
            probability = comparison.probability(nearest)
            reason = f"its probability is {probability:.2g}: a name needs {SEARCH.sure:g}"
        reason_clause = f"; it is no name, as {reason}" if reason else ""
        effects = effects_text(named_effects(comparison.problem, mentioned))
        _, explains = comparison.closed_share(mentioned)
        sentence = f"{gap} The best hypothesis is {effects}: {explains}{reason_clause}."
    resembles = () if mentioned is None else plain_names(mentioned.candidate.identifiers)
    return _outcome(
        comparison,
        VerdictKind.UNEXPLAINED,
        sentence,
        first.probability,
        standing=mentioned,
        members=[],
        resembles=resembles,
        gates=first.gates,
    )


def _larger_error_sentence(comparison: Comparison[H], hypothesis: H) -> str:
    """Return the sentence on a hypothesis that is not named because it makes the error larger."""
    effects = effects_text(named_effects(comparison.problem, hypothesis))
    nearest = f"The nearest in the catalogue is {effects}, but"
    if comparison.simulation(hypothesis) is comparison.search.no_effect:
        return f"{nearest} it cannot be simulated: nothing is named."
    _, enlarges = comparison.closed_share(hypothesis)
    return f"{nearest} {enlarges}: nothing is named, and nothing to be applied."


def _outcome(
    comparison: Comparison[H],
    kind: VerdictKind,
    sentence: str,
    probability: float,
    *,
    standing: H | None,
    members: Sequence[H],
    effects: tuple[NamedEffect, ...] = (),
    group: tuple[str, ...] = (),
    family: str = "",
    gates: tuple[Gate, ...] = (),
    resembles: tuple[str, ...] = (),
) -> VerdictOutcome:
    """Return a verdict that lists all hypotheses.

    Parameters
    ----------
    comparison : Comparison
        The hypotheses.
    kind, sentence, probability
        What is concluded, see `Verdict`.
    standing : H or None
        The hypothesis that the verdict is about; None for the model without effect.
    members : sequence of H
        The hypotheses that are listed first, in their order.
    effects, group, family, gates, resembles
        Further attributes of the `Verdict`.
    """
    others = []
    for other in comparison.ranked:
        if not any(other is member for member in members):
            others.append(other)
    listed: list[H] = [*members, *others]
    scores = np.array([comparison.score(hypothesis) for hypothesis in listed])
    probabilities = np.exp(scores - logsumexp(scores)).tolist()
    weighted: list[WeightedHypothesis] = []
    for hypothesis, weight in zip(listed, probabilities, strict=True):
        weighted.append(WeightedHypothesis(hypothesis, weight))
    first_other = len(members)
    other_weighted = sorted(weighted[first_other:], key=lambda entry: -entry.probability)
    weighted = weighted[:first_other] + other_weighted
    fit = comparison.search.no_effect
    if standing is not None:
        fit = comparison.simulation(standing)
    comparison.standing = standing
    best = listed[0] if standing is None else standing
    log_bayes_factor = best.log_evidence - comparison.no_effect.log_evidence
    return Conclusion(comparison.search, log_bayes_factor, weighted).outcome(
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
