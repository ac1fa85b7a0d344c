"""Ring-down trials: two damped modes of each, their averages, and their change with amplitude.

Kapteyn et al. 2021, eq. (22): the signal is a sum of two damped cosines; eqs. (23) and (24) convert
damped frequency and decay rate to natural frequency and damping ratio.
"""

import cmath
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.signal import decimate, detrend, find_peaks

from calibration.errors import ExperimentDataError
from reporting.arrays import Float

from .damped_cosine import DampedCosines, RingDownMode
from .records import MINIMUM_COUNT, RingDownRecord

FIRST_PEAK = 0.00548
"""Time of the first peak in the published records, where the authors crop them [s]."""

WORKING_RATE = 2000.0
"""Rate to which faster records are decimated, as in the authors' script [Hz]."""

SEARCH_BAND = (2.0, 80.0)
"""Band in which the two spectral peaks are sought; drift lies below [Hz]."""

_PADDING = 64  # zero padding of the spectrum: bins of 1/64 of the record's own resolution
_PROMINENCE = 3.5  # of a spectral peak, over the median amplitude of the noise
# Smallest peak, over the highest amplitude: smaller ripples come from the end of a record that
# still rings there, and from the skirts of the first mode where it has died away.
_SMALLEST_PEAK = (0.003, 0.02)
_END_FRACTION = 0.05  # of a record, which counts as its end
_LONGEST_DECIMATION = 10  # factor of one stage
_SEARCH_DECAY = 3.0  # 1/s, applied to a record in which the first search finds too few peaks
_STARTING_RATIOS = (0.01, 0.03, 0.08)
_STEADY_RATIO = 0.7  # rms of the last third over the first; above it nothing decays


@dataclass(frozen=True, eq=False)
class RingDownFit:
    """Two modes fitted to one record.

    Attributes
    ----------
    modes : (RingDownMode, RingDownMode)
        The modes by ascending frequency.
    record : RingDownRecord
        The record as fitted: decimated and cropped.
    fitted : (N,) array
        The fitted signal [V].
    residual_deviation : float
        The standard deviation of the residuals [V].
    frequencies_fitted : bool
        Whether the frequencies were fitted; otherwise they are those of spectral peaks.
    """

    modes: tuple[RingDownMode, RingDownMode]
    record: RingDownRecord
    fitted: Float
    residual_deviation: float
    frequencies_fitted: bool


Fits = tuple[RingDownFit, ...]
"""The fitted trials of one wing."""


def prepare(record: RingDownRecord, start: float = FIRST_PEAK) -> RingDownRecord:
    """Decimate a record to about 2 kHz and crop it.

    Decimation runs forwards and backwards through a low-pass filter, so that it does not shift the
    phase. Drift is not removed here but fitted together with the modes, which biases neither.

    Parameters
    ----------
    start : float
        The record begins after this time [s].

    Raises
    ------
    ExperimentDataError
        If the record is too short, or less than a quarter of it remains.
    """
    decimated = _decimated(record)
    is_after_start = decimated.time > start
    remaining = np.count_nonzero(is_after_start)
    if remaining < 0.25 * decimated.time.size:
        raise ExperimentDataError(
            f"{record.source}: cropped at {start:g} s, {remaining} of {decimated.time.size} "
            "samples remain; give the instant of release."
        )
    lowest = decimated.lowest
    highest = decimated.highest
    return replace(
        record,
        time=decimated.time[is_after_start],
        signal=decimated.signal[is_after_start],
        lowest=None if lowest is None else lowest[is_after_start],
        highest=None if highest is None else highest[is_after_start],
    )


class _Samples(NamedTuple):
    """The samples of a record, see `RingDownRecord`."""

    time: Float
    signal: Float
    lowest: Float | None
    highest: Float | None


def _decimated(record: RingDownRecord) -> _Samples:
    """Reduce the sampling rate of a record to about `WORKING_RATE`.

    Decimated samples have no lowest and highest values of their interval any more.
    """
    factor = int(record.sampling_rate / WORKING_RATE + 0.5)
    if factor <= 1:
        return _Samples(record.time, record.signal, record.lowest, record.highest)
    if record.count // factor < MINIMUM_COUNT:
        duration = record.time[-1] - record.time[0]
        raise ExperimentDataError(
            f"{record.source}: {record.count} samples at {record.sampling_rate:.4g} Hz last "
            f"{duration:.3g} s, too short for a ring-down; is the time in s?"
        )
    time = record.time
    signal = record.signal
    while factor > 1:
        stage = min(factor, _LONGEST_DECIMATION)
        time = time[::stage]
        signal = np.asarray(decimate(signal, stage, zero_phase=True))
        factor //= stage
    return _Samples(time, signal, None, None)


def spectrum(record: RingDownRecord) -> tuple[Float, Float]:
    """Return the zero-padded spectrum of the detrended record in the search band.

    Returns
    -------
    frequency : (F,) array
        The frequencies [Hz].
    amplitude : (F,) array
        The amplitudes [V].
    """
    size = _PADDING * record.count
    transform = np.fft.rfft(detrend(record.signal), size)
    frequency = np.fft.rfftfreq(size, 1.0 / record.sampling_rate)
    lowest, highest = _visible_band(record)
    is_inside = (frequency >= lowest) & (frequency <= highest)
    amplitude = 2.0 / record.count * np.abs(transform[is_inside])
    return (
        np.asarray(frequency[is_inside], dtype=np.float64),
        np.asarray(amplitude, dtype=np.float64),
    )


def _visible_band(record: RingDownRecord) -> tuple[float, float]:
    """Return the search band, cut off at half the sampling rate [Hz]."""
    return SEARCH_BAND[0], min(SEARCH_BAND[1], 0.5 * record.sampling_rate)


def spectral_peaks(record: RingDownRecord) -> tuple[float, float]:
    """Return the two most prominent peaks of the spectrum, in ascending order [Hz].

    Raises
    ------
    ExperimentDataError
        If the record is sampled too slowly, or if it has fewer than two peaks, even after a factor
        that emphasises its beginning. A peak must rise by 3.5 times the median noise, and by 2 % of
        the highest amplitude, or less (down to 0.3 %) if the record has died away at its end.
    """
    highest = 0.5 * record.sampling_rate
    if highest < 4.0 * SEARCH_BAND[0]:
        raise ExperimentDataError(
            f"{record.source}: a sampling rate of {record.sampling_rate:.3g} Hz shows nothing "
            f"above {highest:.3g} Hz; is the time in s?"
        )
    peaks = _prominent_peaks(record, 0.0)
    if len(peaks) < 2:
        peaks = _prominent_peaks(record, _SEARCH_DECAY)
    if len(peaks) < 2:
        band = _visible_band(record)
        peak_text = f"one, at {peaks[0]:.3g} Hz" if peaks else "none"
        raise ExperimentDataError(
            f"{record.source}: two spectral peaks are needed between {band[0]:.3g} and "
            f"{band[1]:.3g} Hz, but there is {peak_text}; "
            "check the record, its sampling and the release."
        )
    lower_frequency, higher_frequency = sorted(peaks[:2])
    return lower_frequency, higher_frequency


def _prominent_peaks(record: RingDownRecord, decay: float) -> list[float]:
    """Return the frequencies of significant peaks [Hz], the most prominent first.

    The record is multiplied by exp(-decay t). Without this factor, a second mode that dies away
    after a tenth of the record would be lost in the noise of the remaining record, and in the
    spectrum of the first mode beside its peak. The factor shifts no frequency.
    """
    time_from_start = record.time - record.time[0]
    decay_factor = np.exp(-decay * time_from_start)
    decayed_signal = decay_factor * detrend(record.signal)
    decayed = RingDownRecord(record.time, decayed_signal, source=record.source)
    frequency, amplitude = spectrum(decayed if decay else record)
    root_mean_square_factor = math.sqrt(float(np.mean(decay_factor**2)))
    noise = _noise_amplitude(record) * root_mean_square_factor

    # Smallest significant peak, which grows with the signal that remains at the end of the record
    signal = detrend(decayed.signal)
    end_length = max(int(_END_FRACTION * record.count), 8)
    end = signal[-end_length:]
    end_amplitude = math.sqrt(2.0 * float(np.mean(end**2)))
    relative_end_amplitude = end_amplitude / float(np.abs(signal).max())
    smallest_peak = float(np.clip(relative_end_amplitude, *_SMALLEST_PEAK))
    prominence = max(_PROMINENCE * noise, smallest_peak * float(amplitude.max()))

    peaks, properties = find_peaks(amplitude, prominence=prominence)
    most_prominent_first = np.argsort(properties["prominences"])[::-1]
    return [float(frequency[peak]) for peak in peaks[most_prominent_first]]


def _noise_amplitude(record: RingDownRecord) -> float:
    """Return the median amplitude of the noise in the spectrum of a record [V]."""
    # A Hann window, of mean square 3/8, hides a mode that dies away at the start.
    window = np.hanning(record.count) / math.sqrt(0.375)
    transform = np.fft.rfft(window * detrend(record.signal))
    amplitude = 2.0 / record.count * np.abs(transform)
    frequency = np.fft.rfftfreq(record.count, 1.0 / record.sampling_rate)
    low, high = SEARCH_BAND
    is_in_band = (frequency >= low) & (frequency <= high)
    return float(np.median(amplitude[is_in_band]))


def fit_ring_down(
    record: RingDownRecord, *, frequencies_fitted: bool = False, start: float = FIRST_PEAK
) -> RingDownFit:
    """Fit two damped cosines, an offset and a drift to one record.

    The authors hold the damped frequencies fixed at the two highest peaks of the spectrum. The
    Levenberg-Marquardt iteration finds the decay rates, and the damped frequencies if they are
    fitted, too. Cosine and sine amplitudes, offset and drift are eliminated by linear least squares
    at each step. If the values of a record are averages over intervals, the model is averaged over
    the same intervals, exactly.

    Parameters
    ----------
    record : RingDownRecord
        One trial, as read.
    frequencies_fitted : bool
        Whether the frequencies are fitted, too.
    start : float
        The time at which the record is cropped [s].

    Raises
    ------
    ExperimentDataError
        If the record does not decay, or shows fewer than two modes.
    """
    record = prepare(record, start)
    _refuse_steady(record)
    omega = 2.0 * math.pi * np.array(spectral_peaks(record))
    model = DampedCosines(record.time, record.signal, record.averaging_width)
    candidates = []
    for ratio in _STARTING_RATIOS:
        candidates.append(model.fit((1j - ratio) * omega, frequencies_fitted=frequencies_fitted))
    best_fit = min(candidates, key=lambda candidate: float(candidate.deviation[0]))
    low, high = sorted(best_fit.modes, key=lambda mode: mode.pole.imag)
    refuse_growing((low, high), record.source)
    return RingDownFit(
        modes=(low, high),
        record=record,
        fitted=best_fit.fitted[:, 0],
        residual_deviation=float(best_fit.deviation[0]),
        frequencies_fitted=frequencies_fitted,
    )


def _refuse_steady(record: RingDownRecord) -> None:
    """Raise `ExperimentDataError` if the signal does not decay."""
    signal = detrend(record.signal)
    third = record.count // 3
    first_rms = math.sqrt(float(np.mean(signal[:third] ** 2)))
    last_rms = math.sqrt(float(np.mean(signal[-third:] ** 2)))
    if last_rms > _STEADY_RATIO * first_rms:
        raise ExperimentDataError(
            f"{record.source}: the signal does not decay (its last third has "
            f"{last_rms / first_rms:.2g} times the rms of its first); a record of free vibration "
            "from the release on is needed."
        )


def refuse_growing(modes: Iterable[RingDownMode], source: str) -> None:
    """Raise `ExperimentDataError` if a mode does not decay, or decays faster than it oscillates.

    `source` is the name of the record, which begins the message.
    """
    for number, mode in enumerate(modes, start=1):
        decay_rate = -mode.pole.real
        if not 0.0 < decay_rate < mode.pole.imag:
            raise ExperimentDataError(
                f"{source}: mode {number} at {mode.damped_frequency:.3g} Hz is not a decaying "
                f"oscillation (fitted rate {decay_rate:.3g} 1/s); a ring-down record is needed."
            )


PUBLISHED_FREQUENCIES = (5.6492, 29.9699)
"""Natural frequencies found by the authors in the raw records, mean of five trials [Hz]."""

PUBLISHED_DAMPING_RATIOS = (0.0281, 0.0717)
"""Damping ratios found by the authors, mean of five trials [1]."""

ModalQuantity = Literal["frequency", "damping_ratio"]
"""A quantity of a mode."""


class Averaged(NamedTuple):
    """Mean over trials, standard deviation between them, and standard error of the mean."""

    mean: float
    standard_deviation: float
    standard_error: float


def average(trials: Fits, name: ModalQuantity, mode: int) -> Averaged:
    """Return the mean of a modal quantity over trials, with its scatter and standard error.

    A single trial has no scatter (NaN), and the standard error of its fit.

    Parameters
    ----------
    name : {"frequency", "damping_ratio"}
        The natural frequency [Hz] or the damping ratio [1].
    mode : {0, 1}
        The index of the mode.
    """
    values = [float(getattr(fit.modes[mode], name)) for fit in trials]
    mean = float(np.mean(values))
    if len(values) == 1:
        return Averaged(mean, math.nan, trials[0].modes[mode].standard_error[name])
    deviation = float(np.std(values, ddof=1))
    return Averaged(mean, deviation, deviation / math.sqrt(len(values)))


def fit_trials(
    records: Sequence[RingDownRecord],
    *,
    frequencies_fitted: bool = False,
    start: float = FIRST_PEAK,
) -> Fits:
    """Fit all records; the arguments are those of `fit_ring_down`.

    Raises
    ------
    ExperimentDataError
        If there is no record, or one does not show two decaying modes.
    """
    if not records:
        raise ExperimentDataError("there is no ring-down record; at least one is needed.")
    return tuple(
        fit_ring_down(record, frequencies_fitted=frequencies_fitted, start=start)
        for record in records
    )


WINDOW = 0.8
"""Length of a window [s]."""
STEP = 0.4
"""Shift between the starts of two windows [s]."""
FIRST = 0.4
"""Start of the first window, when mode 2 has died away [s]."""

_VISIBLE_AMPLITUDE = 4.0  # of the first mode in a window, over the residuals


def amplitude_dependence(fit: RingDownFit) -> tuple[RingDownMode, ...]:
    """Fit the first mode in windows that slide over the record.

    A linear wing has the same frequency and damping ratio in each window, and so at each amplitude.
    Amplitudes are those in the middle of the windows. Windows in which the mode does not exceed
    `_VISIBLE_AMPLITUDE` times the residuals are left out.
    """
    record = fit.record
    first_start = record.time[0] + FIRST
    last_start = record.time[-1] - WINDOW
    modes = []
    for start in np.arange(first_start, last_start, STEP).tolist():
        is_inside = (record.time >= start) & (record.time < start + WINDOW)
        model = DampedCosines(
            record.time[is_inside], record.signal[is_inside], record.averaging_width
        )
        window_fit = model.fit(np.array([fit.modes[0].pole]))
        (mode,) = window_fit.modes
        # the complex amplitude at the middle of the window in place of that at its start
        to_middle = cmath.exp(mode.pole * 0.5 * WINDOW)
        mode = mode._replace(wave=mode.wave * to_middle)
        if mode.amplitude > _VISIBLE_AMPLITUDE * float(window_fit.deviation[0]):
            modes.append(mode)
    return tuple(modes)
