"""The picture of a meshed structure in the view: its outer faces, seen from one side."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from fe.structure.design import MeshDesign, load_structure
from fe.structure.operators import structure_mesh
from reporting.arrays import Float
from twin_master.assets.structure_source import structure_file_in
from twin_master.report.structure import structure_camera
from twin_master.scenario.schema import Scenario

_MOST_FACES = 5000
"""Largest number of faces that a page draws; a finer mesh has no picture."""
NO_REGION = -1
"""Region of a face outside of all damage regions of the scenario."""
_DIGITS = 5


class PartPicture(NamedTuple):
    """The visible faces of a structure in a picture plane.

    Attributes
    ----------
    faces : list of list of tuple
        The corners of each face, in fractions of the width of the picture; the nearest face is the
        last one.
    region : list of int
        The index of the factor of the state that each face belongs to; `NO_REGION` if to none.
    gauges : list of tuple
        The positions of the gauges.
    """

    faces: list[list[tuple[float, float]]]
    region: list[int]
    gauges: list[tuple[float, float]]


def part_picture(folder: Path, scenario: Scenario) -> PartPicture | None:
    """Return the picture of the structure of a flight, or None if there is none to draw.

    There is none if the structure has no mesh, if the mesh is too fine for a page, or if it has
    another number of gauges than the scenario has sensors.

    Parameters
    ----------
    folder : Path
        The folder of the flight, with the structure of the twin's model or of the asset.
    scenario : Scenario
        The scenario, which defines the sensors and the factors of the state.
    """
    file = structure_file_in(folder)
    if file is None:
        return None
    design = load_structure(file)
    if not isinstance(design, MeshDesign) or len(design.gauge) != scenario.observation.count:
        return None
    mesh = structure_mesh(design, file)
    region_of_cell = np.full(len(mesh.cells), NO_REGION)
    for damage in design.damage:
        if damage.name in scenario.state_names:
            cells = mesh.cells_of(damage.set, "a damage region")
            region_of_cell[cells] = scenario.state_names.index(damage.name)

    camera = structure_camera()
    outer_faces = mesh.outer_faces
    faces = []
    for cell, number in zip(outer_faces.cell.tolist(), outer_faces.number.tolist(), strict=True):
        corners = mesh.points[mesh.cells[cell, list(mesh.kind.faces[number])]]
        if _faces_viewer(corners, mesh.centres[cell], camera.to_viewer):
            faces.append((float(corners.mean(axis=0) @ camera.to_viewer), cell, corners))
    if len(faces) > _MOST_FACES:
        return None
    faces.sort(key=lambda face: face[0])  # from the farthest to the nearest

    gauges = design.unit * np.array([gauge.point for gauge in design.gauge])
    drawn_points = np.concatenate([mesh.points, gauges]) @ camera.picture_axes
    low = drawn_points.min(axis=0)
    width = float(np.ptp(drawn_points[:, 0])) or 1.0

    def drawn(points: Float) -> list[tuple[float, float]]:
        """Return points (n, 3) in the picture, in fractions of its width."""
        in_picture = np.round((points @ camera.picture_axes - low) / width, _DIGITS)
        return [(x, y) for x, y in in_picture.tolist()]

    return PartPicture(
        faces=[drawn(corners) for _, _, corners in faces],
        region=[int(region_of_cell[cell]) for _, cell, _ in faces],
        gauges=drawn(gauges),
    )


def _faces_viewer(corners: Float, cell_centre: Float, to_viewer: Float) -> bool:
    """Return whether a face (n, 3) of a cell turns its outer side to the viewer."""
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    outwards = corners.mean(axis=0) - cell_centre
    if normal @ outwards < 0.0:
        normal = -normal
    return bool(normal @ to_viewer > 0.0)
