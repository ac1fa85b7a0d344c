"""Faults that a campaign shows without a model: noise records and faulty channels.

What makes a campaign unreadable (missing columns, uneven sampling, gaps, NaN) is refused by the
reader. What only a model can show (units, signs, swapped channels, length) is in
`discrepancy.checks.model_check`.
"""

from collections.abc import Iterator

import numpy as np
from scipy.stats import f as f_distribution

from discrepancy.campaign.noise import LEAST_FOR_COLOUR
from discrepancy.campaign.noise_records import repeat_record
from discrepancy.campaign.records import (
    BoolArray,
    Campaign,
    Channel,
    FloatArray,
    NoiseRecord,
    Trial,
)
from discrepancy.campaign.sampling import quantum_of
from discrepancy.checks.copies import find_copied_channels
from discrepancy.checks.fault import DataFault, FaultKind, mark_accepted
from discrepancy.checks.held import (
    estimate_roughness,
    runs_of_true,
    stuck_sensor_faults,
    update_length,
)
from discrepancy.checks.outliers import LARGEST_SHARE, find_outliers
from discrepancy.checks.rest import noise_record_faults

LEAST_CLIPPED_RUN = 3
"""Fewest samples in a row at an extreme value that make a record clipped."""
_LEVEL = 1e-3
"""Level of the F test between a noise record and repeats."""
_NOISE_FACTOR = 2.0
"""Factor by which a noise record must be contradicted."""
SLOW_NOISE_ROUGHNESS = 0.24
"""Roughness (`estimate_roughness`) over standard deviation of noise whose neighbouring samples have
the correlation 0.9, as an autoregression of first order; that of white noise is one."""


def check_data(campaign: Campaign) -> tuple[DataFault, ...]:
    """Return the faults of a campaign's data that can be found without a model.

    Some faults only limit what can be concluded: a channel without a noise record, or a noise
    record that contains a motion, or that contradicts repeats (F test at 0.1 %) or the roughness of
    the readings (by a factor of two, with slow noise allowed for). Others make the data wrong
    (`DataFault.fatal`): a channel that is constant (dead), clipped, stuck for a time (held) or a
    copy of another one, and more than 3 % of outliers in a record in time.
    """
    faults: list[DataFault] = []
    for name, channel in campaign.channels.items():
        faults += _noise_faults(campaign, channel)
        faults += _dead_faults(campaign, name)
    for trial in campaign.trials:
        for column, name in enumerate(trial.channels):
            faults += _clipped_faults(trial, name, trial.values[:, column], trial.used[:, column])
        if trial.is_dynamic:
            faults += stuck_sensor_faults(campaign, trial)
    faults += find_copied_channels(campaign)
    faults += noise_record_faults(campaign)
    faults += _outlier_faults(campaign)
    return mark_accepted(faults, campaign)


def _outlier_faults(campaign: Campaign) -> Iterator[DataFault]:
    """Yield a fault for each record in time with too many outliers."""
    for trial, name, is_outlier in find_outliers(campaign):
        fraction = is_outlier.mean()
        if trial.is_dynamic and fraction > LARGEST_SHARE:
            sentence = (
                f"{fraction:.1%} of the readings of {name!r} in the trial {trial.name!r} are "
                f"outliers, and at most {LARGEST_SHARE:.0%} may be left out: remove the cause "
                "(loose wire, radio link) and repeat the trial, or leave the channel out of it."
            )
            yield DataFault(FaultKind.OUTLIERS, sentence, name, trial.name)


# ---------------------------------------------------------------- noise


def _noise_faults(campaign: Campaign, channel: Channel) -> Iterator[DataFault]:
    """Yield a fault if a channel has no noise record, or if its readings contradict the record.

    The record is contradicted by dynamic readings that are too smooth, or by repeated trials whose
    scatter differs significantly (F test) and by a factor of two. A record that was made from
    repeats is not tested.
    """
    record = channel.noise
    if record is None:
        sentence = (
            f"The channel {channel.name!r} has no noise record, so that it cannot be judged "
            "whether a model explains it: add samples at rest, repeats, or a standard deviation "
            "and its degrees of freedom."
        )
        yield DataFault(FaultKind.NO_NOISE_RECORD, sentence, channel.name)
        return
    if record.source == "repeats":
        return
    stated_deviation = record.standard_deviation
    contradiction = ""
    least_roughness = min(_contradicting_roughness(campaign, record, channel.name), default=None)
    if least_roughness is not None:
        contradiction = f"neighbouring samples scatter by {least_roughness:.3g}"

    repeats = repeat_record(channel, campaign.trials)
    if repeats is not None:
        variance_ratio = (repeats.standard_deviation / stated_deviation) ** 2
        freedom = repeats.degrees_of_freedom
        record_freedom = min(record.degrees_of_freedom, 1e9)  # the distribution takes no infinity
        probability_of_larger = f_distribution.sf(variance_ratio, freedom, record_freedom)
        probability_of_smaller = f_distribution.cdf(variance_ratio, freedom, record_freedom)
        p_value = 2.0 * min(probability_of_larger, probability_of_smaller)
        is_similar = _NOISE_FACTOR**-2 < variance_ratio < _NOISE_FACTOR**2
        if p_value < _LEVEL and not is_similar:
            contradiction = f"repeated trials scatter by {repeats.standard_deviation:.3g}"
    if contradiction:
        sentence = (
            f"The noise record of the channel {channel.name!r} says {stated_deviation:.3g} (SI), "
            f"but its {contradiction}: check the record and its unit, and whether the noise is "
            "coloured."
        )
        yield DataFault(FaultKind.NOISE_LABEL, sentence, channel.name)


def _contradicting_roughness(campaign: Campaign, record: NoiseRecord, name: str) -> Iterator[float]:
    """Yield the roughness of each dynamic record of a channel that is too smooth for its noise.

    A record is too smooth if its roughness (`estimate_roughness`) is less than half of the one
    expected. At the sampling interval of the noise record, this is the roughness of the noise
    record. At another interval, or without samples of noise, the noise may be slow, and is taken as
    smooth as `SLOW_NOISE_ROUGHNESS` says. The test is one-sided: a fast motion may make a record
    rougher than its noise.
    """
    slow_roughness = SLOW_NOISE_ROUGHNESS * record.standard_deviation
    recorded_roughness = slow_roughness
    if record.samples is not None and len(record.samples) >= LEAST_FOR_COLOUR:
        recorded_roughness = estimate_roughness(record.samples)
    record_interval = record.interval or np.inf
    for trial, values, _ in campaign.records(name):
        if not trial.is_dynamic or len(values) < LEAST_FOR_COLOUR:
            continue
        has_same_interval = np.isclose(trial.interval, record_interval, rtol=1e-3, atol=0.0)
        expected_roughness = recorded_roughness if has_same_interval else slow_roughness
        roughness = estimate_roughness(values) / trial.noise_factor
        if 0.0 < roughness < expected_roughness / _NOISE_FACTOR:
            yield roughness


# ---------------------------------------------------------------- records


def _dead_faults(campaign: Campaign, name: str) -> Iterator[DataFault]:
    """Yield a fault for each trial in which a channel is constant although it should change.

    A trial at rest counts only if the channel is constant in all its trials: a load may have no
    effect on a channel that works in other trials, which only the model can tell.
    """
    trials = [trial for trial, *_ in campaign.records(name)]
    still_trials = [trial for trial in trials if is_still(trial, name)]
    for trial in still_trials:
        if trial.is_dynamic or len(still_trials) == len(trials):
            yield dead_fault(trial, name)


def dead_fault(trial: Trial, name: str) -> DataFault:
    """Return the fault of a channel that shows one value throughout a trial."""
    sentence = (
        f"The channel {name!r} shows the same value throughout the trial {trial.name!r}: check its "
        "wiring, or leave it out of the trial."
    )
    return DataFault(FaultKind.DEAD, sentence, name, trial.name)


def is_still(trial: Trial, name: str) -> bool:
    """Return whether a channel shows one value throughout a trial that excites the structure.

    A trial at rest does so if its load changes. With fewer than `LEAST_CLIPPED_RUN` used readings
    the answer is no.
    """
    column = trial.channels.index(name)
    is_used = trial.used[:, column]
    if is_used.sum() < LEAST_CLIPPED_RUN or np.ptp(trial.values[is_used, column]) > 0.0:
        return False
    return trial.is_dynamic or bool(np.ptp(trial.load[is_used]) > 0.0)


def _clipped_faults(
    trial: Trial, name: str, values: FloatArray, is_used: BoolArray
) -> Iterator[DataFault]:
    """Yield a fault if a channel's readings (N,) in a trial are clipped at their largest value.

    Another fault is for the smallest value. Readings at rest are put in the order of their loads.
    """
    readings = values[is_used]
    if len(readings) < LEAST_CLIPPED_RUN:
        return
    load = None
    if not trial.is_dynamic:
        load = trial.load[is_used]
        order = np.argsort(load, kind="stable")
        readings = readings[order]
        load = load[order]
    extremes = {"largest": float(readings.max()), "smallest": float(readings.min())}
    for side, extreme in extremes.items():
        run = clipped_run(readings, extreme, load)
        if run:
            sentence = (
                f"The channel {name!r} is clipped in the trial {trial.name!r}: {run} readings in a "
                f"row are at its {side} value {extreme:.6g} (SI), reached in a jump; widen the "
                "range of the amplifier and repeat the trial, or leave the channel out of it."
            )
            yield DataFault(FaultKind.CLIPPED, sentence, name, trial.name)


def clipped_run(values: FloatArray, extreme: float, load: FloatArray | None = None) -> int:
    """Return the length of the longest clipped run of readings at an extreme; 0 if none is clipped.

    A run is clipped if an extrapolation of the other readings exceeds the extreme by more than some
    quanta of the sensor (`quantum_of`) and six standard deviations of its scatter. A record of
    coarse quanta is flat at its turning points, too, but there it would exceed the extreme only by
    about a quantum.

    Parameters
    ----------
    values : (N,) ndarray
        Readings, in the order of time or of load.
    extreme : float
        The largest or smallest of them.
    load : (N,) ndarray, optional
        The loads of readings at rest; without them the readings are samples in time.
    """
    quantum = quantum_of(values)
    # a logger that is faster than its sensor repeats each reading
    least_length = LEAST_CLIPPED_RUN * (update_length(values) if load is None else 1.0)
    longest = 0
    for start, stop in runs_of_true(values == extreme).tolist():
        if stop - start < max(least_length, longest + 1):
            continue
        if load is None:
            is_clipped = _is_clipped_in_time(values, start, stop, quantum)
        else:
            is_clipped = _is_clipped_over_load(values, start, stop, quantum, load)
        if is_clipped:
            longest = stop - start
    return longest


def _is_clipped_over_load(
    values: FloatArray, start: int, stop: int, quantum: float, load: FloatArray
) -> bool:
    """Return whether a run of equal readings at rest lies off the line through all other readings.

    The line must depart from the run by more than 1.5 quanta plus six standard deviations of the
    scatter about the line, and the run must span three different loads. Readings and loads (N,) are
    in the order of load, and the run goes from the index `start` to the one before `stop`.
    """
    run = slice(start, stop)
    loads_of_run = load[run]
    other_loads = np.delete(load, run)
    other_values = np.delete(values, run)
    spans_loads = np.unique(loads_of_run).size >= LEAST_CLIPPED_RUN
    gives_line = np.unique(other_loads).size >= 2
    if not (spans_loads and gives_line):
        return False
    line = np.polynomial.Polynomial.fit(other_loads, other_values, 1)
    excess = float(np.max(np.abs(line(loads_of_run) - values[start])))
    scatter = float(np.std(other_values - line(other_loads)))
    return excess > 1.5 * quantum + 6.0 * scatter


def _is_clipped_in_time(values: FloatArray, start: int, stop: int, quantum: float) -> bool:
    """Return whether a parabola through three samples on either side of a run exceeds the run.

    At the middle of the run it must do so by half of the largest error that the parabola has there
    if each of the six samples is wrong by three quanta plus six standard deviations of the noise.
    This error grows with the length of the run. Readings (N,) are in the order of time, and the run
    of equal readings goes from the sample `start` to the one before `stop`. A run with fewer than
    three samples on one side is not judged, and the answer is no.
    """
    neighbours = np.r_[start - 3 : start, stop : stop + 3]
    if neighbours[0] < 0 or neighbours[-1] >= len(values):
        return False
    # The parabola of least squares has a value at the middle of the run (sample 0) that is a
    # weighted sum of the six neighbours: the last row of the pseudo-inverse, for its constant.
    relative_samples = neighbours - 0.5 * (start + stop - 1)
    _, _, weights_at_middle = np.linalg.pinv(np.vander(relative_samples, 3))
    excess = abs(weights_at_middle @ values[neighbours] - values[start])
    error = 3.0 * quantum + 6.0 * estimate_roughness(values)
    sum_of_weights = np.abs(weights_at_middle).sum()
    return bool(excess > 0.5 * sum_of_weights * error)
