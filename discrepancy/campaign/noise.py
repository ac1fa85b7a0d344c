"""The noise of a channel, from its record: variance, lines of the mains, and correlation in time.

Coloured noise is whitened by an autoregression fitted to the record, so that samples that repeat
each other are not counted as evidence. Lines of the mains are taken out first: they are an effect,
not noise.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from math import ceil, inf

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter, zoom_fft
from scipy.stats import f as f_distribution

from discrepancy.campaign.noise_tests import (
    SHORTEST_SERIES,
    LineTest,
    cumulative_periodogram,
    fisher_g,
    largest_ordinate_test,
    ljung_box,
    periodogram,
)
from discrepancy.campaign.records import Channel, FloatArray, Trial

MAINS = (50.0, 60.0, 400.0)
"""Mains frequencies [Hz], of land and aircraft: an effect, and looked for in noise records."""
MAINS_DEVIATION = 1e-3
"""Largest relative departure of the mains from their nominal frequency."""
LINE_STEPS = 1000
"""Number of frequencies that are searched within the resolution of a record."""
LEAST_FOR_COLOUR = 50
"""Fewest samples at rest from which lines and correlation in time are estimated."""
LARGEST_ORDER = 12
"""Largest order of the autoregression."""
WHITE_LEVEL = 1e-6
"""Noise is taken as white unless the Ljung-Box test of the record rejects it at this level.

Whitening by a chance correlation would colour white data."""
LINE_LEVEL = 1e-4
"""Level of the test that a line of the mains stands out of a record."""
LEAST_LINE_PERIODS = 3
"""Fewest periods in a record that make a line in it; fewer are a drift."""
NOISE_RECORD_LEVEL = 1e-3
"""p-value below which a noise record itself counts as not white, or as holding a line."""


@dataclass(frozen=True)
class NoiseModel:
    """Noise of one channel.

    Attributes
    ----------
    standard_deviation : float
        s0 of the noise of dynamic trials after whitening: of the innovation of the autoregression
        [channel's unit].
    static_deviation : float
        s0 of a single reading [channel's unit].
    degrees_of_freedom : float
        n0, the degrees of freedom of the estimate s0; infinite if s0 is exact, zero if s0 is only a
        stand-in because the channel has no noise record.
    autoregression : (p,) ndarray
        The coefficients a of e_t = x_t - sum_k a_k x_(t-k); empty for white noise.
    interval : float or None
        The sampling interval to which the autoregression belongs [s].
    lines : tuple of float
        The mains frequencies found in the record [Hz].
    """

    standard_deviation: float
    static_deviation: float
    degrees_of_freedom: float
    autoregression: FloatArray = field(default_factory=lambda: np.empty(0))
    interval: float | None = None
    lines: tuple[float, ...] = ()

    def whiten(self, columns: FloatArray, interval: float | None) -> FloatArray:
        """Filter records so that noise with this autocorrelation becomes white noise.

        Parameters
        ----------
        columns : (..., N) ndarray
            Residuals of a dynamic trial, or their derivatives; samples along the last axis.
        interval : float or None
            The sampling interval of the records [s]; None if they are unevenly sampled. If it
            differs from the interval of the noise record, the records are returned unchanged.

        Returns
        -------
        (..., N) ndarray
            The filtered records.
        """
        if not self.can_whiten(interval):
            return columns
        filter_taps = np.r_[1.0, -self.autoregression]
        white_residuals = np.asarray(lfilter(filter_taps, [1.0], columns, axis=-1))
        # `lfilter` takes samples before the record as zero, which is wrong for the first p samples:
        # they are replaced by their own weighted sums
        sample_count = columns.shape[-1]
        for sample, weights in enumerate(self._start_up_weights[:sample_count]):
            white_residuals[..., sample] = columns[..., : sample + 1] @ weights
        return white_residuals

    @cached_property
    def _start_up_weights(self) -> tuple[FloatArray, ...]:
        """Weights (t + 1,) of samples 0 .. t that whiten sample t, for t below the order p.

        The first p samples have fewer than p predecessors. Their best linear predictors come from
        the Levinson-Durbin recursion, run from order p down to order 0. Each weight vector ends
        with the sample itself, and is scaled so that the prediction error has the variance of the
        innovation at order p.
        """
        weights: list[FloatArray] = []
        coefficients = self.autoregression
        # variance of the innovation at order p over that of the prediction error at this order
        variance_ratio = 1.0
        while coefficients.size:
            reflection = coefficients[-1]
            variance_ratio *= 1.0 - reflection**2
            coefficients = (coefficients[:-1] + reflection * coefficients[-2::-1]) / (
                1.0 - reflection**2
            )
            weights.append(np.sqrt(variance_ratio) * np.r_[-coefficients[::-1], 1.0])
        return tuple(reversed(weights))

    def can_whiten(self, interval: float | None) -> bool:
        """Return whether the autoregression can filter records of a sampling interval.

        An autoregression holds only at the interval of the record that it was fitted to.

        Parameters
        ----------
        interval : float or None
            The sampling interval of the records [s]; None if they are unevenly sampled.
        """
        if not self.autoregression.size or self.interval is None or interval is None:
            return False
        return bool(abs(interval - self.interval) <= 1e-3 * self.interval)

    def stays_coloured(self, trial: Trial) -> bool:
        """Return whether a trial has coloured noise that cannot be whitened at its interval."""
        is_coloured = self.autoregression.size > 0
        return trial.is_dynamic and is_coloured and not self.can_whiten(trial.whitening_interval)


def record_at_rest(channel: Channel) -> FloatArray | None:
    """Return the noise record (n,) of a channel with its mean removed [channel's unit].

    The result is None if the channel has no samples of noise, or fewer than `SHORTEST_SERIES`.
    """
    record = channel.noise
    if record is None or record.samples is None or len(record.samples) < SHORTEST_SERIES:
        return None
    return np.asarray(record.samples - record.samples.mean())


def whiteness_is_tested(channel: Channel) -> bool:
    """Return whether the residuals of a channel must be white for a fit to be consistent.

    They must be white if the noise record passes the same tests of whiteness itself, or if there is
    no record long enough to be tested. Residuals of a sensor with coloured noise cannot be white.
    The location of a discrepancy and the gate of absolute fit use this rule.
    """
    series = record_at_rest(channel)
    if series is None:
        return True
    tests = (fisher_g(series), ljung_box(series), cumulative_periodogram(series))
    p_values = [test.p_value for test in tests]
    return min(p_values) >= NOISE_RECORD_LEVEL


def aliased_frequency(frequency: float, interval: float) -> float:
    """Return the alias of a frequency [Hz] at a sampling interval [s]: 50 Hz is 10 Hz at 1/60 s."""
    rate = 1.0 / interval
    return abs(frequency - rate * round(frequency / rate))


def noise_model(channel: Channel, fallback: float) -> NoiseModel:
    """Estimate the noise of a channel from its noise record.

    Spectral lines at mains frequencies are removed from the record first. If what remains is
    correlated in time, an autoregression is fitted to it; its innovation is the white noise.

    Parameters
    ----------
    channel : Channel
        The channel, with or without a noise record.
    fallback : float
        The standard deviation to use if the channel has no noise record [channel's unit]. The model
        then has zero degrees of freedom, which marks this value as a stand-in.

    Returns
    -------
    NoiseModel
        Standard deviation, degrees of freedom, mains lines and autoregression. A record without
        samples, or with fewer than `LEAST_FOR_COLOUR`, gives white noise of its standard deviation.
    """
    record = channel.noise
    if record is None:
        return NoiseModel(
            standard_deviation=fallback, static_deviation=fallback, degrees_of_freedom=0.0
        )
    samples, interval = record.samples, record.interval
    if samples is None or interval is None or len(samples) < LEAST_FOR_COLOUR:
        return NoiseModel(
            standard_deviation=record.standard_deviation,
            static_deviation=record.standard_deviation,
            degrees_of_freedom=record.degrees_of_freedom,
            interval=interval,
        )
    residual, lines = remove_lines(samples - samples.mean(), interval)
    # the mean has one degree of freedom; a line has three: cosine, sine and frequency
    freedom = len(residual) - 1.0 - 3.0 * len(lines)
    deviation = float(np.sqrt(residual @ residual / freedom))
    white = NoiseModel(
        standard_deviation=deviation,
        static_deviation=deviation,
        degrees_of_freedom=freedom,
        interval=interval,
        lines=lines,
    )
    if ljung_box(residual).p_value > WHITE_LEVEL:
        return white
    coefficients, innovation_variance = fit_autoregression(residual)
    return replace(
        white,
        standard_deviation=np.sqrt(innovation_variance),
        degrees_of_freedom=freedom - len(coefficients),
        autoregression=coefficients,
    )


def remove_lines(samples: FloatArray, interval: float) -> tuple[FloatArray, tuple[float, ...]]:
    """Remove spectral lines at mains frequencies from a noise record.

    A line is removed only if it is significant; see `strongest_line_near`.

    Parameters
    ----------
    samples : (n,) ndarray
        The samples of the record, minus their mean.
    interval : float
        The interval between successive samples [s].

    Returns
    -------
    residual : (n,) ndarray
        The record minus these lines.
    frequencies : tuple of float
        The nominal mains frequencies of the lines that were removed [Hz].
    """
    frequencies: list[float] = []
    residual = samples
    for frequency in MAINS:
        # the mains frequency wanders by up to this much, and a long record resolves it
        half_width = MAINS_DEVIATION * frequency
        line = strongest_line_near(
            residual, interval, aliased_frequency(frequency, interval), half_width
        )
        if line is not None:
            frequencies.append(frequency)
            residual = residual - line
    return residual, tuple(frequencies)


def strongest_line_near(
    samples: FloatArray, interval: float, frequency: float, half_width: float
) -> FloatArray | None:
    """Return the strongest spectral line near a frequency, or None if it is not significant.

    The power of the line is compared with that of the spectrum around it by an F test. None also if
    the frequency is within two resolutions of zero or of the Nyquist frequency.

    Parameters
    ----------
    samples : (n,) ndarray
        The samples of the record, minus their mean.
    interval : float
        The interval between successive samples [s].
    frequency : float
        The centre of the band that is searched [Hz].
    half_width : float
        Half the width of the band [Hz].

    Returns
    -------
    (n,) ndarray or None
        The line as a sine in time.
    """
    resolution = 1.0 / (len(samples) * interval)
    if frequency < 2.0 * resolution or frequency > 0.5 / interval - 2.0 * resolution:
        return None
    line = _strongest_line(samples, interval, frequency - half_width, frequency + half_width)

    # power of the neighbouring ordinates, because coloured noise must not pass for a line
    spectrum = np.abs(np.fft.rfft(samples - line)) ** 2
    centre = round(frequency / resolution)
    excluded = 3 + ceil(half_width / resolution)
    below = spectrum[max(1, centre - excluded - 9) : max(1, centre - excluded + 1)]
    above = spectrum[centre + excluded : centre + excluded + 10]
    neighbours = np.r_[below, above]  # ten on either side, fewer near the ends of the spectrum
    # By Parseval's theorem a sine has the sum of squares of two ordinates, at plus and minus its
    # frequency, over n. This is that of a sine fitted to noise alone.
    noise_power = neighbours.mean() * 2.0 / len(samples)

    # F test at a Bonferroni level: the strongest of several independent frequencies was chosen
    independent_frequencies = 1.0 + 2.0 * half_width / resolution
    critical_ratio = f_distribution.isf(
        LINE_LEVEL / independent_frequencies, 2, 2 * len(neighbours)
    )
    stands_out = noise_power > 0.0 and line @ line > critical_ratio * noise_power
    return line if stands_out else None


def find_line(series: FloatArray) -> LineTest:
    """Test a noise record for a spectral line that stands out of the spectrum of its noise.

    Slow noise has most of its power at low frequencies, where a test against white noise would take
    it for a line. Therefore the ordinates of the periodogram are divided by the spectrum of an
    autoregression before they are tested by Fisher's g. The autoregression is fitted to the record
    minus the line, because otherwise it would follow the line. Two candidates are tried: the
    strongest line, and the one that most exceeds the spectrum of an autoregression of the whole
    record. The p-value allows for this choice (Bonferroni). A sine of fewer than
    `LEAST_LINE_PERIODS` periods counts as a drift and not as a line.

    Parameters
    ----------
    series : (n,) ndarray
        The samples of the record, minus their mean.

    Returns
    -------
    LineTest
        The test, whose statistic is the fraction of the record's variance in the line.
    """
    count = len(series)
    ordinates = periodogram(series)  # (M,), at the frequencies 1 / n, 2 / n, ... per sample
    total_power = float(ordinates.sum())
    ordinates[: LEAST_LINE_PERIODS - 1] = 0.0
    coefficients, _ = fit_autoregression(series)
    whitened_ordinates = ordinates / _autoregressive_spectrum(coefficients, count)
    candidates = {int(ordinates.argmax()) + 1, int(whitened_ordinates.argmax()) + 1}
    tests = []
    for index in sorted(candidates):
        line = _strongest_line(series, 1.0, (index - 1) / count, (index + 1) / count)
        coefficients, _ = fit_autoregression(series - line)
        whitened_ordinates = ordinates / _autoregressive_spectrum(coefficients, count)
        tests.append(largest_ordinate_test(whitened_ordinates))
    best = min(tests, key=lambda test: test.p_value)
    return LineTest(
        statistic=float(ordinates[best.frequency_index - 1]) / total_power,
        p_value=min(1.0, len(tests) * best.p_value),
        frequency_index=best.frequency_index,
    )


def _autoregressive_spectrum(coefficients: FloatArray, count: int) -> FloatArray:
    """Return the power spectrum (M,) of an autoregression whose innovation has unit variance.

    The spectrum is given at the frequencies of `periodogram` for `count` samples.
    """
    filter_response = np.fft.rfft(np.r_[1.0, -coefficients], count)
    return np.asarray(1.0 / np.abs(filter_response[1 : (count - 1) // 2 + 1]) ** 2)


def _strongest_line(samples: FloatArray, interval: float, low: float, high: float) -> FloatArray:
    """Fit the sine of largest power between two frequencies to a record by least squares.

    Parameters
    ----------
    samples : (n,) ndarray
        The samples of the record, minus their mean.
    interval : float
        The interval between successive samples [s].
    low, high : float
        The ends of the band of frequencies that is searched [Hz].

    Returns
    -------
    (n,) ndarray
        The sine at the times of the samples.
    """
    step = 1.0 / (LINE_STEPS * len(samples) * interval)
    low = max(low, step)
    # frequency of most power, by a zoomed Fourier transform
    frequencies = np.linspace(low, high, 2 + int((high - low) / step))
    spectrum = zoom_fft(samples, (low, high), len(frequencies), fs=1.0 / interval, endpoint=True)
    strongest = np.abs(spectrum).argmax()
    # amplitudes of cosine and sine at that frequency
    phase = 2.0 * np.pi * frequencies[strongest] * interval * np.arange(len(samples))
    waves = np.stack((np.cos(phase), np.sin(phase)), axis=1)
    amplitudes, *_ = np.linalg.lstsq(waves, samples, rcond=None)
    return np.asarray(waves @ amplitudes)


def fit_autoregression(series: FloatArray) -> tuple[FloatArray, float]:
    """Fit an autoregression to a series, with the order of the least BIC.

    The coefficients solve the Yule-Walker equations of each order. BIC is the Bayesian information
    criterion (Schwarz 1978), n log(variance) + p log(n) for the order p.

    Parameters
    ----------
    series : (n,) ndarray
        The samples of the record, minus their mean.

    Returns
    -------
    coefficients : (p,) ndarray
        The coefficients a of x_t = sum_k a_k x_(t-k) + e_t; p is at most `LARGEST_ORDER`.
    variance : float
        The variance of the innovation e.
    """
    count = len(series)
    covariance = np.array(  # (LARGEST_ORDER + 1,), at the lags 0, 1, ...
        [series[: count - lag] @ series[lag:] / count for lag in range(LARGEST_ORDER + 1)]
    )
    best_coefficients = np.empty(0)
    best_variance = float(covariance[0])
    least_criterion = inf
    for order in range(LARGEST_ORDER + 1):
        lagged = covariance[1 : order + 1]
        coefficients = solve_toeplitz(covariance[:order], lagged) if order else np.empty(0)
        variance = float(covariance[0] - coefficients @ lagged)
        criterion = count * np.log(variance) + order * np.log(count)
        if criterion < least_criterion:
            least_criterion = criterion
            best_coefficients = coefficients
            # unbiased: the coefficients and the mean take order + 1 degrees of freedom
            best_variance = variance * count / (count - order - 1.0)
    return best_coefficients, best_variance
