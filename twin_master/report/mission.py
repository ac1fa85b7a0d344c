"""The course of a mission as seen at one turn: past, present and prediction (Kapteyn et al. 2021, Fig. 6)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from reporting import figures as style
from twin_master.report.data import RunRecord
from twin_master.report.view import (
    Band,
    Course,
    capital,
    choose_sensors,
    observation_scale,
    reward_course,
    sensor_course,
    sensor_title,
    short_number,
    state_course,
    state_label,
    state_scale,
)

Float = NDArray[np.floating[Any]]

_ROW_HEIGHT = 1.22
_NARROW = 0.19
_MANY_TURNS = 120  # more have no room for gaps between bars
_MANY_DOTS = 1000
_DASHES = (0, (3, 1.2))
_TRUTH: dict[str, Any] = {
    "color": style.TRUTH,
    "linewidth": 1.0,
    "linestyle": (0, (4, 1.5, 1, 1.5)),
    "label": "truth",
}
_DOT: dict[str, Any] = {
    "color": style.OBSERVED,
    "linestyle": "none",
    "marker": "o",
    "markersize": 2.3,
    "markeredgewidth": 0.6,
}


def mission_figure(record: RunRecord, now: int, sensors: Sequence[int] | None = None) -> Figure:
    """Draw the mission as the twin sees it at turn `now`.

    Parameters
    ----------
    record
        The run.
    now
        The present turn, 0..T-1.
    sensors
        Indices of the sensors to show, from 0; by default `choose_sensors`.

    Raises
    ------
    IndexError
        `now` is no turn of the run.
    """
    if not 0 <= now < record.step_count:
        raise IndexError(f"The present turn must lie in 0..{record.step_count - 1}, not at {now}.")
    chosen = choose_sensors(record) if sensors is None else list(sensors)
    left: list[tuple[str, int]] = [("state", k) for k in range(len(record.state_names))] + [("control", 0)]
    right: list[tuple[str, int]] = [("sensor", sensor) for sensor in chosen]
    if record.filtered.reward is not None:
        for reward in range(len(record.rewards)):
            (left if len(left) <= len(right) else right).append(("reward", reward))
    rows = max(len(left), len(right))
    with style.publication_style():
        figure = style.new_figure(1.22 + _ROW_HEIGHT * rows)
        grid = figure.add_gridspec(
            rows, 2, left=0.088, right=0.985, hspace=0.42, wspace=0.28,
            top=1.0 - 0.86 / figure.get_figheight(), bottom=0.42 / figure.get_figheight(),
        )  # fmt: skip
        labels = iter("abcdefghijklmnopqrstuvwxyz")
        for column, panels in enumerate((left, right)):
            for row, (kind, index) in enumerate(panels):
                axes = figure.add_subplot(grid[row, column])
                _zones(axes, record, now, named=row == 0)
                title = _PANELS[kind](axes, record, index, now)
                style.panel_label(axes, next(labels), title)
                if row == len(panels) - 1:
                    axes.set_xlabel(record.step_word)
                else:
                    axes.tick_params(labelbottom=False)
        _legend(figure, record, now)
    return figure


def _zones(axes: Axes, record: RunRecord, now: int, *, named: bool) -> None:
    end = now + max(record.horizon, 1)
    axes.set_xlim(-0.8, end + 0.8)
    axes.axvspan(now + 0.5, end + 0.8, color=style.PREDICTION, alpha=0.06, linewidth=0)
    axes.axvline(now, color=style.PRESENT, linewidth=0.8, zorder=0.5)
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.grid(axis="y")
    axes.yaxis.set_label_coords(-0.16, 0.5)
    if named:
        where, height = axes.get_xaxis_transform(), 1.24
        axes.text(now, height, f"now: {now}", transform=where, ha="right", color=style.PRESENT)
        if now > 0.35 * end:
            axes.text(-0.8, height, "past", transform=where, ha="left", color=style.PAST)
        if record.horizon > _NARROW * end:
            axes.text(now + 0.5, height, "prediction", transform=where, ha="left", color=style.PREDICTION)


def _draw(axes: Axes, band: Band, color: str, *, prediction: bool = False, label: str = "") -> None:
    axes.fill_between(band.step, band.lower, band.upper, color=color, alpha=style.BAND_OPACITY, linewidth=0)
    line = axes.plot(band.step, band.center, color=color, label=label)[0]
    if prediction:
        line.set(linestyle=_DASHES, marker=".", markersize=3.5)


def _draw_present(axes: Axes, now: int, center: float, lower: float, upper: float) -> None:
    axes.errorbar(
        [now], [center], yerr=[[max(center - lower, 0.0)], [max(upper - center, 0.0)]], color=style.PRESENT,
        marker="D", markersize=4.2, capsize=2.0, elinewidth=1.2, linestyle="none", zorder=4, label="present",
    )  # fmt: skip


def _draw_course(axes: Axes, course: Course, now: int) -> None:
    if course.past is not None:
        _draw(axes, course.past, style.PAST, label="past")
    if course.predicted is not None:
        _draw(axes, course.predicted, style.PREDICTION, prediction=True, label="prediction")
    if course.past is not None and course.past.step[-1] == now:
        past = course.past
        _draw_present(axes, now, past.center[-1], past.lower[-1], past.upper[-1])
    if course.truth is not None:
        axes.plot(np.arange(len(course.truth)), course.truth, **_TRUTH)


def _state_panel(axes: Axes, record: RunRecord, factor: int, now: int) -> str:
    scale, _ = state_scale(record, factor)
    at_the_time = scale * record.filtered.mean[: now + 1, factor]
    axes.plot(np.arange(now + 1), at_the_time, color=style.PRESENT, linewidth=0.9, label="at the time")
    _draw_course(axes, state_course(record, factor, now), now)
    levels = scale * record.levels[factor]
    margin = 0.075 * (levels[-1] - levels[0]) or 6.0
    axes.set_ylim(levels[0] - margin, levels[-1] + margin)
    axes.set_yticks(levels, [short_number(level) for level in levels.tolist()])
    axes.set_ylabel(state_label(record, factor))
    return capital(record.state_titles[factor])


def _sensor_panel(axes: Axes, record: RunRecord, sensor: int, now: int) -> str:
    scale, unit = observation_scale(record, sensor)
    if record.observation is not None:
        observation = scale * record.observation[: now + 1 + record.horizon, sensor]
        turn = np.arange(len(observation))
        seen, later = turn <= now, turn > now
        many = len(turn) > _MANY_DOTS  # as outlines they would make the page too large
        axes.plot(turn[seen], observation[seen], **_DOT, label="observed", rasterized=many)
        axes.plot(turn[later], observation[later], **_DOT, markerfacecolor="none", label="observed later")
        lost = turn[seen & np.isnan(observation)]
        if len(lost):
            where = axes.get_xaxis_transform()
            axes.plot(
                lost, np.full(len(lost), 0.04), **{**_DOT, "marker": "x"}, transform=where, label="lost"
            )
    _draw_course(axes, sensor_course(record, sensor, now), now)
    axes.margins(y=0.12)
    axes.set_ylabel(unit if record.sensor_titles else f"{record.observation_name} ({unit})")
    return capital(sensor_title(record, sensor))


def _control_panel(axes: Axes, record: RunRecord, _index: int, now: int) -> str:
    tallest, width = 0.82, 0.8 if now + record.horizon < _MANY_TURNS else 1.0
    for control in range(len(record.controls)):
        past = np.flatnonzero(record.control_index[:now] == control)
        parts = np.split(past, np.flatnonzero(np.diff(past) > 1) + 1) if width == 1.0 else past[:, None]
        bars = [(part[0] - width / 2, part[-1] - part[0] + width) for part in parts if len(part)]
        axes.broken_barh(bars, (control, tallest), facecolors=style.PAST, linewidth=0)
        if record.control_index[now] == control:
            axes.broken_barh(
                [(now - width / 2, width)], (control, tallest), facecolors=style.PRESENT, linewidth=0
            )
        if record.control_probability is not None and record.horizon:
            axes.bar(
                now + 1.0 + np.arange(record.horizon), tallest * record.control_probability[now, :, control],
                width=width, bottom=control, color=style.PREDICTION, linewidth=0,
                label=f"predicted {control}",
            )  # fmt: skip
        axes.axhline(control, color=style.REFERENCE, linewidth=0.6)
    later = np.arange(now + 1, min(now + 1 + record.horizon, record.step_count))
    if len(later):
        axes.plot(
            later, record.control_index[later] + tallest + 0.06, linestyle="none", marker="v", markersize=3.0,
            color=style.TRUTH, markeredgewidth=0, label="flown later",
        )  # fmt: skip
    axes.grid(visible=False)
    axes.set_ylim(-0.02, len(record.controls) + 0.06)
    axes.set_yticks(np.arange(len(record.controls)) + tallest / 2, record.controls)
    axes.tick_params(axis="y", length=0)
    return "Control: flown | predicted probability"


def _reward_panel(axes: Axes, record: RunRecord, reward: int, now: int) -> str:
    _draw_course(axes, reward_course(record, reward, now), now)
    axes.margins(y=0.15)
    axes.set_ylabel("reward")
    return f"{capital(record.rewards[reward])} reward"


_PANELS = {"state": _state_panel, "sensor": _sensor_panel, "control": _control_panel, "reward": _reward_panel}


def _legend(figure: Figure, record: RunRecord, now: int) -> None:
    handles = [
        Line2D([], [], color=style.PAST, label="past"),
        Line2D([], [], color=style.PRESENT, linewidth=0.9, label="state as seen at the time"),
        Line2D([], [], color=style.PRESENT, marker="D", linestyle="none", label="present"),
    ]
    if record.horizon:
        handles.append(
            Line2D([], [], color=style.PREDICTION, linestyle=_DASHES, marker=".", label="prediction")
        )
    if record.truth_state is not None or record.truth_observation is not None:
        handles.append(Line2D([], [], **_TRUTH))
    if record.observation is not None:
        handles.append(Line2D([], [], **_DOT, label="observed"))
        if now < record.step_count - 1:
            handles.append(Line2D([], [], **_DOT, markerfacecolor="none", label="observed later"))
        if np.isnan(record.observation[: now + 1]).any():
            handles.append(Line2D([], [], **{**_DOT, "marker": "x"}, label="observation lost"))
    columns = (len(handles) + 1) // 2
    figure.legend(handles=handles, loc="upper center", ncols=columns, bbox_to_anchor=(0.53, 1.0))
