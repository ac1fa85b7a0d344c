"""The quantities that a twin learnt during a mission, as figures and as rows of a table."""

from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from reporting.arrays import Float
from reporting.pages import figures as style
from reporting.words import between, rounded
from twin_master.report.reading import Moments, Run, moments_of
from twin_master.store.mission_result import LearntQuantity

_ROW_HEIGHT = 1.55  # in inches
_PRIOR_MARK: style.IntervalStyle = {
    "color": style.PAST,
    "marker": "s",
    "markersize": 3.2,
    "capsize": 2.0,
    "elinewidth": 1.2,
}
_PRIOR_COORDINATE = -1.0  # the prior is drawn where the step before the first would be


@style.publication_style()
def learnt_figure(run: Run) -> Figure:
    """Draw each learnt quantity over the steps with its 90 % band.

    A quantity of the whole asset has one panel; a quantity of each sensor has two. The left one
    shows the sensor that departs most from its prior with its band, and the means of the others;
    the right one shows all sensors after the last step.
    """
    asset_quantities = quantities_of_asset(run)
    sensor_quantities = quantities_of_sensors(run)
    asset_rows = -(-len(asset_quantities) // 2)  # two in a row, rounded up
    rows = asset_rows + len(sensor_quantities)
    labels = iter("abcdefghijklmnopqrstuvwxyz")
    figure, grid = style.panels(
        rows, 2, 0.85 + _ROW_HEIGHT * rows, 0.52, 0.42, left=0.08, hspace=0.62, wspace=0.22
    )
    _draw_asset_quantities(grid, run, asset_quantities, labels)
    for (left_axes, right_axes), quantity in zip(grid[asset_rows:], sensor_quantities, strict=True):
        most_departed = quantity.most_departed_sensor
        _draw_sensors_over_steps(left_axes, run, quantity, most_departed)
        style.panel_label(left_axes, next(labels), quantity.label)
        right_axes.sharey(left_axes)
        _draw_last_step(right_axes, run, quantity, most_departed)
        style.panel_label(right_axes, next(labels), f"After the last {run.step_word}")
    style.shared_legend(figure)
    return figure


def quantities_of_asset(run: Run) -> list[LearntQuantity]:
    """Return the learnt quantities of the whole asset."""
    return [quantity for quantity in run.learnt_quantities if not quantity.is_per_sensor]


def quantities_of_sensors(run: Run) -> list[LearntQuantity]:
    """Return the learnt quantities that have a value for each sensor."""
    return [quantity for quantity in run.learnt_quantities if quantity.is_per_sensor]


def _draw_asset_quantities(
    grid: list[list[Axes]], run: Run, quantities: Sequence[LearntQuantity], labels: Iterator[str]
) -> None:
    """Draw quantities of the whole asset, two in a row.

    If their number is odd, the last panel is as wide as the row, and the unused panel is removed.
    """
    panels = [axes for row in grid for axes in row]
    for axes, quantity in zip(panels, quantities, strict=False):
        course = moments_of(quantity.posterior)
        _draw_course(axes, run, course, moments_of(quantity.prior), quantity.truth)
        style.panel_label(axes, next(labels), quantity.label)
    if len(quantities) % 2:
        last_row = len(quantities) // 2
        left_axes, right_axes = grid[last_row]
        right_axes.remove()
        grid_of_figure = left_axes.get_gridspec()
        if grid_of_figure is not None:
            left_axes.set_subplotspec(grid_of_figure[last_row, :])


def _draw_sensors_over_steps(axes: Axes, run: Run, quantity: LearntQuantity, sensor: int) -> None:
    """Draw a quantity of one sensor with its band, and the means of the other sensors in grey."""
    means = moments_of(quantity.posterior).mean  # (T, G)
    axes.plot(
        run.step_numbers,
        np.delete(means, sensor, axis=1),
        color=style.REFERENCE,
        linewidth=0.5,
        alpha=0.8,
        label=f"other {run.sensors.word}s",
    )
    course = moments_of(quantity.posterior[:, sensor])
    prior = moments_of(quantity.prior[sensor])
    truth = None if quantity.truth is None else quantity.truth[sensor]
    _draw_course(axes, run, course, prior, truth)
    axes.text(
        0.99,
        0.97,
        run.sensors.titles[sensor],
        transform=axes.transAxes,
        ha="right",
        va="top",
        color=style.PRESENT,
    )


def _draw_course(
    axes: Axes, run: Run, course: Moments, prior: Moments, truth: Float | None
) -> None:
    """Draw posterior mean and 90 % band of a learnt quantity over the steps, and its prior.

    Parameters
    ----------
    course : Moments of (T,) arrays
        The posterior after each step.
    prior : Moments of numbers
        The prior. It is drawn before the first step, but only if the run begins with the first
        step of the mission.
    truth : number or None
        The true value, if known; NaN for a sensor of which it is not known.
    """
    steps = run.step_numbers
    style.band(axes, steps, course.lower, course.upper, style.PRESENT)
    axes.plot(steps, course.mean, color=style.PRESENT, label="learnt, 90 % band")
    if run.first_step == 0:
        style.interval(
            axes,
            _PRIOR_COORDINATE,
            float(prior.mean),
            float(prior.lower),
            float(prior.upper),
            **_PRIOR_MARK,
            zorder=4,
            label="prior, 90 %",
        )
    if truth is not None and np.isfinite(truth):
        axes.axhline(float(truth), **style.TRUTH_LINE, label="truth")
    axes.set_xlim(steps[0] - 1.8, steps[-1] + 0.8)
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.grid(axis="y")
    axes.set_xlabel(run.step_word, labelpad=1.0)


def _draw_last_step(
    axes: Axes, run: Run, quantity: LearntQuantity, highlighted_sensor: int
) -> None:
    """Draw prior 90 % range (bar), last posterior (point) and true value (line) of each sensor."""
    sensor_numbers = np.arange(1.0, len(quantity.prior) + 1.0)
    prior_moments = moments_of(quantity.prior)
    axes.bar(
        sensor_numbers,
        prior_moments.upper - prior_moments.lower,
        bottom=prior_moments.lower,
        width=1.0,
        color=style.PAST,
        alpha=0.12,
        linewidth=0,
    )
    last_moments = moments_of(quantity.posterior[-1])
    for sensor, number in enumerate(sensor_numbers):
        style.interval(
            axes,
            number,
            last_moments.mean[sensor],
            last_moments.lower[sensor],
            last_moments.upper[sensor],
            color=style.PRESENT if sensor == highlighted_sensor else style.OBSERVED,
            marker="o",
            markersize=2.6,
            elinewidth=1.0,
        )
    if quantity.truth is not None:
        axes.hlines(
            quantity.truth,
            sensor_numbers - 0.45,
            sensor_numbers + 0.45,
            color=style.TRUTH,
            linewidth=1.0,
            zorder=3,
        )
    axes.set_xlim(0.2, sensor_numbers[-1] + 0.8)
    axes.xaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 4, 5, 10], integer=True))
    axes.grid(axis="y")
    axes.set_xlabel(run.sensors.word, labelpad=1.0)


def mean_and_interval(values: Float) -> str:
    """Return the text "MEAN (LOWER to UPPER)", with digits that suit the width of the interval.

    Parameters
    ----------
    values : (4,) array
        The moments of a learnt quantity, see `Moments`; NaN if it is not learnt.
    """
    moments = moments_of(values)
    mean = float(moments.mean)
    lower = float(moments.lower)
    upper = float(moments.upper)
    if not np.isfinite(mean):
        return "—"
    return f"{rounded(mean, upper - lower)} ({between(lower, upper)})"


def sensor_rows(run: Run) -> list[list[str]]:
    """Return a table row for each sensor: title, and last value of each learnt quantity."""
    quantities = quantities_of_sensors(run)
    if not quantities:
        return []
    rows = []
    for sensor, title in enumerate(run.sensors.titles):
        values = [mean_and_interval(quantity.posterior[-1, sensor]) for quantity in quantities]
        rows.append([title, *values])
    return rows
