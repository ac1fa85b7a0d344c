"""Gauss-Newton's method for the motion, the missing force and the unknowns of a hypothesis.

The trials are linearised along the last trajectory, and a filter and a smoother give the next one,
until nothing changes. This is the iterated Kalman smoother (Bell 1994, SIAM J. Optimization 4,
626-636; damped: Särkkä and Svensson 2020, ICASSP). Where little force is missing, the trials are
linearised along the motion that the laws alone give (shooting). The innovations at the end give the
evidence by Laplace's approximation.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import Candidate
from discrepancy.trials_in_motion.effects import EffectLaws
from discrepancy.trials_in_motion.trajectory import LawArguments, Trajectory
from discrepancy.trials_in_motion.trial_at_rest import LinearTrial

from .estimate import Estimate
from .linear_about_trajectory import Simulation
from .linearisation import Linearisation, linearised
from .process_search import Processes, prior_log_density
from .regression import Priors

MOST_ITERATIONS = 12
"""Largest number of linearisations at one amplitude of the missing force."""
CONVERGED_STEP = 0.02
"""Step of an unknown, in posterior standard deviations, below which the iteration has converged."""
CONVERGED_EVIDENCE = 0.05
"""Change of the log evidence below which the iteration has converged [nat]."""
LEAST_RISE, MOST_STAGNANT_ITERATIONS = 0.5, 2
"""Rise of the log evidence that counts as progress [nat], and the number of iterations in a row
without progress after which the iteration ends."""
STEP_FRACTIONS = (1.0, 0.5, 0.25, 0.125, 0.0625)
"""Fractions of a step that are tried in turn."""
SHORTEST_FRACTION = 0.1
"""Fraction of a step below which an iteration along the motion of laws ends."""
LONGEST_STEP = 2.0
"""Longest step of the unknown of an effect, in prior standard deviations."""


@dataclass(frozen=True, eq=False)
class EstimatorStart:
    """The values and trajectories with which an estimate begins.

    Attributes
    ----------
    effect, shared : (E,), (K,) ndarray
        The unknowns of effects, and those that all trials share.
    local : tuple of (L,) ndarray
        The unknowns of each trial alone.
    trajectories : tuple of Trajectory
        The trajectory of each trial.
    processes : mapping of int to Process
        The missing forces: large enough for the trajectories to follow the readings with any laws,
        or small if the estimate is along the motion of the laws alone.
    """

    effect: FloatArray
    shared: FloatArray
    local: tuple[FloatArray, ...]
    trajectories: tuple[Trajectory, ...]
    processes: Processes

    def law_arguments(self, trial_index: int, speed_window: float) -> LawArguments:
        """Return the arguments of the laws in a trial; `speed_window` as in `LawArguments`."""
        return LawArguments(
            trial_index, self.trajectories[trial_index], self.effect, self.shared, speed_window
        )


def start_from_estimate(estimate: Estimate) -> EstimatorStart:
    """Return the start of an estimate that continues from the result of another one."""
    return EstimatorStart(
        estimate.effect,
        estimate.shared,
        estimate.local,
        tuple(smoothed_trial.trajectory for smoothed_trial in estimate.trials),
        estimate.processes,
    )


def linearise_trials(
    laws: EffectLaws,
    trials: Sequence[LinearTrial],
    start: EstimatorStart,
    speed_window: float,
    shared_priors: Priors,
) -> Linearisation | None:
    """Return all trials with the laws of a hypothesis, linearised along trajectories.

    Parameters
    ----------
    start : EstimatorStart
        The trajectories and the values of unknowns.
    speed_window : float
        The half width of the window of speeds over which laws of the speed are averaged, divided by
        the rms speed.

    Returns
    -------
    Linearisation or None
        The linear trials; None if the laws are not possible in one of them.
    """
    linear_trials = []
    for trial_index, trial in enumerate(trials):
        arguments = start.law_arguments(trial_index, speed_window)
        forces_and_sensor_errors = laws.linearise_along_trajectory(arguments)
        if forces_and_sensor_errors is None:
            return None
        forces, sensor_errors = forces_and_sensor_errors
        linear_trial = linearised(
            trial,
            start.trajectories[trial_index],
            forces=forces,
            sensor_errors=sensor_errors,
            effect=start.effect,
            shared=start.shared,
        )
        linear_trials.append(linear_trial)
    # the unknowns of effects have standard normal priors, of precision one
    effect_priors = Priors.without_ranges(np.ones(laws.candidate.parameter_count))
    return Linearisation(tuple(linear_trials), shared_priors.followed_by(effect_priors))


def linearise_along_laws(
    laws: EffectLaws,
    trials: Sequence[LinearTrial],
    start: EstimatorStart,
    speed_window: float,
    shared_priors: Priors,
) -> Linearisation | None:
    """Return all trials linearised along the motion that the laws of a hypothesis alone give them.

    Unless the record is thinned, a linear trial also gets the residuals of a simulation.

    Parameters
    ----------
    start : EstimatorStart
        The values of unknowns, and trajectories that begin in the same states.
    speed_window : float
        The half width of the window of speeds, see `LawArguments`.

    Returns
    -------
    Linearisation or None
        The linear trials; None if the laws are not possible in one of them.
    """
    trajectories = []
    simulations: list[Simulation | None] = []
    for trial_index, local_values in enumerate(start.local):
        arguments = start.law_arguments(trial_index, speed_window)
        trajectory = laws.motion_under_laws(arguments, local_values)
        if trajectory is None:
            return None
        trajectories.append(trajectory)
        if trials[trial_index].stride > 1:  # a rough comparison is enough for a thinned record
            simulations.append(None)
            continue
        residual = laws.residual_of_simulation(arguments, local_values)
        if residual is None:
            return None
        simulations.append(Simulation(local_values, residual))
    start_along_laws = replace(start, trajectories=tuple(trajectories))
    linearisation = linearise_trials(laws, trials, start_along_laws, speed_window, shared_priors)
    if linearisation is None:
        return None
    simulated_trials = [
        replace(trial, simulation=simulation)
        for trial, simulation in zip(linearisation.trials, simulations, strict=True)
    ]
    return replace(linearisation, trials=tuple(simulated_trials))


def _start_after_step(
    laws: EffectLaws, start: EstimatorStart, estimate: Estimate, fraction: float
) -> EstimatorStart:
    """Return the values and trajectories a fraction of the way from a start to an estimate.

    The fraction is reduced if an unknown of an effect would move by more than `LONGEST_STEP`.
    """
    change = estimate.effect - start.effect
    longest_change = float(np.max(np.abs(change), initial=0.0))
    if longest_change > LONGEST_STEP:
        fraction = min(fraction, LONGEST_STEP / longest_change)
    return EstimatorStart(
        effect=laws.candidate.within_range(start.effect + fraction * change),
        shared=start.shared + fraction * (estimate.shared - start.shared),
        local=tuple(
            before + fraction * (after - before)
            for before, after in zip(start.local, estimate.local, strict=True)
        ),
        trajectories=tuple(
            trajectory.interpolate(smoothed_trial.trajectory, fraction)
            for trajectory, smoothed_trial in zip(start.trajectories, estimate.trials, strict=True)
        ),
        processes=start.processes,
    )


def _at_start_of_step(estimate: Estimate, start: EstimatorStart) -> Estimate:
    """Return the estimate with the unknowns and the motion at the start of its step, not its end.

    The linear trials of the estimate were computed at this start.
    """
    shared_and_effect = np.concatenate((start.shared, start.effect))
    filtered_trials = estimate.linearisation.filter(start.processes)
    trials = tuple(
        filtered_trial.smooth(np.concatenate((shared_and_effect, local)))
        for filtered_trial, local in zip(filtered_trials, start.local, strict=True)
    )
    return replace(estimate, effect=start.effect, shared=start.shared, trials=trials)


@dataclass(frozen=True, eq=False)
class GaussNewton:
    """Gauss-Newton iterations of hypotheses on the same trials, under given missing forces.

    Attributes
    ----------
    trials : tuple of LinearTrial
        The dynamic trials as linear systems with ports.
    shared_priors : Priors
        The priors of the K shared unknowns.
    prior_medians : mapping of int to Process
        The prior medians of the missing forces, by the index of the port.
    """

    trials: tuple[LinearTrial, ...]
    shared_priors: Priors
    prior_medians: Processes

    def linearise(
        self, laws: EffectLaws, start: EstimatorStart, speed_window: float
    ) -> Linearisation | None:
        """Return `linearise_trials` of these trials."""
        return linearise_trials(laws, self.trials, start, speed_window, self.shared_priors)

    def log_evidence(self, linearisation: Linearisation, processes: Processes) -> float:
        """Return the log evidence of linear trials plus the log prior of missing forces [nat]."""
        return linearisation.log_evidence_with_prior(self.prior_medians, processes)

    @np.errstate(over="ignore", invalid="ignore")  # a motion that diverges is rejected
    def iterate(
        self,
        laws: EffectLaws,
        start: EstimatorStart,
        speed_window: float,
        most_iterations: int = MOST_ITERATIONS,
    ) -> Estimate | None:
        """Return the estimate under given missing forces, by damped Gauss-Newton steps.

        Parameters
        ----------
        start : EstimatorStart
            The values and trajectories to begin with, and the missing forces.
        speed_window : float
            The half width of the window of speeds over which laws of the speed are averaged,
            divided by the rms speed.
        most_iterations : int
            The largest number of linearisations.

        Returns
        -------
        Estimate or None
            The last estimate, converged or not; None if the laws are not possible along the first
            trajectories, or if the first evidence is not finite.
        """
        current_start = start
        last_evidence = -inf
        estimate: Estimate | None = None
        stagnant_iterations = 0
        largest_evidence = -inf
        for _ in range(most_iterations):
            linearisation = self.linearise(laws, current_start, speed_window)
            if linearisation is None:
                return estimate
            new_estimate = self._estimate_of_linearisation(
                laws.candidate, linearisation, current_start, last_evidence, speed_window
            )
            if new_estimate is None:
                return estimate
            estimate = new_estimate
            if estimate.log_evidence > largest_evidence + LEAST_RISE:
                stagnant_iterations = 0
            else:
                stagnant_iterations += 1
            largest_evidence = max(largest_evidence, estimate.log_evidence)
            if estimate.converged or stagnant_iterations == MOST_STAGNANT_ITERATIONS:
                return estimate
            last_evidence = estimate.log_evidence
            next_start = self._take_step(laws, current_start, estimate, linearisation, speed_window)
            if next_start is None:
                return estimate
            current_start = next_start
        return estimate

    @np.errstate(over="ignore", invalid="ignore")  # a motion that diverges is rejected
    def iterate_along_laws(
        self,
        laws: EffectLaws,
        start: EstimatorStart,
        speed_window: float,
        most_iterations: int = MOST_ITERATIONS,
    ) -> Estimate | None:
        """Return the estimate by damped Gauss-Newton steps along the motion of the laws alone.

        This is a shooting method: each trajectory is simulated with the unknowns of the last
        estimate. Laws with kinks, such as dry friction, are thus linearised along a motion that
        they cause themselves. The simulation leaves out missing forces, which must be small. If the
        evidence after a step is lower, half the step is tried from the best start so far; after a
        rise, the next step is a fraction at most twice as large.

        Parameters
        ----------
        start : EstimatorStart
            The unknowns to begin with, trajectories that begin in the same states, and the missing
            forces, which are small.
        speed_window : float
            The half width of the window of speeds, see `LawArguments`.
        most_iterations : int
            The largest number of simulations.

        Returns
        -------
        Estimate or None
            The most probable estimate, converged or not; None if the laws are not possible at the
            first unknowns, or if the first evidence is not finite.
        """
        best_estimate: Estimate | None = None
        best_start = start
        fraction = 1.0
        for _ in range(most_iterations):
            linearisation = linearise_along_laws(
                laws, self.trials, start, speed_window, self.shared_priors
            )
            if linearisation is None:
                break
            estimate = self._estimate_of_linearisation(
                laws.candidate, linearisation, start, -inf, speed_window
            )
            if estimate is None:
                break
            # The evidence is that of the linear laws at the end of the step. At the start, where
            # they are exact, the log posterior is lower by the Newton decrement.
            decrement = _newton_decrement(start, estimate)
            estimate = replace(
                estimate,
                log_evidence=estimate.log_evidence - decrement,
                converged=decrement < CONVERGED_EVIDENCE,
                follows_laws=True,
            )
            if best_estimate is None or estimate.log_evidence > best_estimate.log_evidence:
                best_estimate = estimate
                best_start = start
                fraction = min(2.0 * fraction, 1.0)
            else:
                fraction = 0.5 * fraction
            if best_estimate.converged or fraction < SHORTEST_FRACTION:
                break
            start = _start_after_step(laws, best_start, best_estimate, fraction)
        if best_estimate is None or best_estimate.converged:
            return best_estimate
        # the evidence holds at the start of the last step; its end may be worse
        return _at_start_of_step(best_estimate, best_start)

    def _estimate_of_linearisation(
        self,
        candidate: Candidate,
        linearisation: Linearisation,
        start: EstimatorStart,
        last_evidence: float,
        speed_window: float,
    ) -> Estimate | None:
        """Return the estimate of linear trials, after a whole Gauss-Newton step from a start.

        Parameters
        ----------
        linearisation : Linearisation
            The trials, linear about the start.
        start : EstimatorStart
            The values and trajectories about which they are linear.
        last_evidence : float
            The log evidence of the previous estimate [nat]. The iteration has converged if neither
            the evidence nor an unknown changes notably.
        speed_window : float
            The half width of the window of speeds with which the laws are linear.

        Returns
        -------
        Estimate or None
            The estimate; None if its evidence is not finite.
        """
        try:
            solution, smoothed_trials = linearisation.solve_and_smooth(start.processes)
        except np.linalg.LinAlgError:  # along a motion that grows without bound
            return None
        if not np.isfinite(solution.log_evidence):
            return None
        unknowns = solution.mean
        evidence = solution.log_evidence + prior_log_density(self.prior_medians, start.processes)
        # the change of each unknown in posterior standard deviations
        last_unknowns = np.concatenate((start.shared, start.effect))
        deviations = np.sqrt(np.diag(solution.covariance))
        largest_step = float(np.max(np.abs(unknowns - last_unknowns) / deviations, initial=0.0))
        evidence_change = abs(evidence - last_evidence)
        shared_count = len(self.shared_priors)
        return Estimate(
            candidate=candidate,
            effect=unknowns[shared_count:],
            shared=unknowns[:shared_count],
            conditional_covariance=solution.covariance,
            processes=start.processes,
            log_evidence=evidence,
            trials=smoothed_trials,
            linearisation=linearisation,
            speed_window=speed_window,
            converged=largest_step < CONVERGED_STEP and evidence_change < CONVERGED_EVIDENCE,
        )

    def _take_step(
        self,
        laws: EffectLaws,
        current_start: EstimatorStart,
        estimate: Estimate,
        linearisation: Linearisation,
        speed_window: float,
    ) -> EstimatorStart | None:
        """Return the start of the next iteration, after the longest admissible fraction of a step.

        At the end of a step the linear laws differ from the true ones. This difference acts like a
        further missing force, which is not part of the smoother's model. A fraction is admissible
        if the rms difference is at most the largest standard deviation of the missing forces. If no
        fraction of `STEP_FRACTIONS` is, the smallest one at which the laws are possible is taken;
        None if there is none. The whole step leads from `current_start`, about which the trials
        are linear, to the estimate.
        """
        next_start: EstimatorStart | None = None
        for fraction in STEP_FRACTIONS:
            stepped_start = _start_after_step(laws, current_start, estimate, fraction)
            # admissible if the error is at most one; None if the laws are not possible there
            error = self._linearisation_error(
                laws, current_start, stepped_start, linearisation, speed_window
            )
            if error is None:
                continue
            next_start = stepped_start
            if error <= 1.0:
                break
        return next_start

    def _linearisation_error(
        self,
        laws: EffectLaws,
        current_start: EstimatorStart,
        stepped_start: EstimatorStart,
        linearisation: Linearisation,
        speed_window: float,
    ) -> float | None:
        """Return the rms error of the linear laws after a step, relative to the missing forces.

        It is the error at the port and in the trial where it is largest, divided by the largest
        standard deviation of the missing forces. The trials are linear about `current_start`. None
        if the laws are not possible at `stepped_start`, after the step.
        """
        unknowns_change = np.concatenate(
            (
                stepped_start.shared - current_start.shared,
                stepped_start.effect - current_start.effect,
            )
        )
        largest_deviation = max(
            process.standard_deviation for process in stepped_start.processes.values()
        )
        largest_ratio = 0.0
        for trial_index, trial in enumerate(linearisation.trials):
            trajectory = stepped_start.trajectories[trial_index]
            true_forces = laws.forces_along_trajectory(
                stepped_start.law_arguments(trial_index, speed_window)
            )
            if true_forces is None:
                return None
            # the linear law after the step, against the true law there
            for port, linearised_force in trial.forces.items():
                linear_force = linearised_force.extrapolate(
                    trajectory.positions[:, port] - trial.trajectory.positions[:, port],
                    trajectory.speeds[:, port] - trial.trajectory.speeds[:, port],
                    unknowns_change,
                )
                error = float(np.sqrt(np.mean((true_forces[port].force - linear_force) ** 2)))
                largest_ratio = max(largest_ratio, error / largest_deviation)
        return largest_ratio


def _newton_decrement(start: EstimatorStart, estimate: Estimate) -> float:
    """Return by how much the log posterior of linear trials rises from a start to an estimate.

    The trials are linear about the start, so that the log of likelihood times prior is quadratic in
    the unknowns. Half the squared step in the metric of its curvature is the Newton decrement.
    """
    unknowns = np.concatenate((start.shared, start.effect))
    change = estimate.solution.mean - unknowns
    return 0.5 * float(change @ np.linalg.solve(estimate.conditional_covariance, change))
