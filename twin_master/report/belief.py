"""Figures of the belief about the state over the steps, and of the policy over the states.

The belief is a probability distribution over the joint states, the combinations of factor levels.
"""

from typing import Unpack

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from reporting.arrays import Float
from reporting.pages import figures as style
from reporting.words import capital
from twin_master.report.reading import Run, short_number

_SHADES = ["#ffffff", "#d3ece4", "#7fcbb2", style.PRESENT, "#003d2d"]
_PROBABILITY_COLORS: style.ColorScale = {
    "cmap": LinearSegmentedColormap.from_list("probability", _SHADES),
    "vmin": 0.0,
    "vmax": 1.0,
}
_CONTROL_COLORS = ("#e9ddf0", "#b48ac9", "#7b4f96", "#4a2a63")
_BELIEF_PANELS = 8
"""Largest number of steps for which the joint belief is drawn."""
_MEAN_MARK: style.MarkStyle = {
    "marker": "D",
    "markersize": 4.0,
    "color": "white",
    "markeredgecolor": style.PRESENT,
}
_TRUTH_RING: style.LineStyle = {
    "marker": "o",
    "markersize": 9.0,
    "markerfacecolor": "none",
    "linestyle": "none",
}
_LETTERS = "abcdefghijklmnopqrstuvwxyz"
_DARK_CELL = 0.62
"""Fraction of the largest margin above which a cell is so dark that its number is white."""


def belief_steps(run: Run) -> list[int]:
    """Return the rows of at most `_BELIEF_PANELS` evenly spaced steps, from first to last."""
    even_steps = np.linspace(0, run.step_count - 1, _BELIEF_PANELS).round().astype(int)
    return [int(step) for step in np.unique(even_steps)]


@style.publication_style()
def belief_figure(run: Run) -> Figure:
    """Draw the belief about the state.

    For a state of two factors, small maps show the joint belief in some steps; for any other
    state, a map for each factor shows its marginal belief over all steps.
    """
    return _joint_figure(run) if len(run.factors) == 2 else _marginal_figure(run)


def _joint_figure(run: Run) -> Figure:
    """Draw the joint belief of two factors in a few steps, with one map for each step."""
    steps = belief_steps(run)
    columns = min(4, len(steps))
    rows = -(-len(steps) // columns)  # rounded up
    right_edge = 0.115 + 0.785 * columns / 4
    figure, grid = style.panels(
        rows,
        columns,
        0.95 + 1.62 * rows,
        0.52,
        0.43,
        left=0.075,
        right=right_edge,
        wspace=0.12,
        hspace=0.30,
    )
    for axes, step in zip(style.keep_first_panels(grid, len(steps)), steps, strict=True):
        image = _draw_joint_belief(axes, run, step)
    # one colour bar at the right of all panels: position and size as fractions of the figure
    height = figure.get_figheight()
    bar_axes = figure.add_axes((right_edge + 0.015, 0.43 / height, 0.013, 1 - 0.95 / height))
    style.color_bar(figure, image, "probability", cax=bar_axes)
    style.shared_legend(figure, bbox_to_anchor=(0.5, 1.0))
    return figure


def _draw_joint_belief(axes: Axes, run: Run, step: int) -> QuadMesh:
    """Draw the joint belief of two factors after one step, its mean and the true state.

    `step` counts from the first step of the run. Return the map, for its colour bar.
    """
    image = _draw_state_map(axes, run, run["filtered/probability"][step], **_PROBABILITY_COLORS)
    axes.set_title(f"{run.step_word} {run.first_step + step}", fontweight="normal", pad=3.0)
    x, y = run.factor_scales * run["filtered/mean"][step]
    axes.plot(x, y, **_MEAN_MARK, linestyle="none", markeredgewidth=1.1, label="mean of the belief")
    if run.true_state is not None:
        x, y = run.factor_scales * run.true_state[step]
        # A wide white ring below the black one keeps it visible on dark cells.
        for color, width in (("white", 2.6), (style.TRUTH, 1.2)):
            axes.plot(
                x, y, **_TRUTH_RING, markeredgecolor=color, markeredgewidth=width, label="truth"
            )
    axes.set_xlabel(run.factors[0].label, labelpad=2.0)
    axes.set_ylabel(run.factors[1].label, labelpad=2.0)
    axes.label_outer()
    return image


def draw_step_map(
    axes: Axes,
    run: Run,
    values: Float,
    first_number: int,
    *,
    rasterized: bool = False,
    **look: Unpack[style.ColorScale],
) -> QuadMesh:
    """Draw n values over T steps as a map of coloured cells, and return the map.

    Parameters
    ----------
    values : (T, n) array
        The values; those of one step form a column of the map.
    first_number : int
        The vertical coordinate of the first of the n values.
    rasterized : bool
        Whether the cells are drawn as an image, which a file of many cells needs.
    **look : ColorScale
        Colours of the values, as arguments of `Axes.pcolormesh`.
    """
    step_edges = np.arange(run.step_count + 1) + run.first_step - 0.5
    value_edges = np.arange(values.shape[1] + 1) + first_number - 0.5
    return axes.pcolormesh(step_edges, value_edges, values.T, rasterized=rasterized, **look)


def _marginal_figure(run: Run) -> Figure:
    """Draw the marginal belief of each factor over the steps."""
    count = len(run.factors)
    figure, grid = style.panels(
        count, 1, 0.6 + 1.3 * count, 0.3, 0.45, left=0.09, right=0.9, hspace=0.5
    )
    states = run.model.states
    for index, (factor, (axes,)) in enumerate(zip(run.factors, grid, strict=True)):
        marginal = states.marginal(run["filtered/probability"], states.names[index])
        level_numbers = np.arange(len(factor.levels))
        image = draw_step_map(axes, run, marginal, 0, **_PROBABILITY_COLORS)
        if run.true_state is not None:
            true_level = factor.scale * run.true_state[:, index]
            # The levels are drawn at equal distances: interpolate between their numbers.
            height = np.interp(true_level, factor.levels, level_numbers)
            axes.plot(run.step_numbers, height, color=style.TRUTH, linewidth=1.0, label="truth")
        axes.set_yticks(level_numbers, [short_number(level) for level in factor.levels])
        axes.set_ylabel(factor.label)
        style.panel_label(axes, _LETTERS[index % len(_LETTERS)], capital(factor.title))
        style.color_bar(figure, image, "probability", ax=axes, pad=0.02)
    axes.set_xlabel(run.step_word)
    return figure


def _cell_edges(levels: Float) -> Float:
    """Return the edges of the cells of L levels, an (L + 1,) array.

    Inner edges are half-way between levels, and the outer cells extend as far to either side.
    """
    if len(levels) == 1:
        # No distance between levels is given: take the level itself, or 1 if it is 0.
        half_width = 0.5 * abs(float(levels[0])) or 0.5
        return np.array([levels[0] - half_width, levels[0] + half_width])
    middles = (levels[1:] + levels[:-1]) / 2
    first_edge = 2.0 * levels[0] - middles[0]
    last_edge = 2.0 * levels[-1] - middles[-1]
    return np.concatenate([[first_edge], middles, [last_edge]])


def _draw_state_map(
    axes: Axes, run: Run, values: NDArray[np.generic], **look: Unpack[style.ColorScale]
) -> QuadMesh:
    """Draw a value for each joint state of two factors as a map, and return it.

    Parameters
    ----------
    values : (S,) array
        The values; the first factor is drawn along the x axis.
    **look : ColorScale
        Colours of the values, as arguments of `Axes.pcolormesh`.
    """
    x_levels, y_levels = (np.array(factor.levels) for factor in run.factors)
    image = axes.pcolormesh(
        _cell_edges(x_levels),
        _cell_edges(y_levels),
        values.reshape(len(x_levels), len(y_levels)).T,
        edgecolors="#d9d9d9",
        linewidth=0.4,
        **look,
    )
    axes.set_xticks(x_levels, [short_number(level) for level in x_levels.tolist()])
    axes.set_yticks(y_levels, [short_number(level) for level in y_levels.tolist()])
    axes.tick_params(length=2.0)
    axes.spines[["top", "right"]].set_visible(True)
    return image


@style.publication_style()
def policy_figure(run: Run) -> Figure:
    """Draw the policy over the plane of two factors, and the margin of its decision in each state.

    The margin is the difference of the action values of two controls; see `_draw_margin`.
    """
    figure, ((policy_axes, margin_axes),) = style.panels(
        1, 2, 3.2, 0.54, 0.45, left=0.075, right=0.91, wspace=0.22
    )
    _draw_policy(policy_axes, run)
    if len(run.controls) > 1:
        _draw_margin(figure, margin_axes, run)
    else:
        margin_axes.remove()
    return figure


def _draw_policy(axes: Axes, run: Run) -> None:
    """Draw the policy's control in each state, and the path of the estimated mean state."""
    count = len(run.controls)
    colors = [_CONTROL_COLORS[number % len(_CONTROL_COLORS)] for number in range(count)]
    _draw_state_map(
        axes,
        run,
        run["policy/control_index"],
        cmap=ListedColormap(colors),
        vmin=-0.5,
        vmax=count - 0.5,
    )
    estimate = run.factor_scales * run["filtered/mean"]  # (T, 2)
    x, y = estimate.T
    axes.plot(x, y, color=style.PRESENT, linewidth=1.3, marker=".", markersize=4, label="estimate")
    if run.true_state is not None:
        x, y = (run.factor_scales * run.true_state).T
        axes.plot(x, y, **style.TRUTH_LINE, label="truth")
    start_mark: style.MarkStyle = {**_MEAN_MARK, "marker": "o", "markersize": 6.0}
    x, y = estimate[0]
    axes.plot(x, y, **start_mark, label="estimate at the start")
    axes.set_xlabel(run.factors[0].label)
    axes.set_ylabel(run.factors[1].label)
    style.panel_label(axes, "a", "Policy, and the way through it")
    _add_policy_legend(axes, run, colors)


def _add_policy_legend(axes: Axes, run: Run, colors: list[str]) -> None:
    """Add the legend of the policy: controls by colour, and the lines of estimate and truth."""
    handles: list[Rectangle | Line2D] = []
    handles += style.swatches(run.controls, colors, edgecolor=style.REFERENCE, linewidth=0.5)
    handles += [line for line in axes.get_lines() if line.get_label() in {"estimate", "truth"}]
    axes.legend(
        handles=handles,
        loc="lower left",
        bbox_to_anchor=(-0.02, 1.08),
        ncols=len(handles),
        handlelength=1.4,
    )


def _draw_margin(figure: Figure, axes: Axes, run: Run) -> None:
    """Draw the difference of action values in each state.

    An action value is the expected discounted reward of a control in a state. With two
    controls, the value of the first is subtracted from that of the second; with more, the
    second-largest value from the largest.
    """
    action_values = run["policy/action_value"]  # (S, U)
    if action_values.shape[1] == 2:
        minuend = action_values[:, 1]
        subtrahend = action_values[:, 0]
        label = f"Q({run.controls[1]}) − Q({run.controls[0]})"
    else:
        increasing = np.sort(action_values, axis=1)
        minuend = increasing[:, -1]
        subtrahend = increasing[:, -2]
        label = "value minus that of the next best control"
    margin = minuend - subtrahend
    largest_margin = float(np.abs(margin).max()) or 1.0
    if len(run.controls) == 2:  # the margin has either sign
        image = _draw_state_map(
            axes, run, margin, cmap="PuOr", vmin=-largest_margin, vmax=largest_margin
        )
    else:
        image = _draw_state_map(axes, run, margin, cmap="Purples", vmin=0.0, vmax=largest_margin)
    coordinates = run.factor_scales * run.model.states.coordinates
    for (x, y), value in zip(coordinates, margin, strict=True):
        is_dark = abs(value) > _DARK_CELL * largest_margin
        axes.text(
            x,
            y,
            f"{value:+.3f}".replace("-", "−"),
            ha="center",
            va="center",
            fontsize=7.0,
            color="white" if is_dark else style.TRUTH,
        )
    axes.set_xlabel(run.factors[0].label)
    style.panel_label(axes, "b", "Margin of the decision")
    style.color_bar(figure, image, label, ax=axes, pad=0.03, fraction=0.05)
