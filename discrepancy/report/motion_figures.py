"""Motion before and after: histories, spectra, and frequency and damping over the amplitude."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.signal import welch

from discrepancy.campaign.records import FloatArray, NoiseRecord, TrialKind
from discrepancy.campaign.units import UNITS
from discrepancy.errors import FitError
from discrepancy.location.backbones import Backbone, backbones
from discrepancy.location.dependence import predicted_frequencies
from discrepancy.location.residuals import FittedTrial, ResidualSet, channel_fits
from discrepancy.report.residual_figures import (
    DrawnModel,
    draw_noise,
    models_to_draw,
    new_panels,
    rms_over_noise,
)
from reporting.pages import figures as style

_ARRAYS = [entry.name for entry in fields(Backbone) if entry.name != "mode"]
"""Names of the arrays of a backbone."""

LEAST_POINTS = 4
"""Fewest measured points of a mode whose backbone is drawn."""
LARGEST_ERROR = 0.25
"""Largest error of a damping ratio, relative to the median ratio, of a point that is drawn."""
MOST_MODES = 3
"""Modes that are fitted together in a window."""
ABOVE: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.0}
"""Place of a legend that lies over no curve."""


class Worst(NamedTuple):
    """The record with the largest gap: index of the trial in its set, and name of the channel."""

    trial: int
    channel: str


def worst_record(trials: Sequence[FittedTrial]) -> Worst | None:
    """Return the dynamic record with the largest rms residual over the noise.

    None if no dynamic trial has a used sample.
    """
    candidates: list[tuple[float, int, str]] = []
    for index, fitted in enumerate(trials):
        if not fitted.trial.is_dynamic:
            continue
        for name in fitted.trial.channels:
            rms_residual = rms_over_noise([fitted], name)
            if np.isfinite(rms_residual):
                candidates.append((rms_residual, index, name))
    if not candidates:
        return None
    _, index, name = max(candidates)
    return Worst(index, name)


def history_figure(before: ResidualSet, after: ResidualSet | None, worst: Worst) -> Figure:
    """Draw the worst record: readings and predictions, and below them the residuals and the noise.

    Parameters
    ----------
    before, after : ResidualSet or None
        Residuals of the unchanged model, and with the effect.
    worst : Worst
        The record.
    """
    fitted = before.trials[worst.trial]
    column = fitted.column(worst.channel)
    is_used = fitted.used[:, column]
    time = fitted.trial.time
    factor, unit = UNITS[before.channels[worst.channel].quantity].drawn
    drawn_models = models_to_draw(before, after)
    panel_count = 1 + len(drawn_models)
    height_ratios = [1.25, *[1.0] * len(drawn_models)]
    figure, ((axes,), *rows_below) = new_panels(
        panel_count, 1, 1.45 * panel_count + 0.35, height_ratios=height_ratios, sharex=True
    )
    # upper panel: readings, and the predictions of the models
    axes.margins(x=0.01)
    readings = factor * fitted.trial.values[is_used, column]
    axes.plot(time[is_used], readings, ".", ms=1.8, color=style.OBSERVED, label="measured")
    for drawn in drawn_models:
        prediction = factor * drawn.residuals.trials[worst.trial].prediction[:, column]
        axes.plot(time, prediction, drawn.dashes, lw=0.9, color=drawn.colour, label=drawn.label)
    axes.set(ylabel=f"{worst.channel}, {unit}", title=f"a  {worst.channel} in {fitted.trial.name}")
    axes.legend(**ABOVE, ncol=3)
    # below: the residuals of each model, with the noise as a band
    panels_below = [panel for (panel,) in rows_below]
    for letter, panel, drawn in zip("bc", panels_below, drawn_models, strict=False):
        fitted_by_model = drawn.residuals.trials[worst.trial]
        draw_noise(panel, factor * float(fitted_by_model.noise_deviation[column]), 0.3)
        residual = factor * fitted_by_model.residual[is_used, column]
        panel.plot(time[is_used], residual, lw=0.6, color=drawn.colour)
        panel.set(ylabel=f"residual, {unit}", title=f"{letter}  residual, {drawn.label}")
    panels_below[0].legend(**ABOVE)
    figure.axes[-1].set_xlabel("time, s")
    return figure


def spectrum_figure(before: ResidualSet, after: ResidualSet | None, worst: Worst) -> Figure | None:
    """Draw the spectra of the residuals of the worst channel, averaged over the dynamic trials.

    The power is relative to white noise of the stated variance. The result is None if no trial is
    long enough.
    """
    spectra = []
    for drawn in models_to_draw(before, after):
        spectrum = _mean_spectrum(drawn.residuals, worst.channel)
        if spectrum is not None:
            spectra.append((spectrum, drawn))
    if not spectra:
        return None
    figure, ((axes,),) = new_panels(1, 1, 2.7)
    _draw_noise_spectrum(axes, before.channels[worst.channel].noise)
    axes.axhline(1.0, color=style.TRUTH, lw=0.7, ls="-.", label="white noise of the stated size")
    for spectrum, drawn in spectra:
        axes.plot(
            spectrum.frequency,
            spectrum.power,
            drawn.dashes,
            color=drawn.colour,
            lw=1.1,
            label=drawn.label,
        )
    for number, frequency in enumerate(mode_frequencies(before)[:4], start=1):
        axes.axvline(frequency, color=style.REFERENCE, lw=0.6, ls=":")
        axes.annotate(
            f"mode {number}",
            (frequency, 1.0),
            (2.0, -2.0),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            rotation=90,
            va="top",
            fontsize=6.5,
            color=style.OBSERVED,
        )
    highest_frequency = float(spectra[0][0].frequency[-1])
    axes.set(yscale="log", xlim=(0.0, highest_frequency), xlabel="frequency, Hz")
    title = f"residuals of {worst.channel}, all dynamic trials"
    axes.set(ylabel="power / white noise", title=title)
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, 0.1), max(high, 10.0))
    axes.legend(**ABOVE, ncol=2)
    return figure


def _draw_noise_spectrum(axes: Axes, noise: NoiseRecord | None) -> None:
    """Draw the spectrum of a noise record over that of white noise; it needs 32 samples."""
    if noise is None or noise.samples is None or not noise.interval or len(noise.samples) < 32:
        return
    standardised = noise.samples / noise.standard_deviation
    segment = min(len(noise.samples), 128)
    frequency, power = welch(standardised, 1.0 / noise.interval, nperseg=segment)
    # one-sided density of white noise of unit variance: 2 interval
    power = power[1:] * 0.5 / noise.interval
    axes.plot(frequency[1:], power, color=style.OBSERVED, lw=0.8, alpha=0.6, label="noise record")


class _Spectrum(NamedTuple):
    """A spectrum of residuals: frequencies (F,) [Hz], and power (F,) over that of white noise."""

    frequency: FloatArray
    power: FloatArray


def _mean_spectrum(residuals: ResidualSet, channel: str) -> _Spectrum | None:
    """Return the mean spectrum of a channel's residuals over the dynamic trials.

    Trials of different lengths have spectra at different frequencies; only the largest group of
    trials with equal frequencies is averaged. The result is None if no trial has 32 samples.
    """
    groups: dict[float, list[_Spectrum]] = {}
    for fitted, column, _ in channel_fits(residuals.trials, channel):
        if not fitted.trial.is_dynamic or len(fitted.trial.time) < 32:
            continue
        # Welch's estimate of the power; white noise of variance 1 has the power 1 at each frequency
        interval = fitted.trial.interval
        series = np.nan_to_num(fitted.standardised[:, column])
        segment_length = min(len(series), 512)
        frequency, power = welch(series, 1.0 / interval, nperseg=segment_length, detrend="constant")
        resolution = round(interval * len(frequency), 9)
        spectrum = _Spectrum(frequency[1:], power[1:] * 0.5 / interval)
        groups.setdefault(resolution, []).append(spectrum)
    if not groups:
        return None
    largest_group = max(groups.values(), key=len)
    mean_power = np.mean([spectrum.power for spectrum in largest_group], axis=0)
    return _Spectrum(largest_group[0].frequency, mean_power)


def mode_frequencies(residuals: ResidualSet) -> tuple[float, ...]:
    """Return the frequencies [Hz] at which predictions ring, lowest first."""
    dynamic_trials = [fitted for fitted in residuals.trials if fitted.trial.is_dynamic]
    return predicted_frequencies(dynamic_trials) if dynamic_trials else ()


# ---------------------------------------------------------------- backbones


def backbone_figure(before: ResidualSet, after: ResidualSet | None) -> tuple[Figure, str] | None:
    """Draw frequency and damping ratio of the ring-downs over the amplitude (the backbone curves).

    Parameters
    ----------
    before, after : ResidualSet or None
        Residuals of the unchanged model, and with the effect.

    Returns
    -------
    (Figure, str) or None
        The figure and its channel; None if no record is long enough, or no mode rings long enough.
    """
    frequencies = mode_frequencies(before if after is None else after)[:MOST_MODES]
    ringdowns = [fitted for fitted in before.trials if fitted.trial.kind is TrialKind.RINGDOWN]
    worst = worst_record(ringdowns)
    if worst is None or not frequencies:
        return None
    channel = worst.channel
    measured = _backbones_by_mode(before, channel, frequencies, measured=True)
    curves = []
    for drawn in models_to_draw(before, after):
        curves.append((drawn, _backbones_by_mode(drawn.residuals, channel, frequencies)))
    modes = [
        mode for mode in sorted(measured) if np.isfinite(measured[mode].time).sum() >= LEAST_POINTS
    ][:2]
    if not modes:
        return None
    factor, unit = UNITS[before.channels[channel].quantity].drawn
    figure, grid = new_panels(len(modes), 2, 2.3 * len(modes) + 0.3)
    letters = iter("abcd")
    for row, mode in zip(grid, modes, strict=True):
        curves_of_mode = [(drawn, curve[mode]) for drawn, curve in curves if mode in curve]
        for axes, (name, label, scale) in zip(row, _BACKBONE_VALUES, strict=True):
            _draw_backbone(axes, measured[mode], curves_of_mode, name, factor, scale)
            axes.set(
                xscale="log",
                title=f"{next(letters)}  mode {mode}",
                xlabel=f"amplitude of {channel}, {unit}",
                ylabel=label,
            )
            style.plain_powers(axes.xaxis, (1.0, 2.0, 5.0))
            _limit_to_measured(axes, scale * getattr(measured[mode], name))
    grid[0][1].legend(loc="best")
    return figure, channel


_BACKBONE_VALUES = (
    ("frequency", "frequency, Hz", 1.0),
    ("damping_ratio", "damping ratio, %", 100.0),
)
"""Entries of a backbone that are drawn: their name, label, and factor to the unit of the label."""


def _draw_backbone(
    axes: Axes,
    measured: Backbone,
    curves: Sequence[tuple[DrawnModel, Backbone]],
    name: str,
    factor: float,
    scale: float,
) -> None:
    """Draw frequency or damping ratio of a mode over its amplitude, predicted and measured.

    Parameters
    ----------
    axes : Axes
        The axes to draw on.
    measured : Backbone
        The measured backbone.
    curves : sequence of (DrawnModel, Backbone)
        Models and their predicted backbones.
    name : str
        "frequency" or "damping_ratio".
    factor, scale : float
        Factors from the amplitude, and from the drawn value, to the units of the figure.
    """
    for drawn, curve in curves:
        axes.plot(
            factor * curve.amplitude,
            scale * getattr(curve, name),
            color=drawn.colour,
            ls=drawn.dashes,
            lw=1.1,
            alpha=0.8,
            label=drawn.label,
        )
    axes.errorbar(
        factor * measured.amplitude,
        scale * getattr(measured, name),
        scale * getattr(measured, f"{name}_error"),
        fmt="o",
        ms=2.6,
        color=style.OBSERVED,
        lw=0.0,
        elinewidth=0.6,
        alpha=0.85,
        label="measured, ± 1 standard error",
        zorder=3,
    )


def _limit_to_measured(axes: Axes, values: FloatArray) -> None:
    """Limit the vertical axis to the range of the measured values, with a margin."""
    low, high = np.nanquantile(values, (0.02, 0.98))  # without single outliers
    margin = 1.2 * max(float(high - low), 0.02 * abs(float(np.nanmedian(values))))
    bottom, top = axes.get_ylim()
    axes.set_ylim(max(bottom, low - margin), min(top, high + margin))


def _backbones_by_mode(
    residuals: ResidualSet, channel: str, frequencies: Sequence[float], *, measured: bool = False
) -> dict[int, Backbone]:
    """Return the backbone curve of each mode: frequency and damping over amplitude.

    Points with large errors are left out. The points of different ring-downs are separated by NaN,
    so that no line connects them.

    Parameters
    ----------
    frequencies : sequence of float
        The frequencies of the modes, from which their identification starts [Hz].
    measured : bool
        True for curves of the readings, False for curves of the predictions.
    """
    backbones_of_modes: dict[int, list[Backbone]] = {}
    for fitted, column, used in channel_fits(residuals.trials, channel):
        if fitted.trial.kind is not TrialKind.RINGDOWN:
            continue
        noise = float(fitted.noise_deviation[column])
        values = fitted.prediction[:, column]
        if measured:
            values = np.where(used, fitted.trial.values[:, column], values)
        try:
            curves = backbones(fitted.trial.time, values, list(frequencies), noise_deviation=noise)
        except FitError:  # the record is too short
            continue
        for curve in curves:
            if curve.time.size:
                clear_points = _clear_points(curve)
                if clear_points is not None:
                    backbones_of_modes.setdefault(curve.mode, []).append(clear_points)
    return {mode: _join_backbones(mode, parts) for mode, parts in backbones_of_modes.items()}


def _clear_points(curve: Backbone) -> Backbone | None:
    """Return the points of a backbone with small errors, and nan after them.

    None is returned if there is no such point.
    """
    median_ratio = float(np.median(np.abs(curve.damping_ratio)))
    is_clear = curve.damping_ratio_error < LARGEST_ERROR * max(median_ratio, 1e-4)
    if not is_clear.any():
        return None
    arrays = {name: np.r_[getattr(curve, name)[is_clear], np.nan] for name in _ARRAYS}
    return Backbone(mode=curve.mode, **arrays)


def _join_backbones(mode: int, parts: Sequence[Backbone]) -> Backbone:
    """Return the backbones of several ring-downs as one."""
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
    return Backbone(mode=mode, **arrays)
