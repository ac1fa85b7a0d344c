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
    weights_for_times,
)
from discrepancy.checks.row_outliers import NORMAL_OVER_MAD, repeat_outliers, row_outlier
from reporting.arrays import LEAST_DIVISOR
from reporting.words import rows_of_table

LARGEST_SHARE = 0.03
"""Largest fraction of a record in time that may be left out; above it the record is at fault."""
OUTLIER_DEVIATIONS = 5.0
"""Least residual of an outlier, in robust standard deviations and in those of the noise."""
WRONG_END_RATIO = 8.0
"""Least distance of a wrong reading at an end of a record from its neighbours' median, in standard
deviations."""
_WIDTHS_AND_DEGREES = (
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
_EDGE_SAMPLES = 3
"""Samples at either end that are not judged, and the least half width."""
_END_SLICES = (slice(0, _EDGE_SAMPLES), slice(-_EDGE_SAMPLES, None))
"""The slices of the first and of the last samples of a record."""
_NEIGHBOURS = [0, 1, 3, 4]
"""Indices of the neighbours of the middle sample among five samples in a row."""
_HALF_WINDOW = 25
"""Half width of the window, in samples, whose scatter a residual is compared with."""
_MOST_PASSES = 8
"""Most passes in which outliers are found and replaced."""


def mark_outliers(campaign: Campaign) -> Campaign:
    """Return the campaign with isolated outliers left out, and a remark for each channel and trial.

    Dynamic trials: each sample is compared with a local polynomial through its neighbours; of
    several widths and degrees the one that predicts the record best is used. A sample is an outlier
    if its residual exceeds five robust standard deviations of the residuals of the whole record,
    five of those around it, and five standard deviations of the channel's noise, and if it is
    isolated. Three outliers among five samples in a row are an event such as an impact and are
    kept, and so is a sample at a kink or a step. The first and last three samples are not judged.
    Nothing is left out if more than 3 % of a record would be (`check_data` then reports a fault),
    or if the campaign accepts outliers.

    Static and flight trials: if a trial was done at least three times, each row is compared with
    the median over these repeats. Otherwise one row of a trial with eight or more may be left out,
    if a parabola through the others scatters by less than twice the noise and misses this row by
    more than eight standard deviations. Both rules need a noise record.
    """
    is_used = {trial.name: trial.used.copy() for trial in campaign.trials}  # (N, C) by trial
    remarks = list(campaign.remarks)
    for trial, channel, is_outlier in find_outliers(campaign):
        count = int(is_outlier.sum())
        reading_count = len(is_outlier)
        too_many = trial.is_dynamic and count > LARGEST_SHARE * reading_count
        if too_many or "outliers" in campaign.accepted_faults(channel, trial.name):
            continue
        is_used[trial.name][is_outlier, trial.channels.index(channel)] = False
        outliers = "is an outlier" if count == 1 else "are outliers"
        remarks.append(
            f"{count} of {reading_count} readings of {channel!r} in the trial {trial.name!r} "
            f"({rows_of_table(np.flatnonzero(is_outlier).tolist())}) {outliers} and left out."
        )
    trials = tuple(replace(trial, used=is_used[trial.name]) for trial in campaign.trials)
    return replace(campaign, trials=trials, remarks=tuple(remarks))


def find_outliers(campaign: Campaign) -> Iterator[tuple[Trial, str, BoolArray]]:
    """Yield the outliers of each record of a campaign that has any.

    Yields
    ------
    trial : Trial
        A trial.
    channel : str
        The name of one of its channels.
    is_outlier : (N,) ndarray of bool
        Whether each reading of this channel is an outlier; at least one is.
    """
    # all channels of a trial have its times
    weights = {
        trial.name: weights_for_times(trial.time) for trial in campaign.trials if trial.is_dynamic
    }
    for name, channel in campaign.channels.items():
        outliers_of_repeats = repeat_outliers(campaign, channel)
        for trial, values, is_used in campaign.records(name):
            if trial.is_dynamic:
                noise = trial.noise_deviation(channel)
                outliers = sample_outliers(values, is_used, weights[trial.name], noise=noise)
            elif trial.name in outliers_of_repeats:
                outliers = outliers_of_repeats[trial.name] & is_used
            else:
                outliers = row_outlier(trial, values, is_used, channel)
            if outliers.any():
                yield trial, name, outliers


def sample_outliers(
    values: FloatArray,
    is_used: BoolArray | None = None,
    weights: Weights | None = None,
    *,
    noise: float = 0.0,
) -> BoolArray:
    """Return which samples (N,) of a record in time are isolated outliers.

    `mark_outliers` states the rules.

    Parameters
    ----------
    values : (N,) ndarray
        The samples of the record.
    is_used : (N,) ndarray of bool, optional
        False for samples that are left out: they are interpolated and never outliers.
    weights : callable, optional
        The weights of the local polynomials at the record's times; those of even samples by
        default.
    noise : float
        The standard deviation of the channel's noise; 0 if it is not known.
    """
    count = len(values)
    largest_reading = float(np.max(np.abs(values), initial=0.0))
    if is_used is None:
        is_used = np.ones(count, dtype=bool)
    if count < 4 * _EDGE_SAMPLES + 4 or is_used.sum() < 0.5 * count or largest_reading == 0.0:
        return np.zeros(count, dtype=bool)
    # the record (N,), scaled so that squares of readings of any size stay in range
    indices = np.arange(count)
    record = np.where(
        is_used,
        values / largest_reading,
        np.interp(indices, indices[is_used], values[is_used] / largest_reading),
    )
    polynomial = _best_polynomial(record, weights or even_weights)
    # Rounding to a quantum q has the standard deviation q / sqrt(12), and residuals that of this
    # times the norm of their weights. A record at rest may show no rounding at all, so that this is
    # the least scatter that residuals are compared with.
    weight_norm = float(np.linalg.norm(even_weights(polynomial.width, polynomial.degree)))
    rounding = quantum_of(values[is_used] / largest_reading) * 12.0**-0.5 * weight_norm

    # readings within the noise are not outliers
    noise_limit = OUTLIER_DEVIATIONS * noise / largest_reading
    is_suspect, cleaned_record = _find_suspects(record, polynomial, rounding, noise_limit)
    # judge the suspects again: the residual of the original sample among clean neighbours
    residual = polynomial.residual(cleaned_record)
    weight_of_sample = polynomial.weight_of_sample(count)
    deviation = np.abs((record - cleaned_record) * weight_of_sample + residual)
    is_beyond_noise = deviation > noise_limit
    is_beyond_scatter = deviation > OUTLIER_DEVIATIONS * _comparison_deviation(residual, rounding)
    outliers = is_used & is_suspect & is_beyond_noise & is_beyond_scatter
    # three outliers among five samples in a row are an event and not single wrong readings
    is_crowded = np.convolve(outliers, np.ones(5), mode="same") >= 3
    is_event = np.convolve(is_crowded, np.ones(5), mode="same") > 0
    isolated_outliers: BoolArray = outliers & ~is_event
    return isolated_outliers


def _best_polynomial(record: FloatArray, weights: Weights) -> LocalPolynomial:
    """Return the local polynomial that predicts the samples of a record (N,) best.

    The best one has the least robust scatter of residuals. Those of `_WIDTHS_AND_DEGREES` are tried
    that the record is long enough for. Uneven samples have weights for `LOW_DEGREE` alone.
    """
    polynomials = []
    for width, degree in _WIDTHS_AND_DEGREES:
        has_weights = weights is even_weights or degree == LOW_DEGREE
        if has_weights and 4 * width + 4 <= len(record):
            polynomials.append(LocalPolynomial(weights, width, degree))
    return min(polynomials, key=lambda polynomial: _robust_scatter(polynomial.residual(record)))


def _find_suspects(
    record: FloatArray, polynomial: LocalPolynomial, rounding: float, noise_limit: float
) -> tuple[BoolArray, FloatArray]:
    """Find the samples that may be outliers, and replace them by their predictions in a copy.

    In each pass the worst sample of each neighbourhood is replaced, because a wrong reading spoils
    the predictions of the samples around it. The passes end when nothing new is found.

    Parameters
    ----------
    record : (N,) ndarray
        The samples of the record.
    polynomial : LocalPolynomial
        The polynomial that predicts each sample.
    rounding : float
        The standard deviation of its residuals that rounding of the readings causes.
    noise_limit : float
        The largest residual that the noise of the channel explains.

    Returns
    -------
    is_suspect : (N,) ndarray of bool
        The samples with a significant residual that are not at an event such as a kink.
    cleaned_record : (N,) ndarray
        The record with the predictions in place of these samples.
    """
    count = len(record)
    is_suspect = np.zeros(count, dtype=bool)
    is_at_event = np.zeros(count, dtype=bool)
    cleaned_record = record.copy()
    edge = _EDGE_SAMPLES if polynomial.degree == LOW_DEGREE else polynomial.width
    for _ in range(_MOST_PASSES):
        residual = polynomial.residual(cleaned_record)
        ratio = np.abs(residual) / _comparison_deviation(residual, rounding)
        ratio[:edge] = 0.0
        ratio[-edge:] = 0.0
        neighbourhood = 2 * polynomial.width + 1
        is_worst = ratio == maximum_filter1d(ratio, neighbourhood, mode="constant")
        is_beyond_noise = np.abs(residual) > noise_limit
        is_significant = (ratio > OUTLIER_DEVIATIONS) & is_beyond_noise & is_worst
        new_indices = np.flatnonzero(is_significant & ~is_suspect & ~is_at_event)
        if not new_indices.size:
            break
        at_event = np.array([_is_event(residual, int(index), polynomial) for index in new_indices])
        is_at_event[new_indices[at_event]] = True
        new_suspects = new_indices[~at_event]
        is_suspect[new_suspects] = True
        # A sample minus its correction equals its prediction. For unevenly spaced samples the
        # weight of a sample in its own residual is not one.
        correction = residual / polynomial.weight_of_sample(count)
        cleaned_record[new_suspects] -= correction[new_suspects]
    return is_suspect, cleaned_record


def wrong_end_readings(
    residual: FloatArray, is_used: BoolArray, noise: FloatArray | float = 0.0
) -> BoolArray:
    """Return which of the first and last three samples of records are single wrong readings.

    `sample_outliers` does not judge these samples, because they lack neighbours on one side. The
    residual of a model's prediction makes it possible. A deviation in several channels at once, or
    in several samples of one end, is not a single wrong reading but a release, an impact, or a
    trigger that came late.

    Parameters
    ----------
    residual : (N, C) ndarray
        Readings minus prediction; the model need not fit.
    is_used : (N, C) ndarray of bool
        False for samples that are left out.
    noise : (C,) ndarray or float
        The standard deviation of each channel's noise, in the unit of the residual; 0 if it is not
        known.

    Returns
    -------
    (N, C) ndarray of bool
        True for a wrong reading.
    """
    is_wrong = np.zeros(residual.shape, dtype=bool)
    noise = np.broadcast_to(noise, residual.shape[1:])
    for column in range(residual.shape[1]):
        rows = np.flatnonzero(is_used[:, column])
        if len(rows) >= 8 * _EDGE_SAMPLES:
            is_wrong_in_channel = _wrong_ends_of_channel(
                residual[rows, column], float(noise[column])
            )
            is_wrong[rows, column] = is_wrong_in_channel
    for end_slice in _END_SLICES:
        channels_at_end = np.count_nonzero(is_wrong[end_slice].any(axis=0))
        if channels_at_end > 1:  # a release, an impact or a late trigger
            is_wrong[end_slice] = False
    return is_wrong


def _wrong_ends_of_channel(residual: FloatArray, noise: float) -> BoolArray:
    """Return which samples (N,) at the ends of one record are single wrong readings.

    A sample is suspect if its residual is more than twice as large as those of its two neighbours
    on either side, and differs from their median by more than `WRONG_END_RATIO` standard
    deviations: those of the noise, or of such differences near this end, whichever are larger. The
    reading is wrong if it is the only suspect sample of its end. Several suspect samples are a
    release or an impact, and none of them is wrong.

    Parameters
    ----------
    residual : (N,) ndarray
        The readings minus their prediction.
    noise : float
        The standard deviation of the noise; 0 if it is not known.
    """
    # windows (N, 5) around each sample, and their (N, 4) neighbours, NaN beyond the record
    padded_residual = np.pad(residual, 2, constant_values=np.nan)
    neighbours = sliding_window_view(padded_residual, 5)[:, _NEIGHBOURS]
    distance = np.abs(residual - np.nanmedian(neighbours, axis=1))
    exceeds_neighbours = np.abs(residual) > 2.0 * np.nanmax(np.abs(neighbours), axis=1)
    # The scatter is taken near each end alone: in a decaying motion it differs between the ends.
    distances_near_ends = (distance[: 4 * _HALF_WINDOW], distance[-4 * _HALF_WINDOW :])
    is_wrong = np.zeros(len(residual), dtype=bool)
    for end_slice, distance_near_end in zip(_END_SLICES, distances_near_ends, strict=True):
        scatter = NORMAL_OVER_MAD * float(np.median(distance_near_end))
        standard_deviation = max(scatter, noise, LEAST_DIVISOR)
        is_far = distance[end_slice] > WRONG_END_RATIO * standard_deviation
        is_suspect = exceeds_neighbours[end_slice] & is_far
        if is_suspect.sum() == 1:
            is_wrong[end_slice] = is_suspect
    return is_wrong


def _is_event(residual: FloatArray, index: int, polynomial: LocalPolynomial) -> bool:
    """Return whether a kink or a step explains residuals better than a single wrong reading does.

    Each pattern of `event_patterns` is fitted to the residuals of the local polynomial (N,) around
    the sample at `index`; the pattern that explains the largest sum of squares decides.
    """
    width = polynomial.width
    low = max(index - width, 0)
    high = min(index + width + 1, len(residual))
    first_of_pattern = low - index + width
    patterns = event_patterns(width, polynomial.degree)[
        :, first_of_pattern : first_of_pattern + high - low
    ]
    # sum of squares that a pattern p explains by least squares: (p . r)^2 / p . p
    explained_squares = (patterns @ residual[low:high]) ** 2 / np.sum(patterns**2, axis=1)
    # the first pattern is the single wrong reading
    return int(np.argmax(explained_squares)) > 0


def _robust_scatter(residual: FloatArray) -> float:
    """Return the robust standard deviation of residuals (N,), without the unjudged edges."""
    return NORMAL_OVER_MAD * float(np.median(np.abs(residual[_EDGE_SAMPLES:-_EDGE_SAMPLES])))


def _comparison_deviation(residual: FloatArray, least_deviation: float) -> FloatArray:
    """Return the robust standard deviation (N,) that each residual (N,) is compared with.

    The deviation is that of the whole record or that of the `_HALF_WINDOW` samples on either side,
    whichever is larger, and at least `least_deviation`. The unjudged edges do not count.
    """
    scatter_of_record = max(_robust_scatter(residual), least_deviation, LEAST_DIVISOR)
    inner_magnitudes = np.abs(residual[_EDGE_SAMPLES:-_EDGE_SAMPLES])
    if len(inner_magnitudes) <= 2 * _HALF_WINDOW:
        return np.full(len(residual), scatter_of_record)
    windows = sliding_window_view(
        np.pad(inner_magnitudes, _HALF_WINDOW, mode="reflect"), 2 * _HALF_WINDOW + 1
    )
    median_of_surroundings = np.pad(np.median(windows, axis=1), _EDGE_SAMPLES, mode="edge")
    return np.maximum(scatter_of_record, NORMAL_OVER_MAD * median_of_surroundings)
