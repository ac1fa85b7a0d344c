"""Starting points of fits near other optima than the one that was found.

They have another magnitude of a single effect, or another place of one effect of a set.
"""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace

from discrepancy.catalogue.entry import Setting
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate, EffectTerm, Point
from discrepancy.fits.fitting import objective
from discrepancy.fits.problem import Problem
from discrepancy.missing_force.explained import ForceHypothesis
from discrepancy.search_settings import SEARCH


def canonical_relatives(
    leading_term: EffectTerm, hypotheses: Iterable[ForceHypothesis]
) -> list[ForceHypothesis]:
    """Return the hypotheses that a fit from other starting magnitudes may improve.

    Such a hypothesis consists of one effect. The effect has the same family (such as friction) and
    the same place as the leading effect, which fits best so far; it may be the leading effect
    itself. It has a magnitude, from which the fit can start. The shape of its law is the canonical
    one of the catalogue, as its shape parameters are not fitted.

    Parameters
    ----------
    leading_term : EffectTerm
        The leading effect at its place.
    hypotheses : iterable of ForceHypothesis
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
