"""Fits of trials with an unknown initial state, which begin with a fit to the first readings.

The phase of a predicted motion drifts away from that of a long record, so that a fit that begins at
rest ends in a wrong optimum. But the first few readings are nearly linear in the initial state. So
the initial state is fitted to the first readings, then to twice as many, and so on up to the whole
record.
"""

from dataclasses import replace

import numpy as np

from discrepancy.fits.candidate import Candidate, Point
from discrepancy.fits.fitting import MOST_FIT_STEPS, CandidateFit, try_fit
from discrepancy.fits.problem import Problem

FIRST_SAMPLES = 8
"""Number of readings to which an initial state is fitted first."""
MOST_STEPS = 12
"""Largest number of steps of each fit to a part of a record."""
LARGEST_CHI_SQUARE = 1.5
"""χ² per sample above which a fit is repeated with initial states from the first readings."""


def refit_from_first_readings(
    problem: Problem,
    fit: CandidateFit,
    *,
    iterations: int = MOST_FIT_STEPS,
    local_only: bool = False,
) -> CandidateFit:
    """Return the better of a fit and a second fit, which begins at other initial states.

    The second fit begins at initial states that were fitted to the first readings of each trial and
    then to longer and longer parts of it, and at the prior means of the shared unknowns, unless
    these are fixed. It is not made if χ² per sample of the given fit is below `LARGEST_CHI_SQUARE`,
    or if no trial in motion has an unknown initial state.

    Parameters
    ----------
    iterations : int
        The largest number of steps.
    local_only : bool
        Whether only the trials' own unknowns are fitted, while shared unknowns and effects are
        fixed.
    """
    explains_readings = fit.chi_square < LARGEST_CHI_SQUARE * float(problem.sample_counts.sum())
    if explains_readings or not has_unknown_initial_state(problem):
        return fit
    candidate = fit.candidate
    start = Point(
        shared=fit.point.shared if local_only else np.zeros(problem.shared.unknown_count),
        local=problem.prior_mean_point(candidate).local,
        effect=fit.point.effect,
    )
    start = with_initial_states_of_first_readings(problem, start)
    second_fit = try_fit(problem, candidate, start, iterations=iterations, local_only=local_only)
    if second_fit is None or second_fit.objective >= fit.objective:
        return fit
    return second_fit


def has_unknown_initial_state(problem: Problem) -> bool:
    """Return whether the initial state of at least one trial in motion has unknown entries."""
    for data in problem.trials:
        rows, _ = data.unknowns.initial_shape
        if data.trial.is_dynamic and rows > 0:
            return True
    return False


def with_initial_states_of_first_readings(problem: Problem, point: Point) -> Point:
    """Return the point with each trial's own unknowns from a fit that began at its first readings.

    All own unknowns of a trial (`Point.local`) are replaced, the initial state among them. They are
    fitted without effect and at the shared unknowns of the point, to the first readings and then to
    longer and longer parts of the record. They are kept in `Problem.initial_states`, by the name of
    the trial, since they are nearly the same under all hypotheses. If a trial of the problem has no
    entry there, all its trials are fitted, and the entries of all are replaced.
    """
    unknowns_by_trial = problem.initial_states
    if any(data.trial.name not in unknowns_by_trial for data in problem.trials):
        without_effect = replace(point, effect=np.zeros(0))
        fitted_point = _fit_to_growing_records(problem, without_effect)
        for data, unknowns in zip(problem.trials, fitted_point.local, strict=True):
            unknowns_by_trial[data.trial.name] = unknowns
    return replace(
        point, local=tuple(unknowns_by_trial[data.trial.name] for data in problem.trials)
    )


def _fit_to_growing_records(problem: Problem, point: Point) -> Point:
    """Fit the local unknowns to the first readings of each record, then to longer and longer parts.

    The number of readings is doubled from fit to fit, up to whole records, and each fit begins at
    the point of the one before. The shared unknowns are fixed. The point of the last fit that
    succeeded is returned.
    """
    longest_record = max(len(data.trial.time) for data in problem.trials)
    sample_count = FIRST_SAMPLES
    while sample_count < 2 * longest_record:  # the last fit has the whole records
        shortened = problem.with_first_samples(sample_count)
        fit = try_fit(shortened, Candidate(), point, iterations=MOST_STEPS, local_only=True)
        if fit is None:
            break
        point = fit.point
        sample_count *= 2
    return point
