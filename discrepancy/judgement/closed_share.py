"""The share of the mean square error that a hypothesis takes away, and how it is told.

It is 1 - (rms after / rms before)^2 of the residuals without and with the hypothesis. Both are divided by the
same noise, and by nothing else: what a posterior leaves open makes no error smaller.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite, nan

import numpy as np

from discrepancy.campaign.records import Channel, FloatArray
from discrepancy.campaign.units import UNITS
from discrepancy.location.residuals import FittedTrial, ResidualSet, of_channel
from discrepancy.proof_record import ClosedShare
from reporting.words import counted

BLOCKS_OF_TRIAL = 12
"""Blocks into which the record of a trial in motion is cut at most."""
SHORTEST_BLOCK = 8
"""Samples of a block at least."""
LEAST_BLOCKS = 5
"""Blocks of all trials below which a bootstrap tells no interval."""
BOOTSTRAP_DRAWS = 2000
BOOTSTRAP_SEED = 0
NOMINAL_UNIT = "signal"
"""What figures call the unit of a signal of which nothing is known."""
CHANNELS_TOLD = 3
"""Channels whose errors a sentence tells; of more those with the largest error before."""


def over_noise_of(residuals: ResidualSet, reference: ResidualSet) -> ResidualSet:
    """Return residuals whose noise is that of a reference: of the same trials by another hypothesis.

    The two differ where no noise is recorded: there it is what each hypothesis leaves in fitted trials.
    """
    noise = {item.trial.name: item.noise_deviation for item in reference.trials}
    trials = (replace(item, noise_deviation=noise[item.trial.name]) for item in residuals.trials)
    return replace(residuals, trials=tuple(trials))


@dataclass(frozen=True, eq=False)
class SquaredErrors:
    """Sums of squared residuals over the noise, by block of the records (B,), before and after."""

    before: FloatArray
    after: FloatArray

    @property
    def share(self) -> float:
        """1 - (rms after / rms before)^2."""
        return 1.0 - float(self.after.sum() / self.before.sum())

    def interval(self) -> tuple[float, float]:
        """Return the 90 % interval of the share by draws of blocks (Kuensch 1989, Ann. Statist. 17, 1217).

        nan with fewer than five blocks.
        """
        count = len(self.before)
        if count < LEAST_BLOCKS:
            return nan, nan
        generator = np.random.default_rng(BOOTSTRAP_SEED)
        times = generator.multinomial(count, np.full(count, 1.0 / count), BOOTSTRAP_DRAWS)
        before = times @ self.before
        shares = 1.0 - (times @ self.after)[before > 0.0] / before[before > 0.0]
        low, high = np.quantile(shares, (0.05, 0.95))
        return float(low), float(high)


def squared_errors(before: ResidualSet, after: ResidualSet) -> SquaredErrors:
    """Return the squared residuals of the same trials without and with a hypothesis, over the same noise."""
    rows = []
    for without, with_effect in zip(before.trials, after.trials, strict=True):
        used = without.used & with_effect.used
        squares = [
            np.where(used, item.residual / without.noise_deviation, 0.0) ** 2
            for item in (without, with_effect)
        ]
        samples = np.arange(len(used))
        for block in np.array_split(samples, _block_count(without)):
            rows.append([float(square[block].sum()) for square in squares])
    sums_before, sums_after = np.array(rows).T
    return SquaredErrors(sums_before, sums_after)


def _block_count(item: FittedTrial) -> int:
    """Return the number of blocks of a trial: one at rest, where neighbouring loads are no repetition."""
    if not item.trial.is_dynamic:
        return 1
    return min(BLOCKS_OF_TRIAL, max(1, len(item.used) // SHORTEST_BLOCK))


def closed_share(before: ResidualSet, after: ResidualSet) -> ClosedShare | None:
    """Return the share of the mean square error that a hypothesis takes away; None if there is no error.

    Parameters
    ----------
    before, after : ResidualSet
        All trials of a campaign without and with the hypothesis. Those held out count if there are any, else
        those fitted.
    """
    trials, first, second = "fitted", before, after
    if before.held_out is not None and after.held_out is not None:
        trials, first, second = "held-out", before.held_out, after.held_out
    errors = squared_errors(first, second)
    if not errors.before.sum() > 0.0:
        return None
    return ClosedShare(errors.share, *errors.interval(), trials, len(first.trials))


def rms_by_channel(residuals: ResidualSet) -> dict[str, float]:
    """Return the root mean square residual of each channel with a used sample [channel's unit]."""
    found: dict[str, float] = {}
    for name in residuals.measured:
        records = of_channel(residuals.trials, name)
        squares = np.concatenate([item.residual[used, column] ** 2 for item, column, used in records])
        if squares.size:
            found[name] = float(np.sqrt(squares.mean()))
    return found


# ---------------------------------------------------------------- words


def share_text(closed: ClosedShare) -> str:
    """Return a share in percent with its interval where there is one, as in "93.1 % (91 to 95)"."""
    interval = ""
    if isfinite(closed.low) and isfinite(closed.high):
        interval = f" ({_percent(closed.low)} to {_percent(closed.high)})"
    return f"{_percent(closed.value)} %{interval}"


def _percent(share: float) -> str:
    """Return a share in percent that is never rounded to 100."""
    percent = 100.0 * share
    if 99.95 <= percent < 100.0:
        return f"{percent:.2f}" if percent < 99.995 else "> 99.99"
    return f"{percent:.3g}"


def trials_text(closed: ClosedShare) -> str:
    """Return in which trials a share was found."""
    fitted = "not fitted" if closed.trials == "held-out" else "fitted"
    if closed.trial_count == 1:
        return f"one trial that was {fitted}"
    return f"{counted(closed.trial_count, 'trial')} that were {fitted}"


def errors_text(
    channels: Mapping[str, Channel], before: Mapping[str, float], after: Mapping[str, float]
) -> str:
    """Return rms errors before and after in the units of their channels, as in "x 3.6 to 0.95 mm".

    Parameters
    ----------
    channels : mapping of str to Channel
        By name.
    before, after : mapping of str to float
        rms by channel [channel's unit].
    """
    names = sorted(before, key=lambda name: -before[name] / _noise_of(channels[name], before[name]))
    parts = []
    for name in names[:CHANNELS_TOLD]:
        factor, unit = UNITS[channels[name].quantity].drawn
        ends = f"{factor * before[name]:.3g} to {factor * after.get(name, nan):.3g}"
        parts.append(f"{name} {ends}" if unit == NOMINAL_UNIT else f"{name} {ends} {unit}")
    more = len(names) - CHANNELS_TOLD
    if more > 0:
        parts.append(f"{more} more in the report")
    return ", ".join(parts)


def _noise_of(channel: Channel, otherwise: float) -> float:
    """Return the recorded noise of a channel, or something else where none is recorded."""
    recorded = channel.noise.standard_deviation if channel.noise is not None else 0.0
    return recorded or otherwise or 1.0


def closed_text(before: ResidualSet, after: ResidualSet, closed: ClosedShare) -> str:
    """Return share, trials and errors in words that follow "it explains"."""
    first, second = compared_trials(before, after, closed)
    errors = errors_text(before.channels, rms_by_channel(first), rms_by_channel(second))
    where = trials_text(closed)
    if closed.grew:
        return f"it makes the error in {where} larger (rms of {errors})"
    return f"it explains {share_text(closed)} of the mean square error in {where} (rms of {errors})"


def compared_trials(
    before: ResidualSet, after: ResidualSet, closed: ClosedShare
) -> tuple[ResidualSet, ResidualSet]:
    """Return the trials that a share is of, without and with the hypothesis."""
    pairs: Sequence[ResidualSet | None] = (before.fitted, after.fitted)
    if closed.trials == "held-out":
        pairs = (before.held_out, after.held_out)
    first, second = pairs
    return first or before, second or after
