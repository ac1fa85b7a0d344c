"""Beside an optimum: other optima of the same candidate, and its law with a free shape."""

from dataclasses import replace
from typing import Any

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import EffectParameter, ShapeParameter
from discrepancy.search_settings import SEARCH

from .candidate import Candidate, Point, Term
from .fitting import CandidateFit, attempt
from .problem import Problem
from .screening import is_magnitude


def is_box(candidate: Candidate) -> bool:
    """Whether an effect has more than one parameter that is no mere size, as a place and a length.

    Its edges pass sensors and lines of the mesh, and optima on either side may fit within the noise.
    """
    return any(sum(not is_magnitude(item) for item in term.parameters) > 1 for term in candidate.terms)


def around(problem: Problem, found: CandidateFit) -> CandidateFit:
    """Return the best fit of the same candidate beside an optimum, or the fit itself.

    Hysteresis of several elements has many local optima along the direction that the data tell least of, and
    a place has them at each sensor that it passes.
    """
    free = [number for number, item in enumerate(_parameters(found)) if not is_magnitude(item)]
    for _ in range(SEARCH.rounds):
        moves = [step * axis for axis in np.eye(found.candidate.size)[free] for step in SEARCH.place_steps]
        if found.candidate.size > 1:
            _, directions = np.linalg.eigh(found.effect_covariance)
            moves += [step * directions[:, -1] for step in SEARCH.ridge_steps]
        better = found
        for move in moves:
            effect = found.point.effect + move
            better = _better(problem, found, effect, better, iterations=SEARCH.neighbour_iterations)
        if better is found:
            break
        found = better
    return found


def _parameters(found: CandidateFit) -> list[EffectParameter | ShapeParameter]:
    return [item for term in found.candidate.terms for item in term.parameters]


def _better(
    problem: Problem, found: CandidateFit, effect: FloatArray, best: CandidateFit, **options: Any
) -> CandidateFit:
    """Return the best fit so far, or one begun beside a fit at other effect parameters where it gains."""
    start = Point(found.point.shared, found.point.local, effect)
    again = attempt(problem, found.candidate, start, give_up=best.objective, **options)
    if again is None or again.log_evidence <= best.log_evidence + SEARCH.neighbour_gain:
        return best
    # Along a bent valley a fit that is far better may have run out of steps before its end.
    return again if again.converged else attempt(problem, again.candidate, again.point, **options) or again


def free_shape(
    problem: Problem, named: CandidateFit, number: int, *, give_up: float | None = None
) -> CandidateFit | None:
    """Fit the family of one effect of a fit: its shape free, from the canonical one.

    Parameters
    ----------
    problem : Problem
        Of the fit.
    named : CandidateFit
        With canonical shapes.
    number : int
        Of the effect among its terms.
    give_up : float, optional
        See `fit`.

    Returns
    -------
    CandidateFit or None
        None where no shape is to free, or the structure cannot follow.
    """
    terms, parts = list(named.candidate.terms), list(named.candidate.parts(named.point.effect))
    effect = terms[number].effect
    if not effect.shape:
        return None
    terms[number] = Term(effect, terms[number].place, free_shape=True)
    parts[number] = np.append(parts[number], [item.prior.normal(item.canonical) for item in effect.shape])
    start = replace(named.point, effect=np.concatenate(parts))
    return attempt(problem, Candidate(tuple(terms)), start, give_up=give_up)
