"""Fits of trials whose initial state is unknown, begun from the first readings.

Started from rest, the motion of a long record is far from the readings: its phase slips, and a
descent ends in a wrong optimum. Over a few readings a motion is nearly linear in its initial state.
So the initial state is fitted to the first readings, then to twice as many, and so on to the whole
record.
"""

from dataclasses import replace

import numpy as np

from discrepancy.fits.candidate import Candidate, Point
from discrepancy.fits.fitting import CandidateFit, attempt
from discrepancy.fits.problem import Problem

FIRST_SAMPLES = 8
"""Number of readings to which an initial state is fitted first."""
STEPS = 12
"""Largest number of steps of a fit to the first part of a record."""
MISFIT = 1.5
"""χ² per sample from which on a fit is repeated from new initial states."""


def refit_from_first_readings(
    problem: Problem, fit: CandidateFit, *, iterations: int = 60, local_only: bool = False
) -> CandidateFit:
    """Return a fit that begins at the initial states of the first readings, if it is better.

    The given fit is returned where it explains the readings, where no trial has an unknown initial
    state, and where the new fit is no better.

    Parameters
    ----------
    problem : Problem
        The campaign and model that were fitted.
    fit : CandidateFit
        The fit to improve.
    iterations : int
        The largest number of steps.
    local_only : bool
        Whether only the unknowns of the trials are fitted, and all others stay.
    """
    is_fitted = fit.chi_square < MISFIT * float(problem.counts.sum())
    if is_fitted or not has_unknown_initial_state(problem):
        return fit
    candidate = fit.candidate
    start = Point(
        shared=fit.point.shared if local_only else np.zeros(problem.shared.size),
        local=problem.start(candidate).local,
        effect=fit.point.effect,
    )
    start = with_initial_states_of_first_readings(problem, start)
    new_fit = attempt(problem, candidate, start, iterations=iterations, local_only=local_only)
    if new_fit is None or new_fit.objective >= fit.objective:
        return fit
    return new_fit


def has_unknown_initial_state(problem: Problem) -> bool:
    """Return whether a trial in motion begins in a state with unknown entries."""
    for data in problem.trials:
        rows, _ = data.unknowns.initial_shape
        if data.trial.is_dynamic and rows > 0:
            return True
    return False


def with_initial_states_of_first_readings(problem: Problem, point: Point) -> Point:
    """Return a point with the unknowns of the trials as fitted to their first readings.

    They are fitted with the model as it is and kept in `Problem.beginnings` by the name of the
    trial, since the initial state of a trial is the same under all hypotheses.
    """
    beginnings = problem.beginnings
    if any(data.trial.name not in beginnings for data in problem.trials):
        without_effect = replace(point, effect=np.zeros(0))
        fitted = _fit_to_growing_records(problem, without_effect)
        for data, unknowns in zip(problem.trials, fitted.local, strict=True):
            beginnings[data.trial.name] = unknowns
    return replace(point, local=tuple(beginnings[data.trial.name] for data in problem.trials))


def _fit_to_growing_records(problem: Problem, point: Point) -> Point:
    """Return the point with the trials' unknowns fitted to growing parts of the records."""
    longest = max(len(data.trial.time) for data in problem.trials)
    samples = FIRST_SAMPLES
    while samples < 2 * longest:
        shortened = problem.first_samples(samples)
        fit = attempt(shortened, Candidate(), point, iterations=STEPS, local_only=True)
        if fit is None:
            break
        point = fit.point
        samples *= 2
    return point
