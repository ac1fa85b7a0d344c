"""Where and when the gap is: residuals on the wing, by channel and trial, over the load, and in time."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from discrepancy.campaign.records import Channel, FloatArray, Quantity, TrialKind
from discrepancy.campaign.units import UNITS
from discrepancy.judgement.closed_share import with_noise_of
from discrepancy.location.residuals import FittedTrial, ResidualSet, of_channel
from discrepancy.verdict import GapWindow
from fe.runtime.wing_rows import strain_gauge
from fe.wing.design import WingDesign
from reporting import figures as style

AFTER = "with the effect"
EMPTY = "#f0f1f2"
"""Colour of cells of a map that hold nothing."""


class Shown(NamedTuple):
    """Residuals of a model, and how it is drawn."""

    residuals: ResidualSet
    colour: str
    dashes: str
    marker: str
    label: str
    title: str


def models(before: ResidualSet, after: ResidualSet | None) -> list[Shown]:
    """Return the model as it was and, where there is one, with the effect."""
    if after is None:
        return [Shown(before, style.PREDICTION, "--", "o", "model", "model as it is")]
    after = with_noise_of(after, before)
    return [
        Shown(before, style.PREDICTION, "--", "o", "model as it was", "a  model as it was"),
        Shown(after, style.PAST, "-", "D", AFTER, f"b  {AFTER}"),
    ]


def panels(rows: int, columns: int, height: float, **grid: Any) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure of a height [in] and its panels; `grid` as of `matplotlib.figure.Figure.subplots`."""
    figure = style.new_figure(height)
    figure.set_layout_engine("constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **grid).tolist()


def draw_noise(axes: Axes, deviation: float, opacity: float) -> None:
    """Draw the band of two deviations of the noise."""
    axes.axhspan(
        -2.0 * deviation, 2.0 * deviation, color=style.REFERENCE, alpha=opacity, lw=0.0, label="noise, ± 2 s0"
    )


def scale_of(values: Sequence[float] | FloatArray) -> Normalize:
    """Return the colour scale of sizes of residuals: logarithmic, with 1 (noise) near its dark end.

    Sizes below the scale have the colour of its end: a window whose readings are all missing has the size 0.
    """
    found = np.asarray(values, dtype=float)
    largest = float(np.nanmax(found, initial=1.0))
    return LogNorm(0.7, max(largest, 3.0), clip=True)


def size_bar(figure: Figure, norm: Normalize, beside: Sequence[Axes]) -> None:
    """Draw the colour scale of sizes of residuals beside panels."""
    place = {"ax": beside, "fraction": 0.045, "pad": 0.02, "aspect": 14}
    bar = style.color_bar(figure, ScalarMappable(norm, style.LEVELS), "rms residual / noise", **place)
    style.plain_powers(bar.yaxis, (1.0, 2.0, 5.0) if float(norm.vmax or 1.0) < 50.0 else (1.0,))


def heat_map(
    axes: Axes,
    values: FloatArray,
    names: tuple[Iterable[str], Iterable[str]],
    norm: Normalize,
    slant: float,
    texts: NDArray[Any] | None = None,
) -> AxesImage:
    """Draw values (R, C), nan where a cell is empty, with names of rows and columns, and what cells say."""
    image = axes.imshow(np.ma.masked_invalid(values), cmap=style.LEVELS, norm=norm, aspect="auto")
    rows, columns = map(list, names)
    axes.set_xticks(range(len(columns)), columns, rotation=slant, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(rows)), rows)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.set_facecolor(EMPTY)
    for (row, column), text in np.ndenumerate([] if texts is None else texts):
        if text:
            dark = float(norm(values[row, column])) < 0.6
            colour = "white" if dark else "black"
            axes.text(column, row, text, ha="center", va="center", fontsize=6.0, color=colour)
    return image


MOST_RECORDS = 12
"""Records that are drawn; those with the largest gaps go first."""
LONGEST_NAME = 26
MOST_CELLS = 12
"""Rows or columns up to which a heat map has its numbers written in."""
GAUGE: dict[str, Any] = {
    "cmap": style.LEVELS,
    "s": 46,
    "edgecolors": "#333333",
    "linewidths": 0.6,
    "zorder": 3,
}
BELOW: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "va": "top", "fontsize": 6.5}
"""How gauges and their names are drawn on the wing."""


def size(trials: Sequence[FittedTrial], channel: str) -> float:
    """Return the rms residual of a channel over the noise; nan where no sample counts."""
    total, count = 0.0, 0
    for item, column, used in of_channel(trials, channel):
        total += float(np.sum(item.standardised[used, column] ** 2))
        count += int(used.sum())
    return float(np.sqrt(total / count)) if count else float("nan")


def size_table(residuals: ResidualSet) -> tuple[list[str], list[str], FloatArray]:
    """Return channels (C), trials (T), and the sizes (C, T) of the residuals; nan where there is none."""
    items = residuals.trials
    channels = [name for name in residuals.channels if any(name in item.trial.channels for item in items)]
    names = [
        f"{trial.name} (held out)" if trial.held_out and "held out" not in trial.name else trial.name
        for trial in (item.trial for item in items)
    ]
    return channels, names, np.array([[size([item], name) for item in items] for name in channels])


def gauge_places(channels: Sequence[Channel], design: WingDesign) -> dict[str, tuple[float, float]]:
    """Return (distance from the root [m], chord fraction) of the channels that have a place on the wing."""
    places: dict[str, tuple[float, float]] = {}
    positions = design.gauges.positions
    for channel in channels:
        gauge = strain_gauge(channel.output)
        if channel.station is not None:
            places[channel.name] = (channel.station, 0.4 if channel.chord is None else channel.chord)
        elif 0 <= gauge < len(positions):
            places[channel.name] = positions[gauge]
        elif channel.output == "tip_displacement":
            places[channel.name] = (design.planform.semi_span, design.planform.straight_chord_line)
    return places


def planform_figure(before: ResidualSet, after: ResidualSet | None, design: WingDesign) -> Figure | None:
    """Draw the sizes of the residuals on the planform, before and after at one scale; None without places."""
    places = gauge_places(list(before.channels.values()), design)
    shown = models(before, after)
    sizes = [[size(item.residuals.trials, name) for name in places] for item in shown]
    if not places:
        return None
    norm = scale_of(np.array(sizes))
    strain = [before.channels[name].quantity is Quantity.STRAIN for name in places]
    figure, rows = panels(len(sizes), 1, 1.62 * len(sizes) + 0.35, sharex=True)
    for (axes,), row, item in zip(rows, sizes, shown, strict=True):
        _draw_planform(axes, design)
        for name, is_strain, value in zip(places, strain, row, strict=True):
            if np.isfinite(value):
                place = _depth(design, *places[name])
                marker = "o" if is_strain else "s"
                axes.scatter(*place, c=[value], norm=norm, marker=marker, **GAUGE)
                axes.annotate(name, place, (0.0, -6.5), **BELOW)
        axes.set(title=item.title, ylabel="chord, m")
    rows[-1][0].set_xlabel("distance from the root, m")
    size_bar(figure, norm, [axes for (axes,) in rows])
    return figure


def _depth(design: WingDesign, station: float, fraction: float) -> tuple[float, float]:
    """Return the distance of a place from the root, and how far it is behind the root's leading edge [m]."""
    form = design.planform
    behind = (fraction - form.straight_chord_line) * form.chord(min(station / form.semi_span, 1.0))
    return station, form.straight_chord_line * form.root_chord + behind


def _draw_planform(axes: Axes, design: WingDesign) -> None:
    form = design.planform
    wing: dict[str, Any] = {"facecolor": "#f4f5f6", "edgecolor": "#8a939c", "lw": 0.8}
    region: dict[str, Any] = {"facecolor": "none", "edgecolor": "#b8bec4", "lw": 0.6, "ls": "--"}
    boxes = [((0.0, form.semi_span), (0.0, 1.0), wing)]
    boxes += [((d.span_start, d.span_end), (d.chord_start, d.chord_end), region) for d in design.defects]
    for (root, tip), (front, rear), look in boxes:
        corners = ((root, front), (tip, front), (tip, rear), (root, rear))
        axes.fill(*np.transpose([_depth(design, *place) for place in corners]), **look)
    axes.set(aspect="equal", xlim=(-0.03 * form.semi_span, 1.06 * form.semi_span))
    axes.set_ylim(1.12 * form.root_chord, -0.12 * form.root_chord)
    axes.yaxis.set_major_locator(MaxNLocator(3))


def heat_figure(before: ResidualSet, after: ResidualSet | None) -> Figure:
    """Draw the sizes of the residuals by channel and trial, before and after at one scale."""
    shown = models(before, after)
    tables = [size_table(item.residuals) for item in shown]
    channels, trials, _ = tables[0]
    norm = scale_of(np.concatenate([table.ravel() for _, _, table in tables]))
    below = min(0.22 + 0.042 * max(len(name) for name in trials), 1.5)
    height = max(0.22 * len(channels), 0.9) + below + 0.35
    figure, (row,) = panels(1, len(tables), height)
    few = len(channels) <= MOST_CELLS and len(trials) <= MOST_CELLS
    for number, (axes, (_, _, table), item) in enumerate(zip(row, tables, shown, strict=True)):
        names = ([""] * len(channels) if number else channels, trials)
        heat_map(axes, table, names, norm, 40, _cells(table) if few else None)
        axes.set_title(item.title)
    size_bar(figure, norm, row)
    return figure


@np.vectorize
def _cells(value: float) -> str:
    """Return what a cell says of a size."""
    return "" if np.isnan(value) else f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


def load_figure(before: ResidualSet, after: ResidualSet | None) -> Figure | None:
    """Draw residuals of static trials and flights over the load, by quantity; None without such trials."""
    found = []
    for kind, label in ((TrialKind.STATIC, "force, N"), (TrialKind.FLIGHT, "load factor")):
        measured = {name for i in before.trials if i.trial.kind is kind for name in i.trial.channels}
        for quantity in Quantity:
            channels = before.channels.items()
            names = [name for name, item in channels if item.quantity is quantity and name in measured]
            found += [(kind, label, quantity, names)] if names else []
    if not found:
        return None
    found = found[:4]
    columns = min(len(found), 2)
    rows = (len(found) + columns - 1) // columns
    figure, grid = panels(rows, columns, 2.25 * rows + 0.3)
    cells = style.keep_first_panels(grid, len(found))
    for number, (axes, (kind, label, quantity, names)) in enumerate(zip(cells, found, strict=True)):
        factor, unit = UNITS[quantity].drawn
        noise, *_ = [_draw_loads(axes, item, kind, names, factor) for item in models(before, after)]
        draw_noise(axes, noise, 0.25)
        axes.axhline(0.0, color=style.OBSERVED, lw=0.6)
        title = f"{'abcd'[number]}  {kind.value}, {quantity.value}"
        axes.set(xlabel=label, ylabel=f"residual, {unit}", title=title)
    figure.legend(*cells[0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return figure


def _draw_loads(axes: Axes, shown: Shown, kind: TrialKind, names: Sequence[str], factor: float) -> float:
    """Draw the residuals of a model, and return the largest deviation of the noise."""
    noise, label = 0.0, shown.label
    shift = 0.0 if shown.marker == "o" else 0.006
    for item in shown.residuals.trials:
        if item.trial.kind is not kind:
            continue
        load = item.trial.load
        wide = float(np.ptp(load)) or 1.0
        for name in (name for name in names if name in item.trial.channels):
            column = item.column(name)
            used = item.used[:, column]
            noise = max(noise, factor * float(item.noise_deviation[column]))
            axes.plot(
                load[used] + shift * wide, factor * item.residual[used, column], shown.marker, ms=2.8, lw=0.0,
                mfc="none" if item.trial.held_out else shown.colour, mec=shown.colour, mew=0.7, alpha=0.8,
                label=label,
            )  # fmt: skip
            label = "_nolegend_"
    return noise


# ---------------------------------------------------------------- when


def time_line_figure(windows: Sequence[GapWindow]) -> Figure | None:
    """Draw the windows of the records with the largest gaps; None without a window."""
    if not windows:
        return None
    names = dict.fromkeys(window.trial for window in windows)
    sizes = {name: max(window.size for window in windows if window.trial == name) for name in names}
    largest = sorted(names, key=lambda name: -sizes[name])[:MOST_RECORDS]
    trials = [name for name in names if name in largest]
    norm = scale_of([window.size for window in windows])
    both = any(window.with_effect for window in windows)
    figure, ((axes,),) = panels(1, 1, max(0.34 * len(trials), 1.1) + 0.9)
    for row, name in enumerate(trials):
        own = [window for window in windows if window.trial == name]
        _draw_record(axes, row, own, norm, both=both)
    axes.set_yticks(range(len(trials)), [_short(name) for name in trials])
    axes.set_ylim(len(trials) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.set_xlabel("time since the start of the trial, s")
    size_bar(figure, norm, [axes])
    return figure


def _draw_record(axes: Axes, row: int, windows: Sequence[GapWindow], norm: Normalize, *, both: bool) -> None:
    first, last = windows[0].first, windows[0].last
    axes.hlines(
        (row - 0.14, row + 0.2) if both else row, first, last, color=style.REFERENCE, lw=1.0, zorder=1
    )
    for window in windows:
        begin = first if window.begin is None else window.begin.value
        end = last if window.end is None else window.end.value
        low, height = (row + 0.1, 0.2) if window.with_effect else (row - 0.34, 0.4 if both else 0.68)
        colour = colormaps[style.LEVELS](float(norm(window.size)))
        axes.broken_barh(
            [(begin, end - begin)], (low, height), facecolor=colour, edgecolor="#333333", lw=0.5, zorder=2
        )
        middle, cap = low + 0.5 * height, 0.3 * height
        for moment in filter(None, (window.begin, window.end)):
            low, high = moment.low, moment.high
            axes.hlines(middle, low, high, color="white", lw=2.6, zorder=3)
            axes.hlines(middle, low, high, color=style.OBSERVED, lw=1.2, zorder=4)
            axes.vlines([low, high], middle - cap, middle + cap, color=style.OBSERVED, lw=0.9, zorder=4)


def _short(name: str) -> str:
    return name if len(name) <= LONGEST_NAME else f"{name[: LONGEST_NAME - 1]}\N{HORIZONTAL ELLIPSIS}"
