"""The figure of calibration step 2: the load test, the factor on Young's modulus, the stiffness."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibration.static.experiments import HALF_WIDTH_95
from calibration.static.load_test import StaticCalibration
from calibration.static.posterior import ScalarPosterior
from reporting.pages import figures as style

_MARKERS = ("o", "s", "^", "D", "v", "P")
_RUN_LINES = ("-", "--", "-.", ":")


@style.publication_style()
def load_test_figure(result: StaticCalibration) -> Figure:
    """Draw the load test, and the densities of the factor e and of the tip stiffness.

    The panels are those of Kapteyn et al. 2021, Fig. 5.
    """
    figure = style.new_figure(height=4.4)
    axes = figure.subplot_mosaic(
        [
            ["loads", "factor"],
            ["loads", "stiffness"],
        ],
        width_ratios=(1.05, 1.0),
        gridspec_kw={"wspace": 0.22, "hspace": 0.48},
    )
    figure.subplots_adjust(left=0.062, right=0.985, bottom=0.095, top=0.94)
    _draw_loads(axes["loads"], result)
    _draw_factor(axes["factor"], result)
    _draw_stiffness(axes["stiffness"], result)
    return figure


def _draw_factor(axes: Axes, result: StaticCalibration) -> None:
    """Draw the densities of e: its prior, the likelihood of each measured pair, its posteriors."""
    run_numbers = np.searchsorted(result.data.run_indices, result.data.run).tolist()
    for index, (run, of_pair) in enumerate(zip(run_numbers, result.by_pair, strict=True)):
        axes.plot(
            of_pair.grid,
            of_pair.density,
            color=style.OBSERVED,
            lw=0.7,
            ls=_RUN_LINES[run % len(_RUN_LINES)],
            label="likelihood of one pair" if index == 0 else None,
        )
    _draw_densities(axes, result.before, result.exact)
    axes.set_xlabel("Young's modulus factor $e$", parse_math=True)
    axes.set_ylabel("probability density")
    style.panel_label(axes, "b", "Prior, likelihoods, posterior")
    draw_legend_of_densities(axes)


def _draw_stiffness(axes: Axes, result: StaticCalibration) -> None:
    """Draw the densities of the tip stiffness."""
    posterior = result.tip_stiffness_exact
    _draw_densities(axes, result.tip_stiffness_prior, posterior, 1e-3)
    axes.set_xlabel("tip stiffness $k$ (N/mm)", parse_math=True)
    axes.set_ylabel("probability density (mm/N)")
    text = f"{posterior.mean * 1e-3:.4f} ± {posterior.standard_deviation * 1e-3:.4f} N/mm"
    axes.text(
        0.99, 0.60, text, transform=axes.transAxes, color=style.PAST, ha="right", fontsize=6.8
    )
    style.panel_label(axes, "c", "Quantity of interest")
    draw_legend_of_densities(axes)


def draw_legend_of_densities(axes: Axes) -> None:
    """Draw the legend of a panel of densities, small enough to stay beside their peaks."""
    axes.legend(
        loc="upper left", fontsize=6.8, handlelength=1.6, borderaxespad=0.1, labelspacing=0.35
    )


def _draw_loads(axes: Axes, result: StaticCalibration) -> None:
    """Draw measured pairs of load and tip displacement, and the bands before and after them.

    A band is the 95 % interval of the load by the tip stiffness, a priori and a posteriori.
    """
    data = result.data
    largest_displacement = 1.12 * float(data.displacement.max())
    displacement = np.array([0.0, largest_displacement])
    for density, colour, name, line in (
        (result.tip_stiffness_prior, style.REFERENCE, "prior", {"lw": 1.0, "ls": "--"}),
        (result.tip_stiffness_exact, style.PAST, "posterior", {"lw": 1.2}),
    ):
        lower, upper = density.interval(0.95)
        axes.fill_between(
            displacement * 1e3,
            lower * displacement,
            upper * displacement,
            color=colour,
            alpha=0.35,
            lw=0.0,
            label=f"{name}, 95 % band",
        )
        axes.plot(displacement * 1e3, density.mean * displacement, color=colour, **line)
    for number, index in enumerate(data.run_indices):
        is_in_run = data.run == index
        axes.errorbar(
            data.displacement[is_in_run] * 1e3,
            data.load[is_in_run],
            xerr=HALF_WIDTH_95 * data.displacement_standard_deviation * 1e3,
            yerr=HALF_WIDTH_95 * data.load_standard_deviation,
            fmt=_MARKERS[number % len(_MARKERS)],
            color=style.OBSERVED,
            ms=3.6,
            mew=0.9,
            elinewidth=0.8,
            mfc="white" if number % 2 else style.OBSERVED,
            capsize=1.8,
            zorder=3 + number,
            label=f"measured, run {index + 1}",
        )
    axes.set(xlim=(0.0, largest_displacement * 1e3), ylim=(0.0, 1.12 * float(data.load.max())))
    axes.set_xlabel("tip displacement $x$ (mm)", parse_math=True)
    axes.set_ylabel("tip load $f$ (N)", parse_math=True)
    axes.legend(loc="upper left", handlelength=1.5)
    style.panel_label(axes, "a", "Load and displacement")


def _draw_densities(
    axes: Axes,
    prior: ScalarPosterior,
    exact: ScalarPosterior,
    scale: float = 1.0,
) -> None:
    """Draw the prior, and the posterior with its 95 % interval.

    `scale` is the factor from SI to the unit of the panel.
    """
    lower, upper = exact.interval(0.95)
    is_inside = (exact.grid >= lower) & (exact.grid <= upper)
    axes.fill_between(
        exact.grid[is_inside] * scale,
        exact.density[is_inside] / scale,
        color=style.PAST,
        alpha=style.BAND_OPACITY,
        lw=0.0,
        label="95 % interval",
    )
    axes.plot(
        prior.grid * scale, prior.density / scale, color=style.REFERENCE, lw=1.8, label="prior"
    )
    axes.plot(
        exact.grid * scale,
        exact.density / scale,
        color=style.PAST,
        lw=1.6,
        label="posterior",
    )
    half_width = 3.6 * prior.standard_deviation
    left = (prior.mean - half_width) * scale
    right = (prior.mean + half_width) * scale
    axes.set(xlim=(left, right), ylim=(0.0, 1.12 * float(exact.density.max()) / scale))
