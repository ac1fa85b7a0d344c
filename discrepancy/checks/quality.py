"""Faults that a campaign shows without a model: noise records, clipped, dead, frozen and copied channels.

What makes a campaign unreadable (missing columns, uneven sampling, gaps, NaN) is refused by the reader at
once; what only a model can tell (units, signs, swapped channels, length) is in
`discrepancy.checks.model_check`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.stats import f as fisher

from discrepancy.campaign.noise_records import repeat_record
from discrepancy.campaign.records import BoolArray, Campaign, Channel, FloatArray, Trial

from .fault import DataFault, FaultKind, fault
from .held_and_copied import copy_faults, held_faults, roughness
from .model_check import check_against_model
from .outliers import LARGEST_SHARE, find_outliers, mark_outliers
from .rest import rest_faults

__all__ = ["DataFault", "FaultKind", "check_against_model", "check_data", "mark_outliers"]

CLIPPED_RUN = 3
"""Consecutive samples at the very extreme value that make a record clipped, if it gets there in a jump."""
_ALPHA = 1e-3
_NOISE_FACTOR = 2.0


def check_data(campaign: Campaign) -> tuple[DataFault, ...]:
    """Return the faults that a campaign shows by itself, by channel and trial.

    A channel without a noise record, or whose noise record contradicts repeats (F test at 0.1 %) or the
    record itself (by a factor of two) or moves, is reported as a limit; a dead, clipped, frozen or copied
    channel, or more than 3 % of outliers in a record in time, as a fault of the data (`DataFault.fatal`).
    """
    faults: list[DataFault] = []
    for name, channel in campaign.channels.items():
        if channel.noise is None:
            faults.append(fault(FaultKind.NO_NOISE_RECORD, name))
        else:
            faults += _noise_faults(campaign, channel)
    for trial in campaign.trials:
        for column, name in enumerate(trial.channels):
            faults += _record_faults(trial, name, trial.values[:, column], trial.used[:, column])
        if trial.is_dynamic:
            faults += held_faults(campaign, trial)
    faults += copy_faults(campaign)
    faults += rest_faults(campaign)
    for trial_name, name, found in find_outliers(campaign):
        trial = next(item for item in campaign.trials if item.name == trial_name)
        if trial.is_dynamic and found.sum() > LARGEST_SHARE * len(found):
            share = float(found.mean())
            faults.append(fault(FaultKind.OUTLIERS, name, trial_name, share=share, most=LARGEST_SHARE))
    return tuple(faults)


# ---------------------------------------------------------------- noise


def _noise_faults(campaign: Campaign, channel: Channel) -> Iterator[DataFault]:
    record = channel.noise
    if record is None or record.source == "repeats":
        return
    stated = record.standard_deviation
    found = repeat_record(channel, campaign.trials)
    if found is not None:
        ratio = (found.standard_deviation / stated) ** 2
        freedom = min(record.degrees_of_freedom, 1e9)
        tail = min(side(ratio, found.degrees_of_freedom, freedom) for side in (fisher.sf, fisher.cdf))
        if 2.0 * tail < _ALPHA and not 1.0 / _NOISE_FACTOR**2 < ratio < _NOISE_FACTOR**2:
            yield _noise_fault(channel, stated, found.standard_deviation, "repeated trials scatter")
            return
    rough = [
        roughness(trial.values[:, column]) / trial.noise_factor
        for trial in campaign.trials
        if trial.is_dynamic
        for column, name in enumerate(trial.channels)
        if name == channel.name and len(trial.time) >= 50
    ]
    # Only downwards: a fast mode may well be rougher than the noise, but nothing is smoother than its noise.
    if rough:
        white = min(rough)
        if 0.0 < white < stated / _NOISE_FACTOR:
            yield _noise_fault(channel, stated, white, "neighbouring samples scatter")


def _noise_fault(channel: Channel, stated: float, found: float, what: str) -> DataFault:
    return fault(FaultKind.NOISE_LABEL, channel.name, stated=stated, found=found, what=what)


# ---------------------------------------------------------------- records


def _record_faults(trial: Trial, name: str, values: FloatArray, used: BoolArray) -> Iterator[DataFault]:
    kept = values[used]
    if len(kept) < 3:
        return
    load = trial.load_factor if np.any(trial.load_factor) else trial.force
    excited = trial.is_dynamic or np.ptp(load[used]) > 0.0
    if excited and np.ptp(kept) == 0.0:
        yield fault(FaultKind.DEAD, name, trial.name)
        return
    order = np.arange(len(kept)) if trial.is_dynamic else np.argsort(load[used], kind="stable")
    sorted_load = None if trial.is_dynamic else load[used][order]
    for extreme, side in ((kept.max(), "largest"), (kept.min(), "smallest")):
        run = clipped_run(kept[order], float(extreme), sorted_load)
        if run:
            yield fault(FaultKind.CLIPPED, name, trial.name, run=run, side=side, extreme=float(extreme))


def clipped_run(values: FloatArray, extreme: float, load: FloatArray | None = None) -> int:
    """Return the longest run of readings that stand at an extreme where they should not; 0 if there is none.

    Records in time: a parabola through three samples on either side of the run must go beyond the extreme by
    more than three digits (the least difference of two readings) and six deviations of the record's white
    noise; a record of few digits is flat at its turning points too, but by a digit. Static readings, in the
    order of their load: the run must span three loads, and nowhere else may two neighbours be alike.
    """
    distinct = np.unique(values)
    if len(distinct) < 3:
        return 0
    at = np.concatenate([[False], values == extreme, [False]])
    edges = np.flatnonzero(np.diff(at.astype(np.int8)))
    runs = [(int(start), int(stop)) for start, stop in zip(edges[::2], edges[1::2], strict=True)]
    runs = [(start, stop) for start, stop in runs if stop - start >= CLIPPED_RUN]
    if load is not None:
        for start, stop in runs:
            outside = np.concatenate([np.diff(values[:start]), np.diff(values[stop:])])
            if outside.size and np.all(outside != 0.0) and np.unique(load[start:stop]).size >= CLIPPED_RUN:
                return stop - start
        return 0
    if not runs:
        return 0
    limit = 3.0 * float(np.diff(distinct).min()) + 6.0 * roughness(values)
    return max((stop - start for start, stop in runs if _overshoot(values, start, stop) > limit), default=0)


def _overshoot(values: FloatArray, start: int, stop: int) -> float:
    """Return by how much a parabola through the samples beside a run goes beyond the run's value."""
    beside = np.concatenate([np.arange(start - 3, start), np.arange(stop, stop + 3)])
    if beside[0] < 0 or beside[-1] >= len(values):
        return 0.0
    middle = 0.5 * (start + stop - 1)
    parabola = np.polynomial.Polynomial.fit(beside - middle, values[beside], 2)
    return float(abs(parabola(0.0) - values[start]))
