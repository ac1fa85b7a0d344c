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
from reporting.words import listing

from .conclusion import (
    Conclusion,
    VerdictOutcome,
    below_limit_sentence,
    named_effects,
    plain_names,
)
from .consistency_gate import check_consistency

EffectSet = tuple[str, ...]
"""The identifiers of a set of effects."""


class CheckedFit(NamedTuple):
    """A fit with the outcomes of the tests of absolute fit and consistency."""

    fit: CandidateFit
    absolute: Gate
    consistency: Gate


class FittedMember(NamedTuple):
    """A set of effects that may be a member of a group, its fit, and the test of absolute fit."""

    names: EffectSet
    fit: CandidateFit
    absolute: Gate


class Case:
    """A search with all quantities that the rules of a verdict need, and the verdicts themselves.

    Parameters
    ----------
    search : Search
        The search with all candidates.
    probabilities : mapping of tuple of str to float
        The probability of each set of effects, the most probable first.
    leading : tuple of str, optional
        The set that is considered for a name; the most probable one if left out.
    """

    def __init__(
        self,
        search: Search,
        probabilities: Mapping[EffectSet, float],
        leading: EffectSet | None = None,
    ) -> None:
        self.problem = search.problem
        self.search = search
        self.probabilities = probabilities
        self.leading = next(iter(probabilities)) if leading is None else leading
        self.best = search.best()
        if self.leading:
            self.best = search.fit_exactly(search.best_fit_of_set(self.leading))
        self.conclusion = Conclusion.from_probabilities(search, self.best, probabilities)
        self.probability_of_none = probabilities.get((), 0.0)
        self.has_evidence = self.conclusion.log_bayes_factor >= SEARCH.bayes_factor
        self.no_effect_gate = check_absolute_fit(self.problem, search.no_effect)

    # ---------------------------------------------------------------- how probable

    @property
    def has_leading_set(self) -> bool:
        """Whether a set of effects is preferred to the model without effect.

        That is so if the most probable set is not the empty one, and either its Bayes factor is
        large enough or the model without effect fails the test of absolute fit.
        """
        return bool(self.leading) and (self.has_evidence or self.no_effect_gate.passed is False)

    @cached_property
    def probability(self) -> float:
        """The probability that the effects of the leading set are missing in the model.

        It is summed over all sets that contain the leading one, with or without further effects.
        For a law of free shape it includes all effects of its family.
        """
        leading = set(plain_names(self.leading))
        total: float = 0
        for names, probability in self.probabilities.items():
            if leading <= set(plain_names(names)):
                total += probability
        if (
            self.best.candidate.has_free_shape
        ):  # one family is reached from several members or places
            family = self.best.candidate.terms[0].effect.family
            total = max(total, _family_probability(self.search, family))
        return min(total, 1.0)

    @property
    def is_sure(self) -> bool:
        """Whether the leading set is probable enough and has enough evidence to be named."""
        return self.probability >= SEARCH.sure and self.has_evidence

    @cached_property
    def probable_sets(self) -> list[EffectSet]:
        """The most probable sets whose probabilities add up to that which a name needs."""
        return most_probable_sets(self.probabilities)

    # ---------------------------------------------------------------- tests

    @cached_property
    def tested(self) -> CheckedFit:
        """The leading set with the tests of absolute fit and consistency."""
        return CheckedFit(
            self.best,
            check_absolute_fit(self.problem, self.best),
            check_consistency(self.problem, self.best),
        )

    @cached_property
    def _best_free_shape(self) -> CandidateFit | None:
        """The fit of the most evidence in which the shape of one effect of the set is free.

        None if no effect of the set has a shape parameter.
        """
        fits_with_free_shape = []
        for number in range(len(self.best.candidate.terms)):
            free_fit = fit_free_shape(self.problem, self.best, number)
            if free_fit is not None:
                fits_with_free_shape.append(free_fit)
        return max(fits_with_free_shape, key=lambda fit: fit.log_evidence, default=None)

    @cached_property
    def shape_gate(self) -> Gate:
        """The test whether a free shape explains more than the effects as they are."""
        return check_shape(self.best, self._best_free_shape)

    @property
    def family_fit(self) -> CandidateFit | None:
        """The fit with a free shape, if its evidence is enough to name the family instead."""
        return self._best_free_shape if self.shape_gate.statistic > LEAST_SHAPE_GAIN else None

    @property
    def all_gates(self) -> tuple[Gate, ...]:
        """The outcomes of the tests of absolute fit, shape and consistency.

        The test of shape is left out if a shape is free already.
        """
        if self.best.candidate.has_free_shape:
            return self.tested.absolute, self.tested.consistency
        return self.tested.absolute, self.shape_gate, self.tested.consistency

    @property
    def passes(self) -> bool:
        """Whether no test that could be applied fails."""
        return not _any_fails(self.all_gates)

    @cached_property
    def tested_family(self) -> CheckedFit | None:
        """The leading set with one law of free shape, and its tests; None if it may not be named.

        A free shape counts as one more effect, so the set must not have the largest size already.
        A law of free shape together with a second law could fit nearly anything.
        """
        candidate = self.best.candidate
        family_fit = None if candidate.has_free_shape else self.family_fit
        patches = candidate.patches(self.problem.setting, self.best.effect)
        law_count = sum(len(patch.of(*INTERNAL_FORCES)) > 0 for patch in patches)
        if family_fit is None or law_count > 1 or len(patches) == SEARCH.largest_set:
            return None
        return CheckedFit(
            family_fit,
            check_absolute_fit(self.problem, family_fit),
            check_consistency(self.problem, family_fit),
        )

    # ---------------------------------------------------------------- verdicts

    def gap(self) -> VerdictOutcome:
        """Return the verdict that there is a gap which no effect of the catalogue explains."""
        sentence = (
            f"There is a gap that no effect of the catalogue explains. {self.no_effect_gate.reason}"
        )
        probability = self.probabilities[self.leading]
        return self._unexplained(sentence, probability, (self.no_effect_gate,))

    def nothing_missing(self) -> VerdictOutcome:
        """Return the verdict that nothing is missing."""
        if self.no_effect_gate.passed:
            sentence = "The model explains the data within their noise."
        else:
            sentence = (
                "No effect of the catalogue explains the data better than the model does. "
                f"{self.no_effect_gate.reason}"
            )
        return self.conclusion.outcome(
            VerdictKind.NOTHING_MISSING,
            sentence,
            self.probability_of_none,
            gates=(self.no_effect_gate,),
        )

    def common_effects(self) -> VerdictOutcome | None:
        """Return the verdict that names the effects which all probable sets have in common.

        It does not depend on which further effects there are. None is returned if these effects are
        not a probable set themselves, or cannot be named.
        """
        common = set.intersection(*(set(plain_names(names)) for names in self.probable_sets))
        common_set = next((names for names in self.probable_sets if set(names) == common), None)
        if not common_set:
            return None
        case = Case(self.search, self.probabilities, common_set)
        if not case.is_sure:
            return None
        outcome = decide(case)
        return outcome if outcome.verdict.kind is VerdictKind.NAMED else None

    def open(self) -> VerdictOutcome:
        """Return the verdict if no set reaches the probability that a name needs."""
        if () in self.probable_sets:
            return self._below_limit()
        members = []
        for names in self.probable_sets:
            fit = self.search.fit_exactly(self.search.best_fit_of_set(names))
            members.append(FittedMember(names, fit, check_absolute_fit(self.problem, fit)))
        # sets that fail the test are no members, and their probability is not counted
        fitting = [member for member in members if member.absolute.passed is not False]
        probability = sum(self.probabilities[member.names] for member in fitting)
        # an effect with its canonical and with a free shape is one member
        distinct: dict[EffectSet, FittedMember] = {}
        for member in fitting:
            distinct.setdefault(plain_names(member.names), member)
        group = list(distinct.values())
        if not group or len(group) > SEARCH.largest_group:
            return self._no_group(members[0], len(group))
        return self._group(group, probability)

    def _below_limit(self) -> VerdictOutcome:
        """Return the verdict that something may be missing, but is too small to be detected."""
        possible_effects = sorted(
            {name for names in self.probable_sets for name in plain_names(names)}
        )
        return self.conclusion.outcome(
            VerdictKind.BELOW_LIMIT,
            below_limit_sentence(possible_effects),
            sum(self.probabilities[names] for names in self.probable_sets),
            self.best,
            group=tuple(possible_effects),
            gates=(check_absolute_fit(self.problem, self.best),),
        )

    def _no_group(self, first: FittedMember, count: int) -> VerdictOutcome:
        """Return the verdict of a gap if none of the probable sets passes the test, or too many do.

        Parameters
        ----------
        first : FittedMember
            The most probable set.
        count : int
            The number of sets that pass the test of absolute fit.
        """
        sentence = f"There is a gap that no effect of the catalogue fits. {first.absolute.reason}"
        if count:
            sentence = f"There is a gap, and {count} explanations fit it alike."
        return self.conclusion.outcome(
            VerdictKind.UNEXPLAINED,
            sentence,
            sum(self.probabilities[names] for names in self.probable_sets),
            gates=(first.absolute,),
            resembles=plain_names(first.names),
        )

    def _group(self, members: Sequence[FittedMember], probability: float) -> VerdictOutcome:
        """Return the verdict that one of several sets is missing, which cannot be told apart.

        Parameters
        ----------
        members : sequence of FittedMember
            The sets.
        probability : float
            The probability that one of them is missing.
        """
        fits = [with_draws(self.problem, member.fit) for member in members]
        effects: list[NamedEffect] = []
        for fit in fits:
            effects.extend(named_effects(self.problem, fit))
        names = listing((" + ".join(member.names) for member in members), "or")
        if len(members) > 1:
            sentence = f"Either {names} is missing; these data cannot tell which."
        else:
            sentence = (
                f"There is a gap that {names} fits, but not with the probability that a name needs."
            )
        return self.conclusion.outcome(
            VerdictKind.GROUP,
            sentence,
            probability,
            fits[0],
            effects=tuple(effects),
            group=tuple(" + ".join(plain_names(member.names)) for member in members),
            gates=(members[0].absolute,),
        )

    def named(self) -> VerdictOutcome:
        """Return the verdict that names the leading set."""
        fit = with_draws(self.problem, self.best)
        return self.conclusion.named(fit, self.probability, self.all_gates)

    def family(self) -> VerdictOutcome:
        """Return the verdict that names the family of the leading set, with a free shape."""
        if self.tested_family is None:
            tested = self.tested
            gates: tuple[Gate, ...] = (tested.absolute, tested.consistency)
        else:
            tested = self.tested_family
            gates = (tested.absolute, self.shape_gate, tested.consistency)
        return self.conclusion.family(tested.fit, self.probability, gates)

    def unfit(self) -> VerdictOutcome:
        """Return the verdict of an unexplained gap, as the set or its family fails a test."""
        tested = self.tested_family or self.tested
        reason = tested.absolute.reason
        if tested.absolute.passed is not False and tested.consistency.passed is False:
            reason = tested.consistency.reason
        if self.best.candidate.has_free_shape:
            sentence = f"There is a gap that no effect of the catalogue fits. {reason}"
            gates = (tested.absolute, tested.consistency)
            return self._unexplained(sentence, self.probability, gates)
        if self.family_fit is not None and self.tested_family is None:
            reason = (
                "one of them would need a shape of its own, and with so much freedom nearly "
                "anything fits."
            )
        nearest = " with ".join(self.best.candidate.identifiers)
        clause = f"{reason[0].lower()}{reason[1:]}"
        sentence = (
            f"There is a gap that no effect of the catalogue fits; the nearest is {nearest}, but "
            f"{clause}"
        )
        gates_with_shape = (tested.absolute, self.shape_gate, tested.consistency)
        return self._unexplained(sentence, self.probability, gates_with_shape)

    def _unexplained(
        self, sentence: str, probability: float, gates: tuple[Gate, ...]
    ) -> VerdictOutcome:
        """Return the verdict of an unexplained gap, with the leading set as what it resembles."""
        return self.conclusion.outcome(
            VerdictKind.UNEXPLAINED,
            sentence,
            probability,
            gates=gates,
            resembles=plain_names(self.best.candidate.identifiers),
        )


def decide(case: Case) -> VerdictOutcome:
    """Return the verdict by the first rule that holds.

    The rules in words are the `[[rule]]` tables of `sentences.toml`, in the same order.
    """
    if not case.has_leading_set:
        if case.no_effect_gate.passed is False:
            return case.gap()
        if case.leading and case.probability_of_none < SEARCH.unsure:
            return case.open()
        return case.nothing_missing()
    if not case.is_sure:
        return case.common_effects() or case.open()
    if case.passes:
        return case.family() if case.best.candidate.has_free_shape else case.named()
    family = case.tested_family
    if family is None or _any_fails((family.absolute, family.consistency)):
        return case.unfit()
    return case.family()


def _any_fails(gates: Iterable[Gate]) -> bool:
    """Return whether a test fails; a test that could not be made has not failed."""
    return any(gate.passed is False for gate in gates)


def most_probable_sets(probabilities: Mapping[EffectSet, float]) -> list[EffectSet]:
    """Return the most probable sets whose probabilities add up to that which a name needs."""
    cumulative = np.cumsum(list(probabilities.values()))
    return list(probabilities)[: int(np.searchsorted(cumulative, SEARCH.sure)) + 1]


def _family_probability(search: Search, family: str) -> float:
    """Return the probability of a family: that of all its single effects, of any shape."""
    fits = list(search.compared_fits().values())
    scores = np.array([search.score(fit) for fit in fits])
    weights = np.exp(scores - scores.max())
    is_member = []
    for fit in fits:
        terms = fit.candidate.terms
        is_member.append(len(terms) == 1 and terms[0].effect.family == family)
    return float(weights[is_member].sum() / weights.sum())
