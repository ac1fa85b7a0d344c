"""The time line of the gap: when each record holds one, as the model was and with the effect."""

from collections.abc import Sequence

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from discrepancy.report.kit import scale_of, size_bar
from discrepancy.verdict import GapWindow, Moment
from reporting.figures import LEVELS, OBSERVED, REFERENCE, new_figure, publication_style

MOST_RECORDS = 12
"""Records that are drawn; those with the largest gaps go first."""
LONGEST_NAME = 26


def time_line_figure(windows: Sequence[GapWindow]) -> Figure | None:
    """Draw the windows of the records with the largest gaps; None without a window."""
    if not windows:
        return None
    sizes: dict[str, float] = {}
    for window in windows:
        sizes[window.trial] = max(sizes.get(window.trial, 0.0), window.size)
    largest = set(sorted(sizes, key=lambda name: -sizes[name])[:MOST_RECORDS])
    trials = [name for name in sizes if name in largest]
    norm = scale_of([window.size for window in windows])
    both = any(window.with_effect for window in windows)
    height = 0.34 * len(trials) + 0.9
    with publication_style():
        figure = new_figure(height)
        figure.set_layout_engine("constrained")
        axes = figure.add_subplot()
        for row, name in enumerate(trials):
            own = [window for window in windows if window.trial == name]
            _draw_record(axes, row, own, norm, both=both)
        axes.set_yticks(range(len(trials)), [_short(name) for name in trials])
        axes.set_ylim(len(trials) - 0.4, -0.6)
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_visible(False)
        axes.set_xlabel("time since the start of the trial, s")
        size_bar(figure, norm, axes)
    return figure


def _draw_record(axes: Axes, row: int, windows: Sequence[GapWindow], norm: Normalize, *, both: bool) -> None:
    first, last = windows[0].first, windows[0].last
    for middle in (row - 0.14, row + 0.2) if both else (row,):
        axes.plot([first, last], [middle, middle], color=REFERENCE, lw=1.0, zorder=1)
    for window in windows:
        begin = first if window.begin is None else window.begin.value
        end = last if window.end is None else window.end.value
        low, height = (row + 0.1, 0.2) if window.with_effect else (row - 0.34, 0.4 if both else 0.68)
        colour = colormaps[LEVELS](float(norm(window.size)))
        axes.broken_barh(
            [(begin, end - begin)], (low, height), facecolor=colour, edgecolor="#333333", lw=0.5, zorder=2
        )
        for moment in (window.begin, window.end):
            if moment is not None:
                _draw_moment(axes, moment, low + 0.5 * height, height)


def _draw_moment(axes: Axes, moment: Moment, middle: float, height: float) -> None:
    axes.plot([moment.low, moment.high], [middle, middle], color="white", lw=2.6, zorder=3)
    axes.plot([moment.low, moment.high], [middle, middle], color=OBSERVED, lw=1.2, zorder=4)
    for at in (moment.low, moment.high):
        axes.plot([at, at], [middle - 0.3 * height, middle + 0.3 * height], color=OBSERVED, lw=0.9, zorder=4)


def _short(name: str) -> str:
    return name if len(name) <= LONGEST_NAME else f"{name[: LONGEST_NAME - 1]}\N{HORIZONTAL ELLIPSIS}"
