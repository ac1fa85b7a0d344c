"""Verdicts on hypotheses of which a right one leaves only noise, as its records have it.

A set of effects is *named* if it is probable enough, has enough evidence against the model as it
is, and passes all tests of its simulation.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Generic, NamedTuple

from discrepancy.fits.fitting import CandidateFit, fit_free_shape
from discrepancy.fits.gates import LEAST_SHAPE_GAIN, check_absolute_fit, check_shape
from discrepancy.fits.predictive import with_draws
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate, NamedEffect, Verdict, VerdictKind
from fe.runtime.patch import INTERNAL_FORCES
from reporting.probabilities import total_probability
from reporting.words import listing

from .comparison import Comparison, EffectSet, HypothesisT, most_probable_sets
from .consistency_gate import check_consistency
from .hypotheses import (
    VerdictOutcome,
    WeightedHypothesis,
    curve_sentence,
    effects_text,
    list_hypotheses,
    named_effects,
    names_without_free_shape,
    probability_text,
    remainder_estimates,
)


class CheckedFit(NamedTuple):
    """A fit with the outcomes of the tests of absolute fit and consistency."""

    fit: CandidateFit
    absolute_fit: Gate
    consistency: Gate

    @property
    def fails(self) -> bool:
        """Whether a test fails; a test that could not be made has not failed."""
        return self.absolute_fit.has_failed or self.consistency.has_failed


class NoiseCase(Generic[HypothesisT]):
    """A comparison of hypotheses with what the rules ask of it.

    Parameters
    ----------
    comparison : Comparison
        The hypotheses.
    probabilities : mapping of tuple of str to float, optional
        The probability of each set of effects, the most probable first; those of the comparison if
        left out.
    leading_set : tuple of str, optional
        The set that is considered for a name; the most probable one if left out.
    noise : str
        A clause that describes the noise, such as "which is coloured as its records admit".
    """

    def __init__(
        self,
        comparison: Comparison[HypothesisT],
        probabilities: Mapping[EffectSet, float] | None = None,
        leading_set: EffectSet | None = None,
        noise: str = "",
    ) -> None:
        self.comparison = comparison
        self.problem = comparison.problem
        self.noise = noise
        self.probabilities = probabilities or comparison.set_probabilities()
        self.leading_set = next(iter(self.probabilities)) if leading_set is None else leading_set
        self.leading_hypothesis = comparison.best_of_set(self.leading_set)
        self.leading_fit = comparison.simulation_of_best_fit(self.leading_hypothesis)
        self.no_effect_probability = self.probabilities.get((), 0.0)
        self.no_effect_gate = check_absolute_fit(self.problem, self.no_effect_fit)

    @property
    def no_effect_fit(self) -> CandidateFit:
        """The simulation of the model without effect."""
        return self.comparison.search.compared_no_effect

    # ---------------------------------------------------------------- how probable

    @property
    def log_bayes_factor(self) -> float:
        """Ln of the evidence of the leading set over that of the model as it is [nat]."""
        return self.comparison.log_bayes_factor(self.leading_hypothesis)

    @property
    def has_enough_evidence(self) -> bool:
        """Whether the leading set has the evidence that a name needs."""
        return self.log_bayes_factor >= SEARCH.least_log_bayes_factor

    @property
    def is_better_than_no_effect(self) -> bool:
        """Whether a set of effects is preferred to the model without effect.

        That is so if the most probable set is not the empty one, and either its Bayes factor is
        large enough or the model without effect fails the test of absolute fit.
        """
        return bool(self.leading_fit.candidate.terms) and (
            self.has_enough_evidence or self.no_effect_gate.has_failed
        )

    @cached_property
    def probability(self) -> float:
        """The probability that the effects of the leading set are missing in the model.

        It is the sum over all sets that contain the effects of the leading set. The exponents of a
        law of free shape are fitted, so that all effects of its family (such as all dampings) can
        become the same law. The probability of the family is then returned if it is larger.
        """
        leading_names = set(names_without_free_shape(self.leading_set))
        set_probability = sum(
            probability
            for names, probability in self.probabilities.items()
            if leading_names <= set(names_without_free_shape(names))
        )
        # the same law of free shape is counted under several effects and at several places
        if self.leading_fit.candidate.has_free_shape:
            family = self.leading_fit.candidate.terms[0].effect.family
            set_probability = max(set_probability, self.comparison.probability_of_family(family))
        return min(set_probability, 1.0)

    @property
    def is_sure_enough_to_name(self) -> bool:
        """Whether the leading set is probable enough and has enough evidence to be named."""
        return self.probability >= SEARCH.name_probability and self.has_enough_evidence

    @cached_property
    def probable_sets(self) -> list[EffectSet]:
        """The most probable sets whose probabilities add up to that which a name needs."""
        return most_probable_sets(self.probabilities)

    # ---------------------------------------------------------------- tests

    def check(self, fit: CandidateFit) -> CheckedFit:
        """Return a fit with its tests of absolute fit and consistency."""
        return CheckedFit(
            fit, check_absolute_fit(self.problem, fit), check_consistency(self.problem, fit)
        )

    @cached_property
    def tested_set(self) -> CheckedFit:
        """The leading set with its tests."""
        return self.check(self.leading_fit)

    @cached_property
    def _best_free_shape(self) -> CandidateFit | None:
        """The fit of the most evidence in which the shape of one effect of the set is free.

        None if no effect of the set has a shape parameter, or one is free already.
        """
        if self.leading_fit.candidate.has_free_shape or self.noise:
            return None
        fits_with_free_shape = []
        for term_index in range(len(self.leading_fit.candidate.terms)):
            free_fit = fit_free_shape(self.problem, self.leading_fit, term_index)
            if free_fit is not None:
                fits_with_free_shape.append(free_fit)
        return max(fits_with_free_shape, key=lambda fit: fit.log_evidence, default=None)

    @cached_property
    def shape_gate(self) -> Gate:
        """The test whether a free shape explains more than the effects as they are."""
        return check_shape(self.leading_fit, self._best_free_shape)

    @property
    def needs_free_shape(self) -> bool:
        """Whether a free shape explains so much more that the family is named instead."""
        return self.shape_gate.statistic > LEAST_SHAPE_GAIN

    @cached_property
    def tested_family_set(self) -> CheckedFit | None:
        """The leading set with a free shape, and its tests; None if it may not be named.

        A free shape counts as one more effect, so the set must not have the largest size already.
        A law of free shape together with a second law could fit nearly anything.
        """
        family_fit = self._best_free_shape
        if family_fit is None or not self.needs_free_shape:
            return None
        patches = self.leading_fit.candidate.patches(self.problem.setting, self.leading_fit.effect)
        law_count = sum(len(patch.of(*INTERNAL_FORCES)) > 0 for patch in patches)
        if law_count > 1 or len(patches) == SEARCH.largest_set:
            return None
        return self.check(family_fit)

    # ---------------------------------------------------------------- verdicts

    def outcome(
        self,
        kind: VerdictKind,
        sentence: str,
        probability: float,
        fit: CandidateFit | None = None,
        *,
        effects: tuple[NamedEffect, ...] = (),
        group: tuple[str, ...] = (),
        family: str = "",
        gates: tuple[Gate, ...] = (),
        resembles: tuple[str, ...] = (),
    ) -> VerdictOutcome:
        """Return a verdict that lists all sets of effects, each at its most probable places.

        Parameters
        ----------
        kind, sentence, probability
            What is concluded, see `Verdict`.
        fit : CandidateFit, optional
            The fit that represents the verdict; the one without effect if left out.
        effects, group, family, gates, resembles
            Further attributes of the `Verdict`.
        """
        verdict = Verdict(
            kind,
            sentence,
            probability,
            self.log_bayes_factor,
            effects=effects,
            group=group,
            family=family,
            gates=gates,
            resembles=resembles,
        )
        sets = []
        for names, set_probability in self.probabilities.items():
            hypothesis = self.comparison.record_values(self.comparison.best_of_set(names))
            sets.append(WeightedHypothesis(hypothesis, set_probability))
        search = self.comparison.search
        fit = self.no_effect_fit if fit is None else fit
        verdict = replace(verdict, remainders=remainder_estimates(self.problem, fit))
        return VerdictOutcome(list_hypotheses(search, verdict, sets), search, fit)

    def unexplained(
        self, sentence: str, probability: float, gates: tuple[Gate, ...], names: EffectSet
    ) -> VerdictOutcome:
        """Return the verdict of an unexplained gap, which resembles a set of effects."""
        return self.outcome(
            VerdictKind.UNEXPLAINED,
            sentence,
            probability,
            gates=gates,
            resembles=names_without_free_shape(names),
        )


def decide_on_noise(case: NoiseCase[HypothesisT]) -> VerdictOutcome:
    """Return the verdict by the first rule that holds.

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
        return common_effects_verdict(case) or undecided_verdict(case)
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
    sentence = (
        f"There is a gap that no effect of the catalogue explains. {case.no_effect_gate.reason}"
    )
    return case.unexplained(
        sentence, case.probabilities[case.leading_set], (case.no_effect_gate,), case.leading_set
    )


def nothing_missing_verdict(case: NoiseCase[HypothesisT]) -> VerdictOutcome:
    """Return the verdict that nothing is missing."""
    if case.noise:
        sentence = f"The model explains the data within their noise, {case.noise}."
    elif case.no_effect_gate.passed:
        sentence = "The model explains the data within their noise."
    else:
        sentence = (
            "No effect of the catalogue explains the data better than the model does. "
            f"{case.no_effect_gate.reason}"
        )
    return case.outcome(
        VerdictKind.NOTHING_MISSING,
        sentence,
        case.no_effect_probability,
        gates=(case.no_effect_gate,),
    )


def named_verdict(case: NoiseCase[HypothesisT]) -> VerdictOutcome:
    """Return the verdict that names the leading set."""
    fit = with_draws(case.problem, case.leading_fit)
    checked_fit = case.tested_set
    effects = named_effects(case.problem, fit)
    probability_clause = f"probability {probability_text(case.probability)}"
    sentence = f"The model lacks {effects_text(effects)} ({probability_clause})."
    if not checked_fit.absolute_fit.passed:
        sentence += f" {checked_fit.absolute_fit.reason}"
    return case.outcome(
        VerdictKind.NAMED,
        sentence,
        case.probability,
        fit,
        effects=effects,
        gates=_gates(case, checked_fit),
    )


def family_verdict(case: NoiseCase[HypothesisT], checked_fit: CheckedFit) -> VerdictOutcome:
    """Return the verdict that names the family of a law that was fitted with a free shape.

    Parameters
    ----------
    case : NoiseCase
        The hypotheses.
    checked_fit : CheckedFit
        The leading set with a free shape.
    """
    fit = with_draws(case.problem, checked_fit.fit)
    effects = named_effects(case.problem, fit)
    free_terms = [term for term in fit.candidate.terms if term.free_shape]
    family = ", ".join(sorted({term.effect.family for term in free_terms}))
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
    """Return the verdict of an unexplained gap, as the leading set or its family fails a test.

    Parameters
    ----------
    case : NoiseCase
        The hypotheses.
    checked_fit : CheckedFit
        The leading set, or the set with a free shape.
    """
    reason = checked_fit.absolute_fit.reason
    if not checked_fit.absolute_fit.has_failed and checked_fit.consistency.has_failed:
        reason = checked_fit.consistency.reason
    if case.leading_fit.candidate.has_free_shape:  # it has no nearest effect to mention
        sentence = f"There is a gap that no effect of the catalogue fits. {reason}"
    else:
        if case.needs_free_shape and case.tested_family_set is None:
            reason = (
                "one of them would need a free shape, and with that much freedom nearly anything "
                "fits."
            )
        nearest_effects = " with ".join(case.leading_fit.candidate.identifiers)
        sentence = (
            "There is a gap that no effect of the catalogue fits; the nearest is "
            f"{nearest_effects}, but {reason[0].lower()}{reason[1:]}"
        )
    return case.unexplained(sentence, case.probability, _gates(case, checked_fit), case.leading_set)


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


class _Member(NamedTuple):
    """A set of effects that may be a member of a group, its fit, and the test of absolute fit."""

    effect_names: EffectSet
    fit: CandidateFit
    absolute_fit: Gate


def undecided_verdict(case: NoiseCase[HypothesisT]) -> VerdictOutcome:
    """Return the verdict if no set reaches the probability that a name needs."""
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
    # an effect with its canonical and with a free shape is one member, and what explains the
    # readings alone needs no further effect beside it
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
    sentence = (
        f"There is a gap that no effect of the catalogue fits. {most_probable.absolute_fit.reason}"
    )
    if group:
        sentence = f"There is a gap, and {len(group)} explanations fit it equally well."
    return case.unexplained(
        sentence,
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
    nearest_clause = ""
    if possible_effects:
        nearest_clause = f"; the nearest are {', '.join(possible_effects[:4])}"
    sentence = (
        "Something may be missing, but it is too small for these data to distinguish from noise"
        f"{noise_clause}{nearest_clause}."
    )
    return case.outcome(
        VerdictKind.BELOW_LIMIT,
        sentence,
        case.no_effect_probability,
        case.leading_fit,
        group=tuple(possible_effects),
        gates=(check_absolute_fit(case.problem, case.leading_fit),),
    )


def _group_verdict(
    case: NoiseCase[HypothesisT], members: Sequence[_Member], probability: float
) -> VerdictOutcome:
    """Return the verdict that one of several sets is missing and the data do not tell which.

    Parameters
    ----------
    case : NoiseCase
        The hypotheses.
    members : sequence of _Member
        The sets of effects that the group consists of.
    probability : float
        The probability that one of them is missing.
    """
    fits = [with_draws(case.problem, member.fit) for member in members]
    effects_by_member = [named_effects(case.problem, fit) for fit in fits]
    names = listing([effects_text(effects) for effects in effects_by_member], "or")
    if len(members) > 1:
        sentence = (
            f"Either {names} is missing (probability {probability_text(probability)}); these "
            "data cannot tell which."
        )
    else:
        sentence = (
            f"There is a gap that {names} fits, but its probability of "
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
