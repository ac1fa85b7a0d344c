"""Scales of data over a model's predictions, and channels that are exchanged."""

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from discrepancy.campaign.records import Campaign, Channel, FloatArray, Quantity, Trial
from discrepancy.checks.fault import DataFault, FaultKind
from discrepancy.checks.held import estimate_roughness
from reporting.arrays import LEAST_DIVISOR

CLEAR_NOISE_DEVIATIONS = 5.0
"""Least size of a clear reading, in standard deviations of the noise."""
_LEAST_RELATIVE_AMPLITUDE = 0.01
"""Least predicted amplitude of a channel, as a fraction of the largest of its quantity.

Below it the load has hardly any effect on the channel."""
_CLEAR_ZERO_DEVIATIONS = 2.0
"""Size of a reading above which its sign is clear, in standard deviations of the zero."""
_MOST_ROWS = 400
"""Number of rows, evenly spread over the trial, of which all pairs are compared."""
_LEAST_CLEAR_STEP = 0.2
"""Least difference of the prediction between two rows with clearly different loads, as a fraction
of its largest magnitude."""
_LEAST_AGREEING_SHARE = 0.9
"""Least fraction of the pairs of rows whose slopes must have one sign."""
_LARGEST_RATIO = 1e9
"""Ratio of data to prediction above which the prediction is only a rounding error."""
_LEAST_RELATIVE_ERROR = 0.02
"""Relative error that any prediction may have, in a comparison of channels."""


def data_scales(
    campaign: Campaign, predictions: Mapping[str, FloatArray]
) -> dict[tuple[str, str], float]:
    """Return the ratios of readings to predicted readings, by channel and trial.

    A ratio has a sign. For readings at rest (static and flight trials) it is the robust slope of
    the readings over the prediction. For records in time it is the ratio of their amplitudes,
    because the model need not predict their phase. A signal, or a channel with a free gain, is left
    out. In a trial, a channel is also left out if its predicted amplitude is too small to determine
    the ratio, or if the ratio is zero or so large that the prediction can only be a rounding error.

    Parameters
    ----------
    campaign : Campaign
        The trials and channels.
    predictions : mapping of str to (N, C) ndarray
        The predicted readings by the name of the trial.

    Returns
    -------
    dict of (str, str) to float
        The ratio by the names of channel and trial.
    """
    scales = {}
    for trial in campaign.trials:
        prediction = predictions[trial.name]
        largest_amplitudes = _largest_amplitudes(campaign, trial, prediction)
        for column, name in enumerate(trial.channels):
            channel = campaign.channels[name]
            has_known_scale = (
                np.isfinite(channel.gain_deviation) and channel.quantity is not Quantity.SIGNAL
            )
            if not has_known_scale:
                continue
            is_used = trial.used[:, column]
            readings = trial.values[is_used, column]
            predicted_readings = prediction[is_used, column]
            amplitude = _amplitude(predicted_readings, trial)
            least_amplitude = _LEAST_RELATIVE_AMPLITUDE * largest_amplitudes[channel.quantity]
            if amplitude == 0.0 or amplitude <= least_amplitude:
                continue
            if trial.is_dynamic:
                scale = _dynamic_scale(readings, predicted_readings, trial, channel)
            else:
                noise = trial.noise_deviation(channel)
                scale = _static_scale(readings, predicted_readings, noise, channel.offset_deviation)
            if 0.0 < abs(scale) < _LARGEST_RATIO:
                scales[name, trial.name] = scale
    return scales


def _largest_amplitudes(
    campaign: Campaign, trial: Trial, prediction: FloatArray
) -> dict[Quantity, float]:
    """Return the largest amplitude of a trial's predicted readings (N, C) by quantity."""
    largest: dict[Quantity, float] = {}
    for name, values in zip(trial.channels, prediction.T, strict=True):
        quantity = campaign.channels[name].quantity
        largest[quantity] = max(largest.get(quantity, 0.0), _amplitude(values, trial))
    return largest


def _amplitude(values: FloatArray, trial: Trial) -> float:
    """Return the amplitude of readings (N,) in a trial.

    The amplitude is the root mean square about the median for a dynamic trial, else the largest
    magnitude; 0 without readings.
    """
    if len(values) == 0:
        return 0.0
    if trial.is_dynamic:
        return float(np.sqrt(np.mean((values - np.median(values)) ** 2)))
    return float(np.max(np.abs(values)))


def _static_scale(
    readings: FloatArray, predicted_readings: FloatArray, noise: float, zero_deviation: float
) -> float:
    """Return the ratio of readings at rest to their prediction; 0 if the data do not determine it.

    If the prediction differs clearly within some pairs of rows, the ratio is the median of the
    slopes over these pairs (Theil-Sen). It is not determined if

    - the usual step between the rows of a pair is within the noise;
    - too few slopes (`_LEAST_AGREEING_SHARE`) have the sign of the median slope;
    - the slope is negative, but the median reading clearly has the sign of the prediction: another
      cause, such as temperature, then dominates.

    If all rows have nearly the same load, the ratio is the median reading over the median
    prediction. It is not determined if

    - the median prediction is zero;
    - the median reading is within the noise or the uncertainty of the zero.

    Parameters
    ----------
    readings, predicted_readings : (N,) ndarrays
        Readings, and their prediction by the model [channel's unit].
    noise, zero_deviation : float
        The standard deviations of the noise and of the channel's zero [channel's unit].
    """
    # steps (P,) of readings and predictions in all P pairs of at most `_MOST_ROWS` rows
    row_count = min(len(readings), _MOST_ROWS)
    rows = np.linspace(0, len(readings) - 1, row_count).round().astype(int)
    first_of_pair, second_of_pair = np.triu_indices(row_count, 1)
    first_rows = rows[first_of_pair]
    second_rows = rows[second_of_pair]
    data_steps = readings[first_rows] - readings[second_rows]
    model_steps = predicted_readings[first_rows] - predicted_readings[second_rows]
    # Only pairs of clearly different predictions: rows that differ in the damage state alone would
    # give slopes of noise over nearly zero.
    largest_prediction = np.max(np.abs(predicted_readings))
    is_clear_step = np.abs(model_steps) > _LEAST_CLEAR_STEP * largest_prediction
    median_reading = float(np.median(readings))
    median_prediction = float(np.median(predicted_readings))
    if not is_clear_step.any():
        is_visible = abs(median_reading) > CLEAR_NOISE_DEVIATIONS * max(noise, zero_deviation)
        return median_reading / median_prediction if median_prediction and is_visible else 0.0
    slopes = data_steps[is_clear_step] / model_steps[is_clear_step]
    slope = float(np.median(slopes))  # Theil-Sen estimate
    # The usual step is that of the readings or of the prediction, whichever is larger. A channel
    # that hardly responds has a slope near zero, and this slope is well determined if the predicted
    # step alone is above the noise.
    usual_model_step = np.median(np.abs(model_steps[is_clear_step]))
    usual_step = max(abs(slope), 1.0) * usual_model_step
    is_above_noise = usual_step > CLEAR_NOISE_DEVIATIONS * noise
    pairs_agree = np.mean(slopes * slope > 0.0) > _LEAST_AGREEING_SHARE
    reading_along_prediction = median_reading * np.sign(median_prediction)
    has_sign_of_prediction = reading_along_prediction > _CLEAR_ZERO_DEVIATIONS * zero_deviation
    has_another_cause = slope < 0.0 and has_sign_of_prediction
    is_determined = is_above_noise and pairs_agree and not has_another_cause
    return slope if is_determined else 0.0


def _dynamic_scale(
    readings: FloatArray, predicted_readings: FloatArray, trial: Trial, channel: Channel
) -> float:
    """Return the ratio of the amplitudes of a record in time (N,) and its prediction (N,).

    The sign is that of `sign_of_release`. The result is 0 if the record is within its noise.
    """
    # The 95 % quantile ignores outliers. Unlike the median it shows the motion of a record that
    # decays and is quiet for most of its length.
    data_amplitude = np.quantile(np.abs(readings - np.median(readings)), 0.95)
    model_amplitude = np.quantile(np.abs(predicted_readings - np.median(predicted_readings)), 0.95)
    sign = sign_of_release(readings, predicted_readings, trial)
    scale = float(data_amplitude / model_amplitude) * sign
    # A record within the noise has no scale. If its noise was stated in a wrong unit, however, the
    # record stands out of its own scatter, and the prediction out of the stated noise.
    predicted_amplitude = _amplitude(predicted_readings, trial)
    measured_amplitude = abs(scale) * predicted_amplitude
    scatter = estimate_roughness(readings) if len(readings) > 6 else 0.0
    noise = trial.noise_deviation(channel) or scatter
    is_above_noise = measured_amplitude > CLEAR_NOISE_DEVIATIONS * noise
    noise_may_be_in_another_unit = (
        measured_amplitude > CLEAR_NOISE_DEVIATIONS * scatter
        and predicted_amplitude > CLEAR_NOISE_DEVIATIONS * noise
    )
    return scale if is_above_noise or noise_may_be_in_another_unit else 0.0


def sign_of_release(readings: FloatArray, predicted_readings: FloatArray, trial: Trial) -> float:
    """Return -1 if a channel's readings start on the opposite side of their prediction, else 1.

    The result is also 1 for a trial that is not a ring-down from rest, whose phase the model need
    not predict.

    Parameters
    ----------
    readings, predicted_readings : (N,) ndarrays
        Readings and prediction of a channel.
    trial : Trial
        The trial, for its release.
    """
    if trial.release is None or not trial.release.at_rest:
        return 1.0
    # until the prediction first crosses zero, an error of its frequency does not matter
    crossings = np.flatnonzero(np.sign(predicted_readings) != np.sign(predicted_readings[0]))
    first_crossing = int(crossings[0]) if crossings.size else len(predicted_readings)
    count = max(first_crossing, 3)
    # signs are weighted by the predictions, so that a single wrong reading does not decide
    signs = np.sign(readings - np.median(readings))[:count]
    return float(np.sign(signs @ predicted_readings[:count])) or 1.0


def swapped_channels(
    campaign: Campaign, predictions: Mapping[str, FloatArray]
) -> list[tuple[str, str]]:
    """Return the pairs of channels that fit the model clearly better if they are exchanged.

    Channels of one quantity that occur in the same trials are assigned to the predictions of these
    channels so that the sum of their misfits is least (linear assignment problem). A pair is
    returned if each gets the prediction of the other, and `_exchange_is_better`. Signals, and
    channels with a free gain, are not compared.

    Parameters
    ----------
    campaign : Campaign
        The trials and channels.
    predictions : mapping of str to (N, C) ndarray
        The predicted readings by the name of the trial.
    """
    groups: dict[tuple[Quantity, tuple[str, ...]], list[Channel]] = defaultdict(list)
    for name, channel in campaign.channels.items():
        trials = tuple(trial.name for trial in campaign.trials if name in trial.channels)
        if not np.isinf(channel.gain_deviation) and channel.quantity is not Quantity.SIGNAL:
            groups[channel.quantity, trials].append(channel)
    swaps = []
    for (_, trial_names), channels in groups.items():
        if len(channels) < 2:
            continue
        # (channels, channels): chi-squared of readings (row) to a prediction (column), all trials
        misfits = np.zeros((1, 1))
        for trial in campaign.trials:
            if trial.name in trial_names:
                misfits = misfits + _misfits(trial, predictions[trial.name], channels)
        _, assigned_columns = linear_sum_assignment(misfits)
        for first_index, second_index in enumerate(assigned_columns):
            is_exchange = (
                first_index < second_index and assigned_columns[second_index] == first_index
            )
            if is_exchange and _exchange_is_better(misfits, first_index, int(second_index)):
                swaps.append((channels[first_index].name, channels[second_index].name))
    return swaps


def swap_fault(first_channel: str, second_channel: str) -> DataFault:
    """Return the fault of two channels that are swapped."""
    sentence = (
        f"The channels {first_channel!r} and {second_channel!r} fit the model clearly better if "
        "they are exchanged: check wires and columns, and exchange their `column` or `output`."
    )
    return DataFault(FaultKind.SWAPPED, sentence, first_channel)


def _exchange_is_better(misfits: FloatArray, first_index: int, second_index: int) -> bool:
    """Return whether two channels fit clearly better if they are exchanged.

    Each of their misfits (chi-squared) must become less than half, and their sum must fall by more
    than 30. `misfits` (C, C) holds those of the readings of a channel (row) to the prediction of a
    channel (column).
    """
    pair = [first_index, second_index]
    exchanged = [second_index, first_index]
    misfits_before = misfits[pair, pair]
    misfits_after = misfits[pair, exchanged]
    return bool(
        np.all(misfits_after < 0.5 * misfits_before)
        and np.sum(misfits_before - misfits_after) > 30.0
    )


def _misfits(trial: Trial, predictions: FloatArray, channels: Sequence[Channel]) -> FloatArray:
    """Return chi-squared (C, C) of each channel's readings (row) to each prediction (column).

    `predictions` (N, M) has a column for each of the M channels of the trial.
    """
    columns = [trial.channels.index(channel.name) for channel in channels]
    misfits = np.zeros((len(channels), len(channels)))
    for row, channel in enumerate(channels):
        is_used = trial.used[:, columns[row]]
        readings = trial.values[is_used, columns[row]]
        for column_of_misfit, column_of_prediction in enumerate(columns):
            misfits[row, column_of_misfit] = _misfit(
                readings, predictions[is_used, column_of_prediction], channel, trial
            )
    return misfits


def _misfit(
    readings: FloatArray, predicted_readings: FloatArray, channel: Channel, trial: Trial
) -> float:
    """Return chi-squared of a channel's readings (N,) to a prediction (N,).

    The standard deviation of a reading combines the noise with 2 % of the prediction, because any
    model may be wrong by that much. For records in time, only their amplitudes are compared.
    """
    noise = trial.noise_deviation(channel)
    if trial.is_dynamic:
        # Only the amplitudes are compared: over many periods a small error of the frequency would
        # outweigh the difference between two gauges.
        sign = sign_of_release(readings, predicted_readings, trial)
        residual = np.asarray(sign * np.std(readings) - np.std(predicted_readings))
        deviation = np.hypot(
            noise / np.sqrt(len(readings)), _LEAST_RELATIVE_ERROR * np.std(predicted_readings)
        )
    else:
        residual = readings - predicted_readings
        if channel.offset_deviation > 0.0:
            residual = residual - np.median(residual)
        least_deviation = (
            0.2 * _LEAST_RELATIVE_ERROR * float(np.max(np.abs(predicted_readings), initial=0.0))
        )
        deviation = np.maximum(
            np.hypot(noise, _LEAST_RELATIVE_ERROR * np.abs(predicted_readings)), least_deviation
        )
    # bounded, so that readings of any size stay comparable
    standardised = np.minimum(np.abs(residual / np.maximum(deviation, LEAST_DIVISOR)), 1e9)
    return float(np.sum(standardised**2))
