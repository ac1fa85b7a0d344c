"""Noise records of a campaign's channels: from samples at rest, from repeated trials, or as stated."""

from collections.abc import Mapping, Sequence

import numpy as np

from discrepancy.campaign.records import Channel, FloatArray, NoiseRecord, Trial
from discrepancy.errors import CampaignDataError
from reporting.words import counted

SAME_INPUT = 1e-6
"""Inputs of two rows are the same if they differ by less than this share of the largest in the trial."""
_LEAST_DEGREES = 3


def pre_trigger_record(samples: FloatArray, interval: float | None, name: str, source: str) -> NoiseRecord:
    """Return the noise record of samples at rest: mean removed, deviation with n - 1 degrees of freedom.

    Parameters
    ----------
    samples : (n,) ndarray
        [channel's unit].
    interval : float or None
        Of sampling [s]; None where the samples are not evenly spaced, so that nothing is known of their
        correlation in time.
    name, source : str
        Channel and file, for error messages.

    Raises
    ------
    CampaignDataError
        Fewer than four samples, or all of them alike.
    """
    if len(samples) < _LEAST_DEGREES + 1:
        raise CampaignDataError(
            f"{source} holds {counted(len(samples), 'sample')} of the channel {name!r}: a noise record needs "
            f"at least {_LEAST_DEGREES + 1}; record more before the trigger or leave the column out."
        )
    mean, spread = float(np.mean(samples)), float(np.std(samples, ddof=1))
    if np.ptp(samples) == 0.0:
        raise CampaignDataError(
            f"{source}: all samples of the channel {name!r} are {samples[0]!r}, which is no noise; "
            "record it with "
            "the amplifier on, or state its standard deviation."
        )
    if abs(mean) > 1e-12 * spread:
        samples = samples - mean
        spread = float(np.std(samples, ddof=1))
    return NoiseRecord(spread, float(len(samples) - 1), samples, interval, "pre-trigger", source)


def repeat_record(channel: Channel, trials: Sequence[Trial]) -> NoiseRecord | None:
    """Return the noise of a channel from repeated static or flight trials, pooled; None without repeats.

    Trials are repeats of each other if kind, run, load place, noise factor, number of rows and every row's
    force, load factor, inputs, temperature and health agree. Deviations are taken from the mean of each row
    over the repeats; where the channel's zero is free in each trial (`offset_deviation` above zero), each
    trial's mean deviation is removed too. R repeats of N rows then have (R - 1) N or (R - 1) (N - 1) degrees
    of freedom, and sums of squares and degrees of freedom add up over groups of repeats. Fewer than three
    degrees of freedom are no record.
    """
    squares, degrees = 0.0, 0
    for group in repeated(trials, channel.name):
        # Repeats are weighed alike here, so they have one noise factor (`_repeats`).
        stack = np.stack([trial.values[:, trial.channels.index(channel.name)] for trial in group])
        stack = stack / group[0].noise_factor
        used = np.all([trial.used[:, trial.channels.index(channel.name)] for trial in group], axis=0)
        stack = stack[:, used]
        rest = stack - stack.mean(axis=0)
        rows = stack.shape[1]
        if channel.offset_deviation > 0.0:
            rest = rest - rest.mean(axis=1, keepdims=True)
            rows -= 1
        squares += float(np.sum(rest**2))
        degrees += (len(group) - 1) * max(rows, 0)
    if degrees < _LEAST_DEGREES or squares == 0.0:
        return None
    return NoiseRecord(float(np.sqrt(squares / degrees)), float(degrees), None, None, "repeats")


def repeated(trials: Sequence[Trial], channel: str) -> list[list[Trial]]:
    """Return the groups of two or more trials with a channel that repeat each other."""
    groups: list[list[Trial]] = []
    for trial in trials:
        if trial.is_dynamic or channel not in trial.channels:
            continue
        for group in groups:
            if _repeats(group[0], trial):
                group.append(trial)
                break
        else:
            groups.append([trial])
    return [group for group in groups if len(group) > 1]


def _repeats(first: Trial, second: Trial) -> bool:
    if (first.kind, first.run, first.load_place, len(first.time), first.noise_factor) != (
        second.kind, second.run, second.load_place, len(second.time), second.noise_factor,
    ):  # fmt: skip
        return False
    if [item.name for item in first.inputs] != [item.name for item in second.inputs]:
        return False
    pairs = (
        *zip([item.values for item in first.inputs], [item.values for item in second.inputs], strict=True),
        (first.force, second.force),
        (first.load_factor, second.load_factor),
        (first.temperature, second.temperature),
        (first.health, second.health),
    )
    return all(
        float(np.max(np.abs(one - other))) <= SAME_INPUT * float(np.max(np.abs(one))) for one, other in pairs
    )


def with_noise(
    channel: Channel,
    recorded: Mapping[str, NoiseRecord],
    stated: NoiseRecord | None,
    trials: Sequence[Trial],
) -> tuple[NoiseRecord | None, str]:
    """Return a channel's noise record and a remark (empty if there is nothing to say).

    Samples at rest come first, then what is stated, then repeats: repeats hold whatever differs from trial to
    trial (a zero that drifts, a seating), which may be the effect that is looked for.
    """
    if channel.name in recorded:
        return recorded[channel.name], ""
    if stated is not None:
        return stated, ""
    found = repeat_record(channel, trials)
    if found is not None:
        return found, (
            f"The noise of the channel {channel.name!r} is taken from repeated trials "
            f"({found.degrees_of_freedom:.0f} degrees of freedom): what changes from trial to trial is in it."
        )
    return None, ""  # said by the checks
