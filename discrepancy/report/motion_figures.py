"""Motion before and after: time histories and spectra of residuals."""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.signal import welch

from discrepancy.campaign.units import UNITS
from discrepancy.location.dependence import predicted_frequencies
from discrepancy.location.residuals import ResidualSet
from discrepancy.report.kit import draw_noise, models, panels
from discrepancy.report.residual_figures import size
from reporting.figures import OBSERVED, REFERENCE, TRUTH, new_figure, publication_style

FloatArray = NDArray[np.float64]

COMPARABLE = 6.0
"""Ratio of residuals before and after up to which they are drawn at one scale."""


@dataclass(frozen=True)
class Worst:
    """The record with the largest gap: index of the trial in its set, name of the channel."""

    trial: int
    channel: str


def worst_record(before: ResidualSet) -> Worst | None:
    """Return the dynamic record whose residuals exceed the noise most; None without one."""
    found = [
        (found, number, name)
        for number, item in enumerate(before.trials)
        if item.trial.is_dynamic
        for column, name in enumerate(item.trial.channels)
        if item.used[:, column].any() and np.isfinite(found := size(item, column))
    ]
    return Worst(*max(found)[1:]) if found else None


def history_figure(before: ResidualSet, after: ResidualSet | None, worst: Worst) -> Figure:
    """Draw the worst record: measured and predicted values, and the residuals against the noise."""
    item = before.trials[worst.trial]
    column = item.column(worst.channel)
    factor, unit = UNITS[before.channels[worst.channel].quantity].drawn
    time, used = item.trial.time, item.used[:, column]
    shown = models(before, after)
    with publication_style():
        count = 1 + len(shown)
        figure, cells = panels(
            count, 1, 1.45 * count + 0.35, 1.0 - 0.2 / (1.45 * count), 0.38 / (1.45 * count), left=0.095,
            hspace=0.34, height_ratios=[1.25, *([1.0] * len(shown))],
        )  # fmt: skip
        (axes,), *below = cells
        values = factor * item.trial.values[used, column]
        axes.plot(time[used], values, ".", ms=1.8, color=OBSERVED, label="measured")
        for one in shown:
            predicted = factor * one.residuals.trials[worst.trial].prediction[:, column]
            axes.plot(time, predicted, one.dashes, lw=0.9, color=one.colour, label=one.label)
        axes.set_ylabel(f"{worst.channel}, {unit}")
        axes.set_title(f"a  {worst.channel} in {item.trial.name}", loc="left")
        axes.legend(ncol=3, loc="upper right")
        axes.margins(x=0.01)
        sizes = [size(one.residuals.trials[worst.trial], column) for one in shown]
        alike = sizes[0] < COMPARABLE * sizes[-1]
        for number, ((panel,), one) in enumerate(zip(below, shown, strict=True)):
            each = one.residuals.trials[worst.trial]
            panel.sharex(axes)
            draw_noise(panel, factor * float(each.noise_deviation[column]), 0.3)
            panel.plot(time[used], factor * each.residual[used, column], lw=0.6, color=one.colour)
            panel.set_ylabel(f"residual, {unit}")
            own = " (own scale)" if number and not alike else ""
            panel.set_title(f"{'bc'[number]}  residual, {one.label}{own}", loc="left")
            panel.margins(x=0.01)
        below[0][0].legend(loc="upper right")
        if alike:
            limits = [limit for (panel,) in below for limit in panel.get_ylim()]
            for (panel,) in below:
                panel.set_ylim(min(limits), max(limits))
        figure.axes[-1].set_xlabel("time, s")
        for above in figure.axes[:-1]:
            above.tick_params(labelbottom=False)
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
    with publication_style():
        figure = new_figure(2.7)
        axes = figure.add_axes((0.095, 0.16, 0.885, 0.70))
        if noise is not None and noise.samples is not None and noise.interval and len(noise.samples) >= 32:
            count = min(len(noise.samples), 128)
            at, power = welch(noise.samples / noise.standard_deviation, 1.0 / noise.interval, nperseg=count)
            power = power[1:] * 0.5 / noise.interval
            axes.plot(at[1:], power, color=OBSERVED, lw=0.8, alpha=0.6, label="noise record")
        axes.axhline(1.0, color=TRUTH, lw=0.7, ls="-.", label="white noise of the stated size")
        for at, power, item in drawn:
            axes.plot(at, power, item.dashes, color=item.colour, lw=1.1, label=item.label)
        for number, frequency in enumerate(mode_frequencies(before)[:4], start=1):
            axes.axvline(frequency, color=REFERENCE, lw=0.6, ls=":")
            axes.annotate(
                f"mode {number}", (frequency, 1.0), (2.0, -2.0), xycoords=("data", "axes fraction"),
                textcoords="offset points", rotation=90, va="top", fontsize=6.5, color=OBSERVED,
            )  # fmt: skip
        axes.set_yscale("log")
        axes.set_xlim(0.0, float(drawn[0][0][-1]))
        axes.set_xlabel("frequency, Hz")
        axes.set_ylabel("power / white noise")
        axes.set_title(f"residuals of {worst.channel}, all dynamic trials", loc="left")
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, 0.1), max(high, 10.0))
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncol=2, borderaxespad=0.0)
    return figure


def _spectrum(residuals: ResidualSet, channel: str) -> tuple[FloatArray, FloatArray] | None:
    """Return frequency [Hz] and power over that of the stated white noise, mean of the trials."""
    found: dict[float, list[tuple[FloatArray, FloatArray]]] = {}
    for item in residuals.trials:
        if not item.trial.is_dynamic or channel not in item.trial.channels or len(item.trial.time) < 32:
            continue
        series = np.nan_to_num(item.standardised[:, item.column(channel)])
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
