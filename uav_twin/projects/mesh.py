"""`uav-twin init mesh`: a structure from a mesh, and a mission of its twin."""

import shutil
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from fe.runtime.arrays import FloatArray
from fe.structure.affine import AffineStructure, static_response, static_responses
from fe.structure.design import Rosette
from fe.structure.gauges import evenly_placed_rosettes
from fe.structure.mesh import StructureMesh
from fe.structure.mesh_file import read_mesh
from fe.structure.operators import assemble_structure
from fe.structure.tables import UNITS
from scenarios import structure_files
from uav_twin.projects.project import (
    CHECK_MISSION,
    FLY_MISSION,
    VIEW_FLIGHT,
    Project,
    filled_in,
    rounded_to,
)

STRUCTURE_NAME = "part.toml"
"""The file of the structure."""
STREAM_NAME = "stream.csv"
"""The readings of a real asset."""
SECONDS_PER_STEP = 600.0
"""Length of a step of a real asset [s]."""
HEAVY = 3.0
"""Load factor of the harder control."""
_ROSETTES = 4
_LARGE_IN_METRES = 10.0
"""A part whose coordinates exceed this is taken to be in millimetres."""
_THICKNESSES_OF_END = (1e-6, 0.02, 0.05, 0.1, 0.2)
"""Fractions of the length of a part that are tried for the sets of nodes at its ends."""
_NODES_OF_END = 4
"""Least number of nodes that are held, or pulled."""
_REGIONS = (("z_root", "root_region", 0.0, 0.3), ("z_middle", "middle_region", 0.3, 0.6))
"""State, set of cells, and both ends as fractions of the length of the part, of each region."""
_AXES = "xyz"
_SHARE_OF_LIMIT = 0.75
"""Share of the limit from which on the light control is the better one, by the guessed rewards.

They differ by 0.2 times 2.5, and the heavy load uses up two thirds of the strain more.
"""
_USUAL_STRAIN = 100e-6
"""Largest strain of a gauge under the guessed force at a load factor of one."""


@dataclass(frozen=True)
class PartDraft:
    """What is guessed about a part from its mesh alone.

    Attributes
    ----------
    unit : str
        The unit of length of the mesh.
    axis : int
        The axis of the largest extent.
    across : int
        The axis of the smallest extent, along which the part is pulled.
    root, tip : (2, 3) array
        Corners of the boxes of nodes that are held (root) and pulled (tip), in `unit`.
    regions : list of (2, 3) array
        Corners of the box of cells of each region of `_REGIONS`, in `unit`.
    """

    unit: str
    axis: int
    across: int
    root: FloatArray
    tip: FloatArray
    regions: list[FloatArray]
    rosettes: list[Rosette]


def draft_part(mesh: StructureMesh) -> PartDraft:
    """Return a support, a loaded tip, regions and gauges for a part, by its extent alone.

    The part is taken to be supported at the low end of its longest axis, the root, and loaded at
    the other end, the tip.
    """
    points = mesh.points / mesh.unit
    low = points.min(axis=0)
    high = points.max(axis=0)
    extent = high - low
    axis = int(np.argmax(extent))
    slack = 1e-3 * extent.max()

    def box_between(begin: float, end: float) -> FloatArray:
        """Return the box between two fractions of the length."""
        box = np.array([low - slack, high + slack])
        box[0, axis] = low[axis] + begin * extent[axis] - (slack if begin == 0.0 else 0.0)
        box[1, axis] = low[axis] + end * extent[axis] + (slack if end == 1.0 else 0.0)
        return box

    def box_with_nodes(*, at_root: bool) -> FloatArray:
        """Return the thinnest box at an end of the part that has enough nodes."""
        box = box_between(0.0, 1.0)
        for thickness in _THICKNESSES_OF_END:
            begin, end = (0.0, thickness) if at_root else (1.0 - thickness, 1.0)
            box = box_between(begin, end)
            if np.all((points >= box[0]) & (points <= box[1]), axis=1).sum() >= _NODES_OF_END:
                break
        return box

    rosettes = []
    for number, rosette in enumerate(evenly_placed_rosettes(mesh, _ROSETTES), start=1):
        rosettes.append(rosette.model_copy(update={"name": f"r{number}"}))
    return PartDraft(
        unit=mesh.unit_name,
        axis=axis,
        across=int(np.argmin(extent)),
        root=box_with_nodes(at_root=True),
        tip=box_with_nodes(at_root=False),
        regions=[box_between(begin, end) for _, _, begin, end in _REGIONS],
        rosettes=rosettes,
    )


def _unit_of(mesh_file: Path) -> str:
    """Return the length unit of a mesh: "mm" if its coordinates are large, else "m"."""
    mesh = read_mesh(mesh_file, 1.0, "units of the file")
    return "mm" if np.ptp(mesh.points, axis=0).max() > _LARGE_IN_METRES else "m"


def structure_text(name: str, mesh_name: str, draft: PartDraft, force: float) -> str:
    """Return the text of a structure file for a mesh, with a force [N] at the tip."""
    direction = np.zeros(3)
    direction[draft.across] = -force
    regions = []
    for (state, cell_set, _, _), box in zip(_REGIONS, draft.regions, strict=True):
        regions.append({"state": state, "set": cell_set, "box": _vectors(box)})
    rosettes = []
    for rosette in draft.rosettes:
        rosettes.append(
            {
                "name": rosette.name,
                "point": _vectors(np.array(rosette.point)),
                "axes": _vectors(np.array(rosette.axes)),
            }
        )
    return filled_in(
        "structure.toml",
        schema="structure",
        name=name,
        mesh=mesh_name,
        unit=draft.unit,
        axis=_AXES[draft.axis],
        root=_vectors(draft.root),
        tip=_vectors(draft.tip),
        force=_vectors(direction),
        regions=regions,
        rosettes=rosettes,
    )


def _vectors(values: FloatArray) -> str:
    """Return vectors as TOML, with six digits of the largest component."""
    digits = 6 - int(np.ceil(np.log10(np.abs(values).max())))
    return str((np.round(values, digits) + 0.0).tolist())


def mission_text(name: str, structure_file: Path, *, watched: bool = False) -> str:
    """Return the text of a mission for a complete structure file.

    Noise and limit follow from the strains under the heavy load.

    Parameters
    ----------
    watched : bool
        Whether a real asset is watched instead of a simulated flight.
    """
    structure = assemble_structure(structure_file)
    design = structure.design
    parameter = design.parameter[0].name
    control = design.control[0].name
    asset = None
    if not watched:
        asset = (
            f'kind = "structure"  # what flies\nstructure = "{structure_file.name}"\n'
            f"parameters = {{ {parameter} = 1.02 }}  # the true one, unseen by the twin"
        )
    return filled_in(
        "mission.toml",
        schema="scenario",
        name=name,
        title=f"A mission of {name}",
        steps=30,
        controls=[
            {"name": "light", "inputs": f"{{ {control} = 1.0 }}"},
            {"name": "heavy", "inputs": f"{{ {control} = {HEAVY} }}"},
        ],
        states=[_state(region.name) for region in design.damage],
        role="strain",
        sensors=_sensors(structure),
        probability="{ light = 0.02, heavy = 0.08 }",
        control_weight=2.5,
        rewards="{ light = -0.1, heavy = 0.1 }",
        asset=asset,
        belief='kind = "structure"  # what the twin predicts with\n'
        f'structure = "{structure_file.name}"',
        parameter={"name": parameter, "mean": 1.0, "deviation": 0.02},
        growth={"last_step": 16, "text": "gain_percent = 5"},
        stream={"file": STREAM_NAME, "seconds_per_step": SECONDS_PER_STEP},
    )


def _state(region: str) -> dict[str, object]:
    """Return the table of a region with its levels of stiffness loss."""
    return {
        "name": region,
        "title": f"stiffness loss {region}",
        "levels_key": "levels_percent",
        "levels": [0, 20, 40, 60, 80],
        "prior": [1, 0, 0, 0, 0],
    }


def _sensors(structure: AffineStructure) -> dict[str, object]:
    """Return titles, noise and limit of the gauges, from the strains under the heavy load.

    The limit makes the light control the better one from a loss of 60 % of the first region on.
    """
    design = structure.design
    noise = rounded_to(0.05e6 * HEAVY * _largest_strain(structure))
    strain_at_loss = []
    for loss in (0.4, 0.6):
        values = {design.damage[0].name: loss, design.control[0].name: HEAVY}
        strain_at_loss.append(float(static_response(structure, values).strain.max()))
    limit = rounded_to(1e6 * float(np.mean(strain_at_loss)) / _SHARE_OF_LIMIT)
    titles = list(structure.gauges)
    return {
        "titles": titles,
        "titles_text": "[" + ", ".join(f'"{title}"' for title in titles) + "]",
        "noise_text": f"standard_deviation_microstrain = {noise}",
        "limit_text": f"health_limit_microstrain = {limit}",
        "limited_text": 'health_sensors = "all"',
        "scale_text": f"error_scale_microstrain = {noise}",
    }


def _largest_strain(structure: AffineStructure) -> float:
    """Return the largest gauge strain under any load alone, at nominal values."""
    responses = static_responses(structure).values()
    return max(float(np.abs(response.strain).max()) for response in responses)


class _DraftedPart(NamedTuple):
    """The mesh and the structure file of a drafted part."""

    mesh_file: Path
    structure: str


def drafted_part(name: str, mesh_file: Path | None) -> _DraftedPart:
    """Guess support, load and gauges of the part in a mesh file, by default the shipped bracket.

    The force at the tip is such that the largest strain of a gauge is about `_USUAL_STRAIN`.
    """
    if mesh_file is None:
        mesh_file = structure_files()["bracket"].with_suffix(".inp")
    unit = _unit_of(mesh_file)
    draft = draft_part(read_mesh(mesh_file, UNITS[unit], unit))
    # The strain of a force of 1 N: a structure can only be assembled from files in a folder.
    with TemporaryDirectory(prefix="uav_twin_") as folder:
        structure_file = Path(folder, STRUCTURE_NAME)
        shutil.copy(mesh_file, folder)
        structure_file.write_text(structure_text(name, mesh_file.name, draft, 1.0), "utf-8")
        strain_of_newton = _largest_strain(assemble_structure(structure_file))
    force = rounded_to(_USUAL_STRAIN / strain_of_newton)
    return _DraftedPart(mesh_file, structure_text(name, mesh_file.name, draft, force))


def mesh_project(name: str, mesh_file: Path | None) -> Project:
    """Return a project with a part drafted from a mesh file, and a mission of its twin.

    Without a mesh file, the part is the bracket that the program ships with.
    """
    part = drafted_part(name, mesh_file)
    mesh_name = part.mesh_file.name
    # Noise and limit in the mission follow from the part's strains. To compute them, the part is
    # assembled from its files, which are not in the project's folder yet.
    with TemporaryDirectory(prefix="uav_twin_") as folder:
        structure_file = Path(folder, STRUCTURE_NAME)
        structure_file.write_text(part.structure, encoding="utf-8")
        shutil.copy(part.mesh_file, folder)
        mission = mission_text(name, structure_file)
    return Project(
        title="A part from a mesh, and the mission of its twin.",
        texts={STRUCTURE_NAME: part.structure, "mission.toml": mission},
        contents={mesh_name: part.mesh_file.read_bytes()},
        files={
            mesh_name: "the mesh",
            "part.toml": "material, support, loads, regions that may lose stiffness, gauges",
            "mission.toml": "what the twin sees, believes and may choose, and what really happens",
        },
        commands=(
            (
                "uav-twin structure info part.toml",
                "Check the part: mass, frequencies, strains under its loads.",
            ),
            CHECK_MISSION,
            FLY_MISSION,
            VIEW_FLIGHT,
            (
                "uav-twin run mission.toml --seeds 0:20 --out runs/many",
                "Fly it under twenty seeds, and see what the policy earns.",
            ),
        ),
    )
