"""What a discrepancy depends on: amplitude, time, load, temperature, harmonics.

Each dependence is fitted to the residuals, and explains a fraction of the excess variance: their
sum of squares, in units of the noise, less its expectation for noise alone. A motion of several
modes is split into them by bands of its spectrum.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.linalg import block_diag

from discrepancy.campaign.noise_tests import periodogram
from discrepancy.campaign.records import FloatArray
from discrepancy.location.map import NormalEquations, explained, features, normal_equations_of
from discrepancy.location.residuals import FittedTrial


def mode_bands(frequencies: Sequence[float]) -> list[tuple[float, float]]:
    """Return the band of each mode [Hz], lowest first.

    Bands end midway (geometrically) between neighbouring frequencies. The lowest begins at half the
    first frequency, the highest ends at `sqrt(2)` times the last.
    """
    modes = np.asarray(frequencies, dtype=float)
    inner_edges = np.sqrt(modes[1:] * modes[:-1]).tolist()
    edges = [0.5 * frequencies[0], *inner_edges, 2.0**0.5 * frequencies[-1]]
    return list(pairwise(edges))


def modal_motion(
    values: FloatArray, interval: float, frequencies: Sequence[float]
) -> NDArray[np.complex128]:
    """Return the component of each mode in a motion without noise, such as a prediction.

    Parameters
    ----------
    values : (N, C) ndarray
        The motion. Its mirror images are set before and after it, so that it has no ends.
    interval : float
        Sampling interval [s].
    frequencies : sequence of float
        Frequencies of the K modes [Hz], lowest first, apart by more than the resolution of the
        record.

    Returns
    -------
    (K, N, C) ndarray
        Analytic signals: displacement less i rate / angular frequency; the modulus is the
        amplitude.
    """
    count = len(values)
    mirrored = np.concatenate([values[:0:-1], values, values[-2::-1]])
    spectrum = np.fft.fft(mirrored, axis=0)
    ordinate_frequencies = np.fft.fftfreq(len(spectrum), interval)[:, np.newaxis]
    spectra_of_modes = []
    for low, high in mode_bands(frequencies):
        in_band = (ordinate_frequencies >= low) & (ordinate_frequencies < high)
        # positive frequencies alone, doubled: the analytic signal
        spectra_of_modes.append(2.0 * spectrum * in_band)
    return np.asarray(np.fft.ifft(spectra_of_modes, axis=1)[:, count - 1 : 2 * count - 1])


def mode_shares(
    trials: Sequence[FittedTrial], white: Sequence[FloatArray], frequencies: Sequence[float]
) -> FloatArray:
    """Return the fraction of the excess variance in the band of each mode, (M,).

    Parameters
    ----------
    trials : sequence of FittedTrial
        Dynamic trials.
    white : sequence of (N, C) ndarray
        Their white residuals.
    frequencies : sequence of float
        Frequencies of the M modes [Hz], lowest first.
    """
    excess_of_modes = np.zeros(len(frequencies))
    total_excess = 0.0
    for fitted, values in zip(trials, white, strict=True):
        # each ordinate stands for two terms of the sum of squares, and is one for noise
        surplus = sum(2.0 * (periodogram(series) - 1.0) for series in values.T)
        duration = len(values) * fitted.trial.interval
        ordinate_frequencies = np.arange(1, np.size(surplus) + 1) / duration
        total_excess += float(np.sum(surplus))
        for mode, (low, high) in enumerate(mode_bands(frequencies)):
            in_band = (ordinate_frequencies >= low) & (ordinate_frequencies < high)
            excess_of_modes[mode] += float(np.sum(surplus, where=in_band))
    if total_excess <= 0.0:
        return excess_of_modes
    return np.clip(excess_of_modes / total_excess, 0.0, 1.0)


def predicted_frequencies(trials: Sequence[FittedTrial]) -> tuple[float, ...]:
    """Return the frequencies [Hz] of the highest peaks of the predictions' spectra, at most four.

    They come lowest first. A peak is the largest ordinate within a factor of 1.4 on both sides,
    above a thousandth of the greatest, and makes at least four periods in the record: below that a
    zero or a slow decay looks like one.
    """
    longest = max(trials, key=lambda fitted: len(fitted.trial.time)).trial
    count = len(longest.time)
    power = np.zeros((count - 1) // 2)
    for fitted in trials:
        interval_ratio = fitted.trial.interval / longest.interval
        if len(fitted.trial.time) != count or abs(interval_ratio - 1.0) > 1e-6:
            continue
        values = fitted.prediction - fitted.prediction.mean(axis=0)
        # half a window, because the start of a ring-down counts most
        taper = np.hanning(2 * count)[count:, np.newaxis]
        spectra = np.abs(np.fft.rfft(values * taper, axis=0)) ** 2 / fitted.noise_deviation**2
        power += spectra[1 : power.size + 1].sum(axis=1)
    frequencies = np.arange(1, power.size + 1) / (count * longest.interval)
    peaks = []
    for index in range(3, power.size - 1):
        frequency = float(frequencies[index])
        is_near = (frequencies > frequency / 1.4) & (frequencies < frequency * 1.4)
        if power[index] >= power[is_near].max() and power[index] > 1e-3 * power.max():
            peaks.append((float(power[index]), frequency))
    highest = sorted(peaks, reverse=True)[:4]
    return tuple(sorted(frequency for _, frequency in highest))


_HATS = 9
"""Knots of a dependence on time or amplitude."""


class Dependence(NamedTuple):
    """What a dependence explains of the excess variance of trials of one kind.

    Attributes
    ----------
    subject : str
        "mode 1", ...; empty for whole channels.
    name : str
        What residuals depend on: "amplitude", "time", "load (not proportional)", ...
    share : float
        Fraction of the excess variance that it explains.
    p_value : float
        p-value if there is no such dependence.
    coefficients : int
        Number of fitted coefficients.
    """

    subject: str
    name: str
    share: float
    p_value: float
    coefficients: int


def excess(trials: Sequence[FittedTrial]) -> float:
    """Return the excess variance of trials, in units of the noise variance."""
    total = 0.0
    for fitted in trials:
        expected = np.sum(fitted.expected_variance[fitted.used])
        total = total + (np.nansum(fitted.standardised**2) - expected)
    return float(total)


def _hats(values: FloatArray, low: float, high: float) -> FloatArray:
    """Return piecewise linear hat functions (n, `_HATS`) of values (n,) between two ends."""
    if high <= low:
        return np.ones((values.size, 1))
    knots = np.linspace(low, high, _HATS)
    return np.column_stack([np.interp(values, knots, hat) for hat in np.eye(_HATS)])


def dependences(trials: Sequence[FittedTrial]) -> Iterator[Dependence]:
    """Yield what single dependences explain of the excess variance of trials.

    Every dependence is fitted to each channel by itself, with one set of coefficients for all
    trials, so that amplitude and time can be distinguished if releases differ. The strongest line
    has a phase of its own in each trial. Modes are split at the peaks of the predictions' spectra.

    Parameters
    ----------
    trials : sequence of FittedTrial
        Trials of one kind with the same channels.
    """
    excess_variance = excess(trials)
    freedom = sum(float(np.sum(fitted.expected_variance[fitted.used])) for fitted in trials)
    if freedom <= 0.0 or excess_variance <= 2.0 * np.sqrt(2.0 * freedom):
        return  # there is no excess to explain
    line = None
    modes: tuple[float, ...] = ()
    if trials[0].trial.is_dynamic:
        line = dominant_line(trials)
        modes = predicted_frequencies(trials)
    equations: dict[tuple[str, str], list[NormalEquations]] = {}
    for column in range(len(trials[0].trial.channels)):
        with_channel = [fitted for fitted in trials if fitted.used[:, column].any()]
        if not with_channel:
            continue
        bases = dependence_bases(with_channel, column, modes)
        if line is not None:
            bases["", line.name] = line.waves(with_channel, column)
        rows = [(fitted, fitted.used[:, column]) for fitted in with_channel]
        for key, basis in bases.items():
            of_channel = normal_equations_of(basis, rows, column)
            if of_channel is not None:
                equations.setdefault(key, []).append(of_channel)
    for (subject, name), of_channels in equations.items():
        statistic, count = explained(of_channels)
        share = float(np.clip((statistic - count) / excess_variance, 0.0, 1.0))
        p_value = float(stats.chi2.sf(statistic, count)) if count else 1.0
        # the line was chosen among many
        choices = line.choices if line is not None and name == line.name else 1
        yield Dependence(subject, name, share, min(1.0, p_value * choices), count)


class SpectralLine(NamedTuple):
    """The strongest line in the spectra of residuals.

    Attributes
    ----------
    frequency : float
        Frequency [Hz].
    decay : float
        Decay rate [1/s].
    choices : int
        Number of lines from which it was chosen.
    """

    frequency: float
    decay: float
    choices: int

    @property
    def name(self) -> str:
        """Name such as "a line at 50 Hz" or "a decaying line at 9.1 Hz"."""
        return f"a {'decaying ' if self.decay else ''}line at {self.frequency:.3g} Hz"

    def waves(self, trials: Sequence[FittedTrial], column: int) -> FloatArray:
        """Return its cosine and sine (n, 2 T) at the used samples of a channel in T trials."""
        waves_of_trials = []
        for fitted in trials:
            times = fitted.trial.time[fitted.used[:, column]] - fitted.trial.time[0]
            wave = np.exp((-self.decay + 2j * np.pi * self.frequency) * times)
            waves_of_trials.append(np.column_stack([wave.real, wave.imag]))
        return np.asarray(block_diag(*waves_of_trials))


def dominant_line(trials: Sequence[FittedTrial]) -> SpectralLine | None:
    """Return the line that explains most of the residuals of dynamic trials, over all channels.

    Frequencies are those of a spectrum padded four times, from one period of the record upwards.
    Decays are none, and 1, 3, 10 and 30 e-folds within a record. None for records of fewer than
    eight samples.
    """
    length = max(len(fitted.trial.time) for fitted in trials)
    interval = trials[0].trial.interval
    if length < 8:
        return None
    evenly_sampled = [
        fitted for fitted in trials if abs(fitted.trial.interval / interval - 1.0) < 1e-6
    ]
    frequencies = np.fft.rfftfreq(4 * length, interval)
    strongest: SpectralLine | None = None
    greatest_power = 0.0
    choices = 0
    for folds in (0.0, 1.0, 3.0, 10.0, 30.0):
        decay = folds / (length * interval)
        power = np.zeros(frequencies.size)
        for fitted in evenly_sampled:
            weight = np.exp(-decay * interval * np.arange(len(fitted.trial.time)))
            weighted = np.nan_to_num(fitted.standardised) * weight[:, np.newaxis]
            spectra = np.abs(np.fft.rfft(weighted, 4 * length, axis=0)) ** 2
            # a cosine and a sine under this weight have about half the square of the weight each
            power += 2.0 * spectra.sum(axis=1) / (weight @ weight)
        power[:4] = 0.0
        index = int(np.argmax(power))
        choices += length // 2
        # a decay must explain visibly more than the same line without it
        if power[index] > 1.05 * greatest_power:
            greatest_power = float(power[index])
            strongest = SpectralLine(float(frequencies[index]), decay, choices)
    return None if strongest is None else strongest._replace(choices=choices)


def dependence_bases(
    trials: Sequence[FittedTrial], column: int, modes: Sequence[float]
) -> dict[tuple[str, str], FloatArray]:
    """Return the functions (n, k) of each dependence at the n used samples of a channel.

    Parameters
    ----------
    trials : sequence of FittedTrial
        Trials of one kind in which the channel is used.
    column : int
        Column of the channel.
    modes : sequence of float
        Frequencies of the modes [Hz].

    Returns
    -------
    dict of (str, str) to (n, k) ndarray
        Functions by subject and name of the dependence.
    """
    samples = _UsedSamples(trials, column)
    bases = {
        ("", "zero shift"): samples.features("mean"),
        ("", "zero shift of each trial"): samples.per_trial(np.ones((samples.count, 1))),
    }
    temperature = samples.of_trials(lambda fitted: fitted.trial.temperature)
    if np.ptp(temperature) > 0.0:
        proportional = temperature * samples.features("x")[:, 0]
        bases["", "temperature"] = np.column_stack([temperature, proportional])
    if trials[0].trial.is_dynamic:
        return bases | _bases_in_time(samples, modes)
    return bases | _bases_at_rest(samples)


class _UsedSamples:
    """The used samples of a channel in several trials, one trial after the other.

    Parameters
    ----------
    trials : sequence of FittedTrial
        The trials.
    column : int
        Column of the channel.
    """

    def __init__(self, trials: Sequence[FittedTrial], column: int) -> None:
        self.trials = trials
        self.column = column
        self.rows = [fitted.used[:, column] for fitted in trials]
        self.count = sum(int(rows.sum()) for rows in self.rows)
        self._features = [features(fitted, column) for fitted in trials]

    def of_trials(self, values: Callable[[FittedTrial], FloatArray]) -> FloatArray:
        """Return an array (N, ...) of each trial at its used samples, stacked (n, ...)."""
        return self.stacked([values(fitted) for fitted in self.trials])

    def stacked(self, arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Return arrays (N, ...) of the trials at the used samples, stacked (n, ...)."""
        used = [array[rows] for array, rows in zip(arrays, self.rows, strict=True)]
        return np.concatenate(used)

    def per_trial(self, functions: FloatArray) -> FloatArray:
        """Return functions (n, k) with coefficients of their own in each of T trials, (n, k T)."""
        ends = np.cumsum([int(rows.sum()) for rows in self.rows])
        return np.asarray(block_diag(*np.split(functions, ends[:-1])))

    def features(self, *names: str) -> FloatArray:
        """Return features of the prediction by name, (n, k); zeros in a trial that lacks one."""
        widths = [
            table.shape[1]
            for tables in self._features
            for name, table in tables.items()
            if name in names
        ]
        width = max(widths, default=1)
        stacked = []
        for tables, rows in zip(self._features, self.rows, strict=True):
            zeros = np.zeros((int(rows.sum()), width))
            stacked.append(np.hstack([tables.get(name, zeros) for name in names]))
        return np.vstack(stacked)


def _bases_at_rest(samples: _UsedSamples) -> dict[tuple[str, str], FloatArray]:
    """Return the dependences of readings at rest: on time and load."""
    bases: dict[tuple[str, str], FloatArray] = {}
    time = samples.of_trials(lambda fitted: fitted.trial.time)
    if np.ptp(time) > 0.0:
        bases["", "time"] = np.column_stack([np.ones_like(time), time - time.mean()])
    load = samples.of_trials(lambda fitted: fitted.trial.load)
    if np.ptp(load) > 0.0:
        x = samples.features("x")[:, 0]
        bases["", "load (proportional)"] = np.column_stack([x, load])
        not_proportional = [load, np.abs(load) * load, load**2]
        bases["", "load (not proportional)"] = np.column_stack(not_proportional)
    return bases


def _bases_in_time(
    samples: _UsedSamples, modes: Sequence[float]
) -> dict[tuple[str, str], FloatArray]:
    """Return the dependences of records in time: on drift, motion, harmonics and modes."""
    bases: dict[tuple[str, str], FloatArray] = {}
    relative_time = samples.of_trials(lambda fitted: np.linspace(-1.0, 1.0, len(fitted.trial.time)))
    drift = np.asarray(np.polynomial.legendre.legvander(relative_time, 4), dtype=np.float64)
    bases["", "a drift of zero in each trial"] = samples.per_trial(drift)
    if all(fitted.rates is not None for fitted in samples.trials):
        bases["", "x and v"] = samples.features("x", "v")
        bases["", "higher harmonics"] = samples.features("2nd harmonic", "3rd harmonic")
    if not modes:
        return bases
    column = samples.column
    motions = [
        modal_motion(fitted.prediction[:, [column]], fitted.trial.interval, modes)
        for fitted in samples.trials
    ]
    time = samples.of_trials(lambda fitted: fitted.trial.time)
    by_time = _hats(time, float(time.min()), float(time.max()))
    for mode in range(len(modes)):
        motion = samples.stacked([motion_of_trial[mode] for motion_of_trial in motions])
        amplitude = np.abs(motion[:, 0])
        if not amplitude.any():
            continue
        level = np.log(np.clip(amplitude / amplitude.max(), 1e-3, None))
        by_amplitude = _hats(level, float(level.min()), 0.0)
        for name, shapes in (("amplitude", by_amplitude), ("time", by_time)):
            in_and_out_of_phase = [shapes * motion.real, shapes * motion.imag]
            bases[f"mode {mode + 1}", name] = np.hstack(in_and_out_of_phase)
    return bases
