"""The folder of a calibrated wing: page, figures, and the wing for ParaView."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation
from numpy.typing import NDArray

from calibration.dynamics.figures import ring_down_figure
from calibration.result.file import FILE_NAME
from calibration.result.folder import (
    FIGURES,
    MODE_FIELDS,
    WING_FIELDS,
    calibration_folder,
    write_page,
)
from calibration.static.figure import load_test_figure
from calibration.static.load_test import StaticCalibration
from calibration.static.posterior import ScalarPosterior, push_forward
from calibration.wing.calibrate import WingCalibration
from calibration.wing.lab_data import StepOrigin
from fe.reduction.model_cache import WingFields, wing_fields, write_modes_vtu, write_wing_vtu
from fe.runtime.reduced_results import ReducedModes
from reporting.arrays import Float
from reporting.pages import figures as style
from reporting.pages.figures import save_figure
from reporting.pages.page import Block, Notice, Section
from reporting.pages.page_words import Words
from reporting.progress import stage
from reporting.words import plus_minus

WORDS = Words("calibration.wing")

LOAD_FACTOR = 3.0
"""Load factor of the turn in which `wing.vtu` shows the wing."""

_CHORD_TO_THE_LEFT = 0.45
_CHORD_DOWNWARD = 0.40
"""Shifts of a point in the oblique view of a wing, per unit of its chordwise position."""


def write_wing_folder(calibration: WingCalibration, folder: Path, *, report: bool = True) -> Path:
    """Write a calibrated wing to a folder, and return the path of its file `calibration.nc`.

    If `report` is true, the folder also has a page with figures, and the wing and its modes as
    files for ParaView.

    Raises
    ------
    FileNotWrittenError
        If a file cannot be written; the folder is then unchanged.
    """
    result = calibration.result
    fields = wing_fields(result.design) if report else None
    with calibration_folder(result, folder) as new_folder:
        if fields is not None:
            state = result.mean_state()
            model_vector = fields.model.vector(
                state.values, state.stiffness_loss, load_factor=LOAD_FACTOR
            )
            write_wing_vtu(new_folder / WING_FIELDS, fields, model_vector)
            write_modes_vtu(new_folder / MODE_FIELDS, fields, model_vector)
            with stage("Drawing the report"):
                sections = _wing_sections(calibration, fields, new_folder / FIGURES)
                write_page(result, new_folder, sections)
    return folder / FILE_NAME


def _wing_sections(calibration: WingCalibration, fields: WingFields, folder: Path) -> list[Section]:
    """Return the sections on a wing for the page of its calibration.

    Their figures are written to `folder`.
    """
    trials = calibration.lab.trials
    ring_down: Block = WORDS.say("no_record")
    if trials is not None:
        ring_down = save_figure(WORDS.figure("ring_down", ring_down_figure(trials)), folder)
    state = calibration.result.mean_state()
    modes = calibration.model.modes(state.values, state.stiffness_loss)
    mode_figure = WORDS.figure("modes", modes_figure(fields, modes, _mode_titles(modes)))
    return [
        Section("What was measured", _origins(calibration.lab.origins)),
        Section("Load test", _load_test(calibration.static, folder)),
        Section("Ring-down", [ring_down]),
        Section("The calibrated wing", [save_figure(mode_figure, folder)]),
    ]


def _origins(origins: Sequence[StepOrigin]) -> list[Block]:
    """Return where the measurements of each step come from.

    If some steps use measurements of this wing and others published values, the latter are notices.
    """
    has_measurements = any(origin.read for origin in origins)
    blocks: list[Block] = []
    for origin in origins:
        text = WORDS.say("origin", origin=origin)
        blocks.append(Notice(text) if has_measurements and not origin.read else text)
    return blocks


def _load_test(static: StaticCalibration, folder: Path) -> list[Block]:
    """Return the page's figure and table of the load test; the figure is written to `folder`."""
    posteriors = {"exact": static.exact}
    for name, alternative in static.alternatives.items():
        posteriors[f"exact, {name}"] = alternative
    rows = []
    for name, factor in posteriors.items():
        rows.append((name, _moments(factor), _moments(push_forward(factor, static.curve))))
    figure = WORDS.figure("load_test", load_test_figure(static))
    return [save_figure(figure, folder), WORDS.table("load_test", rows)]


def _moments(density: ScalarPosterior) -> str:
    """Format the mean and the standard deviation of a density."""
    return plus_minus(density.mean, density.standard_deviation)


def _mode_titles(modes: ReducedModes) -> list[str]:
    """Return the titles of the first six modes: number, frequency, and which are flapwise."""
    flapwise = dict(zip(modes.followed, ("first flapwise", "second flapwise"), strict=True))
    titles = []
    for index, frequency in enumerate(modes.frequency[:6]):
        title = f"mode {index + 1}, {frequency:.2f} Hz"
        if index in flapwise:
            title += f", {flapwise[index]}"
        titles.append(title)
    return titles


@style.publication_style()
def modes_figure(fields: WingFields, modes: ReducedModes, titles: Sequence[str]) -> Figure:
    """Draw the mode shapes of the upper skin, coloured by their displacement."""
    # The skin with its damage regions, see `fe.reduction.model_cache.WingFields`
    is_skin = fields.region <= len(fields.regions)
    corners_of_skin = fields.cells[is_skin][:, :8]
    _, _, heights = np.moveaxis(fields.points[corners_of_skin], 2, 0)
    is_upper = heights.mean(axis=1) > 0.0
    upper_nodes = np.unique(corners_of_skin[is_upper])
    points = fields.points[upper_nodes]
    x, y, _ = points.T
    # Nodes are connected as seen from above. Triangles at the trailing edge, in front, come last.
    triangles = Triangulation(y, x).triangles
    triangles = triangles[np.argsort(x[triangles].mean(axis=1))]
    span = float(np.ptp(y))
    shapes = (fields.modal_displacement @ modes.shape)[upper_nodes]
    row_count = (len(titles) + 1) // 2
    figure, grid = style.panels(
        row_count,
        2,
        1.5 * row_count,
        0.015 * row_count,
        0.0,
        wspace=0.06,
        hspace=0.04,
        left=0.01,
        right=0.99,
    )
    panels = style.keep_first_panels(grid, len(titles))
    for axes, shape, title in zip(panels, np.moveaxis(shapes, -1, 0), titles, strict=False):
        displacement = np.linalg.norm(shape, axis=1)
        largest = float(displacement.max())
        deformed = points + shape * (0.14 * span / largest)
        at_rest_shade = np.broadcast_to(0.1 * largest, displacement.shape)
        _draw_surface(axes, points, triangles, at_rest_shade, "Greys", largest)
        _draw_surface(axes, deformed, triangles, displacement, style.LEVELS, largest)
        axes.set(xlim=(-0.09 * span, 1.10 * span), ylim=(-0.24 * span, 0.27 * span), aspect="equal")
        axes.set_axis_off()
        axes.text(
            0.0, 0.97, title, transform=axes.transAxes, va="top", fontsize=8.0, fontweight="bold"
        )
    return figure


def _draw_surface(
    axes: Axes,
    points: Float,
    triangles: NDArray[np.int32],
    shade: Float,
    colours: str,
    largest: float,
) -> None:
    """Draw a surface in oblique view: span to the right, chord into the page.

    Parameters
    ----------
    points : (N, 3) array
        The positions of the nodes: x aft, y along the span, z upward [m].
    triangles : (T, 3) array
        The nodes of each triangle.
    shade : (N,) array
        The value at each node that its colour shows, from 0 to `largest`.
    """
    x, y, z = points.T
    # Oblique projection: the chord goes to the lower left of the panel.
    projection = Triangulation(y - _CHORD_TO_THE_LEFT * x, z - _CHORD_DOWNWARD * x, triangles)
    axes.tripcolor(
        projection,
        shade,
        cmap=colours,
        clim=(0.0, largest),
        shading="gouraud",
        rasterized=True,
    )
