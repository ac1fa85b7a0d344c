"""A hypothesis that is fitted along the missing force: effects, remaining force and motion."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import Candidate

from .filtered import Solution
from .linear_trials import LinearTrials, TrialMotion
from .process_search import MOST_STEPS, Processes

NO_EFFECTS = Candidate()
"""The candidate without effects."""
NO_EFFECT_VALUES = np.zeros(0)
"""The effect parameters of the candidate without effects."""
HIDDEN_SHARE = 0.5
"""Share of the unexplained force that may look like a law of the hypothesis. Without it, the
intervals of a weaker law contain only 4 of 9 true values."""


@dataclass(frozen=True, eq=False)
class ForceHypothesis:
    """A hypothesis that is fitted to the missing force, with effects along the estimated motion.

    Attributes
    ----------
    candidate : Candidate
        The effects; without any, all of the force is missing.
    effect : (E,) array
        The scaled effect parameters, with standard normal prior.
    processes : mapping of int to Process
        The forces that remain missing with the effects, by the numbers of their ports.
    log_evidence : float
        The log evidence, with the prior of the processes [nat].
    linear_trials : LinearTrials
        The trials, with the columns of the effects.
    solution : Solution
        The K shared unknowns, then the E effect parameters.
    local : sequence of (L,) array
        The unknowns of each trial alone.
    motions : sequence of TrialMotion
        The motion of each trial.
    speed_window : float or None
        The half width of the window of speeds over which laws of the speed are averaged, divided by
        the rms speed, if effects and motion were estimated together; else None.
    """

    candidate: Candidate
    effect: FloatArray
    processes: Processes
    log_evidence: float
    linear_trials: LinearTrials
    solution: Solution
    local: Sequence[FloatArray]
    motions: Sequence[TrialMotion]
    speed_window: float | None = None

    @property
    def effect_covariance(self) -> FloatArray:
        """The covariance (E, E) of the effect parameters, given the missing force's process."""
        first_effect = len(self.linear_trials.shared_precision)
        return self.solution.covariance[first_effect:, first_effect:]

    @cached_property
    def shared(self) -> FloatArray:
        """The conditional mean (K,) of the shared unknowns given the effect parameters `effect`.

        It differs from the mean of the solution if the iteration ended before `effect` reached that
        mean.
        """
        first_effect = len(self.linear_trials.shared_precision)
        mean = self.solution.mean
        covariance = self.solution.covariance
        if not len(self.effect):
            return mean[:first_effect]
        # conditional mean of a joint Gaussian: m_s + C_se C_ee^-1 (effect - m_e)
        residual = self.effect - mean[first_effect:]
        weighted_residual = np.linalg.solve(covariance[first_effect:, first_effect:], residual)
        return np.asarray(
            mean[:first_effect] + covariance[:first_effect, first_effect:] @ weighted_residual
        )

    @cached_property
    def covariance(self) -> FloatArray:
        """The covariance (K + E, K + E) of all unknowns, widened for a hidden force.

        The process of a missing force is independent of the motion. But if another law is missing,
        its force depends on the motion, and a part of it may look like the laws of the hypothesis.
        The rms of this hidden part is taken as `HIDDEN_SHARE` times that of the unexplained force.
        """
        covariance = self.solution.covariance
        if not len(self.effect):
            return covariance
        first_effect = len(self.linear_trials.shared_precision)
        added_covariance = self._covariance_of_hidden_force()
        effect_covariance = covariance[first_effect:, first_effect:]
        # all unknowns follow the effect parameters by their regression on these
        regression = np.linalg.lstsq(effect_covariance, covariance[first_effect:], rcond=None)[0].T
        return np.asarray(covariance + regression @ added_covariance @ regression.T)

    def _covariance_of_hidden_force(self) -> FloatArray:
        """Return the covariance (E, E) that a hidden force adds to the effect parameters.

        A hidden force at a port looks like a change of the parameters whose laws act there. It is
        taken as one reading of these parameters: with a variance v of the hidden force, the mean
        products M of the laws' forces per unit, and the prior variance one of each parameter, their
        posterior covariance is (M / v + I)^-1 = v (M + v I)^-1. For one parameter this is nearly
        v / M, and never more than its prior variance. Hidden forces at several ports are
        independent, so their covariances add.
        """
        effect_count = len(self.effect)
        added_covariance = np.zeros((effect_count, effect_count))
        for port, process in self.processes.items():
            forces_per_unit = self._force_by_parameter(port)  # (E, T)
            acting_parameters = np.flatnonzero(forces_per_unit.any(axis=1))
            if not len(acting_parameters):
                continue
            hidden_variance = (HIDDEN_SHARE * process.standard_deviation) ** 2
            acting_forces = forces_per_unit[acting_parameters]
            sample_count = acting_forces.shape[1]
            mean_products = acting_forces @ acting_forces.T / sample_count
            prior_precision = np.eye(len(acting_parameters))
            added_covariance[np.ix_(acting_parameters, acting_parameters)] += (
                hidden_variance * np.linalg.inv(mean_products + hidden_variance * prior_precision)
            )
        return added_covariance

    def _force_by_parameter(self, port: int) -> FloatArray:
        """Return the forces (E, T) for a unit of each effect parameter at a port.

        T is the number of samples of all trials together.
        """
        by_trial = []
        for number, trial in enumerate(self.linear_trials.trials):
            no_force = np.zeros(len(trial.fine_time))
            forces = [
                column[number].forces.get(port, no_force)
                for column in self.linear_trials.effect_columns
            ]
            by_trial.append(np.array([np.asarray(force)[:: trial.substeps] for force in forces]))
        return np.concatenate(by_trial, axis=-1)


def fit_missing_forces(
    linear_trials: LinearTrials,
    median_processes: Processes,
    initial_processes: Processes,
    candidate: Candidate = NO_EFFECTS,
    effect: FloatArray = NO_EFFECT_VALUES,
    *,
    skip_grid: bool = False,
    most_steps: int = MOST_STEPS,
) -> ForceHypothesis:
    """Fit a hypothesis to the trials: its missing forces, the motion, and the shared unknowns.

    The standard deviation and correlation time of each missing force are the most probable ones.

    Parameters
    ----------
    linear_trials : LinearTrials
        The trials in motion as one linear model, with the columns of the effects: the changes of
        the readings for a unit of each effect parameter.
    median_processes : mapping of int to Process
        The prior medians of the missing forces, by the numbers of their ports.
    initial_processes : mapping of int to Process
        The missing forces with which the search for the most probable missing forces begins.
    candidate : Candidate
        The effects of the hypothesis, each at its place.
    effect : (E,) array
        The effect parameters about which the trials are linear, on the scale on which their priors
        are standard normal.
    skip_grid : bool
        Whether the search begins at `initial_processes`. Otherwise it begins at the best point of a
        grid of standard deviations and correlation times around `initial_processes`.
    most_steps : int
        The largest number of steps of Newton's method in the search for the missing forces.
    """
    processes, log_evidence = linear_trials.most_probable_processes(
        median_processes, initial_processes, skip_grid=skip_grid, most_steps=most_steps
    )
    motion_estimate = linear_trials.smooth(processes)
    return ForceHypothesis(
        candidate=candidate,
        effect=effect,
        processes=processes,
        log_evidence=log_evidence,
        linear_trials=linear_trials,
        solution=motion_estimate.solution,
        local=motion_estimate.local,
        motions=motion_estimate.motions,
    )
