"""The most probable hypotheses on the missing force, estimated together with the motion.

The search follows a hypothesis along a motion that is taken as known. Here its laws are inside of
the smoother that estimates the motion.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import with_step
from discrepancy.missing_force.explained import ForceHypothesis
from discrepancy.missing_force.filtered import Solution
from discrepancy.missing_force.naming import ForceSearch
from discrepancy.missing_force.trial import SeenTrial
from discrepancy.missing_force.view import TrialMotion

from .effects import STEP, EffectLaws
from .estimator import EstimatorStart, MotionEstimate, MotionEstimator
from .linearised import SmoothedTrial, Trajectory

REFINED = 4
"""Largest number of hypotheses that are estimated, the most probable first."""
CLOSE = 60.0
"""Log probability below the best hypothesis from which on none is estimated [nat]."""


def refined(
    search: ForceSearch,
    ranked: Sequence[ForceHypothesis],
    effect_count: int,
    on_progress: Callable[[str], None] = lambda message: None,
) -> list[ForceHypothesis]:
    """Return hypotheses, the most probable first, the best ones estimated with the motion.

    The search follows a law along a motion that is taken as known. That gives wrong values for a
    law that changes much within a time step, such as dry friction at a reversal of the motion; a
    free exponent then explains more than the true law. A hypothesis is replaced by its estimate
    only if the estimate is more probable.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force.
    ranked : sequence of ForceHypothesis
        The hypotheses, the most probable first.
    effect_count : int
        The number of effects that were compared, for the prior of a hypothesis.
    on_progress : callable
        The function that takes a line on what is estimated.
    """

    def score(hypothesis: ForceHypothesis) -> float:
        return search.score(hypothesis, effect_count)

    with_effects = [hypothesis for hypothesis in ranked if hypothesis.candidate.terms]
    nearly_best = []
    for hypothesis in with_effects:
        if score(hypothesis) > score(with_effects[0]) - CLOSE:
            nearly_best.append(hypothesis)
    hypotheses = list(ranked)
    for hypothesis in nearly_best[:REFINED]:
        on_progress(f"estimating {hypothesis.candidate.description} together with the motion")
        refined_hypothesis = estimated(search, hypothesis)
        if refined_hypothesis is None:
            continue
        if refined_hypothesis.log_evidence > hypothesis.log_evidence:
            hypotheses = [
                refined_hypothesis if other is hypothesis else other for other in hypotheses
            ]
    return sorted(hypotheses, key=lambda hypothesis: -score(hypothesis))


def estimated(search: ForceSearch, followed: ForceHypothesis) -> ForceHypothesis | None:
    """Return a hypothesis whose effects and motion are estimated together.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force.
    followed : ForceHypothesis
        The result of the search for this hypothesis, from which the estimate begins.

    Returns
    -------
    ForceHypothesis or None
        The hypothesis; None if its laws are not possible along the motion.
    """
    trials = tuple(followed.view.trials)
    problem = search.problem
    laws = EffectLaws(
        search.columns, trials, followed.candidate, search.own_laws, adjustable_laws(search)
    )
    estimator = MotionEstimator(
        trials, problem.shared.precision, search.prior_processes(followed.processes)
    )
    trajectories = tuple(
        Trajectory(motion.added, motion.positions, motion.speeds, motion.forces)
        for motion in followed.motions
    )
    # missing forces as large as without any effect: the trajectory then follows the readings even
    # if the parameters of the law are still wrong
    processes = {
        port: replace(process, size=max(process.size, search.whole_size(port)))
        for port, process in followed.processes.items()
    }
    estimate = estimator.estimate(
        laws, EstimatorStart(followed.effect, followed.shared, trajectories, processes)
    )
    return None if estimate is None else _explained(search, followed, estimate)


def adjustable_laws(search: ForceSearch) -> tuple[int, ...]:
    """Return the numbers of the shared unknowns that change the model's own laws."""
    shared = search.point.shared
    laws_at_point = search.own_laws(shared)
    return tuple(
        number
        for number in range(search.problem.shared.count)
        if search.own_laws(with_step(shared, number, STEP)) != laws_at_point
    )


def _explained(
    search: ForceSearch, followed: ForceHypothesis, estimate: MotionEstimate
) -> ForceHypothesis | None:
    """Return an estimate as a hypothesis of the search, to which further effects may be added.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force.
    followed : ForceHypothesis
        The hypothesis before the estimate.
    estimate : MotionEstimate
        The estimate.

    Returns
    -------
    ForceHypothesis or None
        The hypothesis; None if its effects cannot act along the estimated motion.
    """
    motions = [
        _smoothed_motion(trial, smoothed)
        for trial, smoothed in zip(followed.view.trials, estimate.trials, strict=True)
    ]
    view = search.linear(followed.view, motions, followed.candidate, estimate.effect)
    if view is None:
        return None
    mean = np.concatenate((estimate.shared, estimate.effect))
    return ForceHypothesis(
        candidate=followed.candidate,
        effect=estimate.effect,
        processes=estimate.processes,
        log_evidence=estimate.log_evidence,
        view=view,
        solution=Solution(estimate.log_evidence, mean, estimate.covariance),
        local=estimate.local,
        motions=motions,
    )


def _smoothed_motion(trial: SeenTrial, smoothed: SmoothedTrial) -> TrialMotion:
    """Return the smoothed motion of a trial in the form that the search for effects uses.

    The search distinguishes the part of the added state that the hypothesis explains: all but that
    of the missing force which none of its laws explains.

    Parameters
    ----------
    trial : SeenTrial
        The trial.
    smoothed : SmoothedTrial
        Its smoothed trajectory and forces.
    """
    trajectory = smoothed.trajectory
    state_by_missing_force = np.zeros_like(trajectory.added)
    for port, force in smoothed.missing.items():
        state_by_missing_force = state_by_missing_force + trial.pushed(port, force)
    deviations = {}
    for port, deviation in smoothed.deviations.items():
        at_samples = deviation[:: trial.parts]
        deviations[port] = (at_samples, _speed_deviation(trial, port, smoothed.state_deviation))
    return TrialMotion(
        added=trajectory.added,
        forces=trajectory.forces,
        left=smoothed.missing,
        explained=trajectory.added - state_by_missing_force,
        positions=trajectory.positions,
        speeds=trajectory.speeds,
        deviations=deviations,
    )


def _speed_deviation(trial: SeenTrial, port: int, state_deviation: FloatArray) -> float:
    """Return the median standard deviation of the speed of a port over time [per s].

    Correlations between the states are neglected, as only their variances are computed.

    Parameters
    ----------
    trial : SeenTrial
        The trial.
    port : int
        The number of the port.
    state_deviation : (F, n) array
        The standard deviations of the states.
    """
    row = trial.system.speeds[port]
    return float(np.median(np.sqrt(np.square(state_deviation) @ np.square(row))))
