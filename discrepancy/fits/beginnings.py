"""Unknown beginnings of trials, taken from their first readings.

From rest, a swing of a whole record is far: its phase slips, and a descent ends in a wrong optimum. Over a
few readings a motion is nearly linear in its beginning. So the beginning is fitted to these, then to twice
as many, and so on to the whole record.
"""

from dataclasses import replace

import numpy as np

from discrepancy.fits.candidate import Candidate, Point
from discrepancy.fits.fitting import CandidateFit, attempt
from discrepancy.fits.problem import Problem

FIRST_SAMPLES = 8
"""Readings to which a beginning is fitted first."""
STEPS = 12
"""Steps of a fit to a part of the record."""
MISFIT = 1.5
"""χ² per sample from which on a beginning is looked for again."""


def refitted_from_beginnings(
    problem: Problem, found: CandidateFit, *, iterations: int = 60, local_only: bool = False
) -> CandidateFit:
    """Return a fit begun anew from what the first readings show, where that is better; else the fit as it is.

    Parameters
    ----------
    problem : Problem
        Of the fit.
    found : CandidateFit
        The fit; nothing is done where it explains the readings, or no trial begins in an unknown state.
    iterations, local_only
        As of `discrepancy.fits.fitting.fit`.
    """
    if found.chi_square < MISFIT * float(problem.counts.sum()) or not has_unknown_beginning(problem):
        return found
    shared = found.point.shared if local_only else np.zeros(problem.shared.size)
    begun = from_beginnings(problem, Point(shared, problem.start(found.candidate).local, found.point.effect))
    again = attempt(problem, found.candidate, begun, iterations=iterations, local_only=local_only)
    return found if again is None or again.objective >= found.objective else again


def has_unknown_beginning(problem: Problem) -> bool:
    """Whether a trial in motion begins in a state of which entries are unknown."""
    return any(data.trial.is_dynamic and data.unknowns.initial_shape[0] for data in problem.trials)


def from_beginnings(problem: Problem, point: Point) -> Point:
    """Return a point whose trials' own unknowns are those that the first readings show, by the bare model.

    They are kept in `Problem.beginnings`, by trial: what begins a trial is the same for all hypotheses.
    """
    known = problem.beginnings
    if any(data.trial.name not in known for data in problem.trials):
        bare = replace(point, effect=np.zeros(0))
        for data, unknowns in zip(problem.trials, _grown(problem, bare).local, strict=True):
            known[data.trial.name] = unknowns
    return replace(point, local=tuple(known[data.trial.name] for data in problem.trials))


def _grown(problem: Problem, point: Point) -> Point:
    """Return the point with the trials' own unknowns fitted to more and more of the records."""
    longest = max(len(data.trial.time) for data in problem.trials)
    samples = FIRST_SAMPLES
    while samples < 2 * longest:
        part = problem.first_samples(samples)
        fitted = attempt(part, Candidate(), point, iterations=STEPS, local_only=True)
        if fitted is None:
            break
        point = fitted.point
        samples *= 2
    return point
