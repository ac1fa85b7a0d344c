"""Figure of ring-down records: fit, spectra, dependence on the amplitude."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator, ScalarFormatter

from reporting.figures import (
    OBSERVED,
    PAST,
    PREDICTION,
    PRESENT,
    new_figure,
    panel_label,
    publication_style,
)

from .ringdown import RingDownFit, spectrum
from .trials import RingDownTrials, amplitude_dependence


def ring_down_figure(trials: RingDownTrials) -> Figure:
    """Draw the first trial with its two modes, all spectra, and the first mode over its amplitude."""
    with publication_style():
        figure = new_figure(height=4.8)
        grid = figure.add_gridspec(2, 2, wspace=0.26, hspace=0.48)
        figure.subplots_adjust(left=0.075, right=0.985, bottom=0.09, top=0.94)
        _draw_record(figure.add_subplot(grid[0, 0]), trials.fits[0])
        _draw_spectra(figure.add_subplot(grid[0, 1]), trials)
        frequency, damping = (figure.add_subplot(grid[1, column]) for column in (0, 1))
        _draw_amplitudes(frequency, damping, trials)
    return figure


def _draw_record(axes: Axes, fit: RingDownFit) -> None:
    time = fit.record.time
    axes.plot(time, fit.record.signal * 1e3, ".", color=OBSERVED, ms=2.2, label="measured")
    axes.plot(time, fit.fitted * 1e3, color=PAST, lw=0.9, label="two modes")
    for mode, colour, style in zip(fit.modes, (PRESENT, PREDICTION), ("--", ":"), strict=True):
        envelope = mode.amplitude * np.exp(mode.pole.real * (time - time[0])) * 1e3
        label = f"envelope, {mode.frequency:.2f} Hz"
        axes.plot(time, envelope, color=colour, lw=0.9, ls=style, label=label)
    axes.set_xlim(0.0, min(2.0, float(time[-1])))
    axes.set_xlabel("time (s)")
    axes.set_ylabel("strain signal (mV)")
    axes.legend(loc="upper right", fontsize=6.8)
    panel_label(axes, "a", "First trial")


def _draw_spectra(axes: Axes, trials: RingDownTrials) -> None:
    top = 0.0
    for number, fit in enumerate(trials.fits):
        frequency, amplitude = spectrum(fit.record)
        top = max(top, 1e3 * float(amplitude.max()))
        label = f"{len(trials.fits)} trials" if number == 0 else None
        axes.semilogy(frequency, amplitude * 1e3, color=OBSERVED, lw=0.5, alpha=0.6, label=label)
    for mode, name in ((0, "first"), (1, "second")):
        axes.axvline(
            trials.frequency(mode).mean, color=PAST, lw=0.8, ls=("--", ":")[mode], label=f"{name} mode"
        )
    axes.set_xlim(0.0, float(frequency[-1]))
    axes.set_ylim(2e-4 * top, 2.0 * top)
    axes.set_xlabel("frequency (Hz)")
    axes.set_ylabel("amplitude (mV)")
    axes.legend(loc="upper right", fontsize=6.8)
    panel_label(axes, "b", "Spectra")


def _draw_amplitudes(frequency: Axes, damping: Axes, trials: RingDownTrials) -> None:
    for fit in trials.fits:
        points = amplitude_dependence(fit)
        amplitude = [point.amplitude * 1e3 for point in points]
        frequency.semilogx(amplitude, [point.frequency for point in points], "o", color=OBSERVED, ms=2.4)
        damping.semilogx(
            amplitude, [point.damping_ratio * 100.0 for point in points], "o", color=OBSERVED, ms=2.4
        )
    for axes, averaged, scale in (
        (frequency, trials.frequency(0), 1.0),
        (damping, trials.damping_ratio(0), 100.0),
    ):
        axes.axhline(averaged.mean * scale, color=PAST, lw=1.0, label="whole record")
        axes.set_xlabel("amplitude of the first mode (mV)")
        axes.xaxis.set_major_formatter(ScalarFormatter())
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_minor_locator(NullLocator())
    frequency.legend(loc="upper right")
    damping.legend(loc="lower right")
    frequency.set_ylabel("natural frequency (Hz)")
    damping.set_ylabel("damping ratio (%)")
    panel_label(frequency, "c", "First mode within windows of 0.8 s")
    panel_label(damping, "d", "Its damping")
