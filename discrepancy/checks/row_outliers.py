"""Outliers among the rows of static and flight trials."""

import numpy as np

from discrepancy.campaign.noise_records import repeated_readings
from discrepancy.campaign.records import BoolArray, Campaign, Channel, FloatArray, Trial

SIGNIFICANT_ROW = 8.0
"""Residual of an outlier among the rows of a static or flight trial, in deviations of the noise."""
NORMAL_OVER_MAD = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""


def repeat_outliers(campaign: Campaign, channel: Channel) -> dict[str, BoolArray]:
    """Return the outliers (N,) of trials with at least two repeats, by the name of the trial.

    Each row is compared with its median over the repeats.
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
        is_off = np.abs(residual) > SIGNIFICANT_ROW * scale
        # a trial that is off in several rows has another offset or gain, and no single wrong
        # reading
        number_off = is_off.sum(axis=1, keepdims=True)
        is_single = (number_off == 1) & (is_off.shape[1] > 1)
        for trial, is_outlier in zip(repeats.trials, is_off & is_single, strict=True):
            outliers[trial.name] = is_outlier
    return outliers


def row_outlier(trial: Trial, values: FloatArray, used: BoolArray, channel: Channel) -> BoolArray:
    """Return the one row (N,) that a parabola through the others misses, if these agree with it.

    Parameters
    ----------
    trial : Trial
        A static or flight trial.
    values, used : (N,) ndarrays
        Readings of the channel, and which of them count.
    channel : Channel
        The channel; without a noise record there is no outlier.
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
    # residual of each row to the parabola through the others, and the scatter of the others about
    # it
    left_out_residual = np.abs(residual / one_minus_leverage)
    degrees = len(rows) - 1 - basis.shape[1]
    squares_of_others = residual @ residual - residual**2 / one_minus_leverage
    scatter_of_others = np.sqrt(np.maximum(squares_of_others, 0.0) / degrees)
    noise = trial.noise_deviation(channel)
    scatter_of_others[left_out_residual <= SIGNIFICANT_ROW * noise] = np.inf
    candidate = int(np.argmin(scatter_of_others))
    outlier[rows[candidate]] = scatter_of_others[candidate] < 2.0 * noise
    return outlier
