"""Hypotheses before a court: which may be named, what speaks against the others."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Generic

import numpy as np
from scipy.special import logsumexp
from scipy.stats import chi2

from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.gates import ABSOLUTE_LEVEL
from discrepancy.fits.problem import Problem
from discrepancy.missing_force.hypotheses import Key, key_of
from discrepancy.missing_force.shares import Share
from discrepancy.search.starting_points import acts_within
from discrepancy.search_settings import SEARCH

from .comparison import Comparison, H, Hypothetic

COUNTER = -0.1
"""Share below which trials in which a law has hardly any force speak against it all the same."""


@dataclass
class Court(Generic[H]):
    """Hypotheses that are compared in one way, with the share that each is of what is missing."""

    problem: Problem
    way: Comparison[H]

    @cached_property
    def ranked(self) -> Sequence[H]:
        """Hypotheses, the most probable first."""
        return self.way.ranked

    @cached_property
    def _known(self) -> dict[tuple[int, bool], tuple[H, Share]]:
        return {}

    def share(self, item: H, *, held_out: bool) -> Share:
        """Return the share that a hypothesis is of what is missing."""
        key = (id(item), held_out)
        if key not in self._known:
            self._known[key] = item, self.way.share(item, held_out=held_out)
        return self._known[key][1]

    def told(self, item: H) -> Share:
        """Return the share that counts: in trials not fitted, if there are any that can test it."""
        if self.way.has_held_out:
            outside = self.share(item, held_out=True)
            if outside.tested:
                return outside
        return self.share(item, held_out=False)

    # ---------------------------------------------------------------- who may be named

    def against(self, item: H) -> str:
        """Return why a hypothesis is no name; empty where nothing speaks against it."""
        if not any(self.acts(term) for term in item.candidate.terms):
            return "it describes readings, causes nothing and leaves more than noise"
        if item.candidate.is_family and len(item.candidate.terms) > 1:
            return "beside another law a shape of its own imitates nearly anything"
        least = self.way.least_end
        inside = self.share(item, held_out=False)
        if _is_little(inside, least):
            return f"it is {part(inside)} where it was fitted"
        if self.way.has_held_out and not self._survives(item, least):
            return f"it is {part(self.share(item, held_out=True))} in trials that were not fitted"
        names = self.problem.shared.gain_channels
        count = len(item.shared) - len(names)
        proper = self.problem.shared.precision > 0.0
        for what, own in (("calibrated parameters", slice(count)), ("gains", slice(count, None))):
            u = item.shared[own][proper[own]]
            if u.size and chi2.sf(u @ u / SEARCH.widened**2, u.size) < ABSOLUTE_LEVEL:
                return f"it needs {what} far beside their priors: are these what you would bet on?"
        return self.way.against(item)

    def _survives(self, item: H, least: float) -> bool:
        """Whether trials that were not fitted bear a hypothesis out, or have no force by which they could."""
        outside = self.share(item, held_out=True)
        if not outside.tested:
            return outside.value > COUNTER
        return not _is_little(outside, least)

    def acts(self, term: Term) -> bool:
        """Whether a term acts on the structure, and is no description of readings."""
        return acts_within(term.effect, self.problem.setting)

    @cached_property
    def contenders(self) -> list[H]:
        """Hypotheses that data do not exclude and nothing speaks against, most probable first.

        Errors of the readings beside laws take up what is left, whatever it is: they are no part of a name.
        """
        found: dict[Key, tuple[H, float]] = {}
        for item in self.ranked:
            core = self._core(item)
            if core is not None and key_of(core.candidate) not in found and not self.against(core):
                found[key_of(core.candidate)] = core, self.way.score(item)
        best = max((score for _, score in found.values()), default=0.0)
        return [item for item, score in found.values() if score > best - SEARCH.contenders]

    def _core(self, item: H) -> H | None:
        """Return a hypothesis without errors of the readings beside its laws; None without an effect."""
        acts = [self.acts(term) for term in item.candidate.terms]
        if all(acts) or not any(acts):
            return item if acts else None
        parts = item.candidate.parts(item.effect)
        kept = [number for number, within in enumerate(acts) if within]
        candidate = Candidate(tuple(item.candidate.terms[number] for number in kept))
        known = next((one for one in self.ranked if key_of(one.candidate) == key_of(candidate)), None)
        if known is not None:
            return known
        if key_of(candidate) not in self._followed:
            values = np.concatenate([parts[number] for number in kept])
            self._followed[key_of(candidate)] = self.way.followed(candidate, values)
        return self._followed[key_of(candidate)]

    @cached_property
    def _followed(self) -> dict[Key, H | None]:
        return {}

    def slimmed(self, best: H) -> H:
        """Return the simplest hypothesis that is as much of the missing force."""
        own = {_family(term) for term in best.candidate.terms}
        able = {key_of(item.candidate): item for item in (*self.ranked, *self._singles(best))}
        inside, outside = self.share(best, held_out=False).value, self.told(best).value
        simpler = [
            item for item in able.values()
            if item.candidate.terms and _freedom(item) < _freedom(best)
            and {_family(term) for term in item.candidate.terms} <= own
            and self.share(item, held_out=False).value > inside - 3.0 * SEARCH.slim
            and self.told(item).value > outside - SEARCH.slim
            and not self.against(item)
        ]  # fmt: skip
        return min(simpler, key=lambda item: (_freedom(item), -self.way.score(item)), default=best)

    def _singles(self, best: H) -> list[H]:
        """Return the effects of a hypothesis each alone, where there are several."""
        parts, terms = best.candidate.parts(best.effect), best.candidate.terms
        if len(terms) < 2:
            return []
        known = {key_of(item.candidate) for item in self.ranked}
        alone = [(Candidate((term,)), part) for term, part in zip(terms, parts, strict=True)]
        found = [
            self.way.followed(candidate, part) for candidate, part in alone if key_of(candidate) not in known
        ]
        return [item for item in found if item is not None]

    def probability(self, item: H) -> float:
        """Return the probability of a hypothesis with all that hold its effects or their families."""
        own = {_family(term) for term in item.candidate.terms}
        kept = [
            one for one in self.ranked if not one.candidate.terms or one is item or not self._refuted(one)
        ]
        scores = np.array([self.way.score(one) for one in kept])
        holds = np.array([own <= {_family(term) for term in one.candidate.terms} for one in kept])
        if not holds.any():
            return 0.0
        return float(np.exp(logsumexp(scores[holds]) - logsumexp(scores)))

    def _refuted(self, item: H) -> bool:
        """Whether trials show that a hypothesis is not what is missing."""
        if self.share(item, held_out=False).interval[1] < SEARCH.least_share:
            return True
        return self.way.has_held_out and not self._survives(item, 0.0)

    def rivals(self, best: H) -> list[H]:
        """Return other names that neither evidence nor trials tell from the best one."""
        own, share = {_family(term) for term in best.candidate.terms}, self.told(best)
        found: list[H] = []
        for item in self.contenders:
            families = {_family(term) for term in item.candidate.terms}
            same = names(item) == names(best) or (families == own and _is_free(item))
            if same or names(item) > names(best) or len(item.candidate.terms) > len(best.candidate.terms):
                continue
            close = self.way.score(item) > self.way.score(best) - SEARCH.force_rival
            known = any(names(item) == names(other) for other in found)
            if close and not known and not share.told_from(self.told(item)):
                found.append(item)
        return found


def _is_little(share: Share, least: float) -> bool:
    low, high = share.interval
    return high < SEARCH.least_share or low < least


def _family(term: Term) -> tuple[str, str]:
    return term.effect.family, term.place


def names(item: Hypothetic) -> set[tuple[str, str]]:
    """Return effects and places of a hypothesis."""
    return {(term.effect.identifier, term.place) for term in item.candidate.terms}


def _is_free(item: Hypothetic) -> bool:
    return any(term.free_shape for term in item.candidate.terms)


def _freedom(item: Hypothetic) -> tuple[int, int]:
    return len(item.candidate.terms), sum(term.free_shape for term in item.candidate.terms)


def percent(share: Share) -> str:
    """Return a share with its interval."""
    low, high = share.interval
    return f"{100.0 * share.value:.3g} % ({100.0 * low:.3g} to {100.0 * high:.3g})"


def part(share: Share) -> str:
    """Return a share with its interval, and what it is one of."""
    return f"{percent(share)} of {share.of}"
