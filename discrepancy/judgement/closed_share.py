"""The share of the mean square error that a hypothesis removes, as a number and in words.

It is 1 - (rms after / rms before)^2, with the residuals before and after the hypothesis is added to
the model. Both are divided by the same noise deviation. They are not divided by the uncertainty of
the prediction, so that an uncertain posterior does not make an error look small.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isfinite, nan

import numpy as np

from discrepancy.campaign.records import Channel, FloatArray
from discrepancy.campaign.units import UNITS
from discrepancy.location.residuals import FittedTrial, ResidualSet, channel_fits
from discrepancy.proof_record import ClosedShare, ErrorComparison
from reporting.words import counted

BLOCKS_OF_TRIAL = 12
"""Largest number of blocks into which the record of a trial in motion is cut."""
SHORTEST_BLOCK = 8
"""Least number of samples of a block."""
LEAST_BLOCKS = 5
"""Number of blocks of all trials below which there is no bootstrap interval."""
BOOTSTRAP_DRAWS = 2000
"""Number of bootstrap draws."""
BOOTSTRAP_SEED = 0
"""Seed of the bootstrap."""
NOMINAL_UNIT = "signal"
"""Unit in figures of a signal about which nothing is known."""
CHANNELS_MENTIONED = 3
"""Number of channels whose errors a sentence mentions."""


def residuals_with_noise_of(residuals: ResidualSet, reference: ResidualSet) -> ResidualSet:
    """Return residuals of a hypothesis with the noise deviations of another one, the reference.

    Only then can the two be compared: the noise of a channel without a record is estimated from
    the residuals of each hypothesis, and differs between them.
    """
    noise = {
        fitted_trial.trial.name: fitted_trial.noise_deviation for fitted_trial in reference.trials
    }
    trials = [
        replace(fitted_trial, noise_deviation=noise[fitted_trial.trial.name])
        for fitted_trial in residuals.trials
    ]
    return replace(residuals, trials=tuple(trials))


@dataclass(frozen=True, eq=False)
class SquaredErrors:
    """Sums of squared residuals over the noise variance, for each block of the records.

    Attributes
    ----------
    before, after : (B,) array
        The sums of each block without and with a hypothesis.
    """

    before: FloatArray
    after: FloatArray

    @property
    def share(self) -> float:
        """The share of the mean square error that is removed: 1 - (rms after / rms before)^2."""
        return 1.0 - float(self.after.sum() / self.before.sum())

    def interval(self) -> tuple[float, float]:
        """Return the 90 % interval of the share by a block bootstrap.

        Blocks are drawn with replacement (Kuensch 1989, Ann. Statist. 17, 1217-1241). The ends are
        nan with fewer than five blocks.
        """
        block_count = len(self.before)
        if block_count < LEAST_BLOCKS:
            return nan, nan
        generator = np.random.default_rng(BOOTSTRAP_SEED)
        times_drawn = generator.multinomial(
            block_count, np.full(block_count, 1.0 / block_count), BOOTSTRAP_DRAWS
        )
        sums_before = times_drawn @ self.before
        sums_after = times_drawn @ self.after
        # a draw of blocks without any error has no share
        has_error = sums_before > 0.0
        shares = 1.0 - sums_after[has_error] / sums_before[has_error]
        low, high = np.quantile(shares, (0.05, 0.95))
        return float(low), float(high)


def squared_errors(residuals_before: ResidualSet, residuals_after: ResidualSet) -> SquaredErrors:
    """Return the sums of squares of residuals without and with a hypothesis, over the same noise.

    Parameters
    ----------
    residuals_before, residuals_after : ResidualSet
        The same trials without and with the hypothesis.
    """
    block_sums = []
    for without_effect, with_effect in zip(
        residuals_before.trials, residuals_after.trials, strict=True
    ):
        noise = without_effect.noise_deviation
        is_used = without_effect.used & with_effect.used
        squares_before = np.where(is_used, without_effect.residual / noise, 0.0) ** 2
        squares_after = np.where(is_used, with_effect.residual / noise, 0.0) ** 2
        samples = np.arange(len(is_used))
        for block in np.array_split(samples, _block_count(without_effect)):
            sums = (float(squares_before[block].sum()), float(squares_after[block].sum()))
            block_sums.append(sums)
    sums_before, sums_after = np.array(block_sums).T
    return SquaredErrors(sums_before, sums_after)


def _block_count(fitted_trial: FittedTrial) -> int:
    """Return the number of blocks of a trial for the bootstrap.

    A static trial is one block, as its rows are different loads and no repetition of each other.
    """
    if not fitted_trial.trial.is_dynamic:
        return 1
    return min(BLOCKS_OF_TRIAL, max(1, len(fitted_trial.used) // SHORTEST_BLOCK))


def closed_share(residuals_before: ResidualSet, residuals_after: ResidualSet) -> ClosedShare | None:
    """Return the share of the mean square error that a hypothesis removes; None without an error.

    Parameters
    ----------
    residuals_before, residuals_after : ResidualSet
        All trials of a campaign without and with the hypothesis. The share is computed in the
        held-out trials if there are any, else in the fitted trials.
    """
    trial_role = "fitted"
    if residuals_before.held_out is not None and residuals_after.held_out is not None:
        trial_role = "held-out"
        residuals_before = residuals_before.held_out
        residuals_after = residuals_after.held_out
    errors = squared_errors(residuals_before, residuals_after)
    if not errors.before.sum() > 0.0:
        return None
    low, high = errors.interval()
    return ClosedShare(errors.share, low, high, trial_role, len(residuals_before.trials))


def rms_by_channel(residuals: ResidualSet) -> dict[str, float]:
    """Return the rms residual of each channel with a used sample [unit of the channel]."""
    rms: dict[str, float] = {}
    for name in residuals.channel_names:
        squares = []
        for fitted_trial, column, is_used in channel_fits(residuals.trials, name):
            squares.append(fitted_trial.residual[is_used, column] ** 2)
        all_squares = np.concatenate(squares)
        if all_squares.size:
            rms[name] = float(np.sqrt(all_squares.mean()))
    return rms


# ---------------------------------------------------------------- words


def percent_with_interval(share: ClosedShare) -> str:
    """Return a share in percent with its interval, if it has one, as in "93.1 % (91 to 95)"."""
    interval = ""
    if isfinite(share.low) and isfinite(share.high):
        interval = f" ({_percent_text(share.low)} to {_percent_text(share.high)})"
    return f"{_percent_text(share.value)} %{interval}"


def _percent_text(share: float) -> str:
    """Return a share in percent, with more digits if it would be rounded to 100."""
    percent = 100.0 * share
    if 99.95 <= percent < 100.0:
        return f"{percent:.2f}" if percent < 99.995 else "> 99.99"
    return f"{percent:.3g}"


def compared_trials_text(share: ClosedShare) -> str:
    """Return in words the trials that a share refers to."""
    role = "not fitted" if share.trials == "held-out" else "fitted"
    if share.trial_count == 1:
        return f"one trial that was {role}"
    return f"{counted(share.trial_count, 'trial')} that were {role}"


def channels_by_error(channels: Mapping[str, Channel], rms: Mapping[str, float]) -> list[str]:
    """Return the `CHANNELS_MENTIONED` channels with the largest rms error over noise, in order."""
    names = sorted(
        rms, key=lambda name: -rms[name] / _recorded_noise_or_fallback(channels[name], rms[name])
    )
    return names[:CHANNELS_MENTIONED]


def error_change_text(
    channels: Mapping[str, Channel],
    name: str,
    rms_before: Mapping[str, float],
    rms_after: Mapping[str, float],
) -> str:
    """Return the rms error of a channel before and after in its unit, as in "3.6 → 0.95 mm"."""
    factor, unit = UNITS[channels[name].quantity].drawn
    change = f"{factor * rms_before[name]:.3g} → {factor * rms_after.get(name, nan):.3g}"
    return f"{change} {unit}" if unit != NOMINAL_UNIT else f"{change} in its own unit"


def rms_errors_text(
    channels: Mapping[str, Channel], rms_before: Mapping[str, float], rms_after: Mapping[str, float]
) -> str:
    """Return rms errors before and after in the units of their channels, as in "x 3.6 → 0.95 mm".

    Parameters
    ----------
    rms_before, rms_after : mapping of str to float
        The rms error of each channel without and with the hypothesis [unit of the channel].
    """
    channel_texts = []
    for name in channels_by_error(channels, rms_before):
        change = error_change_text(channels, name, rms_before, rms_after)
        channel_texts.append(f"{name} {change}")
    unmentioned_count = len(rms_before) - CHANNELS_MENTIONED
    if unmentioned_count > 0:
        channel_texts.append(f"{unmentioned_count} more in the report")
    return ", ".join(channel_texts)


def _recorded_noise_or_fallback(channel: Channel, fallback: float) -> float:
    """Return the recorded noise deviation of a channel, or a fallback without a record; never 0."""
    recorded_deviation = channel.noise.standard_deviation if channel.noise is not None else 0.0
    return recorded_deviation or fallback or 1.0


def closed_share_text(channels: Mapping[str, Channel], errors: ErrorComparison) -> str:
    """Return the share as a clause, such as "it explains 93 % of the mean square error in ...".

    Parameters
    ----------
    errors : ErrorComparison
        The errors without and with the hypothesis; they must have a share.
    """
    share = errors.closed
    assert share is not None
    rms_errors = rms_errors_text(channels, errors.rms_before, errors.rms_after)
    trials = compared_trials_text(share)
    if share.has_grown:
        return f"it makes the error in {trials} larger (rms of {rms_errors})"
    return (
        f"it explains {percent_with_interval(share)} of the mean square error in {trials} "
        f"(rms of {rms_errors})"
    )
