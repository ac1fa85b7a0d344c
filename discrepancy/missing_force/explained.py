"""A hypothesis along the missing force: effects, the force missing beside them, and the motion."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import Candidate

from .filtered import Solution
from .process_search import MOST_STEPS, Processes
from .view import TrialMotion, View

NOTHING = Candidate()
"""The candidate without effects."""
NO_VALUES = np.zeros(0)
"""Its parameters."""
HIDDEN_PART = 0.5
"""Part of the remaining force that may be hidden along a named law. Without it, intervals beside a
weaker law hold 4 of 9 hidden values."""


@dataclass(frozen=True, eq=False)
class ForceHypothesis:
    """A hypothesis that was fitted to the missing force: its effects act along the motion that was.

    Attributes
    ----------
    candidate : Candidate
        The effects; without any, there are missing forces alone.
    effect : (E,) array
        The scaled effect parameters.
    processes : mapping of int to Process
        The missing forces beside the effects, by the numbers of their ports.
    log_evidence : float
        The log evidence, with the prior of the processes [nat].
    view : View
        The trials and the columns of the effects.
    solution : Solution
        The values of shared unknowns and effect parameters, in this order.
    local : sequence of (L,) array
        The unknowns of each trial.
    motions : sequence of TrialMotion
        The motion of each trial.
    """

    candidate: Candidate
    effect: FloatArray
    processes: Processes
    log_evidence: float
    view: View
    solution: Solution
    local: Sequence[FloatArray]
    motions: Sequence[TrialMotion]

    @property
    def effect_covariance(self) -> FloatArray:
        """The covariance (E, E) of the effect parameters, beside the missing force as it is."""
        first_effect = len(self.view.shared_precision)
        return self.solution.covariance[first_effect:, first_effect:]

    @cached_property
    def shared(self) -> FloatArray:
        """The shared unknowns (K,) at the values of the effects, which may not have converged.

        They are the conditional mean of the solution, given the effect parameters.
        """
        first_effect = len(self.view.shared_precision)
        mean = self.solution.mean
        covariance = self.solution.covariance
        if not len(self.effect):
            return mean[:first_effect]
        residual = self.effect - mean[first_effect:]
        weights = np.linalg.solve(covariance[first_effect:, first_effect:], residual)
        return np.asarray(mean[:first_effect] + covariance[:first_effect, first_effect:] @ weights)

    @cached_property
    def covariance(self) -> FloatArray:
        """The covariance (K + E, K + E) of all unknowns, with room for a hidden force.

        The process of a missing force has nothing to do with the motion. What remains of another
        law has: as much of it as is seen beside the named laws may be hidden along them.
        """
        covariance = self.solution.covariance
        if not len(self.effect):
            return covariance
        first_effect = len(self.view.shared_precision)
        hidden = self._covariance_of_hidden_force()
        effect_covariance = covariance[first_effect:, first_effect:]
        # all unknowns follow the effect parameters by their regression on these
        regression = np.linalg.lstsq(effect_covariance, covariance[first_effect:], rcond=None)[0].T
        return np.asarray(covariance + regression @ hidden @ regression.T)

    def _covariance_of_hidden_force(self) -> FloatArray:
        """Return the covariance (E, E) of effect parameters that a hidden force adds."""
        hidden = np.zeros((len(self.effect),) * 2)
        for port, process in self.processes.items():
            columns = self._effect_forces(port)
            acting = np.flatnonzero(columns.any(axis=1))
            if not len(acting):
                continue
            variance = (HIDDEN_PART * process.size) ** 2
            gram = columns[acting] @ columns[acting].T / columns.shape[1]
            regularised = gram + variance * np.eye(len(acting))
            hidden[np.ix_(acting, acting)] += variance * np.linalg.inv(regularised)
        return hidden

    def _effect_forces(self, port: int) -> FloatArray:
        """Return the forces (E, T) of a unit of each effect parameter at a port, at all samples."""
        by_trial = []
        for number, trial in enumerate(self.view.trials):
            no_force = np.zeros(len(trial.fine_time))
            forces = [column[number].forces.get(port, no_force) for column in self.view.effects]
            by_trial.append(np.array([np.asarray(force)[:: trial.parts] for force in forces]))
        return np.concatenate(by_trial, axis=-1)


def with_most_probable_forces(
    view: View,
    median: Processes,
    begin: Processes,
    candidate: Candidate = NOTHING,
    effect: FloatArray = NO_VALUES,
    *,
    near: bool = False,
    most_steps: int = MOST_STEPS,
) -> ForceHypothesis:
    """Return a hypothesis beside the most probable missing forces.

    Parameters
    ----------
    view : View
        The trials and the columns of the effects.
    median : mapping of int to Process
        The prior medians of the missing forces, by the numbers of their ports.
    begin : mapping of int to Process
        The missing forces from which the search for the most probable ones begins.
    candidate : Candidate
        The effects.
    effect : (E,) array
        The scaled effect parameters about which the view is linear.
    near : bool
        Whether the search begins at `begin` itself, not at the best of a grid around it.
    most_steps : int
        The largest number of steps of Newton's method.
    """
    processes, log_evidence = view.most_probable(median, begin, near=near, most_steps=most_steps)
    solution, local, motions = view.smoothed(processes)
    return ForceHypothesis(
        candidate=candidate,
        effect=effect,
        processes=processes,
        log_evidence=log_evidence,
        view=view,
        solution=solution,
        local=local,
        motions=motions,
    )
