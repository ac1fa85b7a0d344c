"""A hypothesis at its most probable values: effects, motion, missing forces and evidence."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import Candidate
from discrepancy.trials_in_motion.trial_at_rest import LinearTrial

from .filtered import SmoothedTrial
from .linearisation import Linearisation
from .process_search import MOST_STEPS, Processes, scale_processes
from .regression import Solution

NO_EFFECTS = Candidate()
"""The candidate without effects."""
NO_EFFECT_VALUES = np.zeros(0)
"""The effect parameters of the candidate without effects."""
HIDDEN_SHARE = 0.5
"""Share of the unexplained force that may look like a law of the hypothesis. Without it, the
intervals of a weaker law contain only 4 of 9 true values."""
LEAST_EVIDENCE = 3.0
"""Log evidence over no missing force from which on a force is missing [nat]."""
NEGLIGIBLE_AMPLITUDE = 1e-9
"""Factor on the amplitude of a missing force that stands for none: a process without amplitude is
singular."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """A hypothesis at its most probable values, estimated together with the motion of the trials.

    Attributes
    ----------
    candidate : Candidate
        The effects; without any, all of the force is missing.
    effect : (E,) ndarray
        The scaled effect parameters, with standard normal prior.
    shared : (K,) ndarray
        The scaled unknowns that all trials share.
    conditional_covariance : (K + E, K + E) ndarray
        The covariance of shared unknowns and effect parameters, given the missing force's process.
    processes : mapping of int to Process
        The forces that remain missing with the effects, by the index of the port.
    log_evidence : float
        The log evidence, with the prior of the processes [nat].
    trials : tuple of SmoothedTrial
        The motion and the forces of each trial.
    linearisation : Linearisation
        The trials, linear about the values of the last step.
    speed_window : float
        The half width of the window of speeds over which laws of the speed are averaged, divided by
        the rms speed.
    converged : bool
        Whether the last step was short enough.
    follows_laws : bool
        Whether the trials are linear along the motion of the laws alone, which is that of the last
        step but for the missing forces.
    """

    candidate: Candidate
    effect: FloatArray
    shared: FloatArray
    conditional_covariance: FloatArray
    processes: Processes
    log_evidence: float
    trials: tuple[SmoothedTrial, ...]
    linearisation: Linearisation
    speed_window: float = 0.0
    converged: bool = True
    follows_laws: bool = False

    @property
    def ported_trials(self) -> tuple[LinearTrial, ...]:
        """The linear trials with ports, in which the estimate was made."""
        return tuple(smoothed_trial.trial for smoothed_trial in self.trials)

    @property
    def local(self) -> tuple[FloatArray, ...]:
        """The unknowns (L,) of each trial alone."""
        return tuple(smoothed_trial.local for smoothed_trial in self.trials)

    @property
    def effect_covariance(self) -> FloatArray:
        """The covariance (E, E) of the effect parameters, given the missing force's process."""
        first_effect = len(self.shared)
        return self.conditional_covariance[first_effect:, first_effect:]

    @property
    def solution(self) -> Solution:
        """The shared unknowns, then the effect parameters, with the log evidence."""
        return Solution(
            log_evidence=self.log_evidence,
            mean=np.concatenate((self.shared, self.effect)),
            covariance=self.conditional_covariance,
        )

    @cached_property
    def log_evidence_without_force(self) -> float:
        """The log evidence of the same trials and laws if no force is missing [nat]."""
        no_force = scale_processes(self.processes, NEGLIGIBLE_AMPLITUDE, 1.0)
        return self.linearisation.solve(no_force).log_evidence

    @property
    def leaves_no_force(self) -> bool:
        """Whether the trials do not show that any force is missing beside the effects."""
        return self.log_evidence < self.log_evidence_without_force + LEAST_EVIDENCE

    @cached_property
    def covariance(self) -> FloatArray:
        """The covariance (K + E, K + E) of all unknowns, widened for a hidden force.

        The process of a missing force is independent of the motion. But if another law is missing,
        its force depends on the motion, and a part of it may look like the laws of the hypothesis.
        The rms of this hidden part is taken as `HIDDEN_SHARE` times that of the unexplained force.
        """
        covariance = self.conditional_covariance
        if not len(self.effect):
            return covariance
        added_covariance = self._covariance_of_hidden_force()
        # all unknowns follow the effect parameters by their regression on these
        regression = np.linalg.lstsq(
            self.effect_covariance, covariance[len(self.shared) :], rcond=None
        )[0].T
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
        """Return the forces (E, T) at a port caused by a unit change of each effect parameter.

        There are E effect parameters, and T samples in all trials together.
        """
        first_effect = len(self.shared)  # shared unknowns come first, then effect parameters
        by_trial = []
        for linear_trial in self.linearisation.trials:
            trial = linear_trial.trial
            forces = np.zeros((len(self.effect), len(trial.time)))
            if port in linear_trial.forces:
                for unknown, force in linear_trial.forces[port].by_unknown.items():
                    if unknown >= first_effect:
                        forces[unknown - first_effect] = force[:: trial.substeps]
            by_trial.append(forces)
        return np.concatenate(by_trial, axis=-1)


def estimate_of_processes(
    linearisation: Linearisation,
    median_processes: Processes,
    initial_processes: Processes,
    *,
    skip_grid: bool = False,
    most_steps: int = MOST_STEPS,
) -> Estimate:
    """Return the estimate of trials without effects, with the most probable missing forces.

    Parameters
    ----------
    linearisation : Linearisation
        The trials, along a motion that was estimated before.
    median_processes : mapping of int to Process
        The prior medians of the missing forces, by the index of the port.
    initial_processes : mapping of int to Process
        The missing forces with which the search for the most probable ones begins.
    skip_grid : bool
        Whether the search begins at `initial_processes`. Otherwise it begins at the best point of a
        grid of standard deviations and correlation times around `initial_processes`.
    most_steps : int
        The largest number of steps of Newton's method in the search for the missing forces.
    """
    processes, log_evidence = linearisation.most_probable_processes(
        median_processes, initial_processes, skip_grid=skip_grid, most_steps=most_steps
    )
    solution, smoothed_trials = linearisation.solve_and_smooth(processes)
    return Estimate(
        candidate=NO_EFFECTS,
        effect=NO_EFFECT_VALUES,
        shared=solution.mean,
        conditional_covariance=solution.covariance,
        processes=processes,
        log_evidence=log_evidence,
        trials=smoothed_trials,
        linearisation=linearisation,
    )
