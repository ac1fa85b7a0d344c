"""Trajectory, missing force and unknowns of a hypothesis, estimated together, with the evidence.

Gauss-Newton on the trajectory: the trials are made linear along the last trajectory, one filter and
one smoother give the next, until nothing moves. This is the iterated Kalman smoother (Bell 1994,
SIAM J. Optimization 4, 626-636; damped: Särkkä and Svensson 2020, ICASSP). It begins with a large
missing force, with which a trajectory follows the readings whatever the law, and lowers it step by
step (continuation). The innovations at the end give the evidence by Laplace's approximation, which
chooses how large the missing force is.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from math import inf
from typing import Protocol

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.missing_force.filtered import (
    LEAST_PRECISION,
    Process,
    Regression,
    Solution,
    without,
)
from discrepancy.missing_force.process_search import prior_log_density
from discrepancy.missing_force.trial import SeenTrial

from .laws import ForceAlong
from .linearised import Forces, LinearisedTrial, SensorReadings, SmoothedTrial, Trajectory

SHARES_OF_SIZE = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001)
"""Deviations of the missing force, over the first one, through which it is lowered."""
SMOOTHINGS = (0.1, 0.02, 0.005)
"""Half windows of speeds, over the usual speed, over which laws of speed are averaged: wide ones
first."""
ITERATIONS = 12
"""Linearisations at one size of the missing force, at most."""
SETTLED = 0.02
"""Step of the unknowns, in their standard deviations, below which nothing moves any more."""
LEVEL = 0.05
"""Change of the evidence [nat] below which nothing moves any more."""
STEP_FRACTIONS = (1.0, 0.5, 0.25, 0.125, 0.0625)
"""Parts of a step that are tried in turn."""
LONGEST_STEP = 2.0
"""Longest step of the unknown of an effect, in deviations of its prior."""
FACTORS = (3.0, 1.7, 1.3)
"""Of size and time of a missing force, by which the most probable ones are looked for."""
DECLINE = 12.0
"""Evidence [nat] below the best by which lower missing forces are given up."""


class HypothesisLaws(Protocol):
    """The laws and sensors of a hypothesis, as the estimator asks for them."""

    @property
    def size(self) -> int:
        """Number E of unknowns of its effects, each of standard normal prior."""

    def along(
        self,
        number: int,
        trajectory: Trajectory,
        effect: FloatArray,
        shared: FloatArray,
        smoothing: float,
    ) -> tuple[Mapping[int, Forces], SensorReadings] | None:
        """Return forces at ports and readings of a trial along a trajectory.

        None where they cannot be.
        """

    def forces(
        self,
        number: int,
        trajectory: Trajectory,
        effect: FloatArray,
        shared: FloatArray,
        smoothing: float,
    ) -> Mapping[int, ForceAlong] | None:
        """Return the forces at ports of a trial along a trajectory; None where they cannot be."""


@dataclass(frozen=True, eq=False)
class MotionEstimate:
    """A hypothesis at its most probable values.

    Attributes
    ----------
    effect : (E,) ndarray
        Unknowns of its effects, standard normal before the readings.
    shared : (K,) ndarray
        Unknowns of all trials.
    local : tuple of (L,) ndarray
        Unknowns of each trial.
    covariance : (K + E, K + E) ndarray
        The covariance of shared unknowns and effect parameters.
    processes : mapping of int to Process
        Missing forces beside its laws, by the numbers of their ports.
    log_evidence : float
        Logarithm of the evidence [nat], with the priors of the processes.
    trials : tuple of SmoothedTrial
        TrialMotion and missing forces of each trial.
    converged : bool
        Whether the last step was short enough.
    """

    effect: FloatArray
    shared: FloatArray
    local: tuple[FloatArray, ...]
    covariance: FloatArray
    processes: Mapping[int, Process]
    log_evidence: float
    trials: tuple[SmoothedTrial, ...]
    converged: bool


@dataclass(frozen=True, eq=False)
class Linearisation:
    """All trials, linear along their trajectories."""

    trials: tuple[LinearisedTrial, ...]
    precision: FloatArray

    def solve(self) -> tuple[Solution, list[FloatArray]]:
        """Return shared unknowns and those of effects, and the unknowns of each trial."""
        total = np.zeros((1 + len(self.precision),) * 2)
        half = 0.0
        for linear_trial in self.trials:
            products, half_of_trial = linear_trial.products
            local_precision = linear_trial.trial.local_precision
            without_local, half_without_local = without(
                products, np.asarray(half_of_trial), local_precision
            )
            total += without_local
            half += float(half_without_local)
        solution = Regression(total, half).solve(range(len(self.precision)), self.precision)
        return solution, [self._local(linear_trial, solution.mean) for linear_trial in self.trials]

    def beside(self, processes: Mapping[int, Process]) -> "Linearisation":
        """Return the same with other missing forces."""
        trials = tuple(replace(trial, processes=processes) for trial in self.trials)
        return Linearisation(trials, self.precision)

    def _local(self, linear_trial: LinearisedTrial, known: FloatArray) -> FloatArray:
        """Return the unknowns (L,) of a trial, given the others."""
        products, _ = linear_trial.products
        first = 1 + len(known)
        precision = np.maximum(linear_trial.trial.local_precision, LEAST_PRECISION)
        right = products[first:, 0] - products[first:, 1:first] @ known
        return np.linalg.solve(products[first:, first:] + np.diag(precision), right)


@dataclass(frozen=True, eq=False)
class EstimatorStart:
    """Where an estimate begins.

    Attributes
    ----------
    effect, shared : (E,), (K,) ndarray
        Unknowns.
    trajectories : tuple of Trajectory
        The trajectory of each trial.
    processes : mapping of int to Process
        Missing forces, large enough that the trajectory follows the readings.
    """

    effect: FloatArray
    shared: FloatArray
    trajectories: tuple[Trajectory, ...]
    processes: Mapping[int, Process]


def start_after(estimate: MotionEstimate) -> EstimatorStart:
    """Return the start of an estimate that begins where another one ended."""
    return EstimatorStart(
        estimate.effect,
        estimate.shared,
        tuple(smoothed.trajectory for smoothed in estimate.trials),
        estimate.processes,
    )


@dataclass(frozen=True, eq=False)
class MotionEstimator:
    """Estimates hypotheses on the same trials.

    Attributes
    ----------
    trials : tuple of SeenTrial
        Dynamic trials.
    shared_precision : (K,) ndarray
        Prior precision of the shared unknowns.
    usual : mapping of int to Process
        Medians of the priors of missing forces, by port.
    """

    trials: tuple[SeenTrial, ...]
    shared_precision: FloatArray
    usual: Mapping[int, Process]

    def estimate(self, laws: HypothesisLaws, start: EstimatorStart) -> MotionEstimate | None:
        """Return a hypothesis at its most probable values; None where its laws cannot be followed.

        Parameters
        ----------
        laws : HypothesisLaws
            The laws and sensors of the hypothesis.
        start : EstimatorStart
            The values and trajectories to begin with.
        """
        current = start
        for smoothing in SMOOTHINGS[:-1]:
            smoothed = self._iterated(laws, current, smoothing)
            if smoothed is None:
                return None
            current = start_after(smoothed)
        estimate = self._with_smaller_missing_forces(laws, current)
        return None if estimate is None else self._tuned(laws, estimate)

    def _with_smaller_missing_forces(
        self, laws: HypothesisLaws, start: EstimatorStart
    ) -> MotionEstimate | None:
        """Return the estimate with the most probable of several sizes of the missing force.

        With a large missing force the trajectory follows the readings whatever the laws are. The
        size is then lowered step by step, and each estimate begins where the last one ended. None
        if the laws cannot be followed even at the first size.
        """
        best: MotionEstimate | None = None
        current = start
        for fraction in SHARES_OF_SIZE:
            processes = {
                port: replace(process, size=fraction * process.size)
                for port, process in start.processes.items()
            }
            estimate = self._iterated(laws, replace(current, processes=processes), SMOOTHINGS[-1])
            if estimate is None:
                break
            if best is None or estimate.log_evidence > best.log_evidence:
                best = estimate
            elif estimate.log_evidence < best.log_evidence - DECLINE:
                break
            current = start_after(estimate)
        return best

    def _tuned(self, laws: HypothesisLaws, estimate: MotionEstimate) -> MotionEstimate:
        """Return an estimate with size and time of its missing forces at the most probable values.

        A pattern search by ever smaller factors; the trials stay linear along one trajectory
        meanwhile.
        """
        start = start_after(estimate)
        linear = self.linearised(laws, start, SMOOTHINGS[-1])
        if linear is None:
            return estimate
        processes = dict(start.processes)
        top = self._evidence_beside(linear, processes)
        for factor in FACTORS:
            for port, name in product(tuple(processes), ("size", "time")):
                for change in (factor, 1.0 / factor):
                    value = change * getattr(processes[port], name)
                    changed = processes | {port: replace(processes[port], **{name: value})}
                    evidence = self._evidence_beside(linear, changed)
                    if evidence > top:
                        processes, top = changed, evidence
                        break
        tuned = self._iterated(laws, replace(start, processes=processes), SMOOTHINGS[-1])
        return (
            tuned if tuned is not None and tuned.log_evidence > estimate.log_evidence else estimate
        )

    def _iterated(
        self, laws: HypothesisLaws, start: EstimatorStart, smoothing: float
    ) -> MotionEstimate | None:
        """Return the estimate beside given missing forces, by Gauss-Newton steps."""
        current = start
        last_evidence = -inf
        estimate: MotionEstimate | None = None
        for _ in range(ITERATIONS):
            linear = self.linearised(laws, current, smoothing)
            if linear is None:
                return estimate
            solution, local = linear.solve()
            if not np.isfinite(solution.evidence):
                return estimate
            count = len(self.shared_precision)
            unknowns = solution.mean
            smoothed = tuple(
                trial.smoothed(np.concatenate((unknowns, local_unknowns)))
                for trial, local_unknowns in zip(linear.trials, local, strict=True)
            )
            evidence = solution.evidence + self._log_prior(start.processes)
            last_unknowns = np.concatenate((current.shared, current.effect))
            deviations = np.sqrt(np.diag(solution.covariance))
            largest_move = float(np.max(np.abs(unknowns - last_unknowns) / deviations, initial=0.0))
            is_settled = largest_move < SETTLED and abs(evidence - last_evidence) < LEVEL
            estimate = MotionEstimate(
                effect=unknowns[count:],
                shared=unknowns[:count],
                local=tuple(local),
                covariance=solution.covariance,
                processes=start.processes,
                log_evidence=evidence,
                trials=smoothed,
                converged=is_settled,
            )
            last_evidence = evidence
            next_start = (
                None if is_settled else self._stepped(laws, current, estimate, linear, smoothing)
            )
            if next_start is None:
                return estimate
            current = next_start
        return estimate

    def _evidence_beside(self, linear: Linearisation, processes: Mapping[int, Process]) -> float:
        """Return the evidence of trials that stay as they are beside other missing forces [nat]."""
        solution, _ = linear.beside(processes).solve()
        return solution.evidence + self._log_prior(processes)

    def linearised(
        self, laws: HypothesisLaws, start: EstimatorStart, smoothing: float
    ) -> Linearisation | None:
        """Return all trials, linear along trajectories; None where the laws cannot be followed."""
        linear_trials = []
        for number, trial in enumerate(self.trials):
            forces_and_sensors = laws.along(
                number, start.trajectories[number], start.effect, start.shared, smoothing
            )
            if forces_and_sensors is None:
                return None
            forces, sensors = forces_and_sensors
            linear_trials.append(
                LinearisedTrial(
                    trial,
                    start.processes,
                    start.trajectories[number],
                    forces,
                    sensors,
                    start.effect,
                    start.shared,
                )
            )
        precision = np.concatenate((self.shared_precision, np.ones(laws.size)))
        return Linearisation(tuple(linear_trials), precision)

    def _stepped(
        self,
        laws: HypothesisLaws,
        current: EstimatorStart,
        estimate: MotionEstimate,
        linear: Linearisation,
        smoothing: float,
    ) -> EstimatorStart | None:
        """Return the longest part of a step whose linear laws err by less than the missing force.

        Where a law is not what it was linearised to, the difference acts as a further missing force
        of which the smoother does not know. In no step is it larger than the missing force that the
        hypothesis admits.
        """
        change = estimate.effect - current.effect
        longest = float(np.max(np.abs(change), initial=0.0))
        most = min(1.0, LONGEST_STEP / longest) if longest > 0.0 else 1.0
        chosen: EstimatorStart | None = None
        for fraction in STEP_FRACTIONS:
            taken = min(fraction, most)
            stepped = EstimatorStart(
                current.effect + taken * change,
                current.shared + taken * (estimate.shared - current.shared),
                tuple(
                    trajectory.toward(smoothed.trajectory, taken)
                    for trajectory, smoothed in zip(
                        current.trajectories, estimate.trials, strict=True
                    )
                ),
                current.processes,
            )
            error = self._error_of_laws(laws, current, stepped, linear, smoothing)
            if error is None:
                continue
            chosen = stepped
            if error <= 1.0:
                break
        return chosen

    def _error_of_laws(
        self,
        laws: HypothesisLaws,
        current: EstimatorStart,
        stepped: EstimatorStart,
        linear: Linearisation,
        smoothing: float,
    ) -> float | None:
        """Return the rms error of the linear laws over the deviation of the missing force."""
        worst = 0.0
        for number, trial in enumerate(linear.trials):
            forces_after = laws.forces(
                number, stepped.trajectories[number], stepped.effect, stepped.shared, smoothing
            )
            if forces_after is None:
                return None
            change = np.concatenate(
                (stepped.shared - current.shared, stepped.effect - current.effect)
            )
            for port, forces in trial.forces.items():
                position = (
                    stepped.trajectories[number].positions[:, port]
                    - trial.trajectory.positions[:, port]
                )
                speed = (
                    stepped.trajectories[number].speeds[:, port] - trial.trajectory.speeds[:, port]
                )
                expected = forces.along.force + forces.along.by_position * position
                expected = expected + forces.along.by_speed * speed
                for unknown, slope in forces.by_unknown.items():
                    expected = expected + change[unknown] * slope
                error = float(np.sqrt(np.mean((forces_after[port].force - expected) ** 2)))
                size = max(process.size for process in stepped.processes.values())
                worst = max(worst, error / size)
        return worst

    def _log_prior(self, processes: Mapping[int, Process]) -> float:
        """Return the logarithm of the prior of missing forces [nat], up to a constant."""
        return prior_log_density(self.usual, processes)
