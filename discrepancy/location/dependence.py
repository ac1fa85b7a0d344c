"""What single dependences explain of the excess variance: amplitude, time, load, temperature, harmonics.

Excess variance is the sum of squares in units of the noise less what noise alone would leave after the fit.
A smooth motion of several modes is split into them by local least squares, ends of the record included.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import stats
from scipy.linalg import block_diag

from discrepancy.campaign.noise_tests import periodogram
from discrepancy.campaign.records import FloatArray

from .map import Part, explained, features, part_of
from .residuals import FittedTrial, ResidualSet

_PERIODS = 2.0  # of the lowest frequency, or of the closest difference, in a window


class MotionByMode(NamedTuple):
    """Motion of each mode: values, rates / angular frequency and amplitudes, (K, N, C) in the unit given."""

    displacement: FloatArray
    velocity: FloatArray
    amplitude: FloatArray


def modal_motion(values: FloatArray, interval: float, frequencies: Sequence[float]) -> MotionByMode | None:
    """Return the part of each mode in a motion.

    In a window of two periods about each sample (at the ends: the first or last whole window) the motion is a
    constant and, for each mode, (a + b t) cos w t + (c + d t) sin w t, fitted by least squares.

    Parameters
    ----------
    values : (N, C) ndarray
        Motion without noise, such as a prediction.
    interval : float
        Sampling interval [s].
    frequencies : sequence of float
        [Hz], about right within a few per cent, below half the sampling rate.

    Returns
    -------
    MotionByMode or None
        None if the record is shorter than a window, or a window cannot tell the frequencies apart.
    """
    if not frequencies:
        return None
    omega = 2.0 * np.pi * np.sort(np.asarray(frequencies, dtype=float))
    apart = min([float(omega[0]), *np.diff(omega).tolist()])
    if omega[-1] * interval >= np.pi or apart <= 0.02 * omega[-1]:
        return None
    count = len(values)
    unknown = 4 * omega.size + 1
    width = max(round(_PERIODS * 2.0 * np.pi / (apart * interval)), 2 * unknown) | 1
    if width > count:
        return None
    tau = interval * (np.arange(width) - width // 2)
    basis = np.linalg.pinv(_columns(tau, omega, tau[-1]))
    windows = np.lib.stride_tricks.sliding_window_view(values, width, axis=0)  # (n - W + 1, C, W)
    coefficient = windows @ basis.T  # (n - W + 1, C, unknown)
    place = np.clip(np.arange(count) - width // 2, 0, count - width)
    late = interval * (np.arange(count) - width // 2 - place)
    local = coefficient[place]
    cosine, sine = np.cos(omega * late[:, np.newaxis]), np.sin(omega * late[:, np.newaxis])
    stretch = (late / tau[-1])[:, np.newaxis]
    parts = []
    for mode in range(omega.size):
        a, b, c, d = (local[:, :, 4 * mode + n] for n in range(4))
        in_phase, quadrature = a + b * stretch, c + d * stretch
        co, si = cosine[:, [mode]], sine[:, [mode]]
        parts.append((in_phase * co + quadrature * si, -in_phase * si + quadrature * co,
                      np.hypot(in_phase, quadrature)))  # fmt: skip
    displacement, velocity, amplitude = (np.stack(rows) for rows in zip(*parts, strict=True))
    return MotionByMode(displacement, velocity, amplitude)


def _columns(tau: FloatArray, omega: FloatArray, scale: float) -> FloatArray:
    columns = []
    for w in omega:
        cosine, sine = np.cos(w * tau), np.sin(w * tau)
        columns += [cosine, tau / scale * cosine, sine, tau / scale * sine]
    return np.column_stack([*columns, np.ones_like(tau)])


_HATS = 9  # knots of a dependence on time or amplitude


@dataclass(frozen=True)
class Disagreement:
    """One finding.

    Attributes
    ----------
    trials : str
        Kind of the trials where it shows.
    subject : str
        "mode 1", "channel g17", "all channels", ...; of a pattern over channels what it means.
    dependence : str
        What it goes with: "amplitude", "time", "load (not proportional)", "channels", ...
    share : float
        Of the excess variance of these trials.
    p_value : float
        Of the finding.
    coefficients : int
        Number fitted to tell it.
    sentence : str
        In words.
    channel : str
        Where a pattern over channels is strongest.
    """

    trials: str
    subject: str
    dependence: str
    share: float
    p_value: float
    coefficients: int = 0
    sentence: str = ""
    channel: str = ""


def kinds(residuals: ResidualSet) -> dict[str, tuple[int, ...]]:
    """Return the indices of trials by kind and channels: the groups that form one matrix each."""
    groups: dict[tuple[str, tuple[str, ...]], list[int]] = {}
    for number, item in enumerate(residuals.trials):
        groups.setdefault((item.trial.kind.value, item.trial.channels), []).append(number)
    names: dict[str, tuple[int, ...]] = {}
    for (kind, _), members in groups.items():
        name = "ring-down" if kind == "ringdown" else kind
        names[name if name not in names else f"{name} ({len(names) + 1})"] = tuple(members)
    return names


def excess(items: Sequence[FittedTrial]) -> float:
    """Return the excess variance of trials, in units of the noise variance."""
    return float(sum(np.nansum(i.standardised**2) - np.sum(i.expected_variance[i.used]) for i in items))


def _hats(values: FloatArray, low: float, high: float) -> FloatArray:
    """Return piecewise linear hat functions between `low` and `high`, (n, `_HATS`)."""
    if high <= low:
        return np.ones((values.size, 1))
    centres = np.linspace(low, high, _HATS)
    return np.column_stack([np.interp(values, centres, hat) for hat in np.eye(_HATS)])


def explanations(residuals: ResidualSet) -> tuple[Disagreement, ...]:
    """Return what single dependences explain of the excess variance, by kind of trial, largest share first.

    Every dependence is fitted to each channel by itself with one set of coefficients for all trials of the
    kind, so that amplitude and time are told apart where releases differ; the strongest line has a phase of
    its own in each trial. Modes are split at `frequencies` [Hz], by default at the peaks of the predictions'
    spectra.
    """
    found = []
    for name, members in kinds(residuals).items():
        items = [residuals.trials[number] for number in members]
        whole = excess(items)
        freedom = sum(float(np.sum(i.expected_variance[i.used])) for i in items)
        if freedom <= 0.0 or whole <= 2.0 * np.sqrt(2.0 * freedom):
            continue  # no excess to explain
        parts: dict[tuple[str, str], list[Part]] = {}
        modes = _modes(items)
        line = dominant_line(items) if items[0].trial.is_dynamic else None
        for column in range(len(items[0].trial.channels)):
            used = [item for item in items if item.used[:, column].any()]
            bases = _bases(used, column, modes) if used else {}
            if used and line is not None:
                bases["", line.name] = _line_basis(used, column, line)
            for key, basis in bases.items():
                part = part_of(basis, [(item, item.used[:, column]) for item in used], column)
                if part is not None:
                    parts.setdefault(key, []).append(part)
        for (subject, dependence), own in parts.items():
            statistic, count = explained(own)
            share = float(np.clip((statistic - count) / whole, 0.0, 1.0))
            p = float(stats.chi2.sf(statistic, count)) if count else 1.0
            if line is not None and dependence == line.name:
                p = min(1.0, p * line.choices)
            found.append(Disagreement(name, subject, dependence, share, p, count))
    return tuple(sorted(found, key=lambda item: -item.share))


class SpectralLine(NamedTuple):
    """The strongest line of residuals: frequency [Hz], decay rate [1/s], how many it was chosen from."""

    frequency: float
    decay: float
    choices: int

    @property
    def name(self) -> str:
        """Such as "a line at 50 Hz" or "a decaying line at 9.1 Hz"."""
        return f"a {'decaying ' if self.decay else ''}line at {self.frequency:.3g} Hz"


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
            power += (
                2.0 * np.sum(np.abs(np.fft.rfft(values, 4 * length, axis=0)) ** 2, axis=1) / (weight @ weight)
            )
        power[:4] = 0.0
        place = int(np.argmax(power))
        choices += length // 2
        # A decay must explain visibly more than the same line without it.
        if power[place] > 1.05 * best[0]:
            best = (float(power[place]), float(at[place]), decay)
    return SpectralLine(best[1], best[2], choices) if best[0] > 0.0 else None


def _line_basis(items: Sequence[FittedTrial], column: int, line: SpectralLine) -> FloatArray:
    waves = []
    for item in items:
        time = item.trial.time[item.used[:, column]] - item.trial.time[0]
        wave = np.exp((-line.decay + 2j * np.pi * line.frequency) * time)
        waves.append(np.column_stack([wave.real, wave.imag]))
    return np.asarray(block_diag(*waves))


def _modes(items: Sequence[FittedTrial]) -> dict[int, MotionByMode] | None:
    """Return the modal motion of each trial by its identity, None where it cannot be had."""
    if not items[0].trial.is_dynamic:
        return None
    at = predicted_frequencies(items)
    found = {id(item): modal_motion(item.prediction, item.trial.interval, at) for item in items}
    whole = {key: motion for key, motion in found.items() if motion is not None}
    return whole if len(whole) == len(items) else None


def _bases(
    items: Sequence[FittedTrial], column: int, modes: Mapping[int, MotionByMode] | None
) -> dict[tuple[str, str], FloatArray]:
    """Return the functions of each subject and dependence, stacked over trials, (n, k)."""
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

    bases = {("", "zero shift"): stack("mean")}
    bases["", "zero shift of each trial"] = np.vstack([
        np.tile(np.eye(len(items))[number], (int(use.sum()), 1)) for number, use in enumerate(rows)
    ])  # fmt: skip
    temperature = joined([item.trial.temperature for item in items])
    if np.ptp(temperature) > 0.0:
        bases["", "temperature"] = np.column_stack([temperature, temperature * stack("x")[:, 0]])
    within = joined([item.trial.time for item in items])
    if not items[0].trial.is_dynamic:
        if np.ptp(within) > 0.0:
            bases["", "time"] = np.column_stack([np.ones_like(within), within - within.mean()])
        force = joined([item.trial.force for item in items])
        load = force if np.any(force) else joined([item.trial.load_factor for item in items])
        if np.ptp(load) > 0.0:
            bases["", "load (proportional)"] = np.column_stack([stack("x")[:, 0], load])
            bases["", "load (not proportional)"] = np.column_stack([load, np.abs(load) * load, load**2])
        return bases
    drifts = []
    for item, use in zip(items, rows, strict=True):
        x = (item.trial.time[use] - item.trial.time[0]) / (item.trial.time[-1] - item.trial.time[0])
        drifts.append(np.polynomial.legendre.legvander(2.0 * x - 1.0, 4))
    bases["", "a drift of zero in each trial"] = np.asarray(block_diag(*drifts))
    if all(item.rates is not None for item in items):
        bases["", "x and v"] = stack("x", "v")
        bases["", "higher harmonics"] = stack("2nd harmonic", "3rd harmonic")
    if modes is None:
        return bases
    by_time = _hats(within, float(within.min()), float(within.max()))
    for mode in range(len(next(iter(modes.values())).amplitude)):
        parts = [modes[id(item)] for item in items]
        motion = np.column_stack([
            joined([part.displacement[mode, :, column] for part in parts]),
            joined([part.velocity[mode, :, column] for part in parts]),
        ])  # fmt: skip
        amplitude = joined([part.amplitude[mode, :, column] for part in parts])
        if not amplitude.any():
            continue
        level = np.log(np.clip(amplitude / amplitude.max(), 1e-3, None))
        by_amplitude = _hats(level, float(level.min()), 0.0)
        for dependence, shape in (("amplitude", by_amplitude), ("time", by_time)):
            table = np.hstack([shape * motion[:, [0]], shape * motion[:, [1]]])
            bases[f"mode {mode + 1}", dependence] = table
    return bases


def mode_shares(
    items: Sequence[FittedTrial], white: Sequence[FloatArray], frequencies: Sequence[float]
) -> FloatArray:
    """Return the share of the excess variance in the band of each mode, (M,), summing to at most one.

    Bands end midway (geometrically) between neighbouring frequencies, the lowest begins at half the first,
    the highest ends at `sqrt(2)` times the last.
    """
    modes = np.sort(np.asarray(frequencies, dtype=float))
    edges = np.concatenate([[0.5 * modes[0]], np.sqrt(modes[1:] * modes[:-1]), [np.sqrt(2.0) * modes[-1]]])
    sums, whole = np.zeros(modes.size), 0.0
    for item, values in zip(items, white, strict=True):
        for column in range(values.shape[1]):
            surplus = 2.0 * (periodogram(values[:, column]) - 1.0)
            at = np.arange(1, surplus.size + 1) / (len(values) * item.trial.interval)
            place = np.searchsorted(edges, at) - 1
            whole += float(surplus.sum())
            for mode in range(modes.size):
                sums[mode] += float(surplus[place == mode].sum())
    return np.clip(sums / whole, 0.0, 1.0) if whole > 0.0 else np.zeros(modes.size)


def predicted_frequencies(items: Sequence[FittedTrial]) -> tuple[float, ...]:
    """Return the frequencies [Hz] of the peaks of the predictions' spectra, lowest first, at most four.

    A peak is a largest ordinate within a factor 1.4 on both sides, above a thousandth of the greatest, of
    four periods or more in the record: below, a zero or a slow decay looks like one.
    """
    longest = max(items, key=lambda item: len(item.trial.time))
    power = np.zeros((len(longest.trial.time) - 1) // 2)
    for item in items:
        if len(item.trial.time) != len(longest.trial.time):
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
