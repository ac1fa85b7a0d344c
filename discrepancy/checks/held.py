"""Channels that stand still within a motion: which runs of equal readings no sensor makes."""

from collections.abc import Iterator

import numpy as np

from discrepancy.campaign.records import BoolArray, Campaign, FloatArray, IntArray, Trial, TrialKind
from discrepancy.campaign.sampling import lattice_step, least_beyond_rounding, quantum_of
from discrepancy.checks.fault import DataFault, FaultKind, fault, place_of

LEAST_HELD = 8
"""Fewest equal readings in a row that are looked at."""
_BESIDE = 4  # a run is judged beside so many times its length before and after it
_ALIKE = 0.25  # runs of at least this share of its length are its like: pauses, square waves, coarse digits
_MOST_ALIKE = 1.0 / 3.0  # share of the surroundings that its like may hold
_JUMP = 3.0  # digits in one sample that no turning point makes
_PACE = 0.25  # share of the mean step beside a run that is no standstill either
_MOVING, _RESTING = 0.5, 0.25  # range of another record meanwhile, over its usual one in such a time
_NOISE_DIGITS = 2.0  # noise of so many digits does not let a reading come twice
_LEAST_UPDATES = 4.0  # so many updates of a sensor that is slower than its logger must show one value


def roughness(values: FloatArray) -> float:
    """Return the standard deviation of white noise that the sixth differences of a record would show.

    Robust (median absolute deviation); differences of the sixth order take out motions of more than some
    eight samples per period.
    """
    differences = np.diff(values, 6)
    return float(1.4826 * np.median(np.abs(differences)) / np.sqrt(924.0))  # sum of squared binomials


def runs_of(at: BoolArray) -> IntArray:
    """Return the first sample (R, 2) of each run of true ones, and the one after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], at, [False])).astype(np.int8)))
    return np.stack((edges[::2], edges[1::2]), axis=1)


def held_faults(campaign: Campaign, trial: Trial) -> Iterator[DataFault]:
    """Yield a fault for each stretch of a record in time in which a channel stood still and should not have.

    See `held_span` for what is told from a pause, a square wave, a coarse converter or a rest.
    """
    force = [trial.force] if trial.kind is TrialKind.FORCED else []
    series = np.column_stack([trial.values, *(item.values for item in trial.inputs), *force])
    for column, name in enumerate(trial.channels):
        channel = campaign.channels[name]
        noise = channel.noise_in(trial)
        others = np.delete(series, column, axis=1)
        for start, stop in held_spans(trial.values[:, column], trial.used[:, column], others, noise):
            place = place_of(channel, trial, start, stop)
            yield fault(FaultKind.FROZEN, name, trial.name, count=stop - start, place=place)


def held_spans(
    values: FloatArray, used: BoolArray, others: FloatArray, noise: float = 0.0
) -> list[tuple[int, int]]:
    """Return the runs of equal readings, first sample and the one after the last, that are no rest.

    Noise of more than two digits shows at rest too: any run is at fault that is longer than four updates of
    the sensor, which may be slower than its logger. Else, what stands still comes to
    rest before it and starts from rest: its readings go into the run and out of it by a digit at a time. A
    run counts where the record goes in and out at speed; where it does so on one side only, another record
    must go on moving meanwhile, and the run be alone of its kind. Other records that come to rest with it
    acquit it, and so do a second run at the same value (a dead zone) and a third of the surroundings in runs
    alike (a square wave, pauses).

    Parameters
    ----------
    values : (N,) ndarray
        A record in time.
    used : (N,) ndarray of bool
        Samples that count.
    others : (N, K) ndarray
        What else was recorded.
    noise : float
        Standard deviation of the channel's noise; 0: not known.
    """
    runs = runs_of((np.diff(values) == 0.0) & used[1:] & used[:-1]) + np.array([0, 1])
    lengths = runs[:, 1] - runs[:, 0]
    long = runs[lengths >= LEAST_HELD].tolist()
    distinct = np.unique(values)
    if len(distinct) < 3 or not long:
        return []
    digit, updates = _digit_in_time(values), update_length(values)
    inner = [run for run in long if values[run[0]] not in (distinct[0], distinct[-1])]  # else told as clipped
    if min(noise, roughness(values)) > _NOISE_DIGITS * digit:
        return [(start, stop) for start, stop in inner if stop - start >= _LEAST_UPDATES * updates]
    steps = np.abs(np.diff(values, prepend=values[:1], append=values[-1:]))  # into each sample, and the last
    found = []
    for start, stop in inner:
        length = stop - start
        if max(steps[start], steps[stop]) < _JUMP * digit:
            continue
        low, high = max(start - _BESIDE * length, 0), min(stop + _BESIDE * length, len(values))
        like = lengths >= _ALIKE * length
        inside = like & (runs[:, 0] >= low) & (runs[:, 1] <= high)
        dead_zone = np.count_nonzero(values[runs[like, 0]] == values[start]) > 1
        windows = [*range(start - length, low - 1, -length), *range(stop, high - length + 1, length)]
        if len(windows) < 2 or dead_zone or lengths[inside].sum() > _MOST_ALIKE * (high - low):
            continue
        speed = max(_JUMP * digit, _PACE * float(np.mean(np.r_[steps[low : start + 1], steps[stop:high]])))
        fast = int(steps[start] >= speed) + int(steps[stop] >= speed)
        usual = np.median([np.ptp(others[at : at + length], axis=0) for at in windows], axis=0)
        meanwhile = np.ptp(others[start:stop], axis=0)
        moving = bool(np.any((meanwhile > _MOVING * usual) & (usual > 0.0)))
        resting = not moving and bool(np.any(meanwhile < _RESTING * usual))
        if (fast == 2 and not resting) or (fast and moving and np.count_nonzero(like) == 1):
            found.append((start, stop))
    return found


def _digit_in_time(values: FloatArray) -> float:
    """Return the quantum of a record in time.

    A record that rises all the way passes over values of its sensor; its second differences do not.
    """
    step = lattice_step(values)
    if step is not None:
        return step
    bends = np.abs(np.diff(values, 2))
    least_bend = least_beyond_rounding(bends[bends > 1e-9 * np.ptp(values)])
    return min(quantum_of(values), least_bend or np.inf)


def update_length(values: FloatArray) -> float:
    """Return how many samples a logger usually takes of each reading of a sensor.

    It is the median length of runs of equal readings; 1 where the sensor's quantum is why readings repeat.

    Parameters
    ----------
    values : (N,) ndarray
        A record in time.
    """
    if lattice_step(values) is not None:
        return 1.0
    changes = np.flatnonzero(np.diff(values))
    return float(np.median(np.diff(changes))) if len(changes) > 1 else 1.0
