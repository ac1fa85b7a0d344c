"""The ranking of hypotheses on the missing force, in two rounds if the records are long.

The first round compares all effects in thinned records, and the second one estimates the leading
hypotheses in all samples. Short records need no first round.
"""

from collections.abc import Callable, Sequence

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import Effect
from discrepancy.missing_force.explained import ForceHypothesis
from discrepancy.missing_force.linear_trials import TrialMotion
from discrepancy.missing_force.naming import FOLLOWED_COUNTS, ForceSearch
from discrepancy.missing_force.trial import PortedTrial

from .estimator import SPEED_WINDOWS
from .gauss_newton import EstimatorStart
from .refinement import (
    estimate_extended_hypothesis,
    hypothesis_of_estimate,
    laws_and_estimator,
    refine_hypotheses,
)
from .trajectory import Trajectory

MOST_SAMPLES_OF_FIRST_ROUND = 3000
"""Number of samples of all trials together to which records are thinned in the first round. It is
enough to tell laws from each other, and records that are shorter are not thinned."""
THINNED_AT_LEAST = 2.0
"""Ratio of the number of samples to that number above which there is a first round."""
MOST_REFINED_SETS = 2
"""Largest number of sets of each length that are estimated with the motion in the first round."""
LEADING_RANGE = 12.0
"""Difference to the best score of the first round above which a hypothesis is dropped [nat]. In all
samples the difference is larger by about the factor of the thinning."""
MOST_LEADING = 3
"""Largest number of hypotheses with effects that are estimated in all samples."""


def rank_by_missing_force(
    search: ForceSearch,
    effects: Sequence[Effect],
    on_progress: Callable[[str], None] = lambda message: None,
) -> list[ForceHypothesis]:
    """Return hypotheses on the missing force, the most probable first.

    The best hypotheses are estimated together with the motion. Of long records, only the leading
    hypotheses and the one without effects are returned.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force in all samples.
    effects : sequence of Effect
        The effects that may be missing in the model.
    on_progress : callable
        The function that receives a line for the progress display, such as the comparison that
        runs.
    """
    thinned_search = search_in_thinned_records(search)
    if thinned_search is None:
        ranked_hypotheses = search.rank_hypotheses(effects, on_progress)
        return refine_hypotheses(search, ranked_hypotheses, len(effects), on_progress)
    ranked_hypotheses = _rank_in_thinned_records(thinned_search, effects, on_progress)
    hypotheses = [search.hypothesis_of_all_ports]
    for leading_hypothesis in _leading_hypotheses(thinned_search, ranked_hypotheses, len(effects)):
        on_progress(f"estimating {leading_hypothesis.candidate.description} in all samples")
        hypothesis = estimate_in_all_samples(search, leading_hypothesis)
        if hypothesis is not None:
            hypotheses.append(hypothesis)
    return sorted(hypotheses, key=lambda hypothesis: -search.score(hypothesis, len(effects)))


def search_in_thinned_records(search: ForceSearch) -> ForceSearch | None:
    """Return the search in thinned records, or None if the records are short.

    Parameters
    ----------
    search : ForceSearch
        The search in all samples.
    """
    trials = search.hypothesis_of_best_port().linear_trials.trials
    sample_count = sum(len(trial.time) for trial in trials)
    if sample_count < THINNED_AT_LEAST * MOST_SAMPLES_OF_FIRST_ROUND:
        return None
    thinned_search = ForceSearch(search.problem_with_laws, MOST_SAMPLES_OF_FIRST_ROUND)
    thinned_trials = thinned_search.hypothesis_of_best_port().linear_trials.trials
    is_thinned = any(trial.stride > 1 for trial in thinned_trials)
    return thinned_search if is_thinned else None


def _rank_in_thinned_records(
    search: ForceSearch, effects: Sequence[Effect], on_progress: Callable[[str], None]
) -> list[ForceHypothesis]:
    """Return the hypotheses of the first round, the most probable first.

    The best single effects are estimated together with the motion before others are added. Along a
    motion that is taken as known, the errors of a single law in a long record are large, and would
    be named as further effects.

    Parameters
    ----------
    search : ForceSearch
        The search in thinned records.
    effects : sequence of Effect
        The effects that may be missing in the model.
    on_progress : callable
        The function that receives a line for the progress display, such as the comparison that
        runs.
    """

    def score(hypothesis: ForceHypothesis) -> float:
        return search.score(hypothesis, len(effects))

    single_effects = search.rank_hypotheses(effects, on_progress, largest_set=1)
    hypotheses = refine_hypotheses(search, single_effects, len(effects), on_progress)
    best_hypothesis = hypotheses[0]
    for followed_count in FOLLOWED_COUNTS[1:]:
        if not best_hypothesis.candidate.terms:
            break
        extended_hypotheses = search.extend_hypothesis(
            best_hypothesis, effects, followed_count, on_progress
        )
        refined_hypotheses = []
        for hypothesis in extended_hypotheses[:MOST_REFINED_SETS]:
            on_progress(f"estimating {hypothesis.candidate.description} together with the motion")
            estimated_hypothesis = estimate_extended_hypothesis(search, hypothesis, best_hypothesis)
            refined_hypotheses.append(
                hypothesis if estimated_hypothesis is None else estimated_hypothesis
            )
        hypotheses += refined_hypotheses
        best_of_sets = max(refined_hypotheses, key=score, default=best_hypothesis)
        if score(best_of_sets) <= score(best_hypothesis):
            break
        best_hypothesis = best_of_sets
    return sorted(hypotheses, key=lambda hypothesis: -score(hypothesis))


def _leading_hypotheses(
    search: ForceSearch, ranked_hypotheses: Sequence[ForceHypothesis], effect_count: int
) -> list[ForceHypothesis]:
    """Return the hypotheses with effects that are estimated in all samples, the best first.

    These are the most probable ones, and the law of the best one with the other kind of shape: the
    verdict compares a law of canonical shape with that of free shape.

    Parameters
    ----------
    search : ForceSearch
        The search in thinned records.
    ranked_hypotheses : sequence of ForceHypothesis
        Its hypotheses, the most probable first.
    effect_count : int
        The number of effects that were compared.
    """
    with_effects = [hypothesis for hypothesis in ranked_hypotheses if hypothesis.candidate.terms]
    if not with_effects:
        return []
    best_hypothesis = with_effects[0]
    least_score = search.score(best_hypothesis, effect_count) - LEADING_RANGE
    leading_hypotheses = [
        hypothesis
        for hypothesis in with_effects[:MOST_LEADING]
        if search.score(hypothesis, effect_count) > least_score
    ]
    for hypothesis in with_effects:
        has_same_effects = hypothesis.candidate.identifiers == best_hypothesis.candidate.identifiers
        if (
            has_same_effects
            and hypothesis not in leading_hypotheses
            and len(leading_hypotheses) < MOST_LEADING
        ):
            leading_hypotheses.append(hypothesis)
    return leading_hypotheses


def estimate_in_all_samples(
    search: ForceSearch, hypothesis: ForceHypothesis
) -> ForceHypothesis | None:
    """Return a hypothesis that was fitted to thinned records, estimated in all samples.

    Parameters
    ----------
    search : ForceSearch
        The search in all samples.
    hypothesis : ForceHypothesis
        The hypothesis in the thinned trials, about whose unknowns the trials are linearised.

    Returns
    -------
    ForceHypothesis or None
        The hypothesis; None if its laws are not possible along the motion.
    """
    thinned_trials = hypothesis.linear_trials.trials
    shared_count = search.problem.shared.unknown_count
    shared_values = thinned_trials[0].linearisation_point[:shared_count]
    local_of_trials = [trial.linearisation_point[shared_count:] for trial in thinned_trials]
    trials = search.column_builder.trials_about(
        search.point_of_unknowns(shared_values, local_of_trials)
    )
    laws, estimator = laws_and_estimator(search, hypothesis.candidate, trials)
    trajectories = []
    for thinned_trial, trial, motion, own_unknowns in zip(
        thinned_trials, trials.trials, hypothesis.motions, hypothesis.local, strict=True
    ):
        unknowns = np.concatenate((hypothesis.shared, own_unknowns))
        trajectories.append(_trajectory_in_all_samples(thinned_trial, trial, motion, unknowns))
    start = EstimatorStart(
        hypothesis.effect, hypothesis.shared, tuple(trajectories), hypothesis.processes
    )
    estimate = estimator.polish(laws, start, hypothesis.speed_window or SPEED_WINDOWS[-1])
    if estimate is None:
        return None
    return hypothesis_of_estimate(search, hypothesis.candidate, trials, estimate)


def _trajectory_in_all_samples(
    thinned_trial: PortedTrial, trial: PortedTrial, motion: TrialMotion, unknowns: FloatArray
) -> Trajectory:
    """Return the motion of a thinned trial at all fine stamps of the record.

    The added state and the forces are interpolated. The motion of the ports is that of the model,
    which is known at all stamps, and what the added state adds to it.

    Parameters
    ----------
    thinned_trial, trial : PortedTrial
        The trial with some of its samples, and with all of them.
    motion : TrialMotion
        The motion of the thinned trial.
    unknowns : (K + L,) array
        The values of the shared unknowns, then of those of the trial alone.
    """
    time, thinned_time = trial.fine_time, thinned_trial.fine_time
    added_state = np.column_stack(
        [np.interp(time, thinned_time, state) for state in motion.added_state.T]
    )
    forces = {port: np.interp(time, thinned_time, force) for port, force in motion.forces.items()}
    positions, speeds = trial.port_motion(unknowns, added_state)
    return Trajectory(added_state, positions, speeds, forces)
