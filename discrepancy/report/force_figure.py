"""The picture of a missing force: over what it depends on, with its free shape and its law."""

from math import ceil
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from discrepancy.campaign.records import FloatArray
from discrepancy.judgement.curve_words import curve_in_words
from discrepancy.missing_force.port_force import LEAST_IN_BIN, MOST_BINS, MissingForce, TrialForce
from discrepancy.report.residual_figures import new_panels
from discrepancy.report.verdict_sentences import MOTION_OF_FORCE_UNIT, port_motion_units
from fe.runtime.patch import TableDamping, TableStiffness
from reporting.pages import figures as style

MOST_DOTS = 3000
"""Most dots of a panel; longer records are thinned evenly."""
MOST_FORCE_SAMPLES = 400
"""Most samples of the force in a panel over time, centred on its largest value."""
LEAST_SHAPE_POINTS = 8
"""Least number of values of a variable for a shape in words."""
WIDE = 1.5
"""Width of the panel over what the force depends on, over that of the others."""


class Variable(NamedTuple):
    """A variable over which a force is drawn: its name among those of a trial, and its label."""

    name: str
    label: str


def missing_force_figure(missing: MissingForce) -> Figure:
    """Draw a missing force over what it depends on, over another motion, and over time.

    The first panel also has the mean force at equal values of the variable, as a line with a band
    of two standard deviations: the shape of the force without any law. With a law, a further panel
    has the force that remains beside it.
    """
    variables = _variables(missing)
    noun, *_ = port_motion_units(missing.at_port)
    title = f"missing {noun}"
    if missing.law:
        figure, ((first, second), (left, over_time)) = new_panels(
            2, 2, 4.2, width_ratios=(WIDE, 1.0)
        )
        panels = [first, second, left, over_time]
        titles = [title, title, f"remaining {noun}", title]
    else:
        figure, ((first, second, over_time),) = new_panels(1, 3, 2.4, width_ratios=(WIDE, 1.0, 1.0))
        panels = [first, second, over_time]
        titles = [title] * 3
    _draw_over(first, missing, variables[0], "force")
    _draw_free_shape(first, missing, variables[0])
    _draw_over(second, missing, variables[1], "force")
    if missing.law:
        _draw_over(left, missing, variables[0], "left")
        left.set_ylim(first.get_ylim())
    _draw_over_time(over_time, missing)
    for axes, letter, panel_title in zip(panels, "abcd", titles, strict=False):
        axes.axhline(0.0, color=style.REFERENCE, lw=0.6, zorder=0)
        axes.locator_params(axis="x", nbins=5)  # the integral of a state may have six digits
        axes.set_ylabel(f"{noun}, {missing.at_port.unit}")
        style.panel_label(axes, letter, panel_title)
    handles, labels = first.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=3, markerscale=3.0)
    return figure


def _variables(missing: MissingForce) -> tuple[Variable, Variable]:
    """Return the variable that the force depends on, and another one.

    If it depends on neither motion of its port alone nor on an input, they are displacement and
    velocity. At a port of a state they are the state, and the first recorded input or the integral
    of the state.
    """
    _, displacement_unit, speed_unit = port_motion_units(missing.at_port)
    names = dict.fromkeys(name for course in missing.courses for name in course.variables)
    recorded = {name: Variable(name, name.removeprefix("the ")) for name in names}
    first = Variable("position", f"displacement, {displacement_unit}")
    second = Variable("speed", f"velocity, {speed_unit}")
    if not displacement_unit:
        integral = Variable("position", "integral of the state")
        first = Variable("speed", f"state, {speed_unit}")
        second = next(iter(recorded.values()), integral)
    followed = next(iter(missing.at_port.ordered_by), "")
    if followed == "velocity":
        return second, first
    if followed in recorded:
        return recorded[followed], first
    return first, second


def _joined(missing: MissingForce, variable: Variable, series: str) -> tuple[FloatArray, ...]:
    """Return a variable and a series of all trials that have it, joined and thinned.

    They are ordered as in the trials. Where trials have no such series, both are empty.
    """
    sample_count = sum(len(course.time) for course in missing.courses)
    stride = max(1, ceil(sample_count / MOST_DOTS))
    xs: list[FloatArray] = [np.zeros(0)]
    ys: list[FloatArray] = [np.zeros(0)]
    for course in missing.courses:
        x = _values_of(course, variable)
        y = getattr(course, series)
        if x is not None and y is not None:
            xs.append(x[::stride])
            ys.append(y[::stride])
    return np.concatenate(xs), np.concatenate(ys)


def _values_of(course: TrialForce, variable: Variable) -> FloatArray | None:
    """Return the values of a variable in a trial; None if the trial does not have it."""
    motions = {"position": course.position, "speed": course.speed}
    return motions.get(variable.name, course.variables.get(variable.name))


def _draw_over(axes: Axes, missing: MissingForce, variable: Variable, series: str) -> None:
    """Draw a force over a variable, with its law; `series` is "force" or "left"."""
    x, force = _joined(missing, variable, series)
    axes.plot(x, force, ".", color=style.OBSERVED, ms=2.0, alpha=0.35, label="seen")
    if series == "force" and missing.law:
        x, law = _joined(missing, variable, "law")
        axes.plot(x, law, ".", color=style.PREDICTION, ms=1.6, label=missing.law, zorder=4)
    axes.set_xlabel(variable.label)


class FreeShape(NamedTuple):
    """The mean force at S values of a variable, without any law.

    Attributes
    ----------
    values : (S,) array
        The values of the variable [SI].
    force, deviation : (S,) array
        The mean force there, and the standard deviation of the force about it [unit of the force].
    """

    values: FloatArray
    force: FloatArray
    deviation: FloatArray


def free_shape(missing: MissingForce, variable: Variable) -> FreeShape:
    """Return the mean force over a variable, from lines through the samples of equal stretches.

    Stretches with fewer than `LEAST_IN_BIN` samples are left out.
    """
    x, force = _joined(missing, variable, "force")
    edges = np.linspace(x.min(), x.max(), MOST_BINS + 1)
    if x.min() < 0.0 < x.max():
        edges[1 + int(np.argmin(np.abs(edges[1:-1])))] = 0.0  # a force may change with the sign
    stretch_of_sample = np.clip(np.searchsorted(edges, x) - 1, 0, MOST_BINS - 1)
    rows = []
    for stretch in range(MOST_BINS):
        in_stretch = stretch_of_sample == stretch
        if np.count_nonzero(in_stretch) < LEAST_IN_BIN or not np.ptp(x[in_stretch]) > 0.0:
            continue
        centre = float(x[in_stretch].mean())
        slope, mean = np.polyfit(x[in_stretch] - centre, force[in_stretch], 1)
        about_line = force[in_stretch] - mean - slope * (x[in_stretch] - centre)
        rows.append((centre, float(mean), float(about_line.std())))
    return FreeShape(*np.array(rows).reshape(-1, 3).T)


def shape_in_words(missing: MissingForce | None) -> str:
    """Return the free shape of a force over displacement or velocity in words.

    It is empty if the force does not follow one of the two alone, or at a port of a state.
    """
    if missing is None or missing.at_port.ordered_by not in (("displacement",), ("velocity",)):
        return ""
    force_unit = missing.at_port.unit
    variable, _ = _variables(missing)
    shape = free_shape(missing, variable)
    if force_unit not in MOTION_OF_FORCE_UNIT or len(shape.values) < LEAST_SHAPE_POINTS:
        return ""
    values = tuple(shape.values.tolist())
    forces = tuple(shape.force.tolist())
    curve: TableStiffness | TableDamping = TableStiffness(missing.at_port.port, values, forces)
    if variable.name == "speed":
        curve = TableDamping(missing.at_port.port, values, forces)
    return curve_in_words(curve, force_unit)


def _draw_free_shape(axes: Axes, missing: MissingForce, variable: Variable) -> None:
    """Draw the mean force at equal values of a variable, with a band of two deviations."""
    shape = free_shape(missing, variable)
    low = shape.force - 2.0 * shape.deviation
    high = shape.force + 2.0 * shape.deviation
    style.band(axes, shape.values, low, high, style.PAST)
    label = "mean, ± 2 deviations"
    axes.plot(shape.values, shape.force, color=style.PAST, lw=1.2, label=label, zorder=3)


def _draw_over_time(axes: Axes, missing: MissingForce) -> None:
    """Draw the force with two deviations around its largest value, in the trial with that value."""
    strongest = max(missing.courses, key=lambda course: float(np.max(np.abs(course.force))))
    first = int(np.argmax(np.abs(strongest.force))) - MOST_FORCE_SAMPLES // 2
    first = max(min(first, len(strongest.time) - MOST_FORCE_SAMPLES), 0)
    drawn = slice(first, first + MOST_FORCE_SAMPLES)
    time = strongest.time[drawn]
    force = strongest.force[drawn]
    two_deviations = 2.0 * strongest.deviation[drawn]
    style.band(axes, time, force - two_deviations, force + two_deviations, style.OBSERVED)
    axes.plot(time, force, color=style.OBSERVED, lw=0.9)
    if strongest.law is not None:
        axes.plot(time, strongest.law[drawn], "--", color=style.PREDICTION, lw=0.9)
    axes.set_xlabel(f"time in {strongest.trial}, s")
