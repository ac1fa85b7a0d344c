"""The figure of a mission at one step: estimates of the past and present, and predictions.

Source: Kapteyn, Pretorius and Willcox (2021), Fig. 6.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from reporting.arrays import Float, Index
from reporting.pages import figures as style
from reporting.words import capital
from twin_master.report.reading import NORMAL_95, Run, short_number
from twin_master.scenario.schema import REWARD_NAMES

_ROW_HEIGHT = 1.22  # in inches
_STEPS_BEFORE_CHANGE = 3  # from the present of the first figure to the first change of control
_LEAST_PAST = 3  # steps before the present that a figure needs to show a course
_NARROW_ZONE = 0.19  # fraction of the width below which the prediction has no heading
_LONG_PAST = 0.35  # fraction of the width above which the past has a heading
_MANY_STEPS = 120  # more have no room for gaps between bars
_MANY_DOTS = 1000  # as outlines they would make the page too large
_BAR_HEIGHT = 0.82  # of the row of a control
_DASHES = (0, (3, 1.2))
_DOT: style.LineStyle = {
    "color": style.OBSERVED,
    "linestyle": "none",
    "marker": "o",
    "markersize": 2.3,
    "markeredgewidth": 0.6,
}
_PREDICTED_LINE: style.LineStyle = {"linestyle": _DASHES, "marker": ".", "markersize": 3.5}
_PRESENT_MARK: style.IntervalStyle = {
    "color": style.PRESENT,
    "marker": "D",
    "markersize": 4.2,
    "capsize": 2.0,
    "elinewidth": 1.2,
}

Panel = Callable[[Axes, Run, int], str]
"""Draws a panel of a run, given the axes and the row of the present step; returns its title."""


class Course(NamedTuple):
    """A mean with its interval in n successive steps; each field is an (n,) array."""

    mean: Float
    lower: Float
    upper: Float

    def scaled(self, factor: float) -> "Course":
        """Return the course in another unit, given the conversion factor."""
        return Course(factor * self.mean, factor * self.lower, factor * self.upper)


def default_present_row(run: Run) -> int:
    """Return the row of the step that is the present of the mission's figure by default.

    It lies `_STEPS_BEFORE_CHANGE` steps before the flown control first changes, so that this
    change still lies ahead. If the control never changes, or if fewer than `_LEAST_PAST` steps
    would lie before the present, it lies two thirds into the mission.
    """
    change_rows = np.flatnonzero(np.diff(run.control_index)) + 1
    if len(change_rows) and change_rows[0] >= _STEPS_BEFORE_CHANGE + _LEAST_PAST:
        return int(change_rows[0] - _STEPS_BEFORE_CHANGE)
    return round(2 * (run.step_count - 1) / 3)


def choose_sensors(run: Run, count: int = 4) -> list[int]:
    """Choose the sensors that the figure of a mission shows by default; return their indices.

    These are the sensor with the largest expected value, the first sensor, and for each factor of
    the state the sensor that responds most to it among the others. The response is the change of
    the logarithm, so that it counts only if all expected values are positive. If the sensors have
    different units, the first `count` sensors are returned.

    Parameters
    ----------
    count : int
        The largest number of sensors.
    """
    if not run.sensors.unit:  # the sensors have different units: values cannot be compared
        return list(range(min(count, len(run.sensors.titles))))
    expected_values = run["filtered/quantity_mean"]
    chosen_sensors = [int(np.argmax(np.abs(expected_values).max(axis=0)))]
    if 0 not in chosen_sensors:
        chosen_sensors.append(0)
    if np.all(expected_values > 0.0):
        for sensitivity in _sensitivities(run, expected_values):
            order = np.argsort(-sensitivity, kind="stable")
            # A sensor whose relative change is below 1e-3 hardly depends on the factor.
            other_sensors = [int(sensor) for sensor in order if int(sensor) not in chosen_sensors]
            if other_sensors and sensitivity[other_sensors[0]] > 1e-3:
                chosen_sensors.append(other_sensors[0])
    return chosen_sensors[:count]


def _sensitivities(run: Run, expected_values: Float) -> Float:
    """Return the relative change of each sensor's value with each factor, a (K, G) array.

    K is the number of factors and G the number of sensors. The logarithms of the expected values
    (T, G) are fitted by least squares as linear functions of the means of the factors, plus a
    constant for each control; the coefficients of the factors are returned.
    """
    control_indicators = np.eye(len(run.controls))[run.control_index]
    regressors = np.concatenate([run["filtered/mean"], control_indicators], axis=1)
    coefficients = np.linalg.lstsq(regressors, np.log(expected_values), rcond=None)[0]
    return np.asarray(coefficients[: len(run.factors)])


@style.publication_style()
def mission_figure(run: Run, present_row: int, sensors: Sequence[int] | None = None) -> Figure:
    """Draw states, control, sensors and rewards of a mission as the twin knows them at one step.

    Each panel shows the estimates of the past, the present step, and the predicted steps.

    Parameters
    ----------
    present_row : int
        The row of the present step in the run's arrays, from 0 to T - 1.
    sensors : sequence of int, optional
        The indices of the sensors to draw, from 0; by default those of `choose_sensors`.
    """
    columns = _panels_in_columns(run, choose_sensors(run) if sensors is None else sensors)
    rows = max(len(column) for column in columns)
    height = 1.22 + _ROW_HEIGHT * rows
    figure, grid = style.panels(rows, 2, height, 0.86, 0.42, left=0.088, hspace=0.42, wspace=0.28)
    labels = iter("abcdefghijklmnopqrstuvwxyz")
    for column_number, column in enumerate(columns):
        for row, draw_panel in enumerate(column):
            axes = grid[row][column_number]
            _draw_zones(axes, run, present_row, with_headings=row == 0)
            style.panel_label(axes, next(labels), draw_panel(axes, run, present_row))
            if row == len(column) - 1:
                axes.set_xlabel(run.step_word)
            else:
                axes.tick_params(labelbottom=False)
        for row in range(len(column), rows):
            grid[row][column_number].remove()
    style.shared_legend(figure, rows=2)
    return figure


def _panels_in_columns(run: Run, sensors: Sequence[int]) -> tuple[list[Panel], list[Panel]]:
    """Return the panels of the left and of the right column, from top to bottom.

    State factors and the control stand on the left, sensors on the right. The rewards are added one
    by one to the column that is the shorter one then.
    """
    left_column: list[Panel] = []
    for factor_index in range(len(run.factors)):
        left_column.append(partial(_draw_state, factor_index))
    left_column.append(_draw_control)

    right_column: list[Panel] = []
    for sensor_index in sensors:
        right_column.append(partial(_draw_sensor, sensor_index))

    for reward_index in range(len(REWARD_NAMES)):
        reward_panel = partial(_draw_reward, reward_index)
        if len(left_column) <= len(right_column):
            left_column.append(reward_panel)
        else:
            right_column.append(reward_panel)
    return left_column, right_column


def _draw_zones(axes: Axes, run: Run, present_row: int, *, with_headings: bool) -> None:
    """Set up the axes of a panel, and mark the present step and the zone of predicted steps.

    `with_headings` also writes "now", "past" and "prediction" above zones that are wide enough.
    """
    first_step = run.first_step
    present_step = first_step + present_row
    last_step = present_step + run.horizon
    axes.set_xlim(first_step - 0.8, last_step + 0.8)
    axes.axvspan(
        present_step + 0.5, last_step + 0.8, color=style.PREDICTION, alpha=0.06, linewidth=0
    )
    axes.axvline(present_step, color=style.PRESENT, linewidth=0.8, zorder=0.5)
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.grid(axis="y")
    axes.yaxis.set_label_coords(-0.16, 0.5)
    if not with_headings:
        return
    above = axes.get_xaxis_transform()
    height = 1.24
    axes.text(
        present_step,
        height,
        f"now: {present_step}",
        transform=above,
        ha="right",
        color=style.PRESENT,
    )
    if present_row > _LONG_PAST * (last_step - first_step):
        axes.text(first_step - 0.8, height, "past", transform=above, ha="left", color=style.PAST)
    if run.horizon > _NARROW_ZONE * (last_step - first_step):
        axes.text(
            present_step + 0.5,
            height,
            "prediction",
            transform=above,
            ha="left",
            color=style.PREDICTION,
        )


def _draw_course(
    axes: Axes, run: Run, present_row: int, course: Course, truth: Float | None
) -> None:
    """Draw a course from the first step to the last predicted one, and the true values if known.

    Parameters
    ----------
    truth : (T,) array or None
        The true value in each step; None if it is not known.
    """
    steps = run.first_step + np.arange(len(course.mean))
    _draw_part(axes, steps, course, slice(present_row + 1), color=style.PAST, label="past")
    _draw_part(
        axes,
        steps,
        course,
        slice(present_row + 1, None),
        color=style.PREDICTION,
        label="prediction",
        line=_PREDICTED_LINE,
    )
    mean = float(course.mean[present_row])
    lower = float(course.lower[present_row])
    upper = float(course.upper[present_row])
    if np.isfinite(mean):
        style.interval(
            axes, steps[present_row], mean, lower, upper, **_PRESENT_MARK, zorder=4, label="present"
        )
    if truth is not None:
        drawn_truth = truth[: len(steps)]
        axes.plot(steps[: len(drawn_truth)], drawn_truth, **style.TRUTH_LINE, label="truth")


def _draw_part(
    axes: Axes,
    steps: Index,
    course: Course,
    rows: slice,
    color: str,
    label: str,
    line: style.LineStyle | None = None,
) -> None:
    """Draw part of a course as a line with a band, in the steps where it has values."""
    has_value = np.isfinite(course.mean[rows])
    if not has_value.any():
        return
    part_steps = steps[rows][has_value]
    style.band(
        axes, part_steps, course.lower[rows][has_value], course.upper[rows][has_value], color
    )
    axes.plot(part_steps, course.mean[rows][has_value], color=color, label=label, **(line or {}))


def _past_and_predicted(run: Run, variable: str, index: int, present_row: int) -> Float:
    """Return estimates up to the step in row `present_row` and predictions after it, (n,), SI.

    Past estimates are smoothed, given all observations, if the step is the last one; otherwise they
    are filtered, each given the observations up to its own step.
    """
    past_group = "smoothed" if present_row == run.step_count - 1 else "filtered"
    past_values = run[f"{past_group}/{variable}"][: present_row + 1, ..., index]
    predicted_values = run[f"predicted/{variable}"][present_row, ..., index]
    return np.concatenate((past_values, predicted_values))


def _quantity_course(run: Run, sensor: int, present_row: int) -> Course:
    """Return the noise-free value at a sensor with its 95 % intervals, in SI units."""
    return Course(
        mean=_past_and_predicted(run, "quantity_mean", sensor, present_row),
        lower=_past_and_predicted(run, "quantity_lower", sensor, present_row),
        upper=_past_and_predicted(run, "quantity_upper", sensor, present_row),
    )


def _state_course(run: Run, index: int, present_row: int) -> Course:
    """Return the mean of a factor and two standard deviations around it, in printed units.

    The band is clipped to the range of the levels. Past values are moments of the smoothed belief
    p(D_t | o_0..o_now), predicted ones of p(D_{now+h} | o_0..o_now) for h steps ahead.
    """
    factor = run.factors[index]
    if present_row == run.step_count - 1:
        past_mean = run["smoothed/mean"]
        past_deviation = run["smoothed/standard_deviation"]
    else:
        belief = run.smoothed_until(present_row)
        past_mean = run.model.states.mean(belief)
        past_deviation = run.model.states.standard_deviation(belief)
    predicted_mean = run["predicted/mean"][present_row]
    predicted_deviation = run["predicted/standard_deviation"][present_row]
    mean = factor.scale * np.vstack((past_mean, predicted_mean))[:, index]
    deviation = factor.scale * np.vstack((past_deviation, predicted_deviation))[:, index]
    lowest_level = factor.levels[0]
    highest_level = factor.levels[-1]
    return Course(
        mean=mean,
        lower=np.clip(mean - 2.0 * deviation, lowest_level, highest_level),
        upper=np.clip(mean + 2.0 * deviation, lowest_level, highest_level),
    )


def _draw_state(index: int, axes: Axes, run: Run, present_row: int) -> str:
    """Draw the belief of one factor of the state, and return the title of the panel."""
    factor = run.factors[index]
    axes.plot(
        run.step_numbers[: present_row + 1],
        factor.scale * run["filtered/mean"][: present_row + 1, index],
        color=style.PRESENT,
        linewidth=0.9,
        label="as seen at the time",
    )
    truth = None if run.true_state is None else factor.scale * run.true_state[:, index]
    _draw_course(axes, run, present_row, _state_course(run, index, present_row), truth)
    lowest_level = factor.levels[0]
    highest_level = factor.levels[-1]
    margin = 0.075 * (highest_level - lowest_level)
    if margin == 0.0:  # a factor with one level
        margin = 6.0
    axes.set_yticks(factor.levels, [short_number(level) for level in factor.levels])
    axes.set(ylim=(lowest_level - margin, highest_level + margin), ylabel=factor.label)
    return capital(factor.title)


def _draw_sensor(sensor: int, axes: Axes, run: Run, present_row: int) -> str:
    """Draw readings and expected values of a sensor, and return the title of the panel."""
    sensors = run.sensors
    readings = sensors.scale * run.observations[: present_row + 1 + run.horizon, sensor]
    steps = run.step_numbers[: len(readings)]
    _draw_readings(axes, steps, readings, present_row)
    true_quantity = run.get(f"truth/{sensors.quantity}")
    truth = None if true_quantity is None else sensors.scale * true_quantity[:, sensor]
    course = _quantity_course(run, sensor, present_row).scaled(sensors.scale)
    _draw_course(axes, run, present_row, course, truth)
    axes.margins(y=0.12)
    unit = sensors.units[sensor]
    axes.set_ylabel(unit if sensors.named else f"{sensors.quantity} ({unit})")
    return capital(sensors.titles[sensor])


def _draw_readings(axes: Axes, steps: Index, readings: Float, present_row: int) -> None:
    """Draw readings as dots, and lost readings as crosses at the bottom.

    Readings after the step in row `present_row`, which the twin did not have yet, are hollow dots.
    """
    is_until_now = steps <= steps[present_row]
    is_later = steps > steps[present_row]
    is_rasterized = len(steps) > _MANY_DOTS
    axes.plot(
        steps[is_until_now],
        readings[is_until_now],
        **_DOT,
        label="observed",
        rasterized=is_rasterized,
    )
    axes.plot(
        steps[is_later], readings[is_later], **_DOT, markerfacecolor="none", label="observed later"
    )
    lost_steps = steps[is_until_now & np.isnan(readings)]
    if len(lost_steps):
        cross: style.LineStyle = {**_DOT, "marker": "x"}
        near_bottom = np.full(len(lost_steps), 0.04)
        transform = axes.get_xaxis_transform()
        axes.plot(lost_steps, near_bottom, **cross, transform=transform, label="lost")


def _draw_control(axes: Axes, run: Run, present_row: int) -> str:
    """Draw flown and predicted controls, a row for each control, and return the panel's title.

    Triangles mark the controls that were flown after the present step.
    """
    for control in range(len(run.controls)):
        _draw_control_row(axes, run, control, present_row)
    later_rows = np.arange(present_row + 1, min(present_row + 1 + run.horizon, run.step_count))
    if len(later_rows):
        axes.plot(
            run.step_numbers[later_rows],
            run.control_index[later_rows] + _BAR_HEIGHT + 0.06,
            linestyle="none",
            marker="v",
            markersize=3.0,
            color=style.TRUTH,
            markeredgewidth=0,
            label="flown later",
        )
    axes.grid(visible=False)
    axes.set_ylim(-0.02, len(run.controls) + 0.06)
    axes.set_yticks(np.arange(len(run.controls)) + _BAR_HEIGHT / 2, run.controls)
    axes.tick_params(axis="y", length=0)
    return "Control: flown | predicted probability"


def _draw_control_row(axes: Axes, run: Run, control: int, present_row: int) -> None:
    """Draw the steps in which a control was flown, and its probability in the predicted steps.

    In a short mission each step is a bar; in a long one, successive steps are one bar.
    """
    present_step = run.step_numbers[present_row]
    row_span = (control, _BAR_HEIGHT)
    has_gaps = present_row + run.horizon < _MANY_STEPS
    width = 0.8 if has_gaps else 1.0
    past_steps = run.step_numbers[:present_row][run.control_index[:present_row] == control]
    if has_gaps:
        spans = list(past_steps[:, None])
    else:
        spans = np.split(past_steps, np.flatnonzero(np.diff(past_steps) > 1) + 1)
    bars = [(span[0] - width / 2, span[-1] - span[0] + width) for span in spans if len(span)]
    axes.broken_barh(bars, row_span, facecolors=style.PAST, linewidth=0)
    if run.control_index[present_row] == control:
        bar = (present_step - width / 2, width)
        axes.broken_barh([bar], row_span, facecolors=style.PRESENT, linewidth=0)
    axes.bar(
        present_step + 1.0 + np.arange(run.horizon),
        _BAR_HEIGHT * run["predicted/control_probability"][present_row, :, control],
        width=width,
        bottom=control,
        color=style.PREDICTION,
        linewidth=0,
        label=f"_predicted {control}",  # the underscore keeps it out of the legend
    )
    axes.axhline(control, color=style.REFERENCE, linewidth=0.6)


def _draw_reward(reward: int, axes: Axes, run: Run, present_row: int) -> str:
    """Draw a reward, and return the title of the panel."""
    # The 95 % interval is that of a normal distribution.
    mean = _past_and_predicted(run, "reward_mean", reward, present_row)
    deviation = _past_and_predicted(run, "reward_standard_deviation", reward, present_row)
    half_width = NORMAL_95 * deviation
    course = Course(mean, mean - half_width, mean + half_width)
    _draw_course(axes, run, present_row, course, None)
    axes.margins(y=0.15)
    low, high = axes.get_ylim()
    if high - low < 1e-6:  # the reward is constant but for rounding
        axes.set_ylim(low - 0.1, high + 0.1)
    axes.set_ylabel("reward")
    return f"{capital(REWARD_NAMES[reward])} reward"
