"""The most probable hypotheses on the missing force, estimated together with the motion.

The search evaluates the laws of a hypothesis along a motion that is taken as known. Here the laws
are part of the smoother that estimates the motion.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import Candidate, with_step
from discrepancy.missing_force.explained import ForceHypothesis
from discrepancy.missing_force.filtered import Solution
from discrepancy.missing_force.linear_trials import LinearTrials, PortDeviations, TrialMotion
from discrepancy.missing_force.naming import ForceSearch
from discrepancy.missing_force.trial import PortedTrial

from .effects import HALF_DIFFERENCE, EffectLaws
from .estimator import COARSE_FACTORS, SPEED_WINDOWS, MotionEstimator
from .gauss_newton import EstimatorStart, MotionEstimate
from .linearised import SmoothedTrial
from .trajectory import Trajectory

MOST_REFINED = 4
"""Largest number of hypotheses that are estimated together with the motion, the most probable
first."""
REFINED_WITHIN = 60.0
"""Difference to the best score above which no hypothesis is estimated with the motion [nat]."""
DIFFERENT_TIMES = 2.0
"""Ratio of two correlation times of a missing force above which an estimate begins with either."""
MOST_LINEARISATIONS = 3
"""Largest number of times that the trials are linearised about the unknowns of an estimate."""
SAME_POINT = 0.1
"""Change of all shared unknowns, in prior standard deviations, below which the trials are not
linearised again."""


def refine_hypotheses(
    search: ForceSearch,
    ranked_hypotheses: Sequence[ForceHypothesis],
    effect_count: int,
    on_progress: Callable[[str], None] = lambda message: None,
) -> list[ForceHypothesis]:
    """Estimate the best hypotheses together with the motion, and sort all by their probability.

    The search evaluates a law along a motion that is taken as known. That gives wrong values for a
    law that changes much within a time step, such as dry friction at a reversal of the motion; a
    free exponent then explains more than the true law. A hypothesis is replaced by its estimate
    only if the estimate is more probable.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force.
    ranked_hypotheses : sequence of ForceHypothesis
        The hypotheses as the search has fitted them, the most probable first.
    effect_count : int
        The number of effects that were compared. The prior probability of a set of effects is
        smaller if there are more of them.
    on_progress : callable
        The function that receives a line for the progress display: the estimate that runs.
    """

    def score(hypothesis: ForceHypothesis) -> float:
        return search.score(hypothesis, effect_count)

    with_effects = [hypothesis for hypothesis in ranked_hypotheses if hypothesis.candidate.terms]
    nearly_best = []
    for hypothesis in with_effects:
        if score(hypothesis) > score(with_effects[0]) - REFINED_WITHIN:
            nearly_best.append(hypothesis)
    hypotheses = list(ranked_hypotheses)
    for hypothesis in nearly_best[:MOST_REFINED]:
        on_progress(f"estimating {hypothesis.candidate.description} together with the motion")
        estimated_hypothesis = estimate_hypothesis(search, hypothesis)
        if estimated_hypothesis is None:
            continue
        if estimated_hypothesis.log_evidence > hypothesis.log_evidence:
            position = next(index for index, entry in enumerate(hypotheses) if entry is hypothesis)
            hypotheses[position] = estimated_hypothesis
    hypotheses.sort(key=lambda hypothesis: -score(hypothesis))
    return _estimate_simpler_forms(search, hypotheses, effect_count, on_progress)


def _estimate_simpler_forms(
    search: ForceSearch,
    ranked_hypotheses: Sequence[ForceHypothesis],
    effect_count: int,
    on_progress: Callable[[str], None],
) -> list[ForceHypothesis]:
    """Estimate the simpler forms of the best hypothesis, as long as one of them is better.

    A set may lead only because its fit reached the right values of one effect, and the fit of that
    effect alone did not. The same holds for a law of free shape and the named laws of its family,
    such as dry friction. Each simpler form of the best hypothesis is therefore estimated, beginning
    with the motion of that hypothesis.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force.
    ranked_hypotheses : sequence of ForceHypothesis
        The hypotheses, the most probable first.
    effect_count : int
        The number of effects that were compared.
    on_progress : callable
        The function that receives a line for the progress display: the estimate that runs.

    Returns
    -------
    list of ForceHypothesis
        The hypotheses, the most probable first. A simpler form replaces the hypothesis of the same
        effects if it is more probable.
    """

    def score(hypothesis: ForceHypothesis) -> float:
        return search.score(hypothesis, effect_count)

    # in ascending order, so that the most probable hypothesis of each set is kept
    by_effects = {
        hypothesis.candidate.key: hypothesis for hypothesis in reversed(ranked_hypotheses)
    }
    best_hypothesis = ranked_hypotheses[0]
    while best_hypothesis.speed_window is not None:
        simpler_forms = [
            *_named_laws_of_family(best_hypothesis, tuple(by_effects.values())),
            *_simpler_forms(best_hypothesis.candidate, best_hypothesis.effect),
        ]
        # the values of the best hypothesis are preferred where both have the same effects
        form_by_effects = {form.candidate.key: form for form in simpler_forms}
        for form in form_by_effects.values():
            on_progress(f"estimating {form.candidate.description} together with the motion")
            simpler_hypothesis = _estimate_from_values(search, best_hypothesis, form)
            if simpler_hypothesis is None:
                continue
            same_effects = by_effects.get(form.candidate.key)
            if same_effects is None or simpler_hypothesis.log_evidence > same_effects.log_evidence:
                by_effects[form.candidate.key] = simpler_hypothesis
        best_of_all = max(by_effects.values(), key=score)
        if best_of_all is best_hypothesis:
            break
        best_hypothesis = best_of_all
    return sorted(by_effects.values(), key=lambda hypothesis: -score(hypothesis))


class _ValuedCandidate(NamedTuple):
    """A set of effects, and the scaled parameters (E,) with which its estimate begins."""

    candidate: Candidate
    parameters: FloatArray


def _simpler_forms(candidate: Candidate, parameters: FloatArray) -> list[_ValuedCandidate]:
    """Return the simpler forms of a set: without one effect, or with one law in canonical shape.

    Parameters
    ----------
    candidate : Candidate
        The set of effects. The only effect of a set is never left out.
    parameters : (E,) array
        The scaled parameters of the set, which the forms inherit.
    """
    forms = []
    numbers = range(len(candidate.terms))
    if len(numbers) > 1:
        for left_out in numbers:
            kept = [number for number in numbers if number != left_out]
            forms.append(_ValuedCandidate(*candidate.subset_of_terms(kept, parameters)))
    for number, term in enumerate(candidate.terms):
        if not term.free_shape:
            continue
        canonical_term = replace(term, free_shape=False)
        terms = list(candidate.terms)
        terms[number] = canonical_term
        parameters_by_term = [of_term for _, of_term in candidate.split_by_term(parameters)]
        # the parameters of the shape follow those of the canonical law
        canonical_count = len(canonical_term.parameters)
        parameters_by_term[number] = parameters_by_term[number][:canonical_count]
        forms.append(_ValuedCandidate(Candidate(tuple(terms)), np.concatenate(parameters_by_term)))
    return forms


def _named_laws_of_family(
    hypothesis: ForceHypothesis, other_hypotheses: Sequence[ForceHypothesis]
) -> list[_ValuedCandidate]:
    """Return the sets in which named laws stand in place of the laws of free shape of a hypothesis.

    They are taken from the other hypotheses, with the values that these have. A set that has been
    estimated with the motion is left out.

    Parameters
    ----------
    hypothesis : ForceHypothesis
        The hypothesis, some of whose laws may have a free shape.
    other_hypotheses : sequence of ForceHypothesis
        The hypotheses that were fitted.
    """

    def laws(candidate: Candidate) -> list[tuple[str, str]]:
        return sorted((term.effect.family, term.place) for term in candidate.terms)

    if not hypothesis.candidate.has_free_shape:
        return []
    return [
        _ValuedCandidate(other.candidate, other.effect)
        for other in other_hypotheses
        if other.speed_window is None
        and not other.candidate.has_free_shape
        and laws(other.candidate) == laws(hypothesis.candidate)
    ]


def _estimate_from_values(
    search: ForceSearch, start_hypothesis: ForceHypothesis, valued_candidate: _ValuedCandidate
) -> ForceHypothesis | None:
    """Estimate a set of effects, starting from the motion of another, estimated hypothesis.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force.
    start_hypothesis : ForceHypothesis
        The estimated hypothesis. Its motion and missing forces are those to begin with.
    valued_candidate : _ValuedCandidate
        The set of effects, with the values to begin with.

    Returns
    -------
    ForceHypothesis or None
        The new hypothesis; None if its laws are not possible along the motion.
    """
    trials = start_hypothesis.linear_trials
    laws, estimator = laws_and_estimator(search, valued_candidate.candidate, trials)
    start = EstimatorStart(
        valued_candidate.parameters,
        start_hypothesis.shared,
        _trajectories(start_hypothesis),
        start_hypothesis.processes,
    )
    # a hypothesis that was not estimated with a window of speeds gets the usual one, the last
    speed_window = start_hypothesis.speed_window or SPEED_WINDOWS[-1]
    estimate = estimator.polish(laws, start, speed_window)
    if estimate is None:
        return None
    return hypothesis_of_estimate(search, valued_candidate.candidate, trials, estimate)


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
    first_estimate = _estimate_about_point_of_search(search, hypothesis)
    if first_estimate is None:
        return None
    trials, estimate = _linearise_about_estimate(
        search, hypothesis.candidate, hypothesis.linear_trials, first_estimate
    )
    return hypothesis_of_estimate(search, hypothesis.candidate, trials, estimate)


def estimate_extended_hypothesis(
    search: ForceSearch, hypothesis: ForceHypothesis, base: ForceHypothesis
) -> ForceHypothesis | None:
    """Return a hypothesis that adds an effect to an estimated one, estimated with the motion.

    The estimate begins with the motion and the small missing forces of the base.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force.
    hypothesis : ForceHypothesis
        The hypothesis with one more effect, as the search has fitted it.
    base : ForceHypothesis
        The hypothesis without that effect, estimated with the motion.

    Returns
    -------
    ForceHypothesis or None
        The hypothesis; None if its laws are not possible along the motion.
    """
    start = _ValuedCandidate(hypothesis.candidate, hypothesis.effect)
    return _estimate_from_values(search, base, start)


def _trajectories(hypothesis: ForceHypothesis) -> tuple[Trajectory, ...]:
    """Return the motion of each trial of a hypothesis as a trajectory of the estimator."""
    return tuple(
        Trajectory(motion.added_state, motion.positions, motion.speeds, motion.forces)
        for motion in hypothesis.motions
    )


def _estimate_about_point_of_search(
    search: ForceSearch, hypothesis: ForceHypothesis
) -> MotionEstimate | None:
    """Return the estimate in trials that are linear about the unknowns of the search.

    The estimate begins with missing forces that are as large as without any effect: the trajectory
    then follows the readings even if the parameters of the law are still wrong. With the law the
    search may have found a far shorter correlation time than without it. Which one leads to the
    better optimum is not known beforehand, so the estimate begins with either if they differ much.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force.
    hypothesis : ForceHypothesis
        The hypothesis as the search has fitted it.

    Returns
    -------
    MotionEstimate or None
        The more probable estimate; None if the laws are not possible along the motion.
    """
    trials = hypothesis.linear_trials
    laws, estimator = laws_and_estimator(search, hypothesis.candidate, trials)
    trajectories = _trajectories(hypothesis)
    processes = {
        port: replace(
            process,
            standard_deviation=max(process.standard_deviation, search.force_deviation(port)),
        )
        for port, process in hypothesis.processes.items()
    }
    beginnings = [processes]
    without_effect = search.hypothesis_of_all_ports.processes
    times_without_effect = {
        port: replace(process, correlation_time=without_effect[port].correlation_time)
        for port, process in processes.items()
        if port in without_effect
    }
    if any(
        abs(np.log(process.correlation_time / processes[port].correlation_time))
        > np.log(DIFFERENT_TIMES)
        for port, process in times_without_effect.items()
    ):
        beginnings.append(processes | times_without_effect)
    estimates = []
    for beginning in beginnings:
        start = EstimatorStart(hypothesis.effect, hypothesis.shared, trajectories, beginning)
        estimate = estimator.follow_to_small_forces(laws, start)
        if estimate is not None:
            estimates.append(estimate)
    if not estimates:
        return None
    best_estimate = max(estimates, key=lambda estimate: estimate.log_evidence)
    return estimator.tune_processes(laws, best_estimate, COARSE_FACTORS)


def _linearise_about_estimate(
    search: ForceSearch, candidate: Candidate, trials: LinearTrials, estimate: MotionEstimate
) -> tuple[LinearTrials, MotionEstimate]:
    """Return trials that are linear about the unknowns of an estimate, and the estimate in them.

    The search takes its trials as linear about the unknowns that it found without any effect. The
    response of the model is not linear in a parameter: a mass that is wrong by a tenth leaves a
    hundredth of the forces, which would then be missing.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force.
    candidate : Candidate
        The effects of the hypothesis, each at its place.
    trials : LinearTrials
        The trials in which the hypothesis was estimated.
    estimate : MotionEstimate
        The estimate of the motion and of all unknowns.

    Returns
    -------
    trials : LinearTrials
        The trials in motion as one linear model.
    estimate : MotionEstimate
        The estimate in these trials; the given one if none can be made in them.
    """
    for number in range(MOST_LINEARISATIONS):
        point = search.point_of_unknowns(estimate.shared, estimate.local)
        point_of_trials = trials.trials[0].linearisation_point[: len(point.shared)]
        is_same_point = bool(np.all(np.abs(point.shared - point_of_trials) < SAME_POINT))
        if is_same_point and number > 0:
            break
        next_trials = trials if is_same_point else search.column_builder.trials_about(point)
        laws, estimator = laws_and_estimator(search, candidate, next_trials)
        start = start_in_other_trials(estimate, trials.trials, next_trials.trials)
        if number == 0:
            next_estimate = estimator.estimate_nearby(laws, start)
        else:
            next_estimate = estimator.polish(laws, start, estimate.speed_window)
        if next_estimate is None:
            break
        trials, estimate = next_trials, next_estimate
    return trials, estimate


def start_in_other_trials(
    estimate: MotionEstimate, trials: Sequence[PortedTrial], other_trials: Sequence[PortedTrial]
) -> EstimatorStart:
    """Return the start of an estimate in trials that are linear about other unknowns.

    The motion of the ports stays the same. The model moves them differently about other unknowns,
    so that the added state changes by what moves the ports back.

    Parameters
    ----------
    estimate : MotionEstimate
        The estimate of the motion and of all unknowns.
    trials : sequence of PortedTrial
        The trials in which it was estimated.
    other_trials : sequence of PortedTrial
        The trials in which the next estimate is made, with the same fine stamps.
    """
    trajectories = []
    for smoothed_trial, trial, other_trial, local_values in zip(
        estimate.trials, trials, other_trials, estimate.local, strict=True
    ):
        unknowns = np.concatenate((estimate.shared, local_values))
        trajectory = smoothed_trial.trajectory
        motion = np.concatenate(trial.port_motion(unknowns, trajectory.added_state), axis=1)
        other_motion = np.concatenate(
            other_trial.port_motion(unknowns, trajectory.added_state), axis=1
        )
        motion_by_state = np.concatenate((other_trial.system.positions, other_trial.system.speeds))
        change = (motion - other_motion) @ np.linalg.pinv(motion_by_state).T
        trajectories.append(replace(trajectory, added_state=trajectory.added_state + change))
    return EstimatorStart(estimate.effect, estimate.shared, tuple(trajectories), estimate.processes)


def laws_and_estimator(
    search: ForceSearch, candidate: Candidate, trials: LinearTrials
) -> tuple[EffectLaws, MotionEstimator]:
    """Return the laws of a hypothesis in some trials, and the estimator of these trials.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force.
    candidate : Candidate
        The effects of the hypothesis.
    trials : LinearTrials
        The trials in motion as one linear model.
    """
    laws = EffectLaws(
        search.column_builder,
        tuple(trials.trials),
        candidate,
        search.evaluate_model_laws,
        unknowns_of_model_laws(search),
    )
    prior_medians = search.prior_processes(search.hypothesis_of_all_ports.processes)
    estimator = MotionEstimator(
        tuple(trials.trials), search.problem.shared.precision, prior_medians
    )
    return laws, estimator


def unknowns_of_model_laws(search: ForceSearch) -> tuple[int, ...]:
    """Return the numbers of the shared unknowns that change the model's own laws."""
    shared_values = search.point.shared
    laws_at_point = search.evaluate_model_laws(shared_values)
    return tuple(
        number
        for number in range(search.problem.shared.parameter_count)
        if search.evaluate_model_laws(with_step(shared_values, number, HALF_DIFFERENCE))
        != laws_at_point
    )


def hypothesis_of_estimate(
    search: ForceSearch, candidate: Candidate, trials: LinearTrials, estimate: MotionEstimate
) -> ForceHypothesis | None:
    """Convert an estimate of a set of effects to a hypothesis of the search for effects.

    The search can then add further effects to the hypothesis.

    Parameters
    ----------
    search : ForceSearch
        The search for effects that explain the missing force.
    candidate : Candidate
        The set of effects, each at its place.
    trials : LinearTrials
        The trials from which the effects were estimated.
    estimate : MotionEstimate
        The result of the estimation: values of the effects' parameters (`effect`) and of the
        unknowns of all trials (`shared`) and of single trials (`local`), and smoothed motions.

    Returns
    -------
    ForceHypothesis or None
        The hypothesis; None if an effect cannot be computed along the estimated motions.
    """
    motions = [
        _trial_motion(trial, smoothed_trial)
        for trial, smoothed_trial in zip(trials.trials, estimate.trials, strict=True)
    ]
    linear_trials = search.linearise_effects(trials, motions, candidate, estimate.effect)
    if linear_trials is None:
        return None
    # the search orders the unknowns: those of all trials, then those of the effects
    solution = Solution(
        log_evidence=estimate.log_evidence,
        mean=np.concatenate((estimate.shared, estimate.effect)),
        covariance=estimate.covariance,
    )
    return ForceHypothesis(
        candidate=candidate,
        effect=estimate.effect,
        processes=estimate.processes,
        log_evidence=estimate.log_evidence,
        linear_trials=linear_trials,
        solution=solution,
        local=estimate.local,
        motions=motions,
        speed_window=estimate.speed_window,
    )


def _trial_motion(trial: PortedTrial, smoothed_trial: SmoothedTrial) -> TrialMotion:
    """Return the smoothed motion of a trial in the form that the search for effects uses.

    The search distinguishes the part of the added state that the hypothesis explains: all but that
    of the missing force which none of its laws explains.

    Parameters
    ----------
    trial : PortedTrial
        The trial as a linear system with ports.
    smoothed_trial : SmoothedTrial
        Its smoothed trajectory and forces.
    """
    trajectory = smoothed_trial.trajectory
    state_by_missing_force = np.zeros_like(trajectory.added_state)
    for port, force in smoothed_trial.missing_forces.items():
        state_by_missing_force = state_by_missing_force + trial.state_under_force(port, force)
    deviations = {}
    for port, deviation in smoothed_trial.missing_force_deviations.items():
        deviations[port] = PortDeviations(
            force=deviation[:: trial.substeps],
            speed=_speed_deviation(trial, port, smoothed_trial.state_deviation),
        )
    return TrialMotion(
        added_state=trajectory.added_state,
        forces=trajectory.forces,
        unexplained_forces=smoothed_trial.missing_forces,
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
        The trial as a linear system with ports.
    port : int
        The number of the port.
    state_deviation : (F, n) array
        The standard deviations of the states.
    """
    # speed = row @ state: the variance is the sum of row^2 times the variances of the states
    row = trial.system.speeds[port]
    return float(np.median(np.sqrt(np.square(state_deviation) @ np.square(row))))
