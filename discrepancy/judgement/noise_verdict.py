"""Verdicts for the case that the right hypothesis leaves only noise, as in the noise records.

A set of effects is *named* if it is probable enough, has enough evidence against the model as it
is, and passes all tests of its simulation.
"""

from collections.abc import Sequence
from typing import NamedTuple

from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.gates import check_absolute_fit
from discrepancy.fits.predictive import with_draws
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate, NamedEffect, VerdictKind
from reporting.probabilities import total_probability
from reporting.words import capital, listing, small

from .comparison import EffectSet, HypothesisT
from .hypotheses import (
    UNEXPLAINED_GAP,
    VerdictOutcome,
    curve_sentence,
    effects_text,
    group_sentence,
    missing_clause,
    named_effects,
    names_without_free_shape,
    probability_text,
)
from .noise_case import CheckedFit, NoiseCase

MOST_NEAREST = 4
"""Largest number of explanations that a verdict on a gap too small to be detected mentions."""


def decide_on_noise(case: NoiseCase[HypothesisT]) -> VerdictOutcome:
    """Return the verdict by the first rule that holds, for the case that only noise may remain.

    The rules in words are the `[[rule]]` tables of `sentences.toml`, in the same order.
    """
    # no set of effects is clearly better than the model as it is
    if not case.is_better_than_no_effect:
        if case.no_effect_gate.has_failed:
            return gap_verdict(case)
        is_undecided = case.no_effect_probability < SEARCH.inconclusive_probability
        if case.leading_set and is_undecided:
            return undecided_verdict(case)
        return nothing_missing_verdict(case)
    # several sets explain the readings about equally well
    if not case.is_sure_enough_to_name:
        return (
            common_effects_verdict(case) or common_family_verdict(case) or undecided_verdict(case)
        )
    # one set is sure: name it, or its family if the shape of its law is free
    if case.leading_fit.candidate.has_free_shape:
        if case.tested_set.fails:
            return failed_test_verdict(case, case.tested_set)
        return family_verdict(case, case.tested_set)
    if not case.needs_free_shape and not case.tested_set.fails:
        return named_verdict(case)
    # it fails a test as it is: the family remains if it passes
    if case.tested_family_set is None:
        return failed_test_verdict(case, case.tested_set)
    if case.tested_family_set.fails:
        return failed_test_verdict(case, case.tested_family_set)
    return family_verdict(case, case.tested_family_set)


def gap_verdict(case: NoiseCase[HypothesisT]) -> VerdictOutcome:
    """Return the verdict that there is a gap which no effect of the catalogue explains."""
    return case.unexplained(
        UNEXPLAINED_GAP,
        case.no_effect_gate.reason,
        case.probabilities[case.leading_set],
        (case.no_effect_gate,),
        case.leading_set,
    )


def nothing_missing_verdict(case: NoiseCase[HypothesisT]) -> VerdictOutcome:
    """Return the verdict that nothing is missing."""
    reasons = ""
    if case.noise:
        explanation = f"the model explains the data within their noise, {case.noise}"
    elif case.no_effect_gate.passed:
        explanation = "the model explains the data within their noise"
    else:
        explanation = "no effect of the catalogue explains the data better than the model does"
        reasons = case.no_effect_gate.reason
    probability = probability_text(case.no_effect_probability)
    return case.outcome(
        VerdictKind.NOTHING_MISSING,
        f"Nothing is missing (probability {probability}): {explanation}.",
        case.no_effect_probability,
        gates=(case.no_effect_gate,),
        reasons=reasons,
    )


def named_verdict(case: NoiseCase[HypothesisT]) -> VerdictOutcome:
    """Return the verdict that the effects of the leading set are missing, each by its name."""
    fit = with_draws(case.problem, case.leading_fit)
    checked_fit = case.tested_set
    effects = named_effects(case.problem, fit)
    probability = probability_text(case.probability)
    return case.outcome(
        VerdictKind.NAMED,
        f"{capital(missing_clause(effects))} (probability {probability}).",
        case.probability,
        fit,
        effects=effects,
        gates=_gates(case, checked_fit),
        reasons="" if checked_fit.absolute_fit.passed else checked_fit.absolute_fit.reason,
    )


def family_verdict(case: NoiseCase[HypothesisT], checked_fit: CheckedFit) -> VerdictOutcome:
    """Return the verdict that a force of a certain family is missing, with a fitted shape.

    Laws of one family, such as all dampings, differ only in their shape, for example the exponent
    of the velocity. If no law of the catalogue has the right shape, it is fitted too (it is free),
    and the family is all that can be named.

    Parameters
    ----------
    case : NoiseCase
        The set of effects that is considered for a name, its leading set, with its probability.
    checked_fit : CheckedFit
        The fit of this set with the free shape, and its tests.
    """
    fit = with_draws(case.problem, checked_fit.fit)  # intervals of a posterior that is not Gaussian
    effects = named_effects(case.problem, fit)
    terms_of_free_shape = [term for term in fit.candidate.terms if term.free_shape]
    family = ", ".join(sorted({term.effect.family for term in terms_of_free_shape}))
    # a force that is the only effect, given point by point as a curve, is described by that curve
    sentence = curve_sentence(case.problem, effects, case.probability)
    if not sentence:
        other_names = ", ".join(effect.name for effect in effects if not effect.shape)
        beside_clause = f", beside {other_names}" if other_names else ""
        sentence = (
            f"An effect of the family {family} is missing, with a fitted shape{beside_clause} "
            f"(probability {probability_text(case.probability)})."
        )
    return case.outcome(
        VerdictKind.FAMILY,
        sentence,
        case.probability,
        fit,
        effects=effects,
        family=family,
        gates=_gates(case, checked_fit),
    )


def failed_test_verdict(case: NoiseCase[HypothesisT], checked_fit: CheckedFit) -> VerdictOutcome:
    """Return the verdict of an unexplained gap after the leading set or its family failed a test.

    Parameters
    ----------
    checked_fit : CheckedFit
        The leading set, or the set with a free shape.
    """
    reason = checked_fit.absolute_fit.reason
    if not checked_fit.absolute_fit.has_failed and checked_fit.consistency.has_failed:
        reason = checked_fit.consistency.reason
    if not case.leading_fit.candidate.has_free_shape:  # else it has no nearest effect to mention
        if case.needs_free_shape and case.tested_family_set is None:
            reason = (
                "one of them would need a free shape, and with that much freedom nearly anything "
                "fits."
            )
        nearest_effects = effects_text(named_effects(case.problem, case.leading_fit))
        reason = f"The nearest in the catalogue is {nearest_effects}, but {small(reason)}"
    return case.unexplained(
        UNEXPLAINED_GAP,
        reason,
        case.probability,
        _gates(case, checked_fit),
        case.leading_set,
    )


def _gates(case: NoiseCase[HypothesisT], checked_fit: CheckedFit) -> tuple[Gate, ...]:
    """Return the tests of absolute fit, shape and consistency.

    There is no test of the shape if it is free already, or if the noise is coloured.
    """
    if case.leading_fit.candidate.has_free_shape or case.noise:
        return checked_fit.absolute_fit, checked_fit.consistency
    return checked_fit.absolute_fit, case.shape_gate, checked_fit.consistency


# ---------------------------------------------------------------- several sets


def common_effects_verdict(case: NoiseCase[HypothesisT]) -> VerdictOutcome | None:
    """Return the verdict that names the effects which all probable sets have in common.

    Such a verdict is right whichever of the probable sets is the true one. None is returned if the
    sets have no effect in common, if the common effects are not a probable set themselves, or if
    they cannot be named.
    """
    common_names = set.intersection(
        *(set(names_without_free_shape(names)) for names in case.probable_sets)
    )
    # a set in which a shape is free has another name, and is not looked for: its law is no name
    common_set = next((names for names in case.probable_sets if set(names) == common_names), None)
    if not common_set:
        return None
    common_case = NoiseCase(case.comparison, case.probabilities, common_set, case.noise)
    if not common_case.is_sure_enough_to_name:
        return None
    outcome = decide_on_noise(common_case)
    return outcome if outcome.verdict.kind is VerdictKind.NAMED else None


def common_family_verdict(case: NoiseCase[HypothesisT]) -> VerdictOutcome | None:
    """Return the verdict that names the family to which each probable set belongs.

    A law of free shape contains the named laws of its family: quadratic drag and damping by a free
    power of the speed are not two explanations. None is returned if a probable set is not a single
    effect of the family, if none of them has a free shape, or if the family cannot be named.
    """
    free_set: EffectSet | None = None
    families: set[tuple[str, ...]] = set()
    named_laws: list[NamedEffect] = []
    for names in case.probable_sets:
        hypothesis = case.comparison.best_of_set(names)
        terms = hypothesis.candidate.terms
        families.add(tuple(term.effect.family for term in terms))
        if not hypothesis.candidate.has_free_shape:
            named_laws.extend(named_effects(case.problem, hypothesis))
        elif free_set is None and len(terms) == 1:
            free_set = names
    if free_set is None or len(families) > 1:
        return None
    family_case = NoiseCase(case.comparison, case.probabilities, free_set, case.noise)
    if not family_case.is_sure_enough_to_name or family_case.tested_set.fails:
        return None
    outcome = family_verdict(family_case, family_case.tested_set)
    if not named_laws:
        return outcome
    reason = (
        f"{capital(effects_text(named_laws))} needs no fitted exponent, and explains the readings "
        "about as well."
    )
    return outcome._replace(verdict=outcome.verdict.with_reasons(reason))


class _Member(NamedTuple):
    """A set of effects that may be a member of a group, its fit, and the test of absolute fit."""

    effect_names: EffectSet
    fit: CandidateFit
    absolute_fit: Gate


def undecided_verdict(case: NoiseCase[HypothesisT]) -> VerdictOutcome:
    """Return the verdict if no set of effects is probable enough to be named.

    Something may be missing that is too small to be detected, if the model without effect is among
    the probable sets. Otherwise the probable sets that pass the test of absolute fit are a group.
    If none passes, or more than `SEARCH.largest_group` do, the gap is unexplained.
    """
    if () in case.probable_sets:
        return _below_limit_verdict(case)
    members = []
    for names in case.probable_sets:
        hypothesis = case.comparison.best_of_set(names)
        fit = case.comparison.simulation_of_best_fit(hypothesis)
        members.append(_Member(names, fit, check_absolute_fit(case.problem, fit)))
    # sets that fail the test are not members, and their probability is not counted
    passing_members = [member for member in members if not member.absolute_fit.has_failed]
    probability = total_probability(
        case.probabilities[member.effect_names] for member in passing_members
    )
    # an effect with its canonical and with a free shape is one member; a set is no member if a
    # subset of it is one
    distinct_members: dict[EffectSet, _Member] = {}
    for member in passing_members:
        distinct_members.setdefault(names_without_free_shape(member.effect_names), member)
    group = [
        member
        for names, member in distinct_members.items()
        if not any(set(other) < set(names) for other in distinct_members)
    ]
    if group and len(group) <= SEARCH.largest_group:
        return _group_verdict(case, group, probability)
    most_probable = members[0]
    reason = most_probable.absolute_fit.reason
    if group:
        reason = f"{len(group)} explanations fit equally well."
    return case.unexplained(
        UNEXPLAINED_GAP,
        reason,
        total_probability(case.probabilities[names] for names in case.probable_sets),
        (most_probable.absolute_fit,),
        most_probable.effect_names,
    )


def _below_limit_verdict(case: NoiseCase[HypothesisT]) -> VerdictOutcome:
    """Return the verdict that something may be missing, but is too small to be detected."""
    possible_effects = sorted(
        {name for names in case.probable_sets for name in names_without_free_shape(names)}
    )
    noise_clause = f", {case.noise}" if case.noise else ""
    probability = probability_text(case.no_effect_probability)
    sentence = (
        "Something may be missing, but it is too small for these data to distinguish from noise"
        f"{noise_clause} (probability that nothing is missing {probability})."
    )
    hypotheses = [case.comparison.best_of_set(names) for names in case.probable_sets]
    texts = [effects_text(named_effects(case.problem, item)) for item in hypotheses]
    nearest = listing(filter(None, texts), most=MOST_NEAREST)
    return case.outcome(
        VerdictKind.BELOW_LIMIT,
        sentence,
        case.no_effect_probability,
        case.leading_fit,
        group=tuple(possible_effects),
        gates=(check_absolute_fit(case.problem, case.leading_fit),),
        reasons=f"The nearest in the catalogue: {nearest}." if nearest else "",
    )


def _group_verdict(
    case: NoiseCase[HypothesisT], members: Sequence[_Member], probability: float
) -> VerdictOutcome:
    """Return the verdict that one of several sets is missing, and the data do not show which.

    The probability is that one of the members is missing. A single member is a group if its
    probability is too low for a name.
    """
    fits = [with_draws(case.problem, member.fit) for member in members]
    effects_by_member = [named_effects(case.problem, fit) for fit in fits]
    sentence = group_sentence(effects_by_member, probability)
    if len(members) == 1:
        (names,) = map(effects_text, effects_by_member)
        sentence = (
            f"{capital(names)} fits the data, but its probability of "
            f"{probability_text(probability)} is less than a name needs."
        )
    all_effects: list[NamedEffect] = []
    for effects in effects_by_member:
        all_effects.extend(effects)
    return case.outcome(
        VerdictKind.GROUP,
        sentence,
        probability,
        fits[0],
        effects=tuple(all_effects),
        group=tuple(
            " + ".join(names_without_free_shape(member.effect_names)) for member in members
        ),
        gates=(members[0].absolute_fit,),
    )
