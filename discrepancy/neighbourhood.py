"""Beside an optimum: other optima of the same candidate, and its law with a free shape."""

import numpy as np

from .candidate import Candidate, Term
from .errors import FitError, ModelError
from .fitting import Fit, fit
from .problem import Point, Problem
from .screening import is_magnitude

RIDGE_STEPS, PLACE_STEPS = (-0.8, -0.3, 0.3, 0.8), (-0.15, -0.05, 0.05, 0.15)
"""Steps along the direction that the data tell least of, and of parameters that are not mere sizes, in prior
deviations."""
SHAPE_ITERATIONS = 40
"""Steps of a fit with a free shape, whose valleys are long."""
NEIGHBOUR_ITERATIONS, NEIGHBOUR_GAIN, ROUNDS = 8, 1.0, 5
"""Steps of each fit, the gain of log evidence that counts [nat], and how often one leads to the next."""


def is_box(candidate: Candidate) -> bool:
    """Whether an effect has more than one parameter that is no mere size, as a place and a length.

    Its edges pass sensors and lines of the mesh, and optima on either side may fit within the noise.
    """
    return any(sum(not is_magnitude(item) for item in term.parameters) > 1 for term in candidate.terms)


def around(problem: Problem, found: Fit) -> Fit:
    """Return the best fit of the same candidate beside an optimum, or the fit itself.

    Hysteresis of several elements has many local optima along the direction that the data tell least of, and
    a place has them at each sensor that it passes.
    """
    parameters = [item for term in found.candidate.terms for item in term.parameters]
    free = [number for number, item in enumerate(parameters) if not is_magnitude(item)]
    for _ in range(ROUNDS):
        moves = [step * axis for axis in np.eye(found.candidate.size)[free] for step in PLACE_STEPS]
        if found.candidate.size > 1:
            _, directions = np.linalg.eigh(found.effect_covariance)
            moves += [step * directions[:, -1] for step in RIDGE_STEPS]
        better = found
        for move in moves:
            start = Point(found.point.shared, found.point.local, found.point.effect + move)
            try:
                item = fit(
                    problem, found.candidate, start, iterations=NEIGHBOUR_ITERATIONS, give_up=better.objective
                )
            except (FitError, ModelError):
                continue
            if item.log_evidence > better.log_evidence + NEIGHBOUR_GAIN:
                better = item
        if better is found:
            break
        found = better
    return found


def free_shape(problem: Problem, named: Fit, number: int, *, give_up: float | None = None) -> Fit | None:
    """Fit the family of one effect of a fit: its shape free, from the canonical one.

    Parameters
    ----------
    problem : Problem
        Of the fit.
    named : Fit
        With canonical shapes.
    number : int
        Of the effect among its terms.
    give_up : float, optional
        See `fit`.

    Returns
    -------
    Fit or None
        None where no shape is to free, or the structure cannot follow.
    """
    terms, parts = list(named.candidate.terms), list(named.candidate.parts(named.point.effect))
    effect = terms[number].effect
    if not effect.shape:
        return None
    terms[number] = Term(effect, terms[number].place, free_shape=True)
    parts[number] = np.append(parts[number], [item.prior.normal(item.canonical) for item in effect.shape])
    start = Point(named.point.shared, named.point.local, np.concatenate(parts))
    try:
        return fit(problem, Candidate(tuple(terms)), start, iterations=SHAPE_ITERATIONS, give_up=give_up)
    except (FitError, ModelError):
        return None
