"""The rules by which a verdict follows from the fitted candidates of a search.

They apply if the residuals of a right model are noise as in the noise records. A verdict *names* a
set of effects if it is probable enough and passes all tests.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from discrepancy.fits.fitting import CandidateFit, fit_free_shape
from discrepancy.fits.gates import LEAST_SHAPE_GAIN, check_absolute_fit, check_shape
from discrepancy.fits.predictive import with_draws
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate, NamedEffect, VerdictKind
from fe.runtime.patch import INTERNAL_FORCES
from reporting.probabilities import total_probability
from reporting.words import listing

from .conclusion import (
    Conclusion,
    VerdictOutcome,
    below_limit_sentence,
    effects_text,
    named_effects,
    names_without_free_shape,
    probability_text,
)
from .consistency_gate import check_consistency

EffectSet = tuple[str, ...]
"""The identifiers of a set of effects."""


class CheckedFit(NamedTuple):
    """A fit with the outcomes of the tests of absolute fit and consistency."""

    fit: CandidateFit
    absolute_fit: Gate
    consistency: Gate


class FittedEffectSet(NamedTuple):
    """A set of effects that may be a member of a group, its fit, and the test of absolute fit."""

    effect_names: EffectSet
    fit: CandidateFit
    absolute_fit: Gate


class VerdictCase:
    """A search with all quantities that the rules of a verdict need, and the verdicts themselves.

    Parameters
    ----------
    search : Search
        The search with all candidates.
    probabilities : mapping of tuple of str to float
        The probability of each set of effects, the most probable first.
    leading_set : tuple of str, optional
        The set that is considered for a name; the most probable one if left out.
    """

    def __init__(
        self,
        search: Search,
        probabilities: Mapping[EffectSet, float],
        leading_set: EffectSet | None = None,
    ) -> None:
        self.problem = search.problem
        self.search = search
        self.probabilities = probabilities
        self.leading_set = next(iter(probabilities)) if leading_set is None else leading_set
        self.leading_fit = search.best()
        if self.leading_set:
            self.leading_fit = search.fit_to_convergence(search.best_fit_of_set(self.leading_set))
        self.conclusion = Conclusion.from_probabilities(search, self.leading_fit, probabilities)
        self.no_effect_probability = probabilities.get((), 0.0)
        self.has_enough_evidence = self.conclusion.log_bayes_factor >= SEARCH.least_log_bayes_factor
        self.no_effect_gate = check_absolute_fit(self.problem, search.no_effect)

    # ---------------------------------------------------------------- how probable

    @property
    def is_better_than_no_effect(self) -> bool:
        """Whether a set of effects is preferred to the model without effect.

        That is so if the most probable set is not the empty one, and either its Bayes factor is
        large enough or the model without effect fails the test of absolute fit.
        """
        return bool(self.leading_set) and (
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
        total_probability: float = 0
        for names, probability in self.probabilities.items():
            if leading_names <= set(names_without_free_shape(names)):
                total_probability += probability
        # the same law of free shape is counted under several effects and at several places
        if self.leading_fit.candidate.has_free_shape:
            family = self.leading_fit.candidate.terms[0].effect.family
            total_probability = max(total_probability, _family_probability(self.search, family))
        return min(total_probability, 1.0)

    @property
    def is_sure_enough_to_name(self) -> bool:
        """Whether the leading set is probable enough and has enough evidence to be named."""
        return self.probability >= SEARCH.name_probability and self.has_enough_evidence

    @cached_property
    def probable_sets(self) -> list[EffectSet]:
        """The most probable sets whose probabilities add up to that which a name needs."""
        return most_probable_sets(self.probabilities)

    # ---------------------------------------------------------------- tests

    @cached_property
    def tested_set(self) -> CheckedFit:
        """The leading set with the tests of absolute fit and consistency."""
        return CheckedFit(
            self.leading_fit,
            check_absolute_fit(self.problem, self.leading_fit),
            check_consistency(self.problem, self.leading_fit),
        )

    @cached_property
    def _best_free_shape(self) -> CandidateFit | None:
        """The fit of the most evidence in which the shape of one effect of the set is free.

        None if no effect of the set has a shape parameter.
        """
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
    def family_fit(self) -> CandidateFit | None:
        """The fit with a free shape, if its evidence is enough to name the family instead."""
        return self._best_free_shape if self.shape_gate.statistic > LEAST_SHAPE_GAIN else None

    @property
    def all_gates(self) -> tuple[Gate, ...]:
        """The outcomes of the tests of absolute fit, shape and consistency.

        The test of shape is left out if a shape is free already.
        """
        if self.leading_fit.candidate.has_free_shape:
            return self.tested_set.absolute_fit, self.tested_set.consistency
        return self.tested_set.absolute_fit, self.shape_gate, self.tested_set.consistency

    @property
    def passes_all_tests(self) -> bool:
        """Whether no test that could be applied fails."""
        return not _any_fails(self.all_gates)

    @cached_property
    def tested_family_set(self) -> CheckedFit | None:
        """The fit and the tests of the leading set with a free shape; None if it may not be named.

        A free shape counts as one more effect, so the set must not have the largest size already.
        A law of free shape together with a second law could fit nearly anything.
        """
        candidate = self.leading_fit.candidate
        family_fit = None if candidate.has_free_shape else self.family_fit
        patches = candidate.patches(self.problem.setting, self.leading_fit.effect)
        law_count = sum(len(patch.of(*INTERNAL_FORCES)) > 0 for patch in patches)
        if family_fit is None or law_count > 1 or len(patches) == SEARCH.largest_set:
            return None
        return CheckedFit(
            family_fit,
            check_absolute_fit(self.problem, family_fit),
            check_consistency(self.problem, family_fit),
        )

    # ---------------------------------------------------------------- verdicts

    def gap_verdict(self) -> VerdictOutcome:
        """Return the verdict that there is a gap which no effect of the catalogue explains."""
        sentence = (
            f"There is a gap that no effect of the catalogue explains. {self.no_effect_gate.reason}"
        )
        probability = self.probabilities[self.leading_set]
        return self._unexplained_verdict(sentence, probability, (self.no_effect_gate,))

    def nothing_missing_verdict(self) -> VerdictOutcome:
        """Return the verdict that nothing is missing."""
        if self.no_effect_gate.passed:
            sentence = "The model explains the data within their noise."
        else:
            sentence = (
                "No effect of the catalogue explains the data better than the model does. "
                f"{self.no_effect_gate.reason}"
            )
        return self.conclusion.build_outcome(
            VerdictKind.NOTHING_MISSING,
            sentence,
            self.no_effect_probability,
            gates=(self.no_effect_gate,),
        )

    def common_effects_verdict(self) -> VerdictOutcome | None:
        """Return the verdict that names the effects which all probable sets have in common.

        Such a verdict is right whichever of the probable sets is the true one. None is returned if
        the sets have no effect in common, if the common effects are not a probable set themselves,
        or if they cannot be named.
        """
        common_names = set.intersection(
            *(set(names_without_free_shape(names)) for names in self.probable_sets)
        )
        if not common_names:
            return None
        # a set in which a shape is free has another name, and is not looked for: its law is no name
        common_set = next(
            (names for names in self.probable_sets if set(names) == common_names), None
        )
        if common_set is None:
            return None
        case = VerdictCase(self.search, self.probabilities, common_set)
        if not case.is_sure_enough_to_name:
            return None
        outcome = decide_verdict(case)
        return outcome if outcome.verdict.kind is VerdictKind.NAMED else None

    def undecided_verdict(self) -> VerdictOutcome:
        """Return the verdict if no set reaches the probability that a name needs."""
        if () in self.probable_sets:
            return self._below_limit_verdict()
        members = []
        for names in self.probable_sets:
            fit = self.search.fit_to_convergence(self.search.best_fit_of_set(names))
            members.append(FittedEffectSet(names, fit, check_absolute_fit(self.problem, fit)))
        # sets that fail the test are not members, and their probability is not counted
        passing_members = [member for member in members if not member.absolute_fit.has_failed]
        probability = total_probability(
            self.probabilities[member.effect_names] for member in passing_members
        )
        # an effect with its canonical and with a free shape is one member, and what explains the
        # readings alone needs no further effect beside it
        distinct_members: dict[EffectSet, FittedEffectSet] = {}
        for member in passing_members:
            distinct_members.setdefault(names_without_free_shape(member.effect_names), member)
        group = []
        for names, member in distinct_members.items():
            if not any(set(other) < set(names) for other in distinct_members):
                group.append(member)
        if not group or len(group) > SEARCH.largest_group:
            return self._no_group_verdict(members[0], len(group))
        return self._group_verdict(group, probability)

    def _below_limit_verdict(self) -> VerdictOutcome:
        """Return the verdict that something may be missing, but is too small to be detected."""
        possible_effects = sorted(
            {name for names in self.probable_sets for name in names_without_free_shape(names)}
        )
        return self.conclusion.build_outcome(
            VerdictKind.BELOW_LIMIT,
            below_limit_sentence(possible_effects),
            self.no_effect_probability,
            self.leading_fit,
            group=tuple(possible_effects),
            gates=(check_absolute_fit(self.problem, self.leading_fit),),
        )

    def _no_group_verdict(
        self, most_probable: FittedEffectSet, passing_count: int
    ) -> VerdictOutcome:
        """Return the verdict of an unexplained gap if no set passes the test, or too many do.

        Parameters
        ----------
        most_probable : FittedEffectSet
            The most probable set.
        passing_count : int
            The number of sets that pass the test of absolute fit.
        """
        reason = most_probable.absolute_fit.reason
        sentence = f"There is a gap that no effect of the catalogue fits. {reason}"
        if passing_count:
            sentence = f"There is a gap, and {passing_count} explanations fit it equally well."
        return self.conclusion.build_outcome(
            VerdictKind.UNEXPLAINED,
            sentence,
            total_probability(self.probabilities[names] for names in self.probable_sets),
            gates=(most_probable.absolute_fit,),
            resembles=names_without_free_shape(most_probable.effect_names),
        )

    def _group_verdict(
        self, members: Sequence[FittedEffectSet], probability: float
    ) -> VerdictOutcome:
        """Return the verdict that one of several sets is missing and the data do not tell which.

        Parameters
        ----------
        members : sequence of FittedEffectSet
            The sets of effects that the group consists of.
        probability : float
            The probability that one of them is missing.
        """
        fits = [with_draws(self.problem, member.fit) for member in members]
        effects: list[NamedEffect] = []
        for fit in fits:
            effects.extend(named_effects(self.problem, fit))
        texts = [effects_text(named_effects(self.problem, fit)) for fit in fits]
        names = listing(texts, "or")
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
        return self.conclusion.build_outcome(
            VerdictKind.GROUP,
            sentence,
            probability,
            fits[0],
            effects=tuple(effects),
            group=tuple(
                " + ".join(names_without_free_shape(member.effect_names)) for member in members
            ),
            gates=(members[0].absolute_fit,),
        )

    def named_verdict(self) -> VerdictOutcome:
        """Return the verdict that names the leading set."""
        fit = with_draws(self.problem, self.leading_fit)
        return self.conclusion.build_named_outcome(fit, self.probability, self.all_gates)

    def family_verdict(self) -> VerdictOutcome:
        """Return the verdict that names the family of the leading set, with a free shape."""
        if self.tested_family_set is None:
            checked_fit = self.tested_set
            gates: tuple[Gate, ...] = (checked_fit.absolute_fit, checked_fit.consistency)
        else:
            checked_fit = self.tested_family_set
            gates = (checked_fit.absolute_fit, self.shape_gate, checked_fit.consistency)
        return self.conclusion.build_family_outcome(checked_fit.fit, self.probability, gates)

    def failed_test_verdict(self) -> VerdictOutcome:
        """Return the verdict of an unexplained gap, as the set or its family fails a test."""
        # the reason of the test that failed: absolute fit, or else consistency
        checked_fit = self.tested_family_set or self.tested_set
        reason = checked_fit.absolute_fit.reason
        if not checked_fit.absolute_fit.has_failed and checked_fit.consistency.has_failed:
            reason = checked_fit.consistency.reason
        # a law of free shape has no nearest effect to mention
        if self.leading_fit.candidate.has_free_shape:
            sentence = f"There is a gap that no effect of the catalogue fits. {reason}"
            gates = (checked_fit.absolute_fit, checked_fit.consistency)
            return self._unexplained_verdict(sentence, self.probability, gates)
        if self.family_fit is not None and self.tested_family_set is None:
            reason = (
                "one of them would need a free shape, and with that much freedom nearly anything "
                "fits."
            )
        nearest_effects = " with ".join(self.leading_fit.candidate.identifiers)
        clause = f"{reason[0].lower()}{reason[1:]}"
        sentence = (
            "There is a gap that no effect of the catalogue fits; the nearest is "
            f"{nearest_effects}, but {clause}"
        )
        gates_with_shape = (checked_fit.absolute_fit, self.shape_gate, checked_fit.consistency)
        return self._unexplained_verdict(sentence, self.probability, gates_with_shape)

    def _unexplained_verdict(
        self, sentence: str, probability: float, gates: tuple[Gate, ...]
    ) -> VerdictOutcome:
        """Return the verdict of an unexplained gap, with the leading set as its resemblance."""
        return self.conclusion.build_outcome(
            VerdictKind.UNEXPLAINED,
            sentence,
            probability,
            gates=gates,
            resembles=names_without_free_shape(self.leading_fit.candidate.identifiers),
        )


def decide_verdict(case: VerdictCase) -> VerdictOutcome:
    """Return the verdict by the first rule that holds.

    The rules in words are the `[[rule]]` tables of `sentences.toml`, in the same order.
    """
    # no set of effects is clearly better than the model as it is
    if not case.is_better_than_no_effect:
        model_fails = case.no_effect_gate.has_failed
        if model_fails:
            return case.gap_verdict()
        is_undecided = case.no_effect_probability < SEARCH.inconclusive_probability
        if case.leading_set and is_undecided:
            return case.undecided_verdict()
        return case.nothing_missing_verdict()
    # several sets explain the readings about equally well
    if not case.is_sure_enough_to_name:
        return case.common_effects_verdict() or case.undecided_verdict()
    # one set is sure: name it, or its family if the shape of its law is free
    if case.passes_all_tests:
        if case.leading_fit.candidate.has_free_shape:
            return case.family_verdict()
        return case.named_verdict()
    # it fails a test as it is: the family remains if it passes
    family = case.tested_family_set
    if family is None or _any_fails((family.absolute_fit, family.consistency)):
        return case.failed_test_verdict()
    return case.family_verdict()


def _any_fails(gates: Iterable[Gate]) -> bool:
    """Return whether a test fails; a test that could not be made has not failed."""
    return any(gate.has_failed for gate in gates)


def most_probable_sets(probabilities: Mapping[EffectSet, float]) -> list[EffectSet]:
    """Return the most probable sets whose probabilities add up to that which a name needs."""
    cumulative_probabilities = np.cumsum(list(probabilities.values()))
    last_set = int(np.searchsorted(cumulative_probabilities, SEARCH.name_probability))
    return list(probabilities)[: last_set + 1]


def _family_probability(search: Search, family: str) -> float:
    """Return the probability that one effect of a family, with any shape, is missing alone."""
    fits = list(search.compared_fits().values())
    scores = np.array([search.score(fit) for fit in fits])
    weights = np.exp(scores - scores.max())
    is_member = []
    for fit in fits:
        terms = fit.candidate.terms
        is_member.append(len(terms) == 1 and terms[0].effect.family == family)
    return float(weights[is_member].sum() / weights.sum())
