"""Starting points of fits near other optima than the one that was found.

They have another magnitude of a single effect, or another place of one effect of a set.
"""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace

from discrepancy.catalogue.entry import Setting
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate, EffectTerm, Point
from discrepancy.fits.fitting import LARGEST_EFFECT, objective
from discrepancy.fits.problem import Problem
from discrepancy.missing_force.explained import ForceHypothesis
from discrepancy.search_settings import SEARCH


def canonical_relatives(
    leading: EffectTerm, hypotheses: Iterable[ForceHypothesis]
) -> list[ForceHypothesis]:
    """Return the hypotheses that consist of one effect of the same family and place as another.

    The effect must have a parameter that is its magnitude, such as the force of dry friction. Its
    law must have the canonical shape: its dependence on position or speed is given, not fitted.

    Parameters
    ----------
    leading : EffectTerm
        The effect, at its place, whose family and place are required.
    hypotheses : iterable of ForceHypothesis
        The sets of effects among which to select.
    """
    relatives = []
    for hypothesis in hypotheses:
        if len(hypothesis.candidate.terms) != 1:
            continue
        (term,) = hypothesis.candidate.terms
        has_same_family = term.effect.family == leading.effect.family
        has_same_place = term.place == leading.place
        has_magnitude = any(parameter.magnitude for parameter in term.parameters)
        if has_same_family and has_same_place and has_magnitude and not term.free_shape:
            relatives.append(hypothesis)
    return relatives


def points_at_other_magnitudes(problem: Problem, candidate: Candidate, start: Point) -> list[Point]:
    """Return points at which a single effect has another magnitude, to begin fits at.

    They are sorted by their objective, the least first; `SEARCH.most_restarts` of them are
    returned.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    candidate : Candidate
        The candidate of one effect.
    start : Point
        The point at which the effect agrees with the missing force. Only the magnitude is changed.
    """
    (term,) = candidate.terms
    valued_points: list[tuple[float, Point]] = []
    for factor in SEARCH.restart_sizes:
        effect = term.multiply_magnitudes(start.effect, factor, -LARGEST_EFFECT, LARGEST_EFFECT)
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
