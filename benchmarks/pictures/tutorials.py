"""Pictures of the tutorials that stand on no other page, of what their notebooks estimate."""

import numpy as np

from benchmarks.pictures.notebooks import notebook
from benchmarks.pictures.picture import Drawing
from reporting.pages.figures import (
    PAST,
    PREDICTION,
    REFERENCE,
    new_figure,
    publication_style,
    to_png,
)

RESOLUTION = 150.0
WIDTH = 7.2
HEIGHT = 2.2
PRESSURE_LIMIT = 50.0
"""Largest pressure drop that the scenario of the heat exchanger allows [kPa]."""
BIN_COUNT = 40


def draw_exchanger() -> Drawing:
    """Draw belief and truth of the fouling, and the pressure drop with its limit."""
    run = notebook("your_own_fmu", "open_run").names["run"]
    fouling = 100 * run["filtered"]["mean"].isel(region=0).values
    two_deviations = 200 * run["filtered"]["standard_deviation"].isel(region=0).values
    pressure_drop = run["observed"]["gauges"].isel(sensor=1).values / 1e3
    control = run["observed"]["control_index"].values
    change = int(np.flatnonzero(np.diff(control))[0]) + 1
    truth = 100 * run["truth"]["state"].isel(region=0).values
    days = np.arange(len(fouling))
    with publication_style():
        figure = new_figure(HEIGHT, WIDTH)
        figure.set_layout_engine("constrained")
        left, right = figure.subplots(1, 2)
        left.fill_between(
            days, fouling - two_deviations, fouling + two_deviations, color=PAST, alpha=0.2, lw=0
        )
        left.plot(days, fouling, color=PAST, label="belief")
        left.plot(days, truth, color="k", ls="--", lw=1, label="truth")
        left.set(xlabel="day", ylabel="fouling, %")
        left.legend(loc="upper left")
        right.plot(days, pressure_drop, ".", color=PAST)
        right.axhline(PRESSURE_LIMIT, color="k", lw=1)
        right.text(days[-1], PRESSURE_LIMIT - 0.8, "limit", ha="right", va="top")
        right.axvline(change, color=PREDICTION, lw=1)
        right.text(change + 0.5, 45, "flow is reduced", color=PREDICTION)
        right.set(xlabel="day", ylabel="pressure drop, kPa")
        png = to_png(figure, RESOLUTION)
    return Drawing(png, {"change": change})


def draw_calibrated_wing() -> Drawing:
    """Draw Young's modulus factor and servo mass before and after, and servo over pitot mass."""
    result = notebook("calibrate_a_wing", "uav_twin.calibrate").names["result"]
    servo_mass = 1e3 * result.draws_of("servo_mass")
    pitot_mass = 1e3 * result.draws_of("pitot_mass")
    histograms = (
        ("young_modulus_factor", 1.0, "factor on Young's modulus"),
        ("servo_mass", 1e3, "mass of the servos, g"),
    )
    with publication_style():
        figure = new_figure(HEIGHT, WIDTH)
        figure.set_layout_engine("constrained")
        *histogram_axes, scatter_axes = figure.subplots(1, 3)
        for axes, (name, factor, label) in zip(histogram_axes, histograms, strict=True):
            for is_prior, color in ((True, REFERENCE), (False, PAST)):
                draws = factor * result.draws_of(name, prior=is_prior)
                axes.hist(draws, BIN_COUNT, density=True, color=color, alpha=0.6)
            axes.set(xlabel=label, yticks=[])
        scatter_axes.plot(servo_mass, pitot_mass, ".", ms=3, alpha=0.3, color=PAST)
        scatter_axes.set(xlabel="mass of the servos, g", ylabel="mass of the pitot tube, g")
        png = to_png(figure, RESOLUTION)
    modulus = "young_modulus_factor"
    numbers = {
        "mean": result.mean(modulus),
        "deviation": result.standard_deviation(modulus),
    }
    return Drawing(png, numbers)
