"""Figure of ring-down records: fit, spectra, dependence on the amplitude."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from reporting.pages import figures as style

from .damped_cosine import RingDownMode
from .trials import Fits, ModalQuantity, RingDownFit, amplitude_dependence, average, spectrum

_MILLIVOLTS_PER_VOLT = 1e3


class _AmplitudePanel(NamedTuple):
    """A panel that shows a quantity of the first mode over its amplitude."""

    axes: Axes
    quantity: ModalQuantity
    scale: float
    ylabel: str
    letter: str
    title: str


@style.publication_style()
def ring_down_figure(trials: Fits) -> Figure:
    """Draw the fitted ring-down trials in four panels.

    They show the first trial with its two modes, the spectra of all trials, and natural frequency
    and damping ratio of the first mode over its amplitude.
    """
    figure, (upper, lower) = style.panels(
        rows=2, columns=2, height=4.8, top=0.29, bottom=0.43, left=0.075, wspace=0.26, hspace=0.48
    )
    _draw_record(upper[0], trials[0])
    _draw_spectra(upper[1], trials)
    windows = [window for fit in trials for window in amplitude_dependence(fit)]
    frequency_panel = _AmplitudePanel(
        axes=lower[0],
        quantity="frequency",
        scale=1.0,
        ylabel="natural frequency (Hz)",
        letter="c",
        title="First mode within windows of 0.8 s",
    )
    damping_panel = _AmplitudePanel(
        axes=lower[1],
        quantity="damping_ratio",
        scale=100.0,  # to per cent
        ylabel="damping ratio (%)",
        letter="d",
        title="Its damping",
    )
    for panel in (frequency_panel, damping_panel):
        mean_over_trials = average(trials, panel.quantity, mode=0).mean
        _draw_amplitude_dependence(panel, windows, mean_over_trials)
    return figure


def _draw_amplitude_dependence(
    panel: _AmplitudePanel, windows: list[RingDownMode], mean: float
) -> None:
    """Draw a modal value of the windows over their amplitudes, and its mean over records."""
    axes = panel.axes
    amplitudes = [window.amplitude * _MILLIVOLTS_PER_VOLT for window in windows]
    values = [panel.scale * getattr(window, panel.quantity) for window in windows]
    axes.semilogx(amplitudes, values, "o", color=style.OBSERVED, ms=2.4)
    axes.axhline(panel.scale * mean, color=style.PAST, lw=1.0, label="whole record")
    axes.set(xlabel="amplitude of the first mode (mV)", ylabel=panel.ylabel)
    style.plain_powers(axes.xaxis, (1.0, 2.0, 5.0))
    axes.legend(loc="best")
    style.panel_label(axes, panel.letter, panel.title)


def _draw_record(axes: Axes, fit: RingDownFit) -> None:
    """Draw a measured record, its fit, and the envelopes of the two modes.

    The style names colours by their meaning in most figures; here they only distinguish curves.
    """
    time = fit.record.time
    time_from_start = time - time[0]
    measured_signal = fit.record.signal * _MILLIVOLTS_PER_VOLT
    fitted_signal = fit.fitted * _MILLIVOLTS_PER_VOLT
    axes.plot(time, measured_signal, ".", color=style.OBSERVED, ms=2.2, label="measured")
    axes.plot(time, fitted_signal, color=style.PAST, lw=0.9, label="two modes")
    colours = (style.PRESENT, style.PREDICTION)
    for mode, colour, dashes in zip(fit.modes, colours, ("--", ":"), strict=True):
        decay = np.exp(mode.pole.real * time_from_start)
        envelope = mode.amplitude * decay * _MILLIVOLTS_PER_VOLT
        label = f"envelope, {mode.frequency:.2f} Hz"
        axes.plot(time, envelope, color=colour, lw=0.9, ls=dashes, label=label)
    last_shown_time = min(2.0, float(time[-1]))
    axes.set(xlim=(0.0, last_shown_time), xlabel="time (s)", ylabel="strain signal (mV)")
    axes.legend(loc="upper right", fontsize=6.8)
    style.panel_label(axes, "a", "First trial")


def _draw_spectra(axes: Axes, trials: Fits) -> None:
    """Draw the spectra of all trials and the mean frequencies of the two modes."""
    spectra = [spectrum(fit.record) for fit in trials]
    for number, (frequency, amplitude) in enumerate(spectra):
        label = f"{len(spectra)} trials" if number == 0 else None
        axes.semilogy(
            frequency,
            amplitude * _MILLIVOLTS_PER_VOLT,
            color=style.OBSERVED,
            lw=0.5,
            alpha=0.6,
            label=label,
        )
    for mode, name, dashes in ((0, "first", "--"), (1, "second", ":")):
        mean = average(trials, "frequency", mode).mean
        axes.axvline(mean, color=style.PAST, lw=0.8, ls=dashes, label=f"{name} mode")
    highest = _MILLIVOLTS_PER_VOLT * max(float(amplitude.max()) for _, amplitude in spectra)
    last_frequency, _ = spectra[-1]
    axes.set(xlim=(0.0, float(last_frequency[-1])), ylim=(2e-4 * highest, 2.0 * highest))
    axes.set(xlabel="frequency (Hz)", ylabel="amplitude (mV)")
    axes.legend(loc="upper right", fontsize=6.8)
    style.panel_label(axes, "b", "Spectra")
