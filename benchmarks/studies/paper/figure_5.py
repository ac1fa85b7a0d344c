"""Fig. 5 of the paper: calibration step 2, with the posterior by particles."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.studies.paper.particle_filter import ParticlePosterior
from benchmarks.studies.paper.table_1 import PAPER
from calibration.static.figure import draw_legend_of_densities, load_test_figure
from calibration.static.load_test import StaticCalibration
from calibration.static.posterior import ScalarPosterior
from reporting.pages import figures as style


@style.publication_style()
def figure_5(static: StaticCalibration, particle: ParticlePosterior) -> Figure:
    """Draw a load test with its exact posterior, and that of the particles as a histogram."""
    figure = load_test_figure(static)
    _, factor_axes, stiffness_axes = figure.axes
    _draw_histogram(factor_axes, particle)
    paper_mean = PAPER["young_modulus_factor"].mean
    factor_axes.axvline(
        paper_mean, color=style.REFERENCE, lw=0.7, ls=":", label="mean in the paper"
    )
    _draw_histogram(stiffness_axes, particle.stiffness, 1e-3)
    for axes in (factor_axes, stiffness_axes):
        draw_legend_of_densities(axes)
    return figure


def _draw_histogram(axes: Axes, particle: ScalarPosterior, scale: float = 1.0) -> None:
    """Draw particles as a histogram; `scale` is the factor from SI to the unit of the panel."""
    edges = particle.mean + particle.standard_deviation * np.linspace(-4.0, 4.0, 33)
    histogram = np.diff(particle.cumulative(edges)) / np.diff(edges)
    axes.stairs(
        histogram / scale,
        edges * scale,
        color=style.PRESENT,
        lw=0.9,
        label="posterior, particles",
    )
