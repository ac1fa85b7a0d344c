"""Verdicts on hypotheses that leave more than noise.

A verdict then names a set of effects *in part*, or a group of hypotheses that cannot be told apart,
or says that the gap between model and readings is unexplained. A set is named in part if it is
probable and explains most of the gap, in fitted and in held-out trials, with calibrated values that
are consistent with priors of twice the stated deviations.
"""

from collections.abc import Sequence

import numpy as np

from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate, NamedEffect, Verdict, VerdictKind
from reporting.probabilities import normalised_probabilities
from reporting.words import capital, listing, small

from .closed_share import compared_trials_text, percent_with_interval
from .comparison import Comparison, HypothesisT, effect_place_pairs, family_place_pairs
from .hypotheses import (
    UNEXPLAINED_GAP,
    VerdictOutcome,
    WeightedHypothesis,
    curve_sentence,
    effects_text,
    group_sentence,
    missing_clause,
    named_effects,
    names_without_free_shape,
    outcome_with_hypotheses,
    probability_text,
)

LEAST_MENTIONED_SHARE = 0.1
"""Least share of the gap for a hypothesis to be mentioned as the best one if none is named."""


def decide_on_remainder(
    comparison: Comparison[HypothesisT], noise_verdict: Verdict
) -> VerdictOutcome:
    """Return the verdict of a comparison: named in part, a group, or an unexplained gap.

    Parameters
    ----------
    noise_verdict : Verdict
        The verdict if only noise may remain, with the tests that the simulations failed.
    """
    if not comparison.nameable_hypotheses:
        return unexplained_outcome(comparison, noise_verdict)
    # the best hypothesis, and those that the data do not separate from it
    best_hypothesis = comparison.simplest_equivalent_hypothesis(comparison.nameable_hypotheses[0])
    members = [best_hypothesis, *comparison.competing_hypotheses(best_hypothesis)]
    other_count = len(members) - 1
    if len(members) > SEARCH.largest_group:
        reason = f"{other_count} others explain as much, so that none of them can be named"
        return unexplained_outcome(comparison, noise_verdict, best_hypothesis, reason)
    # conditions that a name must fulfil
    if comparison.enlarges_error(best_hypothesis):
        rival = comparison.more_probable_rival(best_hypothesis)
        explains_most = rival is not None and (
            comparison.held_out_or_fitted_share(rival).value >= SEARCH.least_gap_share
        )
        mentioned_hypothesis = rival if explains_most else best_hypothesis
        return unexplained_outcome(comparison, noise_verdict, mentioned_hypothesis)
    remaining_error = comparison.reason_of_remaining_error(best_hypothesis)
    if remaining_error:
        return unexplained_outcome(comparison, noise_verdict, best_hypothesis, remaining_error)
    probability = comparison.probability(*members)
    if probability < SEARCH.name_probability:
        return unexplained_outcome(comparison, noise_verdict, best_hypothesis)
    log_bayes_factor = best_hypothesis.log_evidence - comparison.no_effect.log_evidence
    is_proved = comparison.is_proved_curve(best_hypothesis)
    if log_bayes_factor < SEARCH.least_log_bayes_factor and not is_proved:
        reason = (
            "a missing force without any law explains the readings as well "
            f"(ln Bayes factor {log_bayes_factor:.3g}; a name needs "
            f"{SEARCH.least_log_bayes_factor:g})"
        )
        return unexplained_outcome(comparison, noise_verdict, best_hypothesis, reason)
    # one hypothesis is named in part; several are a group if all of them pass the absolute test
    if other_count == 0:
        return named_in_part_outcome(comparison, best_hypothesis, probability)
    if not any(comparison.absolute_fit(member).has_failed for member in members):
        return _group_outcome(comparison, members, probability)
    names = [effects_text(named_effects(comparison.problem, member)) for member in members[1:]]
    reason = (
        "it leaves more than noise, and these data do not distinguish it from "
        f"{listing(names, 'or')}"
    )
    return unexplained_outcome(comparison, noise_verdict, best_hypothesis, reason)


# ---------------------------------------------------------------- one hypothesis, named in part


def named_in_part_outcome(
    comparison: Comparison[HypothesisT], best_hypothesis: HypothesisT, probability: float
) -> VerdictOutcome:
    """Return the verdict that names effects, and leaves a part of the gap unexplained.

    Parameters
    ----------
    best_hypothesis : HypothesisT
        The hypothesis that is named.
    """
    effects = named_effects(comparison.problem, comparison.record_values(best_hypothesis))
    share = comparison.held_out_or_fitted_share(best_hypothesis)
    families = {term.effect.family for term in best_hypothesis.candidate.terms if term.free_shape}
    family = ", ".join(sorted(families))
    sentence = curve_sentence(comparison.problem, effects, probability)
    if not sentence:
        # effects of the catalogue, and families with a shape of their own
        clauses = []
        canonical_effects = [effect for effect in effects if not effect.shape]
        if canonical_effects:
            clauses.append(missing_clause(canonical_effects))
        if family:
            clauses.append(f"an effect of the family {family} is missing, with a fitted shape")
        sentence = (
            f"{capital(listing(clauses))} (probability {probability_text(probability)}), and a "
            "part without a name."
        )
    reasons = ""
    if comparison.has_held_out and not share.held_out:
        reasons = "In the held-out trials it has hardly any force."
    reasons += _shape_sentence(comparison, best_hypothesis)
    reasons += _unproved_addition_sentence(comparison, best_hypothesis)
    return _outcome(
        comparison,
        VerdictKind.NAMED_IN_PART,
        sentence,
        probability,
        judged_hypothesis=best_hypothesis,
        members=[best_hypothesis],
        effects=effects,
        family=family,
        gates=(comparison.absolute_fit(best_hypothesis),),
        reasons=reasons.strip(),
    )


def _shape_sentence(comparison: Comparison[HypothesisT], best_hypothesis: HypothesisT) -> str:
    """Return the sentence on the shape parameters of a law that the data determine.

    A parameter is determined if its standard deviation is below
    `SEARCH.determined_shape_deviation`. The sentence is empty if there is none, if the hypothesis
    has several effects, or if the law with a fitted shape explains less of the gap in the decisive
    trials, by more than `SEARCH.least_added_share`.
    """
    if len(best_hypothesis.candidate.terms) != 1:
        return ""
    (term,) = best_hypothesis.candidate.terms
    free_shape_hypothesis = comparison.fit_with_free_shape(best_hypothesis)
    if free_shape_hypothesis is None:
        return ""
    least_share = (
        comparison.held_out_or_fitted_share(best_hypothesis).value - SEARCH.least_added_share
    )
    if comparison.held_out_or_fitted_share(free_shape_hypothesis).value < least_share:
        return ""
    first_shape = len(free_shape_hypothesis.shared) + len(term.effect.parameters)
    deviations = np.sqrt(np.diag(free_shape_hypothesis.covariance))[first_shape:]
    (effect,) = named_effects(comparison.problem, free_shape_hypothesis)
    texts = []
    for parameter, deviation in zip(effect.shape, deviations, strict=True):
        if deviation < SEARCH.determined_shape_deviation:
            description = parameter.description.split(" (")[0]
            interval = f"{parameter.low:.2g} to {parameter.high:.2g}"
            texts.append(f"{description} {parameter.value:.2g} ({interval})")
    return f" With a fitted shape: {', '.join(texts)}." if texts else ""


def _unproved_addition_sentence(
    comparison: Comparison[HypothesisT], best_hypothesis: HypothesisT
) -> str:
    """Return the sentence on effects that may be missing besides those of the best hypothesis.

    A larger hypothesis has all effects of the best one, by family and place, and more, which act on
    the structure and not on sensors; its score is at most `SEARCH.contender_range` lower. The
    sentence names what the most probable larger hypothesis adds. It is empty if there is none, or
    if that one does not explain more of the gap by at least `SEARCH.negligible_share`.
    """
    best_pairs = family_place_pairs(best_hypothesis)
    least_score = comparison.score(best_hypothesis) - SEARCH.contender_range
    larger_hypothesis = None
    for hypothesis in comparison.ranked_hypotheses:
        has_more_pairs = family_place_pairs(hypothesis) > best_pairs  # a proper superset
        only_on_structure = all(
            comparison.acts_on_structure(term) for term in hypothesis.candidate.terms
        )
        if has_more_pairs and only_on_structure and comparison.score(hypothesis) > least_score:
            larger_hypothesis = hypothesis
            break
    if larger_hypothesis is None:
        return ""
    least_share = (
        comparison.held_out_or_fitted_share(best_hypothesis).value + SEARCH.negligible_share
    )
    if comparison.held_out_or_fitted_share(larger_hypothesis).value < least_share:
        return ""
    added_effects = []
    for effect in named_effects(comparison.problem, larger_hypothesis):
        if (effect.family, effect.place) not in best_pairs:
            added_effects.append(effect)
    return (
        f" {capital(effects_text(added_effects))} may also be missing, but this is not proved: it "
        "gains less evidence than it costs."
    )


# ---------------------------------------------------------------- several hypotheses


def _group_outcome(
    comparison: Comparison[HypothesisT], members: Sequence[HypothesisT], probability: float
) -> VerdictOutcome:
    """Return the verdict that one of several hypotheses is true, and the data do not show which.

    `members` are these hypotheses, the best one first, and `probability` is that of one of them
    being true. The gate in the verdict is that of the best one.
    """
    effects_by_member = [named_effects(comparison.problem, member) for member in members]
    all_effects: list[NamedEffect] = []
    for effects in effects_by_member:
        all_effects.extend(effects)
    member_names = []
    for member in members:
        effect_names = sorted(names_without_free_shape(member.candidate.identifiers))
        member_names.append(" + ".join(effect_names))
    return _outcome(
        comparison,
        VerdictKind.GROUP,
        group_sentence(effects_by_member, probability),
        # rounding may put the sum of the members' probabilities above one
        min(probability, 1.0),
        judged_hypothesis=members[0],
        members=members,
        effects=tuple(all_effects),
        group=tuple(member_names),
        gates=(comparison.absolute_fit(members[0]),),
        reasons=_sentences_on_members(comparison, members, effects_by_member),
    )


def _sentences_on_members(
    comparison: Comparison[HypothesisT],
    members: Sequence[HypothesisT],
    effects_by_member: Sequence[Sequence[NamedEffect]],
) -> str:
    """Return what all members of a group have in common, and the share that each explains."""
    sentences = []
    common_pairs = frozenset.intersection(*(effect_place_pairs(member) for member in members))
    common_effects = []
    for effect in effects_by_member[0]:
        if (effect.identifier, effect.place) in common_pairs:
            common_effects.append(effect)
    if common_effects:
        sentences.append(f"In each case {missing_clause(common_effects)}.")
    shares = [comparison.errors(member).closed for member in members]
    known_shares = [share for share in shares if share is not None]
    if len(known_shares) == len(members):
        texts = listing(map(percent_with_interval, known_shares))
        trials = compared_trials_text(known_shares[0])
        sentences.append(f"They explain {texts} of the mean square error in {trials}.")
    else:
        sentences.append(f"{capital(comparison.closed_share_clause(members[0]))}.")
    return " ".join(sentences)


# ---------------------------------------------------------------- an unexplained gap


def unexplained_outcome(
    comparison: Comparison[HypothesisT],
    noise_verdict: Verdict,
    considered_hypothesis: HypothesisT | None = None,
    reason: str = "",
) -> VerdictOutcome:
    """Return the verdict that there is an unexplained gap.

    Its sentence mentions the best hypothesis, unless that explains hardly anything of the gap or
    makes the error larger.

    Parameters
    ----------
    noise_verdict : Verdict
        The verdict on the simulations.
    considered_hypothesis : HypothesisT, optional
        The hypothesis that was considered for a name; if left out, the one that explains the
        largest share of the gap is mentioned.
    reason : str
        The reason why it is not named. If left out, it is that of `Comparison.objection_to_naming`,
        or else that its probability is too low.
    """
    failed_gates = [gate.reason for gate in noise_verdict.gates if gate.has_failed]
    mentioned_hypothesis = (
        _hypothesis_explaining_most(comparison)
        if considered_hypothesis is None
        else considered_hypothesis
    )
    judged_hypothesis = None
    resembles: tuple[str, ...] = ()
    explained_share = 0.0
    if mentioned_hypothesis is not None:
        explained_share = comparison.held_out_or_fitted_share(mentioned_hypothesis).value
    reasons = failed_gates[:1]
    if mentioned_hypothesis is None or explained_share < LEAST_MENTIONED_SHARE:
        reasons.append("No effect of the catalogue is near.")
    elif comparison.enlarges_error(mentioned_hypothesis):
        reasons.append(_larger_error_sentence(comparison, mentioned_hypothesis))
    else:
        reason = reason or comparison.objection_to_naming(mentioned_hypothesis)
        if considered_hypothesis is not None and not reason:
            probability = comparison.probability(mentioned_hypothesis)
            reason = (
                f"its probability is {probability:.2g}: a name needs {SEARCH.name_probability:g}"
            )
            rival = comparison.more_probable_rival(mentioned_hypothesis)
            if rival is not None:
                rival_text = effects_text(named_effects(comparison.problem, rival))
                reason += f", and {rival_text} is more probable"
        nearest = effects_text(named_effects(comparison.problem, mentioned_hypothesis))
        reasons.append(f"The nearest in the catalogue is {nearest}.")
        if reason:
            reasons.append(not_named_sentence(reason))
        judged_hypothesis = mentioned_hypothesis
        resembles = names_without_free_shape(mentioned_hypothesis.candidate.identifiers)
    return _outcome(
        comparison,
        VerdictKind.UNEXPLAINED,
        UNEXPLAINED_GAP,
        noise_verdict.probability,
        judged_hypothesis=judged_hypothesis,
        members=[],
        resembles=resembles,
        gates=noise_verdict.gates,
        reasons=" ".join(reasons),
    )


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


# ---------------------------------------------------------------- the verdict


def _outcome(
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
    reasons: str = "",
) -> VerdictOutcome:
    """Return a verdict that lists all hypotheses, its members first, then the most probable ones.

    Parameters
    ----------
    kind, sentence, probability
        What is concluded, see `Verdict`.
    judged_hypothesis : HypothesisT or None
        The hypothesis that the verdict is about; None for the model without effect.
    members : sequence of HypothesisT
        The hypotheses that are listed first, in their order.
    effects, group, family, gates, resembles, reasons
        Further attributes of the `Verdict`.
    """
    search = comparison.search
    others = []
    for hypothesis in comparison.ranked_hypotheses:
        if not any(hypothesis is member for member in members):
            others.append(hypothesis)
    listed_hypotheses: list[HypothesisT] = [
        *members,
        *sorted(others, key=lambda hypothesis: -comparison.score(hypothesis)),
    ]
    scores = np.array([comparison.score(hypothesis) for hypothesis in listed_hypotheses])
    probabilities = normalised_probabilities(scores).tolist()
    weighted_hypotheses = []
    for hypothesis, hypothesis_probability in zip(listed_hypotheses, probabilities, strict=True):
        values = comparison.record_values(hypothesis)
        weighted_hypotheses.append(WeightedHypothesis(values, hypothesis_probability))
    # the simulation that represents the verdict
    fit = search.no_effect
    if judged_hypothesis is not None:
        fit = comparison.simulation(judged_hypothesis)
    best_hypothesis = listed_hypotheses[0] if judged_hypothesis is None else judged_hypothesis
    verdict = Verdict(
        kind,
        sentence,
        probability,
        comparison.log_bayes_factor(best_hypothesis),
        effects=effects,
        group=group,
        family=family,
        gates=gates,
        resembles=resembles,
        reasons=reasons,
    )
    return outcome_with_hypotheses(verdict, search, fit, weighted_hypotheses)
