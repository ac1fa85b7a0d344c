"""Figures of the calibration of a wing as a whole: correlations, quantities of interest, mode shapes."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.stats import gaussian_kde

from calibration.static.experiments import HALF_WIDTH_95
from fe.reduction.fields import WingFields
from fe.runtime.reduced import Modes
from reporting.figures import (
    BAND_OPACITY,
    LEVELS,
    OBSERVED,
    PAST,
    REFERENCE,
    new_figure,
    panel_label,
    publication_style,
)

from .result import CalibrationResult, measured_quantities
from .table_1 import SHOWN

Float = NDArray[np.float64]

AXIS_TITLES = {
    "young_modulus_factor": "$e$",
    "servo_mass": "servo (g)",
    "pitot_mass": "pitot tube (g)",
    "damping_alpha": r"$\alpha$ (1/s)",
    "damping_beta": r"$\beta$ (ms)",
    "tip_stiffness": "tip stiffness (N/mm)",
    "frequency_1": "$f_1$ (Hz)",
    "frequency_2": "$f_2$ (Hz)",
    "damping_ratio_1": r"$\zeta_1$ (%)",
    "damping_ratio_2": r"$\zeta_2$ (%)",
}
_FACES = ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))


def quantities_figure(result: CalibrationResult) -> Figure:
    """Draw stiffness, frequencies and damping ratios before and after, with what was measured."""
    measured = measured_quantities(result.modal)
    stiffness = result.step(2).quantities[0]
    if stiffness.measured is not None and stiffness.measured_standard_deviation is not None:
        measured["tip_stiffness"] = stiffness.measured, stiffness.measured_standard_deviation
    names = ("tip_stiffness", "frequency_1", "frequency_2", "damping_ratio_1", "damping_ratio_2")
    with publication_style():
        figure = new_figure(height=3.6)
        grid = figure.add_gridspec(
            2, 3, wspace=0.14, hspace=0.62, left=0.02, right=0.985, bottom=0.12, top=0.93
        )
        places = (grid[0, 0], grid[0, 1], grid[0, 2], grid[1, 1], grid[1, 2])
        for label, name, place in zip("abcde", names, places, strict=True):
            axes = figure.add_subplot(place)
            _draw_quantity(axes, result, name, measured[name])
            panel_label(axes, label, "")
        handles = figure.axes[0].get_legend_handles_labels()
        figure.legend(*handles, loc="upper left", bbox_to_anchor=(0.03, 0.42))
    return figure


def _draw_quantity(axes: Axes, result: CalibrationResult, name: str, measured: tuple[float, float]) -> None:
    scale = SHOWN[name].scale
    prior, posterior = result.draws_of(name, prior=True) * scale, result.draws_of(name) * scale
    value, half = measured[0] * scale, HALF_WIDTH_95 * measured[1] * scale
    spread = max(float(posterior.std()), 1e-6 * abs(float(posterior.mean())))
    low = max(min(float(posterior.mean()) - 4.5 * spread, value - 1.6 * half), 0.0)
    high = max(float(posterior.mean()) + 4.5 * spread, value + 1.6 * half)
    grid = np.linspace(low, high, 301)
    axes.axvspan(
        value - half, value + half, color=OBSERVED, alpha=BAND_OPACITY, lw=0.0, label="measured, 95 %"
    )
    axes.axvline(value, color=OBSERVED, lw=0.9)
    before = gaussian_kde(prior)(grid)
    after = gaussian_kde(posterior)(grid) if posterior.std() > 1e-9 * abs(posterior.mean()) else None
    top = float(before.max())
    if after is not None:
        top = float(after.max())
        axes.fill_between(grid, after, color=PAST, alpha=BAND_OPACITY, lw=0.0)
        axes.plot(grid, after, color=PAST, lw=1.3, label="after the calibration")
    else:
        axes.axvline(float(posterior.mean()), color=PAST, lw=1.3, label="after the calibration")
    axes.plot(grid, before, color=REFERENCE, lw=1.2, ls="--", label="before")
    axes.set_xlim(low, high)
    axes.set_ylim(0.0, 1.12 * top)
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.set_xlabel(AXIS_TITLES[name], parse_math=True)


def modes_figure(fields: WingFields, modes: Modes, titles: Sequence[str]) -> Figure:
    """Draw the mode shapes of the upper skin in oblique view, coloured by their displacement.

    Parameters
    ----------
    fields : WingFields
        Bases on the mesh.
    modes : Modes
        Of the calibrated wing.
    titles : sequence of str
        One for each mode.
    """
    faces = _upper_faces(fields)
    points = fields.basis.points
    span = float(np.ptp(points[:, 1]))
    shapes = fields.basis.modal_displacement @ modes.shape
    rows = (len(titles) + 1) // 2
    with publication_style():
        figure = new_figure(height=1.5 * rows)
        grid = figure.add_gridspec(
            rows, 2, wspace=0.06, hspace=0.04, left=0.01, right=0.99, bottom=0.0, top=0.99
        )
        for index, title in enumerate(titles):
            axes = figure.add_subplot(grid[index // 2, index % 2])
            shape = shapes[:, :, index]
            length = np.linalg.norm(shape, axis=1)
            moved = points + shape * (0.14 * span / float(length.max()))
            _draw_skin(axes, points, faces, None)
            _draw_skin(axes, moved, faces, length / float(length.max()))
            axes.set_xlim(-0.09 * span, 1.10 * span)
            axes.set_ylim(-0.24 * span, 0.27 * span)
            axes.text(0.0, 0.97, title, transform=axes.transAxes, va="top", fontsize=8.0, fontweight="bold")
    return figure


def _upper_faces(fields: WingFields) -> NDArray[np.int64]:
    """Return the corners of the outer faces of the upper skin, (F, 4)."""
    basis = fields.basis
    # the skin and the damage regions in it, see `fe.reduction.fields.FieldBasis`
    skin = basis.cells[basis.region <= len(fields.model.regions)][:, :8]
    height = basis.points[skin][:, :, 2]
    skin = skin[height.mean(axis=1) > 0.0]
    candidates = skin[:, np.array(_FACES)]
    corner = basis.points[candidates]
    normal = np.cross(corner[:, :, 2] - corner[:, :, 0], corner[:, :, 3] - corner[:, :, 1])
    area = np.linalg.norm(normal, axis=2)
    broad = area > 0.5 * area.max(axis=1, keepdims=True)  # the skin is thin: inner and outer face
    best = np.where(broad, corner[:, :, :, 2].mean(axis=2), -np.inf).argmax(axis=1)
    return np.asarray(candidates[np.arange(len(skin)), best])


def _draw_skin(axes: Axes, points: Float, faces: NDArray[np.int64], value: Float | None) -> None:
    """Draw faces in oblique projection, those behind first: span to the right, chord into the page."""
    x, y, z = points.T
    flat = np.column_stack([y + 0.45 * -x, 0.40 * -x + z])
    order = np.argsort(x[faces].mean(axis=1))  # the leading edge is at the back
    polygons = flat[faces[order]]
    if value is None:
        drawn = PolyCollection(
            list(polygons), facecolors="#eeeeee", edgecolors="#dddddd", linewidths=0.2, rasterized=True
        )
    else:
        drawn = PolyCollection(
            list(polygons), array=value[faces[order]].mean(axis=1), cmap=LEVELS, edgecolors="face",
            linewidths=0.15, rasterized=True,
        )  # fmt: skip
        drawn.set_clim(0.0, 1.0)
    axes.add_collection(drawn)
    axes.set_aspect("equal")
    axes.set_axis_off()
