"""The belief over the joint states turn by turn, and the policy over the states."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, ListedColormap, TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from reporting import figures as style
from twin_master.report.data import RunRecord
from twin_master.report.view import capital, short_number, state_label, state_scale, state_scales

Float = NDArray[np.floating[Any]]

_PROBABILITY_COLORS = LinearSegmentedColormap.from_list(
    "probability", ["#ffffff", "#d3ece4", "#7fcbb2", style.PRESENT, "#003d2d"]
)
_CONTROL_COLORS = ("#e9ddf0", "#b48ac9", "#7b4f96", "#4a2a63")
_SMALL_PANELS = 8


def belief_turns(record: RunRecord, count: int = _SMALL_PANELS) -> list[int]:
    """Return at most `count` different turns spread evenly from the first to the last."""
    return [int(turn) for turn in np.unique(np.linspace(0, record.step_count - 1, count).round().astype(int))]


def joint_belief(record: RunRecord, turn: int) -> Float:
    """Return p(z_1, z_2 | o_0..o_turn) of a state of two factors: (L_2, L_1), the first along the x axis."""
    shape = tuple(len(level) for level in record.levels)
    return np.transpose(record.filtered.probability[turn].reshape(shape))


def belief_figure(record: RunRecord) -> Figure:
    """Draw small maps of the joint belief of two factors, else the marginal of each factor over the turns."""
    with style.publication_style():
        return _joint_figure(record) if len(record.state_names) == 2 else _marginal_figure(record)


def _joint_figure(record: RunRecord) -> Figure:
    turns = belief_turns(record)
    columns = min(4, len(turns))
    rows = -(-len(turns) // columns)
    figure = style.new_figure(0.95 + 1.62 * rows)
    height = figure.get_figheight()
    width = 0.785 * (columns / 4) + 0.05
    grid = figure.add_gridspec(
        rows, columns, left=0.075, right=0.02 + width + 0.045, top=1 - 0.52 / height, bottom=0.43 / height,
        wspace=0.12, hspace=0.30,
    )  # fmt: skip
    image = None
    for number, turn in enumerate(turns):
        row, column = divmod(number, columns)
        axes = figure.add_subplot(grid[row, column])
        image = _map(axes, record, joint_belief(record, turn), cmap=_PROBABILITY_COLORS, vmin=0.0, vmax=1.0)
        axes.set_title(f"{record.step_word} {turn}", fontweight="normal", pad=3.0)
        _mark_states(axes, record, turn)
        if row == rows - 1:
            axes.set_xlabel(state_label(record, 0), labelpad=2.0)
        else:
            axes.tick_params(labelbottom=False)
        if column == 0:
            axes.set_ylabel(state_label(record, 1), labelpad=2.0)
        else:
            axes.tick_params(labelleft=False)
    if image is not None:
        where = figure.add_axes((0.02 + width + 0.06, 0.43 / height, 0.013, 1 - 0.95 / height))
        bar = figure.colorbar(image, cax=where)
        bar.set_label("probability")
        bar.outline.set_linewidth(0.5)
    handles = [
        Line2D(
            [], [], marker="D", linestyle="none", color="white", markeredgecolor=style.PRESENT, label="mean"
        )
    ]
    if record.truth_state is not None:
        handles.append(
            Line2D([], [], marker="o", markersize=8, linestyle="none", markerfacecolor="none",
                   markeredgecolor=style.TRUTH, markeredgewidth=1.2, label="truth")
        )  # fmt: skip
    figure.legend(handles=handles, loc="upper center", ncols=2, bbox_to_anchor=(0.5, 1.0))
    return figure


def _mark_states(axes: Axes, record: RunRecord, turn: int) -> None:
    """Mark the mean of the belief and the truth of a turn in a map of the joint states."""
    scales = state_scales(record)
    x, y = scales * record.filtered.mean[turn]
    axes.plot(
        x, y, marker="D", markersize=4.0, color="white", markeredgecolor=style.PRESENT, markeredgewidth=1.1,
        label="mean of the belief",
    )  # fmt: skip
    if record.truth_state is not None:
        x, y = scales * record.truth_state[turn]
        for color, width in (("white", 2.6), (style.TRUTH, 1.2)):
            axes.plot(
                x, y, marker="o", markersize=9.0, markerfacecolor="none", markeredgecolor=color,
                markeredgewidth=width, label="truth",
            )  # fmt: skip


def _marginal_figure(record: RunRecord) -> Figure:
    count = len(record.state_names)
    figure = style.new_figure(0.6 + 1.3 * count)
    grid = figure.add_gridspec(count, 1, left=0.09, right=0.90, top=0.92, bottom=0.12, hspace=0.5)
    for factor, (title, levels) in enumerate(zip(record.state_titles, record.levels, strict=True)):
        axes = figure.add_subplot(grid[factor, 0])
        marginal = np.stack(
            [
                record.filtered.probability[:, record.coordinates[:, factor] == level].sum(1)
                for level in levels
            ]
        )
        image = axes.pcolormesh(
            np.arange(record.step_count + 1) - 0.5, np.arange(len(levels) + 1) - 0.5, marginal,
            cmap=_PROBABILITY_COLORS, vmin=0.0, vmax=1.0, rasterized=False,
        )  # fmt: skip
        if record.truth_state is not None:
            truth = np.interp(record.truth_state[:, factor], levels, np.arange(len(levels)))
            axes.plot(np.arange(record.step_count), truth, color=style.TRUTH, linewidth=1.0, label="truth")
        scale, _ = state_scale(record, factor)
        axes.set_yticks(np.arange(len(levels)), [short_number(scale * level) for level in levels.tolist()])
        axes.set_ylabel(state_label(record, factor))
        style.panel_label(axes, "abcdefghijklmnopqrstuvwxyz"[factor % 26], capital(title))
        figure.colorbar(image, ax=axes, pad=0.02, label="probability")
    axes.set_xlabel(record.step_word)
    return figure


def _edges(levels: Float) -> Float:
    """Return the borders half way between the levels: (L + 1,)."""
    if len(levels) == 1:
        half = 0.5 * abs(float(levels[0])) or 0.5
        return np.array([levels[0] - half, levels[0] + half])
    middle = (levels[1:] + levels[:-1]) / 2
    first, last = levels[0] - (middle[0] - levels[0]), levels[-1] + (levels[-1] - middle[-1])
    return np.concatenate([[first], middle, [last]])


def _map(axes: Axes, record: RunRecord, values: NDArray[Any], **options: Any) -> Any:
    """Draw a value for each joint state of two factors in a plane whose axes are as printed."""
    first, second = (
        scale * levels for scale, levels in zip(state_scales(record), record.levels, strict=True)
    )
    x, y = _edges(first), _edges(second)
    image = axes.pcolormesh(x, y, values, edgecolors="#d9d9d9", linewidth=0.4, **options)
    axes.set_xticks(first, [short_number(level) for level in first.tolist()])
    axes.set_yticks(second, [short_number(level) for level in second.tolist()])
    axes.tick_params(length=2.0)
    for side in ("top", "right"):
        axes.spines[side].set_visible(True)
    return image


def policy_margin(record: RunRecord) -> Float | None:
    """Return how much more the best control is worth than the next best: (S,); None if not stored."""
    if record.policy is None or record.policy.action_value is None or record.policy.action_value.shape[1] < 2:
        return None
    ordered = np.sort(record.policy.action_value, axis=1)
    return ordered[:, -1] - ordered[:, -2]


def policy_figure(record: RunRecord) -> Figure | None:
    """Draw the policy over the plane of two factors, with the margin by which its control is the better one.

    None if no policy was stored or the state has not two factors.
    """
    if record.policy is None or len(record.state_names) != 2:
        return None
    margin = policy_margin(record)
    shape = tuple(len(level) for level in record.levels)
    with style.publication_style():
        figure = style.new_figure(3.2)
        grid = figure.add_gridspec(1, 2, left=0.075, right=0.91, top=0.83, bottom=0.14, wspace=0.22)
        _policy_map(figure.add_subplot(grid[0, 0]), record, shape)
        if margin is not None:
            _margin_map(figure, figure.add_subplot(grid[0, 1]), record, margin, shape)
    return figure


def _policy_map(axes: Axes, record: RunRecord, shape: tuple[int, ...]) -> None:
    assert record.policy is not None
    count, scales = len(record.controls), state_scales(record)
    colors = [_CONTROL_COLORS[number % len(_CONTROL_COLORS)] for number in range(count)]
    chosen = record.policy.control_index.reshape(shape).T
    _map(axes, record, chosen, cmap=ListedColormap(colors), vmin=-0.5, vmax=count - 0.5)
    axes.plot(
        *(scales * record.filtered.mean).T,
        color=style.PRESENT,
        linewidth=1.3,
        marker=".",
        markersize=4,
        label="estimate",
    )
    if record.truth_state is not None:
        axes.plot(
            *(scales * record.truth_state).T,
            color=style.TRUTH,
            linewidth=1.1,
            linestyle=(0, (4, 1.5, 1, 1.5)),
            label="truth",
        )
    axes.plot(
        *(scales * record.filtered.mean[0]),
        marker="o",
        markersize=6,
        color="white",
        markeredgecolor=style.PRESENT,
        label="estimate at the start",
    )
    axes.set_xlabel(state_label(record, 0))
    axes.set_ylabel(state_label(record, 1))
    style.panel_label(axes, "a", "Policy, and the way through it")
    handles: list[Any] = [
        Rectangle((0, 0), 1, 1, facecolor=color, edgecolor=style.REFERENCE, linewidth=0.5, label=name)
        for name, color in zip(record.controls, colors, strict=True)
    ]
    handles += [line for line in axes.get_lines() if line.get_label() in {"estimate", "truth"}]
    axes.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(-0.02, 1.08), ncols=len(handles), handlelength=1.4
    )


def _margin_map(figure: Figure, axes: Axes, record: RunRecord, margin: Float, shape: tuple[int, ...]) -> None:
    assert record.policy is not None
    signed, label = margin, "value beyond the next best"
    if len(record.controls) == 2 and record.policy.action_value is not None:
        signed = record.policy.action_value[:, 1] - record.policy.action_value[:, 0]
        label = f"Q({record.controls[1]}) − Q({record.controls[0]})"
    largest = float(np.abs(signed).max()) or 1.0
    values = signed.reshape(shape).T
    if signed is margin:
        image = _map(axes, record, values, cmap="Purples", vmin=0.0, vmax=largest)
    else:
        image = _map(axes, record, values, cmap="PuOr", norm=TwoSlopeNorm(0.0, -largest, largest))
    scales = state_scales(record)
    for i, x in enumerate(scales[0] * record.levels[0]):
        for j, y in enumerate(scales[1] * record.levels[1]):
            strong = abs(values[j, i]) > 0.62 * largest
            axes.text(
                x, y, f"{values[j, i]:+.3f}".replace("-", "−"), ha="center", va="center", fontsize=7.0,
                color="white" if strong else style.TRUTH,
            )  # fmt: skip
    axes.set_xlabel(state_label(record, 0))
    style.panel_label(axes, "b", "Margin of the decision")
    bar = figure.colorbar(image, ax=axes, pad=0.03, fraction=0.05)
    bar.set_label(label)
    bar.outline.set_linewidth(0.5)
