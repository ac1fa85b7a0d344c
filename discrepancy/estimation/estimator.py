"""The joint estimate of trajectory, missing force and unknowns of a hypothesis, with its evidence.

The estimator is Gauss-Newton's method on the trajectory (see `gauss_newton`). It begins with a
large missing force, with which the trajectory follows the readings whatever the law is, and lowers
that force in steps (continuation). It also begins with a small missing force at the motion that the
laws alone give. The estimate with the largest evidence is returned.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import inf, sqrt

from discrepancy.trials_in_motion.effects import EffectLaws

from .estimate import Estimate
from .force_states import Process
from .gauss_newton import (
    LEAST_RISE,
    MOST_ITERATIONS,
    EstimatorStart,
    GaussNewton,
    start_from_estimate,
)
from .linearisation import Linearisation
from .process_search import Processes, scale_processes

DEVIATION_FRACTIONS = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03, 0.015, 0.007, 0.003, 0.001)
"""Standard deviations of the missing force that are tried in turn, over the one at the start."""
USUAL_WINDOW = 0.005
"""Half width of the window of speeds over which laws of the speed are averaged, divided by the rms
speed."""
FIRST_WINDOWS = (0.5, 0.02)
"""First half widths of this window for a law that holds a body at rest, such as dry friction. The
window becomes narrower together with the missing force. While the missing force is large, a narrow
window leads the iteration astray. In a wide one a body that sticks creeps, which only a missing
force can prevent. Which first width is better depends on the record, so both are tried."""
NARROWEST_WINDOW = 2e-4
"""Narrowest half width of this window."""
WINDOW_AT_REST = 1e-5
"""Half width of this window along the motion of the laws alone."""
MOST_FOLLOWED_FORCES = 4
"""Largest number of missing forces that are tried along the motion of the laws alone."""
SMALL_FRACTION = 0.03
"""Standard deviation of the missing force with which an estimate along the motion of the laws alone
begins, over that without any law."""
LARGEST_RATIO_BESIDE_LAWS = 0.5
"""Standard deviation of the missing force beside laws, over that without any law, above which the
laws do not explain the motion."""
FOLLOWED_RATIO = 0.1
"""This ratio above which the motion of the laws alone is not tried: without the missing force it is
too far from the readings."""
ROUGH_FRACTIONS = (1.0, 0.3, 0.1, 0.03, 0.01)
"""Standard deviations of the missing force that are tried in a rough estimate, over the one at the
start."""
MOST_ROUGH_ITERATIONS = 3
"""Largest number of linearisations at each of them."""
MOST_PASSING_ITERATIONS = 8
"""Largest number of linearisations before the missing force is lowered further."""
MOST_LAST_ITERATIONS = 4
"""Largest number of linearisations where all values are nearly known."""
PATTERN_FACTORS = (3.0, 1.7, 1.3)
"""Factors on amplitude and correlation time of a missing force that are tried in turn."""
COARSE_FACTORS = (3.0,)
"""These factors if the trials are linearised again later, so that both values will change."""
LAST_FACTORS = (2.5, 1.5)
"""These factors if both values are nearly known; each factor is tried once."""
MOST_REPETITIONS = 4
"""Largest number of times in a row that one factor is tried, as long as the evidence rises."""
LARGEST_DECLINE, MOST_DECLINES = 12.0, 2
"""Difference to the largest log evidence that counts as a decline [nat], and the number of declines
in a row after which still smaller missing forces are not tried."""


@dataclass(frozen=True, eq=False)
class MotionEstimator:
    """The estimator of hypotheses on the same trials, with the most probable missing forces.

    Attributes
    ----------
    gauss_newton : GaussNewton
        The iteration under given missing forces.
    processes_without_effects : mapping of int to Process
        The missing forces without any effect, by the index of the port.
    """

    gauss_newton: GaussNewton
    processes_without_effects: Processes

    @property
    def small_processes(self) -> dict[int, Process]:
        """The missing forces with which an estimate along the motion of the laws alone begins."""
        return scale_processes(self.processes_without_effects, SMALL_FRACTION, 1.0)

    def missing_force_ratio(self, estimate: Estimate) -> float:
        """Return the missing forces over those without effects, all ports together.

        Forces at different ports are divided by their prior medians, and their variances added: at
        a port where nothing is missing, the ratio of two small forces says nothing.
        """
        return self._size_of_forces(estimate.processes) / self._size_of_forces(
            self.processes_without_effects
        )

    def _size_of_forces(self, processes: Processes) -> float:
        """Return the root of the sum of squares of forces, each over its prior median."""
        medians = self.gauss_newton.prior_medians
        return sqrt(
            sum(
                (process.standard_deviation / medians[port].standard_deviation) ** 2
                for port, process in processes.items()
            )
        )

    def estimate_from_far(self, laws: EffectLaws, start: EstimatorStart) -> Estimate | None:
        """Return a hypothesis at its most probable values, from values that may be far from them.

        Parameters
        ----------
        start : EstimatorStart
            The values and trajectories to begin with, and large missing forces.

        Returns
        -------
        Estimate or None
            The estimate; None if the laws are not possible along the trajectories.
        """
        windows = FIRST_WINDOWS if laws.hold_at_rest else (USUAL_WINDOW,)
        estimates = []
        for speed_window in windows:
            estimate = self._estimate_with_smaller_forces(laws, start, speed_window)
            if estimate is not None:
                estimates.append(estimate)
        if not estimates:
            return None
        best_estimate = max(estimates, key=lambda estimate: estimate.log_evidence)
        return self.tune_processes(laws, best_estimate, COARSE_FACTORS)

    def estimate_roughly(
        self,
        laws: EffectLaws,
        start: EstimatorStart,
        small_processes: Processes,
        *,
        has_large_forces: bool,
    ) -> Estimate | None:
        """Return an estimate for a first comparison, after few steps.

        One estimate is made with the small missing forces that may remain beside the effects. If a
        force is missing without the last effect, or if this estimate fails, others are made with
        the missing forces of `start`, which are lowered in steps.

        Parameters
        ----------
        start : EstimatorStart
            The values and trajectories to begin with, and the missing forces without the last
            effect.
        small_processes : mapping of int to Process
            The small missing forces, by the index of the port.
        has_large_forces : bool
            Whether a force is missing without the last effect.

        Returns
        -------
        Estimate or None
            The most probable estimate; None if the laws are not possible along the trajectories.
        """
        # small missing forces need a narrow window, and large ones a wide one
        narrow_window = NARROWEST_WINDOW if laws.hold_at_rest else USUAL_WINDOW
        best_estimate = self.gauss_newton.iterate(
            laws, replace(start, processes=small_processes), narrow_window, MOST_ROUGH_ITERATIONS
        )
        if best_estimate is not None and not has_large_forces:
            return best_estimate
        window = FIRST_WINDOWS[-1] if laws.hold_at_rest else USUAL_WINDOW
        current_start = start
        largest_evidence = -inf
        for fraction in ROUGH_FRACTIONS:
            processes = scale_processes(start.processes, fraction, 1.0)
            estimate = self.gauss_newton.iterate(
                laws, replace(current_start, processes=processes), window, MOST_ROUGH_ITERATIONS
            )
            if estimate is None or estimate.log_evidence < largest_evidence - LARGEST_DECLINE:
                break
            largest_evidence = max(estimate.log_evidence, largest_evidence)
            if best_estimate is None or estimate.log_evidence > best_estimate.log_evidence:
                best_estimate = estimate
            current_start = start_from_estimate(estimate)
        return best_estimate

    def estimate_nearby(
        self, laws: EffectLaws, start: EstimatorStart, speed_window: float
    ) -> Estimate | None:
        """Return a hypothesis at its most probable values, from values that are near them.

        If little force is missing beside it, it is also estimated along the motion of its laws.

        Parameters
        ----------
        start : EstimatorStart
            The values and trajectories to begin with. The missing forces need not be large.
        speed_window : float
            The half width of the window of speeds to begin with, see `LawArguments`.

        Returns
        -------
        Estimate or None
            The estimate; None if the laws are not possible along the trajectories.
        """
        estimate = self._estimate_with_smaller_forces(laws, start, speed_window)
        if estimate is None:
            return self.follow_laws(laws, replace(start, processes=self.small_processes))
        tuned_estimate = self.tune_processes(laws, estimate)
        if self.missing_force_ratio(tuned_estimate) > FOLLOWED_RATIO:
            return tuned_estimate
        next_start = replace(start_from_estimate(tuned_estimate), processes=self.small_processes)
        return _more_probable(tuned_estimate, self.follow_laws(laws, next_start))

    def follow_laws(self, laws: EffectLaws, start: EstimatorStart) -> Estimate | None:
        """Return an estimate along the motion of the laws alone, with small missing forces.

        The missing forces and the motion are estimated in turn, as long as the evidence rises.

        Parameters
        ----------
        start : EstimatorStart
            The unknowns to begin with, and small missing forces.

        Returns
        -------
        Estimate or None
            The estimate; None if the laws are not possible.
        """
        best_estimate: Estimate | None = None
        for _ in range(MOST_FOLLOWED_FORCES):
            estimate = self.estimate_along_laws(laws, start)
            if estimate is None or _more_probable(best_estimate, estimate) is best_estimate:
                break
            best_estimate = estimate
            processes, rise = self._more_probable_processes(
                estimate.linearisation, estimate.processes
            )
            if rise < LEAST_RISE:
                break
            start = replace(start_from_estimate(estimate), processes=processes)
        return best_estimate

    def estimate_along_laws(self, laws: EffectLaws, start: EstimatorStart) -> Estimate | None:
        """Return an estimate along the motion of the laws alone, with given missing forces.

        The result is None if the laws are not possible.
        """
        speed_window = WINDOW_AT_REST if laws.hold_at_rest else USUAL_WINDOW
        return self.gauss_newton.iterate_along_laws(laws, start, speed_window)

    def polish(
        self,
        laws: EffectLaws,
        start: EstimatorStart,
        speed_window: float,
        *,
        may_follow_laws: bool = True,
    ) -> Estimate | None:
        """Return a hypothesis at its most probable values, from values that are nearly these.

        It is first estimated along the motion of its laws, and returned if that leaves no force.
        Otherwise it is also estimated along the given trajectories, with a short search for the
        most probable missing forces, and the more probable of both estimates is returned.

        Parameters
        ----------
        start : EstimatorStart
            The values, trajectories and missing forces to begin with.
        speed_window : float
            The half width of the window of speeds, see `LawArguments`.
        may_follow_laws : bool
            Whether an estimate along the motion of the laws alone is made, too.

        Returns
        -------
        Estimate or None
            The estimate; None if the laws are not possible along the trajectories.
        """
        followed_estimate = self.follow_laws(laws, start) if may_follow_laws else None
        if followed_estimate is not None and followed_estimate.leaves_no_force:
            return followed_estimate
        smallest_window = NARROWEST_WINDOW if laws.hold_at_rest else USUAL_WINDOW
        estimate = self.gauss_newton.iterate(
            laws, start, max(speed_window, smallest_window), MOST_LAST_ITERATIONS
        )
        if estimate is None:
            return followed_estimate
        tuned_estimate = self.tune_processes(
            laws, estimate, LAST_FACTORS, repetitions=1, most_iterations=MOST_LAST_ITERATIONS
        )
        return _more_probable(tuned_estimate, followed_estimate)

    def _estimate_with_smaller_forces(
        self, laws: EffectLaws, start: EstimatorStart, speed_window: float
    ) -> Estimate | None:
        """Return the most probable of several estimates with smaller and smaller missing forces.

        This is a continuation. With a large missing force the trajectory follows the readings
        whatever the laws are. Then the standard deviation of the missing force is lowered, to each
        of `DEVIATION_FRACTIONS` times its value at the start. Each estimate begins with the
        unknowns and the trajectories of the previous one. If a law holds a body at rest, the window
        of speeds becomes narrower by the same factor.

        Parameters
        ----------
        start : EstimatorStart
            The unknowns, trajectories and missing forces of the first estimate.
        speed_window : float
            The half width of the first window of speeds, see `LawArguments`.

        Returns
        -------
        Estimate or None
            The estimate; None if there is none even with the first missing force.
        """
        best_estimate: Estimate | None = None
        current_start = start
        decline_count = 0
        for fraction in DEVIATION_FRACTIONS:
            # each fraction is of the missing force at the start, not of the previous one
            processes = scale_processes(start.processes, fraction, 1.0)
            window = speed_window
            if laws.hold_at_rest:
                window = max(fraction * speed_window, NARROWEST_WINDOW)
            estimate = self.gauss_newton.iterate(
                laws, replace(current_start, processes=processes), window, MOST_PASSING_ITERATIONS
            )
            if estimate is None:
                break
            # with smaller forces the evidence will hardly rise again from this far below the best
            if (
                best_estimate is not None
                and estimate.log_evidence < best_estimate.log_evidence - LARGEST_DECLINE
            ):
                decline_count += 1
                if decline_count == MOST_DECLINES:
                    break
            else:
                decline_count = 0
            if best_estimate is None or estimate.log_evidence > best_estimate.log_evidence:
                best_estimate = estimate
            current_start = start_from_estimate(estimate)
        return best_estimate

    def tune_processes(
        self,
        laws: EffectLaws,
        estimate: Estimate,
        factors: Sequence[float] = PATTERN_FACTORS,
        repetitions: int = MOST_REPETITIONS,
        most_iterations: int = MOST_ITERATIONS,
    ) -> Estimate:
        """Return an estimate with more probable amplitudes and times of its missing forces.

        They are searched in trials that stay linear along one trajectory. The hypothesis is then
        estimated anew with them. The given estimate is returned if that is not more probable.

        Parameters
        ----------
        factors : sequence of float
            The factors on amplitude and correlation time that are tried in turn.
        repetitions : int
            The largest number of times in a row that one factor is tried.
        most_iterations : int
            The largest number of linearisations of the last estimate.
        """
        start = start_from_estimate(estimate)
        linearisation = self.gauss_newton.linearise(laws, start, estimate.speed_window)
        if linearisation is None:
            return estimate
        processes, rise = self._more_probable_processes(
            linearisation, start.processes, factors, repetitions
        )
        if rise < LEAST_RISE:
            return estimate
        tuned_estimate = self.gauss_newton.iterate(
            laws, replace(start, processes=processes), estimate.speed_window, most_iterations
        )
        if tuned_estimate is None or tuned_estimate.log_evidence <= estimate.log_evidence:
            return estimate
        return tuned_estimate

    def _more_probable_processes(
        self,
        linearisation: Linearisation,
        first_processes: Processes,
        factors: Sequence[float] = PATTERN_FACTORS,
        repetitions: int = MOST_REPETITIONS,
    ) -> tuple[dict[int, Process], float]:
        """Return more probable missing forces in linear trials, and the rise of the log evidence.

        This is a pattern search with decreasing factors on amplitudes and correlation times. Each
        factor is tried `repetitions` times at most, as long as the evidence rises.
        """
        processes = dict(first_processes)
        first_evidence = self.gauss_newton.log_evidence(linearisation, processes)
        largest_evidence = first_evidence
        for factor in factors:
            for _ in range(repetitions):
                last_evidence = largest_evidence
                processes, largest_evidence = self._try_factor(
                    linearisation, processes, largest_evidence, factor
                )
                if largest_evidence < last_evidence + LEAST_RISE:
                    break
        return processes, largest_evidence - first_evidence

    def _try_factor(
        self,
        linearisation: Linearisation,
        processes: dict[int, Process],
        largest_evidence: float,
        factor: float,
    ) -> tuple[dict[int, Process], float]:
        """Return missing forces after trying a factor on each amplitude and correlation time.

        Each of them is multiplied by the factor, or else by its inverse, if that raises the log
        evidence, which is `largest_evidence` before. The log evidence is returned, too.
        """
        shortest_time, longest_time = linearisation.correlation_time_range
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
                evidence = self.gauss_newton.log_evidence(linearisation, changed_processes)
                if evidence > largest_evidence:
                    processes, largest_evidence = changed_processes, evidence
                    break
        return processes, largest_evidence


def _more_probable(estimate: Estimate | None, other_estimate: Estimate | None) -> Estimate | None:
    """Return the more probable of two estimates, or the only one; the first if they are equal."""
    if estimate is None or other_estimate is None:
        return estimate or other_estimate
    return max(estimate, other_estimate, key=lambda either: either.log_evidence)
