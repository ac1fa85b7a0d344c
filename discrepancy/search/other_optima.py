"""Fits from other starting points, in case a fit has ended in the wrong optimum.

The starting points differ from the fit in the stretch of the structure that an effect covers, in
the point of the grid beside which a mass lies, or in the place of one effect of a set.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.special import ndtr, ndtri

from discrepancy.catalogue.entry import Setting
from discrepancy.fits.candidate import Candidate, Point
from discrepancy.fits.fitting import CandidateFit, try_fit
from discrepancy.system.interface import Model
from fe.runtime.patch import ModelPatch, PlaceMass

from .fitted_candidates import FittedCandidates

LEAST_TAIL = 0.02
"""Least prior probability on either side of a changed parameter."""


def refit_from_other_stretches(
    candidates: FittedCandidates, on_progress: Callable[[str], None]
) -> None:
    """Fit the best set again, beginning with other stretches of the structure.

    Some effects, such as a local loss of stiffness, cover a stretch of the structure. Where an end
    of the stretch passes a line of the mesh, the response has a kink. A fit may end in an optimum
    on the wrong side of a line, where the stretch seems to be known far better than it is.

    Parameters
    ----------
    candidates : FittedCandidates
        All candidates and their fits, to which the new ones are added.
    """
    best_fit = candidates.best()
    for point in points_at_other_stretches(best_fit):
        on_progress(f"fitting {best_fit.candidate.description} from other stretches")
        fit = try_fit(candidates.problem, best_fit.candidate, point)
        if fit is not None:
            candidates.record_fit(fit, exact=True)


def points_at_other_stretches(fit: CandidateFit) -> list[Point]:
    """Return starting points at which the start or the length of a stretch is changed.

    An effect covers a stretch if the catalogue gives a number of levels for more than one of its
    parameters, such as start and length. One of them at a time is changed to either side by half a
    level, which is 0.5 / (number of levels) of its prior probability. All other unknowns stay.
    """
    points = []
    first_parameter = 0
    for term in fit.candidate.terms:
        numbers_with_levels = [
            number for number, parameter in enumerate(term.parameters) if parameter.levels > 1
        ]
        if len(numbers_with_levels) > 1:
            for number in numbers_with_levels:
                half_level = 0.5 / term.parameters[number].levels
                index = first_parameter + number
                for change in (-half_level, half_level):
                    probability = float(ndtr(fit.effect[index])) + change
                    effect = fit.effect.copy()
                    effect[index] = ndtri(np.clip(probability, LEAST_TAIL, 1.0 - LEAST_TAIL))
                    points.append(replace(fit.point, effect=effect))
        first_parameter += len(term.parameters)
    return points


def refit_masses_from_nearest_points(
    candidates: FittedCandidates, on_progress: Callable[[str], None]
) -> None:
    """Fit the best set again with its masses beside the points of the grid that are nearest.

    A mass lies beside a point of the grid, within the reach of this point. A fit that begins beside
    a wrong point ends at the edge of its reach, and the mass, which should be farther away, gets a
    wrong size there. So a mass that has come nearer to another point is fitted beside that one,
    until the best set stays.

    Parameters
    ----------
    candidates : FittedCandidates
        All candidates and their fits, to which the new ones are added.
    """
    problem = candidates.problem
    best_fit = None
    while best_fit is not candidates.best():
        best_fit = candidates.best()
        terms_with_values = best_fit.candidate.split_by_term(best_fit.effect)
        for number, (term, values) in enumerate(terms_with_values):
            place = _nearest_place_of_mass(problem.model, term.patch(problem.setting, values))
            if place in (None, term.place):
                continue
            moved_term = replace(term, place=place)
            is_magnitude = [parameter.magnitude for parameter in term.parameters]
            moved = list(terms_with_values)
            moved[number] = (moved_term, np.where(is_magnitude, values, moved_term.start_values()))
            terms, effect_values = zip(*moved, strict=True)
            candidate = Candidate(terms)
            has_term_twice = len(set(candidate.key)) < len(terms)
            if has_term_twice or candidate.key in candidates.exact_fits:
                continue
            on_progress(f"fitting {candidate.description} at {place}")
            start = replace(best_fit.point, effect=np.concatenate(effect_values))
            fit = try_fit(problem, candidate, start)
            if fit is not None:
                candidates.record_fit(fit, exact=True)


def _nearest_place_of_mass(model: Model, patch: ModelPatch) -> str | None:
    """Return the place of the grid that is nearest to the mass of a patch; None without such one.

    The distance [m] is that of the mass from the point of a place.
    """
    masses = [primitive for primitive in patch if isinstance(primitive, PlaceMass)]
    if not masses:
        return None
    lies_at = model.point_of_mass(masses[0])
    if lies_at is None:
        return None
    distances = {}
    for place in model.mass_reaches:
        middle = model.point_of_mass(PlaceMass(place=place, mass=0.0))
        if middle is not None:
            distances[place] = float(np.linalg.norm(middle.point - lies_at.point))
    return min(distances, key=lambda place: distances[place])


def sets_at_other_places(candidate: Candidate, setting: Setting) -> list[Candidate]:
    """Return all sets of effects that differ from a given one by the place of one effect."""
    moved_candidates = []
    for number, term in enumerate(candidate.terms):
        for place in term.effect.places(setting):
            terms = list(candidate.terms)
            terms[number] = replace(term, place=place)
            moved_candidate = Candidate(tuple(terms))
            has_term_twice = len(set(moved_candidate.key)) < len(terms)
            if place != term.place and not has_term_twice:
                moved_candidates.append(moved_candidate)
    return moved_candidates
