"""Noise records of channels, from samples at rest or from repeated trials."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import BoolArray, Channel, FloatArray, NoiseRecord, Trial
from discrepancy.errors import CampaignDataError
from reporting.words import counted

SAME_INPUT = 1e-6
"""Relative difference, to the largest value in the trial, up to which two inputs are the same."""
_LEAST_DEGREES = 3
"""Fewest degrees of freedom of a noise record."""
_LABELS = "kind", "run", "load_place", "noise_factor"
"""Fields of trials that must agree for them to be repeats of each other."""


def pre_trigger_record(
    samples: FloatArray, interval: float | None, name: str, source: str
) -> NoiseRecord:
    """Return the noise record of samples at rest, with n - 1 degrees of freedom.

    Parameters
    ----------
    samples : (n,) ndarray
        Readings while nothing moves [channel's unit].
    interval : float or None
        Sampling interval [s]; None if the samples are not evenly spaced, so that their correlation
        in time is not known.
    name, source : str
        The name of the channel, for messages, and that of the file.

    Returns
    -------
    NoiseRecord
        Its samples have the mean subtracted.

    Raises
    ------
    CampaignDataError
        If there are fewer than four samples, or all are equal.
    """
    least = _LEAST_DEGREES + 1
    if len(samples) < least:
        raise CampaignDataError(
            f"{source} holds {counted(len(samples), 'sample')} of the channel {name!r}: a noise "
            f"record needs at least {least}; record more before the trigger or leave the column "
            "out."
        )
    if np.ptp(samples) == 0.0:
        raise CampaignDataError(
            f"{source}: all samples of the channel {name!r} have the same value, so that there is "
            "no noise in them; record it with the amplifier on, or state its standard deviation."
        )
    mean = float(np.mean(samples))
    deviation = float(np.std(samples, ddof=1))
    # A mean that is only a rounding error is not subtracted, so that a record that was written to a
    # file and read again stays the same.
    if abs(mean) > 1e-12 * deviation:
        samples = samples - mean
        deviation = float(np.std(samples, ddof=1))
    return NoiseRecord(
        standard_deviation=deviation,
        degrees_of_freedom=float(len(samples) - 1),
        samples=samples,
        interval=interval,
        source="pre-trigger",
        file=source,
    )


def repeat_record(channel: Channel, trials: Sequence[Trial]) -> NoiseRecord | None:
    """Estimate the noise of a channel from repeated static or flight trials.

    Two trials are repeats if their kind, run, load place, noise factor and number of rows agree,
    and in every row force, load factor, inputs, temperature and health. Residuals are taken from
    the mean of each row over the repeats, so that R repeats of N rows have (R - 1) N degrees of
    freedom. If the zero of the channel may differ from trial to trial (`offset_deviation` above
    zero), the mean residual of each trial is subtracted too, which leaves (R - 1) (N - 1). Sums of
    squares and degrees of freedom are added over all groups of repeats.

    Returns
    -------
    NoiseRecord or None
        The noise record; None if there are no repeats, fewer than three degrees of freedom, or no
        scatter at all.
    """
    sum_of_squares = 0.0
    degrees_of_freedom = 0
    for repeats in repeated_readings(trials, channel.name):
        used_rows = repeats.used.all(axis=0)  # rows whose reading is used in every repeat
        # (repeats, used rows)
        readings = repeats.values[:, used_rows] / repeats.trials[0].noise_factor
        residual = readings - readings.mean(axis=0)
        degrees_per_repeat = readings.shape[1]
        if channel.offset_deviation > 0.0:
            residual = residual - residual.mean(axis=1, keepdims=True)
            degrees_per_repeat -= 1
        sum_of_squares += float(np.sum(residual**2))
        degrees_of_freedom += (len(repeats.trials) - 1) * max(degrees_per_repeat, 0)
    if degrees_of_freedom < _LEAST_DEGREES or sum_of_squares == 0.0:
        return None
    return NoiseRecord(
        standard_deviation=float(np.sqrt(sum_of_squares / degrees_of_freedom)),
        degrees_of_freedom=float(degrees_of_freedom),
        source="repeats",
    )


class RepeatedReadings(NamedTuple):
    """Readings of one channel in R > 1 trials of N rows that repeat each other.

    Attributes
    ----------
    trials : list of Trial
        The trials; they have one noise factor.
    values : (R, N) ndarray
        The readings of R repeated trials at N samples [unit of the channel].
    used : (R, N) ndarray of bool
        False for readings that are left out.
    """

    trials: list[Trial]
    values: FloatArray
    used: BoolArray


def repeated_readings(trials: Sequence[Trial], channel: str) -> Iterator[RepeatedReadings]:
    """Yield the readings of a channel in each group of static or flight trials that are repeats.

    A trial joins the first group whose first trial it repeats. Trials without a repeat, and
    dynamic trials, are left out.
    """
    groups: list[list[Trial]] = []
    for trial in trials:
        if trial.is_dynamic or channel not in trial.channels:
            continue
        for group in groups:
            if _is_repeat(group[0], trial):
                group.append(trial)
                break
        else:
            groups.append([trial])
    for group in groups:
        if len(group) == 1:
            continue
        values = []  # (repeats, rows), as is_used
        is_used = []
        for trial in group:
            column = trial.channels.index(channel)
            values.append(trial.values[:, column])
            is_used.append(trial.used[:, column])
        yield RepeatedReadings(group, np.array(values), np.array(is_used))


def _is_repeat(trial: Trial, other_trial: Trial) -> bool:
    """Return whether two trials have equal labels, numbers of rows, loads, inputs and damage.

    Histories are equal if they differ by at most `SAME_INPUT` of the largest value.
    """
    if any(getattr(trial, label) != getattr(other_trial, label) for label in _LABELS):
        return False
    if len(trial.time) != len(other_trial.time):
        return False
    first_histories = _acting_histories(trial)
    second_histories = _acting_histories(other_trial)
    if first_histories.keys() != second_histories.keys():
        return False
    for name, history in first_histories.items():
        largest_difference = np.max(np.abs(history - second_histories[name]))
        if not largest_difference <= SAME_INPUT * np.max(np.abs(history)):
            return False
    return True


def _acting_histories(trial: Trial) -> dict[str, FloatArray]:
    """Return the loads, inputs and stiffness losses of a trial's rows, (N,) each, by name.

    Damage regions without a loss are left out.
    """
    histories = {
        "force": trial.force,
        "load_factor": trial.load_factor,
        "temperature": trial.temperature,
    }
    for recorded_input in trial.inputs:
        histories[f"input {recorded_input.name}"] = recorded_input.values
    for region, loss in zip(trial.regions, trial.health.T, strict=True):
        if np.any(loss):
            histories[f"loss of {region}"] = loss
    return histories
