"""Figures of the gap: residuals on the wing, by channel and trial, over load and time."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from discrepancy.campaign.records import Channel, FloatArray, Quantity
from discrepancy.judgement.closed_share import residuals_with_noise_of
from discrepancy.location.residuals import FittedTrial, ResidualSet, channel_fits
from fe.runtime.wing_rows import strain_gauge
from fe.wing.design import WingDesign
from reporting.pages import figures as style

AFTER = "with the effect"
EMPTY_CELL_COLOUR = "#f0f1f2"
"""Colour of cells of a map that hold nothing."""


class DrawnModel(NamedTuple):
    """Residuals of a model, and how the model is drawn in figures."""

    residuals: ResidualSet
    colour: str
    dashes: str
    marker: str
    label: str
    title: str


def models_to_draw(before: ResidualSet, after: ResidualSet | None) -> list[DrawnModel]:
    """Return the residuals to draw, with style and label: before and, if given, with the effect."""
    was = DrawnModel(before, style.PREDICTION, "--", "o", "model", "unchanged model")
    if after is None:
        return [was]
    was = was._replace(label="unchanged model", title="a  unchanged model")
    with_effect = residuals_with_noise_of(after, before)
    return [was, DrawnModel(with_effect, style.PAST, "-", "D", AFTER, f"b  {AFTER}")]


def new_panels(
    rows: int, columns: int, height: float, **grid: Any
) -> tuple[Figure, list[list[Axes]]]:
    """Return a new figure and its grid of panels.

    Parameters
    ----------
    rows, columns : int
        Numbers of panels.
    height : float
        Height of the figure [in].
    **grid : object
        Further arguments of `matplotlib.figure.Figure.subplots`.
    """
    figure = style.new_figure(height)
    figure.set_layout_engine("constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **grid).tolist()


def draw_noise(axes: Axes, deviation: float, opacity: float) -> None:
    """Draw the band of plus and minus two standard deviations of the noise around zero."""
    axes.axhspan(
        -2.0 * deviation,
        2.0 * deviation,
        color=style.REFERENCE,
        alpha=opacity,
        lw=0.0,
        label="noise, ± 2 s0",
    )


def size_colour_scale(values: Sequence[float] | FloatArray) -> Normalize:
    """Return the logarithmic colour scale of sizes of residuals; 1 (noise) is dark.

    Sizes below the scale have the colour of its end: a window whose readings are all missing has
    the size 0.
    """
    largest = float(np.nanmax(np.asarray(values, dtype=float), initial=1.0))
    return LogNorm(0.7, max(largest, 3.0), clip=True)


def add_size_bar(figure: Figure, norm: Normalize, panels: Sequence[Axes]) -> None:
    """Draw the colour bar of rms residuals to the right of the panels."""
    bar = style.color_bar(
        figure,
        ScalarMappable(norm, style.LEVELS),
        "rms residual / noise",
        ax=panels,
        fraction=0.045,
        pad=0.02,
        aspect=14,
    )
    largest = float(norm.vmax or 1.0)
    style.plain_powers(bar.yaxis, (1.0, 2.0, 5.0) if largest < 50.0 else (1.0,))


def draw_heat_map(
    axes: Axes,
    values: FloatArray,
    names: tuple[Iterable[str], Iterable[str]],
    norm: Normalize,
    slant: float,
    texts: NDArray[np.str_] | None = None,
) -> AxesImage:
    """Draw an array as a heat map, with names at its rows and columns, and texts in its cells.

    Parameters
    ----------
    values : (R, C) ndarray
        Values of the cells; NaN for an empty cell.
    names : (iterable of str, iterable of str)
        Names of the rows and of the columns.
    norm : Normalize
        The colour scale.
    slant : float
        Rotation of the columns' names [deg].
    texts : (R, C) ndarray of str, optional
        Texts of the cells; an empty one is not drawn.
    """
    image = axes.imshow(np.ma.masked_invalid(values), cmap=style.LEVELS, norm=norm, aspect="auto")
    row_names, column_names = map(list, names)
    axes.set_xticks(
        range(len(column_names)), column_names, rotation=slant, ha="right", rotation_mode="anchor"
    )
    axes.set_yticks(range(len(row_names)), row_names)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.set_facecolor(EMPTY_CELL_COLOUR)
    if texts is None:
        return image
    for (row, column), text in np.ndenumerate(texts):
        if text:
            is_dark = float(norm(values[row, column])) < 0.6
            colour = "white" if is_dark else "black"
            axes.text(column, row, text, ha="center", va="center", fontsize=6.0, color=colour)
    return image


_ROW_HEIGHT = 0.22
"""Height of a row of a heat map [in]."""
_LEAST_MAP_HEIGHT = 0.9
"""Least height of a heat map without its names [in]."""
_TITLE_HEIGHT = 0.35
"""Height of the title above a heat map [in]."""
_NAME_SLANT = 40.0
"""Rotation of the names of trials below a heat map [deg]."""
_LETTER_HEIGHT = 0.042
"""Height that each letter of a slanted name takes [in]."""
_MOST_NAME_HEIGHT = 1.5
"""The most height that is left for the names of trials [in]."""
MOST_CELLS = 12
"""Most rows and columns of a heat map whose cells show their numbers."""
GAUGE: dict[str, Any] = {
    "cmap": style.LEVELS,
    "s": 46,
    "edgecolors": "#333333",
    "linewidths": 0.6,
    "zorder": 3,
}
BELOW: dict[str, Any] = {
    "textcoords": "offset points",
    "ha": "center",
    "va": "top",
    "fontsize": 6.5,
}
"""How gauges and their names are drawn on the wing."""


def rms_over_noise(trials: Sequence[FittedTrial], channel: str) -> float:
    """Return the rms residual of a channel in units of its noise; nan if no sample is used."""
    sum_of_squares = 0.0
    count = 0
    for fitted, column, used in channel_fits(trials, channel):
        sum_of_squares += float(np.sum(fitted.standardised[used, column] ** 2))
        count += int(used.sum())
    return float(np.sqrt(sum_of_squares / count)) if count else float("nan")


def rms_table(residuals: ResidualSet) -> tuple[list[str], list[str], FloatArray]:
    """Return the rms residual of each channel in each trial, in standard deviations of the noise.

    Returns
    -------
    channels, trials : list of str
        Names of C channels and T trials; held-out trials are marked.
    rms : (C, T) ndarray
        rms residuals over the noise; NaN if a trial lacks a channel.
    """
    measured = {*residuals.channel_names}
    channels = [name for name in residuals.channels if name in measured]
    trial_names = []
    rms = np.full((len(channels), len(residuals.trials)), np.nan)
    for column, fitted in enumerate(residuals.trials):
        trial = fitted.trial
        is_marked = "held out" in trial.name
        mark = " (held out)" if trial.held_out and not is_marked else ""
        trial_names.append(f"{trial.name}{mark}")
        for row, channel in enumerate(channels):
            rms[row, column] = rms_over_noise([fitted], channel)
    return channels, trial_names, rms


def gauge_places(channels: Sequence[Channel], design: WingDesign) -> dict[str, tuple[float, float]]:
    """Return where channels are drawn on the wing: distance from the root [m] and chord fraction.

    A channel is drawn where it says it is. If it says nothing, it is drawn at its strain gauge in
    the design, or at the tip if it measures the tip displacement. Other channels are left out.
    """
    places: dict[str, tuple[float, float]] = {}
    positions = design.gauges.positions
    for channel in channels:
        gauge = strain_gauge(channel.output)
        if channel.station is not None:
            # a channel without a chord fraction is drawn at 40 % of the chord
            chord_fraction = 0.4 if channel.chord is None else channel.chord
            places[channel.name] = (channel.station, chord_fraction)
        elif 0 <= gauge < len(positions):
            places[channel.name] = positions[gauge]
        elif channel.output == "tip_displacement":
            places[channel.name] = (design.planform.semi_span, design.planform.straight_chord_line)
    return places


def planform_figure(
    before: ResidualSet, after: ResidualSet | None, design: WingDesign
) -> Figure | None:
    """Draw the rms residuals of the channels where they are on the planform of the wing.

    There is one panel for the unchanged model (`before`) and one for the model with the effect
    (`after`), on one colour scale. The result is None if no channel has a position.
    """
    places = gauge_places(list(before.channels.values()), design)
    if not places:
        return None
    drawn_models = models_to_draw(before, after)
    rms_of_models = []
    for drawn in drawn_models:
        rms_of_models.append([rms_over_noise(drawn.residuals.trials, name) for name in places])
    norm = size_colour_scale(np.array(rms_of_models))
    row_count = len(drawn_models)
    figure, grid = new_panels(row_count, 1, 1.62 * row_count + 0.35, sharex=True)
    all_axes = [axes for (axes,) in grid]
    for axes, rms_of_channels, drawn in zip(all_axes, rms_of_models, drawn_models, strict=True):
        _draw_planform(axes, design)
        for (name, place), value in zip(places.items(), rms_of_channels, strict=True):
            if np.isfinite(value):
                position = _planform_position(design, *place)
                is_strain = before.channels[name].quantity is Quantity.STRAIN
                marker = "o" if is_strain else "s"
                axes.scatter(*position, c=[value], norm=norm, marker=marker, **GAUGE)
                axes.annotate(name, position, (0.0, -6.5), **BELOW)
        axes.set(title=drawn.title, ylabel="chord, m")
    all_axes[-1].set_xlabel("distance from the root, m")
    add_size_bar(figure, norm, all_axes)
    return figure


def _planform_position(design: WingDesign, station: float, fraction: float) -> tuple[float, float]:
    """Return the coordinates of a position in the planform.

    The planform is drawn so that the line at the chord fraction `straight_chord_line` is straight
    and runs along the span. A station beyond the tip has the chord of the tip.

    Parameters
    ----------
    station : float
        Distance from the root [m].
    fraction : float
        Chord fraction from the leading edge.

    Returns
    -------
    along_span : float
        The station itself [m].
    along_chord : float
        Distance aft of the leading edge at the root [m].
    """
    form = design.planform
    straight_line_fraction = form.straight_chord_line
    chord = form.chord(min(station / form.semi_span, 1.0))
    behind_straight_line = (fraction - straight_line_fraction) * chord
    return station, straight_line_fraction * form.root_chord + behind_straight_line


def _draw_planform(axes: Axes, design: WingDesign) -> None:
    """Draw the outline of the wing and of its damage regions."""
    form = design.planform
    outline: dict[str, Any] = {"facecolor": "#f4f5f6", "edgecolor": "#8a939c", "lw": 0.8}
    _draw_panel(axes, design, (0.0, form.semi_span), (0.0, 1.0), outline)
    dashed: dict[str, Any] = {"facecolor": "none", "edgecolor": "#b8bec4", "lw": 0.6, "ls": "--"}
    for region in design.defects:
        span = (region.span_start, region.span_end)
        _draw_panel(axes, design, span, (region.chord_start, region.chord_end), dashed)
    axes.set(aspect="equal", xlim=(-0.03 * form.semi_span, 1.06 * form.semi_span))
    axes.set_ylim(1.12 * form.root_chord, -0.12 * form.root_chord)
    axes.yaxis.set_major_locator(MaxNLocator(3))


def _draw_panel(
    axes: Axes,
    design: WingDesign,
    span: tuple[float, float],
    chord: tuple[float, float],
    look: dict[str, Any],
) -> None:
    """Draw a panel of the wing between two distances from the root [m] and two chord fractions."""
    root, tip = span
    front, rear = chord
    corners = ((root, front), (tip, front), (tip, rear), (root, rear))
    positions = [_planform_position(design, station, fraction) for station, fraction in corners]
    axes.fill(*np.transpose(positions), **look)


def heat_figure(before: ResidualSet, after: ResidualSet | None) -> Figure:
    """Draw the rms residuals by channel and trial as heat maps that share one colour scale.

    Parameters
    ----------
    before : ResidualSet
        The residuals of the unchanged model.
    after : ResidualSet or None
        The residuals of the model with the effect that a verdict adds to it. They are drawn in a
        second map, which is absent for None.
    """
    drawn_models = models_to_draw(before, after)
    rms_of_models = []
    for drawn in drawn_models:
        _, _, rms = rms_table(drawn.residuals)
        rms_of_models.append(rms)
    channels, trials, _ = rms_table(before)
    colour_scale = size_colour_scale(np.concatenate([rms.ravel() for rms in rms_of_models]))
    figure, (panels,) = new_panels(1, len(drawn_models), _height_of_heat_map(channels, trials))
    has_texts = len(channels) <= MOST_CELLS and len(trials) <= MOST_CELLS
    for number, (axes, rms, drawn) in enumerate(
        zip(panels, rms_of_models, drawn_models, strict=True)
    ):
        # the channels are named beside the first map only
        row_names = channels if number == 0 else [""] * len(channels)
        texts = _cell_texts(rms) if has_texts else None
        draw_heat_map(axes, rms, (row_names, trials), colour_scale, _NAME_SLANT, texts)
        axes.set_title(drawn.title)
    add_size_bar(figure, colour_scale, panels)
    return figure


def _height_of_heat_map(channels: Sequence[str], trials: Sequence[str]) -> float:
    """Return the height of a heat map with title and names, by its rows and longest name [in]."""
    longest_name = max(len(name) for name in trials)
    name_height = min(_ROW_HEIGHT + _LETTER_HEIGHT * longest_name, _MOST_NAME_HEIGHT)
    map_height = max(_ROW_HEIGHT * len(channels), _LEAST_MAP_HEIGHT)
    return map_height + name_height + _TITLE_HEIGHT


@np.vectorize
def _cell_texts(value: float) -> str:
    """Return the text of a cell for its rms residual; empty for nan."""
    if np.isnan(value):
        return ""
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"
