"""Noise records that hold more than noise: a drift, a motion, or a vibration of the structure."""

from collections.abc import Iterator

import numpy as np
from scipy.stats import f as f_distribution

from discrepancy.campaign.noise import MAINS, remove_lines, strongest_line_near
from discrepancy.campaign.noise_tests import autocorrelation, statistical_inefficiency
from discrepancy.campaign.records import Campaign, FloatArray, NoiseRecord
from discrepancy.checks.fault import DataFault, FaultKind

SHORTEST_RECORD = 128
"""Fewest samples of a noise record that is judged."""
LARGEST_SCATTER_RATIO = 2.0
"""Largest scatter of the loudest quarter of a noise record over that of the quietest."""
LARGEST_DRIFT_SHARE = 0.6
"""Largest fraction of the variance of a noise record that a cubic in time may take."""
LARGEST_LINE_SHARE = 0.05
"""Largest fraction of the variance that a line at the model's frequency may take."""
LEAST_PERIODS = 8.0
"""Fewest periods of a vibration in a noise record that is tested for it."""
RELATIVE_HALF_BAND = 0.1
"""Half width of the band around the model's frequency in which a line is looked for, divided by
that frequency."""
_LEVEL = 1e-5
"""Level of the F test between quarters of a noise record."""


def noise_record_faults(campaign: Campaign, frequency: float | None = None) -> Iterator[DataFault]:
    """Yield a fault for each channel whose noise record contains more than stationary noise.

    Such a record overestimates the noise, which limits what can be concluded. Without a frequency
    of a mode [Hz], drift and changing scatter are looked for; with it, only a vibration at it.
    """
    for name, channel in campaign.channels.items():
        if channel.noise is None:
            continue
        motion = disturbance_phrase(channel.noise, frequency)
        if motion is not None:
            file = f" of {channel.noise.file}" if channel.noise.file else ""
            sentence = (
                f"The noise record of the channel {name!r}, the column "
                f"{channel.table_column!r}{file}, {motion}: the motion counts as noise, and hides "
                "effects of the same size; leave those samples out, or record it while nothing "
                "moves."
            )
            yield DataFault(FaultKind.MOVES_AT_REST, sentence, name)


def disturbance_phrase(record: NoiseRecord, frequency: float | None = None) -> str | None:
    """Return a phrase on what a noise record contains besides stationary noise.

    Without a frequency, the record is tested for a drift (a cubic polynomial in time that has more
    than `LARGEST_DRIFT_SHARE` of the variance), then for a scatter that changes within the record
    (`_unsteady_scatter_phrase`). With a frequency, it is tested only for a vibration at that
    frequency (`_vibration_phrase`). Lines at mains frequencies are removed before.

    Parameters
    ----------
    record : NoiseRecord
        The noise record, taken while nothing should move.
    frequency : float, optional
        The frequency of a mode of the structure [Hz].

    Returns
    -------
    str or None
        The verb phrase for a message, such as "drifts by ...". None if nothing was found, or if
        the record has fewer than `SHORTEST_RECORD` samples or no sampling interval.
    """
    if record.samples is None or record.interval is None or len(record.samples) < SHORTEST_RECORD:
        return None
    residual, _ = remove_lines(record.samples - record.samples.mean(), record.interval)
    if frequency is not None:
        return _vibration_phrase(residual, record.interval, frequency)
    time = np.linspace(-1.0, 1.0, len(residual))
    trend = np.polynomial.Chebyshev.fit(time, residual, 3)(time)
    fraction = float(trend @ trend) / float(residual @ residual)
    if fraction > LARGEST_DRIFT_SHARE:
        return f"drifts by {np.ptp(trend):.3g} (SI) over its length, {fraction:.0%} of its variance"
    return _unsteady_scatter_phrase(residual - trend, record.interval)


def _vibration_phrase(residual: FloatArray, interval: float, frequency: float) -> str | None:
    """Return the phrase about a vibration at a mode's frequency in a noise record, or None.

    A vibration is a spectral line within `RELATIVE_HALF_BAND` of the frequency that has more than
    `LARGEST_LINE_SHARE` of the variance. A vibration is not looked for if the record has fewer than
    `LEAST_PERIODS` periods, or if the frequency is near one of the mains.

    Parameters
    ----------
    residual : (n,) ndarray
        The noise record without mains lines, mean removed.
    interval : float
        The interval between successive samples [s].
    frequency : float
        The frequency of the mode [Hz].
    """
    is_short = frequency * interval * len(residual) < LEAST_PERIODS
    if is_short or any(abs(frequency / mains - 1.0) < RELATIVE_HALF_BAND for mains in MAINS):
        return None
    line = strongest_line_near(residual, interval, frequency, RELATIVE_HALF_BAND * frequency)
    if line is None:
        return None
    fraction = float(line @ line) / float(residual @ residual)
    if fraction <= LARGEST_LINE_SHARE:
        return None
    return f"holds a line near the model's {frequency:.3g} Hz with {fraction:.0%} of its variance"


def _unsteady_scatter_phrase(residual: FloatArray, interval: float) -> str | None:
    """Return the phrase about the quarter of a noise record that scatters most; None if all agree.

    Two quarters do not agree if their scatters differ by at least the factor
    `LARGEST_SCATTER_RATIO`, and significantly by an F test at the level `_LEVEL`.

    Parameters
    ----------
    residual : (n,) ndarray
        The noise record without mains lines and drift.
    interval : float
        The interval between successive samples [s].
    """
    quarters = np.array_split(residual, 4)
    # mean absolute values (4,), which single spikes change less than the standard deviation
    scatter = np.array([np.mean(np.abs(quarter)) for quarter in quarters])
    loudest = int(scatter.argmax())
    quietest = int(scatter.argmin())
    ratio = np.inf
    if scatter[quietest] > 0.0:
        ratio = float(scatter[loudest] / scatter[quietest])
    degrees_of_freedom = (
        _effective_sample_count(quarters[loudest]),
        _effective_sample_count(quarters[quietest]),
    )
    # Bonferroni: the largest ratio among 12 ordered pairs of quarters
    p_value = 12.0 * f_distribution.sf(ratio**2, *degrees_of_freedom)
    if ratio < LARGEST_SCATTER_RATIO or p_value > _LEVEL:
        return None
    first_sample = sum(map(len, quarters[:loudest]))
    begin = first_sample * interval
    end = (first_sample + len(quarters[loudest])) * interval
    return (
        f"scatters {ratio:.2g} times as much from {begin:.4g} to {end:.4g} s as where it is "
        "quietest"
    )


def _effective_sample_count(series: FloatArray) -> float:
    """Return how many independent samples would determine the variance as well as a series (n,).

    Samples that are correlated in time count less; see `statistical_inefficiency`.
    """
    rho, chance = autocorrelation([series])
    return len(series) / statistical_inefficiency(rho, chance)
