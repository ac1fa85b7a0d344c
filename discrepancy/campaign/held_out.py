"""Which trials are held out for proof: whole trials or load levels, never samples of one record."""

from collections.abc import Sequence, Set
from dataclasses import replace

import numpy as np

from discrepancy.campaign.records import Campaign, Trial, TrialKind

HELD_OUT_SHARE = 0.25
"""Fraction of the trials of a kind that is held out."""
LEAST_TRIALS = 3
"""Fewest trials of a kind from which one may be held out."""
LEAST_LEVELS = 6
"""Fewest load levels of a trial from which some may be held out."""


def choose_held_out(campaign: Campaign) -> Campaign:
    """Return the campaign with some trials held out: the proof uses them, and the fit does not.

    A campaign in which trials are held out already is returned unchanged. Otherwise the trials of
    each kind (static, flight, ring-down and so on) are chosen by two rules without randomness:

    1. `_choose_trials` holds out a quarter of the trials of the kind, if there are at least three.
       It prefers trials at middle levels of load, because a model is to be proved between the
       levels of the fit and not beyond them.
    2. If rule 1 holds out no trial of the kind, and the kind is static or flight, then
       `_split_by_levels` splits each trial of the kind that has enough load levels: some of its
       levels become a second trial, which is held out.

    Returns
    -------
    Campaign
        The campaign with marked trials, and a remark on which trials are held out, or why none is.
    """
    if campaign.held_out:
        return campaign
    names = {trial.name for trial in campaign.trials}
    names_held_out: set[str] = set()
    split_trials: dict[str, tuple[Trial, Trial]] = {}  # fitted and held-out part, by trial name
    for kind in TrialKind:
        trials_of_kind = [trial for trial in campaign.trials if trial.kind is kind]
        # rule 1; the kinds before this one may have used up a channel that must stay in the fit
        names_of_kind = _choose_trials(trials_of_kind, campaign, names_held_out)
        names_held_out |= names_of_kind
        # rule 2
        if not names_of_kind and kind in (TrialKind.STATIC, TrialKind.FLIGHT):
            for trial in trials_of_kind:
                fitted_and_held_out = _split_by_levels(trial, names)
                if fitted_and_held_out is not None:
                    split_trials[trial.name] = fitted_and_held_out
    # mark the trials, in the order of the campaign
    marked_trials: list[Trial] = []
    for trial in campaign.trials:
        if trial.name in split_trials:
            marked_trials += split_trials[trial.name]
        else:
            marked_trials.append(replace(trial, held_out=trial.name in names_held_out))
    remark = _held_out_remark(marked_trials)
    return replace(campaign, trials=tuple(marked_trials), remarks=(*campaign.remarks, remark))


def _held_out_remark(trials: Sequence[Trial]) -> str:
    """Return the sentence on which of the trials are held out."""
    names = [trial.name for trial in trials if trial.held_out]
    if names:
        return f"Held out for proof by the rule of the workflow: {', '.join(names)}."
    return (
        "Nothing is held out for proof: there are too few trials to spare one. Mark a trial with "
        "`held_out = true`, or measure one more at another level."
    )


def _choose_trials(
    trials: Sequence[Trial], campaign: Campaign, held_out_before: set[str]
) -> set[str]:
    """Choose the trials of one kind to hold out, and return their names.

    Of three or more trials, at most a quarter (rounded, but at least one) is chosen; of fewer, none
    is. Trials at middle load levels come first, see `_order_of_candidates`. A trial is chosen only
    if its channels, its run and its load place still occur in trials that remain for the fit.

    Parameters
    ----------
    trials : sequence of Trial
        All trials of the kind.
    campaign : Campaign
        The campaign with all of its trials.
    held_out_before : set of str
        The names of the trials of other kinds that are held out already.
    """
    if len(trials) < LEAST_TRIALS:
        return set()
    count = max(1, round(HELD_OUT_SHARE * len(trials)))
    chosen_names: set[str] = set()
    for index in _order_of_candidates(trials):
        if len(chosen_names) == count:
            break
        candidate = trials[index]
        # the trials that would remain for the fit without the candidate
        remaining_of_kind = [
            trial for trial in trials if trial.name not in chosen_names | {candidate.name}
        ]
        remaining_of_other_kinds = [
            trial
            for trial in campaign.trials
            if trial.kind is not candidate.kind and trial.name not in held_out_before
        ]
        if _stays_covered(candidate, remaining_of_kind, remaining_of_other_kinds):
            chosen_names.add(candidate.name)
    return chosen_names


def _order_of_candidates(trials: Sequence[Trial]) -> list[int]:
    """Return the indices of trials in the order in which they are considered for holding out.

    Trials with load levels between the extremes come first, beginning with the level nearest to the
    middle. Of trials with equal levels, the later one comes first.
    """
    levels = np.array([trial.level for trial in trials])
    lowest = levels.min()
    highest = levels.max()
    middle = 0.5 * (lowest + highest)
    is_inside = (levels > lowest) & (levels < highest)

    def priority(index: int) -> tuple[bool, float, int]:
        # sorted ascending: False (inside the range) comes before True, a later trial has a lower -i
        return not is_inside[index], float(abs(levels[index] - middle)), -index

    return sorted(range(len(trials)), key=priority)


def _stays_covered(
    candidate: Trial, other_trials: Sequence[Trial], of_other_kinds: Sequence[Trial]
) -> bool:
    """Return whether the remaining trials have the channels, run, place and level of a candidate.

    Its level must lie between the lowest and the highest level of the remaining trials.

    Parameters
    ----------
    candidate : Trial
        The trial that may be held out.
    other_trials : sequence of Trial
        The other trials of its kind that are fitted.
    of_other_kinds : sequence of Trial
        The fitted trials of other kinds, which cover the run only.
    """
    channels = {name for trial in other_trials for name in trial.channels}
    if not channels.issuperset(candidate.channels):
        return False
    if not any(trial.run == candidate.run for trial in (*other_trials, *of_other_kinds)):
        return False
    if not any(trial.load_place == candidate.load_place for trial in other_trials):
        return False
    # without the extreme level the model would be proved beyond the levels that it was fitted to
    levels = [trial.level for trial in other_trials]
    is_above_lowest = min(levels) <= candidate.level * (1.0 + 1e-9)
    is_below_highest = max(levels) >= candidate.level * (1.0 - 1e-9)
    return is_above_lowest and is_below_highest


def _split_by_levels(trial: Trial, names: Set[str]) -> tuple[Trial, Trial] | None:
    """Split a trial into a fitted and a held-out one, which has every third interior load level.

    Parameters
    ----------
    trial : Trial
        A static or flight trial.
    names : set of str
        The names of the existing trials, which the new held-out trial must not have.

    Returns
    -------
    (Trial, Trial) or None
        The trial to fit and the trial held out. None if the trial has fewer than `LEAST_LEVELS`
        load levels, or if its load does not only rise or only fall: a load cycle has to stay whole.
    """
    load = trial.load
    steps = np.diff(load)
    levels = np.unique(load)
    is_monotonic = np.all(steps >= 0.0) or np.all(steps <= 0.0)
    if len(levels) < LEAST_LEVELS or not is_monotonic:
        return None
    # from the third level on; the lowest and the highest stay in the fit and bound its range
    is_held_out = np.isin(load, levels[2:-1:3])
    name = f"{trial.name}, levels held out"
    while name in names:
        name += "'"
    return trial.rows(~is_held_out), trial.rows(is_held_out, name=name, held_out=True)
