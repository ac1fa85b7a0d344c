"""Figures of the identification: residuals by gauge, singular values, widths, profiles."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from reporting.pages.figures import (
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
from .targets import FITTED_LEVELS, LEVELS, NO_LOSS, Targets

FloatArray = NDArray[np.float64]

_COLOURS = (OBSERVED, PAST, PRESENT, PREDICTION)


class _GaugeResiduals(NamedTuple):
    """Residuals of one quantity by gauge, at the start and after the fit; arrays (G,)."""

    title: str
    at_start: FloatArray
    identified: FloatArray


def gauge_figure(outputs: Outputs, outputs_at_start: Outputs, targets: Targets) -> Figure:
    """Draw the residuals of healthy strains, slopes in e and strain ratios by gauge.

    Parameters
    ----------
    outputs, outputs_at_start : Outputs
        Outputs of the identified wing, and of the start.
    targets : Targets
        Published outputs.
    """
    with publication_style():
        figure = new_figure(height=4.6)
        (strain_axes, slope_axes), (first_region_axes, second_region_axes) = figure.subplots(2, 2)
        figure.subplots_adjust(
            left=0.075, right=0.985, bottom=0.09, top=0.94, hspace=0.5, wspace=0.25
        )
        strain_residuals = _GaugeResiduals(
            title="healthy strain, %",
            at_start=PERCENT * (outputs_at_start.healthy_strain / targets.healthy_strain - 1.0),
            identified=PERCENT * (outputs.healthy_strain / targets.healthy_strain - 1.0),
        )
        slope_residuals = _GaugeResiduals(
            title="slope in e",
            at_start=outputs_at_start.strain_slope - targets.strain_slope,
            identified=outputs.strain_slope - targets.strain_slope,
        )
        _draw_before_and_after(strain_axes, "a", strain_residuals)
        _draw_before_and_after(slope_axes, "b", slope_residuals)
        points = PERCENT * (outputs.ratio - targets.ratio)
        _draw_region(first_region_axes, "c", "z1", points[:, NO_LOSS])
        _draw_region(second_region_axes, "d", "z2", points[NO_LOSS])
    return figure


def _draw_before_and_after(axes: Axes, label: str, residuals: _GaugeResiduals) -> None:
    """Draw the residuals of one quantity by gauge, at the start and after the fit."""
    _prepare_gauge_axes(axes, label, residuals.title)
    axes.plot(
        _gauge_numbers(residuals.at_start),
        residuals.at_start,
        "o",
        color=REFERENCE,
        markerfacecolor="none",
        label="start",
    )
    axes.plot(
        _gauge_numbers(residuals.identified),
        residuals.identified,
        "o",
        color=PAST,
        label="identified",
    )
    axes.legend(loc="upper right", ncols=2)


def _draw_region(axes: Axes, label: str, region: str, points: FloatArray) -> None:
    """Draw the residuals of the strain ratios under losses of one region.

    Parameters
    ----------
    axes : Axes
        Axes to draw on.
    label : str
        Letter of the panel.
    region : str
        Name of the region.
    points : (5, G) array
        Residuals [percentage points] at each of `targets.LEVELS`.
    """
    _prepare_gauge_axes(axes, label, f"ratio under {region}, points")
    damaged_levels = zip(LEVELS[1:], points[1:], _COLOURS, strict=True)
    for level, points_at_level, colour in damaged_levels:
        held_out = level not in FITTED_LEVELS
        remark = " (held out)" if held_out else ""
        axes.plot(
            _gauge_numbers(points_at_level),
            points_at_level,
            "o",
            color=colour,
            markerfacecolor="none" if held_out else None,
            label=f"{PERCENT * level:.0f} %{remark}",
        )
    axes.legend(loc="upper right", ncols=2)


def _gauge_numbers(values: FloatArray) -> range:
    """Return the numbers of the gauges, from 1, given a value for each."""
    return range(1, len(values) + 1)


def _prepare_gauge_axes(axes: Axes, label: str, title: str) -> None:
    """Give axes over gauges a label, a title and a line at zero."""
    panel_label(axes, label, title)
    axes.axhline(0.0, color=REFERENCE, linewidth=0.7)
    axes.set_xlabel("gauge")
    axes.margins(y=0.3)


def identifiability_figure(fit: DesignFit, analysis: Identifiability) -> Figure:
    """Draw the singular values, and the width of each parameter after the fit over that before."""
    with publication_style():
        figure = new_figure(height=5.2)
        singular_axes, width_axes = figure.subplots(1, 2)
        figure.subplots_adjust(left=0.075, right=0.985, bottom=0.08, top=0.95, wspace=0.85)

        directions = np.arange(1, len(analysis.singular_values) + 1)
        singular_axes.semilogy(directions, analysis.singular_values, "o", color=PAST)
        singular_axes.axhline(1.0, color=REFERENCE, linewidth=0.7)
        singular_axes.set_xlabel("direction")
        panel_label(singular_axes, "a", "singular values of the weighted derivatives")

        heights = np.arange(len(analysis.names))[::-1]
        width_axes.barh(heights, analysis.width, color=PAST, height=0.6)
        width_axes.axvline(1.0, color=REFERENCE, linewidth=0.7)
        width_axes.set_yticks(heights, analysis.names, fontsize=6)
        width_axes.set_ylim(-0.7, len(heights) - 0.3)
        width_axes.set_xlabel("width after / before")
        width_axes.set_title("b  what the data leave open", loc="left", x=-0.75)
    return figure


def profile_figure(profiles: Sequence[Profile]) -> Figure:
    """Draw the rise of the objective along parameters: with the others fitted again, and linear."""
    with publication_style():
        figure = new_figure(height=2.3)
        all_axes = np.atleast_1d(figure.subplots(1, len(profiles)))
        figure.subplots_adjust(left=0.06, right=0.985, bottom=0.2, top=0.88, wspace=0.35)
        for number, (axes, profile) in enumerate(zip(all_axes, profiles, strict=True)):
            panel_label(axes, "abcdefgh"[number], profile.name)
            axes.plot(profile.value, profile.linear, color=REFERENCE, label="linear")
            axes.plot(profile.value, profile.rise, "o-", color=PAST, label="fitted again")
            axes.set_xlabel(profile.unit)
            if number == 0:
                axes.set_ylabel("objective above the fit")
                axes.legend()
    return figure
