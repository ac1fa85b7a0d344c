"""A problem whose trials are linear, in motion and at rest, but for laws at the model's ports.

The model's own laws are left out of them: their forces act at the ports, as missing forces and laws
of effects do.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from discrepancy.campaign.records import FloatArray, Trial, TrialKind
from discrepancy.fits.candidate import PARAMETER_STEP, Candidate, Point, with_step
from discrepancy.fits.problem import Problem
from discrepancy.system.interface import Model
from discrepancy.trials_in_motion.effects import HALF_DIFFERENCE, EffectLaws
from discrepancy.trials_in_motion.trajectory import Trajectory
from discrepancy.trials_in_motion.trial_at_rest import LinearTrial
from fe.runtime.laws.interface import PortForce
from fe.runtime.patch import ModelPatch

from .estimate import NO_EFFECT_VALUES, NO_EFFECTS, Estimate
from .force_states import Process
from .gauss_newton import EstimatorStart, linearise_trials
from .linearisation import Linearisation, plain_linearisation
from .regression import Priors
from .trial_set import TrialSet

WIDE_WINDOW = 0.1
"""Half width of the window of speeds with which the model's own laws are linearised along a first
motion, see `LawArguments`."""


def can_estimate_forces(problem: Problem) -> bool:
    """Return whether missing forces can be estimated in a problem.

    That needs a model that describes how its ports move, and a trial that shows the forces.
    """
    model = problem.model
    shows_a_force = any(shows_missing_force(model, data.trial) for data in problem.trials)
    return model.shows_ports and bool(model.ports) and shows_a_force


def shows_all_missing_forces(problem: Problem) -> bool:
    """Return whether missing forces can be estimated in all trials, so that they are comparable.

    Each trial needs at least as many channels as forces at the ports are independent. More free
    forces than that fit any reading, whatever law acts at one of the ports.
    """
    trials = [data.trial for data in problem.trials]
    return can_estimate_forces(problem) and all(
        shows_missing_force(problem.model, trial)
        and len(trial.channels) >= _independent_force_count(problem, trial)
        for trial in trials
    )


def _independent_force_count(problem: Problem, trial: Trial) -> int:
    """Return in how many independent ways forces at the ports act on the model in a trial.

    There may be fewer than ports: a force between two masses also acts on each of them.
    """
    if not trial.is_dynamic:
        return len(problem.model.ports)
    model, _ = problem.model.without_laws()
    parameters = problem.shared.parameters(problem.prior_mean_point(NO_EFFECTS).shared)
    system = model.ported_system(trial, problem.campaign.outputs(trial), parameters)
    return int(np.linalg.matrix_rank(system.actions))


def shows_missing_force(model: Model, trial: Trial) -> bool:
    """Return whether missing forces are estimated in a trial.

    They are in all trials in motion. At rest they are in load steps, but not in missions, nor if

    - the model does not tell how a force at a port acts at rest, as an FMU does not;
    - the model has a mesh: masses and losses of stiffness then have many places, which are searched
      on grids that refit the errors of the mesh at each of them.
    """
    if trial.is_dynamic:
        return True
    has_load_steps = trial.kind is TrialKind.STATIC
    return has_load_steps and model.shows_ports_at_rest and not model.nuisance_parameters


class PortedProblem:
    """A problem whose trials are linear systems between the ports of the model.

    Parameters
    ----------
    problem : Problem
        A problem in which missing forces can be estimated, see `can_estimate_forces`.
    sample_limit : int, optional
        The number of samples of all trials together to which trials are thinned, if they can be.

    Attributes
    ----------
    ports : tuple of str
        The names of the ports.
    problem_with_laws : Problem
        The problem as it was given; `problem` has the same trials, and a model without laws.
    model_laws : ModelPatch
        The model's own laws at its ports, which its linear system does not contain.
    prior_means : Point
        The prior means of all unknowns, about which the trials are linear at first.
    trial_indices : list of int
        The indices in the problem of the trials that show missing forces.
    trial_set : TrialSet
        These trials, from which linear trials with ports are made.
    shared_priors : Priors
        The priors of the unknowns that all trials share.
    """

    def __init__(self, problem: Problem, sample_limit: int | None) -> None:
        self.problem_with_laws = problem
        linear_model, self.model_laws = problem.model.without_laws()
        trials = tuple(data.trial for data in problem.trials)
        self.model = problem.model
        self.problem = problem.with_trials(trials, linear_model)
        self.trial_indices = [
            index for index, trial in enumerate(trials) if shows_missing_force(self.model, trial)
        ]
        self.ports = tuple(linear_model.ports)
        self.prior_means = self.problem.prior_mean_point(NO_EFFECTS)
        self.trial_set = TrialSet(
            problem=self.problem,
            trial_indices=self.trial_indices,
            evaluate_model_laws=self.evaluate_model_laws,
            unknowns_of_model_laws=self._unknowns_of_model_laws(self.prior_means.shared),
            sample_limit=sample_limit,
        )
        low, high = self.problem.shared.bounds
        self.shared_priors = Priors(self.problem.shared.precision, low, high)

    def linearise(
        self,
        trials: tuple[LinearTrial, ...],
        trajectories: tuple[Trajectory, ...],
        shared_values: FloatArray,
    ) -> Linearisation:
        """Return trials along trajectories with the model's own laws, without effects.

        If the laws are not possible there, they are left out, and the trials are linear along the
        motion of the linear model.

        Parameters
        ----------
        trajectories : tuple of Trajectory
            The motion of each trial.
        """
        no_local_values = tuple(np.zeros(0) for _ in trials)
        start = EstimatorStart(NO_EFFECT_VALUES, shared_values, no_local_values, trajectories, {})
        laws = self.trial_set.laws(NO_EFFECTS, trials)
        linearisation = linearise_trials(laws, trials, start, WIDE_WINDOW, self.shared_priors)
        return linearisation or plain_linearisation(trials, self.shared_priors)

    def prior_processes(self, ports: Iterable[int]) -> dict[int, Process]:
        """Return the prior medians of the missing forces at ports, by the index of the port.

        The median standard deviation is 5 % of the elastic force at the port. The median
        correlation time is the time in which the vibration advances by one radian, or the duration
        of the trials if the port has no frequency.

        Parameters
        ----------
        ports : iterable of int
            Indices into `ports`.
        """
        scales = self.problem.setting.scales
        processes = {}
        for port_index in ports:
            port_name = self.ports[port_index]
            scale = scales.ports[port_name]
            rate = scale.angular_frequency or 1.0 / scales.duration
            # the prior also allows forces that are far larger and far smaller than 5 %
            elastic_force = scale.stiffness * scale.displacement
            processes[port_index] = Process(
                standard_deviation=0.05 * elastic_force, correlation_time=1.0 / rate
            )
        return processes

    def evaluate_model_laws(self, shared_values: FloatArray) -> ModelPatch:
        """Return the model's own laws at values (K,) of the shared unknowns."""
        parameters = self.problem.shared.parameters(shared_values)
        return self.model.built_in_laws(parameters) + self.model.patch.of(PortForce)

    def _unknowns_of_model_laws(self, shared_values: FloatArray) -> tuple[int, ...]:
        """Return the indices of the shared unknowns that change the model's own laws.

        They are compared at values (K,) of the shared unknowns, and a small step away.
        """
        laws_at_point = self.evaluate_model_laws(shared_values)
        return tuple(
            unknown
            for unknown in range(self.problem.shared.parameter_count)
            if self.evaluate_model_laws(with_step(shared_values, unknown, HALF_DIFFERENCE))
            != laws_at_point
        )

    def laws(self, candidate: Candidate, trials: Sequence[LinearTrial]) -> EffectLaws:
        """Return the laws and sensor errors of a hypothesis in some of the trials."""
        return self.trial_set.laws(candidate, trials)

    def point_of_unknowns(
        self, shared_values: FloatArray, local_of_trials: Iterable[FloatArray]
    ) -> Point:
        """Return values of the unknowns as a point of the problem, without effects.

        Shared unknowns are clipped to their ranges, and to two prior standard deviations.

        Parameters
        ----------
        shared_values : (K,) array
            The scaled values of the K unknowns that all trials share.
        local_of_trials : iterable of (L,) array
            The unknowns of each trial that shows missing forces; those of others are zero.
        """
        local_values = [np.zeros(data.unknowns.unknown_count) for data in self.problem.trials]
        for trial_index, values in zip(self.trial_indices, local_of_trials, strict=True):
            local_values[trial_index] = values
        low, high = self.problem.shared.bounds
        # a margin of one step, so that difference quotients stay in the ranges
        low = np.maximum(low + PARAMETER_STEP, -2.0)
        high = np.minimum(high - PARAMETER_STEP, 2.0)
        return Point(np.clip(shared_values, low, high), tuple(local_values), np.zeros(0))

    def point_of(self, estimate: Estimate) -> Point:
        """Return `point_of_unknowns` of an estimate, without its effects."""
        return self.point_of_unknowns(estimate.shared, estimate.local)
