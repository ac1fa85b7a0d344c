"""Starts of fits.

The most promising changes by each effect and by pairs, from a screen or a grid.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import combinations, product
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.special import ndtri

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate, EffectTerm, Point
from discrepancy.fits.fitting import CandidateFit, objective
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Screen, ScreenedChange
from discrepancy.search_settings import SEARCH
from fe.runtime.patch import SENSORS

T = TypeVar("T")
OnProgress = Callable[[str], None]
"""Takes a line that says what the search is doing."""
LARGEST_CONDITION = 1e8
"""Condition number beyond which the changes by two effects are the same one."""


class FitStart(NamedTuple):
    """A candidate and the point from which its fit begins."""

    candidate: Candidate
    point: Point


def no_progress(message: str) -> None:
    """Ignore a line of progress."""


def with_progress(
    on_progress: OnProgress, items: Sequence[T], describe: Callable[[T], str]
) -> Iterator[T]:
    """Yield items, and report for each what is done with it and how many are still to come.

    Parameters
    ----------
    on_progress : callable
        Takes a line of progress.
    items : sequence
        The items.
    describe : callable
        Returns what is done with an item, such as "fitting gain".
    """
    for number, item in enumerate(items):
        remaining = len(items) - number - 1
        on_progress(f"{describe(item)}, {remaining} more")
        yield item


# ---------------------------------------------------------------- effects


def acts_within(effect: Effect, setting: Setting) -> bool:
    """Return whether an effect acts on the structure or its loads, and not only on readings."""
    term = EffectTerm(effect, effect.places(setting)[0])
    try:
        patch = term.patch(setting, term.start() + 1.0)
    except DiscrepancyError:  # only a law within the structure can be too large
        return True
    return not all(isinstance(primitive, SENSORS) for primitive in patch)


def are_related(first: Effect, second: Effect) -> bool:
    """Return whether one of two different effects is easily mistaken for the other."""
    if first.identifier == second.identifier:
        return False
    is_confusable = first.identifier in second.confusable or second.identifier in first.confusable
    return is_confusable or first.family == second.family


# ---------------------------------------------------------------- starts from a screen


def starting_changes(screen: Screen, effect: Effect) -> list[ScreenedChange]:
    """Return the most promising changes by an effect, from which its fits may begin.

    An effect with several parameters that are no magnitudes, such as the place and width of a box,
    gets more starts than others.

    Parameters
    ----------
    screen : Screen
        The fit that the effect is added to.
    effect : Effect
        The effect; all its places are tried.
    """
    setting = screen.problem.setting
    places = effect.places(setting)
    has_few_places = len(places) <= SEARCH.few_places
    others = sum(not parameter.magnitude for parameter in effect.parameters)
    count = SEARCH.starts * 3 if others > 1 else SEARCH.starts
    best_changes: list[ScreenedChange] = []
    for place in places:
        best_of_place: list[ScreenedChange] = []
        for change in screen.changes(EffectTerm(effect, place), fine=has_few_places):
            changes = [change]
            is_nonlinear = change.squared_size > SEARCH.first_order and acts_within(effect, setting)
            if has_few_places and is_nonlinear:
                with suppress(DiscrepancyError):
                    small_change, _ = screen.shrunk(change)
                    changes.append(small_change)
            visible = [change for change in changes if change.squared_size > 0.0]
            best_of_place = sorted([*best_of_place, *visible], key=_cost)[:count]
        best_changes.extend(best_of_place)
    return sorted(best_changes, key=_cost)[:count]


def _cost(change: ScreenedChange) -> float:
    """Return the change of the objective at the best scale.

    Its prior less the gained misfit [nat].
    """
    scaled = change.best
    return -change.gain + 0.5 * float(scaled @ scaled)


class ScreenedPair(NamedTuple):
    """Two changes that explain most together at their scales, and the misfit they add [nat]."""

    misfit: float
    first: ScreenedChange
    second: ScreenedChange


def best_pairs(changes: Sequence[ScreenedChange], sign: FloatArray) -> list[ScreenedPair]:
    """Return the best pair of changes for each pair of different effects, the best first.

    Parameters
    ----------
    changes : sequence of ScreenedChange
        The changes by all effects.
    sign : (D,) array
        The signs of the inner product, `Screen.sign`.
    """
    best: dict[tuple[str, str], ScreenedPair] = {}
    for first, second in combinations(changes, 2):
        key = (first.term.effect.identifier, second.term.effect.identifier)
        cross = float(first.vector * sign @ second.vector)
        gram = np.array([[first.squared_size, cross], [cross, second.squared_size]])
        overlap = np.array([first.overlap, second.overlap])
        if key[0] == key[1] or np.linalg.cond(gram) > LARGEST_CONDITION:
            continue
        scale = np.linalg.solve(gram, overlap)
        can_have_sign = [
            factor >= 0.0 or change.term.may_be_negative
            for factor, change in zip(scale, (first, second), strict=True)
        ]
        misfit = -0.5 * float(overlap @ scale)
        is_better = key not in best or misfit < best[key].misfit
        if all(can_have_sign) and is_better:
            best[key] = ScreenedPair(
                misfit, _with_scale(first, scale[0]), _with_scale(second, scale[1])
            )
    return sorted(best.values(), key=lambda pair: pair.misfit)


def _with_scale(change: ScreenedChange, scale: float) -> ScreenedChange:
    """Return the change as one whose best scale is a given one, so that a fit begins there."""
    return replace(change, overlap=scale * change.squared_size)


def start_beside(base: CandidateFit, term: EffectTerm, values: FloatArray) -> FitStart:
    """Return the start of a fit with one more effect.

    Parameters
    ----------
    base : CandidateFit
        The fit that the effect is added to.
    term : EffectTerm
        The effect at its place.
    values : (E,) array
        Its scaled parameters.
    """
    effect = np.concatenate((base.effect, values))
    return FitStart(base.candidate.with_term(term), replace(base.point, effect=effect))


# ---------------------------------------------------------------- starts from a grid


def grid_starts(problem: Problem, base: CandidateFit, effect: Effect) -> list[FitStart]:
    """Return the points of a grid of an effect's parameters at which the objective is least.

    Far from the truth a screen, which is linear, says little; a grid needs a simulation for each
    point.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    base : CandidateFit
        The fit that the effect is added to.
    effect : Effect
        The effect; all its places are tried.
    """
    valued_starts = []
    for place in effect.places(problem.setting):
        term = EffectTerm(effect, place)
        parameter_count = len(term.parameters)
        level_counts = SEARCH.far_levels
        count = level_counts[min(parameter_count, len(level_counts) - 1)]
        # quantiles of the prior
        levels = ndtri((np.arange(count) + 0.5) / max(count, 1))
        for values in product(levels, repeat=parameter_count):
            start = start_beside(base, term, np.array(values))
            with suppress(DiscrepancyError):  # more than the structure can carry
                value = objective(problem, start.candidate, start.point)
                valued_starts.append((value, start))
    valued_starts.sort(key=lambda valued_start: valued_start[0])
    return [start for _, start in valued_starts[: SEARCH.far_starts]]
