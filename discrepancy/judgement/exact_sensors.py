"""Zeros and gains that a campaign states as exact, but that close the misfit when they are free."""

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

LEAST_DROP = 16.0
"""Least drop of a channel's sum of squares that a free zero or gain must promise: four
deviations."""
MOST_FITS = 3
"""Number of channels that are set free one by one, the most promising first."""
LEAST_SHARE = 0.9
"""Least share of the misfit of all channels that a free zero or gain must close once it is
fitted."""
WIDE_GAIN = 1.0
"""Relative deviation that stands for a gain of which nothing is known."""


class _Nuisance(NamedTuple):
    """A nuisance of a channel that a campaign may state to be exact.

    Attributes
    ----------
    key : str
        The key of its deviation in `[[channel]]`.
    noun : str
        Its name.
    wide_deviation : float
        The deviation with which it is free.
    """

    key: str
    noun: str
    wide_deviation: float


_ZERO = _Nuisance("offset_deviation", "zero", inf)
_GAIN = _Nuisance("gain_deviation", "gain", WIDE_GAIN)


def exact_sensor_remarks(problem: Problem, no_effect: CandidateFit) -> list[str]:
    """Return a sentence for each zero or gain that the campaign wrongly states as exact.

    Such a zero or gain explains what the model leaves. The channels whose zero (or gain) promises
    most by its first step are set free and fitted, one by one and then together; the promise alone
    would not decide, as other unknowns hide it. They are reported where that closes nine tenths of
    the misfit of all channels.

    Parameters
    ----------
    problem : Problem
        The campaign and the model.
    no_effect : CandidateFit
        The fit of the model without any effect.
    """
    for nuisance in (_ZERO, _GAIN):
        drops: dict[str, float] = {}
        for name in problem.channel_names:
            drop = _promised_drop(problem, no_effect, name, nuisance)
            if drop > 0.0:
                drops[name] = drop
        promising = sorted(drops, key=lambda name: drops[name])
        sets_of_channels = [[name] for name in promising[::-1][:MOST_FITS]]
        if len(promising) > 1:
            sets_of_channels.append(promising)
        for names in sets_of_channels:
            share = _closed_share(problem, no_effect, names, nuisance)
            if share >= LEAST_SHARE:
                return [_remark(name, nuisance, share) for name in names]
    return []


def _remark(name: str, nuisance: _Nuisance, share: float) -> str:
    """Return the sentence on a channel whose exact zero or gain explains a share of the misfit."""
    return (
        f"The {nuisance.noun} of the channel {name!r} is exact in the campaign; give "
        f"`{nuisance.key}`: left free, it closes {100.0 * share:.0f} % of the misfit of the model "
        "without any effect."
    )


def _promised_drop(
    problem: Problem, no_effect: CandidateFit, name: str, nuisance: _Nuisance
) -> float:
    """Return the drop of a channel's sum of squares that a free zero or gain promises.

    It is 0 where a fit is not worth it, the campaign does not state it as exact, or the noise of
    the channel is not known.
    """
    channel = problem.campaign.channels[name]
    if channel.noise is None or getattr(channel, nuisance.key) != 0.0:
        return 0.0
    squared_lengths = []
    slopes = []
    for residual, derivative in _channel_derivatives(problem, no_effect, name, nuisance):
        squared_lengths.append(float(derivative @ derivative))
        slopes.append(float(residual @ derivative))
    if nuisance is _GAIN:  # all trials have the same gain, while each has its own zero
        squared_lengths = [sum(squared_lengths)]
        slopes = [sum(slopes)]
    drop = 0.0
    for slope, squared_length in zip(slopes, squared_lengths, strict=True):
        if squared_length > 0.0:
            drop += slope**2 / squared_length
    return drop if drop > LEAST_DROP else 0.0


class _ChannelDerivative(NamedTuple):
    """The residual (N,) of a channel in a trial, and its derivative (N,) by the zero or gain."""

    residual: FloatArray
    derivative: FloatArray


def _channel_derivatives(
    problem: Problem, no_effect: CandidateFit, name: str, nuisance: _Nuisance
) -> list[_ChannelDerivative]:
    """Return residual and derivative by a channel's zero or gain, for each trial that has it."""
    derivatives = []
    for number, data in enumerate(problem.trials):
        if name not in data.trial.channels:
            continue
        column = data.trial.channels.index(name)
        response = problem.response_with(number, no_effect.point, no_effect.candidate)
        by_nuisance = np.ones_like(response) if nuisance is _ZERO else response
        derivatives.append(
            _ChannelDerivative(
                residual=no_effect.residuals[number][:, column],
                derivative=data.standardised(by_nuisance)[:, column],
            )
        )
    return derivatives


def _closed_share(
    problem: Problem, no_effect: CandidateFit, names: Sequence[str], nuisance: _Nuisance
) -> float:
    """Return the share of the misfit that closes when the zeros or gains of channels are free."""
    channels = dict(problem.campaign.channels)
    for name in names:
        if nuisance is _ZERO:
            channels[name] = replace(channels[name], offset_deviation=nuisance.wide_deviation)
        else:
            channels[name] = replace(channels[name], gain_deviation=nuisance.wide_deviation)
    campaign = replace(problem.campaign, channels=channels)
    setting = replace(problem.setting, campaign=campaign)
    free_problem = Problem(campaign, problem.model, setting)
    free_fit = fit(free_problem, Candidate(), free_problem.start(Candidate()))
    free_fit = refit_from_first_readings(free_problem, free_fit)
    count = float(problem.counts.sum())
    misfit = no_effect.chi_square - count
    if misfit <= 0.0:
        return 0.0
    return 1.0 - max(free_fit.chi_square - count, 0.0) / misfit
