"""A hypothesis along the missing force: its effects, what is missing beside them, and the motion that was."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import Candidate

from .filtered import Solution
from .process_search import MOST_STEPS, Processes
from .view import Motion, View

NOTHING = Candidate()
NO_VALUES = np.zeros(0)
ALONG = 0.5
"""Share of what is left of an unknown law that may be hidden along a named one: without it intervals beside a
weaker law hold 4 of 9 hidden values."""


@dataclass(frozen=True, eq=False)
class Explained:
    """A hypothesis.

    Attributes
    ----------
    candidate : Candidate
        Its effects; none: missing forces alone.
    effect : (E,) ndarray
        Their unknowns, standard normal before.
    processes : mapping of int to Process
        Missing forces beside them, by the numbers of their ports.
    log_evidence : float
        [nat], with the prior of the processes.
    view : View
        Trials and columns.
    solution : Solution
        Shared unknowns first, those of the effects last.
    local : sequence of (L,) ndarray
        Unknowns of the trials.
    motions : sequence of Motion
        By trial.
    """

    candidate: Candidate
    effect: FloatArray
    processes: Processes
    log_evidence: float
    view: View
    solution: Solution
    local: Sequence[FloatArray]
    motions: Sequence[Motion]

    @property
    def effect_covariance(self) -> FloatArray:
        """Of the effects' unknowns (E, E), beside the missing force as it is."""
        at = len(self.view.shared_precision)
        return self.solution.covariance[at:, at:]

    @cached_property
    def shared(self) -> FloatArray:
        """Shared unknowns (K,) at the values of the effects, which may not have settled."""
        at = len(self.view.shared_precision)
        mean, covariance = self.solution.mean, self.solution.covariance
        if not len(self.effect):
            return mean[:at]
        step = np.linalg.solve(covariance[at:, at:], self.effect - mean[at:])
        return np.asarray(mean[:at] + covariance[:at, at:] @ step)

    @cached_property
    def covariance(self) -> FloatArray:
        """Of all unknowns, shared ones first, wide enough for what is left to lie along the laws in part.

        The process is a force in time that has nothing to do with the motion. What is left of another law
        has: as much of it as is seen beside the columns may be hidden along them.
        """
        at, covariance = len(self.view.shared_precision), self.solution.covariance
        if not len(self.effect):
            return covariance
        wider = np.zeros((len(self.effect),) * 2)
        for port, process in self.processes.items():
            rows = []
            for number, trial in enumerate(self.view.trials):
                nothing = np.zeros(len(trial.fine_time))
                forces = [item[number].forces.get(port, nothing) for item in self.view.effects]
                rows.append(np.array([np.asarray(force)[:: trial.parts] for force in forces]))
            columns = np.concatenate(rows, axis=-1)  # the forces (E, T) at the samples of all trials
            acting = np.flatnonzero(columns.any(axis=1))
            if len(acting):
                size = (ALONG * process.size) ** 2
                gram = columns[acting] @ columns[acting].T / columns.shape[1]
                wider[np.ix_(acting, acting)] += size * np.linalg.inv(gram + size * np.eye(len(acting)))
        follow = np.linalg.lstsq(covariance[at:, at:], covariance[at:], rcond=None)[0].T
        return np.asarray(covariance + follow @ wider @ follow.T)


def seen(
    view: View,
    median: Processes,
    begin: Processes,
    candidate: Candidate = NOTHING,
    effect: FloatArray = NO_VALUES,
    *,
    near: bool = False,
    most_steps: int = MOST_STEPS,
) -> Explained:
    """Return a hypothesis beside the most probable missing forces."""
    processes, log_evidence = view.most_probable(median, begin, near=near, most_steps=most_steps)
    solution, local, motions = view.smoothed(processes)
    return Explained(
        candidate=candidate,
        effect=effect,
        processes=processes,
        log_evidence=log_evidence,
        view=view,
        solution=solution,
        local=local,
        motions=motions,
    )
