"""The most probable hypotheses on the missing force, estimated together with the motion.

The search evaluates the laws of a hypothesis along a motion that is taken as known. Here the laws
are part of the smoother that estimates the motion.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import with_step
from discrepancy.missing_force.explained import ForceHypothesis
from discrepancy.missing_force.filtered import Solution
from discrepancy.missing_force.linear_trials import PortDeviations, TrialMotion
from discrepancy.missing_force.naming import ForceSearch
from discrepancy.missing_force.trial import PortedTrial

from .effects import HALF_DIFFERENCE, EffectLaws
from .estimator import EstimatorStart, MotionEstimate, MotionEstimator
from .linearised import SmoothedTrial, Trajectory

MOST_REFINED = 4
"""Largest number of hypotheses that are estimated together with the motion, the most probable
first."""
REFINED_WITHIN = 60.0
"""Difference to the best score above which no hypothesis is estimated with the motion [nat]."""


def refine_hypotheses(
    search: ForceSearch,
    ranked: Sequence[ForceHypothesis],
    effect_count: int,
    on_progress: Callable[[str], None] = lambda message: None,
) -> list[ForceHypothesis]:
    """Return hypotheses, the most probable first, the best ones estimated with the motion.

    The search evaluates a law along a motion that is taken as known. That gives wrong values for a
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
        The number of effects that were compared, by which the prior of each is smaller.
    on_progress : callable
        The function that takes a line on what is estimated.
    """

    def score(hypothesis: ForceHypothesis) -> float:
        return search.score(hypothesis, effect_count)

    with_effects = [hypothesis for hypothesis in ranked if hypothesis.candidate.terms]
    nearly_best = []
    for hypothesis in with_effects:
        if score(hypothesis) > score(with_effects[0]) - REFINED_WITHIN:
            nearly_best.append(hypothesis)
    hypotheses = list(ranked)
    for hypothesis in nearly_best[:MOST_REFINED]:
        on_progress(f"estimating {hypothesis.candidate.description} together with the motion")
        refined_hypothesis = estimate_hypothesis(search, hypothesis)
        if refined_hypothesis is None:
            continue
        if refined_hypothesis.log_evidence > hypothesis.log_evidence:
            hypotheses = [
                refined_hypothesis if other is hypothesis else other for other in hypotheses
            ]
    return sorted(hypotheses, key=lambda hypothesis: -score(hypothesis))


def estimate_hypothesis(search: ForceSearch, hypothesis: ForceHypothesis) -> ForceHypothesis | None:
    """Return a hypothesis whose effects and motion are estimated together.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force.
    hypothesis : ForceHypothesis
        The hypothesis as the search has fitted it, with which the estimate begins.

    Returns
    -------
    ForceHypothesis or None
        The hypothesis; None if its laws are not possible along the motion.
    """
    trials = tuple(hypothesis.linear_trials.trials)
    problem = search.problem
    laws = EffectLaws(
        search.column_builder,
        trials,
        hypothesis.candidate,
        search.evaluate_model_laws,
        unknowns_of_model_laws(search),
    )
    estimator = MotionEstimator(
        trials, problem.shared.precision, search.prior_processes(hypothesis.processes)
    )
    trajectories = tuple(
        Trajectory(motion.added_state, motion.positions, motion.speeds, motion.forces)
        for motion in hypothesis.motions
    )
    # missing forces as large as without any effect: the trajectory then follows the readings even
    # if the parameters of the law are still wrong
    processes = {
        port: replace(
            process,
            standard_deviation=max(process.standard_deviation, search.force_deviation(port)),
        )
        for port, process in hypothesis.processes.items()
    }
    estimate = estimator.estimate(
        laws, EstimatorStart(hypothesis.effect, hypothesis.shared, trajectories, processes)
    )
    return None if estimate is None else _hypothesis_of_estimate(search, hypothesis, estimate)


def unknowns_of_model_laws(search: ForceSearch) -> tuple[int, ...]:
    """Return the numbers of the shared unknowns that change the model's own laws."""
    shared = search.point.shared
    laws_at_point = search.evaluate_model_laws(shared)
    return tuple(
        number
        for number in range(search.problem.shared.parameter_count)
        if search.evaluate_model_laws(with_step(shared, number, HALF_DIFFERENCE)) != laws_at_point
    )


def _hypothesis_of_estimate(
    search: ForceSearch, hypothesis: ForceHypothesis, estimate: MotionEstimate
) -> ForceHypothesis | None:
    """Return an estimate as a hypothesis of the search, to which further effects may be added.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force.
    hypothesis : ForceHypothesis
        The hypothesis before the estimate.
    estimate : MotionEstimate
        The estimate.

    Returns
    -------
    ForceHypothesis or None
        The hypothesis; None if its effects cannot act along the estimated motion.
    """
    motions = [
        _trial_motion(trial, smoothed)
        for trial, smoothed in zip(hypothesis.linear_trials.trials, estimate.trials, strict=True)
    ]
    linear_trials = search.linearise_effects(
        hypothesis.linear_trials, motions, hypothesis.candidate, estimate.effect
    )
    if linear_trials is None:
        return None
    mean = np.concatenate((estimate.shared, estimate.effect))
    return ForceHypothesis(
        candidate=hypothesis.candidate,
        effect=estimate.effect,
        processes=estimate.processes,
        log_evidence=estimate.log_evidence,
        linear_trials=linear_trials,
        solution=Solution(estimate.log_evidence, mean, estimate.covariance),
        local=estimate.local,
        motions=motions,
    )


def _trial_motion(trial: PortedTrial, smoothed: SmoothedTrial) -> TrialMotion:
    """Return the smoothed motion of a trial in the form that the search for effects uses.

    The search distinguishes the part of the added state that the hypothesis explains: all but that
    of the missing force which none of its laws explains.

    Parameters
    ----------
    trial : PortedTrial
        The trial.
    smoothed : SmoothedTrial
        Its smoothed trajectory and forces.
    """
    trajectory = smoothed.trajectory
    state_by_missing_force = np.zeros_like(trajectory.added_state)
    for port, force in smoothed.missing_forces.items():
        state_by_missing_force = state_by_missing_force + trial.state_under_force(port, force)
    deviations = {}
    for port, deviation in smoothed.missing_force_deviations.items():
        deviations[port] = PortDeviations(
            force=deviation[:: trial.substeps],
            speed=_speed_deviation(trial, port, smoothed.state_deviation),
        )
    return TrialMotion(
        added_state=trajectory.added_state,
        forces=trajectory.forces,
        unexplained_forces=smoothed.missing_forces,
        explained_state=trajectory.added_state - state_by_missing_force,
        positions=trajectory.positions,
        speeds=trajectory.speeds,
        deviations_by_port=deviations,
    )


def _speed_deviation(trial: PortedTrial, port: int, state_deviation: FloatArray) -> float:
    """Return the median standard deviation of the speed of a port over time [per s].

    Correlations between the states are neglected, as only their variances are computed.

    Parameters
    ----------
    trial : PortedTrial
        The trial.
    port : int
        The number of the port.
    state_deviation : (F, n) array
        The standard deviations of the states.
    """
    # speed = row @ state: the variance is the sum of row^2 times the variances of the states
    row = trial.system.speeds[port]
    return float(np.median(np.sqrt(np.square(state_deviation) @ np.square(row))))
