"""Noise records that hold more than noise: a drift, a motion, or a vibration of the structure."""

from collections.abc import Iterator

import numpy as np
from scipy.stats import f as f_distribution

from discrepancy.campaign.noise import MAINS, line_near, without_lines
from discrepancy.campaign.noise_tests import autocorrelation, times_fewer
from discrepancy.campaign.records import Campaign, FloatArray, NoiseRecord
from discrepancy.checks.fault import DataFault, FaultKind

SHORTEST = 128
"""Fewest samples of a noise record that is judged."""
LARGEST_RATIO = 2.0
"""Largest scatter of the loudest quarter of a noise record over that of the quietest."""
LARGEST_DRIFT = 0.6
"""Largest fraction of the variance of a noise record that a cubic in time may take."""
LARGEST_LINE = 0.05
"""Largest fraction of the variance that a line at the model's frequency may take."""
LEAST_PERIODS = 8.0
"""Fewest periods in a noise record in which a line is searched."""
NEAR = 0.1
"""Relative error of the model's frequency that is allowed for."""
_LEVEL = 1e-5
"""Level of the F test between quarters of a noise record."""


def rest_faults(campaign: Campaign, frequency: float | None = None) -> Iterator[DataFault]:
    """Yield a limit for each channel whose noise record moves.

    Parameters
    ----------
    campaign : Campaign
        The campaign.
    frequency : float, optional
        Frequency of a mode [Hz] at which a vibration is searched; see `moves`.
    """
    for name, channel in campaign.channels.items():
        if channel.noise is None:
            continue
        motion = moves(channel.noise, frequency)
        if motion is not None:
            file = f" of {channel.noise.file}" if channel.noise.file else ""
            sentence = (
                f"The noise record of the channel {name!r}, the column "
                f"{channel.table_column!r}{file}, {motion}: what moves counts as noise and hides "
                "as much of an effect; leave those samples out, or record it while nothing moves."
            )
            yield DataFault(FaultKind.MOVES_AT_REST, sentence, name)


def moves(record: NoiseRecord, frequency: float | None = None) -> str | None:
    """Return what a noise record contains beside stationary noise, as a verb phrase.

    None if nothing.

    Without a frequency that is a cubic in time with most of the variance, or quarters that scatter
    differently (F test at 1e-5 with the degrees of freedom that correlation leaves, and a factor of
    two). With the frequency of a mode [Hz] it is a line within 10 % of it with more than 5 % of the
    variance. Lines of the mains are not a motion.
    """
    if record.samples is None or record.interval is None or len(record.samples) < SHORTEST:
        return None
    residual, _ = without_lines(record.samples - record.samples.mean(), record.interval)
    if frequency is not None:
        return _vibration(residual, record.interval, frequency)
    time = np.linspace(-1.0, 1.0, len(residual))
    trend = np.polynomial.Chebyshev.fit(time, residual, 3)(time)
    fraction = float(trend @ trend) / float(residual @ residual)
    if fraction > LARGEST_DRIFT:
        return f"drifts by {np.ptp(trend):.3g} (SI) over its length, {fraction:.0%} of its variance"
    return _unsteady_scatter(residual - trend, record.interval)


def _vibration(residual: FloatArray, interval: float, frequency: float) -> str | None:
    """Return the vibration at a mode's frequency [Hz] in a noise record (n,).

    None if there is none.
    """
    is_short = frequency * interval * len(residual) < LEAST_PERIODS
    if is_short or any(abs(frequency / mains - 1.0) < NEAR for mains in MAINS):
        return None
    line = line_near(residual, interval, frequency, NEAR * frequency)
    if line is None:
        return None
    fraction = float(line @ line) / float(residual @ residual)
    if fraction <= LARGEST_LINE:
        return None
    return f"holds a line near the model's {frequency:.3g} Hz with {fraction:.0%} of its variance"


def _unsteady_scatter(residual: FloatArray, interval: float) -> str | None:
    """Return which quarter of a noise record (n,) scatters more than another; None if none does."""
    quarters = np.array_split(residual, 4)
    # means of absolute values, in which single spikes weigh little
    scatter = np.array([np.mean(np.abs(quarter)) for quarter in quarters])
    loudest = int(scatter.argmax())
    quietest = int(scatter.argmin())
    ratio = np.inf
    if scatter[quietest] > 0.0:
        ratio = float(scatter[loudest] / scatter[quietest])
    freedom = (_freedom(quarters[loudest]), _freedom(quarters[quietest]))
    # 12 ordered pairs of quarters
    p_value = 12.0 * f_distribution.sf(ratio**2, *freedom)
    if ratio < LARGEST_RATIO or p_value > _LEVEL:
        return None
    first = sum(map(len, quarters[:loudest]))
    begin = first * interval
    end = (first + len(quarters[loudest])) * interval
    return (
        f"scatters {ratio:.2g} times as much from {begin:.4g} to {end:.4g} s as where it is "
        "quietest"
    )


def _freedom(series: FloatArray) -> float:
    """Return the degrees of freedom of the variance of a series (n,) that is correlated in time."""
    rho, chance = autocorrelation([series])
    return len(series) / times_fewer(rho, chance)
