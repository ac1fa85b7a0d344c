"""The trials in motion of a problem as linear systems, and estimates transferred between them.

An estimate is transferred to trials that are linear about other unknowns, or from thinned trials to
all samples.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import Candidate, Point
from discrepancy.fits.problem import Problem
from discrepancy.trials_in_motion.effects import EffectLaws
from discrepancy.trials_in_motion.ported_trial import ported_trial, thin_trial, thinning_stride
from discrepancy.trials_in_motion.trajectory import Trajectory
from discrepancy.trials_in_motion.trial_at_rest import LinearTrial, TrialAtRest, trial_at_rest
from fe.runtime.patch import ModelPatch

from .estimate import Estimate
from .gauss_newton import EstimatorStart, start_from_estimate


@dataclass(frozen=True, eq=False)
class TrialSet:
    """Some trials of a problem, from which linear trials with ports and laws are made.

    Attributes
    ----------
    problem : Problem
        The campaign and the model without its own laws, with the layout of their unknowns.
    trial_indices : sequence of int
        The indices of the trials in the problem.
    evaluate_model_laws : callable
        The function that takes the shared unknowns (K,) and returns the model's own laws at ports.
    unknowns_of_model_laws : tuple of int
        The numbers of the shared unknowns that change the model's own laws.
    sample_limit : int or None
        The number of samples of all trials together to which trials are thinned, if they can be.
    """

    problem: Problem
    trial_indices: Sequence[int]
    evaluate_model_laws: Callable[[FloatArray], ModelPatch]
    unknowns_of_model_laws: tuple[int, ...]
    sample_limit: int | None = None

    def with_problem(self, problem: Problem, trial_indices: Sequence[int]) -> "TrialSet":
        """Return all samples of other trials, with the same model."""
        return replace(self, problem=problem, trial_indices=trial_indices, sample_limit=None)

    @property
    def sample_count(self) -> int:
        """The number of samples of all trials in motion together."""
        trials = [self.problem.trials[number].trial for number in self.trial_indices]
        return sum(len(trial.time) for trial in trials if trial.is_dynamic)

    @property
    def is_thinned(self) -> bool:
        """Whether any trial in motion is thinned."""
        return any(stride > 1 for stride in self._strides.values())

    @cached_property
    def _strides(self) -> dict[int, int]:
        """The stride with which each trial in motion is thinned, by the number of the trial.

        It is found about the prior means, so that trials that are linear about other values have
        the same stamps.
        """
        trials = self.problem.trials
        in_motion = [number for number in self.trial_indices if trials[number].trial.is_dynamic]
        if self.sample_limit is None:
            return dict.fromkeys(in_motion, 1)
        wanted_stride = self.sample_count / self.sample_limit
        prior_means = self.problem.prior_mean_point(Candidate())
        return {
            number: thinning_stride(ported_trial(self.problem, number, prior_means), wanted_stride)
            for number in in_motion
        }

    def trials_about(self, point: Point) -> tuple[LinearTrial, ...]:
        """Return the trials with ports, linear about values of the unknowns."""
        return tuple(
            thin_trial(ported_trial(self.problem, number, point), self._strides[number])
            if self.problem.trials[number].trial.is_dynamic
            else trial_at_rest(self.problem, number, point)
            for number in self.trial_indices
        )

    def laws(self, candidate: Candidate, trials: Sequence[LinearTrial]) -> EffectLaws:
        """Return the laws and sensor errors of a hypothesis in these trials."""
        return EffectLaws(
            problem=self.problem,
            trials=tuple(trials),
            trial_indices=self.trial_indices,
            candidate=candidate,
            evaluate_model_laws=self.evaluate_model_laws,
            unknowns_of_model_laws=self.unknowns_of_model_laws,
        )


def start_in_other_trials(
    estimate: Estimate, other_trials: Sequence[LinearTrial]
) -> EstimatorStart:
    """Return the start of an estimate in trials that are linear about other unknowns.

    The motion of the ports stays the same. In the other trials, which must have the same fine
    stamps, the linear model moves the ports differently. The added state is changed so that it
    compensates for this difference.
    """
    trajectories = []
    for smoothed_trial, other_trial in zip(estimate.trials, other_trials, strict=True):
        unknowns = np.concatenate((estimate.shared, smoothed_trial.local))
        trial, trajectory = smoothed_trial.trial, smoothed_trial.trajectory
        if isinstance(trial, TrialAtRest) or isinstance(other_trial, TrialAtRest):
            trajectories.append(trajectory)
            continue
        motion = trial.port_motion(unknowns, trajectory.added_state)
        other_motion = other_trial.port_motion(unknowns, trajectory.added_state)
        motion_difference = np.concatenate(motion, axis=1) - np.concatenate(other_motion, axis=1)
        motion_by_state = np.concatenate((other_trial.system.positions, other_trial.system.speeds))
        change = motion_difference @ np.linalg.pinv(motion_by_state).T
        trajectories.append(replace(trajectory, added_state=trajectory.added_state + change))
    return replace(start_from_estimate(estimate), trajectories=tuple(trajectories))


def trajectory_in_all_samples(
    thinned_trial: LinearTrial, trial: LinearTrial, trajectory: Trajectory, unknowns: FloatArray
) -> Trajectory:
    """Return the motion of a thinned trial at all fine stamps of the record.

    The added state and the forces are interpolated. The motion of the ports is that of the linear
    model, which is known at all stamps, plus that by the added state.

    Parameters
    ----------
    thinned_trial, trial : LinearTrial
        The trial with some of its samples, and with all of them.
    trajectory : Trajectory
        The motion of the thinned trial.
    unknowns : (K + L,) array
        The values of the shared unknowns, then of those of the trial alone.
    """
    if isinstance(trial, TrialAtRest):
        return trajectory  # a trial at rest is not thinned
    time, thinned_time = trial.fine_time, thinned_trial.fine_time
    added_state = np.column_stack(
        [np.interp(time, thinned_time, state) for state in trajectory.added_state.T]
    )
    forces = {
        port: np.interp(time, thinned_time, force) for port, force in trajectory.forces.items()
    }
    positions, speeds = trial.port_motion(unknowns, added_state)
    return Trajectory(added_state, positions, speeds, forces)
