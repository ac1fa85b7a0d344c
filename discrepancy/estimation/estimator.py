"""The joint estimate of trajectory, missing force and unknowns of a hypothesis, with its evidence.

The estimator is Gauss-Newton's method on the trajectory (see `gauss_newton`). It begins with a
large missing force, with which the trajectory follows the readings whatever the law is, and lowers
that force in steps (continuation). The missing force with the largest evidence is returned.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

from discrepancy.missing_force.filtered import Process

from .gauss_newton import (
    LEAST_RISE,
    MOST_ITERATIONS,
    EstimatorStart,
    GaussNewton,
    HypothesisLaws,
    Linearisation,
    MotionEstimate,
    start_from_estimate,
)

DEVIATION_FRACTIONS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001)
"""Standard deviations of the missing force that are tried in turn, divided by the one at the
start."""
SPEED_WINDOWS = (0.1, 0.02, 0.005)
"""Half widths of the window of speeds over which laws of the speed are averaged, divided by the rms
speed. The window becomes narrower from one estimate to the next, so that the jump of dry friction
is introduced gradually."""
NARROWEST_WINDOWS = (0.001, 0.0002)
"""Still narrower windows, which are tried after the missing force has been lowered. In a window a
body that sticks creeps; with a large missing force the narrow ones lead the iteration astray."""
MOST_PASSING_ITERATIONS = 8
"""Largest number of linearisations before the window of speeds is narrowed further, or the missing
force lowered further."""
MOST_LAST_ITERATIONS = 4
"""Largest number of linearisations where all values are nearly known."""
PATTERN_FACTORS = (3.0, 1.7, 1.3)
"""Factors on size and time of a missing force in the search for its most probable values, in
turn."""
COARSE_FACTORS = (3.0,)
"""These factors where the trials are linearised again, so that size and time will change."""
LAST_FACTORS = (2.5, 1.5)
"""These factors where size and time are nearly known; each is tried once."""
MOST_REPETITIONS = 4
"""Largest number of times in a row that one factor is tried, as long as the evidence rises."""
LARGEST_DECLINE = 12.0
"""Difference to the largest log evidence above which still smaller missing forces are not tried
[nat]."""


@dataclass(frozen=True, eq=False)
class MotionEstimator(GaussNewton):
    """The estimator of hypotheses on the same trials, with the most probable missing forces."""

    def estimate(self, laws: HypothesisLaws, start: EstimatorStart) -> MotionEstimate | None:
        """Return a hypothesis at its most probable values, from values that may be far from them.

        Parameters
        ----------
        laws : HypothesisLaws
            The laws and sensor errors of the hypothesis.
        start : EstimatorStart
            The values and trajectories to begin with.

        Returns
        -------
        MotionEstimate or None
            The estimate; None if the laws are not possible along the trajectories.
        """
        estimate = self.follow_to_small_forces(laws, start)
        return None if estimate is None else self.tune_processes(laws, estimate)

    def follow_to_small_forces(
        self, laws: HypothesisLaws, start: EstimatorStart
    ) -> MotionEstimate | None:
        """Return the estimate by continuation from large missing forces to small ones.

        With large missing forces the trajectory follows the readings whatever the laws. They are
        lowered step by step, and each estimate begins where the last one ended. Before that, laws
        of the speed are smoothed over wide windows of speeds, which are narrowed step by step.

        Parameters
        ----------
        laws : HypothesisLaws
            The laws and sensor errors of the hypothesis.
        start : EstimatorStart
            The values and trajectories to begin with.

        Returns
        -------
        MotionEstimate or None
            The estimate; None if the laws are not possible along the trajectories.
        """
        current_start = start
        # with wide windows of speeds first, so that a jump of a law does not stop the iteration
        for speed_window in SPEED_WINDOWS[:-1]:
            estimate = self.iterate(laws, current_start, speed_window, MOST_PASSING_ITERATIONS)
            if estimate is None:
                return None
            current_start = start_from_estimate(estimate)
        return self._estimate_with_smaller_forces(laws, current_start, SPEED_WINDOWS[-1])

    def estimate_nearby(self, laws: HypothesisLaws, start: EstimatorStart) -> MotionEstimate | None:
        """Return a hypothesis at its most probable values, from values that are near them.

        The missing forces at the start need not be large. The windows of speeds become as narrow as
        the evidence allows.

        Parameters
        ----------
        laws : HypothesisLaws
            The laws and sensor errors of the hypothesis.
        start : EstimatorStart
            The values and trajectories to begin with.

        Returns
        -------
        MotionEstimate or None
            The estimate; None if the laws are not possible along the trajectories.
        """
        estimate = self._estimate_with_smaller_forces(laws, start, SPEED_WINDOWS[-1])
        if estimate is None:
            return None
        estimate = self.tune_processes(laws, estimate, COARSE_FACTORS)
        return self.tune_processes(laws, self._narrow_windows(laws, estimate))

    def polish(
        self, laws: HypothesisLaws, start: EstimatorStart, speed_window: float
    ) -> MotionEstimate | None:
        """Return a hypothesis at its most probable values, from values that are nearly these.

        The search for the most probable missing forces is short.

        Parameters
        ----------
        laws : HypothesisLaws
            The laws and sensor errors of the hypothesis.
        start : EstimatorStart
            The values, trajectories and missing forces to begin with.
        speed_window : float
            The half width of the window of speeds, see `LawArguments`.

        Returns
        -------
        MotionEstimate or None
            The estimate; None if the laws are not possible along the trajectories.
        """
        estimate = self.iterate(laws, start, speed_window, MOST_LAST_ITERATIONS)
        if estimate is None:
            return None
        return self.tune_processes(
            laws, estimate, LAST_FACTORS, repetitions=1, most_iterations=MOST_LAST_ITERATIONS
        )

    def _narrow_windows(self, laws: HypothesisLaws, estimate: MotionEstimate) -> MotionEstimate:
        """Return the estimate with the narrowest window of speeds that makes it more probable.

        With a narrower window a body that sticks creeps less, so that a smaller missing force may
        be the more probable one. It is lowered again with each window.

        Parameters
        ----------
        laws : HypothesisLaws
            The laws and sensor errors of the hypothesis.
        estimate : MotionEstimate
            The estimate with a wider window.
        """
        for speed_window in NARROWEST_WINDOWS:
            narrower_estimate = self._estimate_with_smaller_forces(
                laws, start_from_estimate(estimate), speed_window
            )
            if (
                narrower_estimate is None
                or narrower_estimate.log_evidence < estimate.log_evidence + LEAST_RISE
            ):
                break
            estimate = narrower_estimate
        return estimate

    def _estimate_with_smaller_forces(
        self, laws: HypothesisLaws, start: EstimatorStart, speed_window: float
    ) -> MotionEstimate | None:
        """Return the most probable of several estimates with smaller and smaller missing forces.

        This is a continuation. With a large missing force the trajectory follows the readings
        whatever the laws are. Then the standard deviation of the missing force is lowered, to each
        of `DEVIATION_FRACTIONS` times its value at the start. Each estimate begins with the
        unknowns and the trajectories of the previous one.

        Parameters
        ----------
        laws : HypothesisLaws
            The laws and sensor errors of the hypothesis.
        start : EstimatorStart
            The unknowns, trajectories and missing forces of the first estimate.
        speed_window : float
            The half width of the window of speeds, see `LawArguments`.

        Returns
        -------
        MotionEstimate or None
            The estimate; None if there is none even with the first missing force.
        """
        best_estimate: MotionEstimate | None = None
        current_start = start
        for fraction in DEVIATION_FRACTIONS:
            # each fraction is of the missing force at the start, not of the previous one
            processes = {
                port: replace(process, standard_deviation=fraction * process.standard_deviation)
                for port, process in start.processes.items()
            }
            estimate = self.iterate(
                laws,
                replace(current_start, processes=processes),
                speed_window,
                MOST_PASSING_ITERATIONS,
            )
            if estimate is None:
                break
            if best_estimate is None or estimate.log_evidence > best_estimate.log_evidence:
                best_estimate = estimate
            # smaller forces will hardly raise an evidence this far below the best one above it
            elif estimate.log_evidence < best_estimate.log_evidence - LARGEST_DECLINE:
                break
            current_start = start_from_estimate(estimate)
        return best_estimate

    def tune_processes(
        self,
        laws: HypothesisLaws,
        estimate: MotionEstimate,
        factors: Sequence[float] = PATTERN_FACTORS,
        repetitions: int = MOST_REPETITIONS,
        most_iterations: int = MOST_ITERATIONS,
    ) -> MotionEstimate:
        """Return an estimate with the most probable sizes and times of its missing forces.

        This is a pattern search with decreasing factors, in which the trials stay linear along one
        trajectory. The result is then estimated anew, and returned if it is more probable.

        Parameters
        ----------
        laws : HypothesisLaws
            The laws and sensor errors of the hypothesis.
        estimate : MotionEstimate
            The estimate with the present sizes and times.
        factors : sequence of float
            The factors on size and time that are tried in turn.
        repetitions : int
            The largest number of times in a row that one factor is tried.
        most_iterations : int
            The largest number of linearisations of the last estimate.
        """
        start = start_from_estimate(estimate)
        linearisation = self.linearise(laws, start, estimate.speed_window)
        if linearisation is None:
            return estimate
        processes = dict(start.processes)
        first_evidence = self.evidence_with_processes(linearisation, processes)
        largest_evidence = first_evidence
        for factor in factors:
            for _ in range(repetitions):
                last_evidence = largest_evidence
                processes, largest_evidence = self._try_factor(
                    linearisation, processes, largest_evidence, factor
                )
                if largest_evidence < last_evidence + LEAST_RISE:
                    break
        if largest_evidence < first_evidence + LEAST_RISE:
            return estimate
        tuned_estimate = self.iterate(
            laws, replace(start, processes=processes), estimate.speed_window, most_iterations
        )
        if tuned_estimate is None or tuned_estimate.log_evidence <= estimate.log_evidence:
            return estimate
        return tuned_estimate

    def _try_factor(
        self,
        linearisation: Linearisation,
        processes: dict[int, Process],
        largest_evidence: float,
        factor: float,
    ) -> tuple[dict[int, Process], float]:
        """Multiply each size and time of missing forces by a factor if that is more probable.

        Parameters
        ----------
        linearisation : Linearisation
            All trials, linear about the present estimate.
        processes : dict of int to Process
            The missing forces, by the number of the port.
        largest_evidence : float
            Their log evidence [nat].
        factor : float
            The factor; each size and time is multiplied by the factor, or else by its inverse.

        Returns
        -------
        processes : dict of int to Process
            The more probable missing forces.
        log_evidence : float
            Their log evidence [nat].
        """
        shortest_time, longest_time = self.correlation_time_range
        for port, quantity in product(tuple(processes), ("standard_deviation", "correlation_time")):
            # the first of a larger and a smaller value that is more probable is kept
            for ratio in (factor, 1.0 / factor):
                value = ratio * getattr(processes[port], quantity)
                # a force that stays the same throughout the records is a constant, not a process
                if quantity == "correlation_time" and not shortest_time <= value <= longest_time:
                    continue
                changed_processes = processes | {
                    port: replace(processes[port], **{quantity: value})
                }
                evidence = self.evidence_with_processes(linearisation, changed_processes)
                if evidence > largest_evidence:
                    processes, largest_evidence = changed_processes, evidence
                    break
        return processes, largest_evidence
