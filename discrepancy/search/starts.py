"""Points from which fits of effects begin.

They come from a screen, which predicts to first order how much each effect or pair of effects
reduces the misfit, or from a grid of parameters at which the objective is computed.
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
from discrepancy.fits.fitting import CandidateFit, fit, objective, try_fit
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Screen, ScreenedChange
from discrepancy.search_settings import SEARCH
from fe.runtime.patch import READ_PLACES, SENSORS, STRUCTURE, RegionStiffnessLoss

T = TypeVar("T")
OnProgress = Callable[[str], None]
"""A function to which progress is reported, as a line of text."""
LARGEST_CONDITION = 1e8
"""Condition number of the Gram matrix above which the changes by two effects are parallel."""


class FitStart(NamedTuple):
    """A candidate and the point from which its fit begins."""

    candidate: Candidate
    point: Point


def ignore_progress(message: str) -> None:
    """Ignore a line of progress."""


def report_each(
    on_progress: OnProgress, items: Sequence[T], describe: Callable[[T], str]
) -> Iterator[T]:
    """Yield items; before each one, report how it is processed and how many items follow.

    Parameters
    ----------
    describe : callable
        Returns a phrase on how an item is processed, such as "fitting gain".
    """
    for index, item in enumerate(items):
        remaining_count = len(items) - index - 1
        on_progress(f"{describe(item)}, {remaining_count} more")
        yield item


# ---------------------------------------------------------------- effects


def changes_structure(effect: Effect, setting: Setting) -> bool:
    """Return whether an effect changes the structure or its loads, and not only the readings.

    An error of a sensor, such as a gain, changes only the readings.
    """
    term = EffectTerm(effect, effect.places(setting)[0])
    try:
        patch = term.patch(setting, term.start_values() + 1.0)
    except DiscrepancyError:  # only a change of the structure can be too large for the model
        return True
    return not all(isinstance(primitive, (*SENSORS, *READ_PLACES)) for primitive in patch)


def moves_frequencies(effect: Effect, setting: Setting) -> bool:
    """Return whether an effect changes mass or linear stiffness, so that phases drift."""
    places = effect.places(setting)
    if not places:
        return False
    term = EffectTerm(effect, places[0])
    with suppress(DiscrepancyError):
        patch = term.patch(setting, term.start_values())
        return any(isinstance(item, (*STRUCTURE, RegionStiffnessLoss)) for item in patch)
    return False


def free_places(effect: Effect, candidate: Candidate, setting: Setting) -> tuple[str, ...]:
    """Return the places of an effect that a set of effects leaves free for it."""
    taken_places = {
        term.place for term in candidate.terms if term.effect.identifier == effect.identifier
    }
    return tuple(place for place in effect.places(setting) if place not in taken_places)


def are_related(effect: Effect, other_effect: Effect) -> bool:
    """Return whether one of two different effects is easily mistaken for the other."""
    if effect.identifier == other_effect.identifier:
        return False
    is_confusable = (
        effect.identifier in other_effect.confusable or other_effect.identifier in effect.confusable
    )
    return is_confusable or effect.family == other_effect.family


# ---------------------------------------------------------------- starts from a screen


def best_changes_by_effect(screen: Screen, effect: Effect) -> list[ScreenedChange]:
    """Return the changes of the prediction from which the fits of an effect should begin.

    All places and a grid of parameters are tried, and those with the least expected objective are
    kept: `SEARCH.starts_near_data` of them, or three times as many if more than one parameter
    besides the magnitude is varied, such as the place and width of a box.

    Parameters
    ----------
    screen : Screen
        The fit that the effect is added to.
    effect : Effect
        The effect; all its places are tried where the fit does not have it.
    """
    setting = screen.problem.setting
    places = free_places(effect, screen.fit.candidate, setting)
    has_few_places = len(places) <= SEARCH.few_places
    shifts_phases = moves_frequencies(effect, setting)
    varied_parameter_count = sum(
        not parameter.magnitude and parameter.levels != 1 for parameter in effect.parameters
    )
    start_count = SEARCH.starts_near_data
    if varied_parameter_count > 1:
        start_count *= 3
    best_changes: list[ScreenedChange] = []
    for place in places:
        best_of_place: list[ScreenedChange] = []
        for change in screen.changes_on_grid(
            EffectTerm(effect, place), with_small_magnitude=has_few_places
        ):
            tried_changes = [change]
            is_nonlinear = change.squared_length > SEARCH.first_order_change and changes_structure(
                effect, setting
            )
            # a large change that is not linear in its magnitude is tried at a small one too
            if is_nonlinear and (has_few_places or shifts_phases):
                with suppress(DiscrepancyError):
                    small_change, _ = screen.shrink_change(change)
                    tried_changes.append(small_change)
            nonzero_changes = [
                tried_change for tried_change in tried_changes if tried_change.squared_length > 0.0
            ]
            best_of_place = sorted(
                [*best_of_place, *nonzero_changes], key=_expected_objective_change
            )[:start_count]
        best_changes.extend(best_of_place)
    return sorted(best_changes, key=_expected_objective_change)[:start_count]


def _expected_objective_change(change: ScreenedChange) -> float:
    """Return how a change of the prediction, at its best scale, should change the objective [nat].

    It is the negative log prior of the parameters minus the decrease of the misfit.
    """
    scaled_parameters = change.best_values
    return -change.gain + 0.5 * float(scaled_parameters @ scaled_parameters)


class ScreenedPair(NamedTuple):
    """Changes by two effects, scaled such that both together reduce the misfit most.

    Attributes
    ----------
    misfit_change : float
        The change of the misfit by both together, negative for a decrease [nat].
    first, second : ScreenedChange
        The two changes with their best scales.
    """

    misfit_change: float
    first: ScreenedChange
    second: ScreenedChange


def best_pairs(
    changes: Sequence[ScreenedChange], inner_product_signs: FloatArray
) -> list[ScreenedPair]:
    """Return the best pair of changes for each pair of effects, the best first.

    The two effects are different, or one effect at two places if it may act at both at once. Pairs
    are left out if their changes are parallel, or if an effect would need a sign that it cannot
    have.

    Parameters
    ----------
    inner_product_signs : (D,) array
        The signs of the entries in the inner product of two changes, see
        `Screen.inner_product_signs`.
    """
    best_by_effects: dict[tuple[str, str], ScreenedPair] = {}
    for first_change, second_change in combinations(changes, 2):
        effect_names = (first_change.term.effect.identifier, second_change.term.effect.identifier)
        inner_product = float(first_change.vector * inner_product_signs @ second_change.vector)
        gram = np.array(
            [
                [first_change.squared_length, inner_product],
                [inner_product, second_change.squared_length],
            ]
        )
        overlap = np.array([first_change.overlap, second_change.overlap])
        is_one_effect_twice = effect_names[0] == effect_names[1] and (
            not first_change.term.effect.at_several_places
            or first_change.term.place == second_change.term.place
        )
        # no pair: the same effect twice, or two effects of parallel changes
        if is_one_effect_twice or np.linalg.cond(gram) > LARGEST_CONDITION:
            continue
        # least misfit F(s) = F(0) - b^T s + s^T G s / 2: s = G^-1 b, F(s) - F(0) = -b^T s / 2
        best_scales = np.linalg.solve(gram, overlap)
        has_possible_sign = [
            factor >= 0.0 or change.term.may_be_negative
            for factor, change in zip(best_scales, (first_change, second_change), strict=True)
        ]
        misfit_change = -0.5 * float(overlap @ best_scales)
        is_best_of_effects = (
            effect_names not in best_by_effects
            or misfit_change < best_by_effects[effect_names].misfit_change
        )
        if all(has_possible_sign) and is_best_of_effects:
            best_by_effects[effect_names] = ScreenedPair(
                misfit_change,
                _with_scale(first_change, best_scales[0]),
                _with_scale(second_change, best_scales[1]),
            )
    return sorted(best_by_effects.values(), key=lambda pair: pair.misfit_change)


def _with_scale(change: ScreenedChange, scale: float) -> ScreenedChange:
    """Return a change whose best scale is the given one, so that a fit begins there."""
    # the best scale of a change is its overlap over its squared length
    return replace(change, overlap=scale * change.squared_length)


def start_with_added_effect(base: CandidateFit, term: EffectTerm, values: FloatArray) -> FitStart:
    """Return the start of a fit with one more effect than a base has.

    Parameters
    ----------
    base : CandidateFit
        The fit that the effect is added to.
    values : (E,) array
        The E parameters of the effect, on the scale on which their priors are standard normal.
    """
    effect = np.concatenate((base.effect, values))
    return FitStart(base.candidate.with_term(term), replace(base.point, effect=effect))


# ---------------------------------------------------------------- starts from a grid


def grid_starts(problem: Problem, base: CandidateFit, effect: Effect) -> list[FitStart]:
    """Return the points of a parameter grid at which a fit of one more effect should begin.

    A grid needs a simulation for each point. It is used where the residuals are so large that a
    screen, which is linear, is not reliable. The starts, best first, are

    - the best point at each of the best few places (see `_best_places`), if the effect changes
      mass or stiffness at one of more than `SEARCH.few_places` places;
    - otherwise the points with the least objective among all places, at most
      `SEARCH.starts_far_from_data`.

    Parameters
    ----------
    base : CandidateFit
        The fit that the effect is added to, with the derivatives at its point.
    effect : Effect
        The effect; all its places are tried where the base does not have it.
    """
    places = free_places(effect, base.candidate, problem.setting)
    # a parameter with a single level has the same value at all points
    varied_count = sum(parameter.levels != 1 for parameter in effect.parameters)
    level_counts = SEARCH.grid_levels_far_from_data
    level_count = level_counts[min(varied_count, len(level_counts) - 1)]
    # medians of intervals of equal prior probability
    levels = ndtri((np.arange(level_count) + 0.5) / max(level_count, 1))
    if len(places) > SEARCH.few_places and moves_frequencies(effect, problem.setting):
        return _starts_at_best_places(problem, base, effect, places, levels)
    points = _grid_points(problem, base, _refitting_screen(problem, base), effect, places, levels)
    return [point.start for point in points[: SEARCH.starts_far_from_data]]


def _starts_at_best_places(
    problem: Problem,
    base: CandidateFit,
    effect: Effect,
    places: Sequence[str],
    levels: FloatArray,
) -> list[FitStart]:
    """Return the best start at each of the best places, the best first.

    If the model has nuisance parameters, such as errors of a mesh, these are the points of fits to
    the first periods. Otherwise the levels (L,) are searched again with the whole records.
    """
    best_places = _best_places(problem, base, effect, places, levels)
    if problem.model.nuisance_parameters:
        return [point.start for point in best_places]
    best_place_names = [point.place for point in best_places]
    points = _grid_points(
        problem, base, _refitting_screen(problem, base), effect, best_place_names, levels
    )
    # points come with rising objective: in reversed order, the best of a place is entered last
    best_point_by_place = {point.place: point for point in reversed(points)}
    best_points = sorted(best_point_by_place.values(), key=lambda point: point.objective)
    return [point.start for point in best_points]


def _best_places(
    problem: Problem,
    base: CandidateFit,
    effect: Effect,
    places: Sequence[str],
    levels: FloatArray,
) -> list["_GridPoint"]:
    """Return the best points at the places where an effect explains the first periods best.

    Each place is searched on its own, since the magnitude that gives the measured first frequency
    differs between places. Every `SEARCH.coarse_level_step`-th of the levels (L,) is tried first,
    then, at the best `SEARCH.places_with_near_levels` places, the levels next to the best of them.
    Objectives are compared to two digits; places that are then equal stay in their given order, in
    which named sets of nodes come first. Where errors of a mesh are fitted, the points are fitted
    to the first periods: in the whole record, phases drift too far for a fit to begin at a grid.
    """
    early_problem = _problem_of_first_periods(problem)
    early_base = base
    if problem.model.nuisance_parameters:
        early_base = fit(early_problem, base.candidate, base.point, iterations=0)
    screen = _refitting_screen(early_problem, early_base)

    def points_at(place: str, place_levels: FloatArray) -> list[_GridPoint]:
        """Return the points of a grid at one place, the best first."""
        return _grid_points(early_problem, early_base, screen, effect, [place], place_levels)

    half_step = SEARCH.coarse_level_step // 2
    coarse_levels = levels[half_step :: SEARCH.coarse_level_step]
    points_of_places = [points_at(place, coarse_levels) for place in places]
    coarse_points = [points[0] for points in points_of_places if points]
    if not coarse_points:  # the effect is larger than the model allows at all places
        return []
    objectives = sorted(point.objective for point in coarse_points)
    largest_objective = objectives[: SEARCH.places_with_near_levels][-1]
    best_of_places = []
    for coarse_point in coarse_points:
        if coarse_point.objective > largest_objective:
            continue
        level = coarse_point.start.point.effect[len(base.effect)]
        best_index = int(np.argmin(np.abs(levels - level)))
        nearby = levels[max(best_index - half_step, 0) : best_index + half_step + 1]
        fine_points = points_at(coarse_point.place, nearby)
        best_of_places.append(min((coarse_point, *fine_points), key=lambda point: point.objective))
    best_of_places.sort(key=lambda point: float(f"{point.objective:.1e}"))
    best_of_places = best_of_places[: SEARCH.places_far_from_data]
    if not problem.model.nuisance_parameters:
        return best_of_places
    points = []
    for best_point in best_of_places:
        early_fit = try_fit(
            early_problem,
            best_point.start.candidate,
            best_point.start.point,
            nearby_derivatives=early_base.trial_derivatives,
            iterations=SEARCH.rough_fit_iterations,
        )
        if early_fit is not None:
            start = best_point.start._replace(point=early_fit.point)
            points.append(_GridPoint(early_fit.objective, best_point.place, start))
    return sorted(points, key=lambda point: point.objective)


def _problem_of_first_periods(problem: Problem) -> Problem:
    """Return the problem in which only the first periods of each trial in motion are compared.

    They are `SEARCH.first_periods` periods of the first mode. Without trials in motion it is the
    problem itself.
    """
    period = 2.0 * np.pi / problem.setting.scales.angular_frequency
    intervals = [data.trial.interval for data in problem.trials if data.trial.is_dynamic]
    if not intervals:
        return problem
    return problem.with_first_samples(int(SEARCH.first_periods * period / min(intervals)))


def _refitting_screen(problem: Problem, base: CandidateFit) -> Screen | None:
    """Return the screen of a base where errors of the mesh are fitted, which hide a change."""
    if not problem.model.nuisance_parameters:
        return None
    return Screen(problem, base, effect_precision=np.ones(base.candidate.parameter_count))


class _GridPoint(NamedTuple):
    """The start of a fit at a point of a grid, the place of its effect and its objective [nat]."""

    objective: float
    place: str
    start: FitStart


def _grid_points(
    problem: Problem,
    base: CandidateFit,
    screen: Screen | None,
    effect: Effect,
    places: Sequence[str],
    levels: FloatArray,
) -> list[_GridPoint]:
    """Return the points of a parameter grid of an effect at some places, the best first.

    Each parameter is tried at all scaled values in `levels` (L,), or only at its median if the
    catalogue gives it one level. With a screen of the base, all other unknowns are refitted at each
    point, to first order. Points at which the model cannot be evaluated are left out.
    """
    points = []
    for place in places:
        term = EffectTerm(effect, place)
        axes = [(0.0,) if parameter.levels == 1 else levels for parameter in term.parameters]
        for values in product(*axes):
            start = start_with_added_effect(base, term, np.array(values))
            with suppress(DiscrepancyError):  # the effect is larger than the model allows
                if screen is None:
                    value = objective(problem, start.candidate, start.point)
                else:
                    value, refitted_point = screen.refit_with_effect(term, np.array(values))
                    start = start._replace(point=refitted_point)
                points.append(_GridPoint(value, place, start))
    return sorted(points, key=lambda point: point.objective)
