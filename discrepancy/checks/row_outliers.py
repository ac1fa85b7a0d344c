"""Outliers among the rows of static and flight trials."""

import numpy as np

from discrepancy.campaign.noise_records import repeated_readings
from discrepancy.campaign.records import BoolArray, Campaign, Channel, FloatArray, Trial

SIGNIFICANT_ROW = 8.0
"""Least residual of an outlying row of a static or flight trial, in noise deviations."""
NORMAL_OVER_MAD = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""


def repeat_outliers(campaign: Campaign, channel: Channel) -> dict[str, BoolArray]:
    """Return the outliers among the rows of trials that were done at least three times.

    Each row is compared with its median over the repeats. If the zero of the channel is not known
    exactly, the zero of each trial is removed first. A row is an outlier if its residual exceeds
    `SIGNIFICANT_ROW` standard deviations, and if it is the only such row of its trial: a trial with
    several has another zero or gain.

    Parameters
    ----------
    campaign : Campaign
        The campaign.
    channel : Channel
        The channel; without a noise record there is no outlier.

    Returns
    -------
    dict of str to (N,) ndarray of bool
        Which rows are outliers, by the name of the trial.
    """
    outliers: dict[str, BoolArray] = {}
    if channel.noise is None:
        return outliers
    for repeats in repeated_readings(campaign.trials, channel.name):
        if len(repeats.trials) < 3:
            continue
        readings = repeats.values
        if channel.offset_deviation > 0.0:
            from_median = readings - np.median(readings, axis=0)
            readings = readings - np.median(from_median, axis=1, keepdims=True)
        residual = readings - np.median(readings, axis=0)
        noise = channel.noise.standard_deviation * repeats.trials[0].noise_factor
        scale = max(noise, NORMAL_OVER_MAD * float(np.median(np.abs(residual))))
        is_significant = np.abs(residual) > SIGNIFICANT_ROW * scale
        significant_rows = is_significant.sum(axis=1, keepdims=True)
        is_single = (significant_rows == 1) & (is_significant.shape[1] > 1)
        for trial, is_outlier in zip(repeats.trials, is_significant & is_single, strict=True):
            outliers[trial.name] = is_outlier
    return outliers


def row_outlier(trial: Trial, values: FloatArray, used: BoolArray, channel: Channel) -> BoolArray:
    """Find the single outlier among the rows of a trial by a parabola over the load.

    A row is an outlier if the parabola through all other rows misses it by more than
    `SIGNIFICANT_ROW` standard deviations of the noise, while the other rows scatter about that
    parabola by less than twice the noise. Of several such rows the one that leaves the least
    scatter is taken.

    Parameters
    ----------
    trial : Trial
        A static or flight trial.
    values : (N,) ndarray
        Readings of the channel.
    used : (N,) ndarray of bool
        False for readings that are left out.
    channel : Channel
        The channel; without a noise record there is no outlier.

    Returns
    -------
    (N,) ndarray of bool
        True for the outlier; False everywhere if there is none.
    """
    outlier = np.zeros(len(values), dtype=bool)
    rows = np.flatnonzero(used)
    load = trial.load[rows]
    if channel.noise is None or len(rows) < 8 or np.ptp(load) == 0.0:
        return outlier
    # residuals of a parabola in the load through all rows, by an orthonormal basis
    powers = np.vander(load / np.max(np.abs(load)), 3)
    basis, singular_values, _ = np.linalg.svd(powers, full_matrices=False)
    basis = basis[:, singular_values > 1e-12 * singular_values[0]]
    residual = values[rows] - basis @ (basis.T @ values[rows])
    one_minus_leverage = np.maximum(1.0 - np.sum(basis**2, axis=1), 1e-12)
    # Leave-one-out residual: the residual r of the fit to all rows over one minus the leverage h.
    # The sum of squares of the other rows about their own parabola is sum(r^2) - r^2 / (1 - h).
    left_out_residual = np.abs(residual / one_minus_leverage)
    degrees = len(rows) - 1 - basis.shape[1]
    squares_of_others = residual @ residual - residual**2 / one_minus_leverage
    scatter_of_others = np.sqrt(np.maximum(squares_of_others, 0.0) / degrees)
    noise = trial.noise_deviation(channel)
    scatter_of_others[left_out_residual <= SIGNIFICANT_ROW * noise] = np.inf
    candidate = int(np.argmin(scatter_of_others))
    outlier[rows[candidate]] = scatter_of_others[candidate] < 2.0 * noise
    return outlier
