"""Motion before and after: histories, spectra, and frequency and damping over the amplitude."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.signal import welch

from discrepancy.campaign.records import FloatArray, TrialKind
from discrepancy.campaign.units import UNITS
from discrepancy.errors import FitError
from discrepancy.location.dependence import Backbone, backbones, predicted_frequencies
from discrepancy.location.residuals import FittedTrial, ResidualSet, of_channel
from reporting import figures as style

from .residual_figures import draw_noise, models, panels, size

_ROWS = [item.name for item in fields(Backbone)[1:]]

LEAST_POINTS = 4
"""Fewest measured points of a mode whose backbone is drawn."""
LARGEST_ERROR = 0.25
"""Largest error of a damping ratio, relative to the median ratio, of a point that is drawn."""
MOST_MODES = 3
"""Modes that are fitted together in a window."""
ABOVE: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.0}
"""Place of a legend that lies over no curve."""


class Worst(NamedTuple):
    """The record with the largest gap: index of the trial in its set, name of the channel."""

    trial: int
    channel: str


def worst_record(items: Sequence[FittedTrial]) -> Worst | None:
    """Return the dynamic record whose residuals exceed the noise most; None without one."""
    found = [
        (found, number, name)
        for number, item in enumerate(items)
        if item.trial.is_dynamic
        for column, name in enumerate(item.trial.channels)
        if item.used[:, column].any() and np.isfinite(found := size([item], name))
    ]
    return Worst(*max(found)[1:]) if found else None


def history_figure(before: ResidualSet, after: ResidualSet | None, worst: Worst) -> Figure:
    """Draw the worst record: measured and predicted values, and the residuals against the noise."""
    item = before.trials[worst.trial]
    column = item.column(worst.channel)
    factor, unit = UNITS[before.channels[worst.channel].quantity].drawn
    time, used = item.trial.time, item.used[:, column]
    shown = models(before, after)
    count = 1 + len(shown)
    shape = {"height_ratios": [1.25, *[1.0] * len(shown)], "sharex": True}
    figure, ((axes,), *below) = panels(count, 1, 1.45 * count + 0.35, **shape)
    axes.margins(x=0.01)
    values = factor * item.trial.values[used, column]
    axes.plot(time[used], values, ".", ms=1.8, color=style.OBSERVED, label="measured")
    for one in shown:
        predicted = factor * one.residuals.trials[worst.trial].prediction[:, column]
        axes.plot(time, predicted, one.dashes, lw=0.9, color=one.colour, label=one.label)
    axes.set(ylabel=f"{worst.channel}, {unit}", title=f"a  {worst.channel} in {item.trial.name}")
    axes.legend(**ABOVE, ncol=3)
    for number, ((panel,), one) in enumerate(zip(below, shown, strict=True)):
        each = one.residuals.trials[worst.trial]
        draw_noise(panel, factor * float(each.noise_deviation[column]), 0.3)
        panel.plot(time[used], factor * each.residual[used, column], lw=0.6, color=one.colour)
        panel.set(ylabel=f"residual, {unit}", title=f"{'bc'[number]}  residual, {one.label}")
    below[0][0].legend(**ABOVE)
    figure.axes[-1].set_xlabel("time, s")
    return figure


def spectrum_figure(before: ResidualSet, after: ResidualSet | None, worst: Worst) -> Figure | None:
    """Draw spectra of the residuals of the worst channel over all dynamic trials, with that of the noise."""
    drawn = [
        (*spectrum, item)
        for item in models(before, after)
        if (spectrum := _spectrum(item.residuals, worst.channel)) is not None
    ]
    if not drawn:
        return None
    noise = before.channels[worst.channel].noise
    figure, ((axes,),) = panels(1, 1, 2.7)
    if noise is not None and noise.samples is not None and noise.interval and len(noise.samples) >= 32:
        count = min(len(noise.samples), 128)
        at, power = welch(noise.samples / noise.standard_deviation, 1.0 / noise.interval, nperseg=count)
        power = power[1:] * 0.5 / noise.interval
        axes.plot(at[1:], power, color=style.OBSERVED, lw=0.8, alpha=0.6, label="noise record")
    axes.axhline(1.0, color=style.TRUTH, lw=0.7, ls="-.", label="white noise of the stated size")
    for at, power, item in drawn:
        axes.plot(at, power, item.dashes, color=item.colour, lw=1.1, label=item.label)
    for number, frequency in enumerate(mode_frequencies(before)[:4], start=1):
        axes.axvline(frequency, color=style.REFERENCE, lw=0.6, ls=":")
        axes.annotate(
            f"mode {number}", (frequency, 1.0), (2.0, -2.0), xycoords=("data", "axes fraction"),
            textcoords="offset points", rotation=90, va="top", fontsize=6.5, color=style.OBSERVED,
        )  # fmt: skip
    axes.set(yscale="log", xlim=(0.0, float(drawn[0][0][-1])), xlabel="frequency, Hz")
    axes.set(ylabel="power / white noise", title=f"residuals of {worst.channel}, all dynamic trials")
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, 0.1), max(high, 10.0))
    axes.legend(**ABOVE, ncol=2)
    return figure


def _spectrum(residuals: ResidualSet, channel: str) -> tuple[FloatArray, FloatArray] | None:
    """Return frequency [Hz] and power over that of the stated white noise, mean of the trials."""
    found: dict[float, list[tuple[FloatArray, FloatArray]]] = {}
    for item, column, _ in of_channel(residuals.trials, channel):
        if not item.trial.is_dynamic or len(item.trial.time) < 32:
            continue
        series = np.nan_to_num(item.standardised[:, column])
        count = min(len(series), 512)
        at, power = welch(series, 1.0 / item.trial.interval, nperseg=count, detrend="constant")
        found.setdefault(round(item.trial.interval * len(at), 9), []).append(
            (at[1:], power[1:] * 0.5 / item.trial.interval)
        )
    if not found:
        return None
    most = max(found.values(), key=len)
    return most[0][0], np.mean([power for _, power in most], axis=0)


def mode_frequencies(residuals: ResidualSet) -> tuple[float, ...]:
    """Return the frequencies [Hz] at which predictions ring, lowest first."""
    items = [item for item in residuals.trials if item.trial.is_dynamic]
    return predicted_frequencies(items) if items else ()


# ---------------------------------------------------------------- backbones


def backbone_figure(before: ResidualSet, after: ResidualSet | None) -> tuple[Figure, str] | None:
    """Draw frequency and damping ratio of the ring-downs over the amplitude, and name the channel.

    None where no record is long enough or no mode rings long enough.
    """
    frequencies = mode_frequencies(before if after is None else after)[:MOST_MODES]
    worst = worst_record([item for item in before.trials if item.trial.kind is TrialKind.RINGDOWN])
    if worst is None or not frequencies:
        return None
    channel = worst.channel
    measured = _backbones(before, channel, frequencies, measured=True)
    curves = [(_backbones(one.residuals, channel, frequencies), one) for one in models(before, after)]
    modes = [n for n in sorted(measured) if np.isfinite(measured[n].time).sum() >= LEAST_POINTS][:2]
    if not modes:
        return None
    factor, unit = UNITS[before.channels[channel].quantity].drawn
    drawn = (("frequency", "frequency, Hz", 1.0), ("damping_ratio", "damping ratio, %", 100.0))
    figure, cells = panels(len(modes), 2, 2.3 * len(modes) + 0.3)
    for row, mode in enumerate(modes):
        points = measured[mode]
        for place, (axes, (name, label, scale)) in enumerate(zip(cells[row], drawn, strict=True)):
            for found, shown in curves:
                if (curve := found.get(mode)) is not None:
                    (line,) = axes.plot(factor * curve.amplitude, scale * getattr(curve, name))
                    line.set(color=shown.colour, ls=shown.dashes, lw=1.1, alpha=0.8, label=shown.label)
            values, error = scale * getattr(points, name), scale * getattr(points, f"{name}_error")
            axes.errorbar(
                factor * points.amplitude, values, error, fmt="o", ms=2.6, color=style.OBSERVED, lw=0.0,
                elinewidth=0.6, alpha=0.85, label="measured, ± 1 standard error", zorder=3,
            )  # fmt: skip
            title, across = f"{'abcd'[2 * row + place]}  mode {mode}", f"amplitude of {channel}, {unit}"
            axes.set(xscale="log", title=title, xlabel=across, ylabel=label)
            style.plain_powers(axes.xaxis, (1.0, 2.0, 5.0))
            # what was measured and its surroundings, whatever a wrong model does
            low, high = np.nanquantile(values, (0.02, 0.98))
            wide = 1.2 * max(float(high - low), 0.02 * abs(float(np.nanmedian(values))))
            bottom, top = axes.get_ylim()
            axes.set_ylim(max(bottom, low - wide), min(top, high + wide))
    cells[0][1].legend(loc="best")
    return figure, channel


def _backbones(
    residuals: ResidualSet, channel: str, frequencies: Sequence[float], *, measured: bool = False
) -> dict[int, Backbone]:
    """Return the backbones of the ring-downs by mode, of what was predicted or of what was measured.

    Points whose errors leave nothing to be seen are left out; NaN stands between ring-downs.
    """
    found: dict[int, list[list[FloatArray]]] = {}
    for item, column, used in of_channel(residuals.trials, channel):
        if item.trial.kind is not TrialKind.RINGDOWN:
            continue
        noise, values = float(item.noise_deviation[column]), item.prediction[:, column]
        if measured:
            values = np.where(used, item.trial.values[:, column], values)
        try:
            curves = backbones(item.trial.time, values, list(frequencies), noise_deviation=noise)
        except FitError:
            continue
        for curve in (curve for curve in curves if curve.time.size):
            limit = LARGEST_ERROR * max(float(np.median(np.abs(curve.damping_ratio))), 1e-4)
            clear = curve.damping_ratio_error < limit
            if clear.any():
                rows = [np.r_[getattr(curve, name)[clear], np.nan] for name in _ROWS]
                found.setdefault(curve.mode, []).append(rows)
    return {
        mode: Backbone(mode, *map(np.concatenate, zip(*each, strict=True))) for mode, each in found.items()
    }
