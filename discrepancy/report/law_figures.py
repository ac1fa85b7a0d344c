"""What law it is: frequency and damping over the amplitude, restoring force."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from discrepancy.campaign.records import TrialKind
from discrepancy.campaign.units import UNITS
from discrepancy.errors import FitError
from discrepancy.location.backbone import Backbone, RestoringForceSurface, backbones, restoring_force_surface
from discrepancy.location.residuals import FittedTrial, ResidualSet
from discrepancy.report.kit import models, panels, plain_powers
from discrepancy.report.motion_figures import mode_frequencies
from reporting.figures import OBSERVED, REFERENCE, publication_style

FloatArray = NDArray[np.float64]

LEAST_POINTS = 4
"""Fewest measured points of a mode whose backbone is drawn."""
LARGEST_ERROR = 0.25
"""Largest error of a damping ratio, relative to the median ratio, of a point that is drawn."""
FORCE_BINS = 24
MOST_MODES = 3
"""Modes that are fitted together in a window."""


def _ringdowns(residuals: ResidualSet) -> list[FittedTrial]:
    return [item for item in residuals.trials if item.trial.kind is TrialKind.RINGDOWN]


def _clearest(items: Sequence[FittedTrial], frequency: float) -> str:
    """Return the channel that shows the first mode best: clear of noise, and by itself."""
    clear: dict[str, float] = {}
    pure: dict[str, float] = {}
    for item in items:
        at = np.fft.rfftfreq(len(item.trial.time), item.trial.interval)
        near = (at > frequency / 1.4) & (at < frequency * 1.4)
        power = np.abs(np.fft.rfft(item.prediction - item.prediction.mean(axis=0), axis=0)) ** 2
        for column, name in enumerate(item.trial.channels):
            total = float(power[1:, column].sum())
            first = float(power[near, column].sum())
            ratio = float(np.sqrt(first) / item.noise_deviation[column])
            clear[name] = max(clear.get(name, 0.0), ratio)
            pure[name] = min(pure.get(name, 1.0), first / total if total > 0.0 else 0.0)
    # Among those that other modes disturb little, the clearest.
    limit = 3.0 * min(1.0 - share for share in pure.values()) + 0.02
    return max((name for name in clear if 1.0 - pure[name] <= limit), key=lambda name: clear[name])


def _others(values: FloatArray, interval: float, frequency: float) -> list[float]:
    """Return the frequencies of peaks above a first mode, down to a millionth of its power."""
    series = (values - values.mean()) * np.hanning(2 * len(values))[len(values) :]
    power = np.abs(np.fft.rfft(series)) ** 2
    at = np.fft.rfftfreq(len(values), interval)
    found = []
    for number in np.flatnonzero((at > 1.6 * frequency) & (power > 1e-6 * power.max())):
        near = (at > at[number] / 1.25) & (at < at[number] * 1.25)
        if power[number] >= power[near].max() and power[number] > 10.0 * np.median(power[near]):
            found.append(float(at[number]))
    return found


def _all_frequencies(
    items: Sequence[FittedTrial], channel: str, frequencies: Sequence[float]
) -> tuple[float, ...]:
    """Return the first frequency and the lowest that a channel's records show above it.

    Every mode that rings must be fitted along, or it scatters the first one.
    """
    found = [list(frequencies[1:])]
    for item in items:
        if channel in item.trial.channels:
            column = item.column(channel)
            values = np.where(item.used[:, column], item.trial.values[:, column], item.prediction[:, column])
            found.append(_others(values, item.trial.interval, frequencies[0]))
    most = max(found, key=len)
    return (frequencies[0], *sorted(most)[: MOST_MODES - 1])


def backbone_figure(before: ResidualSet, after: ResidualSet | None) -> tuple[Figure, str] | None:
    """Draw frequency and damping ratio of the ring-downs over the amplitude, and name the channel.

    None where no record is long enough or no mode rings long enough.
    """
    items = _ringdowns(before)
    frequencies = mode_frequencies(before if after is None else after)
    if not items or not frequencies:
        return None
    channel = _clearest(items, frequencies[0])
    frequencies = _all_frequencies(items, channel, frequencies)
    measured = _backbones(items, channel, frequencies, None)
    curves = [
        (_backbones(_ringdowns(item.residuals), channel, frequencies, "prediction"), item)
        for item in models(before, after)
    ]
    modes = [n for n in sorted(measured) if sum(len(c.time) for c in measured[n]) >= LEAST_POINTS][:2]
    if not modes:
        return None
    factor, unit = UNITS[before.channels[channel].quantity].drawn
    with publication_style():
        figure, cells = panels(
            len(modes), 2, 2.3 * len(modes) + 0.3, 1.0 - 0.22 / (2.3 * len(modes)), 0.19 / len(modes) + 0.02,
            left=0.09, hspace=0.4, wspace=0.26,
        )  # fmt: skip
        for row, mode in enumerate(modes):
            for place, (name, label, scale) in enumerate(
                (("frequency", "frequency, Hz", 1.0), ("damping_ratio", "damping ratio, %", 100.0))
            ):
                axes = cells[row][place]
                for found, shown in curves:
                    for number, curve in enumerate(found.get(mode, [])):
                        axes.plot(
                            factor * curve.amplitude, scale * getattr(curve, name), shown.dashes,
                            color=shown.colour, lw=1.1, alpha=0.8,
                            label="_nolegend_" if number else shown.label,
                        )  # fmt: skip
                _draw_points(axes, measured[mode], name, factor, scale)
                axes.set_xscale("log")
                plain_powers(axes.xaxis, (1.0, 2.0, 5.0))
                axes.set_ylabel(label)
                axes.set_title(f"{'abcd'[2 * row + place]}  mode {mode}", loc="left")
                axes.set_xlabel(f"amplitude of {channel}, {unit}")
                _range(axes, measured[mode], name, scale)
                if row == 0 and place == 1:
                    axes.legend(loc="best")
    return figure, channel


def _backbones(
    items: Sequence[FittedTrial], channel: str, frequencies: Sequence[float], source: str | None
) -> dict[int, list[Backbone]]:
    found: dict[int, list[Backbone]] = {}
    for item in items:
        if channel not in item.trial.channels:
            continue
        column = item.column(channel)
        noise = float(item.noise_deviation[column])
        values = item.prediction[:, column] if source else np.where(
            item.used[:, column], item.trial.values[:, column], item.prediction[:, column]
        )  # fmt: skip
        try:
            curves = backbones(item.trial.time, values, list(frequencies), noise_deviation=noise)
        except FitError:
            continue
        for curve in curves:
            clear = _clear(curve)
            if clear is not None:
                found.setdefault(curve.mode, []).append(clear)
    return found


def _clear(curve: Backbone) -> Backbone | None:
    """Return the points of a curve whose errors leave something to be seen."""
    if not curve.time.size:
        return None
    limit = LARGEST_ERROR * max(float(np.median(np.abs(curve.damping_ratio))), 1e-4)
    keep = curve.damping_ratio_error < limit
    if not keep.any():
        return None
    fields = (
        "time", "amplitude", "amplitude_error", "frequency", "frequency_error", "damping_ratio",
        "damping_ratio_error",
    )  # fmt: skip
    return Backbone(curve.mode, *(getattr(curve, name)[keep] for name in fields))


def _draw_points(axes: Axes, curves: Sequence[Backbone], name: str, factor: float, scale: float) -> None:
    label = "measured, ± 1 standard error"
    for curve in curves:
        axes.errorbar(
            factor * curve.amplitude, scale * getattr(curve, name), scale * getattr(curve, f"{name}_error"),
            fmt="o", ms=2.6, color=OBSERVED, elinewidth=0.6, lw=0.0, alpha=0.85, label=label, zorder=3,
        )  # fmt: skip
        label = "_nolegend_"


def _range(axes: Axes, curves: Sequence[Backbone], name: str, scale: float) -> None:
    """Show what was measured and its surroundings, whatever a wrong model does."""
    values = scale * np.concatenate([getattr(curve, name) for curve in curves])
    low, high = np.quantile(values, (0.02, 0.98))
    drawn = axes.get_ylim()
    wide = max(float(high - low), 0.02 * abs(float(np.median(values))))
    axes.set_ylim(max(drawn[0], low - 1.2 * wide), min(drawn[1], high + 1.2 * wide))


def force_figure(before: ResidualSet, after: ResidualSet | None) -> tuple[Figure, str] | None:
    """Draw what the restoring force of the first mode has beside its linear part.

    Measured and predicted signals are filtered and evaluated alike. None where a record is too short or too
    coarse, or where noise hides what there is to see.
    """
    items = _ringdowns(before)
    frequencies = mode_frequencies(before if after is None else after)
    if not items or not frequencies:
        return None
    channel = _clearest(items, frequencies[0])
    number = max(
        (n for n, item in enumerate(items) if channel in item.trial.channels),
        key=lambda n: float(np.ptp(items[n].prediction[:, items[n].column(channel)])),
    )
    item = items[number]
    column = item.column(channel)
    values = np.where(item.used[:, column], item.trial.values[:, column], item.prediction[:, column])
    shown = models(before, after)
    signals = [values, *(_ringdowns(one.residuals)[number].prediction[:, column] for one in shown)]
    others = _others(values, item.trial.interval, frequencies[0])
    edge = round(1.0 / (frequencies[0] * item.trial.interval))  # where the filter has seen one side only
    try:
        measured, *predicted = (
            restoring_force_surface(
                item.trial.time[edge:-edge],
                _first_mode(signal, item.trial.interval, frequencies[0], others)[edge:-edge],
                frequencies[0],
            )
            for signal in signals
        )
    except (FitError, ValueError):
        return None
    rate, top = 2.0 * np.pi * frequencies[0], float(np.abs(measured.displacement).max())
    line = np.linalg.lstsq(_line(measured), -measured.acceleration, rcond=None)[0]

    def rest(surface: RestoringForceSurface, over: str) -> tuple[FloatArray, FloatArray, FloatArray]:
        left = 100.0 * (-surface.acceleration - _line(surface) @ line) / (rate**2 * top)
        x, v = surface.displacement / top, surface.velocity / (rate * top)
        along, other = (v, x) if over == "velocity" else (x, v)
        near = np.abs(other) < 0.35 * np.hypot(x, v)
        return _binned(along[near], left[near])

    plain = True
    with publication_style():
        figure, (row,) = panels(1, 2, 2.5, 0.9, 0.17, left=0.09, wspace=0.26)
        for axes, over, title in zip(
            row, ("velocity", "displacement"), ("a  while passing through rest", "b  while turning back"),
            strict=True,
        ):  # fmt: skip
            middles, means, errors = rest(measured, over)
            axes.errorbar(
                middles, means, errors, fmt="o", ms=2.8, color=OBSERVED, elinewidth=0.7, label="measured"
            )
            seen = float(np.nanstd(means)) if np.isfinite(means).any() else 0.0
            hidden = float(np.nanmedian(errors)) if np.isfinite(errors).any() else 1.0
            plain = plain and seen < 3.0 * hidden
            for surface, one in zip(predicted, shown, strict=True):
                middles, means, _ = rest(surface, over)
                axes.plot(middles, means, one.dashes, color=one.colour, lw=1.2, label=one.label)
            axes.axhline(0.0, color=REFERENCE, lw=0.6, zorder=0)
            axes.set_xlabel(f"{over} / largest")
            axes.set_title(title, loc="left")
        row[0].set_ylabel("force less linear part, %")
        row[0].legend(loc="best")
    return None if plain else (figure, f"{channel} in {item.trial.name}")


def _line(surface: RestoringForceSurface) -> FloatArray:
    """Return the columns (N, 3) of a linear force."""
    return np.column_stack((surface.displacement, surface.velocity, np.ones_like(surface.velocity)))


def _first_mode(signal: FloatArray, interval: float, frequency: float, others: Sequence[float]) -> FloatArray:
    """Return the signal below the second mode: zero phase, so that no force is turned into another."""
    if not others:
        return signal
    cut = float(np.sqrt(frequency * min(others)))
    if cut >= 0.45 / interval:
        return signal
    return np.asarray(sosfiltfilt(butter(6, cut, fs=1.0 / interval, output="sos"), signal))


def _binned(along: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    edges = np.linspace(-1.0, 1.0, FORCE_BINS + 1)
    place = np.clip(np.digitize(along, edges) - 1, 0, FORCE_BINS - 1)
    means, errors = np.full(FORCE_BINS, np.nan), np.full(FORCE_BINS, np.nan)
    for n in range(FORCE_BINS):
        inside = values[place == n]
        if len(inside) >= 3:
            means[n], errors[n] = inside.mean(), inside.std() / np.sqrt(len(inside))
    return 0.5 * (edges[:-1] + edges[1:]), means, errors
