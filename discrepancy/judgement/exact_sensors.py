"""Zeros and gains of sensors that a campaign states as exact, but that explain the misfit.

They are found by fitting the model again with these zeros or gains as unknowns.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import inf
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.beginnings import refit_from_first_readings
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit, fit
from discrepancy.fits.problem import Problem

LEAST_EXPECTED_DROP = 16.0
"""Least expected drop of a channel's sum of squares for a free zero or gain to be fitted: that
of four noise deviations."""
MOST_SINGLE_CHANNEL_FITS = 3
"""Number of channels whose zero or gain is fitted one by one, the most promising first."""
LEAST_REMOVED_SHARE = 0.9
"""Least share of the misfit of all channels that a fitted zero or gain must remove for a remark."""
UNKNOWN_GAIN_DEVIATION = 1.0
"""Relative deviation that stands for a gain of which nothing is known."""


class _Nuisance(NamedTuple):
    """A property of a sensor, its zero or its gain, that a campaign may state to be exact.

    Attributes
    ----------
    key : str
        The key of its deviation in `[[channel]]`.
    noun : str
        The name of the property in sentences.
    wide_deviation : float
        The prior standard deviation with which it is fitted as an unknown.
    """

    key: str
    noun: str
    wide_deviation: float


_ZERO_NUISANCE = _Nuisance("offset_deviation", "zero", inf)
_GAIN_NUISANCE = _Nuisance("gain_deviation", "gain", UNKNOWN_GAIN_DEVIATION)


def exact_sensor_remarks(problem: Problem, no_effect: CandidateFit) -> list[str]:
    """Return a sentence for each zero or gain that the campaign wrongly states as exact.

    Zeros are tried first, then gains. With all other unknowns fixed, it is estimated by how much
    the sum of squares falls if the zero of a channel is free. The channels with the largest
    decrease are then fitted with a free zero, each alone and then all together, as other unknowns
    may compensate for it. The first of these fits that removes at least `LEAST_REMOVED_SHARE` of
    the misfit of all channels is reported, for each of its channels.
    """
    for nuisance in (_ZERO_NUISANCE, _GAIN_NUISANCE):
        drop_by_channel: dict[str, float] = {}
        for name in problem.channel_names:
            drop = _expected_drop(problem, no_effect, name, nuisance)
            if drop > 0.0:
                drop_by_channel[name] = drop
        # ascending, so that the channels of the largest drops are the last ones
        channels_by_drop = sorted(drop_by_channel, key=lambda name: drop_by_channel[name])
        sets_of_channels = [[name] for name in channels_by_drop[::-1][:MOST_SINGLE_CHANNEL_FITS]]
        if len(channels_by_drop) > 1:
            sets_of_channels.append(channels_by_drop)
        for names in sets_of_channels:
            share = _removed_share(problem, no_effect, names, nuisance)
            if share >= LEAST_REMOVED_SHARE:
                return [_exactness_remark(name, nuisance, share) for name in names]
    return []


def _exactness_remark(name: str, nuisance: _Nuisance, share: float) -> str:
    """Return the sentence on a channel whose exact zero or gain explains a share of the misfit."""
    return (
        f"The {nuisance.noun} of the channel {name!r} is exact in the campaign; give "
        f"`{nuisance.key}`: if it is fitted, the misfit of the model without any effect falls by "
        f"{100.0 * share:.0f} %."
    )


def _expected_drop(
    problem: Problem, no_effect: CandidateFit, name: str, nuisance: _Nuisance
) -> float:
    """Return the drop of a channel's sum of squares by a free zero or gain, other unknowns fixed.

    With the residuals r and their derivative d it is (r.d)^2 / d.d. It is 0 if the drop is below
    `LEAST_EXPECTED_DROP`, if the campaign does not state the zero or gain as exact, or if the
    channel has no noise record.
    """
    channel = problem.campaign.channels[name]
    if channel.noise is None or getattr(channel, nuisance.key) != 0.0:
        return 0.0
    squared_lengths = []
    slopes = []
    for residual, derivative in _channel_derivatives(problem, no_effect, name, nuisance):
        squared_lengths.append(float(derivative @ derivative))
        slopes.append(float(residual @ derivative))
    if nuisance is _GAIN_NUISANCE:  # all trials have the same gain, while each has its own zero
        squared_lengths = [sum(squared_lengths)]
        slopes = [sum(slopes)]
    drop = 0.0
    for slope, squared_length in zip(slopes, squared_lengths, strict=True):
        if squared_length > 0.0:
            drop += slope**2 / squared_length
    return drop if drop > LEAST_EXPECTED_DROP else 0.0


class _ChannelDerivative(NamedTuple):
    """The residuals of a channel in a trial, and their derivative with respect to a zero or gain.

    Attributes
    ----------
    residual : (N,) array
        The standardised residuals.
    derivative : (N,) array
        The standardised derivative of the prediction by the zero or gain.
    """

    residual: FloatArray
    derivative: FloatArray


def _channel_derivatives(
    problem: Problem, no_effect: CandidateFit, name: str, nuisance: _Nuisance
) -> list[_ChannelDerivative]:
    """Return the residuals and derivatives of a channel for each trial that has the channel."""
    derivatives = []
    for trial_index, data in enumerate(problem.trials):
        if name not in data.trial.channels:
            continue
        column = data.trial.channels.index(name)
        response = problem.response_of_candidate(trial_index, no_effect.point, no_effect.candidate)
        by_nuisance = np.ones_like(response) if nuisance is _ZERO_NUISANCE else response
        derivatives.append(
            _ChannelDerivative(
                residual=no_effect.residuals[trial_index][:, column],
                derivative=data.standardise(by_nuisance)[:, column],
            )
        )
    return derivatives


def _removed_share(
    problem: Problem, no_effect: CandidateFit, names: Sequence[str], nuisance: _Nuisance
) -> float:
    """Return the share of the misfit that is removed if zeros or gains of channels are fitted.

    The misfit is the sum of squared standardised residuals beyond that of noise alone, which is the
    number of readings.
    """
    channels = dict(problem.campaign.channels)
    for name in names:
        if nuisance is _ZERO_NUISANCE:
            channels[name] = replace(channels[name], offset_deviation=nuisance.wide_deviation)
        else:
            channels[name] = replace(channels[name], gain_deviation=nuisance.wide_deviation)
    campaign = replace(problem.campaign, channels=channels)
    setting = replace(problem.setting, campaign=campaign)
    free_problem = Problem(campaign, problem.model, setting)
    free_fit = fit(free_problem, Candidate(), free_problem.prior_mean_point(Candidate()))
    free_fit = refit_from_first_readings(free_problem, free_fit)
    reading_count = float(problem.sample_counts.sum())
    excess_before = no_effect.chi_square - reading_count
    if excess_before <= 0.0:
        return 0.0
    return 1.0 - max(free_fit.chi_square - reading_count, 0.0) / excess_before
