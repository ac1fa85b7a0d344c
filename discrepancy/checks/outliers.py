"""Single wrong readings, found by their neighbours or by repeats, and left out with a remark."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import maximum_filter1d

from discrepancy.campaign.records import BoolArray, Campaign, FloatArray, Trial
from discrepancy.campaign.sampling import quantum_of
from discrepancy.checks.local_polynomial import (
    LOW_DEGREE,
    LocalPolynomial,
    Weights,
    even_weights,
    event_patterns,
    weights_at,
)
from discrepancy.checks.row_outliers import NORMAL_OVER_MAD, repeat_outliers, row_outlier

LARGEST_SHARE = 0.03
"""Largest fraction of a record in time that may be left out; above it the record is at fault."""
SIGNIFICANT = 5.0
"""Residual of an outlier in robust standard deviations, and in those of the channel's noise."""
WRONG_END = 8.0
"""Residual of a wrong reading at the ends of a record, beside the prediction of a model."""
_SHAPES = (
    (3, 5),
    (4, 5),
    (6, 5),
    (9, 5),
    (13, 5),
    (18, 5),
    (6, 9),
    (9, 9),
    (9, 13),
    (13, 13),
    (18, 13),
)
"""Half width (samples) and degree of the local polynomials that are tried."""
_EDGE = 3
"""Samples at either end that are not judged, and the least half width."""
_ENDS = (slice(0, _EDGE), slice(-_EDGE, None))
"""The first and the last samples of a record."""
_NEIGHBOURS = [0, 1, 3, 4]
"""Places of the neighbours of the middle one of five samples."""
_NEAR = 25
"""Half width of the neighbourhood with whose scatter a sample is compared."""
_PASSES = 8
"""Most passes in which outliers are found and replaced."""


def mark_outliers(campaign: Campaign) -> Campaign:
    """Return the campaign with isolated outliers left out, and a remark for each channel and trial.

    Dynamic trials: a sample is compared with a local polynomial through its neighbours, whose width
    is the one that predicts the record best. It is an outlier if its residual is five robust
    standard deviations of the whole record and of its surroundings, and five of the channel's noise
    record, and if it is isolated: three of five samples in a row are an event, such as an impact,
    and stay, and so does a sample at a kink or a step. The first and last three samples are not
    judged. If more than 3 % of a record would go, nothing is left out (`check_data` reports a
    fault), and neither if the campaign accepts outliers.

    Static and flight trials: a row of at least three repeats is compared with their median.
    Otherwise, in trials of eight or more rows, one row may go if a parabola through the others
    explains them within twice the noise and misses this one by eight deviations. Both need a noise
    record.
    """
    used = {trial.name: trial.used.copy() for trial in campaign.trials}
    remarks = list(campaign.remarks)
    for trial, channel, is_outlier in find_outliers(campaign):
        count = int(is_outlier.sum())
        total = len(is_outlier)
        too_many = trial.is_dynamic and count > LARGEST_SHARE * total
        if too_many or "outliers" in campaign.accepted(channel, trial.name):
            continue
        used[trial.name][is_outlier, trial.channels.index(channel)] = False
        outliers = "is an outlier" if count == 1 else "are outliers"
        remarks.append(
            f"{count} of {total} readings of {channel!r} in the trial {trial.name!r} {outliers} "
            "and left out."
        )
    trials = tuple(replace(trial, used=used[trial.name]) for trial in campaign.trials)
    return replace(campaign, trials=trials, remarks=tuple(remarks))


def find_outliers(campaign: Campaign) -> Iterator[tuple[Trial, str, BoolArray]]:
    """Yield trial, channel and outliers (N,) of each record that has any."""
    # all channels of a trial have its times
    weights = {trial.name: weights_at(trial.time) for trial in campaign.trials if trial.is_dynamic}
    for name, channel in campaign.channels.items():
        outliers_of_repeats = repeat_outliers(campaign, channel)
        for trial, values, used in campaign.records(name):
            if trial.is_dynamic:
                noise = trial.noise_deviation(channel)
                outliers = sample_outliers(values, used, weights[trial.name], noise=noise)
            elif trial.name in outliers_of_repeats:
                outliers = outliers_of_repeats[trial.name] & used
            else:
                outliers = row_outlier(trial, values, used, channel)
            if outliers.any():
                yield trial, name, outliers


def sample_outliers(
    values: FloatArray,
    used: BoolArray | None = None,
    weights: Weights | None = None,
    *,
    noise: float = 0.0,
) -> BoolArray:
    """Return which samples (N,) of a record are isolated outliers.

    `mark_outliers` states the rules.

    Parameters
    ----------
    values : (N,) ndarray
        The record.
    used : (N,) ndarray of bool, optional
        False for samples that are left out: they are interpolated and never outliers.
    weights : callable, optional
        Weights of the local polynomials at the record's times; those of even samples by default.
    noise : float
        Standard deviation of the channel's noise; 0 if it is not known.
    """
    count = len(values)
    size = float(np.max(np.abs(values), initial=0.0))
    if used is None:
        used = np.ones(count, dtype=bool)
    if count < 4 * _EDGE + 4 or used.sum() < 0.5 * count or size == 0.0:
        return np.zeros(count, dtype=bool)
    # scaled, so that squares of readings of any size stay in range
    rows = np.arange(count)
    record = np.where(used, values / size, np.interp(rows, rows[used], values[used] / size))
    polynomial = _best_polynomial(record, weights or even_weights)
    # least scatter by rounding to digits, which a record at rest may not show
    weight_norm = float(np.linalg.norm(even_weights(polynomial.width, polynomial.degree)))
    rounding = quantum_of(values[used] / size) * 12.0**-0.5 * weight_norm

    # readings within the noise are no outliers
    noise_limit = SIGNIFICANT * noise / size
    suspects, cleaned = _suspects(record, polynomial, rounding, noise_limit)
    # judge the suspects again, now with clean neighbours
    residual = polynomial.residual(cleaned)
    weight_of_sample = polynomial.weight_of_sample(count)
    deviation = np.abs((record - cleaned) * weight_of_sample + residual)
    is_beyond_noise = deviation > noise_limit
    is_beyond_scatter = deviation > SIGNIFICANT * _scale(residual, rounding)
    outliers = used & suspects & is_beyond_noise & is_beyond_scatter
    # three of five samples in a row are an event, and no single wrong readings
    is_crowded = np.convolve(outliers, np.ones(5), mode="same") >= 3
    is_event = np.convolve(is_crowded, np.ones(5), mode="same") > 0
    isolated: BoolArray = outliers & ~is_event
    return isolated


def _best_polynomial(record: FloatArray, weights: Weights) -> LocalPolynomial:
    """Return the local polynomial that predicts the samples of a record (N,) best."""
    polynomials = []
    for width, degree in _SHAPES:
        has_weights = weights is even_weights or degree == LOW_DEGREE
        if has_weights and 4 * width + 4 <= len(record):
            polynomials.append(LocalPolynomial(weights, width, degree))
    return min(polynomials, key=lambda polynomial: _scatter(polynomial.residual(record)))


def _suspects(
    record: FloatArray, polynomial: LocalPolynomial, rounding: float, noise_limit: float
) -> tuple[BoolArray, FloatArray]:
    """Return the samples that may be outliers, worst first, and the record without them.

    Parameters
    ----------
    record : (N,) ndarray
        The record.
    polynomial : LocalPolynomial
        The polynomial that predicts each sample.
    rounding : float
        Scatter of its residuals by rounding to digits.
    noise_limit : float
        Residual up to which a sample is within the noise of its channel.

    Returns
    -------
    suspects : (N,) ndarray of bool
        Samples that are off and not at an event, such as a kink.
    cleaned : (N,) ndarray
        The record with these samples as predicted.
    """
    count = len(record)
    suspects = np.zeros(count, dtype=bool)
    events = np.zeros(count, dtype=bool)
    cleaned = record.copy()
    edge = _EDGE if polynomial.degree == LOW_DEGREE else polynomial.width
    for _ in range(_PASSES):
        residual = polynomial.residual(cleaned)
        ratio = np.abs(residual) / _scale(residual, rounding)
        ratio[:edge] = 0.0
        ratio[-edge:] = 0.0
        # only the worst of each neighbourhood: it spoils the prediction of the samples around it
        neighbourhood = 2 * polynomial.width + 1
        is_worst = ratio == maximum_filter1d(ratio, neighbourhood, mode="constant")
        is_beyond_noise = np.abs(residual) > noise_limit
        is_significant = (ratio > SIGNIFICANT) & is_beyond_noise & is_worst
        new = np.flatnonzero(is_significant & ~suspects & ~events)
        if not new.size:
            break
        at_event = np.array([_is_event(residual, int(index), polynomial) for index in new])
        events[new[at_event]] = True
        new_suspects = new[~at_event]
        suspects[new_suspects] = True
        correction = residual / polynomial.weight_of_sample(count)
        cleaned[new_suspects] -= correction[new_suspects]
    return suspects, cleaned


def wrong_ends(residual: FloatArray, used: BoolArray, noise: FloatArray | float = 0.0) -> BoolArray:
    """Return which samples (N, C) at the ends of a trial's records are single wrong readings.

    `sample_outliers` cannot judge the ends; beside the prediction of a model they can be judged.
    What several channels show at once, or several samples in a row, is no single wrong reading but
    a release, an impact, or a trigger that came late.

    Parameters
    ----------
    residual : (N, C) ndarray
        Readings minus prediction; the model need not fit.
    used : (N, C) ndarray of bool
        False for samples that are left out.
    noise : (C,) ndarray or float
        Standard deviation of each channel's noise, in the unit of the residual; 0 if it is not
        known.
    """
    wrong = np.zeros(residual.shape, dtype=bool)
    noise = np.broadcast_to(noise, residual.shape[1:])
    for column in range(residual.shape[1]):
        rows = np.flatnonzero(used[:, column])
        if len(rows) >= 8 * _EDGE:
            is_wrong = _wrong_ends_of_channel(residual[rows, column], float(noise[column]))
            wrong[rows, column] = is_wrong
    for end in _ENDS:
        channels_at_end = np.count_nonzero(wrong[end].any(axis=0))
        if channels_at_end > 1:
            wrong[end] = False
    return wrong


def _wrong_ends_of_channel(residual: FloatArray, noise: float) -> BoolArray:
    """Return which samples (N,) at the ends of a record are single wrong readings.

    Parameters
    ----------
    residual : (N,) ndarray
        Readings minus prediction.
    noise : float
        Standard deviation of the noise.
    """
    padded = np.pad(residual, 2, constant_values=np.nan)
    neighbours = sliding_window_view(padded, 5)[:, _NEIGHBOURS]
    deviation = residual - np.nanmedian(neighbours, axis=1)
    sticks_out = np.abs(residual) > 2.0 * np.nanmax(np.abs(neighbours), axis=1)
    # the scatter near each end, where the motion may be fastest
    near_ends = (deviation[: 4 * _NEAR], deviation[-4 * _NEAR :])
    wrong = np.zeros(len(residual), dtype=bool)
    for end, near_end in zip(_ENDS, near_ends, strict=True):
        scatter = NORMAL_OVER_MAD * float(np.median(np.abs(near_end)))
        scale = max(scatter, noise, 1e-300)
        is_off = sticks_out[end] & (np.abs(deviation[end]) > WRONG_END * scale)
        if is_off.sum() == 1:
            wrong[end] = is_off
    return wrong


def _is_event(residual: FloatArray, index: int, polynomial: LocalPolynomial) -> bool:
    """Return whether a kink or a step explains the residuals near a sample better than one reading.

    Parameters
    ----------
    residual : (N,) ndarray
        Residuals of the local polynomial.
    index : int
        The sample.
    polynomial : LocalPolynomial
        The polynomial.
    """
    width = polynomial.width
    low = max(index - width, 0)
    high = min(index + width + 1, len(residual))
    first = low - index + width
    patterns = event_patterns(width, polynomial.degree)[:, first : first + high - low]
    explained = (patterns @ residual[low:high]) ** 2 / np.sum(patterns**2, axis=1)
    return int(np.argmax(explained)) > 0


def _scatter(residual: FloatArray) -> float:
    """Return the robust standard deviation of residuals (N,), without those at the edges."""
    return NORMAL_OVER_MAD * float(np.median(np.abs(residual[_EDGE:-_EDGE])))


def _scale(residual: FloatArray, least: float) -> FloatArray:
    """Return the scatter (N,) with which each residual is compared.

    It is that of the whole record or that of its surroundings, whichever is larger, and at least
    `least`.
    """
    of_record = max(_scatter(residual), least, 1e-300)
    inner = np.abs(residual[_EDGE:-_EDGE])
    if len(inner) <= 2 * _NEAR:
        return np.full(len(residual), of_record)
    windows = sliding_window_view(np.pad(inner, _NEAR, mode="reflect"), 2 * _NEAR + 1)
    of_surroundings = np.pad(np.median(windows, axis=1), _EDGE, mode="edge")
    return np.maximum(of_record, NORMAL_OVER_MAD * of_surroundings)
