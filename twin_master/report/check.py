"""The posterior predictive check of a run: whether its observations agree with the twin's model."""

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.special import ndtr
from scipy.stats import binom

from reporting.arrays import Float, Index
from reporting.pages import figures as style
from twin_master.report.belief import draw_step_map
from twin_master.report.reading import NORMAL_95, Run

_TRANSFORM_BINS = 10
_MOST_VECTOR_CELLS = 6000
"""Largest number of cells of a map drawn as vectors; more would make the page too large."""


@dataclass(frozen=True)
class PredictiveCheck:
    """Observations compared with the posterior predictive distribution of the same step.

    Attributes
    ----------
    residual : (T, G) array
        Observation minus expectation over the predictive standard deviation, which includes noise
        and the uncertainty of the expectation; NaN where the observation was lost.
    coverage : (G,) array
        The fraction of each sensor's observations within their 95 % interval; NaN for a sensor
        without observations.
    count : (G,) array
        The number of observations of each sensor.
    transform : (n,) array
        The probability integral transform of all n observations; uniform if the model is right.
    overall_coverage : float
        The fraction of all observations within their intervals; NaN without observations.
    standard_deviation : float
        The root mean square of the residuals; 1 if the assumed noise is the real one, NaN without
        observations.
    """

    residual: Float
    coverage: Float
    count: Index
    transform: Float
    overall_coverage: float
    standard_deviation: float


def predictive_check(run: Run) -> PredictiveCheck:
    """Compare the observations of a run with their posterior predictive distribution.

    The distribution is normal. Its variance is that of the expected noise-free value plus that of
    the noise.
    """
    noise = run.get("filtered/noise_standard_deviation")
    if noise is None:  # the run was made by an earlier version
        noise = np.asarray(run.scenario.observation.standard_deviation)
    deviation = np.hypot(run["filtered/quantity_standard_deviation"], noise)
    residual = (run.observations - run["filtered/quantity_mean"]) / deviation
    is_observed = np.isfinite(residual)
    count = is_observed.sum(axis=0)
    observed_residuals = residual[is_observed]
    is_within = np.abs(observed_residuals) <= NORMAL_95
    with np.errstate(invalid="ignore"):  # 0 / 0 gives NaN where there is no observation
        coverage = (np.abs(residual) <= NORMAL_95).sum(axis=0) / count
        overall_coverage = np.divide(is_within.sum(), observed_residuals.size)
        mean_square = np.divide((observed_residuals**2).sum(), observed_residuals.size)
    return PredictiveCheck(
        residual=residual,
        coverage=coverage,
        count=count,
        transform=ndtr(observed_residuals),
        overall_coverage=float(overall_coverage),
        standard_deviation=float(np.sqrt(mean_square)),
    )


@style.publication_style()
def check_figure(run: Run, check: PredictiveCheck) -> Figure:
    """Draw residuals, coverage of each sensor, and the histogram of the transforms.

    A transform is the probability integral transform of an observation.
    """
    figure = style.new_figure(4.9)
    grid = figure.add_gridspec(
        2,
        2,
        left=0.075,
        right=0.955,
        top=0.945,
        bottom=0.09,
        hspace=0.42,
        wspace=0.2,
        height_ratios=(1.25, 1.0),
        width_ratios=(1.6, 1.0),
    )
    _draw_residuals(figure, figure.add_subplot(grid[0, :]), run, check)
    _draw_coverage(figure.add_subplot(grid[1, 0]), run, check)
    _draw_transform(figure.add_subplot(grid[1, 1]), check)
    return figure


def _draw_residuals(figure: Figure, axes: Axes, run: Run, check: PredictiveCheck) -> None:
    """Draw a map of the residuals over steps (x) and sensors (y); lost observations are grey."""
    axes.set_facecolor("#c8c8c8")
    sensor_count = len(run.sensors.titles)
    image = draw_step_map(
        axes,
        run,
        np.ma.masked_invalid(check.residual),
        1,
        **style.RESIDUALS,
        rasterized=check.residual.size > _MOST_VECTOR_CELLS,
    )
    tick_distance = 4 if sensor_count > 8 else 1
    ticks = np.arange(1, sensor_count + 1, tick_distance)
    axes.set(xlabel=run.step_word, ylabel=run.sensors.word, yticks=ticks)
    axes.xaxis.set_major_locator(MaxNLocator(10, integer=True))
    style.panel_label(axes, "a", "Standardised residuals")
    style.color_bar(
        figure, image, "standard deviations", ax=axes, pad=0.015, fraction=0.03, extend="both"
    )


def _draw_coverage(axes: Axes, run: Run, check: PredictiveCheck) -> None:
    """Draw the coverage of each sensor, and the range expected of 95 % of sensors.

    If the model is right, the number of observations within their 95 % intervals is binomial. The
    range is computed for the median number of observations of a sensor.
    """
    sensor_numbers = np.arange(1, len(check.count) + 1)
    typical_count = int(np.median(check.count[check.count > 0])) if check.count.any() else 1
    low, high = binom.ppf([0.025, 0.975], typical_count, 0.95) / typical_count
    _draw_expected_range(axes, 100.0 * low, 100.0 * high, 95.0)
    axes.plot(
        sensor_numbers,
        100.0 * check.coverage,
        linestyle="none",
        marker="o",
        color=style.PAST,
        label="coverage",
    )
    lowest_point = 100.0 * min(np.nanmin(check.coverage, initial=1.0), low)
    bottom = max(-4.0, lowest_point - 6.0)
    axes.set(xlabel=run.sensors.word, ylabel="within 95 % interval (%)")
    axes.set(xlim=(0.2, len(sensor_numbers) + 0.8), ylim=(bottom, 104.0))
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    axes.grid(axis="y")
    style.panel_label(axes, "b", f"Coverage of each {run.sensors.word}")


def _draw_transform(axes: Axes, check: PredictiveCheck) -> None:
    """Draw the histogram of the probability integral transform as a density.

    If the model is right, the transform is uniform and the count of a bin is binomial: 95 % of the
    bars end in the grey range.
    """
    observation_count = max(len(check.transform), 1)
    bin_counts, edges = np.histogram(check.transform, bins=_TRANSFORM_BINS, range=(0.0, 1.0))
    low, high = (
        binom.ppf([0.025, 0.975], observation_count, 1 / _TRANSFORM_BINS)
        * _TRANSFORM_BINS
        / observation_count
    )
    _draw_expected_range(axes, low, high, 1.0)
    axes.bar(
        edges[:-1],
        bin_counts * _TRANSFORM_BINS / observation_count,
        width=0.92 / _TRANSFORM_BINS,
        align="edge",
        color=style.PAST,
        alpha=0.75,
        linewidth=0,
    )
    axes.set(xlim=(0.0, 1.0), xlabel="probability integral transform", ylabel="density")
    style.panel_label(axes, "c", "All observations")


def _draw_expected_range(axes: Axes, low: float, high: float, expected_value: float) -> None:
    """Draw the expected value, and the range in which 95 % lie if the model is right."""
    axes.axhspan(low, high, color=style.REFERENCE, alpha=0.25, linewidth=0)
    axes.axhline(expected_value, color=style.TRUTH, linewidth=0.9, linestyle=(0, (4, 2)))
