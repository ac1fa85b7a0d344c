"""Channels that stand still within a motion: runs of equal readings that no sensor makes."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import (
    BoolArray,
    Campaign,
    FloatArray,
    IntArray,
    Trial,
    TrialKind,
)
from discrepancy.campaign.sampling import lattice_step, least_beyond_rounding, quantum_of
from discrepancy.checks.fault import DataFault, FaultKind, place_of

LEAST_HELD = 8
"""Fewest equal readings in a row that are examined."""
_SURROUNDINGS = 4
"""Length of the surroundings before and after a run, in lengths of the run."""
_COMPARABLE = 0.25
"""Relative length from which another run is comparable: pauses, square waves, coarse digits."""
_MOST_COMPARABLE = 1.0 / 3.0
"""Largest fraction of the surroundings that comparable runs may take."""
_JUMP = 3.0
"""Change of a reading in one sample, in digits, that no turning point makes."""
_PACE = 0.25
"""Change into or out of a run, over the mean change around it, that is no gradual standstill."""
_MOVING = 0.5
"""Range of another record during the run, over its usual one, from which on it moves."""
_RESTING = 0.25
"""The same ratio, below which it rests."""
_NOISE_DIGITS = 2.0
"""Noise in digits above which a reading hardly comes twice."""
_LEAST_UPDATES = 4.0
"""Fewest updates of a sensor, slower than its logger, that must show one value for a fault."""


def roughness(values: FloatArray) -> float:
    """Return the standard deviation of white noise that explains a record's sixth differences.

    It is robust (median absolute deviation). Differences of the sixth order take out motions with
    more than some eight samples in a period.

    Parameters
    ----------
    values : (N,) ndarray
        A record in time.
    """
    differences = np.diff(values, 6)
    # 924 is the sum of the squared binomial coefficients of order six
    return float(1.4826 * np.median(np.abs(differences)) / np.sqrt(924.0))


def runs_of(flags: BoolArray) -> IntArray:
    """Return the runs of true entries (R, 2): the first index, and the one after the last."""
    padded = np.concatenate(([False], flags, [False])).astype(np.int8)
    edges = np.flatnonzero(np.diff(padded))
    return np.stack((edges[::2], edges[1::2]), axis=1)


def held_faults(campaign: Campaign, trial: Trial) -> Iterator[DataFault]:
    """Yield a fault for each stretch of a dynamic trial in which a channel stands still by mistake.

    `held_spans` distinguishes it from a pause, a square wave, a coarse converter and a rest.
    """
    series = [trial.values]
    series += [recorded.values[:, np.newaxis] for recorded in trial.inputs]
    if trial.kind is TrialKind.FORCED:
        series.append(trial.force[:, np.newaxis])
    recorded_values = np.concatenate(series, axis=1)
    for column, name in enumerate(trial.channels):
        channel = campaign.channels[name]
        spans = held_spans(
            trial.values[:, column],
            trial.used[:, column],
            np.delete(recorded_values, column, axis=1),
            trial.noise_deviation(channel),
        )
        for start, stop in spans:
            sentence = (
                f"The channel {name!r} holds one value over {stop - start} samples within a "
                f"motion, in {place_of(channel, trial, start, stop)}: empty these cells, or leave "
                "the channel out of the trial, and check sensor and logger."
            )
            yield DataFault(FaultKind.FROZEN, sentence, name, trial.name)


class _RunsOfRecord(NamedTuple):
    """A record in time, and its runs of equal readings.

    Attributes
    ----------
    values : (N,) ndarray
        The record.
    changes : (N + 1,) ndarray
        Absolute change into each sample; the last entry is zero.
    digit : float
        Quantum of the record.
    bounds : (R, 2) ndarray of int
        First sample of each run, and the one after its last.
    lengths : (R,) ndarray of int
        Lengths of the runs in samples.
    """

    values: FloatArray
    changes: FloatArray
    digit: float
    bounds: IntArray
    lengths: IntArray


def held_spans(
    values: FloatArray, used: BoolArray, others: FloatArray, noise: float = 0.0
) -> list[tuple[int, int]]:
    """Return the runs of equal readings at which a sensor or logger failed.

    Noise of more than two digits shows at rest too, so that any run is at fault that is longer than
    four updates of the sensor (which may be slower than its logger). Without such noise, a
    structure comes to rest before it stands still, and starts from rest: its readings go into and
    out of the run by single digits. A run is at fault if the record goes in and out at speed. If it
    does so on one side only, another record must move meanwhile, and no other run be comparable.
    The following acquit a run: other records that rest meanwhile, a second run at the same value (a
    dead zone), and comparable runs over a third of the surroundings (a square wave, pauses).

    Parameters
    ----------
    values : (N,) ndarray
        A record in time.
    used : (N,) ndarray of bool
        False for samples that are left out.
    others : (N, K) ndarray
        The other records of the trial.
    noise : float
        Standard deviation of the channel's noise; 0 if it is not known.

    Returns
    -------
    list of (int, int)
        First sample of each run, and the one after its last.
    """
    is_equal_to_next = (np.diff(values) == 0.0) & used[1:] & used[:-1]
    bounds = runs_of(is_equal_to_next) + np.array([0, 1])
    lengths = bounds[:, 1] - bounds[:, 0]
    long_runs = bounds[lengths >= LEAST_HELD].tolist()
    distinct = np.unique(values)
    if len(distinct) < 3 or not long_runs:
        return []
    # runs at an extreme value are clipped, which is another fault
    extremes = (distinct[0], distinct[-1])
    inner_runs = [(start, stop) for start, stop in long_runs if values[start] not in extremes]
    digit = _digit_in_time(values)
    if min(noise, roughness(values)) > _NOISE_DIGITS * digit:
        least_length = _LEAST_UPDATES * update_length(values)
        return [(start, stop) for start, stop in inner_runs if stop - start >= least_length]
    changes = np.abs(np.diff(values, prepend=values[:1], append=values[-1:]))
    runs = _RunsOfRecord(values, changes, digit, bounds, lengths)
    return [(start, stop) for start, stop in inner_runs if _is_failure(start, stop, runs, others)]


def _is_failure(start: int, stop: int, runs: _RunsOfRecord, others: FloatArray) -> bool:
    """Return whether a run in a record without much noise is a failure and not a rest.

    `held_spans` states the rules.

    Parameters
    ----------
    start, stop : int
        First sample of the run, and the one after its last.
    runs : _RunsOfRecord
        The record and all its runs.
    others : (N, K) ndarray
        The other records.
    """
    length = stop - start
    least_jump = _JUMP * runs.digit
    if max(runs.changes[start], runs.changes[stop]) < least_jump:
        return False

    # comparable runs acquit it: a dead zone, or pauses that fill much of the surroundings
    low = max(start - _SURROUNDINGS * length, 0)
    high = min(stop + _SURROUNDINGS * length, len(runs.values))
    is_comparable = runs.lengths >= _COMPARABLE * length
    is_near = is_comparable & (runs.bounds[:, 0] >= low) & (runs.bounds[:, 1] <= high)
    values_of_comparable = runs.values[runs.bounds[is_comparable, 0]]
    is_dead_zone = np.count_nonzero(values_of_comparable == runs.values[start]) > 1
    windows = [*range(start - length, low - 1, -length), *range(stop, high - length + 1, length)]
    comparable_samples = runs.lengths[is_near].sum()
    if len(windows) < 2 or is_dead_zone or comparable_samples > _MOST_COMPARABLE * (high - low):
        return False

    # does the record go in and out at speed?
    changes_around = np.r_[runs.changes[low : start + 1], runs.changes[stop:high]]
    speed = max(least_jump, _PACE * float(np.mean(changes_around)))
    sides_at_speed = np.count_nonzero(runs.changes[[start, stop]] >= speed)

    # do other records move meanwhile, compared with windows of the same length around?
    ranges = [np.ptp(others[first : first + length], axis=0) for first in windows]
    usual_range = np.median(ranges, axis=0)
    range_meanwhile = np.ptp(others[start:stop], axis=0)
    moves = (range_meanwhile > _MOVING * usual_range) & (usual_range > 0.0)
    another_moves = bool(np.any(moves))
    another_rests = not another_moves and bool(np.any(range_meanwhile < _RESTING * usual_range))
    if sides_at_speed == 2:
        return not another_rests
    is_only_one = np.count_nonzero(is_comparable) == 1
    return sides_at_speed == 1 and another_moves and is_only_one


def _digit_in_time(values: FloatArray) -> float:
    """Return the quantum of a record in time (N,).

    A record that rises throughout skips values of its sensor; its second differences do not.
    """
    step = lattice_step(values)
    if step is not None:
        return step
    bends = np.abs(np.diff(values, 2))
    least_bend = least_beyond_rounding(bends[bends > 1e-9 * np.ptp(values)])
    return min(quantum_of(values), least_bend or np.inf)


def update_length(values: FloatArray) -> float:
    """Return the number of samples that a logger usually takes of each reading of a slow sensor.

    It is the median length of runs of equal readings; 1 if readings repeat because of the sensor's
    quantum.

    Parameters
    ----------
    values : (N,) ndarray
        A record in time.
    """
    if lattice_step(values) is not None:
        return 1.0
    changes = np.flatnonzero(np.diff(values))
    return float(np.median(np.diff(changes))) if len(changes) > 1 else 1.0
