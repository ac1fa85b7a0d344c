"""The structure in the report: what is believed of its regions, and what its gauges show; pictures of plans.

They show what is done where on triangles of beliefs, and which sensors tell most.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from fe.elements.cells import CellMesh
from fe.elements.kinds import KINDS, meshio_with_wedges
from fe.structure.design import MeshDesign, load_structure
from fe.wing.design import WingDesign, load_design
from reporting import figures as style
from reporting.arrays import Float
from twin_master.assets.design_source import DESIGN_COPY, FLOWN_DESIGN_COPY
from twin_master.assets.reduced_model import FIELD_NAME
from twin_master.assets.structure_source import FLOWN_COPY, MODEL_COPY
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.planner import BeliefPolicy
from twin_master.report.reading import Run
from twin_master.scenario.mission import CALIBRATION_COPY
from twin_master.scenario.schema import Scenario

LOSS = "YlOrRd"
"""Colour map of what regions have lost."""
_BAR = {"pad": 0.02, "fraction": 0.02, "aspect": 14}
_LENGTH = 0.08
"""Length of the largest displacement in the picture, as a part of the structure's."""


class Planform(NamedTuple):
    """A wing from above [m]: x along the span from the root, y along the chord, positive to the front.

    Attributes
    ----------
    outline : (N, 2)
    regions : tuple of (N, 2)
        The damage regions, in the order of the state's factors.
    gauges : (G, 2)
    """

    outline: Float
    regions: tuple[Float, ...]
    gauges: Float


def planform_of(design: WingDesign | None, scenario: Scenario) -> Planform | None:
    """Return a wing from above; None without one that has the sensors of a scenario."""
    if design is None or len(design.gauges.positions) != scenario.observation.count:
        return None
    plan = design.planform

    def place(span: float, chord: float) -> tuple[float, float]:
        return span, (plan.straight_chord_line - chord) * plan.chord(span / plan.semi_span)

    def panel(start: float, end: float, front: float, rear: float) -> Float:
        corners = ((start, front), (end, front), (end, rear), (start, rear))
        return np.array([place(span, chord) for span, chord in corners])

    places = {
        f"z{number}": panel(d.span_start, d.span_end, d.chord_start, d.chord_end)
        for number, d in enumerate(design.defects, start=1)
    }
    names = scenario.state_names
    return Planform(
        outline=panel(0.0, plan.semi_span, 0.0, 1.0),
        regions=tuple(places[name] for name in names) if {*names} <= {*places} else (),
        gauges=np.array([place(span, chord) for span, chord in design.gauges.positions]),
    )


def design_of(folder: Path) -> WingDesign | None:
    """Return the design that the twin of a run folder believes, or else that of what is flown."""
    for copy in (DESIGN_COPY, FLOWN_DESIGN_COPY):
        if (folder / copy).is_file():
            return load_design(folder / copy)
    if (folder / CALIBRATION_COPY).is_file():
        from calibration.result.file import load_calibration

        return load_calibration(folder / CALIBRATION_COPY).design
    return None


def planform_figure(run: Run, planform: Planform, residual: Float) -> Figure:
    """Draw a wing after its last step: regions by belief, gauges by reading and by residual (G,)."""
    measured, sensors = run.sensors.scale * run.observed[-1], run.sensors
    shown: tuple[tuple[str, str, Float, str, dict[str, Any]], ...] = (
        ("a", f"Measured {sensors.quantity}", measured, f"{sensors.quantity} ({sensors.unit})", {}),
        ("b", "Measured less expected", residual, "standard deviations", style.RESIDUALS),
    )
    with style.publication_style():
        figure, rows = style.panels(2, 1, 4.0, 0.3, 0.1, left=0.1, right=0.92, hspace=0.25)
        for (axes,), (label, title, values, unit, look) in zip(rows, shown, strict=True):
            axes.fill(*planform.outline.T, facecolor="#f2f4f6", edgecolor=style.REFERENCE)
            regions = PolyCollection(
                planform.regions, array=(run.scales * run["filtered/mean"][-1])[: len(planform.regions)],
                cmap=LOSS, edgecolors="black", linewidths=0.7,
                clim=(run.factors[0].levels[0], max(factor.levels[-1] for factor in run.factors)),
            )  # fmt: skip
            axes.add_collection(regions)
            _draw_gauges(figure, axes, planform.gauges, values, unit, **look)
            axes.set_aspect("equal")
            axes.axis("off")
            style.panel_label(axes, label, title)
            if planform.regions:
                unit = run.factors[0].unit
                style.color_bar(figure, regions, f"expected loss ({unit})", ax=axes, location="left", **_BAR)
    return figure


def _draw_gauges(figure: Figure, axes: Axes, places: Float, values: Float, unit: str, **look: Any) -> None:
    """Draw gauges (G, 2) by their values (G,), and a cross where one was lost."""
    known = np.isfinite(values)
    look = {"cmap": style.LEVELS, **look}
    (x, y), (left, low) = places[known].T, places[~known].T
    dots = axes.scatter(x, y, c=values[known], s=36.0, edgecolors="black", linewidths=0.5, **look)
    axes.scatter(left, low, marker="x", s=30.0, color=style.TRUTH, label="lost")
    style.color_bar(figure, dots, unit, ax=axes, **_BAR)


class StructurePicture(NamedTuple):
    """A picture, the largest displacement [m] in it, and how many times displacements are exaggerated."""

    figure: Figure
    largest: float
    scale: float


def mesh_figure(run: Run, folder: Path, residual: Float) -> StructurePicture:
    """Draw the surface of a structure, regions by what they have lost, gauges by residual (G,)."""
    mesh = meshio_with_wedges().read(folder / FIELD_NAME)
    body = CellMesh(KINDS[mesh.cells[0].type], mesh.points, np.asarray(mesh.cells[0].data))
    loss = np.asarray(mesh.cell_data["stiffness_loss"][0], dtype=np.float64)
    region = np.asarray(mesh.cell_data["region"][0])
    displacement = np.asarray(mesh.point_data["displacement"], dtype=np.float64)
    largest = float(np.linalg.norm(displacement, axis=1).max())
    size = float(np.linalg.norm(np.ptp(mesh.points, axis=0)))
    scale = _LENGTH * size / largest if largest > 0.0 else 0.0
    cells, faces, _ = body.outer_faces
    corners = [body.cells[cell, list(body.kind.faces[face])] for cell, face in zip(cells, faces, strict=True)]
    points = np.asarray(mesh.points + scale * displacement)
    # seen from above, in front and the right; what is farther is drawn first
    angle, tilt = np.radians(-60.0), np.radians(28.0)
    across = np.array([-np.sin(angle), np.cos(angle), 0.0])
    towards = np.array([np.cos(angle) * np.cos(tilt), np.sin(angle) * np.cos(tilt), np.sin(tilt)])
    view = np.column_stack((across, np.cross(towards, across)))
    order = np.argsort([(points[nodes] @ towards).mean() for nodes in corners])
    with style.publication_style():
        figure, ((axes,),) = style.panels(1, 1, 0.55 * style.FULL_WIDTH, 0.05, 0.05, left=0.1, right=0.9)
        patches = PolyCollection(
            [points[corners[number]] @ view for number in order], array=100.0 * loss[cells][order], cmap=LOSS,
            edgecolors=["black" if region[cells[number]] > 0 else "0.6" for number in order], linewidths=0.4,
            clim=(0.0, 100.0),
        )  # fmt: skip
        axes.add_collection(patches)
        copies = (folder / name for name in (MODEL_COPY, FLOWN_COPY))
        places = gauge_places(next((copy for copy in copies if copy.is_file()), None))
        if places is not None and len(places) == len(residual):
            nearest = np.argmin(np.linalg.norm(mesh.points[:, None] - places, axis=2), axis=0)
            places = (places + scale * displacement[nearest]) @ view
            _draw_gauges(figure, axes, places, residual, "gauges: standard deviations", **style.RESIDUALS)
        axes.autoscale_view()
        axes.set_aspect("equal")
        axes.axis("off")
        style.color_bar(figure, patches, "stiffness loss (%)", ax=axes, location="left", **_BAR)
    return StructurePicture(figure, largest, scale)


def gauge_places(file: Path | None) -> Float | None:
    """Return where the gauges of a structure are (G, 3) [m]; None where its file does not say it."""
    structure = None if file is None else load_structure(file)
    if not isinstance(structure, MeshDesign):
        return None
    return structure.unit * np.array([gauge.point for gauge in structure.gauge])


_COLORS = ("#56B4E9", "#E69F00", style.PRESENT, style.DECISION, style.PREDICTION, "#F0E442", style.PAST)
_ROWS = 60
"""Rows of points in a triangle."""


def triangle_of(model: GraphicalModel, place: int) -> Float:
    """Return three beliefs (3, S) of one factor: at its lowest level, at its highest, and not known.

    The other factors are at their lowest levels.
    """
    corners = []
    for own in (0, -1, slice(None)):
        belief = np.zeros(model.states.shape)
        levels: list[Any] = [0] * belief.ndim
        levels[place] = own
        belief[tuple(levels)] = 1.0
        corners.append(belief.ravel() / belief.sum())
    return np.array(corners)


@style.publication_style()
def plan_figure(policy: BeliefPolicy, model: GraphicalModel) -> Figure:
    """Draw for each factor of the state what a policy does between three beliefs, the control by colour."""
    factors, count = model.states.names[:3], len(model.controls)
    share = np.array([(i, j) for i in range(_ROWS + 1) for j in range(_ROWS + 1 - i)]) / _ROWS
    weight = np.column_stack((1.0 - share.sum(axis=1), share))
    x, y = (weight @ np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 0.866]])).T
    mesh = Triangulation(x, y)
    colors = [_COLORS[number % len(_COLORS)] for number in range(count)]
    cmap = ListedColormap(colors)
    figure, (row,) = style.panels(1, len(factors), 3.2, 0.4, 0.45, left=0.03, right=0.97)
    centre = weight[mesh.triangles].mean(axis=1)
    for place, (axes, name) in enumerate(zip(row, factors, strict=True)):
        chosen = policy.decide(centre @ triangle_of(model, place))
        axes.tripcolor(mesh, facecolors=chosen, edgecolors="face", cmap=cmap, vmin=-0.5, vmax=count - 0.5)
        for text, at in (("lowest", (0.0, -0.06)), ("highest", (1.0, -0.06)), ("not known", (0.5, 0.9))):
            axes.text(*at, text, ha="center", va="top" if at[1] < 0.0 else "bottom")
        axes.set_aspect("equal")
        axes.set_axis_off()
        style.panel_label(axes, "abc"[place], f"Belief of {name}")
    handles = style.swatches(model.controls, colors)
    figure.legend(handles=handles, loc="lower center", ncols=count, handlelength=1.4)
    return figure


@style.publication_style()
def design_figure(
    information: Sequence[float], of_all: float, names: Sequence[str], places: Float | None,
    chosen: Sequence[int], outlines: Sequence[Float],
) -> Figure:  # fmt: skip
    """Draw what the chosen sensors tell together, and where they are on a wing from above.

    Parameters
    ----------
    information : sequence of float
        Of the first, the first two, ... of them [bit].
    of_all : float
        Of all candidates [bit].
    names : sequence of str
        Of the chosen sensors.
    places : (G, 2) or None
        Of all sensors [m]; None where they are not known.
    chosen : sequence of int
        Sensors, from 0.
    outlines : sequence of (N, 2)
        What is drawn below the sensors [m].
    """
    figure = style.new_figure(2.6)
    ratios = [1] if places is None else [2, 3]
    panels = figure.subplots(1, len(ratios), squeeze=False, width_ratios=ratios)[0]
    number = np.arange(1, len(information) + 1)
    panels[0].plot(number, information, "o-", color=style.PRESENT)
    panels[0].axhline(of_all, color=style.REFERENCE, linestyle="--", label="all candidates")
    panels[0].set(xlabel="sensors", ylabel="expected information [bit]", ylim=(0.0, None))
    panels[0].set_xticks(number, names, rotation=60)
    panels[0].legend(loc="lower right")
    if places is not None:
        for outline in outlines:
            panels[1].fill(*outline.T, facecolor="none", edgecolor=style.REFERENCE, linewidth=0.8)
        panels[1].plot(*places.T, "o", color=style.REFERENCE, markersize=3.5)
        panels[1].plot(*places[list(chosen)].T, "o", color=style.PRESENT, markersize=6)
        for rank, sensor in enumerate(chosen, start=1):
            panels[1].annotate(str(rank), places[sensor], (3, 3), textcoords="offset points")
        panels[1].set_aspect("equal")
        panels[1].set_axis_off()
    figure.tight_layout()
    return figure
