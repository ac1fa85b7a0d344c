"""What single dependences explain of the excess variance: amplitude, time, load, temperature, harmonics.

Excess variance is the sum of squares in units of the noise less what noise alone would leave after the fit.
A motion of several modes is split into them by bands of its spectrum.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.linalg import block_diag

from calibration.dynamics.damped_cosine import DampedCosineFit, DampedCosines
from discrepancy.campaign.noise_tests import periodogram
from discrepancy.campaign.records import FloatArray
from discrepancy.errors import FitError, said
from discrepancy.location.map import Part, explained, features, part_of
from discrepancy.location.residuals import FittedTrial


def mode_bands(frequencies: Sequence[float]) -> list[tuple[float, float]]:
    """Return the band of each mode [Hz], lowest first.

    They end midway (geometrically) between neighbouring frequencies; the lowest begins at half the first, the
    highest ends at `sqrt(2)` times the last.
    """
    modes = np.asarray(frequencies, dtype=float)
    inner = np.sqrt(modes[1:] * modes[:-1]).tolist()
    return list(pairwise([0.5 * frequencies[0], *inner, 2.0**0.5 * frequencies[-1]]))


def modal_motion(values: FloatArray, interval: float, frequencies: Sequence[float]) -> NDArray[np.complex128]:
    """Return the part of each mode in a motion without noise, such as a prediction.

    Parameters
    ----------
    values : (N, C) ndarray
        The motion. Its mirror images are set before and after it, so that it has no ends.
    interval : float
        Sampling interval [s].
    frequencies : sequence of float
        [Hz], lowest first, apart by more than the resolution of the record.

    Returns
    -------
    (K, N, C) ndarray
        Analytic signals: displacement less i rate / angular frequency; the modulus is the amplitude.
    """
    count = len(values)
    spectrum = np.fft.fft(np.concatenate([values[:0:-1], values, values[-2::-1]]), axis=0)
    at = np.fft.fftfreq(len(spectrum), interval)[:, np.newaxis]
    bands = [2.0 * spectrum * ((at >= low) & (at < high)) for low, high in mode_bands(frequencies)]
    return np.asarray(np.fft.ifft(bands, axis=1)[:, count - 1 : 2 * count - 1])


def mode_shares(
    items: Sequence[FittedTrial], white: Sequence[FloatArray], frequencies: Sequence[float]
) -> FloatArray:
    """Return the share of the excess variance in the band of each mode, (M,), summing to at most one."""
    sums, whole = np.zeros(len(frequencies)), 0.0
    for item, values in zip(items, white, strict=True):
        surplus = sum(2.0 * (periodogram(series) - 1.0) for series in values.T)
        at = np.arange(1, np.size(surplus) + 1) / (len(values) * item.trial.interval)
        bands = [(at >= low) & (at < high) for low, high in mode_bands(frequencies)]
        whole += float(np.sum(surplus))
        sums += [float(np.sum(surplus, where=band)) for band in bands]
    return np.clip(sums / whole, 0.0, 1.0) if whole > 0.0 else sums


def predicted_frequencies(items: Sequence[FittedTrial]) -> tuple[float, ...]:
    """Return the frequencies [Hz] of the peaks of the predictions' spectra, lowest first, at most four.

    A peak is a largest ordinate within a factor 1.4 on both sides, above a thousandth of the greatest, of
    four periods or more in the record: below, a zero or a slow decay looks like one.
    """
    longest = max(items, key=lambda item: len(item.trial.time))
    power = np.zeros((len(longest.trial.time) - 1) // 2)
    for item in items:
        faster = item.trial.interval / longest.trial.interval
        if len(item.trial.time) != len(longest.trial.time) or abs(faster - 1.0) > 1e-6:
            continue
        values = item.prediction - item.prediction.mean(axis=0)
        taper = np.hanning(2 * len(values))[len(values) :, np.newaxis]  # the start of a ring-down counts
        table = np.abs(np.fft.rfft(values * taper, axis=0)) ** 2 / item.noise_deviation**2
        power += table[1 : power.size + 1].sum(axis=1)
    at = np.arange(1, power.size + 1) / (len(longest.trial.time) * longest.trial.interval)
    peaks = []
    for number in range(3, power.size - 1):
        near = (at > at[number] / 1.4) & (at < at[number] * 1.4)
        if power[number] >= power[near].max() and power[number] > 1e-3 * power.max():
            peaks.append((float(power[number]), float(at[number])))
    return tuple(sorted(frequency for _, frequency in sorted(peaks, reverse=True)[:4]))


_HATS = 9  # knots of a dependence on time or amplitude


class Dependence(NamedTuple):
    """What a dependence explains of the excess variance of trials of one kind.

    Attributes
    ----------
    subject : str
        "mode 1", ...; empty: whole channels.
    name : str
        What it goes with: "amplitude", "time", "load (not proportional)", ...
    share : float
        Of the excess variance.
    p_value : float
        Of the finding.
    coefficients : int
        Number fitted to tell it.
    """

    subject: str
    name: str
    share: float
    p_value: float
    coefficients: int


def excess(items: Sequence[FittedTrial]) -> float:
    """Return the excess variance of trials, in units of the noise variance."""
    return float(sum(np.nansum(i.standardised**2) - np.sum(i.expected_variance[i.used]) for i in items))


def _hats(values: FloatArray, low: float, high: float) -> FloatArray:
    """Return piecewise linear hat functions between `low` and `high`, (n, `_HATS`)."""
    if high <= low:
        return np.ones((values.size, 1))
    centres = np.linspace(low, high, _HATS)
    return np.column_stack([np.interp(values, centres, hat) for hat in np.eye(_HATS)])


def dependences(items: Sequence[FittedTrial]) -> Iterator[Dependence]:
    """Yield what single dependences explain of the excess variance of trials of one kind and its channels.

    Every dependence is fitted to each channel by itself with one set of coefficients for all trials, so that
    amplitude and time are told apart where releases differ; the strongest line has a phase of its own in each
    trial. Modes are split at the peaks of the predictions' spectra.
    """
    whole = excess(items)
    freedom = sum(float(np.sum(i.expected_variance[i.used])) for i in items)
    if freedom <= 0.0 or whole <= 2.0 * np.sqrt(2.0 * freedom):
        return  # no excess to explain
    parts: dict[tuple[str, str], list[Part]] = {}
    moves = items[0].trial.is_dynamic
    line, modes = (dominant_line(items), predicted_frequencies(items)) if moves else (None, ())
    for column in range(len(items[0].trial.channels)):
        used = [item for item in items if item.used[:, column].any()]
        bases = _bases(used, column, modes) if used else {}
        if used and line is not None:
            bases["", line.name] = line.waves(used, column)
        for key, basis in bases.items():
            part = part_of(basis, [(item, item.used[:, column]) for item in used], column)
            if part is not None:
                parts.setdefault(key, []).append(part)
    for (subject, name), own in parts.items():
        statistic, count = explained(own)
        share = float(np.clip((statistic - count) / whole, 0.0, 1.0))
        p = float(stats.chi2.sf(statistic, count)) if count else 1.0
        choices = line.choices if line is not None and name == line.name else 1
        yield Dependence(subject, name, share, min(1.0, p * choices), count)


class SpectralLine(NamedTuple):
    """The strongest line of residuals: frequency [Hz], decay rate [1/s], how many it was chosen from."""

    frequency: float
    decay: float
    choices: int

    @property
    def name(self) -> str:
        """Such as "a line at 50 Hz" or "a decaying line at 9.1 Hz"."""
        return f"a {'decaying ' if self.decay else ''}line at {self.frequency:.3g} Hz"

    def waves(self, items: Sequence[FittedTrial], column: int) -> FloatArray:
        """Return its cosine and sine in the used samples of each trial, (n, 2 T)."""
        times = [item.trial.time[item.used[:, column]] - item.trial.time[0] for item in items]
        waves = [np.exp((-self.decay + 2j * np.pi * self.frequency) * time) for time in times]
        return np.asarray(block_diag(*(np.column_stack([wave.real, wave.imag]) for wave in waves)))


def dominant_line(items: Sequence[FittedTrial]) -> SpectralLine | None:
    """Return the line that explains most of the residuals of dynamic trials, over all channels and trials.

    Frequencies are those of a spectrum padded four times, from one period of the record upwards; decays are
    none, and 1, 3, 10 and 30 e-folds within a record. None for records of fewer than eight samples.
    """
    best, choices = (0.0, 0.0, 0.0), 0
    length = max(len(item.trial.time) for item in items)
    interval = items[0].trial.interval
    if length < 8:
        return None
    alike = [item for item in items if abs(item.trial.interval / interval - 1.0) < 1e-6]
    at = np.fft.rfftfreq(4 * length, interval)
    for folds in (0.0, 1.0, 3.0, 10.0, 30.0):
        decay = folds / (length * interval)
        power = np.zeros(at.size)
        for item in alike:
            weight = np.exp(-decay * interval * np.arange(len(item.trial.time)))
            values = np.nan_to_num(item.standardised) * weight[:, np.newaxis]
            # A cosine and a sine under this weight have about half the weight's square each.
            found = np.abs(np.fft.rfft(values, 4 * length, axis=0)) ** 2
            power += 2.0 * found.sum(axis=1) / (weight @ weight)
        power[:4] = 0.0
        place = int(np.argmax(power))
        choices += length // 2
        # A decay must explain visibly more than the same line without it.
        if power[place] > 1.05 * best[0]:
            best = (float(power[place]), float(at[place]), decay)
    return SpectralLine(best[1], best[2], choices) if best[0] > 0.0 else None


def _bases(
    items: Sequence[FittedTrial], column: int, modes: Sequence[float]
) -> dict[tuple[str, str], FloatArray]:
    """Return the functions of each subject and dependence, stacked over trials, (n, k); modes in Hz."""
    named = [features(item, column) for item in items]
    rows = [item.used[:, column] for item in items]

    def stack(*names: str) -> FloatArray:
        width = max((table.shape[1] for f in named for name, table in f.items() if name in names), default=1)
        return np.vstack([
            np.hstack([f.get(name, np.zeros((int(use.sum()), width))) for name in names])
            for f, use in zip(named, rows, strict=True)
        ])  # fmt: skip

    def joined(parts: Sequence[FloatArray]) -> FloatArray:
        return np.concatenate([part[use] for part, use in zip(parts, rows, strict=True)])

    ones = [np.ones((int(use.sum()), 1)) for use in rows]
    bases = {("", "zero shift"): stack("mean"), ("", "zero shift of each trial"): block_diag(*ones)}
    temperature, within = (joined([getattr(i.trial, key) for i in items]) for key in ("temperature", "time"))
    if np.ptp(temperature) > 0.0:
        bases["", "temperature"] = np.column_stack([temperature, temperature * stack("x")[:, 0]])
    if not items[0].trial.is_dynamic:
        if np.ptp(within) > 0.0:
            bases["", "time"] = np.column_stack([np.ones_like(within), within - within.mean()])
        load = joined([item.trial.load for item in items])
        if np.ptp(load) > 0.0:
            bases["", "load (proportional)"] = np.column_stack([stack("x")[:, 0], load])
            bases["", "load (not proportional)"] = np.column_stack([load, np.abs(load) * load, load**2])
        return bases
    spans = [np.linspace(-1.0, 1.0, len(use))[use] for use in rows]
    bases["", "a drift of zero in each trial"] = block_diag(
        *(np.polynomial.legendre.legvander(span, 4) for span in spans)
    )
    if all(item.rates is not None for item in items):
        bases["", "x and v"] = stack("x", "v")
        bases["", "higher harmonics"] = stack("2nd harmonic", "3rd harmonic")
    parts = [modal_motion(i.prediction[:, [column]], i.trial.interval, modes) for i in items] if modes else []
    by_time = _hats(within, float(within.min()), float(within.max()))
    for mode in range(len(modes)):
        motion = joined([part[mode] for part in parts])
        amplitude = np.abs(motion[:, 0])
        if not amplitude.any():
            continue
        level = np.log(np.clip(amplitude / amplitude.max(), 1e-3, None))
        by_amplitude = _hats(level, float(level.min()), 0.0)
        for dependence, shape in (("amplitude", by_amplitude), ("time", by_time)):
            bases[f"mode {mode + 1}", dependence] = np.hstack([shape * motion.real, shape * motion.imag])
    return bases


# ---------------------------------------------------------------- backbones of ring-downs

SMALLEST_SIGNAL = 4.0
"""A mode counts in a window while its amplitude there is this many standard errors."""

_GREATEST_CHANGE = 0.3  # of a frequency from its start value
_FEWEST_PER_UNKNOWN = 2.0


@dataclass(frozen=True, eq=False)
class Backbone:
    """Frequency and damping ratio of one mode along a ring-down.

    Attributes
    ----------
    mode : int
        Counted from one, by start frequency.
    time : (W,) ndarray
        Centroid of the mode's energy in each window [s].
    amplitude, amplitude_error : (W,) ndarray
        At that time [signal's unit]; standard error.
    frequency, frequency_error : (W,) ndarray
        Natural frequency |s| / 2 pi with s = -decay + i omega_d [Hz].
    damping_ratio, damping_ratio_error : (W,) ndarray
        decay / |s| [1].
    """

    mode: int
    time: FloatArray
    amplitude: FloatArray
    amplitude_error: FloatArray
    frequency: FloatArray
    frequency_error: FloatArray
    damping_ratio: FloatArray
    damping_ratio_error: FloatArray


def backbones(
    time: FloatArray,
    signal: FloatArray,
    frequencies: Sequence[float],
    *,
    noise_deviation: float | None = None,
    averaging_width: float = 0.0,
    periods: float = 4.0,
) -> tuple[Backbone, ...]:
    """Return the backbone of each mode.

    Parameters
    ----------
    time, signal : (N,) ndarray
        The record, evenly spaced [s], [any unit].
    frequencies : sequence of float
        Start values of the frequencies of all modes that ring [Hz].
    noise_deviation : float, optional
        Standard deviation of the noise; without it that of each window's own residuals is taken, which also
        holds what the sinusoids do not describe.
    averaging_width : float
        Interval over which each value is an average [s]; 0 for samples.
    periods : float
        Length of a window in periods of the lowest frequency. Longer windows have smaller errors and smear
        what changes with amplitude: three periods of a quadratic damping with a ratio of 0.045 give 0.043.
        The next window repeats half of it.

    Raises
    ------
    FitError
        If the record is shorter than a window, or a window has too few samples.
    """
    interval = float(time[-1] - time[0]) / (time.size - 1)
    start = 2.0 * np.pi * np.sort(np.asarray(frequencies, dtype=float))
    width = round(periods * 2.0 * np.pi / (start[0] * interval)) + 1
    unknown = 4 * start.size + 2
    if width < _FEWEST_PER_UNKNOWN * unknown or width > time.size:
        ends = width, _FEWEST_PER_UNKNOWN * unknown, time.size
        raise FitError(said("campaign.window", periods=periods, ends=ends))
    active = np.ones(start.size, dtype=bool)
    pole = (1j - 0.02) * start
    rows: list[list[tuple[float, ...]]] = [[] for _ in start]
    for first in range(0, time.size - width + 1, max(1, round(0.5 * width))):
        part = slice(first, first + width)
        window = DampedCosines(time[part], signal[part], averaging_width)
        while active.any():
            solution = window.fit(pole[active])
            points = _points(time[part] - time[first], solution, noise_deviation)
            numbers = np.flatnonzero(active).tolist()
            pairs = list(zip(numbers, points, strict=True))
            lost = [number for number, point in pairs if not _credible(point, start[number])]
            if not lost:
                for number, point in pairs:
                    rows[number].append((float(time[first]) + point[0], *point[1:]))
                found = solution.pole
                pole[active] = np.minimum(found.real, -1e-4 * found.imag) + 1j * found.imag
                break
            # Fit again without the modes that have died away: they would spoil the errors of the others.
            active[lost] = False
        if not active.any():
            break
    return tuple(
        Backbone(number + 1, *np.array(points, dtype=float).reshape(-1, 7).T)
        for number, points in enumerate(rows)
    )


def _points(
    time: FloatArray, solution: DampedCosineFit, noise_deviation: float | None
) -> list[tuple[float, ...]]:
    """Return time, amplitude, frequency and damping ratio of each mode, each with its error but the time."""
    own = float(solution.deviation[0])
    deviation = own if noise_deviation is None else noise_deviation
    points: list[tuple[float, ...]] = []
    for mode in solution.modes:
        decay = -mode.pole.real
        weight = np.exp(-2.0 * np.clip(decay * (time - time[-1] / 2.0), -50.0, 50.0))
        centre = float(weight @ time / weight.sum())
        effective = float(weight.sum()) ** 2 / float(weight @ weight)
        points.append(
            (
                centre,
                mode.amplitude * float(np.exp(-np.clip(decay * centre, -50.0, 50.0))),
                deviation * sqrt(2.0 / effective),
                mode.frequency,
                mode.standard_error["frequency"] * deviation / own,
                mode.damping_ratio,
                mode.standard_error["damping_ratio"] * deviation / own,
            )
        )
    return points


def _credible(point: tuple[float, ...], start: float) -> bool:
    """Whether a mode is still there: above its error, near its start frequency, damping below critical."""
    _, amplitude, amplitude_error, frequency, _, ratio, _ = point
    near = abs(2.0 * np.pi * frequency / start - 1.0) < _GREATEST_CHANGE
    return amplitude > SMALLEST_SIGNAL * amplitude_error and near and abs(ratio) < 0.5
