"""Hypotheses before a court: which may be named, what speaks against the others.

Where no simulation leaves noise, hypotheses are compared in one of two ways (`comparison`). Each tells the
evidence of a hypothesis, and the share that it is of what is missing, in trials that were fitted and in those
that were not.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import Generic, TypeVar

import numpy as np
from scipy.special import logsumexp
from scipy.stats import chi2

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import Candidate, Key, Term
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.gates import ABSOLUTE_LEVEL
from discrepancy.fits.problem import Problem
from discrepancy.missing_force.shares import Share
from discrepancy.search.hypotheses import acts_within
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from discrepancy.sentences import said
from discrepancy.verdict import Gate

from .conclusion import Hypothetic

COUNTER = -0.1
"""Share below which trials in which a law has hardly any force speak against it all the same."""
H = TypeVar("H", bound=Hypothetic)


class Court(ABC, Generic[H]):
    """Hypotheses that are compared in one way, with the share that each is of what is missing.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    found : Search
        Whose hypotheses they are.

    Attributes
    ----------
    least_end : float
        Lower end of a share that a name needs.
    has_held_out : bool
        Whether there are trials that were not fitted.
    """

    least_end: float
    has_held_out: bool

    def __init__(self, problem: Problem, found: Search) -> None:
        self.problem, self.found = problem, found
        self._shares: dict[tuple[int, bool], tuple[H, Share]] = {}
        self._followed: dict[Key, H | None] = {}

    # ---------------------------------------------------------------- how they are compared

    @property
    @abstractmethod
    def ranked(self) -> Sequence[H]:
        """Hypotheses, the most probable first."""

    @abstractmethod
    def score(self, item: H) -> float:
        """Return ln (evidence times prior) [nat]."""

    @abstractmethod
    def sizes(self, item: H) -> tuple[float, float, float]:
        """Return log evidence [nat], chi^2 of the readings and its degrees of freedom; nan: not known."""

    @abstractmethod
    def gain(self, item: H) -> float:
        """Return the log evidence over no effect at all [nat]."""

    @abstractmethod
    def share_of(self, item: H, *, held_out: bool) -> Share:
        """Return the share that a hypothesis is of what is missing."""

    @abstractmethod
    def followed(self, candidate: Candidate, effect: FloatArray) -> H | None:
        """Return a further hypothesis, begun at values (E,) of its unknowns; None: it cannot be."""

    @abstractmethod
    def freed(self, item: H) -> H | None:
        """Return a single law with a shape of its own, where that was compared."""

    @abstractmethod
    def gate(self, item: H) -> Gate:
        """Return how well the simulation beside a name leaves noise alone."""

    @abstractmethod
    def fitted(self, item: H) -> CandidateFit:
        """Return the simulation that stands for a hypothesis."""

    @abstractmethod
    def left(self, item: H, share: Share) -> str:
        """Return in words what is left beside a hypothesis."""

    def beside(self, item: H) -> str:
        """Return what else speaks against a name; empty: nothing."""
        return ""

    def gap(self) -> str:
        """Return what is seen of what is missing, in one sentence; empty: nothing."""
        return ""

    # ---------------------------------------------------------------- who may be named

    def share(self, item: H, *, held_out: bool) -> Share:
        """Return the share that a hypothesis is of what is missing."""
        key = (id(item), held_out)
        if key not in self._shares:
            self._shares[key] = item, self.share_of(item, held_out=held_out)
        return self._shares[key][1]

    def told(self, item: H) -> Share:
        """Return the share that counts: in trials not fitted, if there are any that can test it."""
        if self.has_held_out:
            outside = self.share(item, held_out=True)
            if outside.tested:
                return outside
        return self.share(item, held_out=False)

    def against(self, item: H) -> str:
        """Return why a hypothesis is no name; empty where nothing speaks against it."""
        if not any(map(self.acts, item.candidate.terms)):
            return said("against.readings")
        if item.candidate.is_family and len(item.candidate.terms) > 1:
            return said("against.free_shape")
        inside = self.share(item, held_out=False)
        if _is_little(inside, self.least_end):
            return said("against.where_fitted", part=part(inside))
        if self.has_held_out and not self._survives(item, self.least_end):
            return said("against.not_fitted", part=part(self.share(item, held_out=True)))
        count = len(item.shared) - len(self.problem.shared.gain_channels)
        proper = self.problem.shared.precision > 0.0
        for what, own in (("calibrated parameters", slice(count)), ("gains", slice(count, None))):
            u = item.shared[own][proper[own]]
            if u.size and chi2.sf(u @ u / SEARCH.widened**2, u.size) < ABSOLUTE_LEVEL:
                return said("against.beside_priors", what=what)
        return self.beside(item)

    def _survives(self, item: H, least: float) -> bool:
        """Whether trials that were not fitted bear a hypothesis out, or have no force by which they could."""
        outside = self.share(item, held_out=True)
        return not _is_little(outside, least) if outside.tested else outside.value > COUNTER

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
            if core is not None and core.candidate.key not in found and not self.against(core):
                found[core.candidate.key] = core, self.score(item)
        best = max((score for _, score in found.values()), default=0.0)
        return [item for item, score in found.values() if score > best - SEARCH.contenders]

    def _core(self, item: H) -> H | None:
        """Return a hypothesis without errors of the readings beside its laws; None without an effect."""
        acts = [self.acts(term) for term in item.candidate.terms]
        if all(acts) or not any(acts):
            return item if acts else None
        return self._with(item, [number for number, within in enumerate(acts) if within])

    def _with(self, item: H, kept: Sequence[int]) -> H | None:
        """Return a hypothesis with some of its effects only."""
        candidate, values = item.candidate.some(kept, item.effect)
        key = candidate.key
        known = next((one for one in self.ranked if one.candidate.key == key), None)
        if known is not None:
            return known
        if key not in self._followed:
            self._followed[key] = self.followed(candidate, values)
        return self._followed[key]

    def slimmed(self, best: H) -> H:
        """Return the simplest hypothesis that is as much of the missing force."""
        own, count = families(best), len(best.candidate.terms)
        singles = [self._with(best, [number]) for number in range(count)] if count > 1 else []
        able = {item.candidate.key: item for item in (*self.ranked, *singles) if item is not None}
        inside, outside = self.share(best, held_out=False).value, self.told(best).value
        simpler = [
            item for item in able.values()
            if item.candidate.terms and _freedom(item) < _freedom(best) and families(item) <= own
            and self.share(item, held_out=False).value > inside - 3.0 * SEARCH.slim
            and self.told(item).value > outside - SEARCH.slim
            and not self.against(item)
        ]  # fmt: skip
        return min(simpler, key=lambda item: (_freedom(item), -self.score(item)), default=best)

    def probability(self, item: H) -> float:
        """Return the probability of a hypothesis with all that hold its effects or their families."""
        kept = [
            one for one in self.ranked if not one.candidate.terms or one is item or not self._refuted(one)
        ]
        scores = np.array([self.score(one) for one in kept])
        holds = np.array([families(item) <= families(one) for one in kept])
        if not holds.any():
            return 0.0
        return float(np.exp(logsumexp(scores[holds]) - logsumexp(scores)))

    def _refuted(self, item: H) -> bool:
        """Whether trials show that a hypothesis is not what is missing."""
        if self.share(item, held_out=False).interval[1] < SEARCH.least_share:
            return True
        return self.has_held_out and not self._survives(item, 0.0)

    def rivals(self, best: H) -> list[H]:
        """Return other names that neither evidence nor trials tell from the best one."""
        own, share = families(best), self.told(best)
        found: list[H] = []
        for item in self.contenders:
            same = names(item) == names(best) or (families(item) == own and item.candidate.is_family)
            if same or names(item) > names(best) or len(item.candidate.terms) > len(best.candidate.terms):
                continue
            close = self.score(item) > self.score(best) - SEARCH.force_rival
            known = any(names(item) == names(other) for other in found)
            if close and not known and not share.told_from(self.told(item)):
                found.append(item)
        return found


def _is_little(share: Share, least: float) -> bool:
    low, high = share.interval
    return high < SEARCH.least_share or low < least


def families(item: Hypothetic) -> set[tuple[str, str]]:
    """Return families and places of the effects of a hypothesis."""
    return {(term.effect.family, term.place) for term in item.candidate.terms}


def names(item: Hypothetic) -> set[tuple[str, str]]:
    """Return effects and places of a hypothesis."""
    return {(term.effect.identifier, term.place) for term in item.candidate.terms}


def _freedom(item: Hypothetic) -> tuple[int, int]:
    return len(item.candidate.terms), sum(term.free_shape for term in item.candidate.terms)


def percent(share: Share) -> str:
    """Return a share with its interval."""
    low, high = share.interval
    return f"{100.0 * share.value:.3g} % ({100.0 * low:.3g} to {100.0 * high:.3g})"


def part(share: Share) -> str:
    """Return a share with its interval, and what it is one of."""
    return f"{percent(share)} of {share.of}"
