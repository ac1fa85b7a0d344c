"""Channels that stand still within a motion: runs of equal readings that no sensor makes."""

from collections.abc import Iterator, Sequence
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
from discrepancy.checks.fault import DataFault, FaultKind, samples_text

LEAST_RUN_LENGTH = 8
"""Fewest equal readings in a row that are examined."""
_SURROUNDINGS_LENGTH = 4
"""Length of the surroundings on either side of a run, as a multiple of the run's length."""
_COMPARABLE_LENGTH = 0.25
"""Least length of a comparable run, as a fraction of the length of the run that is judged.

Comparable runs come from pauses, square waves and coarse digits."""
_LARGEST_COMPARABLE_SHARE = 1.0 / 3.0
"""Largest fraction of the surroundings that comparable runs may take."""
_LEAST_JUMP = 3.0
"""Least jump of a reading from one sample to the next, in quanta; turning points change less."""
_LEAST_RELATIVE_JUMP = 0.25
"""Least jump into or out of a run, as a fraction of the mean change between samples around it.

A structure that slows down gradually changes less."""
_RANGE_OF_MOVING_RECORD = 0.5
"""Least range of another record during a run, over its usual range, if that record moves."""
_RANGE_OF_RESTING_RECORD = 0.25
"""Largest value of the same ratio if the other record rests."""
_NOISE_IN_QUANTA = 2.0
"""Standard deviation of noise, in quanta, above which equal readings in a row are unlikely."""
_LEAST_UPDATES = 4.0
"""Fewest updates of a sensor that a faulty run must span.

A logger that is faster than its sensor records each update several times."""


def estimate_roughness(values: FloatArray) -> float:
    """Estimate the standard deviation of the white noise in a record by its sixth differences.

    Sixth differences remove motions with more than about eight samples in a period. The estimate is
    1.4826 times their median absolute value, which single wrong readings do not change, divided by
    the root of the variance 924 that they have for noise of unit variance.

    Parameters
    ----------
    values : (N,) ndarray
        The samples of a record in time.
    """
    differences = np.diff(values, 6)
    # 924 = sum_k binomial(6, k)^2
    return float(1.4826 * np.median(np.abs(differences)) / np.sqrt(924.0))


def runs_of_true(flags: BoolArray) -> IntArray:
    """Return the runs of consecutive true entries in an array of flags.

    Returns
    -------
    (R, 2) ndarray of int
        The index of the first entry of each run, and the index after its last entry.
    """
    padded_flags = np.concatenate(([False], flags, [False])).astype(np.int8)
    edges = np.flatnonzero(np.diff(padded_flags))
    return np.stack((edges[::2], edges[1::2]), axis=1)


def stuck_sensor_faults(campaign: Campaign, trial: Trial) -> Iterator[DataFault]:
    """Yield a fault for each span of a dynamic trial in which a sensor or its logger was stuck.

    `stuck_spans` distinguishes such a span of equal readings from a true standstill of the
    structure and from a coarse digital converter. For this it compares the channel with all other
    channels and inputs of the trial.
    """
    series = [trial.values]
    series += [recorded_input.values[:, np.newaxis] for recorded_input in trial.inputs]
    if trial.kind is TrialKind.FORCED:
        series.append(trial.force[:, np.newaxis])
    recorded_values = np.concatenate(series, axis=1)  # (N, channels and then inputs)
    for column, name in enumerate(trial.channels):
        channel = campaign.channels[name]
        spans = stuck_spans(
            trial.values[:, column],
            trial.used[:, column],
            np.delete(recorded_values, column, axis=1),
            trial.noise_deviation(channel),
        )
        for start, stop in spans:
            sentence = (
                f"The channel {name!r} holds one value over {stop - start} samples within a "
                f"motion, in {samples_text(channel, trial, start, stop)}: empty these cells, or "
                "leave the channel out of the trial, and check sensor and logger."
            )
            yield DataFault(FaultKind.FROZEN, sentence, name, trial.name)


class _RunsOfRecord(NamedTuple):
    """A record in time, and its runs of equal readings.

    Attributes
    ----------
    values : (N,) ndarray
        The samples of the record.
    changes : (N + 1,) ndarray
        Absolute change into each sample; the last entry is zero.
    quantum : float
        The least difference between two readings of the sensor, such as its last digit.
    bounds : (R, 2) ndarray of int
        The first sample of each run, and the one after its last.
    lengths : (R,) ndarray of int
        The lengths of the runs in samples.
    """

    values: FloatArray
    changes: FloatArray
    quantum: float
    bounds: IntArray
    lengths: IntArray


def stuck_spans(
    values: FloatArray, is_used: BoolArray, other_records: FloatArray, noise: float = 0.0
) -> list[tuple[int, int]]:
    """Return the runs of equal readings that show a failure of a sensor or logger.

    A quantum is the least difference between two readings. Runs of fewer than `LEAST_RUN_LENGTH`
    readings, and those at the largest or smallest reading (which are clipped), are not judged. The
    rules for the others are:

    - If the noise exceeds two quanta, it makes readings differ even at rest. Any run of at least
      four updates of the sensor (which may be slower than its logger) is then a failure.
    - Otherwise a run may be a true standstill. A structure slows down before it stands still, so
      that the readings change by single quanta just before and after the run. The run is a failure
      if the readings jump on both sides of it. If they jump on one side only, it is a failure if
      another record moves during the run and no other run is of comparable length.
    - A run is not a failure if the other records rest during it, if there is a second run at the
      same value (a dead zone), or if runs of comparable length fill a third of its surroundings (a
      square wave, pauses).

    Parameters
    ----------
    values : (N,) ndarray
        The samples of a record in time.
    is_used : (N,) ndarray of bool
        False for samples that are left out.
    other_records : (N, K) ndarray
        The records of the K other channels and inputs of the trial.
    noise : float
        The standard deviation of the channel's noise; 0 if it is not known.

    Returns
    -------
    list of (int, int)
        The first sample of each run, and the one after its last.
    """
    is_equal_to_next = (np.diff(values) == 0.0) & is_used[1:] & is_used[:-1]  # (N - 1,)
    # a run of k equal pairs has k + 1 readings
    bounds_of_runs = runs_of_true(is_equal_to_next) + np.array([0, 1])
    starts, stops = bounds_of_runs.T
    lengths = stops - starts
    long_runs = bounds_of_runs[lengths >= LEAST_RUN_LENGTH].tolist()
    distinct_values = np.unique(values)
    if len(distinct_values) < 3 or not long_runs:
        return []
    # runs at an extreme value are clipped, which is another fault
    extremes = (distinct_values[0], distinct_values[-1])
    inner_runs = [(start, stop) for start, stop in long_runs if values[start] not in extremes]
    quantum = _quantum_in_time(values)
    if min(noise, estimate_roughness(values)) > _NOISE_IN_QUANTA * quantum:
        least_length = _LEAST_UPDATES * update_length(values)
        return [(start, stop) for start, stop in inner_runs if stop - start >= least_length]
    changes = np.abs(np.diff(values, prepend=values[:1], append=values[-1:]))
    runs = _RunsOfRecord(values, changes, quantum, bounds_of_runs, lengths)
    return [
        (start, stop)
        for start, stop in inner_runs
        if _is_sensor_failure(start, stop, runs, other_records)
    ]


def _is_sensor_failure(
    start: int, stop: int, runs: _RunsOfRecord, other_records: FloatArray
) -> bool:
    """Return whether a run in a record without much noise is a failure and not a standstill.

    The run goes from the sample `start` to the one before `stop`. `runs` holds the record and all
    its runs, and `other_records` (N, K) the other channels and inputs. `stuck_spans` states the
    rules.
    """
    length = stop - start
    least_jump = _LEAST_JUMP * runs.quantum
    if max(runs.changes[start], runs.changes[stop]) < least_jump:
        # the readings slow down before and after the run, as in a true standstill
        return False

    # no failure if runs of comparable length show a dead zone, or fill much of the surroundings
    begin_of_surroundings = max(start - _SURROUNDINGS_LENGTH * length, 0)
    end_of_surroundings = min(stop + _SURROUNDINGS_LENGTH * length, len(runs.values))
    run_starts, run_stops = runs.bounds.T
    is_comparable = runs.lengths >= _COMPARABLE_LENGTH * length
    is_in_surroundings = (
        is_comparable & (run_starts >= begin_of_surroundings) & (run_stops <= end_of_surroundings)
    )
    values_of_comparable = runs.values[run_starts[is_comparable]]
    is_dead_zone = np.count_nonzero(values_of_comparable == runs.values[start]) > 1
    window_starts = [  # of windows as long as the run, which fill the surroundings without it
        *range(start - length, begin_of_surroundings - 1, -length),
        *range(stop, end_of_surroundings - length + 1, length),
    ]
    comparable_samples = runs.lengths[is_in_surroundings].sum()
    if (
        len(window_starts) < 2
        or is_dead_zone
        or comparable_samples
        > _LARGEST_COMPARABLE_SHARE * (end_of_surroundings - begin_of_surroundings)
    ):
        return False

    # on how many sides of the run does the record jump?
    changes_around = np.r_[
        runs.changes[begin_of_surroundings : start + 1], runs.changes[stop:end_of_surroundings]
    ]
    jump = max(least_jump, _LEAST_RELATIVE_JUMP * float(np.mean(changes_around)))
    sides_with_jump = np.count_nonzero(runs.changes[[start, stop]] >= jump)

    movement = _other_movement(start, stop, window_starts, other_records)
    if sides_with_jump == 2:
        return not movement.another_rests
    is_only_comparable_run = np.count_nonzero(is_comparable) == 1
    return sides_with_jump == 1 and movement.another_moves and is_only_comparable_run


class _OtherMovement(NamedTuple):
    """Whether another record moves during a run, or whether one rests and none moves."""

    another_moves: bool
    another_rests: bool


def _other_movement(
    start: int, stop: int, window_starts: Sequence[int], other_records: FloatArray
) -> _OtherMovement:
    """Return whether other records (N, K) move during a run, compared with windows around the run.

    A record moves if its range within the run exceeds `_RANGE_OF_MOVING_RECORD` times its median
    range within the windows, which are as long as the run and begin at `window_starts`. A record
    rests if its range is less than `_RANGE_OF_RESTING_RECORD` times that.
    """
    length = stop - start
    ranges = [
        np.ptp(other_records[first_sample : first_sample + length], axis=0)
        for first_sample in window_starts
    ]
    usual_range = np.median(ranges, axis=0)
    range_in_run = np.ptp(other_records[start:stop], axis=0)
    moves = (range_in_run > _RANGE_OF_MOVING_RECORD * usual_range) & (usual_range > 0.0)  # (K,)
    another_moves = bool(np.any(moves))
    rests = range_in_run < _RANGE_OF_RESTING_RECORD * usual_range  # (K,)
    return _OtherMovement(another_moves, not another_moves and bool(np.any(rests)))


def _quantum_in_time(values: FloatArray) -> float:
    """Return the quantum of a record in time (N,): the least difference between two readings.

    Readings that rise steadily may differ by several quanta at every step. Their second differences
    are then still as small as one quantum. So the smaller of both is returned, unless the readings
    show the output levels of the sensor (`lattice_step`).
    """
    step_between_levels = lattice_step(values)
    if step_between_levels is not None:
        return step_between_levels
    second_differences = np.abs(np.diff(values, 2))
    least_second_difference = least_beyond_rounding(
        second_differences[second_differences > 1e-9 * np.ptp(values)]
    )
    return min(quantum_of(values), least_second_difference or np.inf)


def update_length(values: FloatArray) -> float:
    """Return how many samples a logger usually takes of each reading of a slower sensor.

    The result is the median length of the runs of equal readings. The length is 1 if the readings
    are multiples of a resolution, because a reading then repeats for another reason, and also if
    there are fewer than two changes.

    Parameters
    ----------
    values : (N,) ndarray
        The samples of a record in time.
    """
    if lattice_step(values) is not None:
        return 1.0
    changes = np.flatnonzero(np.diff(values))  # last sample of each run
    return float(np.median(np.diff(changes))) if len(changes) > 1 else 1.0
