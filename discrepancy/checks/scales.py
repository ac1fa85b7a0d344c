"""Scales of data over a model's predictions, and channels that are exchanged."""

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from discrepancy.campaign.records import Campaign, Channel, FloatArray, Quantity, Trial
from discrepancy.checks.fault import DataFault, FaultKind
from discrepancy.checks.held import roughness

ABOVE_NOISE = 5.0
"""Size, in standard deviations of the noise, above which a reading is clear."""
_VISIBLE = 0.01
"""Fraction of the largest prediction of its quantity below which a channel shows nothing."""
_AGREE = 0.9
"""Fraction of the pairs of loads whose slopes must have one sign."""
_NOTHING = 1e9
"""Data over prediction above which the model shows rounding alone."""
_FLOOR = 0.02
"""Relative error of a prediction that does not make a channel another one."""


def data_scales(
    campaign: Campaign, predictions: Mapping[str, FloatArray]
) -> dict[tuple[str, str], float]:
    """Return the signed scale of data over prediction by channel and trial, where it is determined.

    It is the robust slope of data over prediction for readings at rest (static, flight), and the
    ratio of amplitudes for records in time, whose phase the model need not predict.

    Parameters
    ----------
    campaign : Campaign
        The campaign.
    predictions : mapping of str to (N, C) ndarray
        Predicted readings by the name of the trial.
    """
    scales = {}
    for trial in campaign.trials:
        prediction = predictions[trial.name]
        largest = _largest_amplitudes(campaign, trial, prediction)
        for column, name in enumerate(trial.channels):
            channel = campaign.channels[name]
            if np.isinf(channel.gain_deviation) or channel.quantity is Quantity.SIGNAL:
                continue
            used = trial.used[:, column]
            data = trial.values[used, column]
            model = prediction[used, column]
            amplitude = _amplitude(model, trial)
            if amplitude <= _VISIBLE * largest[channel.quantity] or amplitude == 0.0:
                continue
            if trial.is_dynamic:
                scale = _dynamic_scale(data, model, trial, channel)
            else:
                noise = trial.noise_deviation(channel)
                scale = _static_scale(data, model, noise, channel.offset_deviation)
            if 0.0 < abs(scale) < _NOTHING:
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
    """Return the amplitude of readings (N,): rms about their median in time, else their largest."""
    if len(values) == 0:
        return 0.0
    if trial.is_dynamic:
        return float(np.sqrt(np.mean((values - np.median(values)) ** 2)))
    return float(np.max(np.abs(values)))


def _static_scale(
    data: FloatArray, model: FloatArray, noise: float, zero_deviation: float
) -> float:
    """Return the scale of readings at rest: a median slope, or a ratio at one load.

    It is 0 if it is not determined: within the noise and the deviation of the zero, if pairs of
    loads disagree in its sign, or if the readings have the model's sign and the slope has not (then
    it is that of something else, such as a temperature).

    Parameters
    ----------
    data, model : (N,) ndarrays
        Readings and prediction.
    noise, zero_deviation : float
        Standard deviations of the noise and of the channel's zero.
    """
    # all pairs of at most 400 rows
    rows = np.linspace(0, len(data) - 1, min(len(data), 400)).round().astype(int)
    first, second = np.triu_indices(len(rows), 1)
    data_steps = data[rows][first] - data[rows][second]
    model_steps = model[rows][first] - model[rows][second]
    # rows that differ by their health alone would give the noise over next to nothing
    is_far = np.abs(model_steps) > 0.2 * np.max(np.abs(model))
    median_reading = float(np.median(data))
    median_prediction = float(np.median(model))
    if not is_far.any():
        is_visible = abs(median_reading) > ABOVE_NOISE * max(noise, zero_deviation)
        return median_reading / median_prediction if median_prediction and is_visible else 0.0
    slopes = data_steps[is_far] / model_steps[is_far]
    slope = float(np.median(slopes))
    usual_step = np.median(np.abs(model_steps[is_far]))
    is_above_noise = max(abs(slope), 1.0) * usual_step > ABOVE_NOISE * noise
    pairs_agree = np.mean(slopes * slope > 0.0) > _AGREE
    has_sign_of_model = median_reading * np.sign(median_prediction) > 2.0 * zero_deviation
    is_of_something_else = slope < 0.0 and has_sign_of_model
    return slope if is_above_noise and pairs_agree and not is_of_something_else else 0.0


def _dynamic_scale(data: FloatArray, model: FloatArray, trial: Trial, channel: Channel) -> float:
    """Return the scale of a record in time; 0 if the record is within its noise.

    It is the ratio of amplitudes, with the sign of the correlation at the start of a release.

    Parameters
    ----------
    data, model : (N,) ndarrays
        Readings and prediction.
    trial : Trial
        The trial.
    channel : Channel
        The channel.
    """
    # a high quantile is robust against outliers, and for a decaying record not that of its quiet
    # end
    data_amplitude = np.quantile(np.abs(data - np.median(data)), 0.95)
    model_amplitude = np.quantile(np.abs(model - np.median(model)), 0.95)
    scale = float(data_amplitude / model_amplitude) * sign_of_release(data, model, trial)
    # a record within the noise has no scale, unless the noise is in another unit than the data
    predicted = _amplitude(model, trial)
    measured = abs(scale) * predicted
    scatter = roughness(data) if len(data) > 6 else 0.0
    noise = trial.noise_deviation(channel) or scatter
    is_above_noise = measured > ABOVE_NOISE * noise
    noise_may_be_in_another_unit = (
        measured > ABOVE_NOISE * scatter and predicted > ABOVE_NOISE * noise
    )
    return scale if is_above_noise or noise_may_be_in_another_unit else 0.0


def sign_of_release(data: FloatArray, model: FloatArray, trial: Trial) -> float:
    """Return -1 if a release from rest begins on the other side than predicted, else 1.

    Parameters
    ----------
    data, model : (N,) ndarrays
        Readings and prediction of a channel.
    trial : Trial
        The trial.
    """
    if trial.release is None or not trial.release.at_rest:
        return 1.0
    # before the first return through zero an error of frequency does not matter
    crossings = np.flatnonzero(np.sign(model) != np.sign(model[0]))
    first_crossing = int(crossings[0]) if crossings.size else len(model)
    count = max(first_crossing, 3)
    # each sample votes with the weight of its prediction, so that a wrong reading does not decide
    votes = np.sign(data - np.median(data))[:count]
    return float(np.sign(votes @ model[:count])) or 1.0


def swapped_channels(
    campaign: Campaign, predictions: Mapping[str, FloatArray]
) -> list[tuple[str, str]]:
    """Return the pairs of channels that fit the model clearly better if they are exchanged.

    Channels of one quantity that occur in the same trials are assigned to each other's predictions
    so that the sum of their misfits is least.

    Parameters
    ----------
    campaign : Campaign
        The campaign.
    predictions : mapping of str to (N, C) ndarray
        Predicted readings by the name of the trial.
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
        misfits = np.zeros((1, 1))
        for trial in campaign.trials:
            if trial.name in trial_names:
                misfits = misfits + _misfits(trial, predictions[trial.name], channels)
        _, assigned = linear_sum_assignment(misfits)
        for first, second in enumerate(assigned):
            is_exchange = first < second and assigned[second] == first
            if is_exchange and _exchange_is_better(misfits, first, int(second)):
                swaps.append((channels[first].name, channels[second].name))
    return swaps


def swap_fault(first: str, second: str) -> DataFault:
    """Return the fault of two channels that are swapped."""
    sentence = (
        f"The channels {first!r} and {second!r} fit the model clearly better exchanged: see which "
        "wire or column is which, and exchange their `column` or `output`."
    )
    return DataFault(FaultKind.SWAPPED, sentence, first)


def _exchange_is_better(misfits: FloatArray, first: int, second: int) -> bool:
    """Return whether exchanging two channels lowers their misfits (C, C) clearly.

    Each must be less than half, and the sum lower by 30 units of chi-squared.
    """
    pair = [first, second]
    exchanged = [second, first]
    before = misfits[pair, pair]
    after = misfits[pair, exchanged]
    return bool(np.all(after < 0.5 * before) and np.sum(before - after) > 30.0)


def _misfits(trial: Trial, predictions: FloatArray, channels: Sequence[Channel]) -> FloatArray:
    """Return the misfits (C, C) of channels to the predictions of each of them.

    Parameters
    ----------
    trial : Trial
        The trial.
    predictions : (N, M) ndarray
        Predicted readings of all its channels.
    channels : sequence of Channel
        C of its channels.
    """
    columns = [trial.channels.index(channel.name) for channel in channels]
    misfits = np.zeros((len(channels), len(channels)))
    for row, channel in enumerate(channels):
        used = trial.used[:, columns[row]]
        data = trial.values[used, columns[row]]
        for other, column in enumerate(columns):
            misfits[row, other] = _misfit(data, predictions[used, column], channel, trial)
    return misfits


def _misfit(data: FloatArray, model: FloatArray, channel: Channel, trial: Trial) -> float:
    """Return chi-squared of readings about a prediction.

    The standard deviation is at least a fraction of the prediction, which any model may be off.

    Parameters
    ----------
    data, model : (N,) ndarrays
        Readings and prediction.
    channel : Channel
        The channel.
    trial : Trial
        The trial.
    """
    noise = trial.noise_deviation(channel)
    if trial.is_dynamic:
        # amplitudes only: a small error of frequency would outweigh the distance of two gauges
        sign = sign_of_release(data, model, trial)
        residual = np.asarray(sign * np.std(data) - np.std(model))
        deviation = np.hypot(noise / np.sqrt(len(data)), _FLOOR * np.std(model))
    else:
        residual = data - model
        if channel.offset_deviation > 0.0:
            residual = residual - np.median(residual)
        least = 0.2 * _FLOOR * float(np.max(np.abs(model), initial=0.0))
        deviation = np.maximum(np.hypot(noise, _FLOOR * np.abs(model)), least)
    # bounded, so that readings of any size stay comparable
    standardised = np.minimum(np.abs(residual / np.maximum(deviation, 1e-300)), 1e9)
    return float(np.sum(standardised**2))
