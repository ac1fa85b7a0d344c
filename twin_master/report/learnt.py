"""What the twin learnt of what does not change in time: its course over the turns, and its last values."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from reporting import figures as style
from reporting.page import Column, Table
from reporting.words import parameter_title
from twin_master.report.data import LearntCourse, RunRecord
from twin_master.report.text import number
from twin_master.report.view import capital, sensor_title, sensor_word
from twin_master.store.mission_result import printed_learnt

__all__ = ["learnt_caption", "learnt_figure", "learnt_tables"]

Float = NDArray[np.floating[Any]]

_ROW_HEIGHT = 1.55
_TITLES = {
    "noise_scale": "Noise, as a factor on the assumed one",
    "gauge_gain": "Gain error",
    "gauge_offset": "Offset",
    "transition_factor": "Factor on the transitions",
}
_TRUTH: dict[str, Any] = {"color": style.TRUTH, "linewidth": 1.0, "linestyle": (0, (4, 1.5, 1, 1.5))}


@dataclass(frozen=True)
class _Printed:
    """A learnt quantity in printed units; the attributes are those of `LearntCourse`."""

    title: str
    unit: str
    course: Float
    prior: Float
    truth: Float | None

    @property
    def label(self) -> str:
        return f"{self.title} ({self.unit})" if self.unit else self.title


def _printed(learnt: LearntCourse) -> _Printed:
    scale, unit = printed_learnt(learnt.name, learnt.unit)
    title = _TITLES.get(learnt.name, capital(parameter_title(learnt.name)))
    truth = None if learnt.truth is None else scale * learnt.truth
    return _Printed(
        title, "µε" if unit == "microstrain" else unit, scale * learnt.course, scale * learnt.prior, truth
    )


def _most(shown: _Printed) -> int:
    """Return the sensor whose last value departs most from its prior, in its standard deviations."""
    last = shown.course[-1]
    return int(np.nanargmax(np.abs(last[:, 0] - shown.prior[:, 0]) / last[:, 1]))


def learnt_figure(record: RunRecord) -> Figure | None:
    """Draw each learnt quantity over the turns with its 90 % band; None where nothing is learnt.

    Of quantities of each sensor the one that departs most from its prior has the band, and beside it stand
    the last values of all sensors.
    """
    if not record.learnt:
        return None
    whole = [_printed(learnt) for learnt in record.learnt if learnt.course.ndim == 2]
    of_sensors = [_printed(learnt) for learnt in record.learnt if learnt.course.ndim == 3]
    rows = -(-len(whole) // 2) + len(of_sensors)
    labels = iter("abcdefghijklmnopqrstuvwxyz")
    with style.publication_style():
        figure = style.new_figure(0.85 + _ROW_HEIGHT * rows)
        height = figure.get_figheight()
        grid = figure.add_gridspec(
            rows, 2, left=0.08, right=0.985, top=1.0 - 0.52 / height, bottom=0.42 / height,
            hspace=0.62, wspace=0.22,
        )  # fmt: skip
        for place, shown in enumerate(whole):
            row, column = divmod(place, 2)
            alone = place == len(whole) - 1 and column == 0
            axes = figure.add_subplot(grid[row, :] if alone else grid[row, column])
            _course_panel(axes, record, shown)
            style.panel_label(axes, next(labels), shown.label)
        for row, shown in enumerate(of_sensors, start=rows - len(of_sensors)):
            axes = figure.add_subplot(grid[row, 0])
            chosen = _most(shown)
            _sensors_panel(axes, record, shown, chosen)
            style.panel_label(axes, next(labels), shown.label)
            beside = figure.add_subplot(grid[row, 1], sharey=axes)
            _last_panel(beside, record, shown, chosen)
            style.panel_label(beside, next(labels), f"After the last {record.step_word}")
        _legend(figure, record, bool(of_sensors))
    return figure


def _steps(record: RunRecord) -> Float:
    return np.arange(record.first_step, record.first_step + record.step_count, dtype=np.float64)


def _band(axes: Axes, record: RunRecord, course: Float, prior: Float) -> None:
    """Draw a course (T, 4) with its band, from its prior (4,) before the first turn on."""
    steps = _steps(record)
    before = steps[0] - 1.0 if record.first_step == 0 else None
    axes.fill_between(
        steps, course[:, 2], course[:, 3], color=style.PRESENT, alpha=style.BAND_OPACITY, linewidth=0
    )
    axes.plot(steps, course[:, 0], color=style.PRESENT)
    if before is not None:
        axes.errorbar(
            [before], [prior[0]], yerr=[[prior[0] - prior[2]], [prior[3] - prior[0]]], color=style.PAST,
            marker="s", markersize=3.2, capsize=2.0, elinewidth=1.2, linestyle="none", zorder=4,
        )  # fmt: skip


def _axis_of_steps(axes: Axes, record: RunRecord) -> None:
    steps = _steps(record)
    axes.set_xlim(steps[0] - 1.8, steps[-1] + 0.8)
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.grid(axis="y")
    axes.set_xlabel(record.step_word, labelpad=1.0)


def _course_panel(axes: Axes, record: RunRecord, shown: _Printed) -> None:
    _band(axes, record, shown.course, shown.prior)
    if shown.truth is not None:
        axes.axhline(float(shown.truth), **_TRUTH)
    _axis_of_steps(axes, record)


def _sensors_panel(axes: Axes, record: RunRecord, shown: _Printed, chosen: int) -> None:
    steps = _steps(record)
    for sensor in range(shown.course.shape[1]):
        if sensor != chosen:
            axes.plot(steps, shown.course[:, sensor, 0], color=style.REFERENCE, linewidth=0.5, alpha=0.8)
    _band(axes, record, shown.course[:, chosen], shown.prior[chosen])
    if shown.truth is not None and np.isfinite(shown.truth[chosen]):
        axes.axhline(float(shown.truth[chosen]), **_TRUTH)
    axes.text(
        0.99, 0.97, sensor_title(record, chosen), transform=axes.transAxes, ha="right", va="top",
        color=style.PRESENT,
    )  # fmt: skip
    _axis_of_steps(axes, record)


def _last_panel(axes: Axes, record: RunRecord, shown: _Printed, chosen: int) -> None:
    last, place = shown.course[-1], np.asarray(record.sensors, dtype=np.float64)
    axes.bar(
        place, shown.prior[:, 3] - shown.prior[:, 2], bottom=shown.prior[:, 2], width=1.0, color=style.PAST,
        alpha=0.12, linewidth=0,
    )  # fmt: skip
    for index in range(len(place)):
        color = style.PRESENT if index == chosen else style.OBSERVED
        mean, _, low, high = last[index]
        axes.errorbar(
            [place[index]], [mean], yerr=[[mean - low], [high - mean]], color=color, marker="o",
            markersize=2.6, elinewidth=1.0, linestyle="none",
        )  # fmt: skip
    if shown.truth is not None:
        axes.hlines(shown.truth, place - 0.45, place + 0.45, color=style.TRUTH, linewidth=1.0, zorder=3)
    axes.set_xlim(place[0] - 0.8, place[-1] + 0.8)
    axes.xaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 4, 5, 10], integer=True))
    axes.grid(axis="y")
    axes.set_xlabel(sensor_word(record).lower(), labelpad=1.0)


def _legend(figure: Figure, record: RunRecord, of_sensors: bool) -> None:
    handles = [
        Line2D([], [], color=style.PAST, marker="s", markersize=3.2, label="prior, 90 %"),
        Line2D([], [], color=style.PRESENT, label="learnt, 90 % band"),
    ]
    if of_sensors:
        word = sensor_word(record).lower()
        handles.append(Line2D([], [], color=style.REFERENCE, linewidth=0.8, label=f"other {word}s"))
    if any(learnt.truth is not None for learnt in record.learnt):
        handles.append(Line2D([], [], **_TRUTH, label="truth"))
    figure.legend(handles=handles, loc="upper center", ncols=len(handles), bbox_to_anchor=(0.53, 1.0))


def learnt_caption(record: RunRecord) -> str:
    """Return the caption of what was learnt."""
    step, word = record.step_word, sensor_word(record).lower()
    sentences = [
        f"Mean and central 90 % interval of what does not change in time, given all observations up to the "
        f"{step}. Blue: the prior, before the first {step}."
    ]
    if any(learnt.course.ndim == 3 for learnt in record.learnt):
        sentences.append(
            f"Of the {word}s on the left: the one named, which departs most from its prior, has the band, "
            f"and grey are the means of the others; on the right all of them, and as a blue band their prior."
        )
    if any(learnt.truth is not None for learnt in record.learnt):
        sentences.append("The truth is that of the simulated asset; the twin does not know it.")
    return " ".join(sentences)


def learnt_tables(record: RunRecord) -> list[tuple[Table, str, str]]:
    """Return the last values: a table of the asset and one of its sensors, each with caption and title."""
    tables = []
    whole = [_printed(learnt) for learnt in record.learnt if learnt.course.ndim == 2]
    truth = any(shown.truth is not None for shown in whole)
    if whole:
        columns = ["prior, mean", "standard deviation", "learnt, mean", "standard deviation", "90 % interval"]
        rows = [
            (
                shown.label,
                *(number(float(value)) for value in (*shown.prior[:2], *shown.course[-1, :2])),
                f"{number(float(shown.course[-1, 2]))} to {number(float(shown.course[-1, 3]))}",
                *([number(None if shown.truth is None else float(shown.truth))] if truth else []),
            )
            for shown in whole
        ]
        heads = [Column(name, numeric=True) for name in (*columns, *(["truth"] if truth else []))]
        tables.append(
            (
                Table((Column("quantity"), *heads), rows),
                f"After the last {record.step_word}, given all observations. {_worsening(record)}".strip(),
                "What was learnt of the asset",
            )
        )
    of_sensors = [_printed(learnt) for learnt in record.learnt if learnt.course.ndim == 3]
    if of_sensors:
        tables.append(_sensor_table(record, of_sensors))
    return tables


def _sensor_table(record: RunRecord, of_sensors: Sequence[_Printed]) -> tuple[Table, str, str]:
    word = sensor_word(record).lower()
    heads = [Column(shown.title, shown.unit, numeric=True) for shown in of_sensors]
    rows = [
        (
            sensor_title(record, sensor),
            *(_with_interval(shown.course[-1, sensor]) for shown in of_sensors),
        )
        for sensor in range(len(record.sensors))
    ]
    before = "; ".join(
        f"{shown.title.lower()} {_with_interval(_typical(shown.prior))}" for shown in of_sensors
    )
    return (
        Table((Column(word), *heads), rows),
        f"Mean and central 90 % interval after the last {record.step_word}. Prior: {before}.",
        f"What was learnt of the {word}s",
    )


def _typical(prior: Float) -> Float:
    """Return the prior of the sensors (G, 4), which is one unless the scenario gives one for each."""
    return np.asarray(np.nanmedian(prior, axis=0))


def _with_interval(figures: Float) -> str:
    mean, _, low, high = figures.tolist()
    if not np.isfinite(mean):
        return "—"
    # As many digits as an interval of this width leaves: two of the width itself.
    digits = min(max(1 - int(np.floor(np.log10(high - low))), 0), 9) if high > low else 6
    mean, low, high = (f"{value:.{digits}f}".replace("-", "−") for value in (mean, low, high))
    return f"{mean} ({low} to {high})"


def _worsening(record: RunRecord) -> str:
    """Return which probabilities the factor multiplies."""
    transition = record.scenario.get("transition")
    given = transition.get("probability") if isinstance(transition, Mapping) else None
    if not any(learnt.name == "transition_factor" for learnt in record.learnt) or not isinstance(
        given, Mapping
    ):
        return ""
    plain = [f"{value:g} in {name}" for name, value in given.items() if isinstance(value, int | float)]
    step = record.step_word
    return "The factor multiplies the assumed probabilities to leave a state" + (
        f", in a {step} {', '.join(plain)}." if plain else "."
    )
