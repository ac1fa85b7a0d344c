"""What the twin was told about the uncertain parameter of its model before it flew."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import truncnorm

from reporting import figures as style
from reporting.arrays import Float
from reporting.words import parameter_title
from twin_master.report.reading import Run


def true_value(run: Run) -> float | None:
    """Return the value of the parameter that the asset really has; None where nobody knows it."""
    kept, asset, name = run.calibration, run.scenario.asset, run.scenario.calibration.parameter
    known = asset.true_parameters.get(name)
    section = run.config["scenario"]["asset"]
    packed = section.get("design") == "calibration" and not section.get("file")
    if known is None and (packed or ("campaign" in kept and not run.watched)):
        known = kept.get("state", {}).get(name, {}).get("mean")  # at which what is flown starts
    return None if known is None else float(known)


def believed(run: Run) -> tuple[float, float]:
    """Return mean and standard deviation of the parameter as it was calibrated."""
    state = run.calibration.get("state", {}).get(run.scenario.calibration.parameter)
    draws = run["calibration/draw_value"]
    return (
        (state["mean"], state["standard_deviation"]) if state else (float(draws.mean()), float(draws.std()))
    )


def measured(run: Run) -> tuple[Float, Float, Mapping[str, float]] | None:
    """Return measured loads [N] and displacements [m], and the stiffness that they gave; or None."""
    kept = run.calibration
    data = kept.get("data", {})
    stiffness = kept.get("tip_stiffness") or kept.get("quantities", {}).get("tip_stiffness")
    if not stiffness or not data.get("load"):
        return None
    return np.asarray(data["load"], float), np.asarray(data["displacement"], float), stiffness


@style.publication_style()
def calibration_figure(run: Run) -> Figure:
    """Draw the measurements with the stiffness they give, and the distribution of the parameter."""
    found = measured(run)
    figure, (row,) = style.panels(1, 1 if found is None else 2, 2.7, 0.3, 0.43, left=0.088, wspace=0.26)
    if found is not None:
        _pair_panel(row[0], *found)
    _density_panel(row[-1], run, "" if found is None else "b")
    return figure


def _pair_panel(axes: Axes, load: Float, displacement: Float, stiffness: Mapping[str, float]) -> None:
    reach = np.linspace(0.0, 1.08 * float(load.max()), 2)
    mean, deviation = stiffness["mean"], stiffness["standard_deviation"]
    low, high = (1.0e3 * reach / (mean + sign * 2.0 * deviation) for sign in (1.0, -1.0))
    style.band(axes, reach, low, high, style.PRESENT)
    axes.plot(reach, 1.0e3 * reach / mean, color=style.PRESENT, label="calibrated")
    axes.plot(
        load, 1.0e3 * displacement, linestyle="none", marker="o", markersize=3.2, color=style.OBSERVED,
        label="measured",
    )  # fmt: skip
    axes.set_xlim(0.0, reach[-1])
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("tip load (N)")
    axes.set_ylabel("tip displacement (mm)")
    axes.legend(loc="upper left")
    style.panel_label(axes, "a", "Measurements")


def _density_panel(axes: Axes, run: Run, label: str) -> None:
    draws, kept = run["calibration/draw_value"], run.calibration
    center, spread = float(draws.mean()), float(draws.std())
    reach = 4.5 * spread if spread > 0 else 1e-3 * max(abs(center), 1.0)
    low, high = center - reach, center + 1.5 * reach  # room for the legend
    if spread > 0:
        bins = min(16, max(4, len(draws) // 5))
        axes.hist(
            draws, bins=bins, density=True, color=style.REFERENCE, alpha=0.35, linewidth=0,
            label=f"{len(draws)} draws used",
        )  # fmt: skip
    else:
        axes.axvline(center, color=style.PRESENT, label="value used")
    prior, ends = kept.get("prior", {}), np.array([-np.inf, np.inf])
    if prior.get("standard_deviation"):
        mean, deviation = prior["mean"], prior["standard_deviation"]
        ends = np.array(prior.get("range", ends))
        x = np.linspace(max(low, ends[0]), min(high, ends[1]), 200)
        density = truncnorm.pdf(x, *(ends - mean) / deviation, mean, deviation)
        axes.plot(x, density, color=style.PAST, linewidth=1.2, label="prior")
    if kept.get("posterior"):
        grid, density = (np.asarray(kept["posterior"][name], float) for name in ("grid", "density"))
        inside = (grid >= max(low, ends[0])) & (grid <= min(high, ends[1]))
        axes.plot(grid[inside], density[inside], color=style.PRESENT, label="posterior")
    truth = true_value(run)
    if truth is not None:
        axes.axvline(truth, **style.TRUTH_LINE, label="truth")
    axes.set_xlim(low, high)
    axes.set_ylim(bottom=0.0)
    unit = run.tree["calibration/draw_value"].attrs.get("units", "1")
    title = parameter_title(run.scenario.calibration.parameter)
    axes.set_xlabel(title + ("" if unit == "1" else f" ({unit})"))
    axes.set_ylabel("density")
    axes.legend(loc="upper right", handlelength=1.5)
    style.panel_label(axes, label, "The uncertain parameter")
