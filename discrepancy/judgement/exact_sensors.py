"""Zeros and gains that a campaign calls exact, and that close the model's misfit when they are left free."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.beginnings import refitted_from_beginnings
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit, fit
from discrepancy.fits.problem import Problem

LEAST_DROP = 16.0
"""Least drop of a channel's sum of squares that a constant or a scale must promise: four deviations."""
MOST_FITS = 3
"""Channels that are left free one by one, the most promising first."""
LEAST_SHARE = 0.9
"""Least share of the misfit of all channels that is closed once it is fitted."""
WIDE_GAIN = 1.0
"""Relative deviation that stands for a gain of which nothing is known."""


class _Freedom(NamedTuple):
    """A nuisance that a campaign may rule out: its key in `[[channel]]`, its name, and a wide deviation."""

    key: str
    noun: str
    wide: float


_ZERO = _Freedom("offset_deviation", "zero", inf)
_GAIN = _Freedom("gain_deviation", "gain", WIDE_GAIN)


def exact_sensor_remarks(problem: Problem, none: CandidateFit) -> list[str]:
    """Return a sentence for each exact zero, else gain, that explains what the model leaves.

    Those of which a constant or a scale promises most by its first step are left free and fitted, one by one
    and then together; the promise alone would not tell, for other unknowns hide it. They are told where that
    closes nine tenths of the misfit of all channels.

    Parameters
    ----------
    problem : Problem
        The campaign and the model.
    none : CandidateFit
        The model without any effect, fitted to it.
    """
    for freedom in (_ZERO, _GAIN):
        promises = {name: _promised_drop(problem, none, name, freedom) for name in problem.channel_names}
        promising = sorted((name for name in promises if promises[name] > 0.0), key=promises.__getitem__)
        alone = [[name] for name in promising[::-1][:MOST_FITS]]
        together = [promising] if len(promising) > 1 else []
        for names in (*alone, *together):
            share = _closed_share(problem, none, names, freedom)
            if share >= LEAST_SHARE:
                return [_sentence(name, freedom, share) for name in names]
    return []


def _sentence(name: str, freedom: _Freedom, share: float) -> str:
    return (
        f"The {freedom.noun} of the channel {name!r} is exact in the campaign; give `{freedom.key}`: left "
        f"free, it closes {100.0 * share:.0f} % of the misfit of the model without any effect."
    )


def _promised_drop(problem: Problem, none: CandidateFit, name: str, freedom: _Freedom) -> float:
    """Return the drop of a sum of squares that a free zero or gain promises.

    Zero where it is not worth a fit, the campaign does not call it exact, or nobody knows its noise.
    """
    channel = problem.campaign.channels[name]
    if channel.noise is None or getattr(channel, freedom.key) != 0.0:
        return 0.0
    residuals, directions = _of_channel(problem, none, name, freedom)
    sizes = [float(direction @ direction) for direction in directions]
    slopes = [float(r @ direction) for r, direction in zip(residuals, directions, strict=True)]
    if freedom is _GAIN:  # one of all trials, while each trial has its own zero
        sizes, slopes = [sum(sizes)], [sum(slopes)]
    drop = sum(slope**2 / size for slope, size in zip(slopes, sizes, strict=True) if size > 0.0)
    return drop if drop > LEAST_DROP else 0.0


def _of_channel(
    problem: Problem, none: CandidateFit, name: str, freedom: _Freedom
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return the residuals of a channel in each trial that has it, and their slopes by its zero or gain."""
    residuals: list[FloatArray] = []
    directions: list[FloatArray] = []
    for number, data in enumerate(problem.trials):
        if name not in data.trial.channels:
            continue
        column = data.trial.channels.index(name)
        response = problem.answer(number, none.point, none.candidate)
        by_unknown = np.ones_like(response) if freedom is _ZERO else response
        residuals.append(none.residuals[number][:, column])
        directions.append(data.standardised(by_unknown)[:, column])
    return residuals, directions


def _closed_share(problem: Problem, none: CandidateFit, names: Sequence[str], freedom: _Freedom) -> float:
    """Return the share of the misfit of the model that closes when zeros or gains are free."""
    channels = dict(problem.campaign.channels)
    for name in names:
        if freedom is _ZERO:
            channels[name] = replace(channels[name], offset_deviation=freedom.wide)
        else:
            channels[name] = replace(channels[name], gain_deviation=freedom.wide)
    campaign = replace(problem.campaign, channels=channels)
    free = Problem(campaign, problem.model, replace(problem.setting, campaign=campaign))
    start = fit(free, Candidate(), free.start(Candidate()))
    free_fit = refitted_from_beginnings(free, start)
    count = float(problem.counts.sum())
    misfit = none.chi_square - count
    return 1.0 - max(free_fit.chi_square - count, 0.0) / misfit if misfit > 0.0 else 0.0
