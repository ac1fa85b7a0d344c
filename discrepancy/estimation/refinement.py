"""Hypotheses that were followed along the missing force, estimated with their laws inside the smoother."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.missing_force.explained import Explained
from discrepancy.missing_force.filtered import Solution
from discrepancy.missing_force.naming import ForceSearch
from discrepancy.missing_force.trial import SeenTrial
from discrepancy.missing_force.view import Motion

from .effects import STEP, EffectLaws, moved
from .estimator import Estimate, Estimator, Start
from .linearised import SmoothedTrial, Trajectory

REFINED = 4
"""Hypotheses that are estimated, the most probable first."""
CLOSE = 60.0
"""Logarithm of the probability below the best hypothesis from which on none is estimated [nat]."""


def refined(
    search: ForceSearch,
    ranked: Sequence[Explained],
    effect_count: int,
    tell: Callable[[str], None] = lambda words: None,
) -> list[Explained]:
    """Return hypotheses, the most probable first, those that matter with their laws in the smoother.

    Along a motion that is taken as known a law that changes much within a step of time, as dry friction does
    where the motion turns, is followed to the wrong values: a free exponent then explains more than the law.
    A hypothesis keeps what it was followed to where the estimate is less probable.

    Parameters
    ----------
    search : ForceSearch
        The missing forces.
    ranked : sequence of Explained
        The most probable first.
    effect_count : int
        Effects that were looked for, for the prior of a hypothesis.
    tell : callable
        Takes a few words on what is estimated.
    """

    def score(item: Explained) -> float:
        return search.score(item, effect_count)

    with_effects = [item for item in ranked if item.candidate.terms]
    chosen = [item for item in with_effects if score(item) > score(with_effects[0]) - CLOSE][:REFINED]
    found = list(ranked)
    for item in chosen:
        tell(f"estimating {item.candidate.words} together with the motion")
        better = estimated(search, item)
        if better is not None and better.log_evidence > item.log_evidence:
            found[next(at for at, one in enumerate(found) if one is item)] = better
    return sorted(found, key=lambda item: -score(item))


def estimated(search: ForceSearch, followed: Explained) -> Explained | None:
    """Return a hypothesis estimated from where it was followed to; None where its laws cannot be."""
    trials = tuple(followed.view.trials)
    problem = search.problem
    laws = EffectLaws(search.columns, trials, followed.candidate, search.own_laws, adjustable_laws(search))
    estimator = Estimator(trials, problem.shared.precision, search.about(followed.processes))
    trajectories = tuple(
        Trajectory(motion.added, motion.positions, motion.speeds, motion.forces)
        for motion in followed.motions
    )
    # large enough that the trajectory follows the readings, whatever the law was followed to
    processes = {
        port: replace(process, size=max(process.size, search.whole_size(port)))
        for port, process in followed.processes.items()
    }
    found = estimator.estimate(laws, Start(followed.effect, followed.shared, trajectories, processes))
    return None if found is None else _explained(search, followed, found)


def adjustable_laws(search: ForceSearch) -> tuple[int, ...]:
    """Return the shared unknowns by which the laws change that the model has itself."""
    shared = search.point.shared
    here = search.own_laws(shared)
    return tuple(
        number
        for number in range(search.problem.shared.count)
        if search.own_laws(moved(shared, number, STEP)) != here
    )


def _explained(search: ForceSearch, followed: Explained, found: Estimate) -> Explained | None:
    """Return an estimate as a hypothesis of the search, which others may be added to."""
    motions = [
        _smoothed_motion(trial, smoothed)
        for trial, smoothed in zip(followed.view.trials, found.trials, strict=True)
    ]
    view = search.linear(followed.view, motions, followed.candidate, found.effect)
    if view is None:
        return None
    mean = np.concatenate((found.shared, found.effect))
    return Explained(
        candidate=followed.candidate,
        effect=found.effect,
        processes=found.processes,
        log_evidence=found.log_evidence,
        view=view,
        solution=Solution(found.log_evidence, mean, found.covariance),
        local=found.local,
        motions=motions,
    )


def _smoothed_motion(trial: SeenTrial, smoothed: SmoothedTrial) -> Motion:
    """Return the smoothed motion of a trial in the form in which the search follows hypotheses.

    The search asks which part of the motion the hypothesis explains: all but what the missing force,
    which none of its laws is, adds to the state.
    """
    trajectory = smoothed.trajectory
    state_by_missing_force = np.zeros_like(trajectory.added)
    for port, force in smoothed.missing.items():
        state_by_missing_force = state_by_missing_force + trial.pushed(port, force)
    deviations = {}
    for port, deviation in smoothed.deviations.items():
        at_samples = deviation[:: trial.parts]
        deviations[port] = (at_samples, _speed_deviation(trial, port, smoothed.state_deviation))
    return Motion(
        added=trajectory.added,
        forces=trajectory.forces,
        left=smoothed.missing,
        explained=trajectory.added - state_by_missing_force,
        positions=trajectory.positions,
        speeds=trajectory.speeds,
        deviations=deviations,
    )


def _speed_deviation(trial: SeenTrial, port: int, state_deviation: FloatArray) -> float:
    """Return how well the speed of a port is known, at most: as if errors of states were independent."""
    row = trial.system.speeds[port]
    return float(np.median(np.sqrt(np.square(state_deviation) @ np.square(row))))
