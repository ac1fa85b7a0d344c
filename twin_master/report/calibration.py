"""The figure of the calibration of the twin's model: measurements and uncertain parameter."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import truncnorm

from reporting.arrays import Float
from reporting.json_file import JsonRecord
from reporting.pages import figures as style
from reporting.words import parameter_title
from twin_master.report.reading import Run


class LoadTest(NamedTuple):
    """A static test, and the stiffness that was calibrated from it.

    Attributes
    ----------
    load : (N,) array
        The loads at the tip [N].
    displacement : (N,) array
        The displacements of the tip [m].
    stiffness, stiffness_deviation : float
        The mean and the standard deviation of the tip stiffness [N/m].
    """

    load: Float
    displacement: Float
    stiffness: float
    stiffness_deviation: float


def true_value(run: Run) -> float | None:
    """Return the true value of the calibrated parameter in the asset; None if it is not known."""
    name = run.scenario.calibration.parameter
    stated_value = run.scenario.asset.true_parameters.get(name)
    if stated_value is not None:
        return float(stated_value)
    # Two kinds of simulated assets have the calibrated mean as their parameter.
    asset = run.config["scenario"]["asset"]
    is_packed_from_calibration = asset.get("design") == "calibration" and not asset.get("file")
    is_simulated_campaign_model = "campaign" in run.calibration and not run.is_watched
    if not (is_packed_from_calibration or is_simulated_campaign_model):
        return None
    mean = run.calibration.get("state", {}).get(name, {}).get("mean")
    return None if mean is None else float(mean)


def calibrated_moments(run: Run) -> tuple[float, float]:
    """Return mean and standard deviation of the calibrated parameter.

    They are those of the posterior or, if it is not recorded, of the draws.
    """
    posterior = run.calibration.get("state", {}).get(run.scenario.calibration.parameter)
    if posterior:
        return posterior["mean"], posterior["standard_deviation"]
    draws = run["calibration/draw_value"]
    return float(draws.mean()), float(draws.std())


def load_test(run: Run) -> LoadTest | None:
    """Return the static test of the calibration; None if the calibration has none."""
    record = run.calibration
    data = record.get("data", {})
    stiffness = record.get("tip_stiffness") or record.get("quantities", {}).get("tip_stiffness")
    if not stiffness or not data.get("load"):
        return None
    return LoadTest(
        load=np.asarray(data["load"], float),
        displacement=np.asarray(data["displacement"], float),
        stiffness=stiffness["mean"],
        stiffness_deviation=stiffness["standard_deviation"],
    )


def parameter_unit(run: Run) -> str:
    """Return the unit of the calibrated parameter; "1" if it is dimensionless."""
    return str(run.tree["calibration/draw_value"].attrs.get("units", "1"))


@style.publication_style()
def calibration_figure(run: Run) -> Figure:
    """Draw the load test of the calibration, if there is one, and the uncertain parameter."""
    test = load_test(run)
    panel_count = 1 if test is None else 2
    figure, (row,) = style.panels(1, panel_count, 2.7, 0.3, 0.43, left=0.088, wspace=0.26)
    if test is None:
        _draw_parameter(row[0], run, "")
    else:
        _draw_load_test(row[0], test)
        _draw_parameter(row[1], run, "b")
    return figure


def _draw_load_test(axes: Axes, test: LoadTest) -> None:
    """Draw the measured loads and displacements, and the line of the calibrated stiffness.

    Its band is that of two standard deviations of the stiffness. Displacements are drawn in mm.
    """
    loads = np.linspace(0.0, 1.08 * float(test.load.max()), 2)
    two_deviations = 2.0 * test.stiffness_deviation
    low = 1.0e3 * loads / (test.stiffness + two_deviations)
    high = 1.0e3 * loads / (test.stiffness - two_deviations)
    style.band(axes, loads, low, high, style.PRESENT)
    axes.plot(loads, 1.0e3 * loads / test.stiffness, color=style.PRESENT, label="calibrated")
    axes.plot(
        test.load,
        1.0e3 * test.displacement,
        linestyle="none",
        marker="o",
        markersize=3.2,
        color=style.OBSERVED,
        label="measured",
    )
    axes.set(xlim=(0.0, loads[-1]), xlabel="tip load (N)", ylabel="tip displacement (mm)")
    axes.set_ylim(bottom=0.0)
    axes.legend(loc="upper left")
    style.panel_label(axes, "a", "Measurements")


def _draw_parameter(axes: Axes, run: Run, label: str) -> None:
    """Plot histogram, prior, posterior and true value of the uncertain parameter."""
    draws = run["calibration/draw_value"]
    center = float(draws.mean())
    deviation = float(draws.std())
    # 4.5 standard deviations show the tails; without any, a narrow range about the value is drawn.
    half_width = 4.5 * deviation if deviation > 0 else 1e-3 * max(abs(center), 1.0)
    low = center - half_width
    high = center + 1.5 * half_width  # leaves room for the legend
    _draw_draws(axes, draws)
    _draw_prior(axes, run.calibration, low, high)
    _draw_posterior(axes, run.calibration, low, high)
    truth = true_value(run)
    if truth is not None:
        axes.axvline(truth, **style.TRUTH_LINE, label="truth")
    axes.set_ylim(bottom=0.0)
    title = parameter_title(run.scenario.calibration.parameter)
    unit = parameter_unit(run)
    axes.set(
        xlim=(low, high),
        xlabel=title if unit == "1" else f"{title} ({unit})",
        ylabel="density",
    )
    axes.legend(loc="upper right", handlelength=1.5)
    style.panel_label(axes, label, "The uncertain parameter")


def _draw_draws(axes: Axes, draws: Float) -> None:
    """Plot the histogram of the parameter's draws, or a vertical line if all draws are equal."""
    if float(draws.std()) == 0.0:
        axes.axvline(float(draws.mean()), color=style.PRESENT, label="value used")
        return
    axes.hist(
        draws,
        bins=min(16, max(4, len(draws) // 5)),
        density=True,
        color=style.REFERENCE,
        alpha=0.35,
        linewidth=0,
        label=f"{len(draws)} draws used",
    )


def _prior_range(record: JsonRecord) -> tuple[float, float]:
    """Return the bounds of the prior in a calibration's record; infinite if it has none."""
    prior = record.get("prior", {})
    if not prior.get("standard_deviation") or "range" not in prior:
        return -np.inf, np.inf
    lowest, highest = prior["range"]
    return lowest, highest


def _draw_prior(axes: Axes, record: JsonRecord, low: float, high: float) -> None:
    """Plot the density of the prior, a truncated normal distribution, between two values.

    Nothing is plotted if the record has no prior.
    """
    prior = record.get("prior", {})
    if not prior.get("standard_deviation"):
        return
    mean = prior["mean"]
    deviation = prior["standard_deviation"]
    lowest, highest = _prior_range(record)
    x = np.linspace(max(low, lowest), min(high, highest), 200)
    # SciPy expects the bounds in standard deviations from the mean.
    density = truncnorm.pdf(
        x, (lowest - mean) / deviation, (highest - mean) / deviation, mean, deviation
    )
    axes.plot(x, density, color=style.PAST, linewidth=1.2, label="prior")


def _draw_posterior(axes: Axes, record: JsonRecord, low: float, high: float) -> None:
    """Plot the posterior density between two values, if the record has a posterior."""
    posterior = record.get("posterior")
    if not posterior:
        return
    grid = np.asarray(posterior["grid"], float)
    density = np.asarray(posterior["density"], float)
    lowest, highest = _prior_range(record)
    is_drawn = (grid >= max(low, lowest)) & (grid <= min(high, highest))
    axes.plot(grid[is_drawn], density[is_drawn], color=style.PRESENT, label="posterior")
