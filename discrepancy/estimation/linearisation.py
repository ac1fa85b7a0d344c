"""All trials of a hypothesis, linear along their trajectories, as one linear regression."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.trials_in_motion.trajectory import (
    NO_SENSOR_ERRORS,
    LinearisedForce,
    LinearisedSensorErrors,
    Trajectory,
)
from discrepancy.trials_in_motion.trial import correlation_time_range
from discrepancy.trials_in_motion.trial_at_rest import LinearTrial, TrialAtRest

from .filtered import FilteredTrial, SmoothedTrial
from .force_states import Process
from .linearised import LinearisedTrial
from .linearised_rest import LinearisedRest, RestUnderForces
from .process_search import MOST_STEPS, Processes, ProcessSearch, prior_log_density
from .regression import LEAST_PRECISION, Priors, Regression, Solution, integrate_out_last

ANY_TIME = (1e-6, 1e6)
"""Bounds of a correlation time on which nothing depends, as all trials are at rest [s]."""


@dataclass(frozen=True, eq=False)
class Linearisation:
    """All trials, linear along their trajectories.

    Attributes
    ----------
    trials : tuple of LinearisedTrial or LinearisedRest
        The trials in motion and at rest, each linear about the same values.
    priors : Priors
        The priors of the K unknowns that all trials share, then of the E of the effects.
    """

    trials: tuple[LinearisedTrial | LinearisedRest, ...]
    priors: Priors

    @property
    def shared_precision(self) -> FloatArray:
        """The prior precisions (K,) of the unknowns that all trials share."""
        return self.priors.precision[: len(self.trials[0].shared)]

    @cached_property
    def correlation_time_range(self) -> tuple[float, float]:
        """The bounds of a correlation time [s]: shortest sampling interval, longest record.

        Forces at rest have no correlation time, so that without trials in motion it has no bounds.
        """
        if not self.in_motion:
            return ANY_TIME
        return correlation_time_range([linear_trial.trial for linear_trial in self.in_motion])

    @property
    def in_motion(self) -> tuple[LinearisedTrial, ...]:
        """The trials in motion."""
        return tuple(trial for trial in self.trials if isinstance(trial, LinearisedTrial))

    def filter(self, processes: Processes) -> Iterator[FilteredTrial | RestUnderForces]:
        """Yield the filter of each trial with missing forces, one after the other.

        A filter needs tens of MB in a long record, which are free again with the next trial.
        """
        for linear_trial in self.trials:
            if isinstance(linear_trial, LinearisedTrial):
                yield FilteredTrial(linear_trial, processes)
            else:
                yield RestUnderForces(linear_trial, processes)

    def without_cached_arrays(self) -> "Linearisation":
        """Return the same trials without the arrays that were computed from them: tens of MB."""
        return replace(self, trials=tuple(replace(trial) for trial in self.trials))

    def regression(self, filtered_trials: Iterable[FilteredTrial | RestUnderForces]) -> Regression:
        """Return the normal equations of all unknowns but the local ones.

        The local unknowns, which occur in one trial only, are integrated out.
        """
        sum_of_products = np.zeros((1 + len(self.priors),) * 2)
        half_log_determinant = 0.0
        for filtered_trial in filtered_trials:
            products, half_determinant = filtered_trial.whitened_products
            products, half_determinant_with_local = integrate_out_last(
                products,
                np.asarray(half_determinant),
                filtered_trial.linear_trial.trial.local_precision,
            )
            sum_of_products += products
            half_log_determinant += float(half_determinant_with_local)
        return Regression(sum_of_products, half_log_determinant)

    def solve(self, processes: Processes) -> Solution:
        """Return log evidence and values of the K + E unknowns, given the missing forces."""
        return self._solve_filtered(self.filter(processes))

    def _solve_filtered(
        self, filtered_trials: Iterable[FilteredTrial | RestUnderForces]
    ) -> Solution:
        """Return log evidence and values of the K + E unknowns by the filters of all trials."""
        return self.regression(filtered_trials).solve(range(len(self.priors)), self.priors)

    def solve_and_smooth(self, processes: Processes) -> tuple[Solution, tuple[SmoothedTrial, ...]]:
        """Return the most probable unknowns, and the smoothed motion and forces of all trials."""
        filtered_trials = tuple(self.filter(processes))
        solution = self._solve_filtered(filtered_trials)
        return solution, _smooth_filtered(filtered_trials, solution)

    def smooth(self, processes: Processes, solution: Solution) -> tuple[SmoothedTrial, ...]:
        """Return the smoothed motion and forces of all trials at given values of the unknowns.

        Parameters
        ----------
        processes : mapping of int to Process
            The missing forces, by the index of the port.
        solution : Solution
            The values of the shared unknowns and of those of effects. The local unknowns are the
            most probable ones beside these.
        """
        return _smooth_filtered(self.filter(processes), solution)

    def log_evidence_with_prior(self, median_processes: Processes, processes: Processes) -> float:
        """Return the log of evidence times prior of missing forces [nat].

        Parameters
        ----------
        median_processes : mapping of int to Process
            The prior medians of the missing forces, by the index of the port.
        processes : mapping of int to Process
            The missing forces as random processes, by the index of the port.
        """
        return self.solve(processes).log_evidence + prior_log_density(median_processes, processes)

    @np.errstate(invalid="ignore")
    def most_probable_processes(
        self,
        median_processes: Processes,
        initial_processes: Processes,
        *,
        skip_grid: bool = False,
        most_steps: int = MOST_STEPS,
    ) -> tuple[dict[int, Process], float]:
        """Return the most probable missing forces, and the log of evidence times prior there [nat].

        Parameters
        ----------
        median_processes : mapping of int to Process
            The prior medians of the missing forces, by the index of the port.
        initial_processes : mapping of int to Process
            The missing forces to begin with.
        skip_grid : bool
            Whether Newton's method begins at `initial_processes` itself. Otherwise it begins at the
            best point of a grid of amplitudes and times around `initial_processes`.
        most_steps : int
            The largest number of steps of Newton's method.
        """
        search = ProcessSearch.within_prior(
            lambda processes: self.log_evidence_with_prior(median_processes, processes),
            median_processes,
            initial_processes,
            self.correlation_time_range,
        )
        return search.most_probable(from_grid=not skip_grid, most_steps=most_steps)


def _most_probable_local_unknowns(
    filtered_trial: FilteredTrial | RestUnderForces, shared_and_effect: FloatArray
) -> FloatArray:
    """Return the most probable values (L,) of the local unknowns of one trial.

    Local unknowns occur in one trial only, such as its initial state. The K + E other unknowns are
    fixed at given values.
    """
    # inner products of the whitened residual (index 0) and its derivatives with respect to unknowns
    products, _ = filtered_trial.whitened_products
    first_local = 1 + len(shared_and_effect)
    local_slice = slice(first_local, None)
    # normal equations of the local unknowns, with the fixed unknowns on the right side
    precision = np.maximum(filtered_trial.linear_trial.trial.local_precision, LEAST_PRECISION)
    normal_matrix = products[local_slice, local_slice] + np.diag(precision)
    by_fixed = products[local_slice, 1:first_local] @ shared_and_effect
    return np.linalg.solve(normal_matrix, products[local_slice, 0] - by_fixed)


def _smooth_filtered(
    filtered_trials: Iterable[FilteredTrial | RestUnderForces], solution: Solution
) -> tuple[SmoothedTrial, ...]:
    """Return the smoothed motion of filtered trials at the shared values of a solution."""
    smoothed_trials = []
    for filtered_trial in filtered_trials:
        local_values = _most_probable_local_unknowns(filtered_trial, solution.mean)
        unknowns = np.concatenate((solution.mean, local_values))
        smoothed_trials.append(filtered_trial.smooth(unknowns))
    return tuple(smoothed_trials)


def linearised(
    trial: LinearTrial,
    trajectory: Trajectory,
    forces: Mapping[int, LinearisedForce],
    sensor_errors: LinearisedSensorErrors,
    effect: FloatArray,
    shared: FloatArray,
) -> LinearisedTrial | LinearisedRest:
    """Return a trial with laws that are linear about a trajectory and values of the unknowns."""
    if isinstance(trial, TrialAtRest):
        return LinearisedRest(trial, trajectory, forces, sensor_errors, effect, shared)
    return LinearisedTrial(trial, trajectory, forces, sensor_errors, effect, shared)


def plain_linearisation(trials: Sequence[LinearTrial], shared_priors: Priors) -> Linearisation:
    """Return trials along the motion of the linear model, without any law or error of a sensor."""
    no_effect = np.zeros(0)
    linear_trials = []
    for trial in trials:
        shared = trial.linearisation_point[: len(shared_priors)]
        linear_trials.append(
            linearised(
                trial,
                trial.trajectory_of_model(),
                forces={},
                sensor_errors=NO_SENSOR_ERRORS,
                effect=no_effect,
                shared=shared,
            )
        )
    return Linearisation(tuple(linear_trials), shared_priors)
