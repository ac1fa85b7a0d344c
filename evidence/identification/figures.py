"""Figures of the identification: residuals by gauge, singular values, widths, profiles."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from reporting.figures import (
    OBSERVED,
    PAST,
    PREDICTION,
    PRESENT,
    REFERENCE,
    new_figure,
    panel_label,
    publication_style,
)

from .comparison import PERCENT, Outputs
from .identifiability import Identifiability, Profile
from .least_squares import DesignFit
from .targets import LEVELS, Targets

_COLOURS = (OBSERVED, PAST, PRESENT, PREDICTION)


def gauge_figure(found: Outputs, before: Outputs, targets: Targets) -> Figure:
    """Draw residuals by gauge: healthy strains, slopes in e, and ratios of each region at every level."""
    panels = (
        ("a", "healthy strain, %", PERCENT * (found.strain[0, 0] / targets.strain[0, 0] - 1.0),
         PERCENT * (before.strain[0, 0] / targets.strain[0, 0] - 1.0)),
        ("b", "slope in e", found.strain_slope - targets.strain_slope,
         before.strain_slope - targets.strain_slope),
    )  # fmt: skip
    with publication_style():
        figure = new_figure(height=4.6)
        axes = figure.subplots(2, 2)
        figure.subplots_adjust(left=0.075, right=0.985, bottom=0.09, top=0.94, hspace=0.5, wspace=0.25)
        for place, (label, title, after, start) in zip(axes[0], panels, strict=True):
            _zero(place, label, title)
            place.plot(_numbers(start), start, "o", color=REFERENCE, markerfacecolor="none", label="start")
            place.plot(_numbers(after), after, "o", color=PAST, label="identified")
            place.legend(loc="upper right", ncols=2)
        for place, label, region, index in ((axes[1, 0], "c", "z1", 0), (axes[1, 1], "d", "z2", 1)):
            _zero(place, label, f"ratio under {region}, points")
            for number, level in enumerate(LEVELS[1:], start=1):
                state = (number, 0) if index == 0 else (0, number)
                held = number % 2 == 1
                points = PERCENT * (found.ratio - targets.ratio)[state]
                place.plot(
                    _numbers(points),
                    points,
                    "o",
                    color=_COLOURS[number - 1],
                    markerfacecolor="none" if held else None,
                    label=f"{PERCENT * level:.0f} %" + (" (held out)" if held else ""),
                )
            place.legend(loc="upper right", ncols=2)
    return figure


def _numbers(values: NDArray[np.float64]) -> range:
    """Return the numbers of the gauges, from 1."""
    return range(1, len(values) + 1)


def _zero(axes: Axes, label: str, title: str) -> None:
    panel_label(axes, label, title)
    axes.axhline(0.0, color=REFERENCE, linewidth=0.7)
    axes.set_xlabel("gauge")
    axes.margins(y=0.3)


def identifiability_figure(fit: DesignFit, analysis: Identifiability) -> Figure:
    """Draw the singular values, and what is left of each parameter's prior width."""
    with publication_style():
        figure = new_figure(height=5.2)
        left, right = figure.subplots(1, 2)
        figure.subplots_adjust(left=0.075, right=0.985, bottom=0.08, top=0.95, wspace=0.85)
        left.semilogy(
            np.arange(1, len(analysis.singular_values) + 1), analysis.singular_values, "o", color=PAST
        )
        left.axhline(1.0, color=REFERENCE, linewidth=0.7)
        left.set_xlabel("direction")
        panel_label(left, "a", "singular values of the weighted derivatives")
        places = np.arange(len(analysis.names))[::-1]
        right.barh(places, analysis.width, color=PAST, height=0.6)
        right.axvline(1.0, color=REFERENCE, linewidth=0.7)
        right.set_yticks(places, analysis.names, fontsize=6)
        right.set_ylim(-0.7, len(places) - 0.3)
        right.set_xlabel("width after / before")
        right.set_title("b  what the data leave open", loc="left", x=-0.75)
    return figure


def profile_figure(profiles: Sequence[Profile]) -> Figure:
    """Draw the rise of the objective along named parameters: others fitted again, and linear."""
    with publication_style():
        figure = new_figure(height=2.3)
        axes = np.atleast_1d(figure.subplots(1, len(profiles)))
        figure.subplots_adjust(left=0.06, right=0.985, bottom=0.2, top=0.88, wspace=0.35)
        for number, (place, profile) in enumerate(zip(axes, profiles, strict=True)):
            panel_label(place, "abcdefgh"[number], profile.name)
            place.plot(profile.value, profile.linear, color=REFERENCE, label="linear")
            place.plot(profile.value, profile.rise, "o-", color=PAST, label="fitted again")
            place.set_xlabel(profile.unit)
            if number == 0:
                place.set_ylabel("objective above the fit")
                place.legend()
    return figure
