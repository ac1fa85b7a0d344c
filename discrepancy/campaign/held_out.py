"""Which trials are kept for proof: whole trials or whole load levels, never samples of one record."""

from collections import Counter
from dataclasses import replace

import numpy as np

from discrepancy.campaign.records import Campaign, Trial, TrialKind
from discrepancy.errors import said

SHARE = 0.25
"""Share of the trials of a kind that is held out."""
LEAST_TRIALS = 3
"""Fewest trials of a kind of which one can be spared."""
LEAST_LEVELS = 6
"""Fewest load levels of a trial of which some can be spared."""


def choose_held_out(campaign: Campaign) -> Campaign:
    """Return the campaign with trials held out; unchanged if some are already.

    The rule, by kind of trial, is the same for the same campaign:

    1. Of three or more trials, a quarter (rounded, at least one) is held out. Candidates come in the order of
       their level (release displacement, largest force or load factor), those inside the range of levels
       first, from the middle outwards, because proof between levels is asked for and not beyond them; of
       equal levels the later trial. A trial is spared only if every channel, every run and every set of
       inputs' kind that it has stays with the trials that are left.
    2. If that spares none of a static or flight kind, every third interior load level of each trial with at
       least six levels is held out as a trial of its own, if its load rises or falls all the way (a loading
       path that turns must stay whole).

    Returns
    -------
    Campaign
        With a remark on what was held out, or on why nothing was.
    """
    if campaign.held_out:
        return campaign
    chosen: set[str] = set()
    split: dict[str, tuple[Trial, Trial]] = {}
    for kind in TrialKind:
        trials = [trial for trial in campaign.trials if trial.kind is kind]
        spared = _spared(trials, campaign, chosen)
        chosen |= spared
        if not spared and kind in (TrialKind.STATIC, TrialKind.FLIGHT):
            for trial in trials:
                parts = _split(trial, {item.name for item in campaign.trials})
                if parts:
                    split[trial.name] = parts
    kept: list[Trial] = []
    for trial in campaign.trials:
        kept += split.get(trial.name, (replace(trial, held_out=trial.name in chosen),))
    held = ", ".join(trial.name for trial in kept if trial.held_out)
    remark = said("remarks.held_out", names=held) if held else said("remarks.nothing_held_out")
    return replace(campaign, trials=tuple(kept), remarks=(*campaign.remarks, remark))


def _spared(trials: list[Trial], campaign: Campaign, taken: set[str]) -> set[str]:
    if len(trials) < LEAST_TRIALS:
        return set()
    wanted = max(1, round(SHARE * len(trials)))
    levels = np.array([trial.level for trial in trials])
    middle = 0.5 * (levels.min() + levels.max())
    inside = (levels > levels.min()) & (levels < levels.max())
    # Stable: inside first, then by distance from the middle, then the later trial.
    order = sorted(range(len(trials)), key=lambda i: (not inside[i], float(abs(levels[i] - middle)), -i))
    spared: set[str] = set()
    for index in order:
        if len(spared) == wanted:
            break
        left = [trial for trial in trials if trial.name not in spared | {trials[index].name}]
        others = [
            trial
            for trial in campaign.trials
            if trial.kind is not trials[index].kind and trial.name not in taken
        ]
        if _stays_covered(trials[index], left, others):
            spared.add(trials[index].name)
    return spared


def _stays_covered(trial: Trial, left: list[Trial], others: list[Trial]) -> bool:
    """Return whether channels, run, place and level of a trial are still there without it."""
    channels = Counter(name for item in left for name in item.channels)
    levels = [item.level for item in left]
    return (
        all(channels[name] for name in trial.channels)
        and any(item.run == trial.run for item in left + others)
        and any(item.load_place == trial.load_place for item in left)
        # Without the extreme level the model would be proved beyond what it has seen.
        and min(levels) <= trial.level * (1.0 + 1e-9)
        and max(levels) >= trial.level * (1.0 - 1e-9)
    )


def _split(trial: Trial, names: set[str]) -> tuple[Trial, Trial] | None:
    """Return a trial without every third interior level, and those levels as a trial that is held out."""
    load, steps = trial.load, np.diff(trial.load)
    levels = np.unique(load)
    if len(levels) < LEAST_LEVELS or not (np.all(steps >= 0.0) or np.all(steps <= 0.0)):
        return None
    spared = np.isin(load, levels[2:-1:3])
    name = f"{trial.name}, levels held out"
    while name in names:
        name += "'"
    return trial.rows(~spared), trial.rows(spared, name=name, held_out=True)
