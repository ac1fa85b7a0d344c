"""From fitted candidates to a verdict: the first rule that holds decides, and what overrules it."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from discrepancy.catalogue.entry import Effect
from discrepancy.errors import said
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit, attempt, free_shape
from discrepancy.fits.gates import SHAPE_GAIN, absolute_gate, shape_gate
from discrepancy.fits.predictive import residual_set, with_draws
from discrepancy.fits.problem import Problem
from discrepancy.search.starts import Tell, acts_within, in_silence
from discrepancy.search.strategy import Search
from discrepancy.search.whole_search import OnSearch, nobody_looks, search
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate, Verdict, VerdictKind
from fe.runtime.patch import INTERNAL_FORCES, SENSORS, LoadGain, SensorGain
from reporting.words import listing

from .conclusion import (
    LEAST_SIZE,
    Conclusion,
    Outcome,
    below_limit,
    is_one_driven_channel,
    is_small,
    named_effects,
    plain_names,
)
from .consistency_gate import consistency_gate
from .in_part import judged_in_part, nearly_all_by_laws, without_sliver
from .moved_unknowns import moved_sentence, moved_unknowns
from .proof import held_out_gate
from .verdict_checks import checked_verdict

Names = tuple[str, ...]


class Case:
    """A search before the rules.

    Parameters
    ----------
    found : Search
        All candidates.
    probabilities : mapping of tuple of str to float
        Of sets of effects, most probable first.
    top : tuple of str, optional
        The set that may be named; the most probable one if left out.
    """

    def __init__(self, found: Search, probabilities: Mapping[Names, float], top: Names | None = None) -> None:
        self.problem, self.found, self.probabilities = found.problem, found, probabilities
        self.top = next(iter(probabilities)) if top is None else top
        self.best = found.exactly(found.best_of(self.top)) if self.top else found.best()
        self.told = Conclusion.of(found, self.best, probabilities)
        self.p_none = probabilities.get((), 0.0)
        self.has_evidence = self.told.log_bayes_factor >= SEARCH.bayes_factor
        self.none_gate = absolute_gate(self.problem, found.none)

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
        numbers = range(len(self.best.candidate.terms))
        free = (free_shape(self.problem, self.best, number) for number in numbers)
        kept = max((item for item in free if item), key=lambda item: item.log_evidence, default=None)
        outcome = shape_gate(self.best, kept)
        return outcome, kept if outcome.statistic > SHAPE_GAIN else None

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
        return not _any_fails(self.all_gates)

    @cached_property
    def freed(self) -> tuple[CandidateFit, Gate, Gate] | None:
        """The set with one law of free shape, and its gates, where it may be stated so.

        A free shape counts as one more effect, and beside a second law it would imitate nearly anything.
        """
        candidate = self.best.candidate
        family = None if candidate.is_family else self.shape[1]
        patches = candidate.patches(self.problem.setting, self.best.effect)
        laws = sum(len(patch.of(*INTERNAL_FORCES)) > 0 for patch in patches)
        if family is None or laws > 1 or len(patches) == SEARCH.largest_set:
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
        case = Case(self.found, self.probabilities, alone) if alone else None
        if case is None or not case.is_sure:
            return None
        outcome = decided(case)
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
        fit, absolute, consistent = self.freed or (self.best, *self.gates)
        gates = (absolute, consistent) if self.freed is None else (absolute, self.shape[0], consistent)
        return self.told.family(fit, self.probability, gates)

    def unfit(self) -> Outcome:
        """Return that the set, or its family, fails a gate."""
        _, absolute, consistent = self.freed or (self.best, *self.gates)
        fails = absolute.passed is not False and consistent.passed is False
        reason = (consistent if fails else absolute).reason
        if self.best.candidate.is_family:
            sentence = said("verdict.no_effect_fits", reason=reason)
            return self._unexplained(sentence, self.probability, (absolute, consistent))
        if self.shape[1] is not None and self.freed is None:
            reason = said("verdict.needs_shape")
        nearest, reason = " with ".join(self.best.candidate.identifiers), f"{reason[0].lower()}{reason[1:]}"
        sentence = said("verdict.nearest", nearest=nearest, reason=reason)
        return self._unexplained(sentence, self.probability, (absolute, self.shape[0], consistent))

    def _unexplained(self, sentence: str, probability: float, gates: tuple[Gate, ...]) -> Outcome:
        resembles = plain_names(self.best.candidate.identifiers)
        kind = VerdictKind.UNEXPLAINED
        return self.told.outcome(kind, sentence, probability, gates=gates, resembles=resembles)


def decided(case: Case) -> Outcome:
    """Return the verdict of the first rule that holds; in words: `[[rule]]` of `sentences.toml`."""
    if not case.leads:
        if case.none_gate.passed is False:
            return case.gap()
        return case.open() if case.top and case.p_none < SEARCH.unsure else case.nothing()
    if not case.is_sure:
        return case.shared() or case.open()
    if case.passes:
        return case.family() if case.best.candidate.is_family else case.named()
    free = case.freed
    return case.unfit() if free is None or _any_fails(free[1:]) else case.family()


def _any_fails(gates: Iterable[Gate]) -> bool:
    """Whether a gate that could be applied fails."""
    return any(gate.passed is False for gate in gates)


def as_recorded(found: Search) -> Outcome:
    """Return the verdict if what a right model leaves is noise as the records say, and no more."""
    probabilities = found.set_probabilities()
    for _ in range(SEARCH.largest_group):  # those that matter fitted exactly: few steps give rough evidence
        exact = {item.candidate.identifiers for item in found.exact.values()}
        rough = [names for names in members_of(probabilities) if names not in exact]
        if not rough:
            break
        found.exactly(found.best_of(rough[0]))
        probabilities = found.set_probabilities()
    return decided(Case(found, probabilities))


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


INSTRUMENTS = (LoadGain, *SENSORS)


def name(
    problem: Problem,
    effects: Sequence[Effect],
    tell: Tell = in_silence,
    on_search: OnSearch = nobody_looks,
) -> Outcome:
    """Name what is missing.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    effects : sequence of Effect
        The catalogue.
    tell : callable
        Takes a few words on what is fitted, and how much is left.
    on_search : callable
        Takes each search as it begins.

    Returns
    -------
    Outcome
        The verdict without next experiments and data faults, which others add; all candidates; the fit that
        stands for the verdict: of the named set, of the family, of the most probable member of a group or of
        what is too small to tell; else the one without effect.
    """
    verdict, found, fit = checked_verdict(_searched(problem, effects, tell, on_search))
    moved = moved_unknowns(problem, found.none)
    sentence = f"{verdict.sentence} {moved_sentence(moved)}".strip()
    return Outcome(replace(verdict, sentence=sentence, moved=moved), found, fit)


def _searched(problem: Problem, effects: Sequence[Effect], tell: Tell, on_search: OnSearch) -> Outcome:
    """Return the verdict on a search along the missing force, or else on whole simulations."""
    found = search(problem, effects, tell, on_search)
    first = _named(found)
    if not found.forces or first.verdict.kind is not VerdictKind.UNEXPLAINED:
        return first
    tell("nothing follows the missing force: comparing whole simulations")
    again = attempt(problem, Candidate(), found.none.point)  # time steps may be finer by now
    second = Search(problem, found.effects, again or found.none, tell=tell)
    second.force = found.force
    on_search(second)
    second.singles()
    second.sets()
    other = _named(second)
    second.forces = found.forces
    named = other.verdict.kind is VerdictKind.NAMED_IN_PART and any(_acts(problem, other.fit))
    # held-out trials alone give no name: most of the gap is to be closed where it was fitted
    count = float(problem.counts.sum())
    gap = second.none.chi_square - count
    closes = gap > 0.0 and other.fit.chi_square - count < (1.0 - SEARCH.least_share) * gap
    return other if named and closes else first


def _acts(problem: Problem, fit: CandidateFit) -> list[bool]:
    """Return which effects of a fit act on the structure, and are no errors of readings."""
    return [acts_within(term.effect, problem.setting) for term in fit.candidate.terms]


def _named(found: Search) -> Outcome:
    """Return the verdict on a search, by its simulations or else by the missing force."""
    verdict, _, fit = as_recorded(found)
    stands = verdict.kind in (VerdictKind.NAMED, VerdictKind.FAMILY)
    if stands or verdict.kind is VerdictKind.GROUP:
        gate = held_out_gate(residual_set(found.problem, fit, sensitivities=False))
        sentence = f"{verdict.sentence} {gate.reason}" if gate.passed is False else verdict.sentence
        verdict = replace(verdict, sentence=sentence, gates=(*verdict.gates, gate))
        stands = stands and gate.passed is not False
    if verdict.kind in (VerdictKind.NAMED, VerdictKind.GROUP):
        overruled = _overruled(found, verdict)
        if overruled is not None:
            return Outcome(overruled, found, found.none)
    if stands and len(verdict.effects) > 1:
        alone = _without_readings(found, verdict, fit)
        return without_sliver(found, verdict, fit) if alone is None else alone
    failed = {gate.name for gate in verdict.gates if gate.passed is False}
    open_kinds = (VerdictKind.NAMED, VerdictKind.FAMILY, VerdictKind.UNEXPLAINED)
    open_group = verdict.kind is VerdictKind.GROUP and bool(found.forces)
    misfits = bool(failed & {"absolute fit", "held-out trials"})
    if open_group or (not stands and (misfits or verdict.kind in open_kinds)):
        return judged_in_part(found, verdict)
    return Outcome(verdict, found, fit)


def _without_readings(found: Search, verdict: Verdict, fit: CandidateFit) -> Outcome | None:
    """Return the verdict that names laws in part, without an error of readings that was named beside them.

    Where laws are nearly all of the missing force, such an error takes up what is left, whatever it is.
    """
    acts = _acts(found.problem, fit)
    if not found.forces or all(acts) or not any(acts):
        return None
    return nearly_all_by_laws(found, verdict)


def _overruled(found: Search, verdict: Verdict) -> Verdict | None:
    """Return the verdict where errors of instruments that are named are no cause; None where they may be.

    They are none below a size that any instrument has. Nor where they only keep calibrated parameters within
    their priors: with one channel under a recorded drive a gain does what all parameters of a linear model do
    together. Where the model as it is leaves no gap on held-out trials either, nothing but these priors
    speaks for it.
    """
    problem, no_name = found.problem, replace(verdict, effects=(), group=())
    what = " or ".join(dict.fromkeys(effect.name for effect in verdict.effects))
    if all(is_small(problem, effect.patch) for effect in verdict.effects):
        sentence = said("verdict.nuisance", what=what, least=100.0 * LEAST_SIZE)
        return replace(no_name, kind=VerdictKind.NOTHING_MISSING, sentence=sentence)
    parts = [part for effect in verdict.effects for part in effect.patch]
    gains = any(isinstance(part, LoadGain | SensorGain) for part in parts)
    instruments = gains and all(isinstance(part, INSTRUMENTS) for part in parts)
    if not instruments or not is_one_driven_channel(problem) or not problem.campaign.held_out:
        return None
    if held_out_gate(residual_set(problem, found.none, sensitivities=False)).passed is not True:
        return None
    moved = zip(problem.model.parameters, found.none.point.shared, strict=False)
    far = [f"{item.name!r} {abs(u):.1f}" for item, u in moved if abs(u) > SEARCH.stand_in_range]
    told = f" ({', '.join(far)} stated deviations off)" if far else ""
    sentence = said("verdict.parameters_or_instruments", far=told, what=what)
    resembles = tuple(dict.fromkeys(effect.identifier for effect in verdict.effects))
    return replace(no_name, kind=VerdictKind.UNEXPLAINED, sentence=sentence, resembles=resembles)
