"""The hypotheses of a search: sets of effects with their fits, prior shares and probabilities.

Fits begin at the most promising changes of each effect and of pairs of effects, from a screen.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from math import exp, inf
from typing import TypeVar

import numpy as np
from scipy.special import logsumexp

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate, Key, Term
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Change, Screen, rescaled
from discrepancy.missing_force.hypotheses import log_prior
from discrepancy.missing_force.naming import Explained
from discrepancy.search_settings import SEARCH
from fe.runtime.patch import SENSORS, MicroSlip

T = TypeVar("T")
Tell = Callable[[str], None]


def in_silence(what: str) -> None:
    """Tell nobody."""


def each(tell: Tell, items: Sequence[T], words: Callable[[T], str]) -> Iterator[T]:
    """Yield items, and tell of each what is done with it and how many are left."""
    for number, item in enumerate(items):
        tell(f"{words(item)}, {len(items) - number - 1} more")
        yield item


@dataclass
class Hypotheses:
    """All candidates fitted so far.

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


def starts(screen: Screen, effect: Effect, count: int = SEARCH.starts) -> list[Change]:
    """Return the most promising changes of an effect; more of them where a box is to be placed."""
    if sum(not item.magnitude for item in effect.parameters) > 1:
        count *= 3
    found: list[Change] = []
    places = effect.places(screen.problem.setting)
    for place in places:
        best: list[Change] = []
        few = len(places) <= SEARCH.few_places
        for change in screen.changes(Term(effect, place), fine=few):
            tried = [change]
            if few and change.size > SEARCH.first_order and acts_within(effect, screen.problem.setting):
                with suppress(DiscrepancyError):
                    tried.append(screen.shrunk(change)[0])
            best = sorted([*best, *(item for item in tried if item.size > 0.0)], key=_worth)[:count]
        found.extend(best)
    return sorted(found, key=_worth)[:count]


def acts_within(effect: Effect, setting: Setting) -> bool:
    """Whether an effect acts within the structure or on its loads, not on readings only."""
    term = Term(effect, effect.places(setting)[0])
    try:
        patch = term.patch(setting, term.start() + 1.0)
    except DiscrepancyError:  # a law that cannot be so large
        return True
    return not all(isinstance(item, SENSORS) for item in patch)


def are_related(one: Effect, other: Effect) -> bool:
    """Whether one of two different effects is easily taken for the other."""
    if one.identifier == other.identifier:
        return False
    named = one.identifier in other.confusable or other.identifier in one.confusable
    return named or one.family == other.family


def _worth(change: Change) -> float:
    """Order of changes: misfit gained, less what the scale costs in the prior."""
    scaled = rescaled(change)
    return -change.gain + 0.5 * float(scaled @ scaled)


def pairs(changes: dict[str, list[Change]], sign: FloatArray) -> Iterator[tuple[float, Change, Change]]:
    """Yield misfit and changes, scaled together, of all pairs of effects."""
    names = list(changes)
    for i, one in enumerate(names):
        for other in names[i + 1 :]:
            best: tuple[float, Change, Change] | None = None
            for first in changes[one]:
                for second in changes[other]:
                    overlap = float(first.vector * sign @ second.vector)
                    gram = np.array([[first.size, overlap], [overlap, second.size]])
                    fits = np.array([first.fits, second.fits])
                    if np.linalg.cond(gram) > 1e8:
                        continue
                    scale = np.linalg.solve(gram, fits)
                    if any(
                        size < 0.0 and not change.may_turn
                        for size, change in zip(scale, (first, second), strict=True)
                    ):
                        continue  # a size that cannot be negative: the other one alone
                    misfit = -0.5 * float(fits @ scale)
                    if best is None or misfit < best[0]:
                        best = (misfit, _scaled(first, scale[0]), _scaled(second, scale[1]))
            if best is not None and best[0] > -inf:
                yield best


def _scaled(change: Change, scale: float) -> Change:
    """Return the change whose best scale alone is the given one."""
    return Change(change.term, change.start, change.vector, scale * change.size, change.size)


def slips(problem: Problem, found: CandidateFit) -> bool:
    """Whether a fit has a joint that slips."""
    patch = found.candidate.patch(problem.setting, found.point.effect) if found.candidate.terms else ()
    return any(isinstance(item, MicroSlip) for item in patch)
