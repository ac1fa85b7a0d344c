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
    Smoothed,
    Solution,
    regression,
)
from .process_search import MOST_STEPS, Processes, ProcessSearch, prior_log_density
from .trial import SeenTrial, TrialColumn

LATER = 200
"""Number of samples after a moment by which its smoothed state is as well known as by any more of
them."""


@dataclass(frozen=True, eq=False)
class TrialMotion:
    """The estimated motion of a trial with all forces at ports, at the fine stamps.

    Attributes
    ----------
    added : (F, n) ndarray
        The state that all forces and parameters add to the response of the model.
    forces : mapping of int to (F,) ndarray
        The force at each port that the model lacks, laws of the hypothesis included, by the number
        of the port [N, N m or the port's flow].
    left : mapping of int to (F,) ndarray
        The part of `forces` that no law of the hypothesis explains.
    explained : (F, n) ndarray
        The part of `added` that parameters and laws explain.
    positions, speeds : (F, P) ndarray
        The motion of the ports [m or rad, and per s].
    deviations : mapping of int to ((N,) ndarray, float)
        The posterior standard deviations of the missing force at the samples, and of the speed of
        its port.
    """

    added: FloatArray
    forces: Mapping[int, FloatArray]
    left: Mapping[int, FloatArray]
    explained: FloatArray
    positions: FloatArray
    speeds: FloatArray
    deviations: Mapping[int, tuple[FloatArray, float]]

    @property
    def laws(self) -> dict[int, FloatArray]:
        """The forces (F,) of the laws of the hypothesis, by port."""
        return {port: force - self.left.get(port, 0.0) for port, force in self.forces.items()}


EffectColumn = Sequence[TrialColumn]
"""The column of an effect: its change of each trial for a unit of its unknown."""


def combined(columns: Sequence[EffectColumn], factors: Sequence[float]) -> EffectColumn:
    """Return the sum of columns, each multiplied by its factor."""
    first_column, *other_columns = columns
    total = [
        TrialColumn(np.zeros_like(part.readings)).plus(part, factors[0]) for part in first_column
    ]
    for column, factor in zip(other_columns, factors[1:], strict=True):
        total = [part.plus(change, factor) for part, change in zip(total, column, strict=True)]
    return total


@dataclass(frozen=True, eq=False)
class View:
    """The trials, linear in all unknowns, with the columns of what may act in them.

    Attributes
    ----------
    trials : sequence of SeenTrial
        The trials in motion.
    shared_precision : (K,) ndarray
        The prior precisions of the shared unknowns.
    motions : sequence of TrialMotion
        The motion of each trial along which laws and parameters act; empty for that of the model.
    effects : sequence of EffectColumn
        The columns of effects, each with one more unknown.
    precision : sequence of float
        The prior precisions of these unknowns.
    known : EffectColumn or None
        The part of the hypothesis that has no unknown.
    own : EffectColumn or None
        The forces of the model's own laws, which its linear system does not contain.
    """

    trials: Sequence[SeenTrial]
    shared_precision: FloatArray
    motions: Sequence[TrialMotion] = ()
    effects: Sequence[EffectColumn] = ()
    precision: Sequence[float] = ()
    known: EffectColumn | None = None
    own: EffectColumn | None = None

    @cached_property
    def precisions(self) -> FloatArray:
        """The prior precisions of all unknowns: the shared ones, then those of the effects."""
        return np.concatenate((self.shared_precision, self.precision))

    @cached_property
    def parts(self) -> list[dict[int, tuple[TrialColumn, float]]]:
        """The change of each trial for a unit of each unknown, by the number of the unknown.

        Beside each change stands the value of the unknown at which the change is zero: that about
        which the trial is linear.
        """
        by_trial: list[dict[int, tuple[TrialColumn, float]]] = [{} for _ in self.trials]
        for trial, motion, changes in zip(self.trials, self.motions, by_trial, strict=False):
            # calibrated parameters change the system, and with it the added state
            for unknown, slope in enumerate(trial.slopes):
                if slope is not None:
                    change = trial.turned(slope, motion.added, motion.forces)
                    changes[unknown] = (change, float(trial.about[unknown]))
            # gains change the readings of their channel
            readings = trial.readings(motion.added, motion.forces)
            for unknown, channel, scale in trial.gains:
                change = TrialColumn(readings * scale * np.eye(readings.shape[1])[channel])
                changes[unknown] = (change, float(trial.about[unknown]))
        for unknown, column in enumerate(self.effects, start=len(self.shared_precision)):
            for change, changes in zip(column, by_trial, strict=True):
                changes[unknown] = (change, 0.0)
        return by_trial

    @cached_property
    def rows(self) -> list[FloatArray]:
        """The residual of each trial and its derivatives by all unknowns (1 + K + L, N, C).

        Row 0 is the residual at zero unknowns. The K shared unknowns and those of effects follow,
        then the L unknowns of the trial alone. All are divided by the noise deviations.
        """
        by_trial = []
        first_local = 1 + len(self.precisions)
        for number, trial in enumerate(self.trials):
            row_count = first_local + len(trial.local)
            rows = np.moveaxis(np.zeros((*trial.residual.shape, row_count)), -1, 0)
            forces_without_unknown = [
                column[number].readings for column in (self.known, self.own) if column is not None
            ]
            rows[0] = trial.residual - sum(forces_without_unknown)
            rows[1 : 1 + len(trial.shared)] = trial.shared
            rows[first_local:] = trial.local
            for unknown, (change, value) in self.parts[number].items():
                rows[1 + unknown] += change.readings
                # the change is proportional to (unknown - value): refer the residual to zero
                rows[0] += value * change.readings
            by_trial.append(rows)
        return by_trial

    def filtered(self, processes: Processes) -> list[ForceFilter]:
        """Return the Kalman filter of each trial with given missing forces."""
        return [ForceFilter(trial, tuple(processes.items())) for trial in self.trials]

    def products(self, processes: Processes) -> Regression:
        """Return the normal equations of all unknowns, given the missing forces."""
        return regression(self.filtered(processes), self.rows)

    def solve(self, processes: Processes) -> Solution:
        """Return log evidence and values of all unknowns, given the missing forces."""
        return self.products(processes).solve(range(len(self.precisions)), self.precisions)

    @np.errstate(invalid="ignore")
    def most_probable(
        self,
        median: Processes,
        begin: Processes,
        *,
        near: bool = False,
        most_steps: int = MOST_STEPS,
    ) -> tuple[dict[int, Process], float]:
        """Return the most probable missing forces, and the log of evidence times prior there [nat].

        Parameters
        ----------
        median : mapping of int to Process
            The prior medians of size and time of each missing force, by the number of its port.
        begin : mapping of int to Process
            The missing forces to begin with.
        near : bool
            Whether Newton's method begins at `begin` itself. Otherwise it begins at the best point
            of a grid of sizes and times around `begin`.
        most_steps : int
            The largest number of steps of Newton's method.
        """

        def log_evidence(processes: Processes) -> float:
            return self.evidence(median, processes)

        search = ProcessSearch.around(log_evidence, median, begin, self.times)
        return search.most_probable(from_grid=not near, most_steps=most_steps)

    @cached_property
    def times(self) -> tuple[float, float]:
        """The bounds of a correlation time [s]: shortest sampling interval, longest record."""
        stamps = [trial.time for trial in self.trials]
        return min(float(np.median(np.diff(time))) for time in stamps), max(
            float(time[-1] - time[0]) for time in stamps
        )

    def evidence(self, median: Processes, processes: Processes) -> float:
        """Return the log of evidence times prior of missing forces [nat].

        Parameters
        ----------
        median : mapping of int to Process
            The prior medians of the missing forces, by the number of the port.
        processes : mapping of int to Process
            The missing forces.
        """
        return self.solve(processes).evidence + prior_log_density(median, processes)

    def smoothed(
        self, processes: Processes, given: Solution | None = None
    ) -> tuple[Solution, list[FloatArray], list[TrialMotion]]:
        """Return unknowns, motions and missing forces given all readings.

        Parameters
        ----------
        processes : mapping of int to Process
            The missing forces, by the number of the port.
        given : Solution, optional
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
        solution = given or self.solve(processes)
        local_values, motions = [], []
        for number, trial_filter in enumerate(self.filtered(processes)):
            rows = self.rows[number]
            unexplained = rows[0] - np.tensordot(solution.mean, rows[1 : 1 + len(solution.mean)], 1)
            local = _local_unknowns(trial_filter, unexplained)
            unexplained = unexplained - np.tensordot(local, trial_filter.trial.local, 1)
            motions.append(
                self._motion(number, processes, trial_filter.smoothed(unexplained), solution, local)
            )
            local_values.append(local)
        return solution, local_values, motions

    def _motion(
        self,
        number: int,
        processes: Processes,
        smoothed: Smoothed,
        solution: Solution,
        local: FloatArray,
    ) -> TrialMotion:
        """Return the motion of a trial with all that missing forces, unknowns and laws add to it.

        Parameters
        ----------
        number : int
            The index of the trial.
        processes : mapping of int to Process
            The missing forces, by the number of the port.
        smoothed : Smoothed
            Their courses, and the state that they add.
        solution : Solution
            The shared unknowns and those of effects.
        local : (L,) array
            The unknowns of the trial alone.
        """
        trial = self.trials[number]
        missing_forces = dict(zip(processes, smoothed.forces, strict=True))
        unused_readings = np.zeros_like(trial.residual)
        total_change = TrialColumn(unused_readings, smoothed.state, missing_forces)
        for unknown, (change, value) in self.parts[number].items():
            total_change = total_change.plus(change, float(solution.mean[unknown] - value))
        if self.known is not None:
            total_change = total_change.plus(self.known[number], 1.0)
        with_own_laws = (
            total_change if self.own is None else total_change.plus(self.own[number], 1.0)
        )
        added = with_own_laws.added
        assert added is not None
        unknowns = np.concatenate((solution.mean[: len(self.shared_precision)], local))
        positions, speeds = trial.port_motion(unknowns, added)
        force_deviations, speed_deviations = np.split(smoothed.deviations, 2)
        # the deviation of a speed is taken so long before the end that later readings inform on it
        deviations = {
            port: (force, float(speed[-LATER:][0]))
            for port, force, speed in zip(
                processes, force_deviations, speed_deviations, strict=True
            )
        }
        return TrialMotion(
            added=added,
            forces=total_change.forces,
            left=missing_forces,
            explained=added - smoothed.state,
            positions=positions,
            speeds=speeds,
            deviations=deviations,
        )


def _local_unknowns(filtered: ForceFilter, unexplained: FloatArray) -> FloatArray:
    """Return the most probable unknowns (L,) of a trial alone, given all others.

    Parameters
    ----------
    filtered : ForceFilter
        The filter of the trial.
    unexplained : (N, C) array
        The residuals at the values of the other unknowns.
    """
    trial = filtered.trial
    products, _ = filtered.products(np.concatenate((unexplained[None], trial.local)))
    prior_precision = np.diag(np.maximum(trial.local_precision, LEAST_PRECISION))
    return np.linalg.solve(products[1:, 1:] + prior_precision, products[1:, 0])
