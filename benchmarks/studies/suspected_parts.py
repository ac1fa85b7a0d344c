"""Parts whose supports, masses, stiffness, loads and gauges may be wrong, as structure files.

A bracket, a portal frame, a stiffened plate and a curved arm from 20-node hexahedra on a grid. A
fault changes the file of the truth; that of the model stays as it is drawn.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import meshio
import numpy as np

from fe.elements.kinds import KINDS
from fe.runtime.arrays import FloatArray
from reporting.formats.toml_file import toml_text

Point = tuple[float, float, float]

MOTIONS = ("x", "y", "z", "rx", "ry", "rz")
"""Motions of a support, in the order of its springs."""
ARM_RADIUS = 160.0 / (0.5 * np.pi)
"""Radius of the middle line of the arm, a quarter of a circle [mm]."""
ARM_HEIGHT = 8.0
"""Thickness of the arm [mm]."""
GAUGE_LENGTH = 3.0
"""Length of each strain gauge [mm]."""

MODES_OF_MODEL = 8
"""Number of modes of the reduced models: releases show those above the usual six, too."""


@dataclass(frozen=True)
class Fault:
    """Something that a truth hides.

    Attributes
    ----------
    effect : str
        Identifier of the effect that a verdict should name; "nothing" without a fault.
    place : str
        Support, load, gauge or channel; empty for a mass or a loss, which lie at `point`.
    motion : str
        Motion of a support, or axis of an offset.
    value : float
        Spring [N/m or N m/rad], mass [kg], loss [1], offset [m] or gain error [1].
    point : (3,) tuple of float
        Place of a mass, or middle of a loss [mm].
    box : pair of (3,) tuples of float
        Corners of the cells that lose stiffness, on the grid of the part [mm].
    """

    effect: str
    place: str = ""
    motion: str = ""
    value: float = 0.0
    point: Point = (0.0, 0.0, 0.0)
    box: tuple[Point, Point] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Sensor:
    """A strain gauge, or a displacement sensor, at a point of the grid [mm], with its direction."""

    name: str
    point: Point
    direction: Point


@dataclass(frozen=True)
class Part:
    """A part on a grid of cells.

    Attributes
    ----------
    breaks : three tuples of float
        Planes of the grid along x, y and z [mm].
    counts : three tuples of int
        Cells of the model between two planes; the truth has twice as many.
    solid : sequence of pairs of (3,) tuples
        Boxes of the grid that are solid [mm].
    supports : dict of str to pair of (3,) tuples
        Boxes around the clamped nodes [mm].
    loads, gauges, displacements : sequence of Sensor
        Loads of 1 N, strain gauges, and displacement sensors.
    force : float
        Largest static force [N].
    bend : callable
        From points (n, 3) of the grid to those of the part [mm].
    tool : (3,) tuple of float
        Where a known mass of 0.1 kg sits [mm].
    """

    breaks: tuple[tuple[float, ...], ...]
    counts: tuple[tuple[int, ...], ...]
    solid: Sequence[tuple[Point, Point]]
    supports: dict[str, tuple[Point, Point]]
    loads: Sequence[Sensor]
    gauges: Sequence[Sensor]
    displacements: Sequence[Sensor]
    force: float
    tool: Point
    bend: Callable[[FloatArray], FloatArray] = field(default=lambda points: points)

    def place(self, point: Point) -> list[float]:
        """Return the place of a point of the grid in the part [mm]."""
        (bent,) = self.bend(np.array([point], dtype=np.float64))
        return [round(float(value), 9) for value in bent]

    def direction(self, sensor: Sensor) -> list[float]:
        """Return the unit vector of a gauge's direction, which follows the bend."""
        step = 1e-3 * np.array(sensor.direction)
        ends = np.array(sensor.point) + np.array([step, -step])
        plus_end, minus_end = self.bend(ends)
        return [
            float(value) for value in (plus_end - minus_end) / np.linalg.norm(plus_end - minus_end)
        ]


def _bent_to_quarter(points: FloatArray) -> FloatArray:
    """Return points (n, 3) of a bar along x, bent to a quarter of a circle [mm]."""
    along, across, through = points.T
    angle = along / ARM_RADIUS
    radius = ARM_RADIUS + through - 0.5 * ARM_HEIGHT
    return np.column_stack((radius * np.sin(angle), across, radius * np.cos(angle) - ARM_RADIUS))


X = (1.0, 0.0, 0.0)
Y = (0.0, 1.0, 0.0)
Z = (0.0, 0.0, 1.0)
DOWN = (0.0, 0.0, -1.0)
PARTS = {
    "bracket": Part(
        breaks=((0.0, 8.0, 100.0), (0.0, 30.0), (0.0, 8.0, 80.0)),
        counts=((2, 12), (4,), (2, 10)),
        solid=[((0, 0, 0), (8, 30, 80)), ((0, 0, 0), (100, 30, 8))],
        supports={"CLAMP": ((0, 0, 80), (8, 30, 80))},
        loads=[Sensor("pull", (96, 15, 8), Z), Sensor("side", (96, 15, 8), Y)],
        gauges=[
            Sensor("g1", (0, 10, 60), Z),
            Sensor("g2", (0, 10, 30), Z),
            Sensor("g3", (28, 10, 0), X),
            Sensor("g4", (56, 20, 0), X),
        ],
        displacements=[
            Sensor("tip", (96, 15, 8), Z),
            Sensor("tip_y", (96, 15, 8), Y),
            Sensor("elbow", (0, 15, 4), X),
        ],
        force=300.0,
        tool=(88, 15, 8),
    ),
    "portal": Part(
        breaks=((0.0, 8.0, 232.0, 240.0), (0.0, 16.0), (0.0, 142.0, 150.0)),
        counts=((2, 28, 2), (2,), (18, 2)),
        solid=[
            ((0, 0, 0), (8, 16, 150)),
            ((232, 0, 0), (240, 16, 150)),
            ((0, 0, 142), (240, 16, 150)),
        ],
        supports={"LEFT": ((0, 0, 0), (8, 16, 0)), "RIGHT": ((232, 0, 0), (240, 16, 0))},
        loads=[Sensor("side", (0, 8, 146), X), Sensor("down", (90, 8, 150), DOWN)],
        gauges=[
            Sensor("g1", (0, 8, 25), Z),
            Sensor("g2", (0, 8, 115), Z),
            Sensor("g3", (240, 8, 25), Z),
            Sensor("g4", (240, 8, 115), Z),
            Sensor("g5", (50, 8, 150), X),
            Sensor("g6", (160, 8, 150), X),
        ],
        displacements=[
            Sensor("corner", (0, 8, 146), X),
            Sensor("beam", (90, 8, 150), DOWN),
            Sensor("beam_2", (165, 8, 150), DOWN),
        ],
        force=400.0,
        tool=(150, 8, 150),
    ),
    "plate": Part(
        breaks=((0.0, 160.0), (0.0, 46.0, 54.0, 100.0), (-12.0, 0.0, 4.0)),
        counts=((16,), (6, 2, 6), (2, 1)),
        solid=[((0, 0, 0), (160, 100, 4)), ((0, 46, -12), (160, 54, 4))],
        supports={"CLAMP": ((0, 0, -12), (0, 100, 4))},
        loads=[Sensor("corner", (150, 85, 4), Z), Sensor("edge", (150, 25, 4), Z)],
        gauges=[
            Sensor("g1", (28, 25, 4), X),
            Sensor("g2", (28, 75, 4), X),
            Sensor("g3", (80, 50, 4), X),
            Sensor("g4", (90, 85, 4), X),
            Sensor("g5", (70, 18, 4), X),
        ],
        displacements=[
            Sensor("corner_z", (150, 85, 4), Z),
            Sensor("edge_z", (150, 25, 4), Z),
            Sensor("middle", (80, 85, 4), Z),
        ],
        force=200.0,
        tool=(140, 50, 4),
    ),
    "arm": Part(
        breaks=((0.0, 160.0), (0.0, 20.0), (0.0, ARM_HEIGHT)),
        counts=((28,), (4,), (2,)),
        solid=[((0, 0, 0), (160, 20, 8))],
        supports={"CLAMP": ((0, 0, 0), (0, 20, 8))},
        loads=[Sensor("pull", (158, 10, 8), Z), Sensor("side", (158, 10, 8), Y)],
        gauges=[
            Sensor("g1", (24, 8, 8), X),
            Sensor("g2", (56, 8, 8), X),
            Sensor("g3", (84, 12, 8), X),
            Sensor("g4", (116, 8, 8), X),
        ],
        displacements=[
            Sensor("tip", (158, 10, 8), Z),
            Sensor("tip_y", (158, 10, 8), Y),
            Sensor("middle", (80, 10, 8), Z),
        ],
        force=300.0,
        tool=(150, 10, 8),
        bend=_bent_to_quarter,
    ),
}


def write_part(folder: Path, part: Part, refinement: int, faults: Sequence[Fault]) -> Path:
    """Write mesh and structure file of a part; a loss of stiffness is a damage region "lost".

    Parameters
    ----------
    folder : Path
        Where the files are written.
    part : Part
        The part.
    refinement : int
        Cells along each axis in one of the model.
    faults : sequence of Fault
        What differs from the drawing.
    """
    regions = _write_mesh(folder / "part.vtu", part, refinement, faults)
    drawing: dict[str, Any] = {
        "name": "part",
        "mesh": "part.vtu",
        "length_unit": "mm",
        "reduction": {"modes": MODES_OF_MODEL},
        "parameter": [{"name": "e", "minimum": 0.9, "maximum": 1.1}],
        "control": [
            {"name": load.name, "unit": "N", "nominal": 100.0, "minimum": -3e3, "maximum": 3e3}
            for load in part.loads
        ],
        "material": [
            {
                "name": "steel",
                "density": 7850.0,
                "young_modulus": 2.1e11,
                "poisson_ratio": 0.3,
                "scaled_by": "e",
            }
        ],
        "support": [{"set": name, "hold": ["x", "y", "z"]} for name in part.supports],
        "load": [
            {
                "name": load.name,
                "control": load.name,
                "point": part.place(load.point),
                "force": list(load.direction),
            }
            for load in part.loads
        ],
        "mass": [{"name": "tool", "point": part.place(part.tool), "mass": 0.1}],
        "damage": [{"name": name, "set": name} for name in regions],
        "gauge": [_gauge(part, gauge, 0.0) for gauge in part.gauges],
        "displacement": [
            {
                "name": sensor.name,
                "point": part.place(sensor.point),
                "direction": list(sensor.direction),
            }
            for sensor in part.displacements
        ],
        "damping": {"alpha": 1.0, "beta": 1e-5},
    }
    for fault in faults:
        _change_drawing(drawing, part, fault)
    file = folder / "part.toml"
    file.write_text(toml_text(drawing), encoding="utf-8")
    return file


def _gauge(part: Part, gauge: Sensor, offset: float) -> dict[str, Any]:
    """Return the row of a gauge that sits beside its point by an offset along it [mm]."""
    x, y, z = np.array(gauge.point) + offset * np.array(gauge.direction)
    return {
        "name": gauge.name,
        "point": part.place((float(x), float(y), float(z))),
        "direction": part.direction(replace(gauge, point=(float(x), float(y), float(z)))),
        "length": GAUGE_LENGTH,
    }


def _change_drawing(drawing: dict[str, Any], part: Part, fault: Fault) -> None:
    """Change the rows of a structure file as a fault does; a loss is one of the mesh."""
    if fault.effect == "support_compliance":
        (row,) = [row for row in drawing["support"] if row["set"] == fault.place]
        x, y, z = np.mean(part.supports[fault.place], axis=0)
        row["rigid_about"] = part.place((float(x), float(y), float(z)))
        row["hold"] = [motion for motion in MOTIONS if motion != fault.motion]
        row["springs"] = [fault.value if motion == fault.motion else 0.0 for motion in MOTIONS]
    elif fault.effect == "added_mass":
        place = part.place(fault.point)
        drawing["mass"].append({"name": "hidden", "point": place, "mass": fault.value})
    elif fault.effect == "load_offset":
        (row,) = [row for row in drawing["load"] if row["name"] == fault.place]
        row["point"][MOTIONS.index(fault.motion)] += 1e3 * fault.value
    elif fault.effect == "gauge_offset":
        drawing["gauge"] = [
            _gauge(part, gauge, 1e3 * fault.value * (gauge.name == fault.place))
            for gauge in part.gauges
        ]


def _write_mesh(file: Path, part: Part, refinement: int, faults: Sequence[Fault]) -> list[str]:
    """Write the mesh of a part with its supports and damage regions, and return the regions."""
    points, cells = _grid(part, refinement)
    supports = {}
    for name, (low, high) in part.supports.items():
        is_above = np.all(points >= np.array(low) - 1e-6, axis=1)
        supports[name] = is_above & np.all(points <= np.array(high) + 1e-6, axis=1)
    centres = points[cells[:, :8]].mean(axis=1)
    # the model declares damage of one cell under the tool; a truth with a loss declares that alone
    from_tool = np.linalg.norm(centres - np.array(part.tool), axis=1)
    regions = {"declared": from_tool <= np.sort(from_tool)[refinement**3 - 1]}
    boxes = [fault.box for fault in faults if fault.effect == "region_stiffness_loss"]
    for low, high in boxes:
        is_inside = np.all((centres > np.array(low)) & (centres < np.array(high)), axis=1)
        regions = {"lost": is_inside}
    mesh = meshio.Mesh(
        part.bend(points),
        [("hexahedron20", cells)],
        point_data={name: is_held.astype(np.int64) for name, is_held in supports.items()},
        cell_data={name: [is_inside.astype(np.int64)] for name, is_inside in regions.items()},
    )
    meshio.write(file, mesh)
    return [*regions]


def _grid(part: Part, refinement: int) -> tuple[FloatArray, np.ndarray]:
    """Return points (n, 3) [mm] and cells (nc, 20) of the solid boxes of a part's grid."""
    planes = []
    for breaks, counts in zip(part.breaks, part.counts, strict=True):
        pieces = [np.array(breaks[:1])]
        for low, high, count in zip(breaks[:-1], breaks[1:], counts, strict=True):
            pieces.append(np.linspace(low, high, refinement * count + 1)[1:])
        planes.append(np.concatenate(pieces))
    # cells whose middle lies in a solid box
    starts = np.indices([len(plane) - 1 for plane in planes]).reshape(3, -1).T
    middles = np.column_stack(
        [
            0.5 * (plane[:-1] + plane[1:])[start]
            for plane, start in zip(planes, starts.T, strict=True)
        ]
    )
    is_solid = np.zeros(len(starts), dtype=bool)
    for corner, opposite in part.solid:
        is_solid |= np.all((middles > np.array(corner)) & (middles < np.array(opposite)), axis=1)
    # nodes are numbered on a grid of half cells
    kind = KINDS["hexahedron20"]
    corners = np.array(
        [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    )
    doubled = 2 * (starts[is_solid][:, np.newaxis] + corners)
    on_edges = [
        (doubled[:, first] + doubled[:, second])[:, np.newaxis] // 2 for first, second in kind.edges
    ]
    nodes = np.concatenate((doubled, *on_edges), axis=1)
    numbers, cells = np.unique(nodes.reshape(-1, 3), axis=0, return_inverse=True)
    halves = [np.sort(np.concatenate((plane, 0.5 * (plane[:-1] + plane[1:])))) for plane in planes]
    points = np.column_stack([half[number] for half, number in zip(halves, numbers.T, strict=True)])
    return points, cells.reshape(len(nodes), 20)
