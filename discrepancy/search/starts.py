"""Where fits begin: the most promising changes of each effect and of pairs, from a screen or a grid."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import combinations, product
from typing import TypeVar

import numpy as np
from scipy.special import ndtri

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate, Point, Term
from discrepancy.fits.fitting import CandidateFit, objective
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Change, Screen
from discrepancy.search_settings import SEARCH
from fe.runtime.patch import SENSORS

T = TypeVar("T")
Tell = Callable[[str], None]
Start = tuple[Candidate, Point]
Starts = list[Start]


def in_silence(what: str) -> None:
    """Tell nobody."""


def each(tell: Tell, items: Sequence[T], words: Callable[[T], str]) -> Iterator[T]:
    """Yield items, and tell of each what is done with it and how many are left."""
    for number, item in enumerate(items):
        tell(f"{words(item)}, {len(items) - number - 1} more")
        yield item


def starts(screen: Screen, effect: Effect) -> list[Change]:
    """Return the most promising changes of an effect; more of them where a box is to be placed."""
    count = SEARCH.starts * (3 if sum(not item.magnitude for item in effect.parameters) > 1 else 1)
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
    scaled = change.best
    return -change.gain + 0.5 * float(scaled @ scaled)


def pairs(changes: Sequence[Change], sign: FloatArray) -> list[tuple[float, Change, Change]]:
    """Return misfit and changes, scaled together, of all pairs of effects, the best first."""
    best: dict[tuple[str, str], tuple[float, Change, Change]] = {}
    for one, other in combinations(changes, 2):
        key = (one.term.effect.identifier, other.term.effect.identifier)
        overlap = float(one.vector * sign @ other.vector)
        gram, fits = np.array([[one.size, overlap], [overlap, other.size]]), np.array([one.fits, other.fits])
        if key[0] == key[1] or np.linalg.cond(gram) > 1e8:
            continue
        scale = np.linalg.solve(gram, fits)
        # a size that cannot be negative: the other one alone
        able = [size >= 0.0 or item.term.may_turn for size, item in zip(scale, (one, other), strict=True)]
        misfit = -0.5 * float(fits @ scale)
        if all(able) and (key not in best or misfit < best[key][0]):
            best[key] = (misfit, _scaled(one, scale[0]), _scaled(other, scale[1]))
    return sorted(best.values(), key=lambda row: row[0])


def _scaled(change: Change, scale: float) -> Change:
    """Return the change whose best scale alone is the given one."""
    return Change(change.term, change.start, change.vector, scale * change.size, change.size)


def beside(base: CandidateFit, term: Term, values: FloatArray) -> Start:
    """Return a base with one more effect, and where a fit of it begins."""
    effect = np.concatenate((base.effect, values))
    return base.candidate.plus(term), replace(base.point, effect=effect)


def tried(problem: Problem, base: CandidateFit, effect: Effect) -> Starts:
    """Return the most promising points of a grid of an effect's parameters, beside a base."""
    found = []
    for place in effect.places(problem.setting):
        term = Term(effect, place)
        known, size = SEARCH.far_levels, len(term.parameters)
        count = known[min(size, len(known) - 1)]
        levels = ndtri((np.arange(count) + 0.5) / max(count, 1))
        for values in product(levels, repeat=size):
            candidate, start = beside(base, term, np.array(values))
            with suppress(DiscrepancyError):  # more than the structure can carry
                found.append((objective(problem, candidate, start), candidate, start))
    found.sort(key=lambda row: row[0])
    return [row[1:] for row in found[: SEARCH.far_starts]]
