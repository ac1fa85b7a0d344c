"""Ring-downs whose frequency is far from the model's: a stiffness or a mass in another unit."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Trial, TrialKind
from discrepancy.checks.fault import DataFault, FaultKind
from reporting.words import comma_list

LARGEST_FREQUENCY_RATIO = 4.0
"""Largest ratio of the model's first frequency to that of a ring-down, or of its inverse.

Damage, friction and joints change a frequency by much less. Units of stiffness and mass differ by
factors from 10 on, and the frequency changes by the root of such a factor.
"""
_LEAST_PERIODS = 3.0
"""Fewest periods of an oscillation in a record whose frequency is compared."""
_LEAST_SAMPLES = 4.0
"""Fewest samples in a period of such an oscillation."""
_LEAST_SHARE = 0.5
"""Least fraction of a record's power that must lie near its frequency."""
_HALF_BAND = 0.3
"""Half width of the band near a frequency, as a fraction of it; decay and friction widen a peak."""
_MILLISECONDS = 1000.0
_LARGEST_DOUBT = 3.0
"""Ratio up to which two factors count as the same in the comparison with milliseconds."""
_ZERO_PADDING = 4


class _FrequencyRange(NamedTuple):
    """The lowest and the highest frequency [Hz] of the channels of a free vibration."""

    low: float
    high: float


def frequency_faults(
    campaign: Campaign, model_name: str, model_frequency: float
) -> Iterator[DataFault]:
    """Yield a fault if ring-downs oscillate far below or above the model's first frequency [Hz].

    At most two faults are yielded: one for all trials that are too slow, and one for all that are
    too fast, by more than `LARGEST_FREQUENCY_RATIO`. The frequency of a channel is that of the
    largest peak of its spectrum, if most of the power lies there. Channels of one trial may show
    different modes: the one nearest to the model's frequency decides. Times that were written in
    milliseconds look like a trial that is too slow; they are left to the check of the samples in a
    period.
    """
    for is_model_high in (True, False):
        trials: list[str] = []
        frequencies: list[float] = []
        for trial in campaign.trials:
            measured = _frequency_range(trial)
            if measured is None:
                continue
            nearest = measured.high if is_model_high else measured.low
            ratio = model_frequency / nearest if is_model_high else nearest / model_frequency
            if ratio > LARGEST_FREQUENCY_RATIO and not (
                is_model_high and _may_be_milliseconds(ratio)
            ):
                trials.append(trial.name)
                frequencies.append(nearest)
        if trials:
            frequency = float(np.median(frequencies))
            sentence = _frequency_sentence(trials, frequency, model_name, model_frequency)
            trial_of_fault = trials[0] if len(trials) == 1 else ""
            yield DataFault(FaultKind.FREQUENCY, sentence, trial=trial_of_fault)


def _frequency_sentence(
    trials: list[str], frequency: float, model_name: str, model_frequency: float
) -> str:
    """Return the message that ring-downs do not have the model's frequency [Hz]."""
    noun = "trial" if len(trials) == 1 else "trials"
    verb = "oscillates" if len(trials) == 1 else "oscillate"
    ratio = model_frequency / frequency
    size = "large" if ratio > 1.0 else "small"
    factor = float(f"{max(ratio, 1.0 / ratio) ** 2:.2g}")
    return (
        f"The {noun} {comma_list(map(repr, trials))} {verb} at {frequency:.3g} Hz, but the first "
        f"frequency of the model {model_name!r} is {model_frequency:.3g} Hz, as if its stiffness "
        f"over its mass were about {factor:,.0f} times too {size}: check the units of stiffness "
        "and mass in the model (SI: N/m and kg), and of the time in the tables (s)."
    )


def _may_be_milliseconds(ratio: float) -> bool:
    """Return whether times in milliseconds, read as seconds, explain a ratio of frequencies."""
    ratio_to_milliseconds = ratio / _MILLISECONDS
    return 1.0 / _LARGEST_DOUBT < ratio_to_milliseconds < _LARGEST_DOUBT


def _frequency_range(trial: Trial) -> _FrequencyRange | None:
    """Return the lowest and the highest frequency of the channels of a free vibration.

    A driven trial without inputs is a free vibration, too. The result is None for other trials, or
    if no channel oscillates clearly.
    """
    is_free = trial.kind is TrialKind.DRIVEN and not trial.inputs
    if trial.kind is not TrialKind.RINGDOWN and not is_free:
        return None
    frequencies = []
    for column in range(len(trial.channels)):
        is_used = trial.used[:, column]
        if np.count_nonzero(is_used) < 2 * _LEAST_SAMPLES:
            continue
        frequency = dominant_frequency(trial.time[is_used], trial.values[is_used, column])
        if frequency is not None:
            frequencies.append(frequency)
    if not frequencies:
        return None
    return _FrequencyRange(min(frequencies), max(frequencies))


def dominant_frequency(time: FloatArray, values: FloatArray) -> float | None:
    """Return the frequency [Hz] at which a record oscillates; None if it does not clearly.

    The frequency is the peak of the periodogram with a Hann window. At least half of the power must
    lie around the peak, and the record must have three periods, with four samples in each.

    Parameters
    ----------
    time : (N,) ndarray
        Times of the samples [s], which need not be evenly spaced.
    values : (N,) ndarray
        The readings.
    """
    # an even grid, for the transform
    count = len(time)
    duration = float(time[-1] - time[0])
    grid = np.linspace(time[0], time[-1], count)
    readings = np.interp(grid, time, values)
    window = np.hanning(count)
    readings = readings - np.average(readings, weights=window)

    # the peak of the spectrum, and the fraction of the power around it
    padded_count = _ZERO_PADDING * count
    power = np.abs(np.fft.rfft(readings * window, padded_count)) ** 2
    frequencies = np.fft.rfftfreq(padded_count, duration / (count - 1))
    total_power = float(power.sum())
    frequency = float(frequencies[int(np.argmax(power))])
    samples_per_period = (count - 1) / max(duration * frequency, 1.0 / count)
    is_resolved = duration * frequency >= _LEAST_PERIODS and samples_per_period >= _LEAST_SAMPLES
    if total_power == 0.0 or not is_resolved:
        return None
    # the main lobe of the Hann window reaches 2 / duration to either side
    half_width = max(_HALF_BAND * frequency, 2.0 / duration)
    is_near = np.abs(frequencies - frequency) <= half_width
    share = float(power[is_near].sum()) / total_power
    return frequency if share >= _LEAST_SHARE else None
