"""The course of a mission as seen at one step: past, present and prediction (Kapteyn et al. 2021, Fig. 6).

The belief over the joint states step by step, and the policy over the states.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from reporting import figures as style
from reporting.arrays import Float
from reporting.words import capital
from twin_master.report.reading import NORMAL_95, Run, short_number
from twin_master.scenario.schema import REWARD_NAMES

_ROW_HEIGHT = 1.22
_NARROW = 0.19
_MANY_STEPS = 120  # more have no room for gaps between bars
_MANY_DOTS = 1000
_LEAST_PAST = 3  # steps that a figure must have behind its present to show a course
_DASHES = (0, (3, 1.2))
_DOT: dict[str, Any] = {
    "color": style.OBSERVED, "linestyle": "none", "marker": "o", "markersize": 2.3, "markeredgewidth": 0.6,
}  # fmt: skip


def default_now(run: Run) -> int:
    """Return the step that shows most: a few steps before the flown control first changes.

    Two thirds into the mission, where it does not change, or at once.
    """
    last, changes = run.steps - 1, np.flatnonzero(np.diff(run.control_index)) + 1
    if len(changes) and changes[0] >= 3 + _LEAST_PAST:
        return int(changes[0] - 3)
    return round(2 * last / 3)


def choose_sensors(run: Run, count: int = 4) -> list[int]:
    """Return indices of sensors worth a panel: the one strained most, the first, and one for each factor.

    The sensor of a factor is the one whose expected value answers most to it: the largest coefficient of a
    least-squares fit of its logarithm to the means of the factors, apart for each control.
    """
    if not run.sensors.unit:  # what has different units cannot be compared: the first ones
        return list(range(min(count, len(run.sensors.titles))))
    quantity = run["filtered/quantity_mean"]
    chosen = [int(np.argmax(np.abs(quantity).max(axis=0)))]
    if 0 not in chosen:
        chosen.append(0)
    if np.all(quantity > 0.0):
        columns = [run["filtered/mean"], np.eye(len(run.controls))[run.control_index]]
        coefficient = np.linalg.lstsq(np.concatenate(columns, axis=1), np.log(quantity), rcond=None)[0]
        for factor in range(len(run.factors)):
            order = np.argsort(-coefficient[factor], kind="stable")
            fresh = [int(sensor) for sensor in order if int(sensor) not in chosen]
            if fresh and coefficient[factor, fresh[0]] > 1e-3:
                chosen.append(fresh[0])
    return chosen[:count]


@style.publication_style()
def mission_figure(run: Run, now: int, sensors: Sequence[int] | None = None) -> Figure:
    """Draw the mission as the twin sees it at step `now`.

    Parameters
    ----------
    run
        The run.
    now
        The present step, 0..T-1.
    sensors
        Indices of the sensors to show, from 0; by default `choose_sensors`.
    """
    left: list[tuple[Any, int]] = [(_state_panel, k) for k in range(len(run.factors))] + [(_control_panel, 0)]
    right: list[tuple[Any, int]] = [
        (_sensor_panel, sensor) for sensor in (choose_sensors(run) if sensors is None else sensors)
    ]
    for reward in range(len(REWARD_NAMES)):
        (left if len(left) <= len(right) else right).append((_reward_panel, reward))
    rows = max(len(left), len(right))
    figure, grid = style.panels(
        rows, 2, 1.22 + _ROW_HEIGHT * rows, 0.86, 0.42, left=0.088, hspace=0.42, wspace=0.28
    )
    labels = iter("abcdefghijklmnopqrstuvwxyz")
    for column, shown in enumerate((left, right)):
        for row, (panel, index) in enumerate(shown):
            axes = grid[row][column]
            _zones(axes, run, now, named=row == 0)
            style.panel_label(axes, next(labels), panel(axes, run, index, now))
            if row == len(shown) - 1:
                axes.set_xlabel(run.step)
            else:
                axes.tick_params(labelbottom=False)
        for row in range(len(shown), rows):
            grid[row][column].remove()
    style.shared_legend(figure, rows=2)
    return figure


def _zones(axes: Axes, run: Run, now: int, *, named: bool) -> None:
    first, present = run.first_step, run.first_step + now
    end = present + run.horizon
    axes.set_xlim(first - 0.8, end + 0.8)
    axes.axvspan(present + 0.5, end + 0.8, color=style.PREDICTION, alpha=0.06, linewidth=0)
    axes.axvline(present, color=style.PRESENT, linewidth=0.8, zorder=0.5)
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.grid(axis="y")
    axes.yaxis.set_label_coords(-0.16, 0.5)
    if named:
        where, height = axes.get_xaxis_transform(), 1.24
        axes.text(present, height, f"now: {present}", transform=where, ha="right", color=style.PRESENT)
        if now > 0.35 * (end - first):
            axes.text(first - 0.8, height, "past", transform=where, ha="left", color=style.PAST)
        if run.horizon > _NARROW * (end - first):
            axes.text(present + 0.5, height, "prediction", transform=where, ha="left", color=style.PREDICTION)


def _draw(axes: Axes, run: Run, now: int, course: Float, truth: Float | None) -> None:
    """Draw a course, its mean and ends (3, n), up to the present and predicted; and the truth beside it."""
    steps = run.first_step + np.arange(course.shape[1])
    ahead = {"linestyle": _DASHES, "marker": ".", "markersize": 3.5}
    for part, color, label, look in (
        (slice(now + 1), style.PAST, "past", {}),
        (slice(now + 1, None), style.PREDICTION, "prediction", ahead),
    ):
        known = np.isfinite(course[0, part])
        if known.any():
            at, (center, lower, upper) = steps[part][known], course[:, part][:, known]
            style.band(axes, at, lower, upper, color)
            axes.plot(at, center, color=color, label=label, **look)  # type: ignore[arg-type]
    mean, least, most = course[:, now].tolist()
    if np.isfinite(mean):
        look = {"color": style.PRESENT, "marker": "D", "markersize": 4.2, "capsize": 2.0, "elinewidth": 1.2}
        style.interval(axes, steps[now], mean, least, most, **look, zorder=4, label="present")
    if truth is not None:
        seen = truth[: len(steps)]
        axes.plot(steps[: len(seen)], seen, **style.TRUTH_LINE, label="truth")


def _course(run: Run, name: str, index: int, now: int) -> Float:
    """Return `quantity` or `reward` up to a step and as predicted there, with 95 % intervals, SI: (3, n).

    The past is seen in hindsight at the last step, and as seen at the time before that.
    """
    past = "smoothed" if now == run.steps - 1 else "filtered"

    def seen(figure: str) -> Float:
        own, coming = (run[f"{group}/{name}_{figure}"][..., index] for group in (past, "predicted"))
        return np.concatenate((own[: now + 1], coming[now]))

    mean = seen("mean")
    if name == "reward":
        half = NORMAL_95 * seen("standard_deviation")
        return np.array([mean, mean - half, mean + half])
    return np.array([mean, seen("lower"), seen("upper")])


def _state_panel(axes: Axes, run: Run, index: int, now: int) -> str:
    """Draw mean and two standard deviations within the levels: p(D_t | o_0..o_now), p(D_{now+h} | ...)."""
    factor = run.factors[index]
    at_the_time = factor.scale * run["filtered/mean"][: now + 1, index]
    steps = run.numbers[: now + 1]
    axes.plot(steps, at_the_time, color=style.PRESENT, linewidth=0.9, label="as seen at the time")
    if now == run.steps - 1:
        past = run["smoothed/mean"], run["smoothed/standard_deviation"]
    else:
        belief, states = run.smoothed_until(now), run.model.states
        past = states.mean(belief), states.standard_deviation(belief)
    coming = run["predicted/mean"][now], run["predicted/standard_deviation"][now]
    mean, deviation = (factor.scale * np.vstack(parts)[:, index] for parts in zip(past, coming, strict=True))
    ends = np.clip(mean + np.array([[-2.0], [2.0]]) * deviation, factor.levels[0], factor.levels[-1])
    truth = None if run.truth is None else factor.scale * run.truth[:, index]
    _draw(axes, run, now, np.vstack((mean, ends)), truth)
    margin = 0.075 * (factor.levels[-1] - factor.levels[0]) or 6.0
    axes.set_yticks(factor.levels, [short_number(level) for level in factor.levels])
    axes.set(ylim=(factor.levels[0] - margin, factor.levels[-1] + margin), ylabel=factor.label)
    return capital(factor.title)


def _sensor_panel(axes: Axes, run: Run, sensor: int, now: int) -> str:
    sensors = run.sensors
    observation = sensors.scale * run.observed[: now + 1 + run.horizon, sensor]
    step = run.numbers[: len(observation)]
    seen, later = step <= step[now], step > step[now]
    many = len(step) > _MANY_DOTS  # as outlines they would make the page too large
    axes.plot(step[seen], observation[seen], **_DOT, label="observed", rasterized=many)
    axes.plot(step[later], observation[later], **_DOT, markerfacecolor="none", label="observed later")
    lost = step[seen & np.isnan(observation)]
    if len(lost):
        look = {**_DOT, "marker": "x", "transform": axes.get_xaxis_transform()}
        axes.plot(lost, np.full(len(lost), 0.04), **look, label="lost")
    truth = run.get(f"truth/{sensors.quantity}")
    truth = None if truth is None else sensors.scale * truth[:, sensor]
    _draw(axes, run, now, sensors.scale * _course(run, "quantity", sensor, now), truth)
    axes.margins(y=0.12)
    unit = sensors.units[sensor]
    axes.set_ylabel(unit if sensors.named else f"{sensors.quantity} ({unit})")
    return capital(sensors.titles[sensor])


def _control_panel(axes: Axes, run: Run, _index: int, now: int) -> str:
    present, tallest, width = run.numbers[now], 0.82, 0.8 if now + run.horizon < _MANY_STEPS else 1.0
    for control in range(len(run.controls)):
        past = run.numbers[:now][run.control_index[:now] == control]
        parts = np.split(past, np.flatnonzero(np.diff(past) > 1) + 1) if width == 1.0 else past[:, None]
        bars = [(part[0] - width / 2, part[-1] - part[0] + width) for part in parts if len(part)]
        axes.broken_barh(bars, (control, tallest), facecolors=style.PAST, linewidth=0)
        if run.control_index[now] == control:
            axes.broken_barh(
                [(present - width / 2, width)], (control, tallest), facecolors=style.PRESENT, linewidth=0
            )
        axes.bar(
            present + 1.0 + np.arange(run.horizon),
            tallest * run["predicted/control_probability"][now, :, control],
            width=width, bottom=control, color=style.PREDICTION, linewidth=0, label=f"_predicted {control}",
        )  # fmt: skip
        axes.axhline(control, color=style.REFERENCE, linewidth=0.6)
    later = np.arange(now + 1, min(now + 1 + run.horizon, run.steps))
    if len(later):
        axes.plot(
            run.numbers[later], run.control_index[later] + tallest + 0.06, linestyle="none", marker="v",
            markersize=3.0, color=style.TRUTH, markeredgewidth=0, label="flown later",
        )  # fmt: skip
    axes.grid(visible=False)
    axes.set_ylim(-0.02, len(run.controls) + 0.06)
    axes.set_yticks(np.arange(len(run.controls)) + tallest / 2, run.controls)
    axes.tick_params(axis="y", length=0)
    return "Control: flown | predicted probability"


def _reward_panel(axes: Axes, run: Run, reward: int, now: int) -> str:
    _draw(axes, run, now, _course(run, "reward", reward, now), None)
    axes.margins(y=0.15)
    low, high = axes.get_ylim()
    if high - low < 1e-6:  # the same at all times, but for rounding
        axes.set_ylim(low - 0.1, high + 0.1)
    axes.set_ylabel("reward")
    return f"{capital(REWARD_NAMES[reward])} reward"


_SHADES = ["#ffffff", "#d3ece4", "#7fcbb2", style.PRESENT, "#003d2d"]
_PROBABILITY: dict[str, Any] = {
    "cmap": LinearSegmentedColormap.from_list("probability", _SHADES), "vmin": 0.0, "vmax": 1.0
}  # fmt: skip
_CONTROL_COLORS = ("#e9ddf0", "#b48ac9", "#7b4f96", "#4a2a63")
_SMALL_PANELS = 8
_MEAN: dict[str, Any] = {"marker": "D", "markersize": 4.0, "color": "white", "markeredgecolor": style.PRESENT}
_RING: dict[str, Any] = {"marker": "o", "markersize": 9.0, "markerfacecolor": "none", "linestyle": "none"}


def belief_steps(run: Run) -> list[int]:
    """Return different steps spread evenly from the first to the last."""
    return [int(step) for step in np.unique(np.linspace(0, run.steps - 1, _SMALL_PANELS).round().astype(int))]


@style.publication_style()
def belief_figure(run: Run) -> Figure:
    """Draw small maps of the joint belief of two factors, else the marginal of each factor over the steps."""
    return _joint_figure(run) if len(run.factors) == 2 else _marginal_figure(run)


def _joint_figure(run: Run) -> Figure:
    steps = belief_steps(run)
    columns = min(4, len(steps))
    rows = -(-len(steps) // columns)
    right = 0.115 + 0.785 * columns / 4
    figure, grid = style.panels(
        rows, columns, 0.95 + 1.62 * rows, 0.52, 0.43, left=0.075, right=right, wspace=0.12, hspace=0.30
    )
    for axes, step in zip(style.keep_first_panels(grid, len(steps)), steps, strict=True):
        image = _map(axes, run, run["filtered/probability"][step], **_PROBABILITY)
        axes.set_title(f"{run.step} {run.first_step + step}", fontweight="normal", pad=3.0)
        x, y = run.scales * run["filtered/mean"][step]
        axes.plot(x, y, **_MEAN, linestyle="none", markeredgewidth=1.1, label="mean of the belief")
        if run.truth is not None:
            x, y = run.scales * run.truth[step]
            for color, width in (("white", 2.6), (style.TRUTH, 1.2)):
                axes.plot(x, y, **_RING, markeredgecolor=color, markeredgewidth=width, label="truth")
        axes.set_xlabel(run.factors[0].label, labelpad=2.0)
        axes.set_ylabel(run.factors[1].label, labelpad=2.0)
        axes.label_outer()
    height = figure.get_figheight()
    place = figure.add_axes((right + 0.015, 0.43 / height, 0.013, 1 - 0.95 / height))
    style.color_bar(figure, image, "probability", cax=place)
    style.shared_legend(figure, bbox_to_anchor=(0.5, 1.0))
    return figure


def step_map(axes: Axes, run: Run, values: Float, first: int, **look: Any) -> Any:
    """Draw values (T, n) over the steps, those of a step one above the other from `first` on."""
    steps, places = np.arange(run.steps + 1) + run.first_step, np.arange(values.shape[1] + 1) + first
    return axes.pcolormesh(steps - 0.5, places - 0.5, values.T, **look)


def _marginal_figure(run: Run) -> Figure:
    count = len(run.factors)
    figure, grid = style.panels(count, 1, 0.6 + 1.3 * count, 0.3, 0.45, left=0.09, right=0.9, hspace=0.5)
    for index, (factor, (axes,)) in enumerate(zip(run.factors, grid, strict=True)):
        marginal = run.model.states.marginal(run["filtered/probability"], run.model.states.names[index])
        places = np.arange(len(factor.levels))
        image = step_map(axes, run, marginal, 0, **_PROBABILITY)
        if run.truth is not None:
            truth = np.interp(factor.scale * run.truth[:, index], factor.levels, places)
            axes.plot(run.numbers, truth, color=style.TRUTH, linewidth=1.0, label="truth")
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
    handles: list[Any] = style.swatches(run.controls, colors, edgecolor=style.REFERENCE, linewidth=0.5)
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
