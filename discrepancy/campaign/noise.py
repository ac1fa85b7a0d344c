"""What the noise record of a channel says: its variance, lines of the mains in it, its correlation in time.

Coloured noise is whitened by an autoregression fitted to the record, so that samples that repeat each other
are not counted as evidence. Lines of the mains are taken out first: they are an effect, not noise.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import ceil, inf

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter, zoom_fft
from scipy.stats import f as f_distribution

from discrepancy.campaign.noise_tests import SHORTEST_SERIES, cumulative_periodogram, fisher_g, ljung_box
from discrepancy.campaign.records import BoolArray, Channel, FloatArray, NoiseRecord, Trial
from discrepancy.errors import CampaignDataError, said
from reporting.words import counted

MAINS = (50.0, 60.0, 400.0)
"""Mains frequencies [Hz], of land and aircraft: an effect, and looked for in noise records."""
MAINS_DEVIATION = 1e-3
"""Share of its frequency by which the mains may be off."""
LINE_STEPS = 1000
"""Frequencies that are looked at within the resolution of a record."""
LARGEST_ORDER = 12
WHITE_LEVEL = 1e-6
"""Noise is taken as white unless the Ljung-Box test of the record rejects it at this level.

Whitening by a chance correlation would colour white data."""
LINE_LEVEL = 1e-4
NOISE_RECORD_LEVEL = 1e-3
"""p-value below which a noise record itself counts as not white, or as holding a line."""


@dataclass(frozen=True)
class NoiseModel:
    """Noise of one channel.

    Attributes
    ----------
    standard_deviation : float
        s0 of the white innovation for dynamic trials, after whitening [channel's unit].
    static_deviation : float
        s0 of a single reading [channel's unit].
    degrees_of_freedom : float
        n0; infinite where s0 is exact, zero where nothing is known.
    autoregression : (p,) ndarray
        Coefficients a of e_t = x_t - sum_k a_k x_(t-k); empty for white noise.
    interval : float or None
        Sampling interval to which the autoregression belongs [s].
    lines : tuple of float
        Mains frequencies found in the record [Hz].
    """

    standard_deviation: float
    static_deviation: float
    degrees_of_freedom: float
    autoregression: FloatArray = field(default_factory=lambda: np.empty(0))
    interval: float | None = None
    lines: tuple[float, ...] = ()

    def whiten(self, columns: FloatArray, interval: float | None) -> FloatArray:
        """Return the columns (..., N) of a dynamic record filtered so that this noise becomes white.

        Parameters
        ----------
        columns : (..., N) ndarray
            Residuals or derivatives, along the last axis.
        interval : float or None
            Their sampling interval [s]; the filter applies only at the record's own interval.
        """
        if not self.applies(interval):
            return columns
        white = np.asarray(lfilter(np.r_[1.0, -self.autoregression], [1.0], columns, axis=-1))
        for row, weights in enumerate(self._beginning[: columns.shape[-1]]):
            white[..., row] = columns[..., : row + 1] @ weights
        return white

    @cached_property
    def _beginning(self) -> tuple[FloatArray, ...]:
        """Weights (t + 1,) of the samples up to t that make sample t < p white: it has no longer history.

        The best predictors of lower order, by the Levinson-Durbin recursion backwards.
        """
        weights: list[FloatArray] = []
        coefficients, share = self.autoregression, 1.0  # of the innovation in the prediction's variance
        while coefficients.size:
            last = coefficients[-1]
            share *= 1.0 - last**2
            coefficients = (coefficients[:-1] + last * coefficients[-2::-1]) / (1.0 - last**2)
            weights.append(np.sqrt(share) * np.r_[-coefficients[::-1], 1.0])
        return tuple(reversed(weights))

    def applies(self, interval: float | None) -> bool:
        """Whether the autoregression belongs to this sampling interval; to None, of uneven samples, not."""
        return bool(
            self.autoregression.size
            and self.interval is not None
            and interval is not None
            and abs(interval - self.interval) <= 1e-3 * self.interval
        )

    def stays_coloured(self, trial: Trial) -> bool:
        """Whether coloured noise cannot be whitened in a trial: its samples are no independent ones there."""
        return trial.is_dynamic and self.autoregression.size > 0 and not self.applies(trial.whitened_at)


def record_at_rest(channel: Channel) -> FloatArray | None:
    """Return the samples (n,) of a noise record about their mean; None: too few to be tested."""
    record = channel.noise
    if record is None or record.samples is None or len(record.samples) < SHORTEST_SERIES:
        return None
    return np.asarray(record.samples - record.samples.mean())


def whiteness_is_tested(channel: Channel) -> bool:
    """Whether what is left in a channel has to be white: its noise record is so itself, without a line.

    Locating and the gate of absolute fit go by this one rule.
    """
    series = record_at_rest(channel)
    if series is None:
        return True
    p_values = (fisher_g(series)[1], ljung_box(series)[1], cumulative_periodogram(series)[1])
    return min(p_values) >= NOISE_RECORD_LEVEL


def aliased(frequency: float, interval: float) -> float:
    """Return where a line shows [Hz] when sampled at `interval` [s]: 50 Hz shows at 10 Hz with 1/60 s."""
    rate = 1.0 / interval
    return abs(frequency - rate * round(frequency / rate))


def noise_model(channel: Channel, fallback: float) -> NoiseModel:
    """Return the noise of a channel from its record.

    Parameters
    ----------
    channel : Channel
        With its noise record, or none.
    fallback : float
        Scale that stands in for an unknown deviation [channel's unit]; only ratios to it matter then.
    """
    record = channel.noise
    if record is None:
        return NoiseModel(fallback, fallback, 0.0)
    samples, interval = record.samples, record.interval
    if samples is None or interval is None or len(samples) < 50:
        deviation = record.standard_deviation
        return NoiseModel(deviation, deviation, record.degrees_of_freedom, interval=interval)
    rest, lines = without_lines(samples - samples.mean(), interval)
    freedom = len(rest) - 1.0 - 3.0 * len(lines)  # cosine, sine and frequency
    deviation = float(np.sqrt(rest @ rest / freedom))
    white = NoiseModel(deviation, deviation, freedom, interval=interval, lines=lines)
    if ljung_box(rest)[1] > WHITE_LEVEL:
        return white
    found, innovation = autoregression(rest)
    freedom -= len(found)
    return replace(
        white, standard_deviation=np.sqrt(innovation), degrees_of_freedom=freedom, autoregression=found
    )


def without_lines(samples: FloatArray, interval: float) -> tuple[FloatArray, tuple[float, ...]]:
    """Return the record without the mains lines that stand out of it, and their nominal frequencies [Hz].

    The mains wander by `MAINS_DEVIATION` of their frequency, which a long record resolves.
    """
    found: list[float] = []
    rest = samples
    for frequency in MAINS:
        line = line_near(rest, interval, aliased(frequency, interval), MAINS_DEVIATION * frequency)
        if line is not None:
            found.append(frequency)
            rest = rest - line
    return rest, tuple(found)


def line_near(samples: FloatArray, interval: float, shown: float, reach: float) -> FloatArray | None:
    """Return the line within reach of a frequency [Hz] if it stands out of a record, else None."""
    resolution = 1.0 / (len(samples) * interval)
    if shown < 2.0 * resolution or shown > 0.5 / interval - 2.0 * resolution:
        return None
    line = _strongest_line(samples, interval, shown - reach, shown + reach)
    # against the neighbourhood of the line, so that coloured noise is not taken for one
    spectrum = np.abs(np.fft.rfft(samples - line)) ** 2
    index = round(shown / resolution)
    wide = 3 + ceil(reach / resolution)
    near = np.r_[
        spectrum[max(1, index - wide - 9) : max(1, index - wide + 1)],
        spectrum[index + wide : index + wide + 10],
    ]
    level = near.mean() * 2.0 / len(samples)  # mean power that a line of noise alone takes from the sum
    independent = 1.0 + 2.0 * reach / resolution
    far = f_distribution.isf(LINE_LEVEL / independent, 2, 2 * len(near))  # few ordinates tell the level
    stands_out = level > 0.0 and line @ line > far * level
    return line if stands_out else None


def _strongest_line(samples: FloatArray, interval: float, low: float, high: float) -> FloatArray:
    """Return the line of most power between two frequencies [Hz], by least squares."""
    step = 1.0 / (LINE_STEPS * len(samples) * interval)
    low = max(low, step)
    frequencies = np.linspace(low, high, 2 + int((high - low) / step))
    power = np.abs(zoom_fft(samples, (low, high), len(frequencies), fs=1.0 / interval, endpoint=True))
    phase = 2.0 * np.pi * frequencies[power.argmax()] * interval * np.arange(len(samples))
    waves = np.stack((np.cos(phase), np.sin(phase)), axis=1)
    amplitude, *_ = np.linalg.lstsq(waves, samples, rcond=None)
    return np.asarray(waves @ amplitude)


def autoregression(series: FloatArray) -> tuple[FloatArray, float]:
    """Return coefficients (p,) and innovation variance of the autoregression with the least BIC."""
    size = len(series)
    covariance = np.array([series[: size - lag] @ series[lag:] / size for lag in range(LARGEST_ORDER + 1)])
    best, least = (np.empty(0), float(covariance[0])), inf
    for order in range(LARGEST_ORDER + 1):
        coefficients = solve_toeplitz(covariance[:order], covariance[1 : order + 1]) if order else np.empty(0)
        innovation = float(covariance[0] - coefficients @ covariance[1 : order + 1])
        score = size * np.log(innovation) + order * np.log(size)
        if score < least:
            best, least = (coefficients, innovation * size / (size - order - 1.0)), score
    return best


# ---------------------------------------------------------------- records of it


SAME_INPUT = 1e-6
"""Inputs of two rows are the same if they differ by less than this share of the largest in the trial."""
_LEAST_DEGREES = 3
_LABELS = "kind", "run", "load_place", "noise_factor"


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
        told = {"source": source, "samples": counted(len(samples), "sample"), "least": _LEAST_DEGREES + 1}
        raise CampaignDataError(said("campaign.few_at_rest", name=name, **told))
    mean, spread = float(np.mean(samples)), float(np.std(samples, ddof=1))
    if np.ptp(samples) == 0.0:
        raise CampaignDataError(said("campaign.no_noise", source=source, name=name, value=samples[0]))
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
    for group, stack, used in repeated(trials, channel.name):
        stack = stack[:, used.all(axis=0)] / group[0].noise_factor
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


def repeated(trials: Sequence[Trial], channel: str) -> Iterator[tuple[list[Trial], FloatArray, BoolArray]]:
    """Yield groups of R > 1 trials that repeat each other, what a channel read (R, N), and what counts of it.

    Repeats are weighed alike, so they have one noise factor.
    """
    groups: list[list[Trial]] = []
    for trial in trials:
        if not trial.is_dynamic and channel in trial.channels:
            group = next((group for group in groups if _repeats(group[0], trial)), None)
            if group is None:
                groups.append(group := [])
            group.append(trial)
    for group in groups:
        if len(group) > 1:
            of = [(trial, trial.channels.index(channel)) for trial in group]
            values, used = [item.values[:, at] for item, at in of], [item.used[:, at] for item, at in of]
            yield group, np.array(values), np.array(used)


def _repeats(first: Trial, second: Trial) -> bool:
    def acting(trial: Trial) -> dict[str, FloatArray]:
        losses = zip(trial.regions, trial.health.T, strict=True)
        return {
            **{name: getattr(trial, name) for name in ("force", "load_factor", "temperature")},
            **{f"input {item.name}": item.values for item in trial.inputs},
            **{f"loss of {region}": loss for region, loss in losses if np.any(loss)},
        }

    one, other = acting(first), acting(second)
    labels = (getattr(first, name) == getattr(second, name) for name in _LABELS)
    return (
        all(labels)
        and len(first.time) == len(second.time)
        and one.keys() == other.keys()
        and all(
            np.max(np.abs(one[name] - other[name])) <= SAME_INPUT * np.max(np.abs(one[name])) for name in one
        )
    )
