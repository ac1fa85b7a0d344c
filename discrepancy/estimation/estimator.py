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
SHARES = (1.0, 0.5, 0.25, 0.125, 0.0625)
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
        Of shared unknowns and those of effects.
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
        for item in self.trials:
            products, own_half = item.products
            kept, kept_half = without(products, np.asarray(own_half), item.trial.local_precision)
            total += kept
            half += float(kept_half)
        solution = Regression(total, half).solve(range(len(self.precision)), self.precision)
        return solution, [self._local(item, solution.mean) for item in self.trials]

    def beside(self, processes: Mapping[int, Process]) -> "Linearisation":
        """Return the same with other missing forces."""
        trials = tuple(replace(item, processes=processes) for item in self.trials)
        return Linearisation(trials, self.precision)

    def _local(self, item: LinearisedTrial, known: FloatArray) -> FloatArray:
        """Return the unknowns (L,) of a trial, given the others."""
        products, _ = item.products
        first = 1 + len(known)
        precision = np.maximum(item.trial.local_precision, LEAST_PRECISION)
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
        Of each trial.
    processes : mapping of int to Process
        Missing forces, large enough that the trajectory follows the readings.
    """

    effect: FloatArray
    shared: FloatArray
    trajectories: tuple[Trajectory, ...]
    processes: Mapping[int, Process]


def following(found: MotionEstimate) -> EstimatorStart:
    """Return the start of an estimate that begins where another one ended."""
    return EstimatorStart(
        found.effect,
        found.shared,
        tuple(item.trajectory for item in found.trials),
        found.processes,
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
            Of the hypothesis.
        start : EstimatorStart
            Where to begin.
        """
        current = start
        for smoothing in SMOOTHINGS[:-1]:
            found = self._iterated(laws, current, smoothing)
            if found is None:
                return None
            current = following(found)
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
            current = following(estimate)
        return best

    def _tuned(self, laws: HypothesisLaws, found: MotionEstimate) -> MotionEstimate:
        """Return an estimate with size and time of its missing forces at the most probable values.

        A pattern search by ever smaller factors; the trials stay linear along one trajectory
        meanwhile.
        """
        at = following(found)
        linear = self.linearised(laws, at, SMOOTHINGS[-1])
        if linear is None:
            return found
        processes = dict(at.processes)
        top = self._evidence_beside(linear, processes)
        for factor in FACTORS:
            for port, name in product(tuple(processes), ("size", "time")):
                for change in (factor, 1.0 / factor):
                    value = change * getattr(processes[port], name)
                    tried = processes | {port: replace(processes[port], **{name: value})}
                    evidence = self._evidence_beside(linear, tried)
                    if evidence > top:
                        processes, top = tried, evidence
                        break
        again = self._iterated(laws, replace(at, processes=processes), SMOOTHINGS[-1])
        return again if again is not None and again.log_evidence > found.log_evidence else found

    def _iterated(
        self, laws: HypothesisLaws, start: EstimatorStart, smoothing: float
    ) -> MotionEstimate | None:
        """Return the estimate beside given missing forces, by Gauss-Newton steps."""
        current, last_evidence = start, -inf
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
                item.smoothed(np.concatenate((unknowns, own)))
                for item, own in zip(linear.trials, local, strict=True)
            )
            evidence = solution.evidence + self._log_prior(start.processes)
            before = np.concatenate((current.shared, current.effect))
            deviations = np.sqrt(np.diag(solution.covariance))
            moved = float(np.max(np.abs(unknowns - before) / deviations, initial=0.0))
            settled = moved < SETTLED and abs(evidence - last_evidence) < LEVEL
            estimate = MotionEstimate(
                effect=unknowns[count:],
                shared=unknowns[:count],
                local=tuple(local),
                covariance=solution.covariance,
                processes=start.processes,
                log_evidence=evidence,
                trials=smoothed,
                converged=settled,
            )
            last_evidence = evidence
            ahead = None if settled else self._stepped(laws, current, estimate, linear, smoothing)
            if ahead is None:
                return estimate
            current = ahead
        return estimate

    def _evidence_beside(self, linear: Linearisation, processes: Mapping[int, Process]) -> float:
        """Return the evidence of trials that stay as they are beside other missing forces [nat]."""
        solution, _ = linear.beside(processes).solve()
        return solution.evidence + self._log_prior(processes)

    def linearised(
        self, laws: HypothesisLaws, at: EstimatorStart, smoothing: float
    ) -> Linearisation | None:
        """Return all trials, linear along trajectories; None where the laws cannot be followed."""
        found = []
        for number, trial in enumerate(self.trials):
            along = laws.along(number, at.trajectories[number], at.effect, at.shared, smoothing)
            if along is None:
                return None
            forces, sensors = along
            found.append(
                LinearisedTrial(
                    trial,
                    at.processes,
                    at.trajectories[number],
                    forces,
                    sensors,
                    at.effect,
                    at.shared,
                )
            )
        precision = np.concatenate((self.shared_precision, np.ones(laws.size)))
        return Linearisation(tuple(found), precision)

    def _stepped(
        self,
        laws: HypothesisLaws,
        current: EstimatorStart,
        ahead: MotionEstimate,
        linear: Linearisation,
        smoothing: float,
    ) -> EstimatorStart | None:
        """Return the longest part of a step whose linear laws err by less than the missing force.

        Where a law is not what it was linearised to, the difference acts as a further missing force
        of which the smoother does not know. In no step is it larger than the missing force that the
        hypothesis admits.
        """
        change = ahead.effect - current.effect
        longest = float(np.max(np.abs(change), initial=0.0))
        most = min(1.0, LONGEST_STEP / longest) if longest > 0.0 else 1.0
        chosen: EstimatorStart | None = None
        for share in SHARES:
            part = min(share, most)
            there = EstimatorStart(
                current.effect + part * change,
                current.shared + part * (ahead.shared - current.shared),
                tuple(
                    trajectory.toward(smoothed.trajectory, part)
                    for trajectory, smoothed in zip(current.trajectories, ahead.trials, strict=True)
                ),
                current.processes,
            )
            error = self._error_of_laws(laws, current, there, linear, smoothing)
            if error is None:
                continue
            chosen = there
            if error <= 1.0:
                break
        return chosen

    def _error_of_laws(
        self,
        laws: HypothesisLaws,
        current: EstimatorStart,
        there: EstimatorStart,
        linear: Linearisation,
        smoothing: float,
    ) -> float | None:
        """Return the rms error of the linear laws over the deviation of the missing force."""
        worst = 0.0
        for number, item in enumerate(linear.trials):
            found = laws.forces(
                number, there.trajectories[number], there.effect, there.shared, smoothing
            )
            if found is None:
                return None
            change = np.concatenate((there.shared - current.shared, there.effect - current.effect))
            for port, forces in item.forces.items():
                position = (
                    there.trajectories[number].positions[:, port]
                    - item.trajectory.positions[:, port]
                )
                speed = there.trajectories[number].speeds[:, port] - item.trajectory.speeds[:, port]
                expected = forces.along.force + forces.along.by_position * position
                expected = expected + forces.along.by_speed * speed
                for unknown, slope in forces.by_unknown.items():
                    expected = expected + change[unknown] * slope
                error = float(np.sqrt(np.mean((found[port].force - expected) ** 2)))
                size = max(process.size for process in there.processes.values())
                worst = max(worst, error / size)
        return worst

    def _log_prior(self, processes: Mapping[int, Process]) -> float:
        """Return the logarithm of the prior of missing forces [nat], up to a constant."""
        return prior_log_density(self.usual, processes)
