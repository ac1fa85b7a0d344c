"""Records that no sensor made: a value held while all else moves, and a channel that is another one."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from discrepancy.campaign.records import BoolArray, Campaign, FloatArray, Trial

from .fault import DataFault, FaultKind, fault, place_of

LEAST_HELD = 8
"""Fewest equal readings in a row that are looked at."""
_BESIDE = 4  # a run is judged beside so many times its length before and after it
_ALIKE = 0.25  # runs of at least this share of its length are its like: pauses, square waves, coarse digits
_MOST_ALIKE = 1.0 / 3.0  # share of the surroundings that its like may hold
_JUMP = 3.0  # digits in one sample that no turning point makes
_PACE = 0.25  # share of the mean step beside a run that is no standstill either
_MOVING, _RESTING = 0.5, 0.25  # range of another record meanwhile, over its usual one in such a time
_NOISE_DIGITS = 2.0  # noise of so many digits does not let a reading come twice
COPIED = 0.01
"""A channel is a copy if another leaves less than this share of its own noise."""
LEAST_COPIED = 32
_LAGS = 2**14  # samples in which the shift between two channels is looked for


def roughness(values: FloatArray) -> float:
    """Return the standard deviation of white noise that the sixth differences of a record would show.

    Robust (median absolute deviation); differences of the sixth order take out motions of more than some
    eight samples per period.
    """
    differences = np.diff(values, 6)
    return float(1.4826 * np.median(np.abs(differences)) / np.sqrt(924.0))  # sum of squared binomials


# ---------------------------------------------------------------- held


def held_faults(campaign: Campaign, trial: Trial) -> Iterator[DataFault]:
    """Yield a fault for each stretch of a record in time in which a channel stood still and should not have.

    See `held_span` for what is told from a pause, a square wave, a coarse converter or a rest.
    """
    series = np.column_stack([trial.values, *(item.values for item in trial.inputs)])
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

    Noise of more than two digits shows at rest too: any run is at fault. Else, what stands still comes to
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
    same = np.concatenate(([False], (np.diff(values) == 0.0) & used[1:] & used[:-1], [False]))
    edges = np.flatnonzero(np.diff(same.astype(np.int8)))
    runs = np.stack((edges[::2], edges[1::2] + 1), axis=1)
    lengths = runs[:, 1] - runs[:, 0]
    long = runs[lengths >= LEAST_HELD].tolist()
    distinct = np.unique(values)
    if len(distinct) < 3 or not long:
        return []
    bends = np.abs(np.diff(values, 2))  # a record that rises all the way passes over digits, its bends do not
    digit = min(np.diff(distinct).min(), bends[bends > 1e-9 * np.ptp(values)].min(initial=np.inf))
    inner = [run for run in long if values[run[0]] not in (distinct[0], distinct[-1])]  # else told as clipped
    if min(noise, roughness(values)) > _NOISE_DIGITS * digit:
        return [(start, stop) for start, stop in inner]
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


# ---------------------------------------------------------------- copied


def copy_faults(campaign: Campaign) -> Iterator[DataFault]:
    """Yield a fault for each pair of channels of which one is the other, scaled or shifted or neither."""
    found: dict[tuple[str, str], list[tuple[Trial, str]]] = {}
    for trial in campaign.trials:
        if trial.is_dynamic:
            for one, other, how in _copies(trial):
                found.setdefault((one, other), []).append((trial, how))
    for (one, other), where in found.items():
        trial, how = where[0]
        more = f", and so in {len(where) - 1} more of its trials" if len(where) > 1 else ""
        place = place_of(campaign.channels[other], trial)
        yield fault(FaultKind.COPIED, other, trial.name, one=one, how=how, place=place, more=more)


def _copies(trial: Trial) -> Iterator[tuple[str, str, str]]:
    """Yield pairs of channels of a trial that are copies, and how."""
    if len(trial.time) < LEAST_COPIED:
        return
    rough = np.diff(trial.values[:_LAGS], 6, axis=0)
    limit = 15.0 * np.median(np.abs(rough), axis=0)  # a jump or a wrong reading would outweigh all noise
    rough = np.where((np.abs(rough) > limit) & (limit > 0.0), 0.0, rough)
    size = np.sum(rough**2, axis=0)
    # Sixth differences of noise turn at each sample; those of a motion without noise do not.
    noisy = np.sum(rough[1:] * rough[:-1], axis=0) < -0.5 * size
    spectra = np.fft.rfft(rough, 2 * len(rough), axis=0)
    changes = np.count_nonzero(np.diff(trial.values, axis=0), axis=0)
    for i, j in combinations(range(len(trial.channels)), 2):
        if not (noisy[i] and noisy[j]):
            if changes[i] >= 2 * LEAST_COPIED and np.array_equal(trial.values[:, i], trial.values[:, j]):
                yield trial.channels[i], trial.channels[j], "digit for digit"
            continue
        products = np.fft.irfft(spectra[:, j] * np.conj(spectra[:, i]))
        at = int(np.argmax(np.abs(products)))
        if abs(products[at]) < 0.5 * np.sqrt(size[i] * size[j]):
            continue
        shift = at if at < len(rough) else at - len(products)
        how = _copied(trial.values[:, i], trial.values[:, j], trial.used[:, i], trial.used[:, j], shift)
        if how:
            yield trial.channels[i], trial.channels[j], how


def _copied(one: FloatArray, other: FloatArray, first: BoolArray, second: BoolArray, shift: int) -> str:
    """Return how the other is the one so many samples earlier; empty if it is not."""
    count = len(one) - abs(shift)
    a, b = max(-shift, 0), max(shift, 0)
    kept = first[a : a + count] & second[b : b + count]
    x, y = one[a : a + count][kept], other[b : b + count][kept]
    noise = roughness(y) or float(np.std(np.diff(y, 6)) / np.sqrt(924.0)) if len(y) >= LEAST_COPIED else 0.0
    if noise == 0.0 or len(np.unique(x)) < LEAST_COPIED // 2:
        return ""
    late = f", {abs(shift)} samples {'later' if shift > 0 else 'earlier'}," if shift else ""
    if np.array_equal(x, y):
        return f"digit for digit{late}"
    centred = x - x.mean()
    scale = float(centred @ (y - y.mean()) / (centred @ centred))
    rest = float(np.std(y - scale * x))
    return f"times {scale:.6g}{late}" if rest < COPIED * noise else ""
