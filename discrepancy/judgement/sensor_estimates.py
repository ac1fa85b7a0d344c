"""Gains and zeros of channels as they were fitted, beside what the campaign states of them."""

from collections.abc import Mapping, Sequence
from math import inf, nan

import numpy as np

from calibration.result.sensors import SensorFit
from discrepancy.campaign.records import Channel, FloatArray
from discrepancy.campaign.units import UNITS
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.normal_equations import trial_jacobian
from discrepancy.fits.problem import Problem
from discrepancy.verdict import SensorEstimate, SensorValue

from .closed_share import NOMINAL_UNIT

PERCENT = (100.0, "%")
"""Factor and unit in which the relative error of a gain is shown."""


def sensor_fits(
    estimates: Sequence[SensorEstimate], channels: Mapping[str, Channel]
) -> tuple[SensorFit, ...]:
    """Return fitted gains and zeros with the units in which they are shown."""
    fits = []
    for estimate in estimates:
        is_gain = estimate.kind is SensorValue.GAIN
        factor, unit = PERCENT if is_gain else UNITS[channels[estimate.channel].quantity].drawn
        fits.append(
            SensorFit(
                channel=estimate.channel,
                kind="gain" if is_gain else "zero",
                trial=estimate.trial,
                value=estimate.value,
                deviation=estimate.deviation,
                stated_deviation=estimate.stated_deviation,
                shown_factor=factor,
                shown_unit="" if unit == NOMINAL_UNIT else unit,
            )
        )
    return tuple(fits)


def sensor_estimates(problem: Problem, fit: CandidateFit) -> tuple[SensorEstimate, ...]:
    """Return the fitted gains, and the fitted zeros of each trial, in the order of the channels.

    Gains and zeros that the campaign states as exact are not fitted, and have no entry.

    Parameters
    ----------
    fit : CandidateFit
        The fit, with the posterior covariance of what the trials share.
    """
    estimates = _gain_estimates(problem, fit)
    # estimated over recorded noise precision of each channel; 1 with a noise record
    precision_ratios = problem.recorded_or_estimated_precisions(fit.squares_by_channel)
    for trial_index in range(len(problem.trials)):
        estimates += _zero_offset_estimates(problem, fit, trial_index, precision_ratios)
    order = list(problem.campaign.channels)
    return tuple(sorted(estimates, key=lambda estimate: order.index(estimate.channel)))


def _gain_estimates(problem: Problem, fit: CandidateFit) -> list[SensorEstimate]:
    """Return the relative errors of the gains that were fitted; the stated value is zero."""
    layout = problem.shared
    deviations = layout.scale * np.sqrt(np.diag(fit.covariance)[: layout.unknown_count])
    values = layout.centre + layout.scale * fit.point.shared
    estimates = []
    for index, channel in enumerate(layout.gain_channels, start=layout.parameter_count):
        estimates.append(
            _estimate(
                channel=channel,
                kind=SensorValue.GAIN,
                trial="",
                value=float(values[index]),
                deviation=float(deviations[index]),
                stated_deviation=_stated_deviation(layout.scale[index], layout.precision[index]),
                unit="1",
            )
        )
    return estimates


def _zero_offset_estimates(
    problem: Problem, fit: CandidateFit, trial_index: int, precision_ratios: FloatArray
) -> list[SensorEstimate]:
    """Return the zero offsets of sensors that were fitted in a trial; the stated value is zero.

    `precision_ratios` (channels,) are the estimated over the recorded noise precisions.
    """
    data = problem.trials[trial_index]
    layout = data.unknowns
    if not layout.zero_count:
        return []
    deviations = layout.scale * _local_deviations(problem, fit, trial_index, precision_ratios)
    values = layout.scale * fit.point.local[trial_index]
    estimates = []
    for index, column in enumerate(layout.zero_columns):
        channel = data.trial.channels[column]
        estimates.append(
            _estimate(
                channel=channel,
                kind=SensorValue.ZERO,
                trial=data.trial.name,
                value=float(values[index]),
                deviation=float(deviations[index]),
                stated_deviation=_stated_deviation(layout.scale[index], layout.precision[index]),
                unit=UNITS[problem.campaign.channels[channel].quantity].si,
            )
        )
    return estimates


def _local_deviations(
    problem: Problem, fit: CandidateFit, trial_index: int, precision_ratios: FloatArray
) -> FloatArray:
    """Return the posterior standard deviations (L,) of the scaled unknowns of a trial.

    Given the shared unknowns, the trial's unknowns have the covariance A^-1, where A is their block
    of the normal equations. They follow a change of the shared unknowns, which adds the covariance
    of these.
    """
    rows = trial_jacobian(problem, trial_index, fit, fit.candidate, precision_ratios)
    factor, local_per_shared = rows.eliminate_local()
    inverse_factor = np.linalg.inv(np.triu(factor))
    conditional_variance = np.sum(inverse_factor**2, axis=1)
    shared_covariance = fit.covariance[np.ix_(rows.shared_indices, rows.shared_indices)]
    added_variance = np.einsum("lk,km,lm->l", local_per_shared, shared_covariance, local_per_shared)
    return np.asarray(np.sqrt(conditional_variance + np.maximum(added_variance, 0.0)))


def _stated_deviation(scale: float, precision: float) -> float:
    """Return the stated standard deviation of an unknown; infinite if it has a flat prior."""
    return float(scale) if precision > 0.0 else inf


def _estimate(
    *,
    channel: str,
    kind: SensorValue,
    trial: str,
    value: float,
    deviation: float,
    stated_deviation: float,
    unit: str,
) -> SensorEstimate:
    """Return the record of an estimate, with its distance from the stated value, which is zero."""
    deviations = value / stated_deviation if stated_deviation < inf else nan
    return SensorEstimate(
        channel=channel,
        kind=kind,
        trial=trial,
        value=value,
        deviation=deviation,
        stated_deviation=stated_deviation,
        deviations=deviations,
        unit=unit,
    )
