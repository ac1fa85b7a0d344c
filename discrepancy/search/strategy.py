"""The search for the set of effects that explains a campaign: screen, fit, add."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import exp

import numpy as np
from scipy.special import logsumexp

from discrepancy.catalogue.entry import Effect
from discrepancy.errors import ModelError
from discrepancy.estimation.refinement import refined
from discrepancy.fits.candidate import Candidate, Key
from discrepancy.fits.fitting import CandidateFit, attempt, free_shape
from discrepancy.fits.gates import SHAPE_GAIN, absolute_gate, solver_share
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Screen
from discrepancy.missing_force.explained import Explained
from discrepancy.missing_force.hypotheses import log_prior, sees_forces
from discrepancy.missing_force.naming import ForceSearch
from discrepancy.search_settings import SEARCH

from .other_optima import canonical_relatives, restarts, sets_at_other_places
from .starts import Starts, Tell, acts_within, beside, each, in_silence, pairs, starts, tried


@dataclass
class Search:
    """All candidates fitted so far, and the way to more of them.

    Attributes
    ----------
    problem : Problem
        Campaign and model.
    effects : tuple of Effect
        Those that can act here.
    none : CandidateFit
        Without effect.
    exact : dict of Key to CandidateFit
        Fitted to convergence.
    rough : dict of Key to CandidateFit
        Fitted by few steps only; their evidence is approximate.
    judged : dict of Key to CandidateFit
        Fitted with their remainders; where there are any, they alone are compared.
    promised : dict of str to float
        The most that a screen at the fit without effect promised of each effect [nat].
    tell : callable
        Takes a few words on what is fitted, and how much is left.
    wide : Problem or None
        That under what the best hypothesis leaves, by which the judged ones were fitted.
    forces : list of Explained
        Sets of effects along the missing force, if they were compared so, the most probable first.
    """

    problem: Problem
    effects: tuple[Effect, ...]
    none: CandidateFit
    exact: dict[Key, CandidateFit] = field(default_factory=dict)
    rough: dict[Key, CandidateFit] = field(default_factory=dict)
    judged: dict[Key, CandidateFit] = field(default_factory=dict)
    promised: dict[str, float] = field(default_factory=dict)
    tell: Tell = in_silence
    wide: Problem | None = None
    forces: list[Explained] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        self.exact[()] = self.none

    def log_prior(self, candidate: Candidate) -> float:
        """Return ln of the prior probability of a candidate at its places."""
        return log_prior(candidate, len(self.effects), self.problem.setting)

    def score(self, found: CandidateFit | Explained) -> float:
        """Return ln (evidence times prior), up to a constant."""
        return found.log_evidence + self.log_prior(found.candidate)

    def all(self) -> dict[Key, CandidateFit]:
        """Return every candidate that is compared, the exact fit where there is one."""
        return self.judged or {**self.rough, **self.exact}

    def best(self) -> CandidateFit:
        """Return the most probable candidate."""
        return max((self.judged or self.exact).values(), key=self.score)

    def best_of(self, identifiers: tuple[str, ...]) -> CandidateFit:
        """Return the most probable fit of a set of effects."""
        options = [item for item in self.all().values() if item.candidate.identifiers == identifiers]
        return max(options, key=self.score)

    def fitted(self) -> frozenset[str]:
        """Return the identifiers of all effects that were fitted, alone or with others."""
        kept = (*self.rough.values(), *self.exact.values(), *self.judged.values())
        return frozenset(term.effect.identifier for item in kept for term in item.candidate.terms)

    @property
    def nothing(self) -> CandidateFit:
        """The fit without effect as it is compared, with its remainder where others have theirs."""
        return self.judged.get((), self.none)

    def set_probabilities(self) -> dict[tuple[str, ...], float]:
        """Return the probability of each set of identifiers, places summed, most probable first."""
        scores: dict[tuple[str, ...], list[float]] = {}
        for found in self.all().values():
            scores.setdefault(found.candidate.identifiers, []).append(self.score(found))
        sums = {identifiers: float(logsumexp(values)) for identifiers, values in scores.items()}
        total = float(logsumexp(list(sums.values())))
        ordered = sorted(sums.items(), key=lambda item: -item[1])
        return {identifiers: min(exp(value - total), 1.0) for identifiers, value in ordered}

    def keep(self, found: CandidateFit, *, exact: bool) -> None:
        """Keep a fit if it is better than what is known of the same candidate."""
        kept = self.exact if exact else self.rough
        key = found.candidate.key
        if key not in kept or kept[key].log_evidence < found.log_evidence:
            kept[key] = found

    @cached_property
    def force(self) -> ForceSearch | None:
        """The missing forces of the trials in motion, where they can be seen."""
        if not sees_forces(self.problem):
            return None
        self.tell("looking for the missing force")
        try:
            return ForceSearch(self.problem)
        except (ModelError, np.linalg.LinAlgError) as cause:
            self.tell(f"the missing force cannot be seen: {cause}")
            return None

    def scan(self, base: CandidateFit, effects: Iterable[Effect]) -> list[CandidateFit]:
        """Fit every effect roughly in addition to those of `base`; return the best of each, best first.

        Fits begin where a screen at the base leads; far from the truth, where phases slip over a record and
        nothing is linear, where the missing force does.
        """
        effects = near = tuple(effects)
        if self._misfits(base):  # what acts on readings only turns no phases
            near = tuple(effect for effect in effects if not acts_within(effect, self.problem.setting))
        found = self._scan_near(base, near)
        explained = any(absolute_gate(self.problem, item).passed for item in found)
        if self._misfits(base) or (self._far(base) and not explained):
            # nuisances of a wrong model are far off, a bad start; beside a force that is free they are
            # where they belong; beside trials at rest, which know no force, they are as before the data
            there = self._unbiased(base)
            within = [one for one in effects if acts_within(one, self.problem.setting)]
            grids = [row for one in within if (row := tried(self.problem, there, one))]
            found += self._best_of(grids, there, 0.0)
        best: dict[tuple[str, ...], CandidateFit] = {}
        for item in sorted(found, key=self.score):
            self.keep(item, exact=False)
            best[item.candidate.identifiers] = item
        return sorted(best.values(), key=lambda item: -self.score(item))

    def _far(self, base: CandidateFit) -> bool:
        """Whether a fit is far from the truth: much is left, or what is shared had to leave its prior."""
        strain = np.abs(base.point.shared[self.problem.shared.precision > 0.0])
        return self._misfits(base) or bool(strain.max(initial=0.0) > SEARCH.strained)

    def _misfits(self, base: CandidateFit) -> bool:
        """Whether much is left by a fit."""
        return base.chi_square > SEARCH.far * float(self.problem.counts.sum())

    def _scan_near(self, base: CandidateFit, effects: Sequence[Effect]) -> list[CandidateFit]:
        """Fit effects from where a screen at a base leads, the most promising first."""
        least = SEARCH.worth_adding if base.candidate.terms else SEARCH.worth_fitting
        screen, rows = Screen(self.problem, base), []
        for effect in each(self.tell, effects, lambda one: f"screening {one.identifier}"):
            changes = starts(screen, effect)
            if not base.candidate.terms:
                self.promised[effect.identifier] = max((change.gain for change in changes), default=0.0)
            rows.append([change for change in changes if change.gain >= least])
        rows.sort(key=lambda row: -max((change.gain for change in row), default=0.0))
        begun = [[beside(base, change.term, change.best) for change in row] for row in rows if row]
        return self._best_of(begun, base, least if base.candidate.terms else 0.0)

    def _unbiased(self, base: CandidateFit) -> CandidateFit:
        """Return a base with its nuisances where they are beside a missing force."""
        point = self.problem.start(base.candidate)
        if self.moves and self.force is not None:
            along = self.force.whole
            if base.candidate.terms:
                along = self.force.followed(along, base.candidate, base.effect) or along
            point = self.force.whole_point(along)
        return replace(base, point=replace(point, effect=base.effect), linearisations=())

    def _best_of(self, starts: Sequence[Starts], base: CandidateFit, worth: float) -> list[CandidateFit]:
        """Fit each effect by few steps from its starts beside a base; return the best of each."""
        found, prospect = [], base.objective - worth
        for row in each(self.tell, starts, lambda row: f"fitting {row[0][0].words}"):
            fits: list[CandidateFit] = []
            for candidate, start in row:
                rough = attempt(
                    self.problem, candidate, start, known=base.linearisations or None,
                    iterations=SEARCH.rough_steps, give_up=prospect,
                )  # fmt: skip
                if rough is not None:  # else it is more than the structure can carry
                    fits.append(rough)
                    prospect = min(prospect, rough.objective + SEARCH.out_of_reach)
            found += [max(fits, key=self.score)] if fits else []
        return found

    def exactly(self, rough: CandidateFit) -> CandidateFit:
        """Fit a candidate to convergence from a rough fit, and keep it."""
        key = rough.candidate.key
        if key in self.judged:
            return self.judged[key]
        found = self.exact.get(key)
        if found is None or found.log_evidence < rough.log_evidence - SEARCH.gained_again:
            again = attempt(self.problem, rough.candidate, rough.point)
            # few steps may have led to where the structure cannot follow
            self.keep(rough if again is None else again, exact=True)
        return self.exact[key]

    def refine(self, rough: Sequence[CandidateFit], floor: float) -> list[CandidateFit]:
        """Fit exactly those that are close to the best of them and above a floor of the score."""
        if not rough:
            return []
        top = self.score(rough[0])
        # far from the truth, few steps rank only roughly
        margin = max(SEARCH.close, SEARCH.close_share * (top - floor))
        chosen = [item for item in rough[: SEARCH.exact_fits] if self.score(item) > max(top - margin, floor)]
        found = []
        for item in each(self.tell, chosen, lambda one: f"fitting {one.candidate.words} to the end"):
            found.append(self.exactly(item))
        return sorted(found, key=lambda item: -self.score(item))

    # ---------------------------------------------------------------- the strategy

    def singles(self) -> None:
        """Search among single effects; the best is computed finely before what rests on its evidence."""
        self.refine(self.scan(self.none, self.effects), self.score(self.none) - SEARCH.hopeless)
        self.settle()

    def sets(self) -> None:
        """Search beyond one effect: a law of free shape, more effects, any two."""
        self.families()
        self.settle()
        # beside a law whose shape is free further effects would be anything
        if not self.best().candidate.is_family:
            self.longer()
        if not self.best().candidate.is_family and self.unexplained():
            self.fit_pairs()
        self.move_effects()
        self.shorter()
        self.settle()

    @property
    def moves(self) -> bool:
        """Whether all trials are in motion."""
        return all(data.trial.is_dynamic for data in self.problem.trials)

    def by_force(self, force: ForceSearch) -> None:
        """Compare the sets of effects that follow the missing force best, in place of what was fitted."""
        self.exact, self.rough = {(): self.none}, {}
        self.forces = refined(force, force.name(self.effects, self.tell), len(self.effects), self.tell)
        able = [
            one for one in self.forces  # beside another law a shape of its own would imitate nearly anything
            if one.candidate.terms and not (one.candidate.is_family and len(one.candidate.terms) > 1)
        ]  # fmt: skip
        close = [one for one in able if self.score(one) > self.score(able[0]) - SEARCH.followed]
        close = close[: SEARCH.far_fits]
        for item in each(self.tell, close, lambda one: f"fitting {one.candidate.words} to the end"):
            found = attempt(self.problem, item.candidate, force.whole_point(item))
            if found is not None:
                self.keep(found, exact=True)
        self.restart_leading_single(force)
        self.move_effects()
        self.shorter()
        self.settle()

    def restart_leading_single(self, force: ForceSearch) -> None:
        """Fit the leading single effect from other sizes, unless one of canonical shape leaves noise alone.

        Dry friction that ends a motion has an optimum for every number of half swings. The missing force
        leads near the right one, the parameters that follow it may be left in the next. With a free shape a
        law bends itself to a wrong optimum, so the laws of that family are tried whose shape is canonical.
        """
        if not self.unexplained() and not self.best().candidate.is_family:
            return
        singles = [fitted for fitted in self.exact.values() if len(fitted.candidate.terms) == 1]
        if not singles:
            return
        (leading,) = max(singles, key=self.score).candidate.terms
        for hypothesis in canonical_relatives(leading, self.forces):
            self.tell(f"fitting {hypothesis.candidate.words} from other sizes")
            for point in restarts(self.problem, hypothesis.candidate, force.whole_point(hypothesis)):
                fitted = attempt(self.problem, hypothesis.candidate, point)
                if fitted is None:
                    continue
                self.keep(fitted, exact=True)
                if absolute_gate(self.problem, fitted).passed:
                    return

    def unexplained(self) -> bool:
        """Whether the best candidate cannot be shown to explain the data."""
        return not absolute_gate(self.problem, self.best()).passed

    def settle(self) -> None:
        """Compute the best candidate finely: halve the time steps while they cost it too much."""
        while (
            self.problem.refinement < SEARCH.finest
            and solver_share(self.problem, self.best()) > SEARCH.solver_share
        ):
            self.problem.refinement *= 2
            ranked = sorted(self.exact.values(), key=lambda item: -self.score(item))
            for item in ranked[: SEARCH.refitted]:
                again = attempt(self.problem, item.candidate, item.point) if item.candidate.terms else None
                if again is not None:  # else the rough one stands
                    self.exact[item.candidate.key] = again

    def longer(self) -> None:
        """Add one effect at a time to the best set while that makes a better one."""
        current = self.best()
        while 0 < len(current.candidate.terms) < SEARCH.largest_set:
            if len(current.candidate.terms) > 1 and self._far(current):
                break  # a third effect is looked for only where two nearly do
            before, there = self.score(current), {term.effect.identifier for term in current.candidate.terms}
            others = [effect for effect in self.effects if effect.identifier not in there]
            fitted = self.refine(self.scan(current, others), before - SEARCH.hopeless_longer)
            if not fitted or self.score(fitted[0]) <= before:
                break
            current = fitted[0]

    def move_effects(self) -> None:
        """Fit the best set with one effect at another of its places, while the set leaves more than noise.

        Rough fits keep one place of each set, and few steps may rank places wrongly.
        """
        best = self.best()
        while len(best.candidate.terms) > 1 and self.unexplained():
            for candidate in sets_at_other_places(best.candidate, self.problem.setting):
                if candidate.key in self.exact:
                    continue
                fitted = attempt(
                    self.problem, candidate, best.point, give_up=best.objective + SEARCH.out_of_reach
                )
                if fitted is not None:
                    self.keep(fitted, exact=True)
            if self.best() is best:
                break
            best = self.best()

    def shorter(self) -> None:
        """Leave one effect at a time out of the best set, while that makes a better one.

        An effect may have come first because the right one stood at another place, or was not followed to
        its place: beside the right one it may say nothing.
        """
        while (count := len((best := self.best()).candidate.terms)) > 1:
            for out in range(count):
                kept = (number for number in range(count) if number != out)
                candidate, effect = best.candidate.some(kept, best.effect)
                begin, worst = replace(best.point, effect=effect), best.objective + SEARCH.out_of_reach
                found = attempt(self.problem, candidate, begin, give_up=worst)
                if found is not None:
                    self.keep(found, exact=True)
            if self.best() is best:
                break

    def families(self) -> None:
        """Fit the free-shape families of single effects that come close, and keep those that fit.

        A law with a shape of its own is a simpler cause than two laws, so it is tried before pairs are. Where
        the best effect fits, families compete only if others fit as well: its own is for the shape gate.
        """
        singles = [item for item in self.exact.values() if len(item.candidate.terms) == 1]
        singles = [item for item in singles if not item.candidate.is_family]
        singles = sorted(singles, key=self.score, reverse=True)[: SEARCH.exact_fits]
        fitting = [item for item in singles if absolute_gate(self.problem, item).passed is not False]
        if fitting and fitting[0] is singles[0]:
            close = self.score(singles[0]) - SEARCH.rivals
            singles = [item for item in fitting if self.score(item) > close]
            if len(singles) == 1 or absolute_gate(self.problem, self.none).passed is not False:
                return
        kept: dict[tuple[str, str], CandidateFit] = {}
        for named in singles:
            family = free_shape(self.problem, named, 0)
            if family is None or family.log_evidence - named.log_evidence <= SHAPE_GAIN:
                continue
            (term,) = family.candidate.terms
            key = (term.effect.family, term.place)  # one verdict; the member from which it is reached best
            better = key not in kept or self.score(kept[key]) < self.score(family)
            if better and absolute_gate(self.problem, family).passed is not False:
                kept[key] = family
        for family in kept.values():
            self.keep(family, exact=True)

    def fit_pairs(self) -> None:
        """Fit the most promising of all pairs of effects, by their changes at the fit without effect."""
        screen = Screen(self.problem, self.none)
        changes = [change for effect in self.effects for change in starts(screen, effect)]
        begun = []
        for _, first, second in pairs(changes, screen.sign)[: SEARCH.pairs_fitted]:
            candidate = Candidate((first.term, second.term))
            if candidate.key not in self.exact:
                start = replace(self.none.point, effect=np.concatenate((first.best, second.best)))
                begun.append([(candidate, start)])
        rough = self._best_of(begun, self.none, 0.0)
        for item in rough:
            self.keep(item, exact=False)
        rough.sort(key=lambda item: -self.score(item))
        self.refine(rough, self.score(self.best()) - SEARCH.close)
