"""Whether it matters what an input does between its samples, which a record does not say."""

from dataclasses import replace

import numpy as np

from discrepancy.campaign.records import Campaign, Hold, Trial, TrialKind
from discrepancy.models.interface import Conditions, Model
from discrepancy.models.sensing import observe
from fe.runtime.patch import ModelPatch

MATTERS = 0.3
"""Difference between two readings of an input from which on it is said, in deviations of the noise (rms)."""


def hold_sentence(campaign: Campaign, model: Model, trial: Trial, conditions: Conditions) -> str | None:
    """Return what to say where straight lines and curves between an input's samples are not the same.

    None if no channel with a noise record sees a difference, or of every input it is said what it did.
    """
    forced = trial.kind is TrialKind.FORCED and trial.hold is None
    straight = ["force"] if forced else [item.name for item in trial.inputs if item.hold is None]
    if trial.kind not in (TrialKind.FORCED, TrialKind.DRIVEN) or not straight or len(trial.time) < 4:
        return None
    curved = tuple(
        replace(item, hold=Hold.SMOOTH) if item.name in straight else item for item in trial.inputs
    )
    one, other = (
        observe(model, campaign, item, ModelPatch(), conditions).values
        for item in (trial, replace(trial, inputs=curved, hold=Hold.SMOOTH if forced else trial.hold))
    )
    worst, where = 0.0, ""
    for column, name in enumerate(trial.channels):
        noise = campaign.channels[name].noise
        if noise is None:
            continue
        size = float(np.sqrt(np.mean((one - other)[:, column] ** 2))) / noise.standard_deviation
        if size > worst:
            worst, where = size, name
    if worst <= MATTERS:
        return None
    names = ", ".join(map(repr, straight))
    return (
        f"In the trial {trial.name!r} straight lines and curves between the samples of {names} differ by "
        f"{worst:.2g} noise deviations (rms) in {where!r}: say what it did, hold = "
        f'"smooth", "zero_order" or "linear" in its {"[[trial]]" if forced else "[[input]]"}, or record it '
        "faster."
    )
