"""The page and the folder of a wing's calibration."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from calibration.dynamics.figures import ring_down_figure
from calibration.paper.figures import calibration_figure
from calibration.paper.load_test import push_forward
from calibration.paper.table_1 import WORDS as TABLE_1
from calibration.paper.table_1 import write_table_1
from calibration.result.figures import corner_figure, drawn_parameters
from calibration.result.file import FILE_NAME
from calibration.result.folder import (
    MODE_FIELDS,
    WING_FIELDS,
    add_figure,
    begun_page,
    calibration_folder,
    end_page,
)
from fe.reduction.fields import WingFields, write_modes_vtu, write_wing_vtu
from fe.reduction.model_cache import wing_fields
from fe.runtime.reduced import Modes
from reporting.figures import LEVELS, panels, publication_style
from reporting.page import Page, Words
from reporting.progress import Progress
from reporting.words import plus_minus

from .calibrate import WingCalibration

WORDS = Words("calibration.wing")

LOAD_FACTOR = 3.0
"""Of the turn in which `wing.vtu` shows the wing."""

TABLE_NAME = "table_1.csv"


def write_wing_folder(
    calibration: WingCalibration, folder: Path, progress: Progress, *, report: bool = True
) -> Path:
    """Write page, figures, table, the wing for ParaView, and last `calibration.nc`; return its path.

    Without a report, table and `calibration.nc` alone.

    Raises
    ------
    FileNotWrittenError
        If a file cannot be written; the folder is then as it was.
    """
    result = calibration.result
    fields = wing_fields(result.design, progress=progress) if report else None
    with calibration_folder(result, folder) as fresh:
        write_table_1(calibration.table_1, fresh / TABLE_NAME)
        if fields is not None:
            state = result.mean_state()
            vector = fields.model.vector(state.values, state.stiffness_loss, load_factor=LOAD_FACTOR)
            write_wing_vtu(fresh / WING_FIELDS, fields, vector)
            write_modes_vtu(fresh / MODE_FIELDS, fields, vector)
            with progress.stage("Drawing the report"):
                page = begun_page(result, fresh)
                _add_sections(page, calibration, fields, fresh)
                end_page(page, result, fresh)
    return folder / FILE_NAME


def _add_sections(page: Page, calibration: WingCalibration, fields: WingFields, folder: Path) -> None:
    def show(name: str, figure: Figure, **values: object) -> None:
        add_figure(page, WORDS.figure(name, figure, **values), folder)

    lab, joint = calibration.lab, calibration.joint
    measured = any(origin.read for origin in lab.origins)
    for origin in lab.origins:
        add = page.add_notice if measured and not origin.read else page.add_paragraph
        add(WORDS.say("origin", origin=origin))
    page.add_section("Beside the paper")
    TABLE_1.add_table(page, "table_1", calibration.table_1)
    show("load_test", calibration_figure(calibration.static))
    rows = []
    for title, found in (
        ("tailored model", calibration.static),
        ("line of the paper, eq. (14)", calibration.static_published),
    ):
        ways = [("exact", found.exact), *((f"exact, {name}", e) for name, e in found.alternatives.items())]
        pairs = [(way, e, push_forward(e, found.curve)) for way, e in ways]
        pairs.append(("particle filter", found.particle, found.particle.stiffness))
        for way, e, k in pairs:
            told = (plus_minus(item.mean, item.standard_deviation) for item in (e, k))
            rows.append((title, way, *told))
    WORDS.add_table(page, "two_models", rows)
    places, names = drawn_parameters(joint)
    sets = [
        ("joint posterior", joint.samples[:, places]),
        ("the paper's procedure", calibration.paper.samples[:, places]),
    ]
    if lab.authors is not None:
        sets.append(("authors' model", lab.authors.samples))
    show("procedure", corner_figure(names, sets), authors=lab.authors is not None)
    page.add_section("Ring-down")
    if lab.trials is None:
        page.add_paragraph(WORDS.say("no_record"))
    else:
        show("ring_down", ring_down_figure(lab.trials))
    page.add_section("The calibrated wing")
    state = calibration.result.mean_state()
    modes = calibration.model.modes(state.values, state.stiffness_loss)
    flapwise = dict(zip(modes.followed, ("first flapwise", "second flapwise"), strict=True))
    titles = [
        f"mode {index + 1}, {frequency:.2f} Hz" + (f", {flapwise[index]}" if index in flapwise else "")
        for index, frequency in enumerate(modes.frequency[:6])
    ]
    show("modes", modes_figure(fields, modes, titles))


@publication_style()
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
    # the skin and the damage regions in it, see `fe.reduction.fields.WingFields`
    skin = fields.cells[fields.region <= len(fields.regions)][:, :8]
    upper = np.unique(skin[fields.points[skin][:, :, 2].mean(axis=1) > 0.0])
    points = fields.points[upper]
    # neighbours seen from above; those at the trailing edge, which is in front, are drawn last
    triangles = Triangulation(points[:, 1], points[:, 0]).triangles
    triangles = triangles[np.argsort(points[triangles, 0].mean(axis=1))]
    span = float(np.ptp(points[:, 1]))
    shapes = (fields.modal_displacement @ modes.shape)[upper]
    rows = (len(titles) + 1) // 2
    figure, grid = panels(
        rows, 2, 1.5 * rows, 0.015 * rows, 0.0, wspace=0.06, hspace=0.04, left=0.01, right=0.99
    )
    places = [axes for row in grid for axes in row]
    for axes, shape, title in zip(places, np.moveaxis(shapes, -1, 0), titles, strict=False):
        length = np.linalg.norm(shape, axis=1)
        largest = float(length.max())
        moved = points + shape * (0.14 * span / largest)
        for (x, y, z), value, colours in ((points.T, 0.1 * largest, "Greys"), (moved.T, length, LEVELS)):
            # oblique: span to the right, chord into the page
            seen = Triangulation(y - 0.45 * x, z - 0.40 * x, triangles)
            shade = np.broadcast_to(value, length.shape)
            axes.tripcolor(seen, shade, cmap=colours, clim=(0.0, largest), shading="gouraud", rasterized=True)
        axes.set(xlim=(-0.09 * span, 1.10 * span), ylim=(-0.24 * span, 0.27 * span), aspect="equal")
        axes.set_axis_off()
        axes.text(0.0, 0.97, title, transform=axes.transAxes, va="top", fontsize=8.0, fontweight="bold")
    for spare in places[len(titles) :]:
        spare.remove()
    return figure
