"""Fits from other starting points, in case a fit has ended in the wrong optimum.

The starting points differ from the fit in the stretch of the structure that an effect covers, or in
the place of one effect of a set.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.special import ndtr, ndtri

from discrepancy.catalogue.entry import Setting
from discrepancy.fits.candidate import Candidate, Point
from discrepancy.fits.fitting import CandidateFit, try_fit

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
