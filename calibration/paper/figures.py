"""Figures of calibration step 2: the panels of Kapteyn et al. 2021, Fig. 5, and what they leave open."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from calibration.paper.load_test import StaticCalibration
from calibration.paper.table_1 import PAPER_MEAN, PAPER_STANDARD_DEVIATION
from calibration.static.experiments import HALF_WIDTH_95
from calibration.static.posterior import ScalarPosterior
from reporting.figures import (
    BAND_OPACITY,
    OBSERVED,
    PAST,
    PRESENT,
    REFERENCE,
    new_figure,
    panel_label,
    publication_style,
)

_MARKERS = ("o", "s", "^", "D", "v", "P")
_RUN_LINES = ("-", "--", "-.", ":")


def calibration_figure(result: StaticCalibration) -> Figure:
    """Draw the three panels of Fig. 5: measurements and bands, densities of e, densities of the stiffness."""
    with publication_style():
        figure = new_figure(height=4.4)
        grid = figure.add_gridspec(2, 2, width_ratios=(1.05, 1.0), wspace=0.22, hspace=0.48)
        figure.subplots_adjust(left=0.062, right=0.985, bottom=0.095, top=0.94)
        _draw_loads(figure.add_subplot(grid[:, 0]), result)
        _draw_factor(figure.add_subplot(grid[0, 1]), result)
        _draw_stiffness(figure.add_subplot(grid[1, 1]), result)
    return figure


def residual_figure(result: StaticCalibration) -> Figure:
    """Draw the residuals run by run, and the posterior under other assumptions."""
    with publication_style():
        figure = new_figure(height=2.6)
        grid = figure.add_gridspec(1, 2, width_ratios=(1.0, 0.9), wspace=0.45)
        figure.subplots_adjust(left=0.075, right=0.985, bottom=0.165, top=0.90)
        _draw_residuals(figure.add_subplot(grid[0, 0]), result)
        _draw_alternatives(figure.add_subplot(grid[0, 1]), result)
    return figure


def _draw_loads(axes: Axes, result: StaticCalibration) -> None:
    data = result.data
    reach = 1.12 * float(data.displacement.max())
    displacement = np.array([0.0, reach])
    for posterior, colour, name, opacity in (
        (result.tip_stiffness_prior, REFERENCE, "prior", 0.35),
        (result.tip_stiffness_exact, PAST, "posterior", 0.35),
    ):
        lower, upper = posterior.interval(0.95)
        axes.fill_between(
            displacement * 1e3,
            lower * displacement,
            upper * displacement,
            color=colour,
            alpha=opacity,
            lw=0.0,
            label=f"{name}, 95 % band",
        )
    axes.plot(
        displacement * 1e3, result.tip_stiffness_prior.mean * displacement, color=REFERENCE, lw=1.0, ls="--"
    )
    axes.plot(displacement * 1e3, result.tip_stiffness_exact.mean * displacement, color=PAST, lw=1.2)
    for number, index in enumerate(data.run_indices):
        of_run = data.run == index
        axes.errorbar(
            data.displacement[of_run] * 1e3,
            data.load[of_run],
            xerr=HALF_WIDTH_95 * data.displacement_standard_deviation * 1e3,
            yerr=HALF_WIDTH_95 * data.load_standard_deviation,
            fmt=_MARKERS[number % len(_MARKERS)],
            color=OBSERVED,
            mfc="white" if number % 2 else OBSERVED,
            ms=3.6,
            mew=0.9,
            elinewidth=0.8,
            capsize=1.8,
            label=f"measured, run {index + 1}",
            zorder=3 + number,
        )
    axes.set_xlim(0.0, reach * 1e3)
    axes.set_ylim(0.0, 1.12 * float(data.load.max()))
    axes.set_xlabel("tip displacement $x$ (mm)", parse_math=True)
    axes.set_ylabel("tip load $f$ (N)", parse_math=True)
    axes.legend(loc="upper left", handlelength=1.5)
    panel_label(axes, "a", "Load and displacement")


def _draw_factor(axes: Axes, result: StaticCalibration) -> None:
    particle, exact, prior = result.particle, result.exact, result.prior
    reach = 3.6 * prior.standard_deviation
    grid = np.linspace(prior.mean - reach, prior.mean + reach, 601)
    axes.fill_between(exact.grid, exact.density, color=PAST, alpha=BAND_OPACITY, lw=0.0)
    for pair in range(result.data.count):
        run = result.data.run_indices.index(int(result.data.run[pair]))
        axes.plot(
            particle.likelihood_grid, particle.likelihood[pair], color=OBSERVED, lw=0.7,
            ls=_RUN_LINES[run % len(_RUN_LINES)], label="likelihood of one pair" if pair == 0 else None,
        )  # fmt: skip
    axes.plot(grid, prior.density(grid), color=REFERENCE, lw=1.8, label="prior")
    axes.plot(exact.grid, exact.density, color=PAST, lw=1.6, label="posterior, exact")
    _draw_bars(axes, particle.posterior, 1.0)
    axes.axvline(PAPER_MEAN, color=REFERENCE, lw=0.7, ls=":", label="mean in the paper")
    axes.set_xlim(grid[0], grid[-1])
    axes.set_ylim(0.0, 1.12 * float(exact.density.max()))
    axes.set_xlabel("Young's modulus factor $e$", parse_math=True)
    axes.set_ylabel("probability density")
    axes.legend(loc="upper left", fontsize=6.8, handlelength=1.6, borderaxespad=0.1, labelspacing=0.35)
    panel_label(axes, "b", "Prior, likelihoods, posterior")


def _draw_stiffness(axes: Axes, result: StaticCalibration) -> None:
    posterior = result.tip_stiffness_exact
    scale = 1e-3  # N/m to N/mm
    reach = 3.6 * result.tip_stiffness_prior.standard_deviation
    axes.fill_between(
        *_inside(posterior, scale), color=PAST, alpha=BAND_OPACITY, lw=0.0, label="95 % interval"
    )
    axes.plot(*_curve(result.tip_stiffness_prior, scale), color=REFERENCE, lw=1.8, label="prior")
    axes.plot(*_curve(posterior, scale), color=PAST, lw=1.6, label="posterior, exact")
    _draw_bars(axes, result.tip_stiffness_particle, scale)
    axes.set_xlim(
        (result.tip_stiffness_prior.mean - reach) * scale, (result.tip_stiffness_prior.mean + reach) * scale
    )
    axes.set_ylim(0.0, 1.12 * float(posterior.density.max()) / scale)
    axes.set_xlabel("tip stiffness $k$ (N/mm)", parse_math=True)
    axes.set_ylabel("probability density (mm/N)")
    axes.legend(loc="upper left", fontsize=6.8, handlelength=1.6, borderaxespad=0.1, labelspacing=0.35)
    axes.text(
        0.99,
        0.60,
        f"{posterior.mean * scale:.4f} ± {posterior.standard_deviation * scale:.4f} N/mm",
        transform=axes.transAxes,
        color=PAST,
        ha="right",
        fontsize=6.8,
    )
    panel_label(axes, "c", "Quantity of interest")


def _draw_bars(axes: Axes, posterior: ScalarPosterior, scale: float) -> None:
    """Draw a posterior of particles as a histogram."""
    edges = posterior.mean + posterior.standard_deviation * np.linspace(-4.0, 4.0, 33)
    density = np.diff(posterior.cumulative(edges)) / np.diff(edges)
    axes.stairs(density / scale, edges * scale, color=PRESENT, lw=0.9, label="posterior, particles")


def _curve(posterior: ScalarPosterior, scale: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return posterior.grid * scale, posterior.density / scale


def _inside(posterior: ScalarPosterior, scale: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    lower, upper = posterior.interval(0.95)
    inside = (posterior.grid >= lower) & (posterior.grid <= upper)
    return posterior.grid[inside] * scale, posterior.density[inside] / scale


def _draw_residuals(axes: Axes, result: StaticCalibration) -> None:
    data, quality = result.data, result.quality
    half_width = HALF_WIDTH_95 * np.hypot(
        data.displacement_standard_deviation, data.load_standard_deviation / quality.stiffness
    )
    shift = 0.008 * float(data.load.max())
    axes.axhline(0.0, color=PAST, lw=1.0)
    for number, (index, run) in enumerate(zip(data.run_indices, quality.runs, strict=True)):
        of_run = data.run == index
        side = shift * (2 * number - len(quality.runs) + 1)
        line = axes.errorbar(
            data.load[of_run] + side,
            quality.displacement_residual[of_run] * 1e3,
            yerr=half_width * 1e3,
            fmt=_MARKERS[number % len(_MARKERS)],
            color=OBSERVED,
            mfc="white" if number % 2 else OBSERVED,
            ms=3.6,
            mew=0.9,
            elinewidth=0.8,
            capsize=1.8,
            label=f"run {index + 1} ({run.offset * 1e3:+.2f} mm)".replace("-", "−"),
        )
        line.lines[0].set_zorder(3 + number)
        axes.axhline(run.offset * 1e3, color=OBSERVED, lw=0.8, ls=_RUN_LINES[1 + number % 3])
    limit = 1.75 * float(np.max(np.abs(quality.displacement_residual))) * 1e3 + 0.25
    axes.set_ylim(-limit, 1.3 * limit)
    axes.set_xlabel("tip load $f$ (N)", parse_math=True)
    axes.set_ylabel("$x - f/k$ (mm)", parse_math=True)
    axes.legend(loc="upper center", ncols=2, fontsize=6.8, handletextpad=0.3, borderaxespad=0.0)
    panel_label(axes, "a", "Residuals of the two runs" if len(quality.runs) == 2 else "Residuals")


def _short_name(assumption: str) -> str:
    for beginning, short in (
        ("prior flat", "flat in load"),
        ("density", "ratio"),
        ("a zero", "zero offsets"),
    ):
        if assumption.startswith(beginning):
            return short
    return assumption


def _draw_alternatives(axes: Axes, result: StaticCalibration) -> None:
    rows = [
        ("paper", PAPER_MEAN, PAPER_STANDARD_DEVIATION, REFERENCE),
        ("particle filter", result.particle.mean, result.particle.standard_deviation, PRESENT),
        ("exact", result.exact.mean, result.exact.standard_deviation, PAST),
    ]
    rows += [
        (f"exact, {_short_name(alternative.name)}", alternative.mean, alternative.standard_deviation, PAST)
        for alternative in result.alternatives
    ]
    for row, (_, mean, deviation, colour) in enumerate(rows):
        axes.errorbar(
            mean,
            row,
            xerr=HALF_WIDTH_95 * deviation,
            fmt="o",
            color=colour,
            ms=3.8,
            elinewidth=1.2,
            capsize=2.2,
        )
    axes.axvline(PAPER_MEAN, color=REFERENCE, lw=0.7, ls=":")
    axes.set_yticks(range(len(rows)), [row[0] for row in rows])
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0.0)
    axes.spines["left"].set_visible(False)
    axes.set_xlabel("Young's modulus factor $e$ (95 %)", parse_math=True)
    panel_label(axes, "b", "Under other assumptions")
