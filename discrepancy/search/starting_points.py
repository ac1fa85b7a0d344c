"""Where fits begin: the most promising changes of each effect and of pairs of effects, from a screen."""

from collections.abc import Iterator
from math import inf

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Term
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Change, Screen, rescaled
from discrepancy.search_settings import SEARCH
from fe.runtime.patch import SENSORS, MicroSlip


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
                tried.append(_in_small(screen, change))
            best = sorted([*best, *(item for item in tried if item.size > 0.0)], key=_worth)[:count]
        found.extend(best)
    return sorted(found, key=_worth)[:count]


def _in_small(screen: Screen, change: Change) -> Change:
    try:
        return screen.shrunk(change)[0]
    except DiscrepancyError:
        return change


def acts_within(effect: Effect, setting: Setting) -> bool:
    """Whether an effect acts within the structure or on its loads, not on readings only."""
    term = Term(effect, effect.places(setting)[0])
    try:
        patch = effect.patch(setting, term.values(term.start() + 1.0), term.place)
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
