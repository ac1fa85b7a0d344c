"""Ring-down trials: two damped modes from each, averages, and their change with amplitude.

Kapteyn et al. 2021, eq. (22): the signal is a sum of two damped cosines; eqs. (23) and (24) turn damped
frequency and decay rate into natural frequency and damping ratio.

Of records that were read off a plot, the extremes tell more. The middle of the ink in a column of pixels is
not quite the average of the signal there, while its lowest and highest points are the signal's extremes
within the column, but for the width of the line. A fit to these two keeps more of a fast mode that dies away
within a few columns.
"""

import cmath
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import decimate, detrend, find_peaks

from calibration.errors import ExperimentDataError, said
from reporting.arrays import Float

from .damped_cosine import DampedCosines, RingDownMode
from .records import MINIMUM_COUNT, RingDownRecord

FIRST_PEAK = 0.00548
"""Instant of the first peak in the published records, at which the authors crop them [s]."""

WORKING_RATE = 2000.0
"""Rate to which faster records are decimated, as in the authors' script [Hz]."""

SEARCH_BAND = (2.0, 80.0)
"""Band in which the two spectral peaks are sought; drift lies below [Hz]."""

_PADDING = 64  # zero padding of the spectrum: bins of 1/64 of the record's own resolution
_PROMINENCE = 3.5  # of a spectral peak, over the median amplitude of the noise
# Smallest peak, of the highest amplitude: smaller ripples come from the end of a record that still rings
# there, and from the skirts of the first mode where it has died away.
_SMALLEST_PEAK = (0.003, 0.02)
_END_SHARE = 0.05  # of a record, in which its end is judged
_SEARCH_DECAY = 3.0  # 1/s, put upon a record in which the first search finds too little
_STARTING_RATIOS = (0.01, 0.03, 0.08)
_STEADY_SHARE = 0.7  # rms of the last third over the first; above it nothing decays


@dataclass(frozen=True, eq=False)
class RingDownFit:
    """Two modes of one record.

    Attributes
    ----------
    modes : (RingDownMode, RingDownMode)
        By ascending frequency.
    record : RingDownRecord
        The record as fitted: decimated and cropped.
    fitted : (N,) array
        The fitted signal [V].
    residual_deviation : float
        Standard deviation of the residuals [V].
    free : bool
        Whether the frequencies were fitted, too; else they are those of spectral peaks.
    """

    modes: tuple[RingDownMode, RingDownMode]
    record: RingDownRecord
    fitted: Float
    residual_deviation: float
    free: bool


Fits = tuple[RingDownFit, ...]
"""The trials of one wing."""


def prepare(record: RingDownRecord, start: float = FIRST_PEAK) -> RingDownRecord:
    """Decimate a fast record to about 2 kHz and crop it to begin after `start` [s].

    Decimation runs forwards and backwards through a low-pass in stages of at most 10, so that it shifts no
    phase. Drift is not taken out here but fitted along with the modes, which biases neither.

    Raises
    ------
    ExperimentDataError
        If the record is too short, or less than a quarter of it remains.
    """
    time, signal = record.time, record.signal
    lowest, highest = record.lowest, record.highest
    factor = int(record.sampling_rate / WORKING_RATE + 0.5)
    if factor > 1 and record.count // factor < MINIMUM_COUNT:
        length = record.time[-1] - record.time[0]
        raise ExperimentDataError(said("ringdown.short", record=record, length=length))
    while factor > 1:
        stage = min(factor, 10)
        time, signal = time[::stage], np.asarray(decimate(signal, stage, zero_phase=True))
        lowest = highest = None
        factor //= stage
    after = time > start
    if np.count_nonzero(after) < 0.25 * time.size:
        left = np.count_nonzero(after), time.size
        raise ExperimentDataError(said("ringdown.cropped", record=record, start=start, left=left))
    lowest, highest = (None if column is None else column[after] for column in (lowest, highest))
    return replace(record, time=time[after], signal=signal[after], lowest=lowest, highest=highest)


def spectrum(record: RingDownRecord) -> tuple[Float, Float]:
    """Return frequency [Hz] and amplitude [V] of the zero-padded spectrum of the detrended record."""
    size = _PADDING * record.count
    transform = np.fft.rfft(detrend(record.signal), size)
    frequency = np.fft.rfftfreq(size, 1.0 / record.sampling_rate)
    inside = (frequency >= SEARCH_BAND[0]) & (frequency <= min(SEARCH_BAND[1], 0.5 * record.sampling_rate))
    amplitude = np.asarray(2.0 / record.count * np.abs(transform[inside]), dtype=np.float64)
    return np.asarray(frequency[inside], dtype=np.float64), amplitude


def spectral_peaks(record: RingDownRecord) -> tuple[float, float]:
    """Return the two most prominent peaks of the spectrum, by ascending frequency [Hz].

    Raises
    ------
    ExperimentDataError
        If the record is sampled too slowly, or fewer than two peaks rise by 3.5 times the median noise
        and by 2 % of the highest amplitude (less, down to 0.3 %, if the record has died away at its end),
        in the record itself or in its beginning.
    """
    if 0.5 * record.sampling_rate < 4.0 * SEARCH_BAND[0]:
        highest = 0.5 * record.sampling_rate
        raise ExperimentDataError(said("ringdown.slow", record=record, highest=highest))
    found = _peaks(record, 0.0)
    if len(found) < 2:
        found = _peaks(record, _SEARCH_DECAY)
    if len(found) < 2:
        seen = "none" if not found else f"one, at {found[0]:.3g} Hz"
        top = min(SEARCH_BAND[1], 0.5 * record.sampling_rate)
        band = SEARCH_BAND[0], top
        raise ExperimentDataError(said("ringdown.peaks", record=record, band=band, seen=seen))
    first, second = sorted(found[:2])
    return first, second


def _peaks(record: RingDownRecord, decay: float) -> list[float]:
    """Return the peaks that count [Hz], the most prominent first, of a record times exp(-decay t).

    A second mode that is gone after a tenth of the record drowns in the noise of the rest and in the skirts
    of the first; the decay [1/s] takes both away and moves no frequency.
    """
    weight = np.exp(-decay * (record.time - record.time[0]))
    # The noise in a spectrum: a Hann window, of mean square 3/8, hides a mode that dies away at the start.
    window = np.hanning(record.count) / math.sqrt(0.375)
    noise = 2.0 / record.count * np.abs(np.fft.rfft(window * detrend(record.signal)))
    place = np.fft.rfftfreq(record.count, 1.0 / record.sampling_rate)
    floor = float(np.median(noise[(place >= SEARCH_BAND[0]) & (place <= SEARCH_BAND[1])]))
    floor *= math.sqrt(float(np.mean(weight**2)))
    faded = RingDownRecord(record.time, weight * detrend(record.signal), source=record.source)
    frequency, amplitude = spectrum(faded if decay else record)
    level = detrend(faded.signal)
    end = level[-max(int(_END_SHARE * record.count), 8) :]
    left = math.sqrt(2.0 * float(np.mean(end**2))) / float(np.abs(level).max())
    needed = max(_PROMINENCE * floor, float(np.clip(left, *_SMALLEST_PEAK)) * float(amplitude.max()))
    places, found = find_peaks(amplitude, prominence=needed)
    return [float(frequency[places[place]]) for place in np.argsort(found["prominences"])[::-1]]


def fit_ring_down(record: RingDownRecord, *, free: bool = False, start: float = FIRST_PEAK) -> RingDownFit:
    """Fit two damped cosines, an offset and a drift to one record by Levenberg-Marquardt.

    The authors hold the damped frequencies fixed at the two highest peaks of the spectrum. Decay rates (and
    damped frequencies, if they are free) are the unknowns of the iteration; the
    cosine and sine amplitudes, offset and drift are eliminated by linear least squares at each step. Where a
    record holds averages over intervals, the model is averaged over them too, exactly.

    Parameters
    ----------
    record : RingDownRecord
        One trial, as read.
    free : bool
        Whether the frequencies are fitted along with the rest.
    start : float
        Where the record is cropped [s].

    Raises
    ------
    ExperimentDataError
        If the record does not decay, or shows fewer than two modes.
    """
    record = prepare(record, start)
    signal, third = detrend(record.signal), record.count // 3
    first, last = (math.sqrt(float(np.mean(part**2))) for part in (signal[:third], signal[-third:]))
    if last > _STEADY_SHARE * first:
        raise ExperimentDataError(said("ringdown.steady", record=record, share=last / first))
    omega = 2.0 * math.pi * np.array(spectral_peaks(record))
    model = DampedCosines(record.time, record.signal, record.averaging_width)
    searches = [model.fit((1j - ratio) * omega, frequencies_fitted=free) for ratio in _STARTING_RATIOS]
    found = min(searches, key=lambda search: float(search.deviation[0]))
    low, high = sorted(found.modes, key=lambda mode: mode.pole.imag)
    refuse_growing((low, high), record.source)
    return RingDownFit((low, high), record, found.fitted[:, 0], float(found.deviation[0]), free)


def refuse_growing(modes: Iterable[RingDownMode], source: str) -> None:
    """Raise ExperimentDataError for what is no decaying oscillation."""
    for number, mode in enumerate(modes, start=1):
        if not 0.0 < -mode.pole.real < mode.pole.imag:
            where, fitted = (source, number), (mode.damped_frequency, -mode.pole.real)
            raise ExperimentDataError(said("ringdown.no_decay", where=where, fitted=fitted))


PUBLISHED_FREQUENCIES = (5.6492, 29.9699)
"""Natural frequencies found by the authors in the raw records, mean of five trials [Hz]."""

PUBLISHED_DAMPING_RATIOS = (0.0281, 0.0717)
"""Damping ratios found by the authors, mean of five trials [1]."""

ModalFigure = Literal["frequency", "damping_ratio"]
"""What a mode has."""


class Averaged(NamedTuple):
    """Mean over trials, standard deviation between them, and standard error of the mean."""

    mean: float
    standard_deviation: float
    standard_error: float


def average(trials: Fits, name: ModalFigure, mode: int) -> Averaged:
    """Return the natural frequency [Hz] or the damping ratio [1] of mode 0 or 1."""
    values = [float(getattr(fit.modes[mode], name)) for fit in trials]
    mean = float(np.mean(values))
    if len(values) == 1:
        return Averaged(mean, math.nan, trials[0].modes[mode].standard_error[name])
    deviation = float(np.std(values, ddof=1))
    return Averaged(mean, deviation, deviation / math.sqrt(len(values)))


def fit_trials(records: Sequence[RingDownRecord], *, free: bool = False, start: float = FIRST_PEAK) -> Fits:
    """Fit every record, see `fit_ring_down`.

    Raises
    ------
    ExperimentDataError
        If there is no record, or one does not show two decaying modes.
    """
    if not records:
        raise ExperimentDataError("there is no ring-down record; at least one is needed.")
    return tuple(fit_ring_down(record, free=free, start=start) for record in records)


WINDOW, STEP, FIRST = 0.8, 0.4, 0.4
"""Length of a window, shift between two, start of the first, when mode 2 has died away [s]."""


def amplitude_dependence(fit: RingDownFit) -> tuple[RingDownMode, ...]:
    """Fit the first mode alone within windows that slide over the record; amplitudes are those in the middle.

    A linear wing gives the same frequency and damping ratio in each. Windows in which the mode no longer
    stands above four times the residuals are left out.

    Parameters
    ----------
    fit : RingDownFit
        A fitted record; its first mode is the start of each window.
    """
    points = []
    record = fit.record
    for begin in np.arange(record.time[0] + FIRST, record.time[-1] - WINDOW, STEP).tolist():
        inside = (record.time >= begin) & (record.time < begin + WINDOW)
        model = DampedCosines(record.time[inside], record.signal[inside], record.averaging_width)
        solution = model.fit(np.array([fit.modes[0].pole]))
        (seen,) = solution.modes
        seen = seen._replace(wave=seen.wave * cmath.exp(seen.pole * 0.5 * WINDOW))
        if seen.amplitude > 4.0 * float(solution.deviation[0]):
            points.append(seen)
    return tuple(points)


_POINTS = 17  # instants within a column at which the model is evaluated


def refine_by_extremes(trials: Fits) -> Fits:
    """Fit amplitudes, phases and decay rates anew to the extremes; damped frequencies stay as found.

    Raises
    ------
    ExperimentDataError
        If a record has no extremes, or a mode no longer decays.
    """
    return tuple(map(_refine, trials))


def _refine(fit: RingDownFit) -> RingDownFit:
    record = fit.record
    if record.lowest is None or record.highest is None:
        raise ExperimentDataError(said("ringdown.envelope", record=record))
    lowest, highest = record.lowest, record.highest
    time = record.time - record.time[0]
    within = time[:, np.newaxis] + np.linspace(-0.5, 0.5, _POINTS) * record.averaging_width
    poles, waves = (np.array([getattr(mode, name) for mode in fit.modes]) for name in ("pole", "wave"))

    def signal(unknown: Float, when: Float) -> Float:
        """Return offset, drift and the decaying modes at some instants."""
        wave = np.exp(np.multiply.outer(when, unknown[4:6] + 1j * poles.imag)) @ (
            unknown[:2] + 1j * unknown[2:4]
        )
        return np.asarray(unknown[6] + unknown[7] * when + wave.real)

    def residual(scaled: Float) -> Float:
        unknown = scaled * scale
        value, half_line = signal(unknown, within), unknown[8]
        return np.hstack([value.min(axis=1) - half_line - lowest, value.max(axis=1) + half_line - highest])

    size = float(np.ptp(record.signal))
    half_line = 0.5 * float(np.percentile(highest - lowest, 10.0))
    scale = np.array([size, size, size, size, *np.abs(poles.real), size, size, size])
    first = np.array([*waves.real, *waves.imag, *poles.real, 0.0, 0.0, half_line]) / scale
    found = least_squares(residual, first, method="lm", xtol=1e-10, ftol=1e-12, diff_step=1e-6)
    unknown = found.x * scale
    # Both extremes of a column see the same signal: they count as one reading.
    variance = float(found.cost) / max(time.size - unknown.size, 1)
    covariance = 2.0 * variance * np.linalg.pinv(found.jac.T @ found.jac) * np.outer(scale, scale)
    first_mode, second_mode = (
        RingDownMode(
            complex(unknown[4 + at], pole.imag), complex(unknown[at], unknown[2 + at]),
            np.diag([covariance[4 + at, 4 + at], 0.0]),
        )
        for at, pole in enumerate(poles)
    )  # fmt: skip
    modes = first_mode, second_mode
    refuse_growing(modes, record.source)
    fitted, deviation = signal(unknown, time), math.sqrt(variance)
    return replace(fit, modes=modes, fitted=fitted, residual_deviation=deviation)
