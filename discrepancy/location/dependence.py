"""What a discrepancy depends on: amplitude, time, load, temperature, harmonics.

Each dependence is fitted to the residuals, and explains a fraction of the excess variance: their
sum of squares, in units of the noise, less its expectation for noise alone. A motion of several
modes is split into them by bands of its spectrum.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.linalg import block_diag

from discrepancy.campaign.noise_tests import periodogram
from discrepancy.campaign.records import FloatArray
from discrepancy.location.map import (
    NormalEquations,
    dependence_functions,
    explained_sum_of_squares,
    normal_equations_of,
)
from discrepancy.location.residuals import FittedTrial
from reporting.arrays import AnyArray


def mode_bands(frequencies: Sequence[float]) -> list[tuple[float, float]]:
    """Return the frequency band of each mode [Hz], lowest first, given their frequencies [Hz].

    Bands meet at the geometric mean of neighbouring frequencies. The lowest begins at half the
    first frequency, the highest ends at `sqrt(2)` times the last.
    """
    modes = np.asarray(frequencies, dtype=float)
    inner_edges = np.sqrt(modes[1:] * modes[:-1]).tolist()
    edges = [0.5 * frequencies[0], *inner_edges, 2.0**0.5 * frequencies[-1]]
    return list(pairwise(edges))


def modal_motion(
    values: FloatArray, interval: float, frequencies: Sequence[float]
) -> NDArray[np.complex128]:
    """Split a motion without noise, such as a prediction, into its modes by bands of frequency.

    Parameters
    ----------
    values : (N, C) ndarray
        The motion. It is extended by its mirror images on both sides, so that the Fourier
        transform meets no jump at its ends.
    interval : float
        The interval between successive samples [s].
    frequencies : sequence of float
        The frequencies of the K modes [Hz], lowest first, apart by more than the resolution of the
        record.

    Returns
    -------
    (K, N, C) ndarray
        Analytic signal x - i v / w of each mode, with displacement x, rate v and angular frequency
        w. The modulus of the signal is the amplitude of the mode at each time.
    """
    count = len(values)
    mirrored_motion = np.concatenate([values[:0:-1], values, values[-2::-1]])  # (3 N - 2, C)
    spectrum = np.fft.fft(mirrored_motion, axis=0)
    ordinate_frequencies = np.fft.fftfreq(len(spectrum), interval)[:, np.newaxis]
    spectra_of_modes = []
    for low, high in mode_bands(frequencies):
        in_band = (ordinate_frequencies >= low) & (ordinate_frequencies < high)
        # positive frequencies alone, doubled: the analytic signal
        spectra_of_modes.append(2.0 * spectrum * in_band)
    # without the mirror images
    return np.asarray(np.fft.ifft(spectra_of_modes, axis=1)[:, count - 1 : 2 * count - 1])


def mode_shares(
    trials: Sequence[FittedTrial],
    white_residuals: Sequence[FloatArray],
    frequencies: Sequence[float],
) -> FloatArray:
    """Return the fraction (M,) of the excess variance in the frequency band of each mode.

    The excess is the sum of squares of the residuals minus its expectation for white noise. If
    there is none in total, the excess of each band is returned instead, in units of the noise.

    Parameters
    ----------
    trials : sequence of FittedTrial
        Dynamic trials, for their sampling intervals.
    white_residuals : sequence of (N, C) ndarray
        The white residuals of each trial.
    frequencies : sequence of float
        The frequencies of the M modes [Hz], lowest first.
    """
    excess_of_modes = np.zeros(len(frequencies))
    total_excess = 0.0
    for fitted_trial, values in zip(trials, white_residuals, strict=True):
        # An ordinate of the periodogram is one on average for white noise of unit variance, and
        # stands for two terms of the sum of squares: a cosine and a sine.
        excess = sum(2.0 * (periodogram(series) - 1.0) for series in values.T)  # (ordinates,)
        duration = len(values) * fitted_trial.trial.interval
        ordinate_frequencies = np.arange(1, np.size(excess) + 1) / duration
        total_excess += float(np.sum(excess))
        for mode, (low, high) in enumerate(mode_bands(frequencies)):
            in_band = (ordinate_frequencies >= low) & (ordinate_frequencies < high)
            excess_of_modes[mode] += float(np.sum(excess, where=in_band))
    if total_excess <= 0.0:
        return excess_of_modes
    return np.clip(excess_of_modes / total_excess, 0.0, 1.0)


def predicted_frequencies(trials: Sequence[FittedTrial]) -> tuple[float, ...]:
    """Return the frequencies [Hz] of up to four modes, from the spectra of the predictions.

    The modes are the highest peaks, sorted by frequency. A peak is the largest ordinate within a
    factor of 1.4 in frequency on both sides, and at least a thousandth of the largest of all. A
    peak has at least four periods in the record, because a wrong zero or a slow decay looks like a
    peak at lower frequencies. Spectra are summed over the channels and over those trials that are
    as long and as finely sampled as the longest one.
    """
    longest_trial = max(trials, key=lambda fitted_trial: len(fitted_trial.trial.time)).trial
    count = len(longest_trial.time)
    frequency_count = (count - 1) // 2
    # the falling half of a Hann window, because most of a ring-down is at its start
    taper = np.hanning(2 * count)[count:, np.newaxis]
    # power of all channels and trials over their noise, without the constant
    power = np.zeros(frequency_count)
    for fitted_trial in trials:
        trial = fitted_trial.trial
        interval_ratio = trial.interval / longest_trial.interval
        if len(trial.time) != count or abs(interval_ratio - 1.0) > 1e-6:
            continue
        values = fitted_trial.prediction - fitted_trial.prediction.mean(axis=0)  # (N, C)
        transform = np.fft.rfft(values * taper, axis=0)
        spectra = np.abs(transform) ** 2 / fitted_trial.noise_deviation**2
        power += spectra[1 : frequency_count + 1].sum(axis=1)
    frequencies = np.arange(1, frequency_count + 1) / (count * longest_trial.interval)
    # peaks
    least_power = 1e-3 * power.max(initial=0.0)
    peaks = []
    for index in range(3, frequency_count - 1):  # index 3 is four periods in the record
        frequency = float(frequencies[index])
        is_neighbour = (frequencies > frequency / 1.4) & (frequencies < frequency * 1.4)
        is_highest = power[index] >= power[is_neighbour].max()
        if is_highest and power[index] > least_power:
            peaks.append((float(power[index]), frequency))
    highest_peaks = sorted(peaks, reverse=True)[:4]
    return tuple(sorted(frequency for _, frequency in highest_peaks))


_HAT_COUNT = 9
"""Number of knots of a piecewise linear function of time or amplitude."""


class Dependence(NamedTuple):
    """What a dependence explains of the excess variance of trials of one kind.

    Attributes
    ----------
    subject : str
        "mode 1", ...; empty for whole channels.
    name : str
        What residuals depend on: "amplitude", "time", "load (not proportional)", ...
    share : float
        The fraction of the excess variance that it explains.
    p_value : float
        p-value if there is no such dependence.
    coefficient_count : int
        The number of fitted coefficients.
    """

    subject: str
    name: str
    share: float
    p_value: float
    coefficient_count: int


def excess_over_noise(trials: Sequence[FittedTrial]) -> float:
    """Return the excess variance of trials, in units of the noise variance.

    The excess is the sum of squares of the residuals minus its expectation if the model is right.
    """
    total_excess = 0.0
    for fitted_trial in trials:
        expected_sum = np.sum(fitted_trial.expected_variance[fitted_trial.used])
        total_excess = total_excess + (np.nansum(fitted_trial.standardised**2) - expected_sum)
    return float(total_excess)


def _hat_functions(values: FloatArray, low: float, high: float) -> FloatArray:
    """Return hat functions, the basis of piecewise linear functions, at values (n,).

    The knots are evenly spaced from `low` to `high`.

    Returns
    -------
    (n, `_HAT_COUNT`) ndarray
        The value of each hat function; the constant 1 in a single column if the knots coincide.
    """
    if high <= low:
        return np.ones((values.size, 1))
    knots = np.linspace(low, high, _HAT_COUNT)
    hats = np.empty((values.size, _HAT_COUNT))
    for index in range(_HAT_COUNT):
        value_at_knots = np.zeros(_HAT_COUNT)
        value_at_knots[index] = 1.0  # a hat is one at its own knot and zero at the others
        hats[:, index] = np.interp(values, knots, value_at_knots)
    return hats


def explained_dependences(trials: Sequence[FittedTrial]) -> Iterator[Dependence]:
    """Yield how much of the excess variance each dependence of the residuals explains alone.

    A dependence (on amplitude, time, load, temperature and so on) is a set of functions that is
    fitted to the residuals of each channel, with the same coefficients in all trials. Amplitude and
    time can thus be distinguished if the releases differ. Only the strongest spectral line has a
    phase of its own in each trial. Nothing is yielded if there is no significant excess.

    Parameters
    ----------
    trials : sequence of FittedTrial
        Trials of one kind with the same channels.
    """
    excess_variance = excess_over_noise(trials)
    degrees_of_freedom = sum(
        float(np.sum(fitted_trial.expected_variance[fitted_trial.used])) for fitted_trial in trials
    )
    # the sum of squares has about the variance 2 x degrees of freedom: two standard deviations
    if degrees_of_freedom <= 0.0 or excess_variance <= 2.0 * np.sqrt(2.0 * degrees_of_freedom):
        return  # there is no excess to explain
    line = None
    modes: tuple[float, ...] = ()
    if trials[0].trial.is_dynamic:
        line = dominant_line(trials)
        modes = predicted_frequencies(trials)
    # by subject and name of the dependence, for each channel
    equations: dict[tuple[str, str], list[NormalEquations]] = {}
    for column in range(len(trials[0].trial.channels)):
        with_channel = [
            fitted_trial for fitted_trial in trials if fitted_trial.used[:, column].any()
        ]
        if not with_channel:
            continue
        bases = dependence_bases(with_channel, column, modes)
        if line is not None:
            bases["", line.name] = line.decaying_waves(with_channel, column)
        rows = [(fitted_trial, fitted_trial.used[:, column]) for fitted_trial in with_channel]
        for key, basis in bases.items():
            channel_equations = normal_equations_of(basis, rows, column)
            if channel_equations is not None:
                equations.setdefault(key, []).append(channel_equations)
    for (subject, name), equations_of_channels in equations.items():
        statistic, count = explained_sum_of_squares(equations_of_channels)
        share = float(np.clip((statistic - count) / excess_variance, 0.0, 1.0))
        p_value = float(stats.chi2.sf(statistic, count)) if count else 1.0
        # Bonferroni: the line was chosen among many
        choices = line.choice_count if line is not None and name == line.name else 1
        yield Dependence(subject, name, share, min(1.0, p_value * choices), count)


class SpectralLine(NamedTuple):
    """The strongest line in the spectra of residuals.

    Attributes
    ----------
    frequency : float
        The frequency of the line [Hz].
    decay : float
        The decay rate of the line [1/s].
    choice_count : int
        The number of lines from which it was chosen.
    """

    frequency: float
    decay: float
    choice_count: int

    @property
    def name(self) -> str:
        """Name such as "a line at 50 Hz" or "a decaying line at 9.1 Hz"."""
        return f"a {'decaying ' if self.decay else ''}line at {self.frequency:.3g} Hz"

    def decaying_waves(self, trials: Sequence[FittedTrial], column: int) -> FloatArray:
        """Return the decaying cosine and sine of the line, with separate columns for each trial.

        Parameters
        ----------
        trials : sequence of FittedTrial
            The T trials; time counts from the start of each.
        column : int
            The index of the channel in the arrays of the trials.

        Returns
        -------
        (n, 2 T) ndarray
            Values at the n used samples of the channel in all trials.
        """
        waves_of_trials = []
        for fitted_trial in trials:
            times = (
                fitted_trial.trial.time[fitted_trial.used[:, column]] - fitted_trial.trial.time[0]
            )
            wave = np.exp((-self.decay + 2j * np.pi * self.frequency) * times)
            waves_of_trials.append(np.column_stack([wave.real, wave.imag]))
        return np.asarray(block_diag(*waves_of_trials))


def dominant_line(trials: Sequence[FittedTrial]) -> SpectralLine | None:
    """Return the spectral line that explains most of the residuals of dynamic trials.

    The sum of squares that a decaying sine explains is computed for the frequencies of a Fourier
    transform with four-fold zero padding, from one period in the record upwards, and for decays by
    0, 1, 3, 10 and 30 e-folds within the record. The explained sum of squares is summed over all
    channels, and over the trials that are sampled like the first one. The result is None for
    records of fewer than eight samples.
    """
    length = max(len(fitted_trial.trial.time) for fitted_trial in trials)
    interval = trials[0].trial.interval
    if length < 8:
        return None
    evenly_sampled = [
        fitted_trial
        for fitted_trial in trials
        if abs(fitted_trial.trial.interval / interval - 1.0) < 1e-6
    ]
    frequencies = np.fft.rfftfreq(4 * length, interval)
    strongest_line: SpectralLine | None = None
    greatest_power = 0.0
    choices = 0
    for folds in (0.0, 1.0, 3.0, 10.0, 30.0):
        decay = folds / (length * interval)
        power = np.zeros(frequencies.size)  # explained sum of squares, in units of the noise
        for fitted_trial in evenly_sampled:
            weight = np.exp(-decay * interval * np.arange(len(fitted_trial.trial.time)))
            # samples that are not used are nan, and become zero
            weighted_residuals = np.nan_to_num(fitted_trial.standardised) * weight[:, np.newaxis]
            # (frequencies, C)
            spectra = np.abs(np.fft.rfft(weighted_residuals, 4 * length, axis=0)) ** 2
            # A cosine and a sine under this weight each have about half the squared norm of the
            # weight, so that the explained sum of squares is 2 |spectrum|^2 / |weight|^2.
            power += 2.0 * spectra.sum(axis=1) / (weight @ weight)
        power[:4] = 0.0  # less than one period in the record
        index = int(np.argmax(power))
        choices += length // 2  # about as many independent frequencies
        # a decaying line must explain at least 5 % more than the best so far
        if power[index] > 1.05 * greatest_power:
            greatest_power = float(power[index])
            strongest_line = SpectralLine(float(frequencies[index]), decay, choices)
    return None if strongest_line is None else strongest_line._replace(choice_count=choices)


def dependence_bases(
    trials: Sequence[FittedTrial], column: int, modes: Sequence[float]
) -> dict[tuple[str, str], FloatArray]:
    """Return the functions of each dependence at the used samples of a channel.

    Parameters
    ----------
    trials : sequence of FittedTrial
        Trials of one kind in which the channel is used.
    column : int
        The index of the channel in the arrays of the trials.
    modes : sequence of float
        The frequencies of the modes [Hz].

    Returns
    -------
    dict of (str, str) to (n, k) ndarray
        Values of the functions at the n used samples, by subject ("mode 1", or empty for the
        whole channel) and name of the dependence.
    """
    samples = _UsedSamples(trials, column)
    bases = {
        ("", "zero shift"): samples.prediction_features("mean"),
        ("", "zero shift of each trial"): samples.split_by_trial(np.ones((samples.count, 1))),
    }
    temperature = samples.stack_used_samples(lambda fitted: fitted.trial.temperature)
    if np.ptp(temperature) > 0.0:
        x = samples.prediction_features("x").squeeze(axis=1)
        proportional = temperature * x
        bases["", "temperature"] = np.column_stack([temperature, proportional])
    if trials[0].trial.is_dynamic:
        return bases | _dynamic_bases(samples, modes)
    return bases | _static_bases(samples)


class _UsedSamples:
    """The n used samples of a channel in several trials, one trial after the other.

    `column` is the index of the channel in the arrays of the trials.
    """

    def __init__(self, trials: Sequence[FittedTrial], column: int) -> None:
        self.trials = trials
        self.column = column
        self.rows = [fitted_trial.used[:, column] for fitted_trial in trials]
        self.count = sum(int(rows.sum()) for rows in self.rows)
        self._features = [dependence_functions(fitted_trial, column) for fitted_trial in trials]

    def stack_used_samples(self, values: Callable[[FittedTrial], FloatArray]) -> FloatArray:
        """Return an array of each trial at its used samples, stacked over the trials.

        Parameters
        ----------
        values : callable
            Returns the array (N, ...) of a trial of N samples.

        Returns
        -------
        (n, ...) ndarray
            Its rows at the n used samples of all trials.
        """
        return self.stack_arrays([values(fitted_trial) for fitted_trial in self.trials])

    def stack_arrays(self, arrays: Sequence[AnyArray]) -> AnyArray:
        """Return arrays (N, ...) of the trials at the used samples, stacked (n, ...)."""
        used_arrays = [array[rows] for array, rows in zip(arrays, self.rows, strict=True)]
        return np.concatenate(used_arrays)

    def split_by_trial(self, functions: FloatArray) -> FloatArray:
        """Return functions with separate columns for each trial, thus separate coefficients.

        Parameters
        ----------
        functions : (n, k) ndarray
            Values of k functions at the n used samples of T trials.

        Returns
        -------
        (n, k T) ndarray
            Block diagonal: the columns of a trial are zero at the samples of the others.
        """
        # the samples of one trial follow those of the previous one
        used_counts = np.array([rows.sum() for rows in self.rows])
        trial_ends = np.cumsum(used_counts)
        functions_by_trial = np.split(functions, trial_ends[:-1])
        # a block of its own for each trial
        return np.asarray(block_diag(*functions_by_trial))

    def prediction_features(self, *names: str) -> FloatArray:
        """Return functions of the prediction at the n used samples of all trials, side by side.

        The result has the shape (n, functions x width), where the width is the largest number of
        columns of one function (2 for a harmonic: cosine and sine). A function is zero in a trial
        that lacks it. The names, such as "x", are those of
        `discrepancy.location.map.dependence_functions`.
        """
        width = 1
        for features_of_trial in self._features:
            for name in features_of_trial.keys() & set(names):
                width = max(width, features_of_trial[name].shape[1])
        stacked_features = []
        for features_of_trial, rows in zip(self._features, self.rows, strict=True):
            zeros = np.zeros((int(rows.sum()), width))
            features = [features_of_trial.get(name, zeros) for name in names]
            stacked_features.append(np.hstack(features))
        return np.vstack(stacked_features)


def _static_bases(samples: _UsedSamples) -> dict[tuple[str, str], FloatArray]:
    """Return the functions (n, k) of time and of load that static readings may depend on.

    The basis of the time also has a constant, so that it does not matter when the time begins. The
    functions of the load are proportional to it (the prediction x and the load itself), or are not
    (|load| load and load^2).
    """
    bases: dict[tuple[str, str], FloatArray] = {}
    time = samples.stack_used_samples(lambda fitted: fitted.trial.time)
    if np.ptp(time) > 0.0:
        bases["", "time"] = np.column_stack([np.ones_like(time), time - time.mean()])
    load = samples.stack_used_samples(lambda fitted: fitted.trial.load)
    if np.ptp(load) > 0.0:
        x = samples.prediction_features("x").squeeze(axis=1)
        bases["", "load (proportional)"] = np.column_stack([x, load])
        not_proportional = [load, np.abs(load) * load, load**2]
        bases["", "load (not proportional)"] = np.column_stack(not_proportional)
    return bases


def _dynamic_bases(
    samples: _UsedSamples, modes: Sequence[float]
) -> dict[tuple[str, str], FloatArray]:
    """Return the functions (n, k) of each dependence of dynamic records, by subject and name.

    The dependences are a drift of the zero (Legendre polynomials of time), the predicted
    displacement x and speed v, and their harmonics. For each mode, its predicted motion is
    multiplied by hat functions of its amplitude or of time, in phase and a quarter of a period out
    of phase.
    """
    bases: dict[tuple[str, str], FloatArray] = {}
    relative_time = samples.stack_used_samples(
        lambda fitted_trial: np.linspace(-1.0, 1.0, len(fitted_trial.trial.time))
    )
    drift = np.asarray(np.polynomial.legendre.legvander(relative_time, 4), dtype=np.float64)
    bases["", "a drift of zero in each trial"] = samples.split_by_trial(drift)
    if all(fitted_trial.rates is not None for fitted_trial in samples.trials):
        bases["", "x and v"] = samples.prediction_features("x", "v")
        bases["", "higher harmonics"] = samples.prediction_features("2nd harmonic", "3rd harmonic")
    if not modes:
        return bases
    column = samples.column
    motions = [
        modal_motion(fitted_trial.prediction[:, [column]], fitted_trial.trial.interval, modes)
        for fitted_trial in samples.trials
    ]
    time = samples.stack_used_samples(lambda fitted_trial: fitted_trial.trial.time)
    by_time = _hat_functions(time, float(time.min()), float(time.max()))
    for mode in range(len(modes)):
        # complex: in phase and out of phase, (n, 1)
        motion = samples.stack_arrays([motion_of_trial[mode] for motion_of_trial in motions])
        amplitude = np.abs(motion[:, 0])
        if not amplitude.any():
            continue
        # equal ratios of amplitude, down to a thousandth of the largest one
        log_amplitude = np.log(np.clip(amplitude / amplitude.max(), 1e-3, None))
        by_amplitude = _hat_functions(log_amplitude, float(log_amplitude.min()), 0.0)
        for name, shapes in (("amplitude", by_amplitude), ("time", by_time)):
            in_and_out_of_phase = [shapes * motion.real, shapes * motion.imag]
            bases[f"mode {mode + 1}", name] = np.hstack(in_and_out_of_phase)
    return bases
