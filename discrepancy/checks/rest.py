"""Noise records that hold more than noise: a mode of the structure, what begins or dies away."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.stats import f as fisher

from discrepancy.campaign.noise import MAINS, line_near, without_lines
from discrepancy.campaign.records import Campaign, FloatArray, NoiseRecord

from .fault import DataFault, FaultKind, fault

SHORTEST = 128
"""Fewest samples of a noise record that is judged."""
LARGEST_RATIO = 2.0
"""Scatter of the loudest quarter of a noise record over that of the quietest."""
LARGEST_DRIFT = 0.6
"""Share of the variance of a noise record that a cubic in time may take."""
LARGEST_LINE = 0.05
"""Share of the variance that a line at the model's frequency may take."""
LEAST_PERIODS = 8.0
"""Fewest periods in a noise record in which a line is looked for."""
NEAR = 0.1
"""Share of the model's frequency by which it may be off."""
_LEVEL = 1e-5


def rest_faults(campaign: Campaign, frequency: float | None = None) -> Iterator[DataFault]:
    """Yield a limit for each channel whose noise record moves; see `moves`."""
    for name, channel in campaign.channels.items():
        what = None if channel.noise is None else moves(channel.noise, frequency)
        if channel.noise is None or channel.noise.interval is None or what is None:
            continue
        column = f"{(channel.column or name)!r}" + (f" of {channel.noise.file}" if channel.noise.file else "")
        yield fault(FaultKind.MOVES_AT_REST, name, column=column, what=what)


def moves(record: NoiseRecord, frequency: float | None = None) -> str | None:
    """Return what a noise record holds beside noise of one size; None if nothing.

    Without a frequency: a cubic in time that is most of it, or quarters that scatter unlike (F test
    at 1e-5, with the degrees of freedom that correlation leaves, and a factor of two). With the frequency of
    a mode [Hz]: a line within 10 % of it that holds more than 5 % of the variance. Mains are no motion.
    """
    if record.samples is None or record.interval is None or len(record.samples) < SHORTEST:
        return None
    rest, _ = without_lines(record.samples - record.samples.mean(), record.interval)
    power, interval = float(rest @ rest), record.interval
    if frequency is not None:
        short = frequency * interval * len(rest) < LEAST_PERIODS
        if short or any(abs(frequency / mains - 1.0) < NEAR for mains in MAINS):
            return None
        line = line_near(rest, interval, frequency, NEAR * frequency)
        share = 0.0 if line is None else float(line @ line) / power
        if share <= LARGEST_LINE:
            return None
        return f"holds a line near the model's {frequency:.3g} Hz with {share:.0%} of its variance"
    time = np.linspace(-1.0, 1.0, len(rest))
    trend = np.polynomial.Chebyshev.fit(time, rest, 3)(time)
    if (share := float(trend @ trend) / power) > LARGEST_DRIFT:
        return f"drifts by {np.ptp(trend):.3g} (SI) over its length, {share:.0%} of its variance"
    quarters = np.array_split(rest - trend, 4)
    sizes = np.array([np.mean(np.abs(quarter)) for quarter in quarters])  # single spikes weigh little
    one, two = int(sizes.argmax()), int(sizes.argmin())
    freedom = _freedom(quarters[two]), _freedom(quarters[one])
    ratio = float(sizes[one] / sizes[two]) if sizes[two] > 0.0 else np.inf
    if ratio < LARGEST_RATIO or 12.0 * fisher.sf(ratio**2, freedom[1], freedom[0]) > _LEVEL:
        return None
    first = sum(map(len, quarters[:one]))
    return (
        f"scatters {ratio:.2g} times as much from {first * interval:.4g} to "
        f"{(first + len(quarters[one])) * interval:.4g} s as where it is quietest"
    )


def _freedom(series: FloatArray) -> float:
    """Return the degrees of freedom of the variance of a series that is correlated in time."""
    spectrum = np.abs(np.fft.rfft(series, 2 * len(series))) ** 2
    correlation = np.fft.irfft(spectrum)[: len(series) // 4]
    return float(len(series) / (2.0 * np.sum((correlation / max(correlation[0], 1e-300)) ** 2) - 1.0))
