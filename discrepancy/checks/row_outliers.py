"""Outliers among the rows of static and flight trials."""

import numpy as np

from discrepancy.campaign.noise_records import repeated_readings
from discrepancy.campaign.records import BoolArray, Campaign, Channel, FloatArray, Trial

OUTLYING_ROW_DEVIATIONS = 8.0
"""Least residual of an outlying row of a static or flight trial, in noise deviations."""
NORMAL_OVER_MAD = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""
LEAST_REPEATS = 3
"""Least number of repeats: the median of two does not show which of them is wrong."""
LEAST_ROWS = 8
"""Fewest rows of a trial to which a parabola is fitted: five more than its coefficients."""
LARGEST_SCATTER = 2.0
"""Largest scatter about a parabola, in noise deviations, for the load to act by a parabola."""


def repeat_outliers(campaign: Campaign, channel: Channel) -> dict[str, BoolArray]:
    """Return the outliers among the rows of trials that were done at least three times.

    Each row is compared with its median over the repeats. If the zero of the channel is not known
    exactly, the zero of each trial is removed first. A row is an outlier if its residual exceeds
    `OUTLYING_ROW_DEVIATIONS` standard deviations, and if it is the only such row of its trial: a
    trial with several has another zero or gain.

    Returns
    -------
    dict of str to (N,) ndarray of bool
        Which rows are outliers, by the name of the trial. Trials that were done less often are not
        in it. The mapping is empty if the channel has no noise record.
    """
    outliers: dict[str, BoolArray] = {}
    if channel.noise is None:
        return outliers
    for repeats in repeated_readings(campaign.trials, channel.name):
        if len(repeats.trials) < LEAST_REPEATS:
            continue
        noise = channel.noise.standard_deviation * repeats.trials[0].noise_factor
        has_free_zero = channel.offset_deviation > 0.0
        is_outlier = _outliers_among_repeats(repeats.values, noise, has_free_zero=has_free_zero)
        for trial, is_outlier_in_trial in zip(repeats.trials, is_outlier, strict=True):
            outliers[trial.name] = is_outlier_in_trial
    return outliers


def _outliers_among_repeats(
    readings: FloatArray, noise: float, *, has_free_zero: bool
) -> BoolArray:
    """Return which readings (R, N) of N rows in R repeated trials are outliers, of the same shape.

    `noise` is the standard deviation of the channel's noise. If each trial has a zero of its own
    (`has_free_zero`), it is subtracted first: the median, over the rows of a trial, of the
    differences between its readings and the medians over the trials.
    """
    if has_free_zero:
        differences = readings - np.median(readings, axis=0)
        zeros = np.median(differences, axis=1, keepdims=True)  # (R, 1)
        readings = readings - zeros
    residual = readings - np.median(readings, axis=0)
    scale = max(noise, NORMAL_OVER_MAD * float(np.median(np.abs(residual))))
    is_significant = np.abs(residual) > OUTLYING_ROW_DEVIATIONS * scale
    significant_count = is_significant.sum(axis=1, keepdims=True)
    # in a trial of one row, an outlier looks the same as another zero, so nothing is left out
    row_count = is_significant.shape[1]
    is_single: BoolArray = (significant_count == 1) & (row_count > 1)
    return is_significant & is_single


def row_outlier(
    trial: Trial, values: FloatArray, is_used: BoolArray, channel: Channel
) -> BoolArray:
    """Find the single outlier among the rows of a trial by a parabola over the load.

    A row is an outlier if the parabola through all other rows misses it by more than
    `OUTLYING_ROW_DEVIATIONS` standard deviations of the noise, while the other rows scatter about
    that parabola by less than twice the noise. If there are several such rows, the row without
    which the others scatter least is the outlier.

    Parameters
    ----------
    trial : Trial
        A static or flight trial.
    values : (N,) ndarray
        The readings of the channel [SI].
    is_used : (N,) ndarray of bool
        False for readings that are left out.
    channel : Channel
        The channel; without a noise record there is no outlier.

    Returns
    -------
    (N,) ndarray of bool
        True for the outlier; False everywhere if there is none, or if the trial has fewer than
        `LEAST_ROWS` used rows or a single load.
    """
    outlier = np.zeros(len(values), dtype=bool)
    rows = np.flatnonzero(is_used)
    load = trial.load[rows]
    if channel.noise is None or len(rows) < LEAST_ROWS or np.ptp(load) == 0.0:
        return outlier
    # residuals (M,) of a parabola in the load through all M rows, by an orthonormal basis (M, 3);
    # with fewer than three different loads the basis has fewer columns
    powers = np.vander(load / np.max(np.abs(load)), 3)
    basis, singular_values, _ = np.linalg.svd(powers, full_matrices=False)
    basis = basis[:, singular_values > 1e-12 * singular_values[0]]
    residual = values[rows] - basis @ (basis.T @ values[rows])
    one_minus_leverage = np.maximum(1.0 - np.sum(basis**2, axis=1), 1e-12)
    # If row i is left out, its residual is r_i / (1 - h_i), with the leverage h_i, and the other
    # rows have the sum of squares sum(r^2) - r_i^2 / (1 - h_i) about their own parabola.
    left_out_residual = np.abs(residual / one_minus_leverage)
    degrees = len(rows) - 1 - basis.shape[1]
    squares_of_others = residual @ residual - residual**2 / one_minus_leverage
    scatter_of_others = np.sqrt(np.maximum(squares_of_others, 0.0) / degrees)
    noise = trial.noise_deviation(channel)
    scatter_of_others[left_out_residual <= OUTLYING_ROW_DEVIATIONS * noise] = np.inf
    candidate = int(np.argmin(scatter_of_others))
    outlier[rows[candidate]] = scatter_of_others[candidate] < LARGEST_SCATTER * noise
    return outlier
