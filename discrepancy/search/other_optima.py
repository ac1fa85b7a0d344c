"""Starting points of fits near other optima than the one that was found.

They have another magnitude of a single effect, another stretch of the structure that an effect
covers, or another place of one effect of a set.
"""

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.special import ndtr, ndtri

from discrepancy.catalogue.entry import Setting
from discrepancy.errors import DiscrepancyError
from discrepancy.estimation.estimate import Estimate
from discrepancy.fits.candidate import Candidate, EffectTerm, Point
from discrepancy.fits.fitting import CandidateFit, objective, try_fit
from discrepancy.fits.problem import Problem
from discrepancy.search_settings import SEARCH

from .fitted_candidates import FittedCandidates

LEAST_TAIL = 0.02
"""Prior probability that is left beyond a moved end of a stretch."""


def canonical_relatives(leading_term: EffectTerm, hypotheses: Iterable[Estimate]) -> list[Estimate]:
    """Return the hypotheses that a fit from other starting magnitudes may improve.

    Such a hypothesis consists of one effect. The effect has the same family (such as friction) and
    the same place as the leading effect, which fits best so far; it may be the leading effect
    itself. It has a magnitude, from which the fit can start. The shape of its law is the canonical
    one of the catalogue, as its shape parameters are not fitted.

    Parameters
    ----------
    leading_term : EffectTerm
        The leading effect at its place.
    hypotheses : iterable of Estimate
        All hypotheses: sets of effects that were fitted to the missing force.
    """
    relatives = []
    for hypothesis in hypotheses:
        if len(hypothesis.candidate.terms) != 1:
            continue
        (term,) = hypothesis.candidate.terms
        has_same_family = term.effect.family == leading_term.effect.family
        is_related = has_same_family and term.place == leading_term.place
        has_magnitude = any(parameter.magnitude for parameter in term.parameters)
        if is_related and has_magnitude and not term.free_shape:
            relatives.append(hypothesis)
    return relatives


def points_at_other_magnitudes(problem: Problem, candidate: Candidate, start: Point) -> list[Point]:
    """Return points at which a single effect has another magnitude, to begin fits at.

    They are sorted by their objective, the least first; `SEARCH.most_restarts` of them are
    returned.

    Parameters
    ----------
    problem : Problem
        The campaign and the model, with the layout of their unknowns.
    candidate : Candidate
        The candidate of one effect.
    start : Point
        The point at which the effect agrees with the missing force. Only the magnitude is changed.
    """
    (term,) = candidate.terms
    valued_points: list[tuple[float, Point]] = []
    for factor in SEARCH.restart_sizes:
        effect = term.multiply_magnitudes_within_range(start.effect, factor)
        point = replace(start, effect=effect)
        with suppress(DiscrepancyError):  # the effect is larger than the model allows
            valued_points.append((objective(problem, candidate, point), point))
    valued_points.sort(key=lambda valued_point: valued_point[0])
    return [point for _, point in valued_points[: SEARCH.most_restarts]]


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
        numbers_with_levels = [k for k, item in enumerate(term.parameters) if item.levels]
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
