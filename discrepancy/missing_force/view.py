"""The missing forces of all trials together: processes, courses, and the motion with them.

A view is the set of trials, linear in all unknowns, with the columns of what may act in them. A
column is the change of the readings for a unit of one unknown.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray

from .filtered import (
    LEAST_PRECISION,
    ForceFilter,
    Process,
    Regression,
    SmoothedForces,
    Solution,
    sum_regressions,
)
from .process_search import MOST_STEPS, Processes, ProcessSearch, prior_log_density
from .trial import PortedTrial, TrialColumn

INFORMING_SAMPLES = 200
"""Number of samples after a moment by which its smoothed state is as well known as by any more of
them."""


@dataclass(frozen=True, eq=False)
class TrialMotion:
    """The estimated motion of a trial with all forces at ports, at the fine stamps.

    Attributes
    ----------
    added_state : (F, n) ndarray
        The state that all forces and parameters add to the response of the model.
    forces : mapping of int to (F,) ndarray
        The force at each port that the model lacks, laws of the hypothesis included, by the number
        of the port [N, N m or the port's flow].
    unexplained_forces : mapping of int to (F,) ndarray
        The part of `forces` that no law of the hypothesis explains.
    explained_state : (F, n) ndarray
        The part of `added_state` that parameters and laws explain.
    positions, speeds : (F, P) ndarray
        The motion of the ports [m or rad, and per s].
    deviations_by_port : mapping of int to ((N,) ndarray, float)
        The posterior standard deviations of the missing force at the samples, and of the speed of
        its port.
    """

    added_state: FloatArray
    forces: Mapping[int, FloatArray]
    unexplained_forces: Mapping[int, FloatArray]
    explained_state: FloatArray
    positions: FloatArray
    speeds: FloatArray
    deviations_by_port: Mapping[int, tuple[FloatArray, float]]

    @property
    def law_forces(self) -> dict[int, FloatArray]:
        """The forces (F,) of the laws of the hypothesis, by port."""
        return {
            port: force - self.unexplained_forces.get(port, 0.0)
            for port, force in self.forces.items()
        }


EffectColumn = Sequence[TrialColumn]
"""The column of an effect: its change of each trial for a unit of its unknown."""


def sum_of_columns(columns: Sequence[EffectColumn], factors: Sequence[float]) -> EffectColumn:
    """Return the sum of columns, each multiplied by its factor."""
    first_column, *other_columns = columns
    sum_by_trial = [
        TrialColumn(np.zeros_like(column_in_trial.readings)).plus(column_in_trial, factors[0])
        for column_in_trial in first_column
    ]
    for column, factor in zip(other_columns, factors[1:], strict=True):
        sum_by_trial = [
            column_in_trial.plus(change, factor)
            for column_in_trial, change in zip(sum_by_trial, column, strict=True)
        ]
    return sum_by_trial


@dataclass(frozen=True, eq=False)
class LinearTrials:
    """The trials, linear in all unknowns, with the columns of what may act in them.

    Attributes
    ----------
    trials : sequence of PortedTrial
        The trials in motion.
    shared_precision : (K,) ndarray
        The prior precisions of the shared unknowns.
    motions : sequence of TrialMotion
        The motion of each trial along which laws and parameters act; empty for that of the model.
    effect_columns : sequence of EffectColumn
        The columns of effects, each with one more unknown.
    effect_precision : sequence of float
        The prior precisions of these unknowns.
    constant_column : EffectColumn or None
        The part of the hypothesis that has no unknown.
    model_laws_column : EffectColumn or None
        The forces of the model's own laws, which its linear system does not contain.
    """

    trials: Sequence[PortedTrial]
    shared_precision: FloatArray
    motions: Sequence[TrialMotion] = ()
    effect_columns: Sequence[EffectColumn] = ()
    effect_precision: Sequence[float] = ()
    constant_column: EffectColumn | None = None
    model_laws_column: EffectColumn | None = None

    @cached_property
    def prior_precision(self) -> FloatArray:
        """The prior precisions of all unknowns: the shared ones, then those of the effects."""
        return np.concatenate((self.shared_precision, self.effect_precision))

    @cached_property
    def columns_by_unknown(self) -> list[dict[int, tuple[TrialColumn, float]]]:
        """The change of each trial for a unit of each unknown, by the number of the unknown.

        Beside each change stands the value of the unknown at which the change is zero: that about
        which the trial is linear.
        """
        by_trial: list[dict[int, tuple[TrialColumn, float]]] = [{} for _ in self.trials]
        for trial, motion, changes in zip(self.trials, self.motions, by_trial, strict=False):
            # calibrated parameters change the system, and with it the added state
            for unknown, slope in enumerate(trial.system_derivatives):
                if slope is not None:
                    change = trial.change_by_system_parameter(
                        slope, motion.added_state, motion.forces
                    )
                    changes[unknown] = (change, float(trial.linearisation_point[unknown]))
            # gains change the readings of their channel
            readings = trial.readings_of_state(motion.added_state, motion.forces)
            for unknown, channel, scale in trial.gain_unknowns:
                change = TrialColumn(readings * scale * np.eye(readings.shape[1])[channel])
                changes[unknown] = (change, float(trial.linearisation_point[unknown]))
        for unknown, column in enumerate(self.effect_columns, start=len(self.shared_precision)):
            for change, changes in zip(column, by_trial, strict=True):
                changes[unknown] = (change, 0.0)
        return by_trial

    @cached_property
    def regression_rows(self) -> list[FloatArray]:
        """The residual of each trial and its derivatives by all unknowns (1 + K + L, N, C).

        Row 0 is the residual at zero unknowns. The K shared unknowns and those of effects follow,
        then the L unknowns of the trial alone. All are divided by the noise deviations.
        """
        by_trial = []
        first_local = 1 + len(self.prior_precision)
        for number, trial in enumerate(self.trials):
            row_count = first_local + len(trial.local_derivatives)
            rows = np.moveaxis(np.zeros((*trial.residual.shape, row_count)), -1, 0)
            forces_without_unknown = [
                column[number].readings
                for column in (self.constant_column, self.model_laws_column)
                if column is not None
            ]
            rows[0] = trial.residual - sum(forces_without_unknown)
            rows[1 : 1 + len(trial.shared_derivatives)] = trial.shared_derivatives
            rows[first_local:] = trial.local_derivatives
            for unknown, (change, value) in self.columns_by_unknown[number].items():
                rows[1 + unknown] += change.readings
                # the change is proportional to (unknown - value): refer the residual to zero
                rows[0] += value * change.readings
            by_trial.append(rows)
        return by_trial

    def force_filters(self, processes: Processes) -> list[ForceFilter]:
        """Return the Kalman filter of each trial with given missing forces."""
        return [ForceFilter(trial, tuple(processes.items())) for trial in self.trials]

    def regression(self, processes: Processes) -> Regression:
        """Return the normal equations of all unknowns, given the missing forces."""
        return sum_regressions(self.force_filters(processes), self.regression_rows)

    def solve(self, processes: Processes) -> Solution:
        """Return log evidence and values of all unknowns, given the missing forces."""
        return self.regression(processes).solve(
            range(len(self.prior_precision)), self.prior_precision
        )

    @np.errstate(invalid="ignore")
    def most_probable_processes(
        self,
        median: Processes,
        initial: Processes,
        *,
        skip_grid: bool = False,
        most_steps: int = MOST_STEPS,
    ) -> tuple[dict[int, Process], float]:
        """Return the most probable missing forces, and the log of evidence times prior there [nat].

        Parameters
        ----------
        median : mapping of int to Process
            The prior medians of size and time of each missing force, by the number of its port.
        initial : mapping of int to Process
            The missing forces to begin with.
        skip_grid : bool
            Whether Newton's method begins at `initial` itself. Otherwise it begins at the best
            point of a grid of sizes and times around `initial`.
        most_steps : int
            The largest number of steps of Newton's method.
        """

        def log_evidence(processes: Processes) -> float:
            return self.log_evidence_with_prior(median, processes)

        search = ProcessSearch.within_prior(
            log_evidence, median, initial, self.correlation_time_range
        )
        return search.most_probable(from_grid=not skip_grid, most_steps=most_steps)

    @cached_property
    def correlation_time_range(self) -> tuple[float, float]:
        """The bounds of a correlation time [s]: shortest sampling interval, longest record."""
        stamps = [trial.time for trial in self.trials]
        return min(float(np.median(np.diff(time))) for time in stamps), max(
            float(time[-1] - time[0]) for time in stamps
        )

    def log_evidence_with_prior(self, median: Processes, processes: Processes) -> float:
        """Return the log of evidence times prior of missing forces [nat].

        Parameters
        ----------
        median : mapping of int to Process
            The prior medians of the missing forces, by the number of the port.
        processes : mapping of int to Process
            The missing forces.
        """
        return self.solve(processes).log_evidence + prior_log_density(median, processes)

    def smooth(
        self, processes: Processes, fixed_solution: Solution | None = None
    ) -> tuple[Solution, list[FloatArray], list[TrialMotion]]:
        """Return unknowns, motions and missing forces given all readings.

        Parameters
        ----------
        processes : mapping of int to Process
            The missing forces, by the number of the port.
        fixed_solution : Solution, optional
            The values of the shared unknowns and of those of effects; by default the most probable
            ones.

        Returns
        -------
        solution : Solution
            The shared unknowns, then those of effects.
        local : list of (L,) array
            The unknowns of each trial alone.
        motions : list of TrialMotion
            The motion of each trial.
        """
        solution = fixed_solution or self.solve(processes)
        local_values, motions = [], []
        for number, trial_filter in enumerate(self.force_filters(processes)):
            rows = self.regression_rows[number]
            unexplained = rows[0] - np.tensordot(solution.mean, rows[1 : 1 + len(solution.mean)], 1)
            local = _local_unknowns(trial_filter, unexplained)
            unexplained = unexplained - np.tensordot(local, trial_filter.trial.local_derivatives, 1)
            motions.append(
                self._trial_motion(
                    number, processes, trial_filter.smooth(unexplained), solution, local
                )
            )
            local_values.append(local)
        return solution, local_values, motions

    def _trial_motion(
        self,
        trial_index: int,
        processes: Processes,
        smoothed: SmoothedForces,
        solution: Solution,
        local: FloatArray,
    ) -> TrialMotion:
        """Return the motion of a trial with all that missing forces, unknowns and laws add to it.

        Parameters
        ----------
        trial_index : int
            The index of the trial.
        processes : mapping of int to Process
            The missing forces, by the number of the port.
        smoothed : SmoothedForces
            Their courses, and the state that they add.
        solution : Solution
            The shared unknowns and those of effects.
        local : (L,) array
            The unknowns of the trial alone.
        """
        trial = self.trials[trial_index]
        missing_forces = dict(zip(processes, smoothed.forces, strict=True))
        unused_readings = np.zeros_like(trial.residual)
        total_change = TrialColumn(unused_readings, smoothed.added_state, missing_forces)
        for unknown, (change, value) in self.columns_by_unknown[trial_index].items():
            total_change = total_change.plus(change, float(solution.mean[unknown] - value))
        if self.constant_column is not None:
            total_change = total_change.plus(self.constant_column[trial_index], 1.0)
        with_own_laws = (
            total_change
            if self.model_laws_column is None
            else total_change.plus(self.model_laws_column[trial_index], 1.0)
        )
        added = with_own_laws.added_state
        assert added is not None
        unknowns = np.concatenate((solution.mean[: len(self.shared_precision)], local))
        positions, speeds = trial.port_motion(unknowns, added)
        force_deviations, speed_deviations = np.split(smoothed.deviations, 2)
        # the deviation of a speed is taken so long before the end that later readings inform on it
        deviations = {
            port: (force, float(speed[-INFORMING_SAMPLES:][0]))
            for port, force, speed in zip(
                processes, force_deviations, speed_deviations, strict=True
            )
        }
        return TrialMotion(
            added_state=added,
            forces=total_change.forces,
            unexplained_forces=missing_forces,
            explained_state=added - smoothed.added_state,
            positions=positions,
            speeds=speeds,
            deviations_by_port=deviations,
        )


def _local_unknowns(force_filter: ForceFilter, unexplained: FloatArray) -> FloatArray:
    """Return the most probable unknowns (L,) of a trial alone, given all others.

    Parameters
    ----------
    force_filter : ForceFilter
        The filter of the trial.
    unexplained : (N, C) array
        The residuals at the values of the other unknowns.
    """
    trial = force_filter.trial
    products, _ = force_filter.whitened_products(
        np.concatenate((unexplained[None], trial.local_derivatives))
    )
    prior_precision = np.diag(np.maximum(trial.local_precision, LEAST_PRECISION))
    return np.linalg.solve(products[1:, 1:] + prior_precision, products[1:, 0])
