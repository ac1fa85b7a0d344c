"""All trials in motion as one linear model: its unknowns, missing forces, and the motion with them.

A column is the change of the trials for a unit of one unknown. The columns of effects and of
parameters are those along a motion of the trials that was estimated before.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

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
from .trial import PortedTrial, TrialColumn, correlation_time_range

INFORMING_SAMPLES = 200
"""Number of later samples after which further ones hardly improve a smoothed state."""


class PortDeviations(NamedTuple):
    """The posterior standard deviations of a missing force and of the motion of its port.

    Attributes
    ----------
    force : (N,) ndarray
        The deviation of the force at the samples [N, N m or the port's flow].
    speed : float
        The deviation of the speed of the port [m/s or rad/s].
    """

    force: FloatArray
    speed: float


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
    deviations_by_port : mapping of int to PortDeviations
        The posterior standard deviations of each missing force and the speed of its port.
    """

    added_state: FloatArray
    forces: Mapping[int, FloatArray]
    unexplained_forces: Mapping[int, FloatArray]
    explained_state: FloatArray
    positions: FloatArray
    speeds: FloatArray
    deviations_by_port: Mapping[int, PortDeviations]

    @property
    def law_forces(self) -> dict[int, FloatArray]:
        """The forces (F,) of the laws of the hypothesis, by port."""
        return {
            port: force - self.unexplained_forces.get(port, 0.0)
            for port, force in self.forces.items()
        }


EffectColumn = Sequence[TrialColumn]
"""The column of an effect: the change of each trial, in order, for a unit of the effect's
unknown."""


class UnknownColumn(NamedTuple):
    """The change of a trial by one unknown.

    Attributes
    ----------
    change : TrialColumn
        The change for a unit of the unknown.
    zero_value : float
        The value of the unknown at which nothing is changed: that about which the trial is linear.
    """

    change: TrialColumn
    zero_value: float


class SmoothedTrials(NamedTuple):
    """The unknowns and the motion of all trials, given all readings.

    Attributes
    ----------
    solution : Solution
        The shared unknowns, then those of effects.
    local : list of (L,) array
        The unknowns of each trial alone.
    motions : list of TrialMotion
        The motion of each trial, with its missing forces.
    """

    solution: Solution
    local: list[FloatArray]
    motions: list[TrialMotion]


def sum_of_columns(columns: Sequence[EffectColumn], factors: Sequence[float]) -> EffectColumn:
    """Multiply each column by its factor, and return the sum of the products for each trial."""
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
    """The trials in motion, linear in all unknowns, with the columns of a hypothesis' effects.

    Attributes
    ----------
    trials : sequence of PortedTrial
        The trials in motion, each as a linear system with ports.
    shared_precision : (K,) ndarray
        The prior precisions of the shared unknowns.
    motions : sequence of TrialMotion
        The motion of each trial along which the columns of laws and parameters are computed; empty
        before any motion has been estimated.
    effect_columns : sequence of EffectColumn
        The columns of effects; each is multiplied by one more unknown.
    effect_precision : sequence of float
        The prior precisions of these unknowns.
    constant_column : EffectColumn or None
        The change of the trials by the effects at zero unknowns; None without effects.
    model_laws_column : EffectColumn or None
        The change of the trials by the model's own laws at ports, which its linear system does not
        contain; None if it has no such laws.
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
        """The prior precisions of the shared unknowns, then those of the effect parameters."""
        return np.concatenate((self.shared_precision, self.effect_precision))

    @cached_property
    def columns_by_unknown(self) -> list[dict[int, UnknownColumn]]:
        """The columns of parameters, gains and effects in each trial, by the number of the unknown.

        The columns of parameters and gains contain only the change of the added state; that of the
        model's response is in `PortedTrial.shared_derivatives`.
        """
        # without a motion (no entry in `motions`) nothing is added that parameters could change
        columns_by_trial = [
            _columns_along_motion(trial, motion)
            for trial, motion in zip(self.trials, self.motions, strict=False)
        ]
        columns_by_trial += [{} for _ in range(len(self.trials) - len(columns_by_trial))]
        for unknown_index, column in enumerate(
            self.effect_columns, start=len(self.shared_precision)
        ):
            for change, columns in zip(column, columns_by_trial, strict=True):
                columns[unknown_index] = UnknownColumn(change, 0.0)
        return columns_by_trial

    @cached_property
    def regression_rows(self) -> list[FloatArray]:
        """The residual of each trial and its derivatives by all unknowns (1 + K + L, N, C).

        Row 0 is the residual at zero unknowns. The K shared unknowns and those of effects follow,
        then the L unknowns of the trial alone. All are divided by the noise deviations.
        """
        rows_by_trial = []
        first_local = 1 + len(self.prior_precision)
        for trial_index, trial in enumerate(self.trials):
            row_count = first_local + len(trial.local_derivatives)
            # the rows of one reading lie side by side in memory, as the filter needs them
            rows = np.moveaxis(np.zeros((*trial.residual.shape, row_count)), -1, 0)
            # changes without an unknown are subtracted from the residual
            readings_without_unknown = [
                column[trial_index].readings
                for column in (self.constant_column, self.model_laws_column)
                if column is not None
            ]
            rows[0] = trial.residual - sum(readings_without_unknown)
            rows[1 : 1 + len(trial.shared_derivatives)] = trial.shared_derivatives
            rows[first_local:] = trial.local_derivatives
            for unknown_index, (change, zero_value) in self.columns_by_unknown[trial_index].items():
                rows[1 + unknown_index] += change.readings
                # the change is proportional to (unknown - zero_value): refer the residual to an
                # unknown of zero
                rows[0] += zero_value * change.readings
            rows_by_trial.append(rows)
        return rows_by_trial

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
            The prior medians of size and time of each missing force, by the number of its port.
        initial_processes : mapping of int to Process
            The missing forces to begin with.
        skip_grid : bool
            Whether Newton's method begins at `initial_processes` itself. Otherwise it begins at the
            best point of a grid of sizes and times around `initial_processes`.
        most_steps : int
            The largest number of steps of Newton's method.
        """

        def log_evidence(processes: Processes) -> float:
            return self.log_evidence_with_prior(median_processes, processes)

        search = ProcessSearch.within_prior(
            log_evidence, median_processes, initial_processes, self.correlation_time_range
        )
        return search.most_probable(from_grid=not skip_grid, most_steps=most_steps)

    @cached_property
    def correlation_time_range(self) -> tuple[float, float]:
        """The bounds of a correlation time [s]: shortest sampling interval, longest record."""
        return correlation_time_range(self.trials)

    def log_evidence_with_prior(self, median_processes: Processes, processes: Processes) -> float:
        """Return the log of evidence times prior of missing forces [nat].

        Parameters
        ----------
        median_processes : mapping of int to Process
            The prior medians of the missing forces, by the number of the port.
        processes : mapping of int to Process
            The missing forces as random processes, by the numbers of their ports.
        """
        return self.solve(processes).log_evidence + prior_log_density(median_processes, processes)

    def smooth(
        self, processes: Processes, fixed_solution: Solution | None = None
    ) -> SmoothedTrials:
        """Return unknowns, motions and missing forces given all readings.

        Parameters
        ----------
        processes : mapping of int to Process
            The missing forces, by the number of the port.
        fixed_solution : Solution, optional
            The values of the shared unknowns and of the effect parameters; by default the most
            probable values.
        """
        solution = fixed_solution or self.solve(processes)
        local_of_trials = []
        motions = []
        for trial_index, force_filter in enumerate(self.force_filters(processes)):
            rows = self.regression_rows[trial_index]
            unexplained_readings = rows[0] - np.tensordot(
                solution.mean, rows[1 : 1 + len(solution.mean)], 1
            )
            local_values = _most_probable_local_unknowns(force_filter, unexplained_readings)
            unexplained_readings = unexplained_readings - np.tensordot(
                local_values, force_filter.trial.local_derivatives, 1
            )
            smoothed_forces = force_filter.smooth(unexplained_readings)
            motions.append(
                self._trial_motion(trial_index, processes, smoothed_forces, solution, local_values)
            )
            local_of_trials.append(local_values)
        return SmoothedTrials(solution, local_of_trials, motions)

    def _trial_motion(
        self,
        trial_index: int,
        processes: Processes,
        smoothed_forces: SmoothedForces,
        solution: Solution,
        local_values: FloatArray,
    ) -> TrialMotion:
        """Return the motion of a trial: the model's, and what forces, unknowns and laws add to it.

        Parameters
        ----------
        trial_index : int
            The index of the trial.
        processes : mapping of int to Process
            The missing forces, by the number of the port.
        smoothed_forces : SmoothedForces
            The missing forces in time, and the state that they add.
        solution : Solution
            The shared unknowns and those of effects.
        local_values : (L,) array
            The unknowns of the trial alone.
        """
        trial = self.trials[trial_index]
        missing_forces = dict(zip(processes, smoothed_forces.forces, strict=True))
        # only state and forces are summed; the readings of this sum are not used
        no_readings = np.zeros_like(trial.residual)
        hypothesis_change = TrialColumn(no_readings, smoothed_forces.added_state, missing_forces)
        for unknown_index, (change, zero_value) in self.columns_by_unknown[trial_index].items():
            unknown_change = float(solution.mean[unknown_index] - zero_value)
            hypothesis_change = hypothesis_change.plus(change, unknown_change)
        if self.constant_column is not None:
            hypothesis_change = hypothesis_change.plus(self.constant_column[trial_index], 1.0)
        # the model's own laws move the trial, but are not among the forces that the model lacks
        change_with_model_laws = hypothesis_change
        if self.model_laws_column is not None:
            change_with_model_laws = change_with_model_laws.plus(
                self.model_laws_column[trial_index], 1.0
            )
        added_state = change_with_model_laws.added_state
        assert added_state is not None
        unknowns = np.concatenate((solution.mean[: len(self.shared_precision)], local_values))
        positions, speeds = trial.port_motion(unknowns, added_state)
        deviations = {}
        for port, force, speed in zip(
            processes,
            smoothed_forces.force_deviations,
            smoothed_forces.speed_deviations,
            strict=True,
        ):
            # The last samples have few later readings, so that their deviations are larger: take
            # that of the sample `INFORMING_SAMPLES` before the end for the whole record.
            deviations[port] = PortDeviations(force, float(speed[-INFORMING_SAMPLES:][0]))
        return TrialMotion(
            added_state=added_state,
            forces=hypothesis_change.forces,
            unexplained_forces=missing_forces,
            explained_state=added_state - smoothed_forces.added_state,
            positions=positions,
            speeds=speeds,
            deviations_by_port=deviations,
        )


def _columns_along_motion(trial: PortedTrial, motion: TrialMotion) -> dict[int, UnknownColumn]:
    """Return the columns of parameters and gains along a motion, by the number of the unknown."""
    columns = {}
    # calibrated parameters change the system, and with it the added state
    for unknown_index, derivative in enumerate(trial.system_derivatives):
        if derivative is not None:
            change = trial.change_by_system_parameter(derivative, motion.added_state, motion.forces)
            columns[unknown_index] = UnknownColumn(
                change, float(trial.linearisation_point[unknown_index])
            )
    # gains change the readings of their channel
    readings = trial.readings_of_state(motion.added_state, motion.forces)
    for unknown_index, channel, scale in trial.gain_unknowns:
        channel_mask = np.eye(readings.shape[1])[channel]
        change = TrialColumn(readings * scale * channel_mask)
        columns[unknown_index] = UnknownColumn(
            change, float(trial.linearisation_point[unknown_index])
        )
    return columns


def _most_probable_local_unknowns(force_filter: ForceFilter, residual: FloatArray) -> FloatArray:
    """Return the most probable values (L,) of the local unknowns of one trial.

    Local unknowns occur in one trial only, such as its initial state. All other unknowns are fixed.
    The values x solve the normal equations (D^T D + prior precision) x = D^T r. Here r is the
    whitened residual at x = 0, and D the whitened derivatives of the prediction by x.

    Parameters
    ----------
    force_filter : ForceFilter
        The filter of the trial. It whitens a record: it subtracts from each reading what the
        earlier readings predict, and divides the difference by its standard deviation.
    residual : (N, C) array
        The readings of N samples and C channels minus the prediction at x = 0, divided by the noise
        deviations.
    """
    trial = force_filter.trial
    residual_and_derivatives = np.concatenate((residual[None], trial.local_derivatives))
    # inner products (1 + L, 1 + L): the first row and column belong to the residual
    products, _ = force_filter.whitened_products(residual_and_derivatives)
    normal_matrix = products[1:, 1:]
    right_side = products[1:, 0]
    prior_precision = np.diag(np.maximum(trial.local_precision, LEAST_PRECISION))
    return np.linalg.solve(normal_matrix + prior_precision, right_side)
