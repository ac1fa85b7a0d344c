"""The missing forces of a problem at the ports of its model, without effects and beside effects.

Without effects, a force is estimated at one port, at several ports, or at one port with jumps. An
effect explains a part of that force. It is estimated together with the motion, and the estimate
begins at the one without effects.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import Candidate, Point
from discrepancy.fits.problem import Problem
from discrepancy.trials_in_motion.effects import EffectLaws
from discrepancy.trials_in_motion.trial_at_rest import LinearTrial

from .estimate import NO_EFFECTS, Estimate, estimate_of_processes
from .estimator import LARGEST_RATIO_BESIDE_LAWS, USUAL_WINDOW, MotionEstimator
from .force_states import Process
from .gauss_newton import EstimatorStart, GaussNewton, start_from_estimate
from .linearisation import Linearisation, plain_linearisation
from .log_prior import log_prior
from .ported_problem import PortedProblem
from .process_search import Processes, scale_processes
from .trial_set import start_in_other_trials, trajectory_in_all_samples

MOST_PORTS = 4
"""Largest number of ports at which forces are missing at once."""
FURTHER_PORT_FACTOR = 0.1
"""Standard deviation with which the search for the forces at all ports together begins, over that
estimated at the port alone. At the best port it is one."""
MOST_LINEARISATIONS = 3
"""Largest number of times that the trials are linearised about the unknowns of an estimate."""
SAME_POINT = 0.1
"""Change of all shared unknowns, in prior standard deviations, below which the trials are not
linearised again."""
MOST_THINNED_SAMPLES = 3000
"""Number of samples of all trials together to which long records are thinned at first. It is enough
to tell laws from each other."""
THINNED_AT_LEAST = 2.0
"""Ratio of all samples to this number from which on records are thinned."""


def _best(estimates: Iterable[Estimate]) -> Estimate:
    """Return the estimate with the largest evidence."""
    return max(estimates, key=lambda estimate: estimate.log_evidence)


class ForceSearch:
    """The missing forces of a problem at the ports of its model, and estimates of effects.

    Parameters
    ----------
    problem, sample_limit
        The problem and the number of samples to which it is thinned, see `PortedProblem`; if there
        is no such number, all samples count.

    Attributes
    ----------
    estimate_by_port : dict of str to Estimate
        The missing force at each port alone, by the name of the port.
    thinned : ForceSearch or None
        The search in thinned records, from which that in all samples begins; None if the records
        are short.
    ported : PortedProblem
        The problem, with its trials as linear systems with ports.
    """

    def __init__(self, problem: Problem, sample_limit: int | None = None) -> None:
        self.ported = PortedProblem(problem, sample_limit)
        self.thinned = self._in_thinned_records() if sample_limit is None else None
        if self.thinned is None:
            self.estimate_by_port = self._estimates_of_ports()
        else:
            self.estimate_by_port = self._estimates_of_ports_like(self.thinned)

    def _in_thinned_records(self) -> "ForceSearch | None":
        """Return the search in thinned records; None if they are short or cannot be thinned."""
        if self.ported.trial_set.sample_count < THINNED_AT_LEAST * MOST_THINNED_SAMPLES:
            return None
        problem = self.ported.problem_with_laws
        thinned = PortedProblem(problem, MOST_THINNED_SAMPLES)
        return ForceSearch(problem, MOST_THINNED_SAMPLES) if thinned.trial_set.is_thinned else None

    def _estimates_of_ports(self) -> dict[str, Estimate]:
        """Return the missing force at each port alone, by the name of the port.

        It is estimated twice. The first estimate is along the motion of the linear model. The
        second one is along the motion of the first, with the model's own laws, in trials that are
        linear about the unknowns of the best first estimate.
        """
        start = self.ported.prior_means
        linearisation = plain_linearisation(
            self.ported.trial_set.trials_about(start), self.ported.shared_priors
        )
        first_estimates = []
        for port in range(len(self.ported.ports)):
            processes = self.ported.prior_processes((port,))
            first_estimates.append(estimate_of_processes(linearisation, processes, processes))
        # about the unknowns of the best port
        trials_about_best = self.ported.trial_set.trials_about(
            self.ported.point_of(_best(first_estimates))
        )
        return {
            name: self._estimate_along_motion(
                trials_about_best,
                first_estimates[port].processes,
                self.ported.prior_processes((port,)),
            )
            for port, name in enumerate(self.ported.ports)
        }

    def _estimates_of_ports_like(self, thinned: "ForceSearch") -> dict[str, Estimate]:
        """Return the missing force at each port alone, beginning at that in thinned records.

        The trials are linear about the unknowns of the best estimate in thinned records, and the
        search for the most probable process needs no grid.
        """
        trials = self.ported.trial_set.trials_about(
            thinned.ported.point_of(thinned.best_port_estimate)
        )
        return {
            name: self._estimate_along_motion(
                trials,
                thinned.estimate_by_port[name].processes,
                self.ported.prior_processes((port,)),
                skip_grid=True,
            )
            for port, name in enumerate(self.ported.ports)
        }

    # ---------------------------------------------------------------- where a force is missing

    @cached_property
    def best_port_estimate(self) -> Estimate:
        """The missing force at one port that has the largest evidence."""
        return _best(self.estimate_by_port.values())

    @cached_property
    def estimate_without_effects(self) -> Estimate:
        """The missing forces at several ports together, if no effect of the catalogue acts.

        These are all ports of the model, or the `MOST_PORTS` ports with the largest evidence if
        there are more. With a single port the result is the estimate at that port. Otherwise:

        1. The search begins at the forces that were estimated at each port alone.
        2. The most probable forces are found along the motion of the best of these estimates.
        3. They are found again along the motion of that result, from its forces.

        If the records are long, the forces in thinned records take the place of the first two
        steps.
        """
        best_alone = self.best_port_estimate
        estimates_alone = sorted(
            self.estimate_by_port.values(), key=lambda at_port: -at_port.log_evidence
        )[:MOST_PORTS]
        if len(estimates_alone) == 1:
            return best_alone
        if self.thinned is not None:
            processes = self.thinned.estimate_without_effects.processes
            return estimate_of_processes(
                self._linearise_along(best_alone),
                self.ported.prior_processes(processes),
                processes,
                skip_grid=True,
            )
        start_processes = dict(best_alone.processes)
        for at_port in estimates_alone[1:]:
            # alone, each port takes the whole gap: the further ports begin with a smaller force
            # of the same correlation time
            start_processes |= scale_processes(at_port.processes, FURTHER_PORT_FACTOR, 1.0)
        prior_medians = self.ported.prior_processes(start_processes)
        estimate = estimate_of_processes(best_alone.linearisation, prior_medians, start_processes)
        # the model's own laws depend on the motion, so forces and motion are estimated twice
        return estimate_of_processes(
            self._linearise_along(estimate), prior_medians, estimate.processes, skip_grid=True
        )

    def estimate_with_jumps(self, port: str) -> Estimate:
        """Return the missing force at a port as a process that may jump.

        The trials are linearised twice: about the estimate without jumps, and again about the first
        estimate with jumps, whose unknowns may differ.

        Parameters
        ----------
        port : str
            The name of the port.
        """
        estimate = self.estimate_by_port[port]
        for _ in range(2):
            jumping_processes = {
                port_index: replace(process, may_jump=True)
                for port_index, process in estimate.processes.items()
            }
            linearisation_point = self.ported.point_of(estimate)
            estimate = self._estimate_along_motion(
                trials=self.ported.trial_set.trials_about(linearisation_point),
                initial_processes=jumping_processes,
                prior_medians=self.ported.prior_processes(jumping_processes),
            )
        return estimate

    def _estimate_along_motion(
        self,
        trials: tuple[LinearTrial, ...],
        initial_processes: Processes,
        prior_medians: dict[int, Process],
        *,
        skip_grid: bool = False,
    ) -> Estimate:
        """Smooth the motion with the initial processes, and return the most probable ones along it.

        The search begins at the best point of a grid around the initial processes or, with
        `skip_grid`, at these themselves.
        """
        # the motion first, from the linear model without its own laws
        linearisation = plain_linearisation(trials, self.ported.shared_priors)
        solution, smoothed_trials = linearisation.solve_and_smooth(initial_processes)
        trajectories = tuple(trial.trajectory for trial in smoothed_trials)
        # then the model's own laws, linearised along this motion
        linearisation_along_motion = self.ported.linearise(trials, trajectories, solution.mean)
        return estimate_of_processes(
            linearisation_along_motion, prior_medians, initial_processes, skip_grid=skip_grid
        )

    def _linearise_along(self, estimate: Estimate) -> Linearisation:
        """Return the trials of an estimate without effects, linear along its motion."""
        trials = estimate.ported_trials
        trajectories = tuple(smoothed_trial.trajectory for smoothed_trial in estimate.trials)
        return self.ported.linearise(trials, trajectories, estimate.shared)

    def force_deviation(self, port: int) -> float:
        """Return the standard deviation of the missing force at a port without any effect.

        Its unit is N, N m or the port's flow. It is the prior median if no force was estimated
        there.
        """
        process = self.estimate_without_effects.processes.get(port)
        if process is None:
            process = self.ported.prior_processes((port,))[port]
        return process.standard_deviation

    # ---------------------------------------------------------------- effects

    def score(self, estimate: Estimate, effect_count: int) -> float:
        """Return the log of evidence times prior of an estimate [nat].

        Parameters
        ----------
        estimate : Estimate
            The estimate of a set of effects.
        effect_count : int
            The number of effects that are compared.
        """
        prior = log_prior(estimate.candidate, effect_count, self.ported.problem.setting)
        return estimate.log_evidence + prior

    def estimator(self, trials: Sequence[LinearTrial]) -> MotionEstimator:
        """Return the estimator of hypotheses in some trials."""
        processes = self.estimate_without_effects.processes
        prior_medians = self.ported.prior_processes(processes)
        return MotionEstimator(
            GaussNewton(tuple(trials), self.ported.shared_priors, prior_medians),
            processes_without_effects=processes,
        )

    def estimate_effects(
        self, base: Estimate, candidate: Candidate, effect_values: FloatArray
    ) -> Estimate | None:
        """Return a set of effects at its most probable values, estimated with the motion.

        It is estimated along the motion of its laws first. If that explains the motion, and
        converges or leaves no force, it is the result. Otherwise the estimate also begins at the
        motion of the base, with missing forces at least as large as without any effect, so that the
        motion follows the readings even if the values of the effects are still wrong. The more
        probable of the two estimates is returned.

        Parameters
        ----------
        base : Estimate
            The estimate whose unknowns, motion and missing forces are those to begin with.
        effect_values : (E,) array
            The scaled effect parameters to begin with.

        Returns
        -------
        Estimate or None
            The estimate; None if the laws are not possible along the motion.
        """
        trials = base.ported_trials
        start = replace(start_from_estimate(base), effect=effect_values)
        processes = {
            port: replace(
                process,
                standard_deviation=max(process.standard_deviation, self.force_deviation(port)),
            )
            for port, process in base.processes.items()
        }
        laws = self.ported.laws(candidate, trials)
        estimator = self.estimator(trials)
        # without effects, the shared unknowns may have compensated for the missing laws
        first_shared = base.shared if base.candidate.terms else np.zeros_like(base.shared)
        along_laws = self._estimate_along_laws(estimator, laws, replace(start, shared=first_shared))
        if along_laws is not None and (along_laws.leaves_no_force or along_laws.converged):
            return along_laws
        from_far = estimator.estimate_from_far(laws, replace(start, processes=processes))
        if from_far is not None:
            from_far = self.estimate_about_own_values(from_far)
        estimates = [estimate for estimate in (along_laws, from_far) if estimate is not None]
        return _best(estimates) if estimates else None

    def _estimate_along_laws(
        self, estimator: MotionEstimator, laws: EffectLaws, start: EstimatorStart
    ) -> Estimate | None:
        """Return an estimate that begins along the motion of the laws alone.

        None if the laws do not explain the motion: they are not possible, or leave a force that is
        more than `LARGEST_RATIO_BESIDE_LAWS` of that without effects.
        """
        estimate = estimator.follow_laws(laws, replace(start, processes=estimator.small_processes))
        if estimate is None:
            return None
        missing_force_ratio = estimator.missing_force_ratio(estimate)
        if not estimate.leaves_no_force and missing_force_ratio > LARGEST_RATIO_BESIDE_LAWS:
            return None
        return self.estimate_about_own_values(estimate)

    def estimate_of_simulation(self, candidate: Candidate, point: Point) -> Estimate | None:
        """Return the estimate of a hypothesis whose simulation was fitted to the readings.

        It is estimated along its simulated motion. If that leaves a force, it is estimated together
        with the missing force instead, from the same effects. `point` has the unknowns of the fit.
        """
        explained = self.estimate_along_simulation(candidate, point)
        if explained is not None and explained.leaves_no_force:
            return explained
        return self.estimate_effects(self.estimate_without_effects, candidate, point.effect)

    def estimate_along_simulation(self, candidate: Candidate, point: Point) -> Estimate | None:
        """Return the estimate of a hypothesis along its simulated motion.

        The laws are linearised along the motion that they cause without missing forces, which are
        estimated beside them and begin small (`MotionEstimator.follow_laws`). `point` has the
        unknowns of a simulation that was fitted to the readings. The result is None if the laws are
        not possible.
        """
        trials = self.ported.trial_set.trials_about(point)
        estimator = self.estimator(trials)
        # All unknowns are those of the simulation. The trajectories without effects are needed only
        # for their first states, in which the simulated motions begin.
        start = replace(
            start_in_other_trials(self.estimate_without_effects, trials),
            effect=point.effect,
            shared=point.shared,
            local=tuple(point.local[index] for index in self.ported.trial_indices),
            processes=estimator.small_processes,
        )
        return estimator.follow_laws(self.ported.laws(candidate, trials), start)

    def begin_along_simulation(self, point: Point) -> None:
        """Estimate the model without effects along its simulation, as effects are estimated.

        The present `estimate_without_effects` is linear about other parameters than its own. It is
        also linear along a smoothed motion, in which a body creeps that is held by friction of the
        model. So the more probable of both estimates replaces it. `point` has the unknowns of the
        model without effects as fitted to the readings.
        """
        if self.thinned is not None:
            self.thinned.begin_along_simulation(point)
        estimate = self.estimate_along_simulation(NO_EFFECTS, point)
        if estimate is not None:
            self.estimate_without_effects = _best((estimate, self.estimate_without_effects))

    def estimate_roughly(
        self, base: Estimate, candidate: Candidate, effect_values: FloatArray, processes: Processes
    ) -> Estimate | None:
        """Return a set of effects near its most probable values, for a first comparison.

        Two searches begin at the motion of `base`: one with its missing forces, which are lowered
        step by step, the other with `processes`, which are small. The more probable result counts.
        If the base leaves no force, the second search is enough, unless it fails.

        Parameters
        ----------
        base : Estimate
            The estimate without the last of the effects.
        effect_values : (E,) array
            The scaled effect parameters to begin with.
        processes : mapping of int to Process
            The missing forces that may remain beside the effects.

        Returns
        -------
        Estimate or None
            The estimate; None if the laws are not possible along the motion.
        """
        trials = base.ported_trials
        start = replace(start_from_estimate(base), effect=effect_values)
        laws = self.ported.laws(candidate, trials)
        return self.estimator(trials).estimate_roughly(
            laws, start, processes, has_large_forces=not base.leaves_no_force
        )

    def polish_effects(
        self, base: Estimate, candidate: Candidate, effect_values: FloatArray
    ) -> Estimate | None:
        """Return a set of effects at its most probable values, from values that are near these.

        Parameters
        ----------
        base : Estimate
            The estimate whose motion and missing forces are those to begin with.
        effect_values : (E,) array
            The scaled effect parameters to begin with.

        Returns
        -------
        Estimate or None
            The estimate; None if the laws are not possible along the motion.
        """
        trials = base.ported_trials
        start = replace(start_from_estimate(base), effect=effect_values)
        # the estimate without effects has no window
        speed_window = base.speed_window or USUAL_WINDOW
        return self.estimator(trials).polish(
            self.ported.laws(candidate, trials), start, speed_window
        )

    def estimate_about_own_values(self, estimate: Estimate) -> Estimate:
        """Return the estimate repeated in trials that are linear about its own unknowns.

        A first estimate is made in trials that are linear about the unknowns without any effect.
        But the response of the model is not linear in a parameter: if a mass is wrong by a tenth, a
        hundredth of its forces would be missing. The trials are linearised until the unknowns
        hardly change, at most `MOST_LINEARISATIONS` times. The last estimate that could be made is
        returned.
        """
        for iteration in range(MOST_LINEARISATIONS):
            trials = estimate.ported_trials
            point = self.ported.point_of(estimate)
            point_of_trials = trials[0].linearisation_point[: len(point.shared)]
            is_same_point = bool(np.all(np.abs(point.shared - point_of_trials) < SAME_POINT))
            if is_same_point and iteration > 0:
                break
            next_trials = trials if is_same_point else self.ported.trial_set.trials_about(point)
            laws = self.ported.laws(estimate.candidate, next_trials)
            estimator = self.estimator(next_trials)
            start = start_in_other_trials(estimate, next_trials)
            if iteration == 0 and not estimate.follows_laws:
                next_estimate = estimator.estimate_nearby(laws, start, estimate.speed_window)
            else:
                next_estimate = estimator.polish(
                    laws, start, estimate.speed_window, may_follow_laws=estimate.follows_laws
                )
            if next_estimate is None:
                break
            estimate = next_estimate
        return estimate

    def estimate_in_all_samples(self, thinned_estimate: Estimate) -> Estimate | None:
        """Return an estimate of thinned trials in all samples; None if its laws are not possible.

        The trials are linear about the same unknowns as the thinned ones.
        """
        shared_count = self.ported.problem.shared.unknown_count
        points = [trial.trial.linearisation_point for trial in thinned_estimate.trials]
        point = self.ported.point_of_unknowns(
            points[0][:shared_count], [values[shared_count:] for values in points]
        )
        trials = self.ported.trial_set.trials_about(point)
        trajectories = []
        for smoothed_trial, trial in zip(thinned_estimate.trials, trials, strict=True):
            unknowns = np.concatenate((thinned_estimate.shared, smoothed_trial.local))
            trajectories.append(
                trajectory_in_all_samples(
                    smoothed_trial.trial, trial, smoothed_trial.trajectory, unknowns
                )
            )
        start = replace(start_from_estimate(thinned_estimate), trajectories=tuple(trajectories))
        laws = self.ported.laws(thinned_estimate.candidate, trials)
        return self.estimator(trials).polish(laws, start, thinned_estimate.speed_window)

    # ---------------------------------------------------------------- values of unknowns

    def point(self, estimate: Estimate) -> Point:
        """Return the unknowns of an estimate with its effects, from which a fit may begin."""
        point = self.ported.point_of(estimate)
        return Point(estimate.shared.copy(), point.local, estimate.effect.copy())
