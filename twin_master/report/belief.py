"""The belief over the joint states turn by turn, and the policy over the states."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from reporting import figures as style
from reporting.arrays import Float
from reporting.words import capital
from twin_master.report.reading import Run
from twin_master.report.view import short_number

_PROBABILITY_COLORS = LinearSegmentedColormap.from_list(
    "probability", ["#ffffff", "#d3ece4", "#7fcbb2", style.PRESENT, "#003d2d"]
)
_CONTROL_COLORS = ("#e9ddf0", "#b48ac9", "#7b4f96", "#4a2a63")
_SMALL_PANELS = 8
_MEAN: dict[str, Any] = {"marker": "D", "markersize": 4.0, "color": "white", "markeredgecolor": style.PRESENT}
_RING: dict[str, Any] = {"marker": "o", "markersize": 9.0, "markerfacecolor": "none", "linestyle": "none"}


def belief_turns(run: Run) -> list[int]:
    """Return different turns spread evenly from the first to the last."""
    return [int(turn) for turn in np.unique(np.linspace(0, run.steps - 1, _SMALL_PANELS).round().astype(int))]


@style.publication_style()
def belief_figure(run: Run) -> Figure:
    """Draw small maps of the joint belief of two factors, else the marginal of each factor over the turns."""
    return _joint_figure(run) if len(run.factors) == 2 else _marginal_figure(run)


def _joint_figure(run: Run) -> Figure:
    turns = belief_turns(run)
    columns = min(4, len(turns))
    rows = -(-len(turns) // columns)
    right = 0.115 + 0.785 * columns / 4
    figure, grid = style.panels(
        rows, columns, 0.95 + 1.62 * rows, 0.52, 0.43, left=0.075, right=right, wspace=0.12, hspace=0.30
    )
    image = None
    for number, turn in enumerate(turns):
        row, column = divmod(number, columns)
        axes = grid[row][column]
        image = _map(
            axes, run, run["filtered/probability"][turn], cmap=_PROBABILITY_COLORS, vmin=0.0, vmax=1.0
        )
        axes.set_title(f"{run.step} {turn}", fontweight="normal", pad=3.0)
        x, y = run.scales * run["filtered/mean"][turn]
        axes.plot(x, y, **_MEAN, linestyle="none", markeredgewidth=1.1, label="mean of the belief")
        if run.truth is not None:
            x, y = run.scales * run.truth[turn]
            for color, width in (("white", 2.6), (style.TRUTH, 1.2)):
                axes.plot(x, y, **_RING, markeredgecolor=color, markeredgewidth=width, label="truth")
        axes.tick_params(labelbottom=row == rows - 1, labelleft=column == 0)
        axes.set_xlabel(run.factors[0].label if row == rows - 1 else "", labelpad=2.0)
        axes.set_ylabel(run.factors[1].label if column == 0 else "", labelpad=2.0)
    for spare in [axes for row in grid for axes in row][len(turns) :]:
        spare.remove()
    height = figure.get_figheight()
    place = figure.add_axes((right + 0.015, 0.43 / height, 0.013, 1 - 0.95 / height))
    style.color_bar(figure, image, "probability", cax=place)
    style.shared_legend(figure, bbox_to_anchor=(0.5, 1.0))
    return figure


def _marginal_figure(run: Run) -> Figure:
    count = len(run.factors)
    figure, grid = style.panels(count, 1, 0.6 + 1.3 * count, 0.3, 0.45, left=0.09, right=0.9, hspace=0.5)
    for index, (factor, (axes,)) in enumerate(zip(run.factors, grid, strict=True)):
        marginal = run.model.states.marginal(run["filtered/probability"], run.model.states.names[index]).T
        places = np.arange(len(factor.levels))
        image = axes.pcolormesh(
            np.arange(run.steps + 1) - 0.5, np.arange(len(places) + 1) - 0.5, marginal,
            cmap=_PROBABILITY_COLORS, vmin=0.0, vmax=1.0,
        )  # fmt: skip
        if run.truth is not None:
            truth = np.interp(factor.scale * run.truth[:, index], factor.levels, places)
            axes.plot(np.arange(run.steps), truth, color=style.TRUTH, linewidth=1.0, label="truth")
        axes.set_yticks(places, [short_number(level) for level in factor.levels])
        axes.set_ylabel(factor.label)
        style.panel_label(axes, "abcdefghijklmnopqrstuvwxyz"[index % 26], capital(factor.title))
        style.color_bar(figure, image, "probability", ax=axes, pad=0.02)
    axes.set_xlabel(run.step)
    return figure


def _edges(levels: Float) -> Float:
    """Return the borders half way between the levels: (L + 1,)."""
    if len(levels) == 1:
        half = 0.5 * abs(float(levels[0])) or 0.5
        return np.array([levels[0] - half, levels[0] + half])
    middle = (levels[1:] + levels[:-1]) / 2
    return np.concatenate([[2.0 * levels[0] - middle[0]], middle, [2.0 * levels[-1] - middle[-1]]])


def _map(axes: Axes, run: Run, values: NDArray[Any], **options: Any) -> Any:
    """Draw a value for each joint state (S,) of two factors, the first along the x axis, as printed."""
    first, second = (np.array(factor.levels) for factor in run.factors)
    image = axes.pcolormesh(
        _edges(first), _edges(second), values.reshape(len(first), len(second)).T, edgecolors="#d9d9d9",
        linewidth=0.4, **options,
    )  # fmt: skip
    axes.set_xticks(first, [short_number(level) for level in first.tolist()])
    axes.set_yticks(second, [short_number(level) for level in second.tolist()])
    axes.tick_params(length=2.0)
    axes.spines[["top", "right"]].set_visible(True)
    return image


@style.publication_style()
def policy_figure(run: Run) -> Figure:
    """Draw the policy over the plane of two factors, with the margin by which its control is better."""
    figure, ((policy, margin),) = style.panels(1, 2, 3.2, 0.54, 0.45, left=0.075, right=0.91, wspace=0.22)
    _policy_map(policy, run)
    if len(run.controls) > 1:
        _margin_map(figure, margin, run)
    else:
        margin.remove()
    return figure


def _policy_map(axes: Axes, run: Run) -> None:
    count = len(run.controls)
    colors = [_CONTROL_COLORS[number % len(_CONTROL_COLORS)] for number in range(count)]
    _map(axes, run, run["policy/control_index"], cmap=ListedColormap(colors), vmin=-0.5, vmax=count - 0.5)
    estimate = run.scales * run["filtered/mean"]
    axes.plot(*estimate.T, color=style.PRESENT, linewidth=1.3, marker=".", markersize=4, label="estimate")
    if run.truth is not None:
        axes.plot(*(run.scales * run.truth).T, **style.TRUTH_LINE, label="truth")
    axes.plot(*estimate[0], **{**_MEAN, "marker": "o", "markersize": 6.0}, label="estimate at the start")
    axes.set_xlabel(run.factors[0].label)
    axes.set_ylabel(run.factors[1].label)
    style.panel_label(axes, "a", "Policy, and the way through it")
    handles: list[Any] = [
        Rectangle((0, 0), 1, 1, facecolor=color, edgecolor=style.REFERENCE, linewidth=0.5, label=name)
        for name, color in zip(run.controls, colors, strict=True)
    ]
    handles += [line for line in axes.get_lines() if line.get_label() in {"estimate", "truth"}]
    axes.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(-0.02, 1.08), ncols=len(handles), handlelength=1.4
    )


def _margin_map(figure: Figure, axes: Axes, run: Run) -> None:
    """Draw by how much one of two controls is worth more, or the best of several beyond the next best."""
    worth = run["policy/action_value"]
    if worth.shape[1] == 2:
        label = f"Q({run.controls[1]}) − Q({run.controls[0]})"
    else:
        worth, label = np.sort(worth, axis=1)[:, -2:], "value beyond the next best"
    margin = worth[:, 1] - worth[:, 0]
    largest = float(np.abs(margin).max()) or 1.0
    lowest, colors = (-largest, "PuOr") if len(run.controls) == 2 else (0.0, "Purples")
    image = _map(axes, run, margin, cmap=colors, vmin=lowest, vmax=largest)
    for (x, y), value in zip(run.scales * run.model.states.coordinates, margin, strict=True):
        strong = abs(value) > 0.62 * largest
        axes.text(
            x, y, f"{value:+.3f}".replace("-", "−"), ha="center", va="center", fontsize=7.0,
            color="white" if strong else style.TRUTH,
        )  # fmt: skip
    axes.set_xlabel(run.factors[0].label)
    style.panel_label(axes, "b", "Margin of the decision")
    style.color_bar(figure, image, label, ax=axes, pad=0.03, fraction=0.05)
