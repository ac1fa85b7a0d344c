"""The missing forces of all trials: their processes, their courses, and the motion beside them."""

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
"""Samples after which more of them tell nothing of a moment."""


@dataclass(frozen=True, eq=False)
class TrialMotion:
    """What was in a trial, at the fine stamps.

    Attributes
    ----------
    added : (F, n) ndarray
        State that it adds to the model's own.
    forces : mapping of int to (F,) ndarray
        The missing force of each port, laws of the hypothesis included.
    left : mapping of int to (F,) ndarray
        The part of it that no law of the hypothesis explains.
    explained : (F, n) ndarray
        State that parameters and laws add: without what is left.
    positions, speeds : (F, P) ndarray
        The motion of the ports [m or rad, and per s].
    deviations : mapping of int to ((N,) ndarray, float)
        How well missing forces are known at the samples, and the speeds of their ports.
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
        """Forces of the hypothesis (F,) by port."""
        return {port: force - self.left.get(port, 0.0) for port, force in self.forces.items()}


EffectColumn = Sequence[TrialColumn]
"""An effect, by trial."""


def combined(columns: Sequence[EffectColumn], factors: Sequence[float]) -> EffectColumn:
    """Return the sum of columns, each taken a number of times."""
    first_column, *other_columns = columns
    total = [
        TrialColumn(np.zeros_like(part.readings)).plus(part, factors[0]) for part in first_column
    ]
    for column, factor in zip(other_columns, factors[1:], strict=True):
        total = [part.plus(added, factor) for part, added in zip(total, column, strict=True)]
    return total


@dataclass(frozen=True, eq=False)
class View:
    """Trials with what may act in them.

    Attributes
    ----------
    trials : sequence of SeenTrial
        The trials in motion.
    shared_precision : (K,) ndarray
        Prior precision of the shared unknowns.
    motions : sequence of TrialMotion
        The motion of each trial along which laws and parameters act; empty for that of the model.
    effects : sequence of EffectColumn
        The columns of effects that act in proportion to one more unknown each.
    precision : sequence of float
        Prior precision of these unknowns.
    known : EffectColumn or None
        The column of what the hypothesis has beside them, without an unknown.
    own : EffectColumn or None
        The column of the model's own laws beside its linear system.
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
        """Prior precision of all unknowns, those of the effects last."""
        return np.concatenate((self.shared_precision, self.precision))

    @cached_property
    def parts(self) -> list[dict[int, tuple[TrialColumn, float]]]:
        """What a unit of unknowns, by number, does along the motion, and which values are in it.

        By trial.
        """
        by_trial: list[dict[int, tuple[TrialColumn, float]]] = [{} for _ in self.trials]
        for trial, motion, parts in zip(self.trials, self.motions, by_trial, strict=False):
            # calibrated parameters change the system along the motion
            for unknown, slope in enumerate(trial.slopes):
                if slope is not None:
                    part = trial.turned(slope, motion.added, motion.forces)
                    parts[unknown] = (part, float(trial.about[unknown]))
            # gains change the readings of their channel
            readings = trial.readings(motion.added, motion.forces)
            for unknown, channel, scale in trial.gains:
                part = TrialColumn(readings * scale * np.eye(readings.shape[1])[channel])
                parts[unknown] = (part, float(trial.about[unknown]))
        for unknown, effect in enumerate(self.effects, start=len(self.shared_precision)):
            for part, parts in zip(effect, by_trial, strict=True):
                parts[unknown] = (part, 0.0)
        return by_trial

    @cached_property
    def rows(self) -> list[FloatArray]:
        """The residuals and their derivatives by all unknowns (1 + K + L, N, C), by trial."""
        by_trial = []
        first_local = 1 + len(self.precisions)
        for number, trial in enumerate(self.trials):
            row_count = first_local + len(trial.local)
            rows = np.moveaxis(np.zeros((*trial.residual.shape, row_count)), -1, 0)
            acting = [
                column[number].readings for column in (self.known, self.own) if column is not None
            ]
            rows[0] = trial.residual - sum(acting)
            rows[1 : 1 + len(trial.shared)] = trial.shared
            rows[first_local:] = trial.local
            for unknown, (part, value) in self.parts[number].items():
                rows[1 + unknown] += part.readings
                rows[0] += value * part.readings
            by_trial.append(rows)
        return by_trial

    def filtered(self, processes: Processes) -> list[ForceFilter]:
        """Return the filters of missing forces."""
        return [ForceFilter(trial, tuple(processes.items())) for trial in self.trials]

    def products(self, processes: Processes) -> Regression:
        """Return the products of all columns beside missing forces."""
        return regression(self.filtered(processes), self.rows)

    def solve(self, processes: Processes) -> Solution:
        """Return evidence and values of all unknowns beside missing forces."""
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
        """Return the processes of the largest evidence times their prior, and its logarithm [nat].

        Parameters
        ----------
        median : mapping of int to Process
            Medians of the prior.
        begin : mapping of int to Process
            Processes to begin with; the search begins at the best of a grid around them.
        near : bool
            Whether the search begins at `begin` itself.
        most_steps : int
            Steps of Newton's method, at most.
        """

        def log_evidence(processes: Processes) -> float:
            return self.evidence(median, processes)

        search = ProcessSearch.around(log_evidence, median, begin, self.times)
        return search.most_probable(from_grid=not near, most_steps=most_steps)

    @cached_property
    def times(self) -> tuple[float, float]:
        """Shortest and longest correlation time [s]: that of a sample, and that of a record."""
        stamps = [trial.time for trial in self.trials]
        return min(float(np.median(np.diff(t))) for t in stamps), max(
            float(t[-1] - t[0]) for t in stamps
        )

    def evidence(self, median: Processes, processes: Processes) -> float:
        """Return the logarithm of the evidence of processes times their prior [nat]."""
        return self.solve(processes).evidence + prior_log_density(median, processes)

    def smoothed(
        self, processes: Processes, given: Solution | None = None
    ) -> tuple[Solution, list[FloatArray], list[TrialMotion]]:
        """Return unknowns, motions and missing forces given all readings.

        The unknowns of the trials are returned apart from the shared ones.
        """
        solution = given or self.solve(processes)
        local_values, motions = [], []
        for number, filtered in enumerate(self.filtered(processes)):
            rows = self.rows[number]
            unexplained = rows[0] - np.tensordot(solution.mean, rows[1 : 1 + len(solution.mean)], 1)
            local = _local_unknowns(filtered, unexplained)
            unexplained = unexplained - np.tensordot(local, filtered.trial.local, 1)
            motions.append(
                self._motion(number, processes, filtered.smoothed(unexplained), solution, local)
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
        """Return the motion of a trial, with what unknowns, hypothesis and model add to it."""
        trial = self.trials[number]
        missing = dict(zip(processes, smoothed.forces, strict=True))
        unused_readings = np.zeros_like(trial.residual)
        acting = TrialColumn(unused_readings, smoothed.state, missing)
        for unknown, (part, value) in self.parts[number].items():
            acting = acting.plus(part, float(solution.mean[unknown] - value))
        if self.known is not None:
            acting = acting.plus(self.known[number], 1.0)
        with_own_laws = acting if self.own is None else acting.plus(self.own[number], 1.0)
        added = with_own_laws.added
        assert added is not None
        unknowns = np.concatenate((solution.mean[: len(self.shared_precision)], local))
        positions, speeds = trial.port_motion(unknowns, added)
        force_deviations, speed_deviations = np.split(smoothed.deviations, 2)
        deviations = {
            port: (force, float(speed[-LATER:][0]))
            for port, force, speed in zip(
                processes, force_deviations, speed_deviations, strict=True
            )
        }
        return TrialMotion(
            added=added,
            forces=acting.forces,
            left=missing,
            explained=added - smoothed.state,
            positions=positions,
            speeds=speeds,
            deviations=deviations,
        )


def _local_unknowns(filtered: ForceFilter, unexplained: FloatArray) -> FloatArray:
    """Return the unknowns (L,) of a trial alone that explain most of its residuals (N, C)."""
    trial = filtered.trial
    products, _ = filtered.products(np.concatenate((unexplained[None], trial.local)))
    prior = np.diag(np.maximum(trial.local_precision, LEAST_PRECISION))
    return np.linalg.solve(products[1:, 1:] + prior, products[1:, 0])
