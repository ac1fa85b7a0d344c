"""The small pictures of README.md, of what the notebooks in docs/tutorials fly, fit and learn."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.pictures.notebooks import notebook
from benchmarks.pictures.picture import Drawing
from discrepancy.report.force_figure import missing_force_figure
from reporting.pages.figures import (
    PAST,
    PREDICTION,
    REFERENCE,
    new_figure,
    publication_style,
    to_png,
)

RESOLUTION = 150.0


def small_axes(x_label: str, y_label: str) -> tuple[Figure, Axes]:
    """Return a small figure and its panel."""
    figure = new_figure(1.9, 3.2)
    figure.set_layout_engine("constrained")
    axes = figure.subplots()
    axes.set(xlabel=x_label, ylabel=y_label)
    return figure, axes


def belief_drawing(run: Any, x_label: str, y_label: str) -> Drawing:
    """Draw belief against truth of the first factor of the state, and where the control changes."""
    mean = 100 * run["filtered"]["mean"].isel(region=0).values
    two_deviations = 200 * run["filtered"]["standard_deviation"].isel(region=0).values
    truth = 100 * run["truth"]["state"].isel(region=0).values
    control = run["observed"]["control_index"].values
    change = int(np.flatnonzero(np.diff(control))[0]) + 1
    damage = int(np.flatnonzero(truth == truth[change])[0])
    with publication_style():
        figure, axes = small_axes(x_label, y_label)
        axes.fill_between(
            range(len(mean)),
            mean - two_deviations,
            mean + two_deviations,
            color=PAST,
            alpha=0.2,
            lw=0,
        )
        axes.plot(mean, color=PAST)
        axes.plot(truth, color="k", ls="--", lw=1)
        axes.axvline(change, color=PREDICTION, lw=1)
        axes.text(change + 0.5, 2, "control changes", color=PREDICTION)
        png = to_png(figure, RESOLUTION)
    return Drawing(png, {"change": change, "damage": damage})


def draw_mission() -> Drawing:
    """Draw region 1 of the paper's mission."""
    run = notebook("fly_the_mission", "open_run").names["run"]
    return belief_drawing(run, "step", "stiffness loss, %")


def draw_structure() -> Drawing:
    """Draw the crack of the bracket."""
    run = notebook("your_own_structure", "open_run").names["run"]
    return belief_drawing(run, "shift", "crack of the heel, %")


def draw_effect() -> Drawing:
    """Draw the residual of the held-out release, before and after friction is named."""
    investigation = notebook("name_an_effect", "investigate(").names["investigation"]
    curves = (
        (investigation.before, REFERENCE, "unchanged model"),
        (investigation.after, PAST, "with friction"),
    )
    with publication_style():
        figure, axes = small_axes("time, s", "residual, mm")
        for residuals, colour, label in curves:
            (held_out,) = (fitted for fitted in residuals.trials if fitted.trial.held_out)
            axes.plot(
                held_out.trial.time,
                1e3 * held_out.residual[:, 0],
                color=colour,
                lw=0.6,
                label=label,
            )
        axes.legend(loc="upper left")
        png = to_png(figure, RESOLUTION)
    (effect,) = investigation.verdict.effects
    (law,) = effect.patch
    proof = investigation.proof
    numbers = {
        "friction": law.coefficient,
        "before": proof.held_out_before.chi_square_per_sample,
        "after": proof.held_out_after.chi_square_per_sample,
    }
    return Drawing(png, numbers)


def draw_missing_force() -> Drawing:
    """Draw the missing force of the same releases, with the law through it."""
    investigation = notebook("name_an_effect", "investigate(").names["investigation"]
    force = np.concatenate(
        [force_of_trial.force for force_of_trial in investigation.missing.courses]
    )
    with publication_style():
        png = to_png(missing_force_figure(investigation.missing), 110.0)
    return Drawing(png, {"step": float(np.median(np.abs(force)))})


def draw_watch() -> Drawing:
    """Draw what the twin learns of the stiffness, and its alarm."""
    decisions = notebook("watch_and_teach", "uav_twin.watch").names["decisions"]
    learnt = [decision["learnt"]["young_modulus_factor"] for decision in decisions]
    low = [interval["lower"] for interval in learnt]
    high = [interval["upper"] for interval in learnt]
    alarm = min(decision["step"] for decision in decisions if decision["notices"])
    with publication_style():
        figure, axes = small_axes("step", "factor on Young's modulus")
        axes.fill_between(range(len(learnt)), low, high, color=PAST, alpha=0.2, lw=0)
        axes.plot([interval["mean"] for interval in learnt], color=PAST)
        axes.axhline(0.97, color="k", ls="--", lw=1)
        axes.axvline(alarm, color=PREDICTION, lw=1)
        axes.text(alarm - 0.3, max(high), "alarm: gauge 4", color=PREDICTION, ha="right", va="top")
        png = to_png(figure, RESOLUTION)
    return Drawing(png, {"alarm": alarm})


def draw_fleet() -> Drawing:
    """Draw the probabilities that a fleet learns, beside the assumed and the true ones."""
    lessons = notebook("a_fleet_that_learns", "learn_from_fleet").names["learnt"]
    rates = lessons["groups"]["north"]["probability"]
    with publication_style():
        figure, axes = small_axes("", "probability to worsen")
        for place, (control, truth) in enumerate((("2g", 0.025), ("3g", 0.05))):
            rate = rates[control]
            learnt_label, assumed_label, truth_label = (
                ("learnt", "assumed", "truth") if place else (None, None, None)
            )
            axes.plot(
                [place, place], [rate["lower_95"], rate["upper_95"]], color=PAST, lw=4, alpha=0.4
            )
            axes.plot(place, rate["mean"], "o", color=PAST, label=learnt_label)
            axes.plot(place, rate["assumed"], "x", color=REFERENCE, label=assumed_label)
            axes.plot([place - 0.2, place + 0.2], [truth, truth], "k--", lw=1, label=truth_label)
        axes.set(xticks=[0, 1], xticklabels=["gentle turn", "sharp turn"], ylim=(0, None))
        axes.legend(loc="upper left")
        png = to_png(figure, RESOLUTION)
    sharp = rates["3g"]
    numbers = {
        "assumed": 100.0 * sharp["assumed"],
        "mean": 100.0 * sharp["mean"],
        "low": 100.0 * sharp["lower_95"],
        "high": 100.0 * sharp["upper_95"],
    }
    return Drawing(png, numbers)
