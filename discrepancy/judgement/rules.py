"""The rules of a verdict where a right model leaves the recorded noise: the first that holds decides."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.gates import SHAPE_GAIN, absolute_gate, shape_gate
from discrepancy.fits.other_optima import free_shape
from discrepancy.fits.posterior import with_draws
from discrepancy.fits.problem import Problem
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from discrepancy.sentences import said
from discrepancy.verdict import Gate, VerdictKind
from fe.runtime.patch import INTERNAL_FORCES
from reporting.words import listing

from .conclusion import (
    Conclusion,
    Outcome,
    below_limit,
    named_effects,
    plain_names,
)
from .consistency_gate import consistency_gate

Names = tuple[str, ...]


class Case:
    """A search before the rules.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    found : Search
        All candidates.
    probabilities : mapping of tuple of str to float
        Of sets of effects, most probable first.
    top : tuple of str, optional
        The set that may be named; the most probable one if left out.
    """

    def __init__(
        self, problem: Problem, found: Search, probabilities: Mapping[Names, float], top: Names | None = None
    ) -> None:
        self.problem, self.found, self.probabilities = problem, found, probabilities
        self.top = next(iter(probabilities)) if top is None else top
        self.best = found.exactly(found.best_of(self.top)) if self.top else found.best()
        self.told = Conclusion.of(found, self.best, probabilities)
        self.p_none = probabilities.get((), 0.0)
        self.has_evidence = self.told.log_bayes_factor >= SEARCH.bayes_factor
        self.none_gate = absolute_gate(problem, found.none)

    # ---------------------------------------------------------------- how probable

    @property
    def leads(self) -> bool:
        """Whether a set of effects is before nothing missing."""
        return bool(self.top) and (self.has_evidence or self.none_gate.passed is False)

    @cached_property
    def probability(self) -> float:
        """Of the set with all that hold it (a further effect is open then), of a family with its members."""
        own = set(plain_names(self.top))
        total = sum(p for names, p in self.probabilities.items() if own <= set(plain_names(names)))
        if self.best.candidate.is_family:  # reached from several members or places, it is one family
            total = max(total, _family_probability(self.found, self.best.candidate.terms[0].effect.family))
        return min(total, 1.0)

    @property
    def is_sure(self) -> bool:
        """Whether the set has the probability and the evidence of a name."""
        return self.probability >= SEARCH.sure and self.has_evidence

    @cached_property
    def members(self) -> list[Names]:
        """The most probable sets that together reach the probability of a name."""
        return members_of(self.probabilities)

    # ---------------------------------------------------------------- gates

    @cached_property
    def gates(self) -> tuple[Gate, Gate]:
        """Absolute fit and consistency of the set."""
        return absolute_gate(self.problem, self.best), consistency_gate(self.problem, self.best)

    @cached_property
    def shape(self) -> tuple[Gate, CandidateFit | None]:
        """The gate of shape, and the fit with the shape free that gains most, where that gains too much."""
        outcome, kept = shape_gate(self.best, None), None
        for number in range(len(self.best.candidate.terms)):
            family = free_shape(self.problem, self.best, number)
            if family is not None:
                gate = shape_gate(self.best, family)
                if kept is None or gate.statistic > outcome.statistic:
                    outcome, kept = gate, family
        return outcome, kept if kept is not None and outcome.statistic > SHAPE_GAIN else None

    @property
    def all_gates(self) -> tuple[Gate, ...]:
        """Absolute fit, shape and consistency; of a family no shape."""
        absolute, consistent = self.gates
        if self.best.candidate.is_family:
            return self.gates
        return absolute, self.shape[0], consistent

    @property
    def passes(self) -> bool:
        """Whether no gate that could be applied fails."""
        return all(gate.passed is not False for gate in self.all_gates)

    @property
    def needs_shape(self) -> bool:
        """Whether the set would need a shape of its own."""
        return not self.best.candidate.is_family and self.shape[1] is not None and not self.shape[0].passed

    @property
    def may_be_free(self) -> bool:
        """Whether the set may be stated with one law of free shape.

        A free shape counts as one more effect, and beside a second law it would imitate nearly anything.
        """
        candidate, setting = self.best.candidate, self.problem.setting
        parts = zip(candidate.terms, candidate.parts(self.best.effect), strict=True)
        patches = [Candidate((term,)).patch(setting, part) for term, part in parts]
        laws = sum(len(patch.of(*INTERNAL_FORCES)) > 0 for patch in patches)
        return laws < 2 and len(candidate.terms) < SEARCH.largest_set

    @cached_property
    def freed(self) -> tuple[CandidateFit, Gate, Gate] | None:
        """The set with its shape free, and its gates, where it may be stated so."""
        family = self.shape[1] if self.needs_shape and self.may_be_free else None
        if family is None:
            return None
        return family, absolute_gate(self.problem, family), consistency_gate(self.problem, family)

    # ---------------------------------------------------------------- what is said

    def gap(self) -> Outcome:
        """Return that there is a gap that no effect of the catalogue explains."""
        sentence, gates = said("verdict.no_effect_explains", gate=self.none_gate), (self.none_gate,)
        return self._unexplained(sentence, self.probabilities[self.top], gates)

    def nothing(self) -> Outcome:
        """Return that nothing is missing."""
        key = "nothing_missing" if self.none_gate.passed else "nothing_better"
        sentence = said(f"verdict.{key}", gate=self.none_gate)
        return self.told.outcome(VerdictKind.NOTHING_MISSING, sentence, self.p_none, gates=(self.none_gate,))

    def shared(self) -> Outcome | None:
        """Return the name of what all probable sets hold, if that fits alone: else a group is open.

        Which further effect it has beside it stays open, and a name does not depend on that.
        """
        common = set.intersection(*(set(plain_names(names)) for names in self.members))
        alone = next((names for names in self.members if set(names) == common), None)
        case = Case(self.problem, self.found, self.probabilities, alone) if alone else None
        if case is None or not case.is_sure:
            return None
        outcome = decided(case, SURE)
        return outcome if outcome.verdict.kind is VerdictKind.NAMED else None

    def open(self) -> Outcome:
        """Return the verdict where no set reaches the probability that a name needs."""
        if () in self.members:
            hints = sorted({name for names in self.members for name in plain_names(names)})
            total = sum(self.probabilities[names] for names in self.members)
            more: dict[str, Any] = {"group": tuple(hints), "gates": (absolute_gate(self.problem, self.best),)}
            return self.told.outcome(VerdictKind.BELOW_LIMIT, below_limit(hints), total, self.best, **more)
        fits = [self.found.exactly(self.found.best_of(names)) for names in self.members]
        gates = [absolute_gate(self.problem, item) for item in fits]
        # those that do not fit take their probability with them; a law and its family are one
        fitting = [row for row in zip(self.members, fits, gates, strict=True) if row[2].passed is not False]
        together = sum(self.probabilities[names] for names, _, _ in fitting)
        single: dict[Names, tuple[Names, CandidateFit, Gate]] = {}
        for row in fitting:
            single.setdefault(plain_names(row[0]), row)
        rows = list(single.values())
        if not rows or len(rows) > SEARCH.largest_group:
            sentence = said("verdict.no_effect_fits", reason=gates[0].reason)
            if rows:
                sentence = said("verdict.alike", count=len(rows))
            total = sum(self.probabilities[names] for names in self.members)
            more = {"gates": (gates[0],), "resembles": plain_names(self.members[0])}
            return self.told.outcome(VerdictKind.UNEXPLAINED, sentence, total, **more)
        drawn = [with_draws(self.problem, item) for _, item, _ in rows]
        labels = listing((" + ".join(names) for names, _, _ in rows), "or")
        more = {
            "effects": tuple(effect for item in drawn for effect in named_effects(self.problem, item)),
            "group": tuple(" + ".join(plain_names(names)) for names, _, _ in rows), "gates": (rows[0][2],),
        }  # fmt: skip
        sentence = said("verdict.either" if len(rows) > 1 else "verdict.not_probable", members=labels)
        return self.told.outcome(VerdictKind.GROUP, sentence, together, drawn[0], **more)

    def named(self) -> Outcome:
        """Return the name."""
        return self.told.named(with_draws(self.problem, self.best), self.probability, self.all_gates)

    def family(self) -> Outcome:
        """Return the family of the set, or of the set with its shape free."""
        if self.freed is None:
            return self.told.family(self.best, self.probability, self.gates)
        fit, absolute, consistent = self.freed
        return self.told.family(fit, self.probability, (absolute, self.shape[0], consistent))

    def unfit(self) -> Outcome:
        """Return that the set, or its family, fails a gate."""
        absolute, consistent = self.gates if self.freed is None else self.freed[1:]
        fails = absolute.passed is not False and consistent.passed is False
        reason = (consistent if fails else absolute).reason
        if self.best.candidate.is_family:
            sentence = said("verdict.no_effect_fits", reason=reason)
            return self._unexplained(sentence, self.probability, (absolute, consistent))
        if self.needs_shape and self.freed is None:
            reason = said("verdict.needs_shape")
        nearest, reason = " with ".join(self.best.candidate.identifiers), f"{reason[0].lower()}{reason[1:]}"
        sentence = said("verdict.nearest", nearest=nearest, reason=reason)
        return self._unexplained(sentence, self.probability, (absolute, self.shape[0], consistent))

    def _unexplained(self, sentence: str, probability: float, gates: tuple[Gate, ...]) -> Outcome:
        resembles = plain_names(self.best.candidate.identifiers)
        kind = VerdictKind.UNEXPLAINED
        return self.told.outcome(kind, sentence, probability, gates=gates, resembles=resembles)


@dataclass(frozen=True)
class Rule:
    """When a verdict is reached, in words and as a question, and what makes it; None: the next decides."""

    kind: str
    when: str
    holds: Callable[[Case], bool]
    makes: Callable[[Case], Outcome | None]


UNSURE = (
    Rule(
        "unexplained", "No effect has the evidence of a name, and the model leaves more than its noise.",
        lambda case: not case.leads and case.none_gate.passed is False, Case.gap,
    ),
    Rule(
        "below detectability, or a group", "Nor has any, but that nothing is missing is improbable.",
        lambda case: not case.leads and bool(case.top) and case.p_none < SEARCH.unsure, Case.open,
    ),
    Rule(
        "nothing missing", "No effect has the evidence of a name.",
        lambda case: not case.leads, Case.nothing,
    ),
    Rule(
        "named", "No set has the probability of a name, but what all probable ones hold has, alone too.",
        lambda case: not case.is_sure, Case.shared,
    ),
    Rule(
        "group, below detectability, or unexplained",
        "No set has the probability of a name: those that fit are the group; with nothing missing among them "
        "it is too small to tell, with none or too many of them it is unexplained.",
        lambda case: not case.is_sure, Case.open,
    ),
)  # fmt: skip
"""Rules where no set of effects has the probability and evidence of a name."""
SURE = (
    Rule(
        "family", "A law with a shape of its own has them, and passes absolute fit and consistency.",
        lambda case: case.best.candidate.is_family and case.passes, Case.family,
    ),
    Rule("named", "A set of effects has them, and passes every gate.", lambda case: case.passes, Case.named),
    Rule(
        "family", "It fails by its shape alone: with that free, it passes absolute fit and consistency.",
        lambda case: case.freed is not None and all(gate.passed is not False for gate in case.freed[1:]),
        Case.family,
    ),
    Rule("unexplained", "It fails a gate.", lambda case: True, Case.unfit),
)  # fmt: skip
"""Rules where one has."""


def decided(case: Case, rules: Sequence[Rule] = (*UNSURE, *SURE)) -> Outcome:
    """Return the verdict of the first rule that holds."""
    made = (rule.makes(case) for rule in rules if rule.holds(case))
    return next(outcome for outcome in made if outcome is not None)


def as_recorded(problem: Problem, found: Search) -> Outcome:
    """Return the verdict if what a right model leaves is noise as the records say, and no more."""
    probabilities = found.set_probabilities()
    for _ in range(SEARCH.largest_group):  # those that matter fitted exactly: few steps give rough evidence
        exact = {item.candidate.identifiers for item in found.exact.values()}
        rough = [names for names in members_of(probabilities) if names not in exact]
        if not rough:
            break
        found.exactly(found.best_of(rough[0]))
        probabilities = found.set_probabilities()
    return decided(Case(problem, found, probabilities))


def members_of(probabilities: Mapping[Names, float]) -> list[Names]:
    """Return the most probable sets that together reach the probability of a name."""
    sums = np.cumsum(list(probabilities.values()))
    return list(probabilities)[: int(np.searchsorted(sums, SEARCH.sure)) + 1]


def _family_probability(found: Search, family: str) -> float:
    """Return the probability of a family: of all single effects of it, named or of free shape."""
    kept = [(item.candidate.terms, found.score(item)) for item in found.all().values()]
    weights = np.exp(np.array([score for _, score in kept]) - max(score for _, score in kept))
    members = [len(terms) == 1 and terms[0].effect.family == family for terms, _ in kept]
    return float(weights[members].sum() / weights.sum())
