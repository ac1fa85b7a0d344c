"""Figure of ring-down records: fit, spectra, dependence on the amplitude."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from reporting import figures as style

from .trials import Fits, ModalFigure, RingDownFit, amplitude_dependence, average, spectrum


@style.publication_style()
def ring_down_figure(trials: Fits) -> Figure:
    """Draw the first trial with its two modes, all spectra, and the first mode over its amplitude."""
    figure, ((record, spectra), lower) = style.panels(
        2, 2, 4.8, 0.29, 0.43, left=0.075, wspace=0.26, hspace=0.48
    )
    _draw_record(record, trials[0])
    _draw_spectra(spectra, trials)
    points = [point for fit in trials for point in amplitude_dependence(fit)]
    amplitude = [point.amplitude * 1e3 for point in points]
    shown: tuple[tuple[Axes, ModalFigure, float, str, str, str], ...] = (
        (lower[0], "frequency", 1.0, "natural frequency (Hz)", "c", "First mode within windows of 0.8 s"),
        (lower[1], "damping_ratio", 100.0, "damping ratio (%)", "d", "Its damping"),
    )
    for axes, name, scale, ylabel, label, title in shown:
        axes.semilogx(
            amplitude, [scale * getattr(point, name) for point in points], "o", color=style.OBSERVED, ms=2.4
        )
        axes.axhline(scale * average(trials, name, 0).mean, color=style.PAST, lw=1.0, label="whole record")
        axes.set(xlabel="amplitude of the first mode (mV)", ylabel=ylabel)
        style.plain_powers(axes.xaxis, (1.0, 2.0, 5.0))
        axes.legend(loc="best")
        style.panel_label(axes, label, title)
    return figure


def _draw_record(axes: Axes, fit: RingDownFit) -> None:
    time = fit.record.time
    axes.plot(time, fit.record.signal * 1e3, ".", color=style.OBSERVED, ms=2.2, label="measured")
    axes.plot(time, fit.fitted * 1e3, color=style.PAST, lw=0.9, label="two modes")
    for mode, colour, dashes in zip(fit.modes, (style.PRESENT, style.PREDICTION), ("--", ":"), strict=True):
        envelope = mode.amplitude * np.exp(mode.pole.real * (time - time[0])) * 1e3
        label = f"envelope, {mode.frequency:.2f} Hz"
        axes.plot(time, envelope, color=colour, lw=0.9, ls=dashes, label=label)
    axes.set(xlim=(0.0, min(2.0, float(time[-1]))), xlabel="time (s)", ylabel="strain signal (mV)")
    axes.legend(loc="upper right", fontsize=6.8)
    style.panel_label(axes, "a", "First trial")


def _draw_spectra(axes: Axes, trials: Fits) -> None:
    spectra = [spectrum(fit.record) for fit in trials]
    for number, (frequency, amplitude) in enumerate(spectra):
        label = f"{len(spectra)} trials" if number == 0 else None
        axes.semilogy(frequency, amplitude * 1e3, color=style.OBSERVED, lw=0.5, alpha=0.6, label=label)
    for mode, name, dashes in ((0, "first", "--"), (1, "second", ":")):
        axes.axvline(
            average(trials, "frequency", mode).mean, color=style.PAST, lw=0.8, ls=dashes, label=f"{name} mode"
        )
    top = 1e3 * max(float(amplitude.max()) for _, amplitude in spectra)
    axes.set(xlim=(0.0, float(spectra[-1][0][-1])), ylim=(2e-4 * top, 2.0 * top))
    axes.set(xlabel="frequency (Hz)", ylabel="amplitude (mV)")
    axes.legend(loc="upper right", fontsize=6.8)
    style.panel_label(axes, "b", "Spectra")
