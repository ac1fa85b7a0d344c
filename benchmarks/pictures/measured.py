"""Pictures of what others measured: rigs and the real wing, and of two models of one design."""

from functools import cache
from pathlib import Path

import numpy as np

import uav_twin
from benchmarks.pictures.notebooks import folder_until_exit
from benchmarks.pictures.picture import Drawing
from benchmarks.public_rigs.__main__ import write as write_public_rig
from discrepancy.campaign.records import Trial
from discrepancy.fits.problem import Problem
from discrepancy.judgement.curve_words import curve_of
from discrepancy.report.force_figure import missing_force_figure
from discrepancy.sources.measured_rigs import write_rig_campaign
from discrepancy.workflow import Investigation
from evidence.sandwich_plate.plate_comparison import DAMAGE, PlateAgreement, compare_with_plate
from fe.runtime.patch import TableDamping
from fe.wing.design import load_design
from reporting.pages.figures import (
    OBSERVED,
    PAST,
    PREDICTION,
    REFERENCE,
    new_figure,
    panel_label,
    publication_style,
    to_png,
)

BEGIN_OF_RECORDS = 0.8
"""Seconds after the release from which on the ring-downs of the real wing are used."""


def force_drawing(investigation: Investigation) -> bytes:
    """Return the picture of a missing force as PNG."""
    if investigation.missing is None:
        raise ValueError(
            f"No force is missing in {investigation.campaign.name!r}: nothing can be drawn."
        )
    with publication_style():
        return to_png(missing_force_figure(investigation.missing), 110.0)


def largest_force(investigation: Investigation) -> float:
    """Return the largest missing force of all courses."""
    assert investigation.missing is not None
    return max(float(np.max(np.abs(course.force))) for course in investigation.missing.courses)


@cache
def real_wing(data: Path) -> Investigation:
    """Investigate the published ring-downs and loading runs of the real wing, as its page does."""
    return uav_twin.investigate(write_rig_campaign("real_wing", data, folder_until_exit()))


def draw_real_wing_force(data: Path) -> Drawing:
    """Draw the force that the wing model lacks."""
    investigation = real_wing(data)
    return Drawing(force_drawing(investigation), {"largest": largest_force(investigation)})


def draw_real_wing_residuals(data: Path) -> Drawing:
    """Draw the first ring-down, and its residuals without and with the effects."""
    investigation = real_wing(data)
    problem = investigation.problem
    search = investigation.search
    fit = investigation.fit
    assert isinstance(problem, Problem), "a campaign without faults has a problem"
    assert search is not None, "a campaign without faults has a search"
    assert fit is not None, "a campaign without faults has a fit"
    number = next(place for place, fitted in enumerate(problem.trials) if fitted.trial.is_dynamic)
    trial: Trial = problem.trials[number].trial
    assert trial.time is not None, "a ring-down has times"
    time = trial.time + BEGIN_OF_RECORDS
    rows = ((search.no_effect, "wing model, refitted"), (fit, "with the effects"))
    root_mean_squares = []
    with publication_style():
        figure = new_figure(5.2, 6.4)
        figure.set_layout_engine("constrained")
        signal_axes, *residual_axes = figure.subplots(3, 1, sharex=True)
        signal_axes.plot(time, 1e3 * trial.values[:, 0], lw=0.8, color="black")
        signal_axes.set_ylabel("signal, mV")
        for axes, (candidate_fit, label) in zip(residual_axes, rows, strict=True):
            prediction = problem.prediction(
                number, candidate_fit.point, candidate_fit.responses[number]
            )
            residual = 1e6 * (trial.values - prediction)[:, 0]
            root_mean_squares.append(float(np.sqrt(np.mean(residual**2))))
            axes.plot(time, residual, lw=0.8, color=PAST)
            axes.set_ylabel("residual, µV")
            axes.set_title(label)
        residual_axes[1].set_ylim(residual_axes[0].get_ylim())
        residual_axes[1].set_xlabel("time since the release, s")
        png = to_png(figure, 90.0)
    without, with_effects = root_mean_squares
    return Drawing(png, {"without": without, "with_effects": with_effects})


def draw_falling_phone(data: Path) -> Drawing:
    """Draw the force that a mass under gravity lacks when a phone falls."""
    folder = write_rig_campaign("falling_phone", data, folder_until_exit())
    investigation = uav_twin.investigate(folder, folder / "model.toml")
    return Drawing(force_drawing(investigation), {"falls": len(investigation.campaign.trials)})


def draw_cooling_water(data: Path) -> Drawing:
    """Draw the heat flow that Newton's law of cooling lacks for a mug of water."""
    folder = write_public_rig("cooling_water", data.parent, folder_until_exit() / "cooling_water")
    investigation = uav_twin.investigate(folder, folder / "model.toml")
    curve = curve_of(investigation.verdict.effects)
    assert isinstance(curve, TableDamping), "a law at a port of a state takes it for a speed"
    numbers = {"flow": float(curve.forces[-1]), "excess": float(curve.speeds[-1])}
    return Drawing(force_drawing(investigation), numbers)


def draw_plate_against_box() -> Drawing:
    """Draw gauge strains of box and sandwich plate over the span, and their ratios under damage."""
    design = load_design()
    agreement = compare_with_plate(design)
    distance = np.array([place for place, _ in design.gauges.positions])
    with publication_style():
        figure = new_figure(2.6)
        strain_axes, ratio_axes = figure.subplots(1, 2)
        strain_axes.plot(distance, 1e6 * agreement.box.strain, "o", color=OBSERVED, label="box")
        strain_axes.plot(
            distance, 1e6 * agreement.plate.strain, "x", color=PAST, label="sandwich plate"
        )
        panel_label(strain_axes, "a", f"strain at {design.lift.load_factor:g}g")
        strain_axes.set_ylabel("microstrain")
        for region, color in enumerate((PREDICTION, PAST)):
            name = f"z{region + 1} = {100 * DAMAGE:.0f} %"
            box_ratio = agreement.box.damage_ratio[region]
            plate_ratio = agreement.plate.damage_ratio[region]
            ratio_axes.plot(distance, box_ratio, "o", color=color, mfc="none", label=f"box, {name}")
            ratio_axes.plot(distance, plate_ratio, "x", color=color, label=f"plate, {name}")
        ratio_axes.axhline(1.0, color=REFERENCE, linewidth=0.7)
        panel_label(ratio_axes, "b", "strain over healthy strain")
        for axes in (strain_axes, ratio_axes):
            axes.set_xlabel("distance from the root, m")
            axes.legend()
        figure.tight_layout()
        png = to_png(figure, 150.0)
    return Drawing(png, strain_difference(agreement))


def strain_difference(agreement: PlateAgreement) -> dict[str, float]:
    """Return the rms and the largest difference of plate and box strains [%], with its gauge."""
    relative = 100.0 * np.abs(agreement.strain)
    gauge = int(np.argmax(relative))
    return {
        "rms": float(np.sqrt(np.mean(relative**2))),
        "largest": float(relative[gauge]),
        "gauge": gauge + 1,
    }
