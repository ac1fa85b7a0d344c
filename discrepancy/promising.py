"""Where fits begin: the most promising changes of each effect and of pairs of effects, from a screen."""

from collections.abc import Iterator
from math import inf

import numpy as np
from numpy.typing import NDArray

from .candidate import Term
from .catalogue.entry import Effect
from .screening import Change, Screen, rescaled

FloatArray = NDArray[np.float64]

STARTS, FAR_STARTS = 2, 3
"""Starts of the fit of each effect, close to the truth and far from it."""
FEW_PLACES = 3
"""Effects with more places than this are those of single channels, which are linear in their size."""


def starts(screen: Screen, effect: Effect, count: int = STARTS) -> list[Change]:
    """Return the most promising changes of an effect; more of them where its place is a parameter."""
    if sum(not item.magnitude for item in effect.parameters) > 1:
        count *= 3
    found: list[Change] = []
    places = effect.places(screen.problem.setting)
    for place in places:
        best: list[Change] = []
        for change in screen.changes(Term(effect, place), fine=len(places) <= FEW_PLACES):
            if change.size > 0.0:
                best = sorted([*best, change], key=_worth)[:count]
        found.extend(best)
    return sorted(found, key=_worth)[:count]


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
                    misfit = -0.5 * float(fits @ scale)
                    if best is None or misfit < best[0]:
                        best = (misfit, _scaled(first, scale[0]), _scaled(second, scale[1]))
            if best is not None and best[0] > -inf:
                yield best


def _scaled(change: Change, scale: float) -> Change:
    """Return the change whose best scale alone is the given one."""
    return Change(change.term, change.start, change.vector, scale * change.size, change.size)
