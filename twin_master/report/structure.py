"""Pictures of the structure after the last step: a wing seen from above, or a mesh's surface."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection, PolyCollection
from matplotlib.figure import Figure

from fe.elements.cells import CellMesh
from fe.elements.kinds import KINDS, meshio_with_wedges
from fe.structure.design import MeshDesign, load_structure
from fe.wing.design import WingDesign, load_design
from reporting.arrays import Float, Index
from reporting.pages import figures as style
from twin_master.assets.design_source import DESIGN_COPY, FLOWN_DESIGN_COPY
from twin_master.assets.reduced_model import FIELD_NAME
from twin_master.assets.structure_source import structure_file_in
from twin_master.report.reading import Run
from twin_master.scenario.mission import CALIBRATION_COPY
from twin_master.scenario.schema import Scenario

LOSS_COLORS = "YlOrRd"
"""Colour map of the stiffness that regions have lost."""
_COLOR_BAR: style.ColorBarShape = {"pad": 0.02, "fraction": 0.02, "aspect": 14}
_DRAWN_DISPLACEMENT = 0.08
"""Length of the largest displacement in the picture, as a fraction of the structure's diagonal."""


class Planform(NamedTuple):
    """A wing seen from above.

    Coordinates are in metres: x along the span from the root, y along the chord, positive to the
    front.

    Attributes
    ----------
    outline : (N, 2) array
        The corners of the wing.
    regions : tuple of (N, 2) array
        The corners of the damage regions, in the order of the factors of the state; empty if the
        factors are not the regions of the wing.
    gauges : (G, 2) array
        The positions of the gauges.
    """

    outline: Float
    regions: tuple[Float, ...]
    gauges: Float


def planform_of(design: WingDesign | None, scenario: Scenario) -> Planform | None:
    """Return outline, damage regions and gauges of a wing as seen from above.

    Parameters
    ----------
    scenario : Scenario
        The scenario, which defines the sensors and the factors of the state.

    Returns
    -------
    Planform or None
        The wing; None if there is no design, or if the number of its gauges is not that of the
        scenario's sensors.
    """
    if design is None or len(design.gauges.positions) != scenario.observation.count:
        return None
    # The factors z1, z2, ... of a state are the stiffness losses of the defects in their order.
    region_of_factor = {}
    for number, defect in enumerate(design.defects, start=1):
        span = (defect.span_start, defect.span_end)
        chord = (defect.chord_start, defect.chord_end)
        region_of_factor[f"z{number}"] = _wing_panel(design, span, chord)
    regions: tuple[Float, ...] = ()  # if the scenario has any other factor
    if all(name in region_of_factor for name in scenario.state_names):
        regions = tuple(region_of_factor[name] for name in scenario.state_names)

    whole_span = (0.0, design.planform.semi_span)
    whole_chord = (0.0, 1.0)
    gauge_points = []
    for span_position, chord_fraction in design.gauges.positions:
        gauge_points.append(_wing_point(design, span_position, chord_fraction))
    return Planform(
        outline=_wing_panel(design, whole_span, whole_chord),
        regions=regions,
        gauges=np.array(gauge_points),
    )


def _wing_point(design: WingDesign, span: float, chord_fraction: float) -> tuple[float, float]:
    """Return the coordinates x, y [m] of a point of a wing as seen from above.

    Parameters
    ----------
    span : float
        The distance from the root [m].
    chord_fraction : float
        The distance behind the leading edge, as a fraction of the local chord.
    """
    planform = design.planform
    chord = planform.chord(span / planform.semi_span)
    return span, (planform.straight_chord_line - chord_fraction) * chord


def _wing_panel(design: WingDesign, span: tuple[float, float], chord: tuple[float, float]) -> Float:
    """Return the four corners [m] of a panel of a wing from above, a (4, 2) array.

    The panel lies between two distances from the root [m] and two fractions of the chord.
    """
    start, end = span
    front, rear = chord
    corners = [
        _wing_point(design, start, front),
        _wing_point(design, end, front),
        _wing_point(design, end, rear),
        _wing_point(design, start, rear),
    ]
    return np.array(corners)


def design_of(folder: Path) -> WingDesign | None:
    """Return the wing design in a run folder; None if the folder has none.

    The design of the twin's model is preferred, then that of the asset, then that of the
    calibration.
    """
    for name in (DESIGN_COPY, FLOWN_DESIGN_COPY):
        if (folder / name).is_file():
            return load_design(folder / name)
    if (folder / CALIBRATION_COPY).is_file():
        from calibration.result.file import load_calibration

        return load_calibration(folder / CALIBRATION_COPY).design
    return None


@style.publication_style()
def planform_figure(run: Run, planform: Planform, residual: Float) -> Figure:
    """Draw a wing from above after the last step, with the readings (a) and the residuals (b).

    The colour of a region is its expected stiffness loss.

    Parameters
    ----------
    planform : Planform
        The planform of the wing.
    residual : (G,) array
        The residuals of the last observations, in standard deviations; NaN where one was lost.
    """
    figure, ((left_axes, right_axes),) = style.panels(
        1, 2, 1.85, 0.3, 0.65, left=0.02, right=0.98, wspace=0.08
    )
    sensors = run.sensors
    _draw_wing(
        figure,
        left_axes,
        run,
        planform,
        values=sensors.scale * run.observations[-1],
        value_label=f"{sensors.quantity} ({sensors.unit})",
        look={"cmap": style.LEVELS},
    )
    style.panel_label(left_axes, "a", f"Measured {sensors.quantity}")
    _draw_wing(
        figure,
        right_axes,
        run,
        planform,
        values=residual,
        value_label="standard deviations",
        look=style.RESIDUALS,
    )
    style.panel_label(right_axes, "b", "Measured less expected")
    return figure


def _draw_wing(
    figure: Figure,
    axes: Axes,
    run: Run,
    planform: Planform,
    *,
    values: Float,
    value_label: str,
    look: style.ColorScale,
) -> None:
    """Draw a wing from above, its regions coloured by expected loss, its gauges by values (G,).

    The colour bars are below the wing: that of the losses on the left, that of the values on the
    right. `look` holds the colours of the values, as arguments of `Axes.scatter`.
    """
    x, y = planform.outline.T
    axes.fill(x, y, facecolor="#f2f4f6", edgecolor=style.REFERENCE)
    expected_loss = run.factor_scales * run["filtered/mean"][-1]
    lowest_level = run.factors[0].levels[0]
    highest_level = max(factor.levels[-1] for factor in run.factors)
    regions = PolyCollection(
        planform.regions,
        array=expected_loss[: len(planform.regions)],
        cmap=LOSS_COLORS,
        edgecolors="black",
        linewidths=0.7,
        clim=(lowest_level, highest_level),
    )
    axes.add_collection(regions)
    dots = _draw_gauges(axes, planform.gauges, values, look)
    axes.set_aspect("equal")
    axes.axis("off")
    scale = axes.inset_axes((0.56, -0.22, 0.4, 0.07))
    style.color_bar(figure, dots, value_label, cax=scale, location="bottom")
    if planform.regions:
        scale = axes.inset_axes((0.04, -0.22, 0.4, 0.07))
        label = f"expected loss ({run.factors[0].unit})"
        style.color_bar(figure, regions, label, cax=scale, location="bottom")


def _draw_gauges(
    axes: Axes, positions: Float, values: Float, look: style.ColorScale
) -> PathCollection:
    """Draw gauges at positions (G, 2) as dots coloured by values (G,), and return the dots.

    A gauge with a lost reading (NaN) is a cross. `look` holds the colours of the values, as
    arguments of `Axes.scatter`.
    """
    is_known = np.isfinite(values)
    x, y = positions[is_known].T
    dots = axes.scatter(
        x, y, c=values[is_known], s=20.0, edgecolors="black", linewidths=0.5, **look
    )
    x, y = positions[~is_known].T
    axes.scatter(x, y, marker="x", s=30.0, color=style.TRUTH, label="lost")
    return dots


class StructurePicture(NamedTuple):
    """A picture of a displaced structure.

    Attributes
    ----------
    figure : Figure
        The figure that is drawn in.
    largest : float
        The largest displacement of a node [m].
    scale : float
        The factor by which displacements are drawn larger than they are.
    """

    figure: Figure
    largest: float
    scale: float


class StructureField(NamedTuple):
    """The last state of a structure of n nodes and m cells, as a run folder keeps it.

    Attributes
    ----------
    body : CellMesh
        The mesh; positions in metres.
    displacement : (n, 3) array
        The displacements of the nodes [m].
    stiffness_loss : (m,) array
        The fraction of its stiffness that each cell has lost.
    region : (m,) array
        The number of the damage region of each cell; 0 outside of all regions.
    """

    body: CellMesh
    displacement: Float
    stiffness_loss: Float
    region: Index


def read_field(path: Path) -> StructureField:
    """Read the last state of a structure from a file of a run folder."""
    mesh = meshio_with_wedges().read(path)
    cells = mesh.cells[0]
    return StructureField(
        body=CellMesh(KINDS[cells.type], mesh.points, np.asarray(cells.data)),
        displacement=np.asarray(mesh.point_data["displacement"], dtype=np.float64),
        stiffness_loss=np.asarray(mesh.cell_data["stiffness_loss"][0], dtype=np.float64),
        region=np.asarray(mesh.cell_data["region"][0]),
    )


class Camera(NamedTuple):
    """The direction and the picture plane of a parallel projection.

    Attributes
    ----------
    to_viewer : (3,) array
        The unit vector from the structure to the viewer.
    picture_axes : (3, 2) array
        The unit vectors to the right and upwards in the picture, as columns.
    """

    to_viewer: Float
    picture_axes: Float


def structure_camera() -> Camera:
    """Return the camera of all pictures of structures: azimuth -60°, elevation 28°."""
    azimuth = np.radians(-60.0)
    elevation = np.radians(28.0)
    to_viewer = np.array(
        [
            np.cos(azimuth) * np.cos(elevation),
            np.sin(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ]
    )
    to_right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    upwards = np.cross(to_viewer, to_right)
    return Camera(to_viewer, np.column_stack((to_right, upwards)))


@style.publication_style()
def mesh_figure(run_folder: Path, residual: Float) -> StructurePicture:
    """Draw the displaced surface of a structure after the last step, with the residuals of gauges.

    Displacements are enlarged so that the largest is `_DRAWN_DISPLACEMENT` of the diagonal.

    Parameters
    ----------
    run_folder : Path
        The folder of the run, with the last state of the structure.
    residual : (G,) array
        The residuals of the last observations, in standard deviations; NaN where one was lost.
    """
    field = read_field(run_folder / FIELD_NAME)
    points = field.body.points
    largest_displacement = float(np.linalg.norm(field.displacement, axis=1).max())
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    scale = (
        _DRAWN_DISPLACEMENT * diagonal / largest_displacement if largest_displacement > 0.0 else 0.0
    )
    displaced_points = np.asarray(points + scale * field.displacement)
    camera = structure_camera()
    figure, ((axes,),) = style.panels(
        1, 1, 0.55 * style.FULL_WIDTH, 0.05, 0.05, left=0.1, right=0.9
    )
    surface = _draw_surface(axes, field, displaced_points, camera)
    gauges = gauge_places(structure_file_in(run_folder))
    if gauges is not None and len(gauges) == len(residual):
        distance = np.linalg.norm(points[:, None] - gauges, axis=2)  # (nodes, gauges)
        nearest_node = np.argmin(distance, axis=0)
        # A gauge is drawn with the displacement of the node nearest to it.
        displaced_gauges = gauges + scale * field.displacement[nearest_node]
        gauges_in_picture = displaced_gauges @ camera.picture_axes
        dots = _draw_gauges(axes, gauges_in_picture, residual, style.RESIDUALS)
        style.color_bar(figure, dots, "gauges: standard deviations", ax=axes, **_COLOR_BAR)
    axes.autoscale_view()
    axes.set_aspect("equal")
    axes.axis("off")
    label = "stiffness loss (%)"
    style.color_bar(figure, surface, label, ax=axes, location="left", **_COLOR_BAR)
    return StructurePicture(figure, largest_displacement, scale)


def _draw_surface(
    axes: Axes, field: StructureField, points: Float, camera: Camera
) -> PolyCollection:
    """Draw the surface of a structure, and return its coloured faces.

    A face has the colour of the stiffness loss of its cell [%]. Faces of damage regions have black
    edges. Faces are drawn from the farthest to the nearest, so that near faces hide the faces
    behind them.

    Parameters
    ----------
    points : (n, 3) array
        The positions at which the n nodes of the mesh are drawn [m].
    """
    body = field.body
    outer_faces = body.outer_faces
    nodes_of_faces = []
    for cell, face in zip(outer_faces.cell, outer_faces.number, strict=True):
        nodes_of_faces.append(body.cells[cell, list(body.kind.faces[face])])
    distances = [(points[nodes] @ camera.to_viewer).mean() for nodes in nodes_of_faces]
    order = np.argsort(distances)
    is_in_region = field.region[outer_faces.cell] > 0
    surface = PolyCollection(
        [points[nodes_of_faces[face]] @ camera.picture_axes for face in order],
        array=100.0 * field.stiffness_loss[outer_faces.cell][order],
        cmap=LOSS_COLORS,
        edgecolors=["black" if is_in_region[face] else "0.6" for face in order],
        linewidths=0.4,
        clim=(0.0, 100.0),
    )
    axes.add_collection(surface)
    return surface


def gauge_places(file: Path | None) -> Float | None:
    """Return the positions of the gauges in a structure file.

    Parameters
    ----------
    file : Path or None
        The file of a structure.

    Returns
    -------
    (G, 3) array or None
        The positions [m]; None if there is no file, or if it describes no mesh.
    """
    structure = None if file is None else load_structure(file)
    if not isinstance(structure, MeshDesign):
        return None
    return structure.unit * np.array([gauge.point for gauge in structure.gauge])
