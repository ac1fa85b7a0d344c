"""Starting points of fits near other optima than the one that was found.

They have another stretch of the structure that an effect covers, or another place of one effect of
a set.
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
"""Prior probability that is left beyond a moved end of a stretch."""


def refit_from_other_stretches(
    candidates: FittedCandidates, on_progress: Callable[[str], None]
) -> None:
    """Fit the best set again from other stretches of the structure that its effect may cover.

    The response has a kink where an end of a stretch passes a line of the mesh. A fit may end in an
    optimum on the wrong side of a line, where the stretch seems to be known far better than it is.

    Parameters
    ----------
    candidates : FittedCandidates
        All candidates and their fits, to which the new ones are added.
    on_progress : callable
        The function to which progress is reported, as a line of text.
    """
    best_fit = candidates.best()
    for point in points_at_other_stretches(best_fit):
        on_progress(f"fitting {best_fit.candidate.description} from other stretches")
        fit = try_fit(candidates.problem, best_fit.candidate, point)
        if fit is not None:
            candidates.record_fit(fit, exact=True)


def points_at_other_stretches(fit: CandidateFit) -> list[Point]:
    """Return points at which an effect covers another stretch of the structure, to begin fits at.

    Both ends of a stretch are unknowns of such an effect, and the catalogue gives the number of
    levels that the screen tries of each. The points have one of these unknowns half a level higher
    or lower, in units of its prior probability. They are none if no effect covers a stretch.

    Parameters
    ----------
    fit : CandidateFit
        The fit that was found.
    """
    points = []
    first_parameter = 0
    for term in fit.candidate.terms:
        numbers_with_levels = [k for k, item in enumerate(term.parameters) if item.levels > 1]
        if len(numbers_with_levels) > 1:  # both ends
            for number in numbers_with_levels:
                half_level = 0.5 / term.parameters[number].levels
                index = first_parameter + number
                for move in (-half_level, half_level):
                    probability = float(ndtr(fit.effect[index])) + move
                    effect = fit.effect.copy()
                    effect[index] = ndtri(np.clip(probability, LEAST_TAIL, 1.0 - LEAST_TAIL))
                    points.append(replace(fit.point, effect=effect))
        first_parameter += len(term.parameters)
    return points


def sets_at_other_places(candidate: Candidate, setting: Setting) -> list[Candidate]:
    """Return all candidates that differ from a set of effects by the place of one effect."""
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
